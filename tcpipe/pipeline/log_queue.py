"""Which log is ingested next: a call alone goes by the order given, a task of an array takes its share, then what no task has begun.

Claims of the tasks of an array (``--shard I/N``): one task works on a log, and another takes over the log of a killed one.

::

    spool/claims/<log>-<n>.json    the n-th task that works on a log: its process, and when the claim expires unless it is renewed

A task claims a log before it begins, renews the claim while it lives, and removes it when the log is committed. Claims only save time:
two tasks that ingest one log, also at once, make the same files and one run.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

from tcpipe import __version__
from tcpipe.errors import StoreError
from tcpipe.formats.commits import Process
from tcpipe.formats.json_files import digest, parse_typed_json, to_json
from tcpipe.formats.place import Place
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.run_documents import SPOOL
from tcpipe.pipeline.calls import LogWriter, identify_process, is_alive
from tcpipe.pipeline.log_sources import (
    LogSource,
    add_hashes,
    group_possible_duplicates,
    make_definitions_key,
    plan_rounds,
)
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.plan import IngestResult, IngestTask, Step, make_planner
from tcpipe.recipe import Recipe

LEASE_S = 120.0
"""A claim expires after this time. Where clocks differ by more, two tasks do the same work; nothing worse happens."""

Held = Literal["mine", "theirs", "given up"]


@dataclass(frozen=True, slots=True)
class Claim:
    """A task that works on a log, and until when that holds [ns since 1970]."""

    process: Process
    log: str
    until_ns: int

    def is_live(self) -> bool:
        """Return whether the claim has not expired and its process has not ended, as far as can be seen from here."""
        return is_alive(self.process) is not False and time.time_ns() < self.until_ns


class Claims:
    """The claims of one task; see `hold_claims`."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._process = identify_process()
        self._held: dict[str, tuple[str, int]] = {}
        self._lock = threading.Lock()

    def claim(self, key: str, log: str, *, take_over: bool, most: int) -> Held:
        """Claim a log; with ``take_over`` also one whose claim is no longer live, unless ``most`` tasks have tried it."""
        if key in self._held:
            return "mine"
        for number in range(1, most + 1):
            name = f"{key}-{number}.json"
            with self._lock:
                if self._place.put_new(name, self._encode(log)):
                    self._held[key] = log, number
                    return "mine"
            if not take_over:
                return "theirs"
            claim = self._read(name)
            if claim is None or claim.is_live():
                return "theirs"
        return "given up"

    def release(self, key: str) -> None:
        """Remove a claim, and those of killed tasks on the same log; one that cannot be removed expires."""
        with self._lock, suppress(StoreError):
            _, number = self._held.pop(key, ("", 0))
            for last in range(number, 0, -1):
                self._place.delete(f"{key}-{last}.json")

    def renew(self) -> None:
        """Write all claims again, with the full time until they expire."""
        for key in list(self._held):
            with self._lock, suppress(StoreError):
                if key in self._held:
                    log, number = self._held[key]
                    self._place.put(f"{key}-{number}.json", self._encode(log))

    def release_all(self) -> None:
        """Remove all claims of this task."""
        for key in list(self._held):
            self.release(key)

    def remove_expired(self) -> None:
        """Remove the claims that killed tasks left."""
        for name in self._place.files():
            claim = self._read(name)
            if claim is not None and not claim.is_live():
                self._place.delete(name)

    def _encode(self, log: str) -> bytes:
        return to_json(Claim(self._process, log, time.time_ns() + int(LEASE_S * 1e9))).encode()

    def _read(self, name: str) -> Claim | None:
        data = self._place.read(name)
        return None if data is None else parse_typed_json(data, Claim, self._place.where(name))


@contextmanager
def hold_claims(store: Place) -> Iterator[Claims]:
    """Yield the claims of this task; a thread renews them until the block ends, which removes them."""
    claims, ended = Claims(store.below(f"{SPOOL}/claims")), threading.Event()

    def renew() -> None:
        while not ended.wait(LEASE_S / 4):
            claims.renew()

    thread = threading.Thread(target=renew, daemon=True)
    thread.start()
    try:
        yield claims
    finally:
        ended.set()
        claims.release_all()


def make_tasks(
    sources: Iterable[LogSource], options: IngestOptions, root: Path | str, recipe: Recipe
) -> list[IngestTask]:
    """Return the task of each log; on a cluster, whose workers are elsewhere, with absolute paths."""
    definitions = None if options.message_definitions is None else Path(options.message_definitions)
    if options.cluster is not None:
        root = root.absolute() if isinstance(root, Path) else root
        definitions = definitions and definitions.absolute()
    robot, tags = options.robot or recipe.robot, dict(options.tags or {})
    how = (root, recipe, robot, tags, options.force, definitions, make_definitions_key(definitions))
    return [IngestTask(source, *how, options.retry_failed, options.min_age_s) for source in sources]


Item: TypeAlias = tuple[int, IngestTask]

_MOST_TASKS = 3
"""At most so many tasks try a log of another's share, one after the other: a log that kills its task must not kill the whole array."""
_UNLIMITED = 1000


class LogQueue:
    """The logs of a call, or of an array as one of its tasks sees them.

    Logs that may be the same recording are a unit with one claim, so that the first of them names the run, whoever ingests it.

    ``own`` are the logs of this task's share, ``broken`` runs and recipes of which files are gone; a call alone has no claims.
    """

    def __init__(
        self,
        log: LogWriter,
        tasks: Sequence[IngestTask],
        own: Iterable[int],
        broken: Container[tuple[str, str]],
        claims: Claims | None,
    ) -> None:
        self._log, self._tasks, self._own, self._broken, self._claims = log, tasks, frozenset(own), broken, claims
        self._planned, self._decide = log.state, make_planner(log.state, broken=broken)
        self._keys, self._given_up = dict[int, str](), False
        every = self.plan(range(len(tasks)))
        self.steps = {at: every[at] for at in own}
        """What the logs of this task's share need as the call begins."""
        todo = [at for at, _ in self._select_todo(every)]
        units = [[todo[at] for at in unit] for unit in group_possible_duplicates([tasks[at].source for at in todo])]
        if claims is not None:
            units.sort(key=lambda unit: (self._own.isdisjoint(unit), -sum(tasks[at].source.size_bytes for at in unit)))
        self._left = units

    def plan(self, indices: Iterable[int]) -> dict[int, Step]:
        """Return what logs need now; those of other shares as a call without options that ingest again."""
        if self._planned is not self._log.state:
            self._planned, self._decide = self._log.state, make_planner(self._log.state, broken=self._broken)
        tasks = {at: self._tasks[at] for at in indices}
        return {
            at: self._decide(task if at in self._own else replace(task, force=False, retry_failed=False))
            for at, task in tasks.items()
        }

    @property
    def is_done(self) -> bool:
        """Whether no log is to be done: this task has none left, other tasks work on none, and none was given up."""
        return not self._given_up and not any(map(self._list_todo, self._left))

    def iterate_rounds(self) -> Iterator[Iterable[Item]]:
        """Yield logs to ingest side by side, then logs to ingest after those, and so on.

        The first task that finds only logs on which others work waits for them, and takes over those of killed tasks; later tasks end.
        """
        take_over = False
        while self._left:
            later = list[Item]()
            yield self._take(later, take_over=take_over)
            yield later
            if take_over and self._left and not self._wait():
                return
            take_over = True

    def release_claim(self, index: int, result: IngestResult) -> None:
        """Remove the claim of a log that is committed; one that may be tried again stays claimed until this task ends."""
        key = self._keys.pop(index, None)
        if self._claims is None or key is None or result.transient or result.status == "waiting":
            return
        if key not in self._keys.values():
            self._claims.release(key)

    def remove_expired_claims(self) -> None:
        """Remove the claims that killed tasks left, once no log is to be done."""
        if self._claims is not None and self.is_done:
            self._claims.remove_expired()

    def _take(self, later: list[Item], *, take_over: bool) -> Iterator[Item]:
        """Yield logs as they are claimed; those that hold the same recording as one of them go to ``later``."""
        units, self._left = self._left, []
        for unit in units:
            todo = self._list_todo(unit)
            if todo and self._claims is not None:
                todo = self._claim(unit, self._claims, take_over=take_over)
            hashed = add_hashes([task.source for _, task in todo])
            items = [(index, replace(task, source=source)) for (index, task), source in zip(todo, hashed, strict=True)]
            now, after = plan_rounds(hashed)
            later += [items[at] for at in after]
            yield from (items[at] for at in now)

    def _claim(self, unit: list[int], claims: Claims, *, take_over: bool) -> list[Item]:
        """Claim a unit, and return which of its logs are to be done; none where another task has it, which `_left` keeps."""
        source = self._tasks[unit[0]].source
        key = self._make_key(f"{source.place} {source.files}")
        most = _MOST_TASKS if self._own.isdisjoint(unit) else _UNLIMITED
        held: Held = "mine"
        with suppress(StoreError):  # a store that does not answer costs the log that is written then, not the call
            if (held := claims.claim(key, source.name, take_over=take_over, most=most)) == "mine":
                self._log.refresh()
        self._left += [unit] if held == "theirs" else []
        self._given_up |= held == "given up"
        if held != "mine":
            return []
        todo = self._list_todo(unit)
        if not todo:
            claims.release(key)
        self._keys.update(dict.fromkeys((index for index, _ in todo), key))
        return todo

    def _wait(self) -> bool:
        """Wait a while for other tasks; return False where another task waits already."""
        waiting = self._make_key("waiting")
        if self._claims is None or self._claims.claim(waiting, "", take_over=True, most=_UNLIMITED) != "mine":
            return False
        time.sleep(LEASE_S / 24)
        self._log.refresh()
        return True

    def _list_todo(self, unit: Iterable[int]) -> list[Item]:
        return self._select_todo(self.plan(unit))

    def _select_todo(self, steps: Mapping[int, Step]) -> list[Item]:
        """Return the logs that are to be done; not those of other shares that failed for now."""
        return [
            (at, step.task)
            for at, step in steps.items()
            if step.is_todo and (at in self._own or step.state != "failed_transient")
        ]

    def _make_key(self, name: str) -> str:
        task = self._tasks[0]
        return digest([name, ingest_key(task.recipe), task.robot, task.definitions, __version__])
