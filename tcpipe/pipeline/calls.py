"""Calls: writing their commits (process, time), which calls have begun or were killed, what calls took, and estimates from that."""

from __future__ import annotations

import logging
import os
import resource
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from tcpipe import __version__
from tcpipe.errors import StoreError
from tcpipe.execution import read_cluster_cpu_s
from tcpipe.formats.commit_log import Stamp, refresh
from tcpipe.formats.commits import Begun, CallRecord, Entries, Kind, Problem, Process, State
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.json_files import convert_record, digest
from tcpipe.store import Store
from tcpipe.tables.findings import Remedy, Subject, make_finding


@dataclass(slots=True)
class LogWriter:
    """The commits of one call: ``state`` is what the log says after the last of them."""

    store: Store
    state: State

    def refresh(self) -> None:
        """Read what others have committed."""
        self.state = refresh(self.store.place, self.state)

    def commit(self, kind: Kind, entries: Entries | Callable[[State], Entries]) -> None:
        """Write a commit, unless it adds nothing; `StoreError` where it cannot be written."""
        make = entries if callable(entries) else lambda _: entries
        stamp = Stamp(identify_process(), datetime.now(UTC).isoformat(timespec="milliseconds"))
        self.state = self.store.commit(self.state, stamp, kind, make)


def open_log(store: Store) -> LogWriter:
    """Return what writes into the log of a store, from what it says now on."""
    return LogWriter(store, store.state())


def is_committed(row: RunFacts, state: State) -> bool:
    """Return whether the log has an ingestion as it lies in its directory."""
    known = state.runs.get((row.run_id, row.recipe_id))
    return known is not None and (known.files, known.tags) == (row.files, row.tags)


def identify_process() -> Process:
    """Return what distinguishes this process from any other; "" for what the system does not say (other than Linux)."""
    boot, machine = (_read_text(path) for path in ("/proc/sys/kernel/random/boot_id", "/etc/machine-id"))
    namespace = ""
    with suppress(OSError):
        namespace = os.readlink("/proc/self/ns/pid")  # noqa: PTH115  no path
    return Process(socket.gethostname(), machine, boot, namespace, os.getpid(), _read_start_time(os.getpid()))


def is_alive(process: Process) -> bool | None:
    """Return whether a process lives; None where that cannot be seen from here: another machine or container, another system."""
    here = identify_process()
    if (process.host, process.machine) != (here.host, here.machine) or not (process.boot and process.start):
        return None
    if process.boot != here.boot:  # of a machine without an identity only its name is known, which others may have
        return False if here.machine else None
    return _read_start_time(process.pid) == process.start if process.namespace == here.namespace else None


def _read_start_time(pid: int) -> str:
    """Return when a living process began, in ticks since the start of the machine (proc(5): stat); "" where there is none."""
    state, *more = _read_text(f"/proc/{pid}/stat").rpartition(")")[2].split() or [""]
    return "" if state in ("", "Z", "X", "x") else more[18]


def _read_text(path: str) -> str:
    with suppress(OSError):
        return Path(path).read_text().strip()
    return ""


logger = logging.getLogger("tcpipe")

_LONGEST_S = 86_400.0
"""After so long a call of a machine that cannot be asked from here counts as killed: calls are made every night."""
_DIGITS = 32


@dataclass(frozen=True, slots=True)
class BegunCall(Begun):
    """A call that has begun and not ended."""

    name: str = ""
    """By which it is acknowledged."""
    state: Literal["running", "perhaps running", "killed"] = "killed"
    """``perhaps`` where its process cannot be looked at from here."""

    def __str__(self) -> str:
        """Return it as one line."""
        at = f" on {self.process.host} (process {self.process.pid})" if self.process else ""
        return f"{self.command} of {self.begin[:19]} UTC{at}"

    @property
    def problem(self) -> Problem:
        """That it was killed, as far as that is known."""
        code = "call-killed" if self.process and is_alive(self.process) is False else "call-lost"
        names = {"command": self.command, "begin": self.begin[:19]}
        names |= {"host": self.process.host, "pid": str(self.process.pid)} if self.process else {}
        remedy = Remedy("acknowledge", command=f"tcpipe acknowledge {self.name}")
        return Problem(make_finding(code, Subject("call", self.name), names=names, remedies=[remedy]), self.name)


@dataclass(slots=True)
class OpenCall:
    """A call that runs: what its last commit adds, and of which kind that is."""

    end: Entries = field(default_factory=Entries)
    kind: Kind = "ended"
    is_whole: bool = True
    """Whether all of its work is done, so that calls that were to do the same end with it."""


@contextmanager
def commit_call(log: LogWriter, command: str, works_on: Sequence[str], *, options: object = None) -> Iterator[OpenCall]:
    """Commit that a call begins, and in the end that it ended; one that is killed, or ended by a signal, has no end.

    When it ends well, calls that were to do the same, and do not run, end with it. A store that cannot be written goes without.

    ``works_on`` are logs and folders, or the dataset, in full; ``options`` what else distinguishes its work from that of another call.
    """
    call, opened, begun = make_call(command, works_on, options), OpenCall(), list[int]()
    done = find_settled_calls(log.state, call)
    try:
        log.commit("begun", Entries(begun=(call,)))
        begun = [log.state.number]
    except StoreError as error:
        logger.info("%s", error)
    try:
        yield opened
    except Exception:
        _end(log, "ended", Entries(ended=tuple(begun)))
        raise
    _end(log, opened.kind, replace(opened.end, ended=(*begun, *(done if opened.is_whole else ()))))


def _end(log: LogWriter, kind: Kind, entries: Entries) -> None:
    try:
        log.commit(kind, entries)
    except StoreError as error:
        logger.warning("%s: so the store has no record of how this call ended", error.problems[0])


def make_call(command: str, works_on: Sequence[str], options: object = None) -> Begun:
    """Return what a commit has of a call that begins."""
    return Begun(command, __version__, tuple(works_on), digest(options)[:_DIGITS])


def find_settled_calls(state: State, call: Begun) -> list[int]:
    """Return the numbers of the calls that do not run and whose work another call does."""
    return [begun.number for begun in list_begun_calls(state) if begun.state != "running" and _is_done_by(begun, call)]


def _is_done_by(call: Begun, other: Begun) -> bool:
    """Return whether another call does all that this one was to do."""
    same = (call.command, call.options) == (other.command, other.options)
    return same and all(is_below(entry, other.works_on) for entry in call.works_on)


def is_below(entry: str, folders: Sequence[str]) -> bool:
    """Return whether a path or URL is one of those given, or lies below one."""
    return any(entry == folder or entry.startswith(f"{folder.rstrip('/')}/") for folder in folders)


def list_begun_calls(state: State) -> list[BegunCall]:
    """Return the calls that have begun and not ended, by when they began."""
    return [
        convert_record(call, BegunCall, name=f"call-{number}", state=_find_state(call))
        for number, call in sorted(state.begun.items())
    ]


def _find_state(call: Begun) -> Literal["running", "perhaps running", "killed"]:
    alive = None if call.process is None else is_alive(call.process)
    if alive is not None:
        return "running" if alive else "killed"
    age_s = time.time() - datetime.fromisoformat(call.begin).timestamp()
    return "perhaps running" if abs(age_s) < _LONGEST_S else "killed"  # abs: a clock that is far ahead


INGEST, BUILD = "ingest", "build-dataset"


@dataclass(frozen=True, slots=True)
class Rates:
    """What work takes: CPU seconds and bytes written, for a byte of log or for a sample; and CPU seconds of a call, whatever it does."""

    cpu_s: float
    written_bytes: float
    call_s: float


MEASURED = {INGEST: Rates(0.2e-6, 1.1, 0.7), BUILD: Rates(180e-6, 4_300.0, 1.5)}
"""Of drives without a camera, on one core of 2025, and of patches of three layers and 40 px (docs/how-to/nights.md)."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """What is to be expected: work, time and room."""

    of: str
    amount: int
    """Bytes of log, or samples."""
    wall_s: float
    written_bytes: int
    source: str
    """What it was taken from."""

    def __str__(self) -> str:
        """Return it as one line."""
        amount = format_bytes(self.amount) if self.of == "logs" else f"{self.amount} {self.of}"
        return f"{amount}: about {format_duration(self.wall_s)} and {format_bytes(self.written_bytes)} ({self.source})"


def start_stopwatch() -> Callable[[CallRecord], CallRecord]:
    """Return what adds to a call when it began, which is now, and what it took until then."""
    begin, running_s, cpu_s = datetime.now(UTC), time.monotonic(), _read_cpu_s()
    return lambda call: replace(
        call,
        begin=begin.isoformat(timespec="milliseconds"),
        wall_s=round(time.monotonic() - running_s, 3),
        cpu_s=round(_read_cpu_s() - cpu_s, 3),
    )


def estimate(calls: Sequence[CallRecord], command: str, amount: int, *, jobs: int) -> Estimate:
    """Return what work will take: by the calls that did the like, or by what was measured elsewhere.

    What was measured counts as one more call, of as much work as takes as long as a call alone: few samples tell little of a million.
    """
    like = [call for call in calls if call.command == command and _parse_amount(call)]
    unit = "logs" if command == INGEST else "samples"
    rates, source = MEASURED[command], "from default figures: this store has no earlier calls"
    if like:
        done, alone = sum(_parse_amount(call) for call in like), rates.call_s / rates.cpu_s
        more_s = sum(max(0.0, call.cpu_s - rates.call_s) for call in like)
        written = sum(call.written_bytes for call in like) + rates.written_bytes * alone
        rates = Rates((more_s + rates.call_s) / (done + alone), written / (done + alone), rates.call_s)
        source = f"by {len(like)} earlier call{'s' * (len(like) > 1)}"
    return Estimate(unit, amount, rates.call_s + rates.cpu_s * amount / jobs, int(rates.written_bytes * amount), source)


def stored_bytes(store: Store, run_ids: Sequence[str]) -> int:
    """Return what runs take in the store [byte]."""
    return sum(entry.size_bytes for run_id in run_ids for entry in store.runs_place.entries(run_id))


def format_duration(seconds: float) -> str:
    """Return a duration in words."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def format_bytes(count: float) -> str:
    """Return a size in words."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} B"


def _parse_amount(call: CallRecord) -> int:
    return call.done_bytes if call.command == INGEST else call.counts.get("samples", 0)


def _read_cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used) + read_cluster_cpu_s()
