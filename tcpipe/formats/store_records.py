"""The records of a store beside its runs: failures, tags, logs that were seen, problems, maps, outputs and calls."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import TypeAlias

from tcpipe.formats.integrity import Checksum
from tcpipe.tables.findings import LEFT_OUT, Finding, Subject

_UNFINISHED = ".active"
"""Ending of a ROS 1 bag that is being recorded, or was when its recorder died."""


Options: TypeAlias = Mapping[str, str | int | float | bool | list[str] | dict[str, str] | None]
"""Options of a call as JSON values."""


@dataclass(frozen=True, slots=True)
class LogSnapshot:
    """A log when it was seen: its files, the size [byte] and modification time [ns] of each, and the hash of its content."""

    log: tuple[str, ...]
    size_and_time: tuple[tuple[int, int], ...]
    sha256: str


@dataclass(frozen=True, slots=True)
class Failure:
    """A log that failed because of its content: the same call would fail again."""

    content: str
    """The sha256 of the log; where nothing could be read, a hash of its path, sizes and times."""
    log: tuple[str, ...]
    problems: tuple[str, ...]
    version: str
    """Version of tcpipe that failed."""
    findings: tuple[Finding, ...] = field(default=(), metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True)
class Problem:
    """A finding that causes exit code 3 until somebody acknowledges it."""

    finding: Finding
    content: str
    """The sha256 of the log, or what else identifies the subject: a problem of other content is a new one."""
    log: tuple[str, ...] = field(default=(), metadata=LEFT_OUT)
    run_id: str | None = field(default=None, metadata=LEFT_OUT)

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
    """The tags of a log, which hold under every recipe."""

    log: str
    """Its sha256."""
    tags: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class StoredMap:
    """A map: its folder, and size and sha256 of each file in it."""

    name: str
    data_model_version: str
    blob: str
    files: Mapping[str, Checksum]

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
    """Options of the last call, by which it can be planned again."""
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
    """A call of a command on a store; without an exit code it has not ended. Times are of the clock of where it ran."""

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
    """Logs by what became of them; or samples and runs."""
    jobs: int = 1
    wall_s: float = 0.0
    cpu_s: float = 0.0
    """CPU time of the process and its workers, including workers on a cluster [s]."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """By log, why it failed for a reason that may pass."""
    done_bytes: int = 0
    """Size of the logs that came in [byte]."""
    written_bytes: int = 0
    """Size of the runs that were written, or of the dataset [byte]."""

    @property
    def end(self) -> str:
        """When it ended, as ``begin``."""
        return (datetime.fromisoformat(self.begin) + timedelta(seconds=self.wall_s)).isoformat(timespec="milliseconds")


def find_lineage(log: tuple[str, ...]) -> str:
    """Return what identifies the place of a log; a recording that is finished (``.active`` goes) stays where it was."""
    return "\n".join(path.removesuffix(_UNFINISHED) for path in log)
