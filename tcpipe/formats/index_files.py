"""The index of a store: what is asked of all runs and logs at once, as two Parquet tables; made again at will, never the truth (ADR 87).

A row holds what a document says and the state of its file: a document whose file is in another state is read again. Any tool may
read the tables, as ``runs.parquet`` names the files of every ingestion, by their place in the store.
"""

from __future__ import annotations

import gc
import logging
import math
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import pyarrow as pa

from tcpipe.errors import StoreError
from tcpipe.formats.json_files import compact_json, is_text, of_json, parse_json, plain, recast, typed
from tcpipe.formats.parquet import parquet_of, write_table
from tcpipe.formats.place import Entry, Place
from tcpipe.formats.record_files import Sighting
from tcpipe.formats.run_documents import LogOrigin, Manifest, RunJson
from tcpipe.tables.arrays import column_of
from tcpipe.tables.facts import EnergyBudget, PhysicsFit
from tcpipe.tables.findings import Finding, select_findings
from tcpipe.tables.verdicts import Verdict, judge_again

T = TypeVar("T")

logger = logging.getLogger("tcpipe")

RUNS, LOGS = "runs.parquet", "logs.parquet"

_ABOUT = b"tcpipe_index"
_VERSION = b"6"
"""Of these tables: those of another are made again."""


@dataclass(frozen=True, slots=True)
class KnownSensor:
    """Of a sensor: what tells one robot from another."""

    topic: str
    type_name: str
    frame_id: str


@dataclass(frozen=True, slots=True)
class KnownLog:
    """What is known of a run's log, and the state of the documents that say so."""

    state: str
    source: LogOrigin
    tags: Mapping[str, str]
    sensors: Mapping[str, KnownSensor]
    """By role."""


@dataclass(frozen=True, slots=True)
class RunFacts:
    """What is asked of an ingestion when all of a store are looked at; the manifest has the rest."""

    run_id: str
    recipe_id: str
    state: str
    """Of the manifest."""
    data_model_version: str
    tcpipe_version: str
    ingest_key: str
    robot: str
    robot_requested: str | None
    message_definitions: str
    tags: Mapping[str, str]
    segments: int
    driven_m: float
    kept_m: float
    findings: tuple[Finding, ...]
    verdict: Verdict
    damage: tuple[str, ...]
    energy_budget: EnergyBudget | None
    segments_sha256: str
    start_ns: int | None = None
    """When the first segment begins [ns since 1970]; None without segments, or where that is not known."""
    end_ns: int | None = None
    """When the last segment ends."""
    proved: str = ""
    """The state of segments and track when their bytes were compared with the manifest; "" if they never were."""
    log: KnownLog | None = None
    """None where the document of the log is gone or not as it was written."""
    superseded_by: str | None = None
    """The run that took the place of this one."""
    segments_file: str = ""
    """Where the segments lie in the store."""
    track_file: str = ""
    sizes: Mapping[str, int] = field(default_factory=dict)
    """How large the files of the manifest are [byte], by their name beside it."""
    ledger_m: Mapping[str, float] = field(default_factory=dict)
    """Where every metre went [m], by entry."""
    standing_watt: float | None = None
    """What the robot draws while it stands."""
    physics: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Terms of the fit of power and their standard deviations, in SI, by ``term`` or, of one class of terrain, ``term on terrain``."""

    @property
    def is_empty(self) -> bool:
        """Whether there is no segment though the robot drove."""
        return bool(select_findings(self.findings, "no-segments"))


@dataclass(frozen=True, slots=True)
class SeenLog:
    """A record of a log that was seen, and the state of its file."""

    lineage: str
    name: str
    state: str
    sighting: Sighting


@contextmanager
def uncollected() -> Iterator[None]:
    """Let Python's search for cycles rest: rows have none, and it would go through ten thousand of them again and again."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def state_of(entry: Entry) -> str:
    """Return what tells a file from one that was written since: name, size, time of writing."""
    return f"{entry.name.rpartition('/')[2]}-{entry.size_bytes}-{entry.modified_ns}"


def facts_of(manifest: Manifest, state: str) -> RunFacts:
    """Return what the index holds of a manifest."""
    label, place = manifest.info.report.facts.label, f"runs/{manifest.run_id}/{manifest.recipe_id}"
    named = {PurePosixPath(name).name: name for name in manifest.checksums}
    if gone := [name for name in ("segments.parquet", "track.parquet", "rejections.parquet") if name not in named]:
        raise StoreError(f"{place}: its manifest lists no {gone[0]}; ingest the log again")
    return recast(
        manifest,
        RunFacts,
        state=state,
        segments=manifest.counts.segments,
        driven_m=math.fsum(manifest.ledger_m.values()),
        kept_m=manifest.ledger_m.get("kept", 0.0),
        energy_budget=None if label is None else label.energy_budget,
        findings=manifest.info.report.findings,
        verdict=judge_again(manifest.verdict, manifest.info.report.findings),
        segments_sha256=manifest.checksums[named["segments.parquet"]].sha256,
        segments_file=f"{place}/{named['segments.parquet']}",
        track_file=f"{place}/{named['track.parquet']}",
        sizes={name: of.size_bytes for name, of in manifest.checksums.items()},
        standing_watt=None if label is None else label.physics.standing_watt,
        physics={} if label is None or label.physics.fit is None else _terms(label.physics.fit),
    )


def _terms(fit: PhysicsFit) -> dict[str, tuple[float, float]]:
    return {of.term if of.terrain == "all" else f"{of.term} on {of.terrain}": (of.value, of.std) for of in fit.terms}


def known_log(known: RunJson, state: str) -> KnownLog:
    """Return what the index holds of what is known of a log."""
    sensors = {role: recast(sensor, KnownSensor) for role, sensor in known.sensors.items()}
    return KnownLog(state, known.source, known.tags, sensors)


def as_stored(row: T) -> T:
    """Return a row as it can be stored: where a name in it is no text, with escapes, and without a state, so that nobody believes it."""
    if is_text(row):
        return row
    return typed({**_escaped(plain(row)), "state": ""}, type(row), Path(RUNS))


def _escaped(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {_escaped(key): _escaped(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_escaped(item) for item in value]
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


_TEXT, _TEXTS = pa.string(), pa.list_(pa.string())
_ROW = "row"
"""Column of what tcpipe itself reads, as JSON: a tenth of the time that nested columns of 10,000 rows take."""
_RUN_SCHEMA = pa.schema({
    "run_id": _TEXT, "recipe_id": _TEXT, "data_model_version": _TEXT, "tcpipe_version": _TEXT, "robot": _TEXT,
    "tags": pa.map_(_TEXT, _TEXT), "segments": pa.int64(), "driven_m": pa.float64(), "kept_m": pa.float64(),
    "findings": pa.list_(pa.struct({"code": _TEXT, "severity": _TEXT})), "damage": _TEXTS,
    "verdict": pa.struct({"position": _TEXT, "time": _TEXT, "energy": _TEXT}), "start_ns": pa.int64(), "end_ns": pa.int64(),
    "log": pa.struct({"source": pa.struct({"paths": _TEXTS, "sha256": _TEXT, "size_bytes": pa.int64()})}),
    "superseded_by": _TEXT, "segments_file": _TEXT, "track_file": _TEXT, _ROW: _TEXT,
})  # fmt: skip
_LOG_SCHEMA = pa.schema({"lineage": _TEXT, _ROW: _TEXT})


def read_runs(place: Place) -> dict[tuple[str, str], RunFacts]:
    """Return the rows of ``runs.parquet``, by run and recipe; none where there is no such index, or it cannot be read."""
    return {
        (row.run_id, row.recipe_id): replace(row, verdict=judge_again(row.verdict, row.findings))
        for row in _rows(place, RUNS, RunFacts)
    }


def read_logs(place: Place) -> dict[tuple[str, str], SeenLog]:
    """Return the rows of ``logs.parquet``, by lineage and record; none where there is no such index, or it cannot be read."""
    return {(row.lineage, row.name): row for row in _rows(place, LOGS, SeenLog)}


def write_runs(place: Place, rows: Iterable[RunFacts]) -> None:
    """Write ``runs.parquet``, unless that cannot be: the next call does without."""
    _write(place, RUNS, rows, _RUN_SCHEMA)


def write_logs(place: Place, rows: Iterable[SeenLog]) -> None:
    """Write ``logs.parquet``, unless that cannot be."""
    _write(place, LOGS, rows, _LOG_SCHEMA)


def forget_runs(place: Place, run_ids: Container[str]) -> None:
    """Take runs out of ``runs.parquet``: the next listing puts in what there is of them, and misses nothing."""
    write_runs(place, [row for (name, _), row in read_runs(place).items() if name not in run_ids])


def _rows(place: Place, name: str, cls: type[T]) -> list[T]:
    try:
        data = place.read(name)
        if data is None:
            return []
        table = parquet_of(data, place.where(name), [_ROW])
        if (table.schema.metadata or {}).get(_ABOUT) != _VERSION:
            return []
        return of_json(f"[{','.join(table.column(_ROW).to_pylist())}]", list[cls], place.where(name))  # type: ignore[valid-type]
    except (StoreError, ValueError, TypeError, KeyError, pa.ArrowException):
        logger.info("%s: the index of the store is not readable; it is made again", place.where(name))
        return []


def _write(place: Place, name: str, rows: Iterable[object], schema: pa.Schema) -> None:
    texts = [compact_json(as_stored(row)) for row in rows]
    values = [{**parse_json(text.encode(), name), _ROW: text} for text in texts]
    columns = [column_of([value[field.name] for value in values], field.type) for field in schema]
    table = pa.table(columns, schema=schema.with_metadata({_ABOUT: _VERSION}))
    with suppress(StoreError), place.workshop() as directory:
        write_table(table, directory / name)
        place.put(name, (directory / name).read_bytes())
