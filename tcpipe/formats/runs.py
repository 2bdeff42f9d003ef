"""The record of one run: its JSON is the manifest, and what is asked of all runs at once is a part of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from tcpipe.formats.integrity import Checksum
from tcpipe.formats.store_records import Problem
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.recipe import IngestSections
from tcpipe.tables.facts import LEFT_OUT, NOTHING_FOUND, EnergyBudget, LabelFacts, PhysicsFit, StageFacts
from tcpipe.tables.findings import Finding, StageReport, Verdict, judge, select_findings, select_problems
from tcpipe.tables.levels import TABLES_VERSION, Sensor, TrackInfo


@dataclass(frozen=True, slots=True)
class LogOrigin:
    """Where the log of a run lay when it was ingested, and what identifies its content."""

    paths: tuple[str, ...]
    sha256: str
    size_bytes: int = 0
    sha256_of: Literal["log", "index"] = "log"
    """Data that was hashed: the whole log, or, if only part of it was downloaded, the sizes and indexes of its files."""
    outline: str = field(default="", metadata=LEFT_OUT)
    """Hash of the size and index of the log, by which it is known where not all of it is at hand; "" where it has none."""
    parts: tuple[Checksum, ...] = field(default=(), metadata=LEFT_OUT)
    """Size and sha256 of each log, in order, where several were ingested as one."""


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
    track_rows: int | None = field(default=None, metadata=LEFT_OUT)
    rejections: int | None = field(default=None, metadata=LEFT_OUT)
    messages: Mapping[str, int] = field(default_factory=dict)
    """By role."""


@dataclass(frozen=True, slots=True)
class Recording:
    """When a log was recorded, and what identifies its beginning: a longer log with the same beginning supersedes it."""

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
    """The facts of a run that are asked of all runs of a store at once; the index of a store holds them."""

    run_id: str
    recipe_id: str
    data_model_version: str
    results_version: int
    tcpipe_version: str
    ingest_key: str
    """Hash of the sections of the recipe that decide its tables."""
    read_key: str
    """Hash of what decides its streams."""
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
    findings: tuple[Finding, ...]
    """Findings of all stages."""
    damage: tuple[Finding, ...] = ()
    """Findings about damage to the log."""
    energy_budget: EnergyBudget | None = None
    idle_watt: float | None = None
    physics: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Terms of the fit of power with their standard deviations, in SI, by ``term`` or, for one terrain class, ``term on terrain``."""
    blob: str
    """Folder of its tables; "" of a run whose tables were pruned."""
    tables: Mapping[str, Checksum]
    """``track.parquet``, ``segments.parquet`` and ``rejections.parquet`` in that folder."""
    streams_blob: str
    """Folder of its streams: its own, or that of a run of the same log with the same streams."""
    streams: Mapping[str, Checksum]
    """``streams/<role>.parquet`` in that folder."""
    tags: Mapping[str, str] = field(default_factory=dict, metadata=LEFT_OUT)
    """Tags of its log, read from the records of tags; not written to the manifest."""
    superseded_by: str | None = field(default=None, metadata=LEFT_OUT)
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
    def verdict(self) -> Verdict:
        """The verdict on its findings by the catalogue of this version."""
        return judge(self.findings)

    @property
    def is_empty(self) -> bool:
        """Whether there is no segment although the robot drove."""
        return bool(select_findings(self.findings, "no-segments"))

    @property
    def defect(self) -> Literal["damaged", "empty", ""]:
        """The defect of the run in one word."""
        return "damaged" if self.damage else "empty" if self.is_empty else ""


def find_problems(row: RunFacts) -> tuple[Problem, ...]:
    """Return what is wrong with a run: damage of its log, or that it has no segments."""
    log = row.log
    return tuple(Problem(finding, log.sha256, log.paths, row.run_id) for finding in select_problems(row.findings))


@dataclass(frozen=True, slots=True, kw_only=True)
class Run(RunFacts):
    """All that is known of a run: the manifest. ``info`` of a record that was read has the findings again."""

    recipe: IngestSections
    counts: Counts
    info: TrackInfo
    topics: tuple[TopicCount, ...] = ()
    notes: tuple[Finding, ...] = ()
    """On the log."""
    read_report: StageReport[StageFacts] = NOTHING_FOUND
    """Findings and facts of the stage that reads."""


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
    """Return a run as it is written: each finding once, without what other documents decide."""
    report = replace(run.info.report, findings=())
    return replace(run, info=replace(run.info, report=report), tags={}, superseded_by=None)


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
