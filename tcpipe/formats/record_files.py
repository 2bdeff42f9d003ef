"""Records: small sealed facts, each a JSON file that is written once, where there was none, and never changed (ADR 50).

One kind goes again: that a call has begun, when it ends.

The name of a record follows from the fact, so that the same fact is one file whoever writes it, and however often.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import TypeVar

from tcpipe.errors import StoreError
from tcpipe.formats.json_files import to_json, typed
from tcpipe.formats.place import Place
from tcpipe.formats.seals import proved, sealed

T = TypeVar("T")

logger = logging.getLogger("tcpipe")

_NAME_DIGITS = 32


@dataclass(frozen=True, slots=True)
class Sighting:
    """A log as it lay: its files, the size [byte] and modification time [ns] of each, and what they hold."""

    log: tuple[str, ...]
    size_and_time: tuple[tuple[int, int], ...]
    sha256: str


@dataclass(frozen=True, slots=True)
class Recording:
    """That the run of a log has an `outline`, by which the log is known where all of it is not at hand."""

    outline: str
    run_id: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Superseded:
    """That another run takes a run's place, or, by None, that the run counts again; of several the one of the highest number holds."""

    run_id: str
    by: str | None
    number: int


def in_force(records: Iterable[Superseded]) -> dict[str, str]:
    """Return the runs that are superseded, and by which run."""
    by_number = sorted(records, key=lambda record: (record.number, record.by is None))
    latest = {record.run_id: record.by for record in by_number}
    return {run_id: by for run_id, by in latest.items() if by is not None}


@dataclass(frozen=True, slots=True)
class Call:
    """What a call of ingest or build-dataset did and took; times are of the clock of where it ran."""

    command: str
    version: str
    exit_code: int
    counts: Mapping[str, int]
    """Logs by what became of them; or samples and runs."""
    jobs: int = 1
    begin: str = ""
    """UTC, ISO 8601."""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    """Of its process and its workers, also those of a cluster."""
    logs: tuple[str, ...] = ()
    """As they were given, in full."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """By log, why it failed for what may pass."""
    done_bytes: int = 0
    """Size of the logs that came in [byte]."""
    written_bytes: int = 0
    """What was written for them, or the size of the dataset [byte]."""

    @property
    def end(self) -> str:
        """When it ended, as ``begin``."""
        return (datetime.fromisoformat(self.begin) + timedelta(seconds=self.wall_s)).isoformat(timespec="milliseconds")


@dataclass(frozen=True, slots=True)
class Process:
    """What tells a process from any other; "" where the system does not tell."""

    host: str
    machine: str
    """Identity of the installed system (machine-id)."""
    boot: str
    """Identity of this start of the machine."""
    namespace: str
    """In which ``pid`` counts: that of a container is its own."""
    pid: int
    start: str
    """When it began, in ticks since the start of the machine."""


@dataclass(frozen=True, slots=True)
class Begun:
    """That a call of ingest or build-dataset has begun; the record goes when the call ends, alone of all records."""

    command: str
    version: str
    begin: str
    """UTC, ISO 8601, by the clock of where it runs."""
    process: Process
    works_on: tuple[str, ...]
    """Logs and folders, or the dataset, in full."""
    options: str
    """Hash of what else tells its work from that of another call."""


@dataclass(frozen=True, slots=True)
class DatasetMade:
    """Which ingestions a dataset is made of, and where it was written; nothing that it refers to is removed."""

    out: str
    inputs: str
    """The digest in its card."""
    runs: tuple[tuple[str, str], ...]
    """Runs and their recipes."""


@dataclass(frozen=True, slots=True)
class DatasetReplaced:
    """That a dataset was overwritten where it lay, by a build; one that was moved away before was not."""

    out: str
    inputs: str


@dataclass(frozen=True, slots=True)
class RunName:
    """What the run of a content is called; the first that names it is right."""

    sha256: str
    run_id: str


def record_name(digest: str) -> str:
    """Return the name of the record of a fact whose digest (hex) this is."""
    return digest[:_NAME_DIGITS]


def put_record(place: Place, name: str, value: object) -> bool:
    """Write a record, a dataclass, unless it is there already, whole; return whether this call did. `StoreError`: it cannot be written."""
    data = to_json(sealed(value)).encode()
    if place.put_new(f"{name}.json", data):
        return True
    if read_record(place, name, type(value)) is not None:
        return False
    place.put(f"{name}.json", data)
    return True


def read_record(place: Place, name: str, cls: type[T]) -> T | None:
    """Return a record; None where there is none, and where it is not as it was written, which is said."""
    data = place.read(f"{name}.json")
    return None if data is None else _whole(data, place.where(f"{name}.json"), cls)


def read_records(place: Place, kind: str, cls: type[T]) -> Iterator[T]:
    """Yield the records of a kind, by name; those that are not as they were written are named and left out."""
    for name in place.files(kind):
        if name.endswith(".json") and (found := read_record(place, f"{kind}/{name.removesuffix('.json')}", cls)):
            yield found


def _whole(data: bytes, where: str, cls: type[T]) -> T | None:
    try:
        return typed(proved(data, where), cls, where)
    except StoreError as error:
        logger.error("%s; this record is ignored", error)  # noqa: TRY400  one line
        return None
