"""Segments of all runs that can become samples, what each of them needs, and the metres of the others by reason."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import DatasetError
from tcpipe.formats.parquet import map_table, write_pieces
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.tables.bits import Loss, flag_name
from tcpipe.tables.columns import to_floats
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import LABELLED_SEGMENTS, LABELS

_LACKS = {"energy": "power", "slip": "wheel odometry", "vibration": "an IMU of 50 Hz or more"}
"""By label: what a run without it lacks; a segment always has its time."""
_ENDS_DEG = [f"{end}_{axis}_deg" for end in ("start", "end") for axis in ("lon", "lat")]


@dataclass(frozen=True, slots=True)
class Need:
    """Columns that a segment needs to become a sample, what a run without them lacks, and what a segment without them is lost to."""

    columns: Sequence[str]
    lack: str
    loss: Loss

    def find_rows(self, segments: pa.Table) -> NDArray[np.bool_]:
        """Return the segments that have them, shape (M,)."""
        known: NDArray[np.bool_] = np.all(np.isfinite([to_floats(segments, name) for name in self.columns]), axis=0)
        return known

    def is_met_by(self, run: StoredRun) -> bool:
        """Return whether any segment of a run has them."""
        return bool(self.find_rows(run.table("segments", list(self.columns))).any())


def list_needs(runs: Sequence[StoredRun], labels: Sequence[str], *, has_patches: bool) -> list[Need]:
    """Return what every sample needs: the labels that were asked for, or energy if a run has it; and a position on the map.

    Without patches a position is needed if any run has one.
    """
    position = Need(_ENDS_DEG, "GNSS", Loss.OUTSIDE_MAP if has_patches else Loss.NO_POSITION)
    needs = [
        Need([LABELS[name]], lack, Loss.NO_POWER if name == "energy" else Loss.NO_LABEL)
        for name, lack in _LACKS.items()
        if name in (labels or ("energy",))
    ]
    optional = [*([] if labels else needs), *([] if has_patches else [position])]
    dropped = [need for need in optional if not any(map(need.is_met_by, runs))]
    return [need for need in (*needs, position) if need not in dropped]


def pool_segments(
    runs: Sequence[StoredRun], directory: Path, needs: Sequence[Need], *, again: Mapping[str, NDArray[np.bool_]]
) -> tuple[pa.Table, dict[str, float], list[Finding]]:
    """Return the segments that can become samples, mapped from a file in ``directory``, and metres by reason, which sum to the odometers.

    ``again`` marks, by run, the segments that another run has too, in the order of the run's file. `DatasetError` states what the runs
    lack if no segment can become a sample.
    """
    names = dict.fromkeys(name for run in runs for name in run.manifest.distance_by_reason_m)
    distance_by_reason_m = {
        name: math.fsum(run.manifest.distance_by_reason_m.get(name, 0.0) for run in runs) for name in names
    }
    path, lacks = directory / "segments.arrow", dict[str, list[str]]()
    lost = {loss: list[float]() for loss in (*dict.fromkeys(need.loss for need in needs), Loss.RECORDED_TWICE)}
    write_pieces(path, LABELLED_SEGMENTS.arrow(), _iterate_usable(runs, needs, again, lacks, lost))
    segments = map_table(path)
    if segments.num_rows == 0:
        raise DatasetError(_describe_nothing_usable(runs, needs, lacks))
    findings = [
        make_finding(
            "run-without-samples", Subject("run", run.run_id), names={"lacks": " and ".join(lacks[run.run_id])}
        )
        for run in runs
        if run.facts.segments and lacks[run.run_id]
    ]
    return (
        segments,
        move_losses(distance_by_reason_m, {loss: math.fsum(metres) for loss, metres in lost.items()}),
        findings,
    )


def _describe_nothing_usable(
    runs: Sequence[StoredRun], needs: Sequence[Need], lacks: Mapping[str, Sequence[str]]
) -> str:
    """Return what all runs lack, or what no segment has together, and what to do."""
    everywhere = [need.lack for need in needs if all(need.lack in lack for lack in lacks.values())]
    missing = " and ".join(everywhere or [need.lack for need in needs])
    remedies = ["ingest runs that have it"]
    if "GNSS" in everywhere:
        remedies.append("build without patches (--without-patches)")
    if labels := [name for name, lack in _LACKS.items() if lack in everywhere]:
        remedies.append(f"ask for other labels than {', '.join(labels)} (--labels)")
    count = f"{len(runs)} runs, {sum(run.facts.segments for run in runs)} segments"
    return f"{count}, but none with {missing}{'' if everywhere else ' at once'}; {', or '.join(remedies)}"


def _iterate_usable(
    runs: Sequence[StoredRun],
    needs: Sequence[Need],
    again: Mapping[str, NDArray[np.bool_]],
    lacks: dict[str, list[str]],
    lost: Mapping[Loss, list[float]],
) -> Iterator[pa.Table]:
    """Yield each run's segments that can become samples; add what no segment of it has to ``lacks``, and lost metres to ``lost``."""
    for run in runs:
        segments = run.segments()
        arc_m, usable = to_floats(segments, "arc_length_m"), np.ones(segments.num_rows, np.bool_)
        lacks[run.run_id] = []
        for need in needs:
            rows = need.find_rows(segments)
            lost[need.loss].append(float(arc_m[usable & ~rows].sum()))
            usable &= rows
            if not rows.any():
                lacks[run.run_id].append(need.lack)
        twice = usable & again.get(run.run_id, np.zeros(len(usable), np.bool_))
        lost[Loss.RECORDED_TWICE].append(float(arc_m[twice].sum()))
        usable &= ~twice
        yield segments if usable.all() else segments.filter(pa.array(usable))


def move_losses(distance_by_reason_m: Mapping[str, float], lost_m: Mapping[Loss, float]) -> dict[str, float]:
    """Return the breakdown with metres moved from kept to losses [m]; its sum stays the odometer."""
    moved = dict(distance_by_reason_m)
    for loss, metres in lost_m.items():
        name = flag_name(loss)
        moved[name] = moved.get(name, 0.0) + float(metres)
    total = math.fsum(float(metres) for metres in lost_m.values())
    left = moved.get(KEPT, 0.0) - total
    moved[KEPT] = left if left > 1e-9 * total else 0.0  # nothing left but rounding
    return moved
