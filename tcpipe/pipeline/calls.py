"""Calls on a store: the record of each call, open and killed calls, durations of calls, and estimates from these."""

import os
import resource
import secrets
import socket
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from tcpipe import __version__
from tcpipe.errors import StoreError, TcpipeError
from tcpipe.execution import read_cluster_cpu_s
from tcpipe.formats.documents import State, parse_name
from tcpipe.formats.json_files import to_plain
from tcpipe.formats.runs import Call, Problem, Process
from tcpipe.progress import logger
from tcpipe.store import Store, is_store
from tcpipe.tables.findings import Remedy, Subject, make_finding


def identify_process() -> Process:
    """Return the identity of this process; parts that the system does not provide (other than Linux) are ""."""
    boot, machine = (_read_text(path) for path in ("/proc/sys/kernel/random/boot_id", "/etc/machine-id"))
    namespace = ""
    with suppress(OSError):
        namespace = os.readlink("/proc/self/ns/pid")  # noqa: PTH115  no path
    return Process(socket.gethostname(), machine, boot, namespace, os.getpid(), _read_start_time(os.getpid()))


def is_alive(process: Process) -> bool | None:
    """Return whether a process exists; None if it cannot be seen: another machine, container or system."""
    here = identify_process()
    if (process.host, process.machine) != (here.host, here.machine) or not (process.boot and process.start):
        return None
    if process.boot != here.boot:  # machines without an identity may share a name
        return False if here.machine else None
    return _read_start_time(process.pid) == process.start if process.namespace == here.namespace else None


def _read_start_time(pid: int) -> str:
    """Return the start of a process in ticks since boot (proc(5): stat); "" without such a process."""
    state, *more = _read_text(f"/proc/{pid}/stat").rpartition(")")[2].split() or [""]
    return "" if state in ("", "Z", "X", "x") else more[18]


def _read_text(path: str) -> str:
    with suppress(OSError):
        return Path(path).read_text().strip()
    return ""


@dataclass(frozen=True, slots=True)
class OpenCall:
    """A call that has begun and not ended."""

    name: str
    """Name by which a person acknowledges it."""
    state: Literal["running", "perhaps running", "killed"]
    """``perhaps running`` if its process cannot be observed from here."""
    call: Call

    @property
    def key(self) -> str:
        """Key of its documents."""
        return self.name.removeprefix(CALL_PREFIX)

    def __str__(self) -> str:
        """Return it as one line."""
        process = self.call.process
        at = f" on {process.host} (process {process.pid})" if process else ""
        return f"{self.call.command} of {self.call.begin[:19]} UTC{at}"

    @property
    def problem(self) -> Problem:
        """The problem that it was killed, or that it may have been."""
        process = self.call.process
        code = "call-killed" if process and is_alive(process) is False else "call-lost"
        names = {"command": self.call.command, "begin": self.call.begin[:19]}
        names |= {"host": process.host, "pid": str(process.pid)} if process else {}
        remedy = Remedy("acknowledge", command=f"tcpipe acknowledge {self.name}")
        return Problem(make_finding(code, Subject("call", self.name), names=names, remedies=[remedy]), self.name)


# Age from which a call on a machine that cannot be observed is reported as lost [s]; calls are made every night.
_LONGEST_S = 86_400.0
CALL_PREFIX = "call-"


def list_open_calls(state: State) -> list[OpenCall]:
    """Return the calls that have begun and not ended, the earliest first."""
    return [
        OpenCall(f"{CALL_PREFIX}{key}", _find_state(call), call)
        for key, call in reversed(state.calls)
        if call.exit_code is None
    ]


def _find_state(call: Call) -> Literal["running", "perhaps running", "killed"]:
    alive = None if call.process is None else is_alive(call.process)
    if alive is not None:
        return "running" if alive else "killed"
    age_s = time.time() - datetime.fromisoformat(call.begin).timestamp()
    return "perhaps running" if abs(age_s) < _LONGEST_S else "killed"  # abs: a clock that is far ahead


@dataclass(slots=True)
class RunningCall:
    """A running call: its record, and the state of the store when it began, with all that it has written since."""

    store: Store
    state: State
    key: str
    call: Call
    begun: bool = False
    """Whether its first document is written: in a new store only when there is something to write."""
    is_whole: bool = True
    """Whether all of its work is done, so that killed calls that were to do the same are closed."""
    result: dict[str, Any] = field(default_factory=dict)
    """Values of its record when it ends: exit code, counts and such."""
    error: StoreError | None = None
    """Why its record could not be written: the store cannot be written to."""

    def begin(self) -> None:
        """Write the first document of the call, unless it is written."""
        if not self.begun:
            self.begun = True
            self.put(self.call)

    def put(self, call: Call) -> None:
        """Write the record of the call; a read-only store gets no record."""
        try:
            self.store.put(self.state, "calls", self.key, call)
        except StoreError as error:
            self.error = error
            logger.debug("%s", error)


@contextmanager
def record_call(
    store: Store, command: str, works_on: Iterable[str], options: object = None, *, jobs: int = 1
) -> Iterator[RunningCall]:
    """Record the begin of a call before the store is scanned, and its end; a killed or interrupted call has no end.

    A call that succeeds also closes killed calls with the same work. ``works_on`` are the full paths of logs and
    folders, or of the output; calls with other ``options`` do other work.
    """
    begin_s, cpu_s = time.monotonic(), _read_cpu_s()
    names = [name for file in store.place.list("calls") if (name := parse_name("calls", file)) is not None]
    number = 1 + max((int(name.key[:8], 16) for name in names), default=0)
    call = Call(
        command=command, version=__version__, works_on=tuple(works_on), options=to_plain(options or {}),
        process=identify_process(), begin=datetime.now(UTC).isoformat(timespec="milliseconds"), jobs=jobs,
    )  # fmt: skip
    running = RunningCall(store, State(), f"{number:08x}{secrets.token_hex(4)}", call)

    def end() -> None:
        took = {"wall_s": round(time.monotonic() - begin_s, 3), "cpu_s": round(_read_cpu_s() - cpu_s, 3)}
        if running.begun:
            running.put(replace(call, **{"exit_code": 0, **took, **running.result}))

    try:
        if is_store(store.root):
            running.begin()
        running.state = store.scan()
        yield running
    except Exception as error:
        running.result |= describe_error(error)
        end()
        raise
    end()
    if running.is_whole:
        _close_killed_calls(running)


def describe_error(error: Exception) -> dict[str, Any]:
    """Return the exit code and the message of a call that ended by an error, as its record has them."""
    lines = error.problems if isinstance(error, TcpipeError) else (f"{type(error).__name__}: {error}",)
    return {"exit_code": getattr(error, "exit_code", 1), "message": "\n".join(lines)}


def _close_killed_calls(running: RunningCall) -> None:
    """Write the end of killed calls whose work this call has done.

    A call counts as killed only if a listing made after its process was found dead shows no end of it.
    """
    killed_calls = [open_call for open_call in list_open_calls(running.state) if open_call.state == "killed"]
    for killed in killed_calls:
        if killed.key == running.key or not _is_done_by(killed.call, running.call):
            continue
        close_call(running.store, running.state, killed, f"its work was done by {CALL_PREFIX}{running.key}")


def close_call(store: Store, state: State, killed: OpenCall, message: str) -> None:
    """Write the end of a killed call, unless it has written it itself meanwhile."""
    key = killed.key
    ends = [
        file for file in store.place.list("calls") if file.startswith(f"{key}.") and not file.startswith(f"{key}.1.")
    ]
    if not any(f"calls/{file}" not in state.damaged for file in ends):
        with suppress(StoreError):
            store.put(state, "calls", key, replace(killed.call, exit_code=1, message=message))


def _is_done_by(call: Call, other: Call) -> bool:
    """Return whether another call does all that this one was to do."""
    same = (call.command, call.options) == (other.command, other.options)
    return same and all(
        any(entry == folder or entry.startswith(f"{folder.rstrip('/')}/") for folder in other.works_on)
        for entry in call.works_on
    )


INGEST, BUILD, ADD_MAP, PRUNE, ACKNOWLEDGE = "ingest", "build-dataset", "add-map", "prune", "acknowledge"


def format_duration(seconds: float) -> str:
    """Return a duration as text."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def format_bytes(count: float) -> str:
    """Return a size as text."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} B"


def _read_cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used) + read_cluster_cpu_s()
