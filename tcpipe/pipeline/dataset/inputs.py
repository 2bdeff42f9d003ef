"""Inputs of a dataset: runs and maps of a store, one hash over all, and how they differ from an earlier dataset's.

Recordings that are in the store twice: one file under two names, or two recordings of one drive, whole or in part
(ADR-18).
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.errors import DatasetError, MapError, StoreError, UsageError, list_first
from tcpipe.formats.dataset_card import (
    DatasetCard,
    DatasetInputs,
    RecordChange,
    RunInputs,
    RunSource,
    compare_records,
    format_value,
)
from tcpipe.formats.documents import BLOBS, State
from tcpipe.formats.geojson import regions_to_json
from tcpipe.formats.integrity import compute_checksums
from tcpipe.formats.json_files import convert_record, digest
from tcpipe.formats.parquet import read_table
from tcpipe.formats.runs import RunFacts, StoredMap
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.pipeline.dataset.options import BuildOptions
from tcpipe.pipeline.dataset.runs import SelectedRuns, choose_runs
from tcpipe.store import Store, choose_maps
from tcpipe.tables.columns import encode_rows, number_column, read_ends_deg, read_spans_ns, to_integers
from tcpipe.tables.findings import Finding, Findings, Remedy, Subject, make_finding
from tcpipe.tables.levels import RESULTS_VERSION, TABLES_VERSION

if TYPE_CHECKING:
    from tcpipe.pipeline.dataset.sampling import MapPlaces


@dataclass(frozen=True, slots=True)
class ChosenInputs:
    """Runs, their entries of the card, the maps, the record of all inputs, and findings."""

    runs: tuple[StoredRun, ...]
    sources: tuple[RunSource, ...]
    map_records: tuple[StoredMap, ...]
    maps: MapPlaces
    made_from: DatasetInputs
    again: Mapping[str, Mask]
    """By run: segments that another run has too."""
    chosen: SelectedRuns
    findings: Findings
    """On the choice of runs."""

    @property
    def digest(self) -> str:
        """Digest of ``made_from``."""
        return self.made_from.digest

    @property
    def map_names(self) -> tuple[str, ...]:
        """In order of priority where maps overlap."""
        return self.made_from.map_names


def choose_inputs(store: Store, options: BuildOptions, state: State) -> ChosenInputs:
    """Return the runs of one robot ingested with this recipe, and the maps; `DatasetError` lists the candidates."""
    problems = list[str]()
    try:
        chosen = choose_runs(store, options.recipe, state=state, robot=options.robot, tags=options.tags)
        _refuse_without_segments(chosen.runs)
    except DatasetError as error:
        problems += error.problems
    try:
        records = _choose_maps(store, state, options)
    except (MapError, UsageError) as error:
        problems += error.problems
    if problems:
        raise DatasetError(*problems)
    made_from = _describe_inputs(options, chosen.runs, records)
    runs, duplicates, of_drives = remove_duplicates(chosen.runs)
    maps = partial(map, store.map_at, records)
    findings = (*chosen.findings, *of_drives)
    if not records and not options.without_patches:
        remedy = Remedy("add_map", command="tcpipe add-map NAME --height FILE")
        findings += (make_finding("no-map", Subject("dataset", options.recipe.dataset.name), remedies=[remedy]),)
    sources = tuple(_describe_run(run, RunSource) for run in runs)
    return ChosenInputs(runs, sources, records, maps, made_from, duplicates, chosen, findings)


def plan_inputs(store: Store, options: BuildOptions, state: State) -> DatasetInputs:
    """Return the inputs of a dataset from the documents alone; `TcpipeError` if runs or maps are missing."""
    chosen = choose_runs(store, options.recipe, state=state, robot=options.robot, tags=options.tags, prove=False)
    return _describe_inputs(options, chosen.runs, _choose_maps(store, state, options))


def _describe_inputs(options: BuildOptions, runs: Sequence[StoredRun], maps: Sequence[StoredMap]) -> DatasetInputs:
    regions = {} if options.regions is None else regions_to_json(options.regions)
    return DatasetInputs(
        versions={"results": str(RESULTS_VERSION), "tables": TABLES_VERSION},
        recipe=options.recipe,
        runs={run.run_id: _describe_run(run, RunInputs) for run in runs},
        robots=tuple(sorted({run.facts.robot for run in runs})),
        tags=dict(sorted(options.tags.items())),
        maps={record.name: _hash_files(record) for record in maps},
        map_names=tuple(record.name for record in maps),
        region=None if options.regions is None else {kind: digest(polygon) for kind, polygon in regions.items()},
        covariates={table.name: table.checksum.sha256 for table in options.covariates},
        file_format=options.file_format,
        labels=options.labels,
        without_patches=options.without_patches,
        without_coordinates=options.without_coordinates,
    )


R = TypeVar("R", RunInputs, RunSource)


def _describe_run(run: StoredRun, record: type[R]) -> R:
    """Return the entry of a run in the card, or in its record of inputs."""
    log, tables = run.facts.log, run.facts.tables
    names = tuple(Path(path).name for path in log.paths)
    segments = tables["segments.parquet"].sha256
    return convert_record(run.facts, record, logs=names, sha256=log.sha256, segments_sha256=segments)


def _refuse_without_segments(runs: Sequence[StoredRun]) -> None:
    if any(run.facts.segments for run in runs):
        return
    lost_m = Counter[str]()
    for run in runs:
        lost_m.update(run.facts.distance_by_reason_m)
    where = ", ".join(
        f"{metres:.0f} m {name.replace('_', ' ')}" for name, metres in lost_m.most_common(4) if metres > 0
    )
    raise DatasetError(
        f"{len(runs)} runs, but no segment in them: {where or 'the robot did not move'} "
        "('tcpipe status' lists remedies)"
    )


def prove_maps(store: Store, maps: Sequence[StoredMap]) -> None:
    """Compare the maps' files with their documents; `MapError` for a changed or lost file (else read as no data)."""
    root = store.place.path
    if root is None:  # files in a bucket are verified when they are fetched
        return
    for record in maps:
        folder = root / BLOBS / record.blob
        found = compute_checksums(folder)
        if wrong := sorted(name for name in {*found, *record.files} if found.get(name) != record.files.get(name)):
            raise MapError(
                f"map {record.name}: changed since it was written: {list_first([str(folder / name) for name in wrong])} "
                f"('tcpipe verify {store.root}' lists everything); add the map again with --force"
            )


def _hash_files(record: StoredMap) -> str:
    """Return one hash over the checksums of the files of a map."""
    start = f"{record.name}.zarr/"
    files = {name.removeprefix(start): each for name, each in record.files.items() if name.startswith(start)}
    return digest({name: (checksum.size_bytes, checksum.sha256) for name, checksum in files.items()})


def _choose_maps(store: Store, state: State, options: BuildOptions) -> tuple[StoredMap, ...]:
    """Return the maps to sample, as `choose_maps`; none for a dataset without patches."""
    if options.without_patches or not (state.maps or options.map_names):
        return ()
    hint = ", or several; the first has priority where they overlap"
    return choose_maps(store, state, options.map_names, hint=hint)


_OPTIONS = {
    "robots": "--robot",
    "tags": "--tag",
    "map_names": "--map",
    "region": "--split",
    "covariates": "--covariates",
    "file_format": "--format",
    "labels": "--labels",
    "without_patches": "--without-patches",
    "without_coordinates": "--without-coordinates",
}
"""Options of a build, by the field of `DatasetInputs` that each rules."""


def find_other_options(card: DatasetCard, options: BuildOptions, inputs: ChosenInputs) -> list[str]:
    """Return a line with both values for each build option that differs from those of the replaced dataset."""
    was, now = card.made_from, inputs.made_from
    if was.without_coordinates and now.without_coordinates:
        return ["--without-coordinates: maps, region, tags and recipe are not stored and cannot be compared"]
    is_other = was.without_coordinates != now.without_coordinates
    names = ("without_coordinates",) if is_other else ("recipe", *_OPTIONS)
    lines = (
        _format_option(change, was, now)
        for change in compare_records(was, now)
        if change.path[0] in names and _is_option(change, options)
    )
    return list(dict.fromkeys(lines))


def _is_option(change: RecordChange, options: BuildOptions) -> bool:
    """Return whether a change is of an option; contents of files, a first map and the runs' robot may change freely."""
    if change.path[0] == "covariates":
        return None in (change.was, change.now)
    if change.path[0] == "map_names":
        return bool(change.was or options.map_names)
    return change.path != ("recipe", "robot")


def _format_option(change: RecordChange, was: DatasetInputs, now: DatasetInputs) -> str:
    field = change.path[0]
    if field == "recipe":
        return f"recipe {change.name}: {format_value(change.was)} in the dataset, {format_value(change.now)} now"
    values = [getattr(record, field) for record in (was, now)]  # without contents of files
    if field == "region":
        values = [each and f"{' and '.join(each)} ({digest(each)[:8]})" for each in values]
    elif field == "covariates":
        values = list(map(tuple, values))
    return f"{_OPTIONS[field]}: {{}} in the dataset, {{}} now".format(*map(format_value, values))


_SAME_TIME_NS = 1_000_000_000
_SAME_PLACE_M = 2.0
_SAME_DRIVE = 0.5
"""If this fraction of two runs overlaps in time and place, a constant offset between their clocks is removed."""
_METRES_PER_DEG = 111_320.0
_NEVER_NS = 2**61  # later than any time [ns since 1970]; twice of it still fits an int64

_WAYS = 64  # most runs whose positions are in memory


@dataclass(frozen=True, slots=True)
class _SegmentPositions:
    """Times and places of a run's segments, in the order of its file (time): [ns], (N,), and lon, lat [deg], (N, 2)."""

    start_ns: Ints
    end_ns: Ints
    lonlat_deg: Floats


def remove_duplicates(runs: Sequence[StoredRun]) -> tuple[tuple[StoredRun, ...], dict[str, Mask], Findings]:
    """Return the runs, by id, without second logs of a drive; of two, the first by id stays.

    Also, by run, marks of the segments that an earlier run has, too; and findings. ``runs`` are all of one recipe.
    """
    runs = sorted(runs, key=lambda run: (run.run_id, run.recipe_id))
    start_ns, end_ns = np.array([_find_span_ns(run.facts) for run in runs], np.int64).reshape(-1, 2).T
    robot, kept = np.array([run.facts.robot for run in runs]), dict[int, StoredRun]()

    @lru_cache(maxsize=_WAYS)
    def way(index: int) -> _SegmentPositions:
        run = runs[index]
        names = [f"{end}_{what}" for end in ("start", "end") for what in ("ns", "lon_deg", "lat_deg")]
        table = run.table("segments", names)
        return _SegmentPositions(*read_spans_ns(table), np.mean(read_ends_deg(table), axis=0))

    duplicates: dict[str, Mask] = {}
    findings: list[Finding] = []
    by_sha256: dict[str, str] = {}
    for index, run in enumerate(runs):
        twin = by_sha256.setdefault(run.facts.log.sha256, run.run_id)
        if twin != run.run_id:
            findings.append(_find_twice(run, run.facts.segments, [twin]))
            continue
        twice, others = np.zeros(run.facts.segments, bool), []
        apart_ns = np.maximum(start_ns[:index], start_ns[index]) - np.minimum(end_ns[:index], end_ns[index])
        for earlier in np.flatnonzero((apart_ns <= _SAME_TIME_NS) & (robot[:index] == run.facts.robot)).tolist():
            if earlier in kept:
                shared = _find_shared(way(index), way(earlier))
                is_one = _is_one_drive((run, kept[earlier])) if shared.any() else False
                if is_one:
                    twice |= shared
                    others.append(kept[earlier].run_id)
                elif is_one is None:
                    findings.append(_find_overlap(run, kept[earlier], int(shared.sum())))
        if twice.any():
            findings.append(_find_twice(run, int(twice.sum()), others))
        if twice.all() and len(twice):
            continue
        duplicates[run.run_id] = twice
        kept[index] = run
    return tuple(kept.values()), duplicates, tuple(findings)


def _find_twice(run: StoredRun, duplicates: int, others: Sequence[str]) -> Finding:
    return make_finding(
        "drive-recorded-twice",
        Subject("run", run.run_id),
        names={"others": ", ".join(others)},
        duplicate_count=duplicates,
        segment_count=run.facts.segments,
    )


def _find_overlap(run: StoredRun, other: StoredRun, shared: int) -> Finding:
    """Return the question whether two runs are of one drive, with a command for each answer."""
    own, others = (shlex.join(each.facts.log.paths) for each in (run, other))
    remedies = (
        Remedy("two_robots", command=f"tcpipe ingest {own} --tag robot={run.run_id}"),
        Remedy("one_drive", command=f"tcpipe ingest {others} {own} --tag robot={other.run_id}"),
    )
    subject, names = Subject("run", run.run_id), {"other": other.run_id}
    return make_finding("drives-overlap", subject, names=names, remedies=remedies, overlapping_count=shared)


_COMPARED_ROLES = ("gnss", "pose", "wheel_odometry", "visual_odometry", "imu")
"""Sensors whose values seldom repeat, those with the fewest first."""
_MIN_EQUAL_FRACTION, _MIN_VALUES = 0.5, 3


def _is_one_drive(pair: tuple[StoredRun, StoredRun]) -> bool | None:
    """Return whether two runs at one time and place are of one drive, None if that is unknown.

    One sensor with equal values proves one drive, other values of topics of one name prove two; else the tag ``robot``
    decides.
    """
    files = [dict[str, Path](), dict[str, Path]()]
    for number, run in enumerate(pair):
        with suppress(StoreError):  # a changed stream proves nothing
            files[number] = run.stream_files()
    sensors = [run.facts.sensors for run in pair]
    for role in (role for role in _COMPARED_ROLES if all(role in found for found in files)):
        fraction = _compute_equal_fraction([read_table(found[role]) for found in files])
        if fraction >= _MIN_EQUAL_FRACTION:
            return True
        one, two = (known[role].topic if role in known else "" for known in sensors)
        if fraction < _MIN_EQUAL_FRACTION and one == two:
            return False
    tags = [run.facts.tags.get("robot") for run in pair]
    return tags[0] == tags[1] if any(tags) else None


def _compute_equal_fraction(streams: Sequence[pa.Table]) -> float:
    """Return the fraction of the unique values in the common time of two streams that both have; NaN for few."""
    names = [field.name for field in streams[0].schema if pa.types.is_floating(field.type) and "_var" not in field.name]
    stamps = [to_integers(table, "stamp_ns") for table in streams]
    first_ns = max(stamp[0] for stamp in stamps) - _SAME_TIME_NS
    last_ns = min(stamp[-1] for stamp in stamps) + _SAME_TIME_NS
    common = [
        Counter(encode_rows(table.filter(number_column((first_ns <= stamp) & (stamp <= last_ns))), names))
        for table, stamp in zip(streams, stamps, strict=True)
    ]
    once = [{row for row, count in counts.items() if count == 1} for counts in common]
    fewest = min(map(len, once))
    return len(once[0] & once[1]) / fewest if fewest >= _MIN_VALUES else math.nan


def _find_span_ns(facts: RunFacts) -> tuple[int, int]:
    """Return the time span of a run's segments: empty without segments, unlimited if it is unknown."""
    if not facts.segments:
        return _NEVER_NS, -_NEVER_NS
    if facts.start_ns is None or facts.end_ns is None:
        return -_NEVER_NS, _NEVER_NS
    return facts.start_ns, facts.end_ns


def _find_shared(own: _SegmentPositions, other: _SegmentPositions) -> Mask:
    """Mark the segments of ``own`` that are ``other``'s: at one time a robot is at one place."""
    skew_ns = 0
    together_ns = min(own.end_ns[-1], other.end_ns[-1]) - max(own.start_ns[0], other.start_ns[0])
    if together_ns >= _SAME_DRIVE * min(way.end_ns[-1] - way.start_ns[0] for way in (own, other)):
        loosely, apart_ns = _find_overlapping(own, other, slack_ns=_SAME_TIME_NS)
        if loosely.sum() >= _SAME_DRIVE * min(len(own.start_ns), len(other.start_ns)):
            skew_ns = int(np.median(apart_ns[loosely]))
    return _find_overlapping(own, other, skew_ns=skew_ns)[0]


def _find_overlapping(
    own: _SegmentPositions, other: _SegmentPositions, *, slack_ns: int = 0, skew_ns: int = 0
) -> tuple[Mask, Ints]:
    """Mark segments whose middle half overlaps a segment of ``other`` in time (with slack) and is within 2 m of it.

    The second array is their delay after that segment [ns], minus ``skew_ns``.
    """
    start_ns, quarter_ns = own.start_ns - skew_ns, (own.end_ns - own.start_ns) // 4
    first = np.searchsorted(other.end_ns, start_ns + quarter_ns - slack_ns, side="right")
    last = np.searchsorted(other.start_ns, start_ns + 3 * quarter_ns + slack_ns, side="left") - 1
    nearest_m, apart_ns = np.full(len(start_ns), np.inf), np.zeros(len(start_ns), np.int64)
    for at in (first, (first + last) // 2, last):
        there = np.clip(at, 0, len(other.start_ns) - 1)
        step_deg = other.lonlat_deg[there] - own.lonlat_deg
        east_m = step_deg[:, 0] * _METRES_PER_DEG * np.cos(np.radians(own.lonlat_deg[:, 1]))
        away_m = np.hypot(east_m, step_deg[:, 1] * _METRES_PER_DEG)
        nearer = (first <= last) & (away_m < nearest_m)
        nearest_m[nearer], apart_ns[nearer] = away_m[nearer], (start_ns - other.start_ns[there])[nearer]
    return nearest_m <= _SAME_PLACE_M, apart_ns
