"""Which logs of a call are ingested next: those that hold the same recording one after the other."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from tcpipe.pipeline.calls import LogWriter
from tcpipe.pipeline.log_sources import (
    LogSource,
    add_hashes,
    group_possible_duplicates,
    make_definitions_key,
    plan_rounds,
)
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.plan import IngestTask, Step, make_planner
from tcpipe.recipe import Recipe


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


class LogQueue:
    """The logs of a call.

    Logs that may be the same recording are a unit, so that the first of them names the run. ``broken`` are runs and recipes of which files
    are gone.
    """

    def __init__(self, log: LogWriter, tasks: Sequence[IngestTask], broken: Container[tuple[str, str]]) -> None:
        self._log, self._tasks, self._broken = log, tasks, broken
        self._planned, self._decide = log.state, make_planner(log.state, broken=broken)
        self.steps = self.plan(range(len(tasks)))
        """Steps that the logs need when the call begins."""
        todo = [at for at, step in self.steps.items() if step.is_todo]
        self._units = [
            [todo[at] for at in unit] for unit in group_possible_duplicates([tasks[at].source for at in todo])
        ]

    def plan(self, indices: Iterable[int]) -> dict[int, Step]:
        """Return what logs need now."""
        if self._planned is not self._log.state:
            self._planned, self._decide = self._log.state, make_planner(self._log.state, broken=self._broken)
        return {at: self._decide(self._tasks[at]) for at in indices}

    @property
    def is_done(self) -> bool:
        """Whether no log was to be done as the call began."""
        return not self._units

    def iterate_rounds(self) -> Iterator[Iterable[Item]]:
        """Yield logs to ingest side by side, then those that hold the same recording as one of them."""
        later = list[Item]()
        yield self._take(later)
        yield later

    def _take(self, later: list[Item]) -> Iterator[Item]:
        for unit in self._units:
            todo = [(at, step.task) for at, step in self.plan(unit).items() if step.is_todo]
            hashed = add_hashes([task.source for _, task in todo])
            items = [(index, replace(task, source=source)) for (index, task), source in zip(todo, hashed, strict=True)]
            now, after = plan_rounds(hashed)
            later += [items[at] for at in after]
            yield from (items[at] for at in now)
