"""Which logs of a call are ingested next: those that hold the same recording one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from tcpipe.pipeline.log_sources import (
    LogSource,
    add_hashes,
    group_possible_duplicates,
    make_definitions_key,
    plan_rounds,
)
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.plan import IngestTask, Step
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


def iterate_rounds(steps: Sequence[Step]) -> Iterator[Iterable[Item]]:
    """Yield logs to ingest side by side, then those that hold the same recording as one of them.

    Logs that may be the same recording are a unit, so that the first of them names the run.
    """
    todo = [at for at, step in enumerate(steps) if step.is_todo]
    units = group_possible_duplicates([steps[at].task.source for at in todo])
    later = list[Item]()

    def take() -> Iterator[Item]:
        for unit in units:
            indices = [todo[at] for at in unit]
            hashed = add_hashes([steps[at].task.source for at in indices])
            items = [(at, replace(steps[at].task, source=source)) for at, source in zip(indices, hashed, strict=True)]
            now, after = plan_rounds(hashed)
            later.extend(items[at] for at in after)
            yield from (items[at] for at in now)

    yield take()
    yield later
