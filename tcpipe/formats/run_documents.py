"""The JSON documents of a store: ``store.json``, and numbered ones on runs, their tags and maps.

A numbered document ``<stem>-<n>.json`` never changes, and the highest number holds (ADR-28). A writer first puts the files that the
document names, each under a name that follows from its content, then the document under the next free number: a reader sees a complete
document or the one before, and of two writers one learns that it came second. A key with a default may be missing.
"""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar

from tcpipe.errors import StoreError
from tcpipe.formats.integrity import Checksum, find_broken_seal, seal_document, verify_document
from tcpipe.formats.json_files import Json, digest, parse_typed, parse_typed_json, to_json
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import Place
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.recipe import IngestSections
from tcpipe.tables.facts import LEFT_OUT, NOTHING_FOUND, StageFacts
from tcpipe.tables.findings import Finding, StageReport, Verdict
from tcpipe.tables.levels import DATA_MODEL_VERSION, TABLES_VERSION, Sensor, TrackInfo


@dataclass(frozen=True, slots=True)
class LogOrigin:
    """Where a run's log lay when it was ingested, and its content."""

    paths: tuple[str, ...]
    sha256: str
    size_bytes: int = 0
    sha256_of: Literal["log", "index"] = "log"
    """Hashed content: of a log in object storage, of which only a part was fetched, sizes and indexes of its files (ADR-30)."""


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
    damage: tuple[Finding, ...] = ()
    notes: tuple[Finding, ...] = ()
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
    distance_by_reason_m: Mapping[str, float]
    """Distance breakdown [m], by entry."""
    damage: tuple[Finding, ...]

    @property
    def driven_m(self) -> float:
        """How far it drove [m]."""
        return math.fsum(self.distance_by_reason_m.values())

    @property
    def kept_m(self) -> float:
        """How much of that is in segments [m]."""
        return self.distance_by_reason_m.get(KEPT, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest(Ingestion):
    """Result of a run under a recipe; ``info.report`` has the findings of every stage."""

    recipe: IngestSections
    counts: Counts
    verdict: Verdict
    info: TrackInfo
    checksums: Mapping[str, Checksum] = field(default_factory=dict)
    """The tables, by their name beside this document."""


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """Metadata of a role's Parquet file; ``key`` names the read settings with which it was written."""

    key: str
    robot: str
    gnss_crs: str
    power_averaged: bool
    report: StageReport[StageFacts]
    sensor: Sensor
    data_model_version: str = TABLES_VERSION


T = TypeVar("T")

_NUMBERED = re.compile(r"(.+)-([1-9]\d*)\.json")
_DIGEST_HEX = 16


def name_document(stem: str, number: int) -> str:
    """Return the name of a document."""
    return f"{stem}-{number}.json"


def split_number(name: str) -> tuple[str, int] | None:
    """Return what a document's name says; None for any other name."""
    found = _NUMBERED.fullmatch(name)
    return (found[1], int(found[2])) if found else None


def find_highest_numbers(names: Iterable[str]) -> dict[str, int]:
    """Return, by stem, the highest number among names."""
    found: dict[str, int] = {}
    documents = (split_number(name) for name in names if name.endswith(".json"))
    for stem, number in filter(None, documents):
        found[stem] = max(number, found.get(stem, 0))
    return found


def read_sealed_at(
    place: Place, name: str, *, ours: Callable[[Mapping[str, Json]], bool] = lambda _: True
) -> dict[str, Json]:
    """Read and prove a sealed document; `StoreError` where it is gone, or not as it was written."""
    data = place.read(name)
    if data is None:
        raise StoreError(f"{place.where(name)}: is missing")
    return verify_document(data, place.where(name), ours=ours)


def read_as_at(place: Place, name: str, cls: type[T]) -> T:
    """Read and prove a sealed document as a dataclass; `StoreError` as `read_sealed_at`."""
    return parse_typed(read_sealed_at(place, name), cls, place.where(name))


def put_next(place: Place, stem: str, value: T, *, after: int, settled: Callable[[T], bool] = lambda _: False) -> T:
    """Write a document under the first free number from ``after`` + 1 on, and return it.

    The one of number ``after`` is returned instead if it has the same bytes, and so is one that others put there meanwhile if it is
    ``settled``: what this call would write. One that is not as it was written is passed over.
    """
    data = to_json(seal_document(value)).encode()
    number = max(after, 1)
    while True:
        name = name_document(stem, number)
        if number > after and place.put_new(name, data):
            return value
        try:
            found = read_as_at(place, name, type(value))
        except StoreError:
            found = None
        if found is not None and (place.read(name) == data or (number > after and settled(found))):
            return found
        number += 1


def name_folder(checksums: Mapping[str, Checksum]) -> str:
    """Return the name of a directory with these files."""
    return digest(dict(checksums))[:_DIGEST_HEX]


MARK = "store.json"
"""Is written first where a store is new."""
COPY_MARK = f"copy it from any store of data model {DATA_MODEL_VERSION}: it is the same in all of them"


def is_unmarked_store(place: Place) -> bool:
    """Return whether runs or maps are here, but not the mark of a store."""
    if place.size(MARK) is not None:
        return False
    return any(name.endswith(".zarr") for name in place.folders("maps")) or any(
        name.startswith("run") and name.endswith(".json")
        for run_id in place.folders("runs")[:10]
        for name in place.files(f"runs/{run_id}")
    )


def read_layout(place: Place) -> str | None:
    """Return the data model of a store, None without a store; `StoreError` if its mark has changed."""
    where, data = place.where(MARK), place.read(MARK)
    if broken := data is not None and find_broken_seal(data, where):
        raise StoreError(f"{broken}; {COPY_MARK}")
    return None if data is None else parse_typed_json(data, StoreDocument, where).data_model_version


def mark_store(place: Place, *, found: bool = False) -> None:
    """Make a place a store; `StoreError` where it cannot be written, or does not keep what is there from being overwritten."""
    data = to_json(seal_document(StoreDocument(DATA_MODEL_VERSION))).encode()
    try:
        new = place.put_new(MARK, data)
        keeps = not (new and (found or place.put_new(MARK, data)))
    except StoreError as error:
        raise StoreError(f"{error.problems[0]}; name another with --store") from None
    if not keeps:
        raise StoreError(
            f"{place.where()}: this object store overwrites what is there although asked not to (put-if-absent), so that two writers "
            "would mix; name another with --store"
        )


@contextmanager
def remove_if_empty(place: str | Path) -> Iterator[None]:
    """Remove what was made for a store on this machine when no run or map came into it, failures too."""
    if is_url(place):
        yield
        return
    store = Path(place)
    made = [path for path in (store, *store.absolute().parents) if not path.exists()]
    try:
        yield
    finally:
        if made and not any(path for pattern in ("runs/*", "maps/*-*.json") for path in store.glob(pattern)):
            for own in ("log", "index"):
                shutil.rmtree(store / own, ignore_errors=True)
            (store / MARK).unlink(missing_ok=True)
            for path in (store / "runs", store / "maps", *made):
                with suppress(OSError):
                    path.rmdir()
