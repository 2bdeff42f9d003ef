"""What is asked of all runs of a store at once: a row for each ingestion, in the log of commits and, for other tools, in a Parquet table.

``index/runs.parquet`` is written after commits; tcpipe never reads it. It names the files of every ingestion by their path in the store.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import PurePosixPath
from typing import Literal, TypeAlias

import pyarrow as pa
from pyarrow.json import ParseOptions, ReadOptions, read_json

from tcpipe.errors import StoreError
from tcpipe.formats.json_files import convert_record, to_compact_json
from tcpipe.formats.parquet import write_parquet_bytes
from tcpipe.formats.place import Place
from tcpipe.formats.run_documents import Ingestion, LogOrigin, Manifest, RunJson
from tcpipe.tables.facts import EnergyBudget, PhysicsFit
from tcpipe.tables.findings import AFFECTED, Finding, Verdict, judge, select_findings

RUNS = "runs.parquet"


@dataclass(frozen=True, slots=True)
class KnownSensor:
    """Of a sensor: what tells one robot from another."""

    topic: str
    type_name: str
    frame_id: str


@dataclass(frozen=True, slots=True)
class KnownLog:
    """What is known of a run's log."""

    source: LogOrigin
    tags: Mapping[str, str]
    sensors: Mapping[str, KnownSensor]
    """By role."""
    outline: str = ""
    """Hash of the log's size and index; "" where it has none (ADR-30)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts(Ingestion):
    """What is asked of an ingestion when all of a store are looked at; the manifest has the rest."""

    manifest: str
    """Name of the manifest in the directory of the ingestion."""
    segments: int
    findings: tuple[Finding, ...]
    energy_budget: EnergyBudget | None
    segments_sha256: str
    start_ns: int | None = None
    """When the first segment begins [ns since 1970]; None without segments, or where that is not known."""
    end_ns: int | None = None
    """When the last segment ends."""
    log: KnownLog | None = None
    """None where the document of the log is gone or not as it was written."""
    superseded_by: str | None = None
    """The run that took the place of this one."""
    segments_file: str = ""
    """Where the segments lie in the store."""
    track_file: str = ""
    files: Mapping[str, int] = field(default_factory=dict)
    """Size [byte] of the manifest, of the documents of the log and tags, and of the tables, by their name in the directory of the run."""
    commit: int = 0
    """Number of the commit that made it visible."""
    idle_watt: float | None = None
    """Idle power of the robot."""
    physics: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Terms of the fit of power and their standard deviations, in SI, by ``term`` or, of one class of terrain, ``term on terrain``."""

    @property
    def verdict(self) -> Verdict:
        """What its findings say by the catalogue of now."""
        return judge(self.findings)

    @property
    def is_empty(self) -> bool:
        """Whether there is no segment though the robot drove."""
        return bool(select_findings(self.findings, "no-segments"))

    @property
    def defect(self) -> Literal["damaged", "empty", ""]:
        """What is wrong with it, in one word."""
        return "damaged" if self.damage else "empty" if self.is_empty else ""


def make_run_facts(manifest: Manifest, name: str, files: Mapping[str, int]) -> RunFacts:
    """Return the row of an ingestion; ``name`` is that of its manifest, ``files`` as in the row."""
    label, place = manifest.info.report.facts.label, f"runs/{manifest.run_id}/{manifest.recipe_id}"
    named = {PurePosixPath(path).name: path for path in manifest.checksums}
    if gone := [file for file in ("segments.parquet", "track.parquet", "rejections.parquet") if file not in named]:
        raise StoreError(f"{place}: its manifest lists no {gone[0]}; ingest the log again")
    return convert_record(
        manifest,
        RunFacts,
        manifest=name,
        segments=manifest.counts.segments,
        energy_budget=None if label is None else label.energy_budget,
        findings=manifest.info.report.findings,
        segments_sha256=manifest.checksums[named["segments.parquet"]].sha256,
        segments_file=f"{place}/{named['segments.parquet']}",
        track_file=f"{place}/{named['track.parquet']}",
        files=files,
        idle_watt=None if label is None else label.physics.idle_watt,
        physics={} if label is None or label.physics.fit is None else _read_terms(label.physics.fit),
    )


def _read_terms(fit: PhysicsFit) -> dict[str, tuple[float, float]]:
    return {
        term.term if term.terrain == "all" else f"{term.term} on {term.terrain}": (term.value, term.std)
        for term in fit.terms
    }


def read_known_log(known: RunJson) -> KnownLog:
    """Return what a row has of what is known of a log."""
    sensors = {role: convert_record(sensor, KnownSensor) for role, sensor in known.sensors.items()}
    return KnownLog(known.source, known.tags, sensors, known.outline)


Rows: TypeAlias = Mapping[tuple[str, str], RunFacts]
"""By run and recipe."""

_TEXT, _TEXTS = pa.string(), pa.list_(pa.string())
_SCHEMA = pa.schema({
    "run_id": _TEXT, "recipe_id": _TEXT, "data_model_version": _TEXT, "tcpipe_version": _TEXT, "robot": _TEXT,
    "tags": pa.map_(_TEXT, _TEXT), "segments": pa.int64(), "driven_m": pa.float64(), "kept_m": pa.float64(),
    "findings": pa.list_(pa.struct({"code": _TEXT, "severity": _TEXT})), "damage": _TEXTS,
    "verdict": pa.struct({"position": _TEXT, "time": _TEXT, "energy": _TEXT}), "start_ns": pa.int64(), "end_ns": pa.int64(),
    "log": pa.struct({"source": pa.struct({"paths": _TEXTS, "sha256": _TEXT, "size_bytes": pa.int64()})}),
    "superseded_by": _TEXT, "segments_file": _TEXT, "track_file": _TEXT,
})  # fmt: skip


def _pick(record: object, names: Iterable[str]) -> dict[str, object]:
    return {name: getattr(record, name) for name in names}


_CELLS: Mapping[str, Callable[[RunFacts], object]] = {
    "tags": lambda row: [{"key": key, "value": row.tags[key]} for key in sorted(row.tags)],
    "findings": lambda row: [_pick(finding, ("code", "severity")) for finding in row.findings],
    "damage": lambda row: [finding.code for finding in row.damage],
    "verdict": lambda row: _pick(row.verdict, AFFECTED),
    "log": lambda row: row.log and {"source": _pick(row.log.source, ("paths", "sha256", "size_bytes"))},
}
"""How a column is made that is no field of a row."""


def write_index(place: Place, rows: Rows) -> None:
    """Write ``runs.parquet`` of a state of the log; where that cannot be, the next commit writes it."""
    lines = [_make_line(rows[key]) for key in sorted(rows)]
    with suppress(StoreError):
        place.put(RUNS, write_parquet_bytes(_parse_lines(lines) if lines else _SCHEMA.empty_table()))


def _make_line(row: RunFacts) -> bytes:
    cells = {name: _CELLS.get(name, attrgetter(name))(row) for name in _SCHEMA.names}
    line = to_compact_json(cells)
    return to_compact_json(_to_text(cells)) if b"\\ud" in line else line  # a name that is no text


def _parse_lines(lines: Sequence[bytes]) -> pa.Table:
    data = b"\n".join(lines)
    at, field = _SCHEMA.get_field_index("tags"), _SCHEMA.field("tags")
    schema = _SCHEMA.set(at, field.with_type(pa.list_(pa.struct({"key": _TEXT, "value": _TEXT}))))  # JSON has no maps
    table = read_json(pa.BufferReader(data), ReadOptions(block_size=len(data)), ParseOptions(explicit_schema=schema))
    tags = table.column(at).combine_chunks()
    return table.set_column(at, field, pa.MapArray.from_arrays(tags.offsets, *tags.values.flatten()))


def _to_text(value: object) -> object:
    """Return a value with names of files that are no text as text with escapes."""
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, Mapping):
        return {str(_to_text(key)): _to_text(item) for key, item in value.items()}
    return [_to_text(item) for item in value] if isinstance(value, tuple | list) else value
