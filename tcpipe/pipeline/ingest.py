"""From logs to labelled segments in the store: one task a log, side by side, each whole or not at all."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Literal, TypeVar

from tcpipe import __version__
from tcpipe.errors import LogError, StoreError, UsageError, plain_line
from tcpipe.execution import run_all
from tcpipe.formats.atomic import scratch_directory
from tcpipe.formats.index_files import forget_runs
from tcpipe.formats.object_storage import is_presigned, is_url
from tcpipe.formats.recipe_toml import ingest_key, recipe_of
from tcpipe.formats.record_files import Call
from tcpipe.formats.robot_files import profiles_of
from tcpipe.formats.store_mark import gone_if_empty
from tcpipe.pipeline.begun_calls import begun_call
from tcpipe.pipeline.calls import INGEST, remember_call, room_of, started
from tcpipe.pipeline.ingest_options import IngestOptions
from tcpipe.pipeline.ingest_run import as_indexed, ingest_one, made_before
from tcpipe.pipeline.ingest_task import IngestResult, IngestTask, died, told, too_young
from tcpipe.pipeline.known_runs import KnownRuns, known_runs
from tcpipe.pipeline.known_trouble import Trouble, trouble_of_run
from tcpipe.pipeline.log_findings import find_failure
from tcpipe.pipeline.log_sources import (
    FoundLogs,
    LogSource,
    definitions_key,
    find_sources,
    in_shard,
    in_turns,
    with_hashes,
)
from tcpipe.pipeline.supersession import remember_earlier, superseded_by
from tcpipe.store import Store, add_by_hash, open_store
from tcpipe.tables.options import as_function

R = TypeVar("R")

logger = logging.getLogger("tcpipe")

_NO_LOGS = "no logs given; wanted .mcap, .bag or .db3 files, ROS 2 bag directories, or folders of them or of tables"


@dataclass(frozen=True, slots=True)
class IngestSummary:
    """What became of every log, in the order given; ``exit_code`` is the contract's."""

    store: Path | str
    results: tuple[IngestResult, ...] = field(default_factory=tuple)

    @property
    def exit_code(self) -> int:
        """0 nothing is wrong, or nothing that is news; 1 all failed; 3 some failed, are damaged or empty."""
        if not any(result.is_news for result in self.results):
            return 0
        return 1 if all(result.status == "failed" for result in self.results) else 3


@dataclass(frozen=True, slots=True)
class SummaryLine:
    """The last line of ``ingest --json``: what became of all logs."""

    recipe: str
    """The file that rules, or that it is the defaults."""
    store: str | None
    """None where no store was made."""
    exit_code: int
    results: tuple[IngestResult, ...]
    kind: Literal["summary"] = "summary"


def run_ingest(options: IngestOptions) -> IngestSummary:
    """Ingest logs (files, ROS 2 bag directories, folders of them) into the store; what is there already is left alone.

    Raises `LogError`, `StoreError`, `RecipeError` or `UsageError` when nothing can be begun; what goes wrong with one log or path stands
    in its result.
    """
    watch = started()
    ruling, shard = recipe_of(options.recipe), options.shard
    robot = options.robot or ruling.robot
    if robot is not None and robot not in (robots := profiles_of(ruling).robots):
        raise UsageError(f"robot {robot!r} is not known; known: {', '.join(sorted(robots))}")
    with (
        _place_for_stand_ins(logs := list(options.logs)) as staging,
        gone_if_empty(options.store),
        ExitStack() as until_it_ends,
    ):
        found = find_sources(logs, as_one=options.as_one, staging=staging, tables=ruling.tables)
        if not found.sources:
            raise (LogError if found.transient else UsageError)(*chain(*found.problems.values()) or [_NO_LOGS])
        opened = open_store(options.store, create=True)
        given = tuple(str(log) if is_url(log) else str(Path(log).absolute()) for log in logs if not is_presigned(log))
        until_it_ends.enter_context(begun_call(opened, INGEST, given, options=(ingest_key(ruling), robot, shard)))
        remember_earlier(opened)
        known = known_runs(opened, force=options.force)
        mine = found.sources if shard is None else in_shard(found.sources, shard)
        root = opened.root
        message_definitions = None if options.message_definitions is None else Path(options.message_definitions)
        if options.cluster is not None:  # its workers are elsewhere
            root = root.absolute() if isinstance(root, Path) else root
            message_definitions = None if message_definitions is None else message_definitions.absolute()
        common = (root, ruling, robot, dict(options.tags or {}), options.force, message_definitions)
        how = (definitions_key(message_definitions), options.retry_failed, options.min_age_s)
        sources = with_hashes(mine, lambda lineage: known.seen.get(lineage, ()))
        tasks = [IngestTask(source, *common, *how) for source in sources]
        if options.on_found:
            sizes = {task.source.name: sum(size for size, _ in task.source.files) for task in tasks}
            options.on_found({**dict.fromkeys(map(plain_line, found.problems), 0), **sizes})
        results = {}
        for index, source, result in _results(opened, tasks, found, known, jobs=options.jobs, cluster=options.cluster):
            results[index] = result
            if options.on_result:
                options.on_result(result)
            if source is not None:
                _remember(opened, tasks[index], source, result, known)
        _keep_index(opened, known, results.values())
        summary = IngestSummary(opened.root, tuple(results[index] for index in sorted(results)))
        if any(result.run_id for result in summary.results):  # else no store may remain
            remember_call(opened, watch, _call_of(opened, summary, given, tasks, options.jobs))
        return summary


ingest = as_function(IngestOptions, run_ingest)
"""`tcpipe.ingest`: its keywords are the fields of `IngestOptions`."""


def _call_of(
    store: Store, summary: IngestSummary, given: tuple[str, ...], tasks: Iterable[IngestTask], jobs: int
) -> Call:
    """Return what the history holds of a call."""
    done = [result for result in summary.results if result.status in ("done", "damaged", "empty")]
    sizes = {task.source.name: sum(size for size, _ in task.source.files) for task in tasks}
    return Call(
        INGEST,
        __version__,
        summary.exit_code,
        Counter(result.status for result in summary.results),
        jobs,
        logs=given,
        failed={result.log: result.problems[0] for result in summary.results if result.transient and result.problems},
        done_bytes=sum(sizes.get(result.log, 0) for result in done),
        written_bytes=room_of(store, [result.run_id for result in done if result.run_id]),
    )


def _keep_index(store: Store, known: KnownRuns, results: Iterable[IngestResult]) -> None:
    """Write the index, with what this call made."""
    results = list(results)
    mended = {result.run_id for result in results if result.run_id} & {run_id for run_id, _ in known.runs.lost}
    if mended:
        forget_runs(store.index_place, mended)
    if not mended and all(result.status in ("unchanged", "waiting") for result in results):
        store.keep_index(known.runs)
    elif known.runs.rows or any(result.run_id for result in results):
        store.keep_index(store.ingestions())
        store.seen_logs()


def _results(
    store: Store, tasks: Sequence[IngestTask], found: FoundLogs, known: KnownRuns, *, jobs: int, cluster: str | None
) -> Iterator[tuple[int, LogSource | None, IngestResult]]:
    """Yield what became of each path that holds no log, and of each log as it ends, by its place; what needs no work is told first."""
    for index, (path, lines) in enumerate(found.problems.items(), start=-len(found.problems)):
        name = plain_line(path)
        findings = find_failure(name, "LogError")
        yield index, None, IngestResult(name, "failed", findings=findings, problems=lines, transient=True)
    runs = store.run_ids_by_hash()
    for turn in in_turns([task.source for task in tasks]):
        todo = []
        for index in turn:
            result = told(tasks[index], partial(_without_work, store=store, known=known, runs=runs))
            if result is None:
                todo.append(index)
            else:
                yield index, tasks[index].source, _judged(store, tasks[index].source, result, runs, known)
        with closing(run_all(ingest_one, [tasks[index] for index in todo], jobs=jobs, cluster=cluster)) as outcomes:
            for outcome in outcomes:
                task = tasks[todo[outcome.index]]
                source, result = outcome.result or (task.source, died(task.source))
                yield todo[outcome.index], source, _judged(store, source, result, runs, known)


def _without_work(
    task: IngestTask, *, store: Store, known: KnownRuns, runs: Mapping[str, Sequence[str]]
) -> IngestResult | None:
    """Return the result of a log that is in the store, is known to fail, or has to wait; None where there is something to do."""
    source, sha256 = task.source, None if task.force else task.source.sha256
    if sha256 and (made := as_indexed(task, known.made.get(sha256, ()), sha256)):
        return made
    run_id = store.run_of(sha256, runs) if sha256 else None
    if run_id and (made := made_before(store, run_id, task, str(source.sha256))):
        return made
    again = task.force or task.retry_failed or task.failure not in known.failed
    failed = None if again else store.recall(task.failure, Trouble)
    if failed is not None:
        return IngestResult(source.name, "failed", problems=failed.lines, sha256=source.sha256, known=True)
    return too_young(task)


def _judged(
    store: Store, source: LogSource, result: IngestResult, runs: dict[str, list[str]], known: KnownRuns
) -> IngestResult:
    """Return a result with what the store says of it: whether its trouble is news, and which runs it supersedes."""
    notes = result.notes
    if result.run_id and result.sha256 and not _is_settled(source, result, known):
        if store.run_of(result.sha256, runs) is None:
            add_by_hash(runs, result.run_id)
        try:
            notes += tuple(superseded_by(store, source, result.run_id, result.sha256, runs))
        except StoreError as error:
            notes += error.problems
    trouble = _trouble(source, result)
    if trouble is None:
        return result if notes == result.notes else replace(result, notes=notes)
    told_before = result.known or (trouble.kind != "failed" and trouble.is_told(store))
    return replace(result, notes=notes, known=told_before, accepted=trouble.is_accepted(store))


def _is_settled(source: LogSource, result: IngestResult, known: KnownRuns) -> bool:
    """Tell whether a log is as it was, and its run has no part in what supersedes what."""
    unchanged = result.status == "unchanged" and result.run_id not in known.parties
    return unchanged and result.sha256 is not None and known.has_seen(source, result.sha256)


def _trouble(source: LogSource, result: IngestResult) -> Trouble | None:
    content = result.sha256 or source.files_digest
    if result.status == "failed":
        return Trouble(content, result.problems, source.origins, kind="failed")
    return trouble_of_run(result.run_id, result.findings, result.damage, content=content, log=source.origins)


def _remember(store: Store, task: IngestTask, source: LogSource, result: IngestResult, known: KnownRuns) -> None:
    """Remember what a log holds, and what is wrong with that; where it cannot be written it is told again the next time."""
    trouble = _trouble(source, result)
    try:
        if result.sha256 and source.files and not known.has_seen(source, result.sha256):
            store.note(source.lineage, source.sighting(result.sha256))
        if trouble is not None and trouble.kind != "failed":
            trouble.told(store)
        elif trouble is not None and not result.transient and not result.known:
            task = replace(task, source=replace(source, sha256=result.sha256))
            store.remember(task.failure, replace(trouble, version=__version__))
    except StoreError as error:
        logger.error("%s", error)  # noqa: TRY400  one line


def _place_for_stand_ins(logs: Iterable[str | Path]) -> AbstractContextManager[Path]:
    """Return a temporary directory, where a log is named by its URL."""
    remote = any(is_url(log) for log in logs)
    return scratch_directory() if remote else nullcontext(Path())
