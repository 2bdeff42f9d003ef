"""The runs of a dataset: intact runs of one robot and recipe, and findings on excluded ones."""

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Mask
from tcpipe.errors import DatasetError, list_first
from tcpipe.formats.dataset_card import RunSource
from tcpipe.formats.documents import State
from tcpipe.formats.parquet import map_table, write_pieces
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.runs import RunFacts
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.recipe import Recipe
from tcpipe.robots import GENERIC
from tcpipe.store import Store
from tcpipe.tables.bits import Loss, flag_name
from tcpipe.tables.columns import to_floats
from tcpipe.tables.findings import Finding, Findings, Remedy, Subject, make_finding
from tcpipe.tables.levels import DATA_MODEL_VERSION, LABELLED_SEGMENTS, LABELS, Sensor

CHOICE_CODES = frozenset({"run-damaged", "run-gone", "run-ingested-otherwise"})
"""Findings on runs that are excluded though they belong in a dataset."""


@dataclass(frozen=True, slots=True)
class SelectedRuns:
    """Runs of one robot and recipe, and findings on excluded ones."""

    runs: tuple[StoredRun, ...]
    missing: Findings
    """On each matching run that was ingested in another way."""
    damaged: Findings
    """Findings on runs whose files were changed or lost."""
    findings: Findings
    """On superseded runs."""


def choose_runs(
    store: Store, recipe: Recipe, *, state: State, robot: str | None, tags: Mapping[str, str], prove: bool = True
) -> SelectedRuns:
    """Return the runs with all of the tags, verified if ``prove``; two robots are pooled only on request."""
    found, key = store.runs(state), ingest_key(recipe)
    mine = [run for run in found if run.facts.ingest_key == key]
    if not mine:
        raise DatasetError(*_describe_no_runs(store, found, state))
    candidates = _select_one_robot(store, _select_tagged(store, mine, tags), robot)
    damaged = store.prove(candidates) if prove else dict[str, str]()
    runs = [run for run in candidates if run.run_id not in damaged]
    known, rows = {run.run_id for run in mine}, state.list_rows()
    selected = [row for row in rows if row.run_id not in known and _is_selected(row, robot, tags)]
    for row in selected:
        if row.blob and not state.has_payload(row) and not row.superseded_by:
            damaged.setdefault(row.run_id, f"the tables of run {row.run_id} are missing")
    if not runs:
        raise DatasetError(
            *(f"run {run_id}: excluded: {line}; ingest its log again with --force" for run_id, line in damaged.items())
        )
    if robot is None:
        generic = {run.run_id: run.facts.sensors for run in runs if run.facts.robot == GENERIC}
        if differences := find_other_sensors(generic):
            raise DatasetError(
                f"{store.root}: the runs of robot {GENERIC} are not all of one robot: their sensors differ; expected one: tag each "
                "(tcpipe ingest LOG --tag robot=NAME) and choose it with --tag robot=NAME, or pool them with --robot generic",
                *differences,
            )
    otherwise = {
        row.run_id: {"what": "recipe", "has": row.recipe_id}
        if row.data_model_version == DATA_MODEL_VERSION
        else {"what": "data_model", "has": row.data_model_version}
        for row in selected
        if row.blob and not row.superseded_by and row.run_id not in damaged
    }
    nothing: dict[str, str] = {}
    missing = tuple(_find_left_out(rows, "run-ingested-otherwise", otherwise))
    broken = tuple(_find_left_out(rows, "run-damaged", dict.fromkeys(damaged, nothing), force=True))
    superseded = {row.run_id: row.superseded_by for row in rows if row.superseded_by and row.ingest_key == key}
    findings = (
        make_finding("run-superseded", Subject("run", run_id), names={"by": by}) for run_id, by in superseded.items()
    )
    return SelectedRuns(tuple(runs), missing, broken, tuple(findings))


def _find_left_out(
    rows: Iterable[RunFacts], code: str, names: Mapping[str, Mapping[str, str]], *, force: bool = False
) -> Iterator[Finding]:
    """Yield a finding on each run of ``names``, with the command that ingests its log again."""
    command = f"tcpipe ingest {_suggest_logs(rows, names)}{' --force' if force else ''}" if names else ""
    for run_id in sorted(names):
        subject, remedy = Subject("run", run_id), Remedy("ingest", command=command)
        yield make_finding(code, subject, names=names[run_id], remedies=[remedy])


def _select_one_robot(store: Store, runs: list[StoredRun], robot: str | None) -> list[StoredRun]:
    robots = sorted({run.facts.robot for run in runs})
    wanted = [run for run in runs if robot is None or run.facts.robot == robot]
    if not wanted:
        raise DatasetError(f"{store.root}: no run of robot {robot!r}; there are runs of {', '.join(robots)}")
    if robot is None and len(robots) > 1:
        raise DatasetError(f"{store.root}: runs of {len(robots)} robots ({', '.join(robots)}); name one with --robot")
    return wanted


def _select_tagged(store: Store, runs: list[StoredRun], tags: Mapping[str, str]) -> list[StoredRun]:
    """Return the runs with all of the tags; `DatasetError` lists all tags if no run has them."""
    chosen = [run for run in runs if tags.items() <= run.facts.tags.items()]
    if not chosen:
        wanted = " ".join(f"{key}={value}" for key, value in tags.items())
        known_tags = sorted({f"{key}={value}" for run in runs for key, value in run.facts.tags.items()})
        raise DatasetError(f"{store.root}: no run is tagged {wanted}; known tags: {', '.join(known_tags) or 'none'}")
    return chosen


def _describe_no_runs(store: Store, found: Sequence[StoredRun], state: State) -> list[str]:
    """Return why no run of the store can be used."""
    rows = state.list_rows()
    if not rows:
        return [f"{store.root}: no runs in the store; ingest one: tcpipe ingest LOG"]
    if found:
        head = (
            f"{len({run.run_id for run in found})} runs in the store, none ingested with this recipe; ingest them with it "
            "(tcpipe ingest LOG --recipe FILE), or give the recipe they were ingested with (--recipe FILE)"
        )
        return [f"{store.root}: {head}"]
    versions, lost = (
        ", ".join(sorted({row.data_model_version for row in rows})),
        sum(not state.has_payload(row) for row in rows),
    )
    why = f"data model {versions}, expected {DATA_MODEL_VERSION}; {lost} without tables"
    return [f"{store.root}: {len(rows)} runs in the store, none that can be read ({why}); ingest their logs again"]


def _is_selected(known: RunFacts | RunSource, robot: str | None, tags: Mapping[str, str]) -> bool:
    """Return whether a run has the requested robot and tags, as far as they are known."""
    its_robot = robot is None or known.robot == robot
    return its_robot and (known.tags is None or tags.items() <= known.tags.items())


def _suggest_logs(rows: Iterable[RunFacts], run_ids: Iterable[str]) -> str:
    """Return an argument of `tcpipe ingest` for the logs of runs: their common folder, or LOG..."""
    names = set(run_ids)
    paths = [path for row in rows if row.run_id in names for path in row.log.paths]
    with suppress(ValueError):  # no path, or some relative and some not
        folder = Path(os.path.commonpath(paths))
        if folder.is_absolute() and folder != Path(folder.anchor):
            return str(folder)
    return "LOG..."


def find_gone_runs(
    before: Sequence[RunSource], chosen: SelectedRuns, *, robot: str | None, tags: Mapping[str, str]
) -> Findings:
    """Return a finding on each matching run of the replaced dataset that the store no longer has."""
    excluded = (*chosen.missing, *chosen.damaged, *chosen.findings)
    known = {*(run.run_id for run in chosen.runs), *(finding.subject.name for finding in excluded)}
    missing = [run.run_id for run in before if run.run_id not in known and _is_selected(run, robot, tags)]
    return tuple(make_finding("run-gone", Subject("run", run_id)) for run_id in sorted(missing))


def find_other_sensors(sensors: Mapping[str, Mapping[str, Sensor]]) -> list[str]:
    """Return a line for each difference between runs by role: type, frame or namespace, or no role in common.

    A role that a run lacks is no difference: a sensor may be off for a drive.
    """
    known, differences = dict[str, Sensor](), dict[str, list[str]]()
    for run_id in sorted(sensors, key=lambda run_id: (-len(sensors[run_id]), run_id)):
        own = sensors[run_id]
        shared = sorted(known.keys() & own.keys())
        wrong = [role for role in shared if not _is_similar(known[role], own[role])] if shared else [*known, *own]
        if wrong and known:
            text = " instead of ".join(_format_sensors(each, dict.fromkeys(wrong)) for each in (own, known))
            differences.setdefault(text, []).append(run_id)
        else:
            known = {**own, **known}
    return [f"{list_first(sorted(run_ids), 3)}: {text}" for text, run_ids in differences.items()]


def _format_sensors(sensors: Mapping[str, Sensor], roles: Iterable[str]) -> str:
    """Return the sensors of some roles as text."""
    known = ((role, sensors[role]) for role in roles if role in sensors)
    parts = (f"{role} {each.topic} ({each.type_name}, frame {each.frame_id or 'none'})" for role, each in known)
    return ", ".join(parts) or "no sensor"


def _is_similar(one: Sensor, other: Sensor) -> bool:
    """Return whether two sensors agree in type and frame, and not only in all but the namespace (/a/imu, /b/imu)."""
    a, b = one.topic.strip("/").split("/"), other.topic.strip("/").split("/")
    is_apart = a != b and (a[1:] == b or a == b[1:] or (a[1:] == b[1:] and len(a) > 1))
    kinds = ((each.type_name, each.frame_id.strip("/")) for each in (one, other))
    return not is_apart and len(set(kinds)) == 1


_LACKS = {"energy": "power", "slip": "wheel odometry", "vibration": "an IMU of 50 Hz or more"}
"""By label: the missing sensor of a run without it; a segment always has its time."""
_ENDS_DEG = [f"{end}_{axis}_deg" for end in ("start", "end") for axis in ("lon", "lat")]


@dataclass(frozen=True, slots=True)
class Need:
    """Columns that a sample needs, with what a run without one lacks, and the loss of a segment without one."""

    columns: Sequence[str]
    lack: str
    loss: Loss

    def find_rows(self, segments: pa.Table) -> Mask:
        """Return the segments that have them, shape (M,)."""
        return np.asarray(np.all(np.isfinite([to_floats(segments, name) for name in self.columns]), axis=0))


def list_needs(runs: Sequence[StoredRun], labels: Sequence[str], *, has_patches: bool) -> list[Need]:
    """Return the columns that every sample needs: requested labels (default: energy if a run has it), and a position.

    Without patches a position is needed if any run has one.
    """
    position = Need(_ENDS_DEG, "GNSS", Loss.OUTSIDE_MAP if has_patches else Loss.NO_POSITION)
    needs = [
        Need([LABELS[name]], lack, Loss.NO_POWER if name == "energy" else Loss.NO_LABEL)
        for name, lack in _LACKS.items()
        if name in (labels or ("energy",))
    ]
    optional = [*([] if labels else needs), *([] if has_patches else [position])]
    dropped = [
        need
        for need in optional
        if not any(need.find_rows(run.table("segments", [*need.columns])).any() for run in runs)
    ]
    return [need for need in (*needs, position) if need not in dropped]


def pool_segments(
    runs: Sequence[StoredRun], directory: Path, needs: Sequence[Need], *, again: Mapping[str, Mask]
) -> tuple[pa.Table, dict[str, float], list[Finding]]:
    """Return the segments that can become samples, mapped from a file in ``directory``, and metres by reason.

    ``again`` marks, by run, the segments that another run has too, in the order of the run's file. `DatasetError`
    states what the runs lack if no segment can become a sample.
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
    """Return the columns that all runs lack, or that no segment has together, and what to do."""
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
    again: Mapping[str, Mask],
    lacks: dict[str, list[str]],
    lost: Mapping[Loss, list[float]],
) -> Iterator[pa.Table]:
    """Yield each run's segments that can become samples; add missing columns to ``lacks``, lost metres to ``lost``."""
    for run in runs:
        segments = run.segments()
        arc_m, usable = to_floats(segments, "arc_length_m"), np.ones(segments.num_rows, bool)
        lacks[run.run_id] = []
        for need in needs:
            rows = need.find_rows(segments)
            lost[need.loss].append(float(arc_m[usable & ~rows].sum()))
            usable &= rows
            if not rows.any():
                lacks[run.run_id].append(need.lack)
        twice = usable & again.get(run.run_id, np.zeros(len(usable), bool))
        lost[Loss.RECORDED_TWICE].append(float(arc_m[twice].sum()))
        usable &= ~twice
        yield segments if usable.all() else segments.filter(usable)


def move_losses(distance_by_reason_m: Mapping[str, float], lost_m: Mapping[Loss, float]) -> dict[str, float]:
    """Return the breakdown with metres moved from kept to losses [m]; its sum stays the odometer."""
    moved = dict(distance_by_reason_m)
    for loss, metres in lost_m.items():
        name = flag_name(loss)
        moved[name] = moved.get(name, 0.0) + float(metres)
    total = math.fsum(float(metres) for metres in lost_m.values())
    rest_m = moved.get(KEPT, 0.0) - total
    moved[KEPT] = rest_m if rest_m > 1e-9 * total else 0.0  # only rounding errors remain
    return moved
