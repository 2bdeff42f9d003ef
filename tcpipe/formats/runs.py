"""The record of one run; its JSON is the manifest, and a part of it is the summary that lists of runs use."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from html import escape
from typing import Literal, TypeAlias

from tcpipe.errors import clean_line
from tcpipe.formats.integrity import FileChecksums
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.recipe import IngestSections
from tcpipe.tables.facts import EnergyBudget, LabelFacts, PhysicsFit, StageFacts
from tcpipe.tables.findings import (
    AFFECTED,
    Finding,
    Findings,
    StageReport,
    Subject,
    Verdict,
    judge,
    omit,
    select_findings,
    select_problems,
)
from tcpipe.tables.levels import TABLES_VERSION, Sensor, TrackInfo

_UNFINISHED = ".active"  # ending of a ROS 1 bag that is being recorded, or was when its recorder died


Options: TypeAlias = Mapping[str, str | int | float | bool | list[str] | dict[str, str] | None]
"""Options of a call as JSON values."""


@dataclass(frozen=True, slots=True)
class LogSnapshot:
    """A log when it was found: its files, each one's size [byte] and modification time [ns], and its content's hash."""

    log: tuple[str, ...]
    size_and_time: tuple[tuple[int, int], ...]
    sha256: str


@dataclass(frozen=True, slots=True)
class LogFailure:
    """A log that failed because of its content: the same call would fail again."""

    content: str
    """The sha256 of the log; if nothing is readable, a hash of its path, sizes and times."""
    log: tuple[str, ...]
    problems: tuple[str, ...]
    version: str
    """Version of tcpipe that failed."""
    findings: Findings = omit(())


@dataclass(frozen=True, slots=True)
class Problem:
    """A finding that causes exit code 3 until somebody acknowledges it."""

    finding: Finding
    content: str
    """The sha256 of the log, or another identity of the subject: with other content a problem counts as new."""
    log: tuple[str, ...] = omit(())
    run_id: str | None = omit()

    @property
    def key(self) -> str:
        """Identifier: the code, the content, and the subject if the content does not determine it."""
        subject = self.finding.subject
        return f"{self.finding.code} {self.content} {'' if subject.kind in ('log', 'run', 'call') else subject.name}"

    @property
    def name(self) -> str:
        """Name for display: the run id, or else the log or call."""
        return self.run_id or " + ".join(self.log) or self.finding.subject.name


def make_failure(content: str, log: tuple[str, ...]) -> Problem:
    """Return the problem that a log failed because of its content."""
    return Problem(Finding("log-failed", "error", Subject("log", " + ".join(log)), "rejected"), content, log)


@dataclass(frozen=True, slots=True)
class Tags:
    """The tags of a log, which apply to every recipe."""

    log: str
    """Its sha256."""
    tags: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class StoredMap:
    """A map: its folder, and size and sha256 of each file in it."""

    name: str
    data_model_version: str
    blob: str
    files: FileChecksums

    @property
    def zarr(self) -> str:
        """Name of the Zarr group in the store."""
        return f"blobs/{self.blob}/{self.name}.zarr"

    @property
    def picture(self) -> str:
        """Name of the picture in the store."""
        return f"blobs/{self.blob}/{self.name}.png"


@dataclass(frozen=True, slots=True, kw_only=True)
class Output:
    """A dataset that was built from this store, and how the last call for it ended."""

    where: str
    """Its path or URL in full."""
    inputs: str = ""
    """Digest of the inputs of the dataset at this place; "" if none has been built."""
    parts: Mapping[str, str] = field(default_factory=dict)
    """Digests of the parts of that: runs, maps, recipe and so on."""
    runs: tuple[tuple[str, str], ...] = ()
    """Runs and recipes of which it was made: `prune` keeps them."""
    options: Options = field(default_factory=dict)
    """Options of the last call, to plan it again."""
    exit_code: int = 0
    message: str = ""
    at: str = ""
    """End of the last call: UTC, ISO 8601."""
    reported: tuple[str, ...] = ()
    """Findings that the last call reported, by code and subject: they are known."""


@dataclass(frozen=True, slots=True)
class Process:
    """Identity of a process; a field is "" if the system does not provide it."""

    host: str
    machine: str
    """Identity of the installed system (machine-id)."""
    boot: str
    """Identity of this start of the machine."""
    namespace: str
    """In which ``pid`` counts: a container has its own."""
    pid: int
    start: str
    """When it began, in ticks since the start of the machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Call:
    """A call of a command on a store; without an exit code it has not ended. Times are of the clock of its machine."""

    command: str
    version: str
    works_on: tuple[str, ...] = ()
    """Logs and folders as they were given, or the output, in full."""
    options: Options = field(default_factory=dict)
    """Options that distinguish its work from that of another call."""
    process: Process | None = None
    begin: str = ""
    """UTC, ISO 8601."""
    exit_code: int | None = None
    message: str = ""
    """Why it failed, or which call did its work after it was killed."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Number of logs by result; or of samples and runs."""
    jobs: int = 1
    wall_s: float = 0.0
    cpu_s: float = 0.0
    """CPU time of the process and its workers, including workers on a cluster [s]."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """By log, why it failed for a reason that may pass."""

    @property
    def end(self) -> str:
        """When it ended, as ``begin``."""
        return (datetime.fromisoformat(self.begin) + timedelta(seconds=self.wall_s)).isoformat(timespec="milliseconds")


def find_lineage(log: tuple[str, ...]) -> str:
    """Return the identity of a log's location; it is the same after the recorder removes ``.active``."""
    return "\n".join(path.removesuffix(_UNFINISHED) for path in log)


@dataclass(frozen=True, slots=True)
class LogOrigin:
    """Location of a run's log when it was ingested, and the identity of its content."""

    paths: tuple[str, ...]
    sha256: str
    size_bytes: int = 0
    sha256_of: Literal["log", "index"] = "log"
    """Hashed data: the whole log, or the sizes and indexes of its files if only part of it was downloaded."""
    outline: str = ""
    """Hash of the size and index of the log, which identifies it if it is not all local; "" without an index."""


@dataclass(frozen=True, slots=True)
class TopicCount:
    """A topic of a log."""

    name: str
    type: str
    messages: int | None


@dataclass(frozen=True, slots=True)
class Counts:
    """Numbers of segments, rows and rejected measurements of a run, and of messages."""

    segments: int
    track_rows: int | None = omit()
    rejections: int | None = omit()
    messages: Mapping[str, int] = field(default_factory=dict)
    """By role."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Recording time of a log, and the identity of its beginning: a longer log with the same one supersedes it."""

    first_ns: int
    """Stamp of the first measurement [ns since 1970]."""
    last_ns: int
    """Stamp of the last measurement [ns since 1970]."""
    rows: int
    """Number of measurements."""
    beginning: str
    """Hash of the first measurements of each sensor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts:
    """The facts of a run that commands need of all runs of a store; the store's index contains them."""

    run_id: str
    recipe_id: str
    data_model_version: str
    results_version: int
    tcpipe_version: str
    ingest_key: str
    """Hash of the sections of the recipe that decide its tables."""
    read_key: str
    """Hash of all settings that determine its streams."""
    robot: str
    robot_requested: str | None = None
    message_definitions: str = ""
    """Hash of the definitions that were given for types which the log does not define; "" without."""
    log: LogOrigin
    recording: Recording | None = None
    """None of a log without measurements."""
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    """By role."""
    segments: int
    start_ns: int | None = None
    """Begin of the first segment [ns since 1970]; None without segments."""
    end_ns: int | None = None
    """End of the last segment [ns since 1970]."""
    distance_by_reason_m: Mapping[str, float]
    """Distance breakdown [m], by entry."""
    findings: Findings
    """Findings of all stages."""
    damage: Findings = ()
    """Findings about damage to the log."""
    energy_joule: float | None = None
    """Energy of the whole drive, also outside segments [J]; None without power."""
    energy_budget: EnergyBudget | None = None
    idle_watt: float | None = None
    physics: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Terms of the power fit with standard deviations, in SI, by ``term`` or, for one class, ``term on terrain``."""
    blob: str
    """Folder of its tables; "" of a run whose tables were pruned."""
    tables: FileChecksums
    """``track.parquet``, ``segments.parquet`` and ``rejections.parquet`` in that folder."""
    streams_blob: str
    """Folder of its streams: its own, or that of a run of the same log with the same streams."""
    streams: FileChecksums
    """``streams/<role>.parquet`` in that folder."""
    tags: Mapping[str, str] = omit({})
    """Tags of its log, read from the records of tags; not written to the manifest."""
    superseded_by: str | None = omit()
    """The run with a longer recording: found when a store is scanned, no part of the manifest."""

    @property
    def driven_m(self) -> float:
        """Driven distance [m]."""
        return math.fsum(self.distance_by_reason_m.values())

    @property
    def kept_m(self) -> float:
        """Distance inside segments [m]."""
        return self.distance_by_reason_m.get(KEPT, 0.0)

    @property
    def wh_per_km(self) -> float | None:
        """Energy of the whole drive over its distance [Wh/km]; None without power, or of a robot that did not move."""
        return None if self.energy_joule is None or not self.driven_m else self.energy_joule / 3.6 / self.driven_m

    @property
    def verdict(self) -> Verdict:
        """The verdict on its findings by the catalogue of this version."""
        return judge(self.findings)

    def _repr_html_(self) -> str:
        """Return distance, energy and verdict as a table for notebooks."""
        energy, wh_per_km = self.energy_joule, self.wh_per_km
        rows = [
            ("robot", self.robot),
            ("segments", self.segments),
            ("driven", f"{self.driven_m:.0f} m, {self.kept_m:.0f} m of it in segments"),
            ("energy", "no power" if energy is None else f"{energy / 3600:.1f} Wh"),
            *([("energy per distance", f"{wh_per_km:.1f} Wh/km")] if wh_per_km is not None else []),
            *((name, getattr(self.verdict, name)) for name in AFFECTED),
        ]
        return format_html_table(f"Run {self.run_id}", rows)

    @property
    def is_empty(self) -> bool:
        """Whether there is no segment although the robot drove."""
        return bool(select_findings(self.findings, "no-segments"))

    @property
    def defect(self) -> Literal["damaged", "empty", ""]:
        """The defect of the run in one word."""
        return "damaged" if self.damage else "empty" if self.is_empty else ""


def find_problems(row: RunFacts) -> tuple[Problem, ...]:
    """Return the problems of a run: damage of its log, or missing segments."""
    log = row.log
    return tuple(Problem(finding, log.sha256, log.paths, row.run_id) for finding in select_problems(row.findings))


@dataclass(frozen=True, slots=True, kw_only=True)
class Run(RunFacts):
    """All facts of a run: the manifest. ``info`` of a record that was read includes the findings."""

    recipe: IngestSections
    counts: Counts
    info: TrackInfo
    topics: tuple[TopicCount, ...] = ()
    notes: Findings = ()
    """On the log."""


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """Metadata of the Parquet file of a role; ``key`` identifies the settings of reading with which it was written."""

    key: str
    robot: str
    gnss_crs: str
    power_averaged: bool
    report: StageReport[StageFacts]
    sensor: Sensor
    data_model_version: str = TABLES_VERSION


def strip_repeated(run: Run) -> Run:
    """Return a run as it is stored: each finding once, without facts of other documents."""
    report = replace(run.info.report, findings=())
    return replace(run, info=replace(run.info, report=report), tags={}, superseded_by=None)


def format_html_table(title: str, rows: Iterable[Sequence[str | float]], header: Sequence[str] = ()) -> str:
    """Return a table of texts and numbers as HTML, as notebooks show results; each text is escaped."""
    lines = [f"<caption><b>{escape(clean_line(title))}</b></caption>"]
    for tag, row in (*([("th", header)] if header else []), *(("td", row) for row in rows)):
        cells = (f"<{tag} style='text-align:left'>{escape(clean_line(str(cell)))}</{tag}>" for cell in row)
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f"<table>{''.join(lines)}</table>"


def restore_repeated(run: Run, facts: RunFacts) -> Run:
    """Return a run that was read with its findings in ``info``, and with tags and supersession of its facts."""
    report = replace(run.info.report, findings=run.findings)
    return replace(run, info=replace(run.info, report=report), tags=facts.tags, superseded_by=facts.superseded_by)


def list_physics_terms(label: LabelFacts | None) -> dict[str, tuple[float, float]]:
    """Return value and standard deviation of each term of the fit of power, by its name in `RunFacts.physics`."""
    fit: PhysicsFit | None = None if label is None else label.physics.fit
    terms = () if fit is None else fit.terms
    return {
        term.term if term.terrain == "all" else f"{term.term} on {term.terrain}": (term.value, term.std)
        for term in terms
    }
