"""Calls that have begun: a commit when one begins and one when it ends, so that one that was killed is known."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Literal

from tcpipe import __version__
from tcpipe.errors import StoreError
from tcpipe.formats.commits import Begun, Entries, Kind, Problem, State
from tcpipe.formats.json_files import convert_record, digest
from tcpipe.pipeline.log_writer import LogWriter, is_alive
from tcpipe.tables.findings import Remedy, Subject, make_finding

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


@contextmanager
def commit_call(log: LogWriter, command: str, works_on: Sequence[str], *, options: object = None) -> Iterator[OpenCall]:
    """Commit that a call begins, and in the end that it ended; one that is killed, or ended by a signal, has no end.

    When it ends well, calls that were to do the same, and do not run, end with it. A store that cannot be written goes without.

    Parameters
    ----------
    log : writes into the log of the store.
    command : ``ingest`` or ``build-dataset``.
    works_on : logs and folders, or the dataset, in full.
    options : what else distinguishes its work from that of another call.
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
    _end(log, opened.kind, replace(opened.end, ended=(*begun, *done)))


def _end(log: LogWriter, kind: Kind, entries: Entries) -> None:
    try:
        log.commit(kind, entries)
    except StoreError as error:
        logger.warning("%s: so the store does not know how this call ended", error.problems[0])


def make_call(command: str, works_on: Sequence[str], options: object = None) -> Begun:
    """Return what a commit has of a call that begins."""
    return Begun(command, __version__, tuple(works_on), digest(options)[:_DIGITS])


def find_settled_calls(state: State, call: Begun) -> list[int]:
    """Return the numbers of the calls that do not run and whose work another call does."""
    return [of.number for of in list_begun_calls(state) if of.state != "running" and _is_done_by(of, call)]


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
