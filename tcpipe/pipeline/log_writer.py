"""Writing into the log of a store: each commit with the process that wrote it and the time."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from tcpipe.formats.commit_log import Stamp
from tcpipe.formats.commits import Entries, Kind, Process, State
from tcpipe.formats.index_files import RunFacts
from tcpipe.store import Store


@dataclass(slots=True)
class LogWriter:
    """The commits of one call: ``state`` is what the log says after the last of them."""

    store: Store
    state: State

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
