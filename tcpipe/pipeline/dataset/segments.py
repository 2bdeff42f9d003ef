"""The labelled segments of all runs in one table, and where the metres of those runs went so far."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import DatasetError
from tcpipe.formats.arrow_file import map_table, write_pieces
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.tables.bits import Loss, name_of
from tcpipe.tables.columns import floats
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import LABELLED_SEGMENTS

KEPT = "kept"
"""The ledger's entry of metres that are still in use."""


@dataclass(frozen=True, slots=True)
class Pool:
    """Segments with power and position, of all runs, mapped from a file; ``ledger_m`` sums to the runs' odometers."""

    segments: pa.Table
    ledger_m: Mapping[str, float]
    findings: tuple[Finding, ...]


def pool_segments(
    runs: Sequence[RunDirectory], directory: Path, *, again: Mapping[str, NDArray[np.bool_]] | None = None
) -> Pool:
    """Gather the segments that can become samples, run by run, in a file in ``directory``.

    ``again`` marks, by run, the segments that another run has too, in the order of the run's file.

    Raises
    ------
    DatasetError : None can: the lines say what the runs lack.
    """
    names = dict.fromkeys(name for run in runs for name in run.manifest.ledger_m)
    ledger_m = {name: math.fsum(run.manifest.ledger_m.get(name, 0.0) for run in runs) for name in names}
    path, counts = directory / "segments.arrow", list[_Count]()
    write_pieces(path, LABELLED_SEGMENTS.arrow(), _usable(runs, again or {}, counts))
    segments = map_table(path)
    if segments.num_rows == 0:
        every, powered, located = (
            sum(getattr(count, name) for count in counts) for name in ("every", "powered", "located")
        )
        lack = "power where there is GNSS" if powered and located else "GNSS" if powered else "power"
        raise DatasetError(
            f"{len(runs)} runs, {every} segments, but none with {lack}: "
            "there is nothing to learn from; ingest runs that have it"
        )
    lost_m = {
        Loss.NO_POWER: math.fsum(count.no_power_m for count in counts),
        Loss.OUTSIDE_MAP: math.fsum(count.no_place_m for count in counts),
        Loss.RECORDED_TWICE: math.fsum(count.again_m for count in counts),
    }
    return Pool(segments, move_out(ledger_m, lost_m), tuple(_find_unusable(runs, counts)))


@dataclass(frozen=True, slots=True)
class _Count:
    """What the segments of a run have: how many, and the metres of those that lack power, or else a place, or else are another run's."""

    every: int
    powered: int
    located: int
    no_power_m: float
    no_place_m: float
    again_m: float


def _usable(
    runs: Sequence[RunDirectory], again: Mapping[str, NDArray[np.bool_]], counts: list[_Count]
) -> Iterator[pa.Table]:
    """Yield each run's segments that can become samples; ``counts`` gets an entry a run."""
    for run in runs:
        segments = run.segments()
        powered: NDArray[np.bool_] = np.isfinite(floats(segments, "power_watt"))
        ends = [f"{end}_{axis}_deg" for end in ("start", "end") for axis in ("lon", "lat")]
        located = np.isfinite([floats(segments, end) for end in ends]).all(axis=0)
        arc_m = floats(segments, "arc_length_m")
        usable = powered & located
        twice = usable & again.get(run.run_id, np.zeros(len(usable), np.bool_))
        lost_m = (float(arc_m[lost].sum()) for lost in (~powered, powered & ~located, twice))
        counts.append(_Count(len(powered), int(powered.sum()), int(located.sum()), *lost_m))
        usable &= ~twice
        yield segments if usable.all() else segments.filter(pa.array(usable))


def _find_unusable(runs: Sequence[RunDirectory], counts: Sequence[_Count]) -> Iterator[Finding]:
    """Yield a finding for every run that lacks power or positions everywhere."""
    for run, count in zip(runs, counts, strict=True):
        lacks = [name for name, has in (("power", count.powered), ("gnss", count.located)) if not has]
        if count.every and lacks:
            yield make_finding("run-without-samples", Subject("run", run.run_id), names={"lacks": " and ".join(lacks)})


def move_out(ledger_m: Mapping[str, float], lost_m: Mapping[Loss, float]) -> dict[str, float]:
    """Return the ledger with metres moved from what is kept to losses [m]; its sum stays the odometer."""
    moved = dict(ledger_m)
    for loss, metres in lost_m.items():
        name = name_of(loss)
        moved[name] = moved.get(name, 0.0) + float(metres)
    total = math.fsum(float(metres) for metres in lost_m.values())
    left = moved.get(KEPT, 0.0) - total
    moved[KEPT] = left if left > 1e-9 * total else 0.0  # nothing left but rounding
    return moved
