"""A log: commits as small sealed files that are put where there is none, and snapshots of the state (ADR-29, ADR-30).

::

    log/0000000017.json                the commit of that number, never changed
    log/snapshot-0000000064.json.zst   what all commits to that number say; may be removed at any time

Readers take the newest readable snapshot and the commits after it. A commit that is missing or damaged is a problem of the state.
"""

from __future__ import annotations

import gc
import hashlib
import logging
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeAlias

import pyarrow as pa

from tcpipe.errors import StoreError
from tcpipe.formats.commits import Commit, Entries, Kind, Problem, Process, State, compact_state, fold
from tcpipe.formats.integrity import SEAL, seal_document, verify_document
from tcpipe.formats.json_files import parse_json, parse_typed, parse_typed_json, to_compact_json, to_json
from tcpipe.formats.place import Place
from tcpipe.tables.findings import Finding, Subject, make_finding

logger = logging.getLogger("tcpipe")

LOG = "log"
COMMIT = re.compile(r"(\d{10})\.json")
SNAPSHOT = "snapshot-"
_EVERY, _EVERY_BYTES = 64, 4 << 20
"""After so many commits, or so many bytes of them, the next snapshot is written."""
_SEAL_BYTES = 64
"""The first line of a snapshot is the sha256 (hex) of the rest."""
_KEPT = 2
"""So many snapshots stay."""

ReadCommit: TypeAlias = tuple[Commit, str, int]


@dataclass(frozen=True, slots=True)
class Stamp:
    """Who commits, and when (UTC, ISO 8601)."""

    who: Process
    at: str


@dataclass(frozen=True, slots=True)
class _Snapshot:
    """A snapshot as it is written: a commit whose runs have no findings, and these apart, each once, as runs share most of them."""

    commit: Commit
    findings: tuple[Finding, ...]
    by_run: tuple[tuple[int, ...], ...]
    """Which of the findings each run has."""


def read_state(store: Place) -> State:
    """Return what the log of a store says: the newest readable snapshot, and the commits after it."""
    has_collector = gc.isenabled()
    gc.disable()  # the rows have no cycles: to search ten thousand of them again and again takes as long as to read them
    try:
        return refresh(store, _read_newest_snapshot(store.below(LOG)))
    finally:
        if has_collector:
            gc.enable()


def _read_newest_snapshot(log: Place) -> State:
    for name in reversed(_list_snapshots(log)):
        try:
            return _read_snapshot(log, name)
        except StoreError as error:
            logger.info("%s; an earlier snapshot, or all commits, are read instead", error)
    return State()


def refresh(store: Place, state: State) -> State:
    """Return the state after the commits that were written since."""
    log = store.below(LOG)
    numbers = _list_commits(log, state.number)
    for number, result in zip(numbers, log.map(lambda n: _try_read_commit(log, n), numbers), strict=True):
        wrong = [_make_problem("commit-missing", log, absent) for absent in range(state.number + 1, number)]
        wrong += [_make_problem("commit-damaged", log, number)] if isinstance(result, StoreError) else []
        if wrong:
            state = replace(state, digest="", problems=(*state.problems, *wrong))
        state = replace(state, number=number) if isinstance(result, StoreError) else _follow(state, result, log)
    return state


def read_newest_commit(store: Place) -> Commit | None:
    """Return the last commit, None where there is none; `StoreError` where it is not as it was written."""
    log = store.below(LOG)
    numbers = _list_commits(log, 0)
    return read_commit(log, numbers[-1])[0] if numbers else None


def _list_commits(log: Place, after: int) -> list[int]:
    """Return the numbers of the commits after one, rising."""
    found = (COMMIT.fullmatch(name) for name in log.files(after=commit_name(after)))
    return sorted(int(match[1]) for match in found if match)


def _try_read_commit(log: Place, number: int) -> ReadCommit | StoreError:
    try:
        return read_commit(log, number)
    except StoreError as error:
        return error


def _follow(state: State, result: ReadCommit, log: Place) -> State:
    """Return the state after a commit; one that was written after another commit than the last is a problem."""
    commit, digest, size_bytes = result
    follows = commit.parent == state.digest or not state.digest
    problems = state.problems if follows else (*state.problems, _make_problem("commit-damaged", log, commit.number))
    return replace(fold([commit], state), digest=digest, tail_bytes=state.tail_bytes + size_bytes, problems=problems)


def _make_problem(code: str, log: Place, number: int) -> Problem:
    name = commit_name(number)
    return Problem(make_finding(code, Subject("file", f"log/{name}")), f"commit {number}", (log.where(name),))


def commit_name(number: int) -> str:
    """Return the name of the file of a commit."""
    return f"{number:010}.json"


def make_snapshot_name(number: int) -> str:
    """Return the name of the file of a snapshot."""
    return f"{SNAPSHOT}{number:010}.json.zst"


def read_commit(log: Place, number: int) -> ReadCommit:
    """Return a commit, its seal and its size [byte]; `StoreError` where it is gone or not as it was written."""
    name = commit_name(number)
    data, where = log.read(name), log.where(name)
    if data is None:
        raise StoreError(f"{where}: is missing")
    document = verify_document(data, where)
    commit = parse_typed(document, Commit, where)
    if commit.number != number:
        raise StoreError(f"{where}: is commit {commit.number}")
    return commit, str(document[SEAL]), len(data)


def put_commit(store: Place, state: State, stamp: Stamp, kind: Kind, make: Callable[[State], Entries]) -> State:
    """Write the next commit, and return the state after it, which holds what others committed meanwhile.

    ``make`` returns what to add to a state; it is called again where another call was faster, and nothing is written where that is
    nothing.
    """
    log = store.below(LOG)
    while True:
        entries, number = make(state), state.number + 1
        if entries.is_empty:
            return state
        document = seal_document(Commit(number, state.digest, kind, stamp.who, stamp.at, entries))
        data = to_json(document).encode()
        if (
            log.put_new(commit_name(number), data) or log.read(commit_name(number)) == data
        ):  # the answer to one's own may be lost
            state = _follow(state, (parse_typed(document, Commit, log.where()), str(document[SEAL]), len(data)), log)
            is_due = state.number - state.snapshot >= _EVERY or state.tail_bytes >= _EVERY_BYTES
            return _keep_snapshot(log, state, stamp) if is_due else state
        state = refresh(store, state)


def _keep_snapshot(log: Place, state: State, stamp: Stamp) -> State:
    """Write a snapshot where everything before it could be read, or somebody acknowledged that it cannot; earlier ones go."""
    if any(problem.key not in state.acknowledged for problem in state.problems):
        return state
    with suppress(StoreError):
        log.put_new(make_snapshot_name(state.number), _encode_snapshot(state, stamp))
        for name in _list_snapshots(log)[:-_KEPT]:
            log.delete(name)
    return replace(state, snapshot=state.number, tail_bytes=0)


def _list_snapshots(log: Place) -> list[str]:
    return [name for name in log.files(after=SNAPSHOT) if name.startswith(SNAPSHOT)]


def _encode_snapshot(state: State, stamp: Stamp) -> bytes:
    entries, numbers = compact_state(state), dict[Finding, int]()
    by_run = tuple(tuple(numbers.setdefault(finding, len(numbers)) for finding in row.findings) for row in entries.runs)
    entries = replace(entries, runs=tuple(replace(row, findings=()) for row in entries.runs))
    commit = Commit(state.number, state.digest, "snapshot", stamp.who, stamp.at, entries)
    text = to_compact_json(_Snapshot(commit, tuple(numbers), by_run))
    sink = pa.BufferOutputStream()
    with pa.CompressedOutputStream(sink, "zstd") as stream:
        stream.write(hashlib.sha256(text).hexdigest().encode() + b"\n")
        stream.write(text)
    return bytes(sink.getvalue())


def _read_snapshot(log: Place, name: str) -> State:
    commit = read_snapshot(log, name)
    return replace(fold([commit]), digest=commit.parent, snapshot=commit.number)


def read_snapshot(log: Place, name: str) -> Commit:
    """Return a snapshot as the one commit that it stands for; `StoreError` where it is not as it was written."""
    where, data = log.where(name), log.read(name)
    try:
        whole = memoryview(pa.input_stream(pa.py_buffer(data or b""), compression="zstd").read())
    except OSError:
        whole = memoryview(b"")
    seal, text = bytes(whole[:_SEAL_BYTES]), whole[_SEAL_BYTES + 1 :]
    if hashlib.sha256(text).hexdigest().encode() != seal:
        raise StoreError(f"{where}: is not as it was written")
    try:
        found = parse_typed_json(text, _Snapshot, where)
    except StoreError:
        found = parse_typed(parse_json(bytes(text), where), _Snapshot, where)
    for row, numbers in zip(found.commit.entries.runs, found.by_run, strict=True):
        object.__setattr__(
            row, "findings", tuple([found.findings[number] for number in numbers])
        )  # nobody else has the row yet
    return found.commit


_HERE: dict[Place, State] = {}
"""What this process read last."""


def read_state_here(store: Place) -> State:
    """Return what `read_state` does; what this process has read before is not read again."""
    known = _HERE.get(store)
    known = known if known and known.number and store.below(LOG).size(commit_name(known.number)) else None
    _HERE.clear()
    _HERE[store] = state = read_state(store) if known is None else refresh(store, known)
    return state


def keep_state_here(store: Place, state: State) -> None:
    """Let `read_state_here` begin at a state."""
    _HERE.clear()
    _HERE[store] = state
