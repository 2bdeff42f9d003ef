"""The JSON documents of a run: run.json on its log, and manifest.json on what became of it under a recipe.

A key with a default may be missing: documents of data model 1.0 have been written without it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from tcpipe.formats.integrity import Checksum
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.recipe import IngestSections
from tcpipe.tables.facts import NOTHING_FOUND, StageFacts
from tcpipe.tables.findings import LEFT_OUT, StageReport
from tcpipe.tables.levels import TABLES_VERSION, Sensor, TrackInfo
from tcpipe.tables.verdicts import Verdict


@dataclass(frozen=True, slots=True)
class LogOrigin:
    """Where a run's log lay when it was ingested, and its content."""

    paths: tuple[str, ...]
    sha256: str
    size_bytes: int = 0
    sha256_of: Literal["log", "index"] = "log"
    """What is hashed: of a log in object storage, of which only a part was fetched, sizes and indexes of its files (ADR-30)."""


@dataclass(frozen=True, slots=True)
class TopicCount:
    """A topic of a log."""

    name: str
    type: str
    messages: int | None


@dataclass(frozen=True, slots=True)
class RunJson:
    """The log and how it was read."""

    source: LogOrigin
    robot: str | None = None
    tags: Mapping[str, str] = field(default_factory=dict)
    topics: tuple[TopicCount, ...] = ()
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    damage: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    message_definitions: str = ""
    """Hash of the definitions that were given for types which the log does not define; "" without."""
    report: StageReport[StageFacts] = NOTHING_FOUND
    streams: Mapping[str, Checksum] = field(default_factory=dict)
    """The tables of what was read, by their name beside this document."""
    streams_key: str = ""
    """Names the read settings that they were made with."""
    outline: str = field(default="", metadata=LEFT_OUT)
    """Hash of the log's size and index, by which it is known where not all of it is at hand (ADR-30); "" where it has none."""


def tell_the_same(one: RunJson, other: RunJson) -> bool:
    """Tell whether two documents say the same of a log; what was computed may differ in the last bit on another processor, tags later."""
    bare = RunJson(one.source).report
    return replace(one, streams={}, report=bare, tags={}) == replace(other, streams={}, report=bare, tags={})


@dataclass(frozen=True, slots=True)
class Tags:
    """A run's tags, where they were changed since it was ingested."""

    tags: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class MapDocument:
    """A map: where it lies, and its files; all names begin in the store's folder of maps."""

    data_model_version: str
    zarr: str
    picture: str
    checksums: Mapping[str, Checksum]


@dataclass(frozen=True, slots=True)
class StoreDocument:
    """That a place is a store, and of which layout."""

    data_model_version: str


@dataclass(frozen=True, slots=True)
class Counts:
    """How many segments, rows and refused measurements a run has, and messages."""

    segments: int
    track_rows: int | None = field(default=None, metadata=LEFT_OUT)
    rejections: int | None = field(default=None, metadata=LEFT_OUT)
    messages: Mapping[str, int] = field(default_factory=dict)
    """By role."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ingestion:
    """A run under one recipe: what its manifest, the log of the store and `tcpipe inspect` hold of it."""

    run_id: str
    recipe_id: str
    data_model_version: str
    tcpipe_version: str
    ingest_key: str
    """Hash of the recipe's sections that rule its files."""
    robot: str
    robot_requested: str | None = None
    message_definitions: str = ""
    tags: Mapping[str, str]
    ledger_m: Mapping[str, float]
    """Where every metre went [m], by entry."""
    damage: tuple[str, ...]

    @property
    def driven_m(self) -> float:
        """How far it drove [m]."""
        return math.fsum(self.ledger_m.values())

    @property
    def kept_m(self) -> float:
        """How much of that is in segments [m]."""
        return self.ledger_m.get(KEPT, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest(Ingestion):
    """What became of a run under a recipe; ``info.report`` has the findings of every stage."""

    recipe: IngestSections
    counts: Counts
    verdict: Verdict
    info: TrackInfo
    checksums: Mapping[str, Checksum] = field(default_factory=dict)
    """The tables, by their name beside this document."""


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """What stands in the metadata of a role's Parquet file; ``key`` names the read settings it was made with."""

    key: str
    robot: str
    gnss_crs: str
    power_averaged: bool
    report: StageReport[StageFacts]
    sensor: Sensor
    data_model_version: str = TABLES_VERSION
