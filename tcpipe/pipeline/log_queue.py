"""Which log is ingested next: a call alone goes by the order given, a task of an array takes its share, then what no task has begun."""

from __future__ import annotations

import time
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TypeAlias

from tcpipe import __version__
from tcpipe.errors import StoreError
from tcpipe.formats.json_files import digest
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.pipeline import claims as claiming
from tcpipe.pipeline.calls import LogWriter
from tcpipe.pipeline.claims import Claims, Held
from tcpipe.pipeline.log_sources import add_hashes, group_possible_duplicates, plan_rounds
from tcpipe.pipeline.plan import IngestResult, IngestTask, Step, make_planner

Item: TypeAlias = tuple[int, IngestTask]

_MOST_TASKS = 3
"""At most so many tasks try a log of another's share, one after the other: a log that kills its task must not kill the whole array."""
_UNLIMITED = 1000


class LogQueue:
    """The logs of a call, or of an array as one of its tasks sees them.

    Logs that may be the same recording are a unit with one claim, so that the first of them names the run, whoever ingests it.

    Parameters
    ----------
    log : writes into the log of the store.
    tasks : all logs, and how they are to be ingested.
    own : those of this task's share.
    broken : runs and recipes of which files are gone.
    claims : those of this task; None of a call alone.
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
        time.sleep(claiming.LEASE_S / 24)
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

    def _make_key(self, of: str) -> str:
        task = self._tasks[0]
        return digest([of, ingest_key(task.recipe), task.robot, task.definitions, __version__])
