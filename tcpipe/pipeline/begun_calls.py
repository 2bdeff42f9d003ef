"""Calls that have begun: a record each while they run, so that one that was killed is known by what it left."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from tcpipe import __version__
from tcpipe.errors import StoreError
from tcpipe.formats.json_files import digest, recast
from tcpipe.formats.record_files import Begun, Process, record_name
from tcpipe.store import Store

_LONGEST_S = 86_400.0
"""After so long a call of a machine that cannot be asked from here counts as killed: calls are made every night."""

_BEGUN = "records/begun"


@dataclass(frozen=True, slots=True)
class BegunCall(Begun):
    """A call that has begun and not ended."""

    name: str = ""
    """Of its record."""
    state: Literal["running", "perhaps running", "killed"] = "killed"
    """``perhaps`` where its process cannot be looked at from here."""

    def __str__(self) -> str:
        """Return it as one line."""
        return f"{self.command} of {self.begin[:19]} UTC on {self.process.host} (process {self.process.pid})"

    @property
    def problem(self) -> str:
        """The line that says it was killed, as far as that is known, and what to do."""
        known = is_alive(self.process) is False
        how = (
            "was killed"
            if known
            else f"has not ended since; whether it still runs on {self.process.host} is not known here"
        )
        return f"{self}: {how}; run the same command again, or 'tcpipe accept {self.name}'"

    def is_done_by(self, other: Begun) -> bool:
        """Tell whether another call does all that this one was to do."""
        same = (self.command, self.options) == (other.command, other.options)
        return same and all(is_below(entry, other.works_on) for entry in self.works_on)


def is_below(entry: str, folders: Sequence[str]) -> bool:
    """Tell whether a path or URL is one of those given, or lies below one."""
    return any(entry == folder or entry.startswith(f"{folder.rstrip('/')}/") for folder in folders)


@contextmanager
def begun_call(store: Store, command: str, works_on: Sequence[str], *, options: object = None) -> Iterator[None]:
    """Leave a record in the store until the call ends; one that is killed, or ended by a signal, leaves it for good.

    When it ends well, the records of calls that were to do the same, and do not run, go with its own. A store that cannot be written goes
    without.

    Parameters
    ----------
    store : where the record lies.
    command : ``ingest`` or ``build-dataset``.
    works_on : logs and folders, or the dataset, in full.
    options : what else tells its work from that of another call.
    """
    begin = datetime.now(UTC).isoformat(timespec="milliseconds")
    call = Begun(command, __version__, begin, this_process(), tuple(works_on), record_name(digest(options)))
    name = f"{begin[:19].replace('-', '').replace(':', '')}-{record_name(digest(call))}"
    done = [name]
    with suppress(StoreError):
        earlier = [of.name for of in begun_calls(store) if of.state != "running" and of.is_done_by(call)]
        store.remember(f"begun/{name}", call)
    try:
        yield
        done += earlier
    except BaseException as error:
        done = done if isinstance(error, Exception) else []
        raise
    finally:
        with suppress(StoreError):
            for ended in done:
                store.place.delete(f"{_BEGUN}/{ended}.json")


def begun_calls(store: Store) -> list[BegunCall]:
    """Return the calls that have begun and not ended, by when they began."""
    names = (name.removesuffix(".json") for name in store.place.files(_BEGUN) if name.endswith(".json"))
    found = ((name, store.recall(f"begun/{name}", Begun)) for name in names)
    return [recast(call, BegunCall, name=name, state=_find_state(call)) for name, call in found if call is not None]


def _find_state(call: Begun) -> Literal["running", "perhaps running", "killed"]:
    alive = is_alive(call.process)
    if alive is not None:
        return "running" if alive else "killed"
    age_s = time.time() - datetime.fromisoformat(call.begin).timestamp()
    return "perhaps running" if abs(age_s) < _LONGEST_S else "killed"  # abs: a clock that is far ahead


def this_process() -> Process:
    """Return what tells this process from any other, here and elsewhere; "" for what the system does not tell (other than Linux)."""
    boot, machine = (_text(path) for path in ("/proc/sys/kernel/random/boot_id", "/etc/machine-id"))
    namespace = ""
    with suppress(OSError):
        namespace = os.readlink("/proc/self/ns/pid")  # noqa: PTH115  no path
    return Process(socket.gethostname(), machine, boot, namespace, os.getpid(), _read_start_time(os.getpid()))


def is_alive(process: Process) -> bool | None:
    """Tell whether a process lives; None where that cannot be seen from here: another machine or container, another system."""
    here = this_process()
    if (process.host, process.machine) != (here.host, here.machine) or not (process.boot and process.start):
        return None
    if process.boot != here.boot:  # of a machine without an identity only its name is known, which others may have
        return False if here.machine else None
    return _read_start_time(process.pid) == process.start if process.namespace == here.namespace else None


def _read_start_time(pid: int) -> str:
    """Return when a living process began, in ticks since the start of the machine (proc(5): stat); "" where there is none."""
    state, *more = _text(f"/proc/{pid}/stat").rpartition(")")[2].split() or [""]
    return "" if state in ("", "Z", "X", "x") else more[18]


def _text(path: str) -> str:
    with suppress(OSError):
        return Path(path).read_text().strip()
    return ""
