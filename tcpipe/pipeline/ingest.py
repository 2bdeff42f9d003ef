"""From logs to labelled segments in the store: one task a log, side by side, each whole or not at all."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, field, fields, replace
from itertools import chain
from pathlib import Path
from typing import Literal

import pyarrow as pa

from tcpipe import __version__
from tcpipe.errors import LogError, StoreError, UsageError, clean_line, list_first
from tcpipe.execution import refuse_import_of_script, run_all
from tcpipe.formats.atomic import make_scratch_directory
from tcpipe.formats.commit_log import keep_state_here
from tcpipe.formats.commits import CallRecord, Entries, Failure, Kind, State, Superseded
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.object_storage import is_presigned, make_absolute
from tcpipe.formats.parquet import read_table
from tcpipe.formats.recipe_toml import ingest_key, load_profiles, resolve_recipe
from tcpipe.formats.run_documents import remove_if_empty
from tcpipe.formats.stored_runs import look_at_files
from tcpipe.pipeline.calls import (
    INGEST,
    LogWriter,
    commit_call,
    find_settled_calls,
    make_call,
    open_log,
    start_stopwatch,
    stored_bytes,
)
from tcpipe.pipeline.ingest_run import Ingested, find_twin, ingest_one
from tcpipe.pipeline.log_queue import Item, LogQueue, make_tasks
from tcpipe.pipeline.log_sources import (
    FoundLogs,
    LogSource,
    find_failure,
    find_sources,
    is_there,
    select_shard,
)
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.plan import IngestResult, IngestTask, Step, check_age, make_died_result, make_result
from tcpipe.pipeline.problems import find_problems, is_acknowledged, make_failure
from tcpipe.recipe import TimeWindow
from tcpipe.store import Store, open_store
from tcpipe.tables.arrays import encode_rows
from tcpipe.tables.findings import select_problems
from tcpipe.tables.options import as_function

logger = logging.getLogger("tcpipe")

_TOGETHER_S = 1.0  # results of this time share a commit

_NO_LOGS = "no logs given; expected .mcap, .bag or .db3 files, ROS 2 bag directories, or folders of them or of tables"


@dataclass(frozen=True, slots=True)
class IngestSummary:
    """Results of the logs in the order given; ``exit_code`` is the contract's."""

    store: Path | str
    results: tuple[IngestResult, ...] = field(default_factory=tuple)

    @property
    def exit_code(self) -> int:
        """0 nothing is wrong, or nothing that is news; 1 all failed; 3 some failed, are damaged or empty."""
        if not any(result.is_new_problem for result in self.results):
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
    refuse_import_of_script(options.jobs)
    measure = start_stopwatch()
    ruling, shard = resolve_recipe(options.recipe), options.shard
    robot = options.robot or ruling.robot
    if robot is not None and robot not in (robots := load_profiles(ruling).robots):
        raise UsageError(f"robot {robot!r} is not known; known: {', '.join(sorted(robots))}")
    undo = nullcontext() if shard is not None else remove_if_empty(options.store)  # another task may be at it
    with make_scratch_directory() as staging, undo:
        found = find_sources(logs := list(options.logs), as_one=options.as_one, staging=staging, tables=ruling.tables)
        if not found.sources:
            raise (LogError if found.transient else UsageError)(*chain(*found.problems.values()) or [_NO_LOGS])
        opened = open_store(options.store, create=True)
        log = open_log(opened)
        before = log.state
        given = tuple(make_absolute(path) for path in logs if not is_presigned(path))  # signed URLs are not stored
        own = found.sources if shard is None else [found.sources[at] for at in select_shard(found.sources, shard)]
        tasks = make_tasks(own, options, opened.root, ruling)
        if options.on_found:
            sizes = {source.name: source.size_bytes for source in own}
            options.on_found({**dict.fromkeys(map(clean_line, found.problems), 0), **sizes})
        results: dict[int, IngestResult] = {}

        def tell(ended: Iterable[tuple[int, IngestResult]]) -> IngestSummary:
            for index, result in ended:
                results[index] = result
                if options.on_result:
                    options.on_result(result)
            return IngestSummary(opened.root, tuple(results[index] for index in sorted(results)))

        begin = (INGEST, given, (ingest_key(ruling), robot))
        queue = LogQueue(log, tasks, find_broken(opened, log.state, own))
        summary = tell(chain(_iterate_missing(found), _iterate_finished(log, queue.steps)))
        if queue.is_done:
            log.commit("ended", Entries(ended=tuple(find_settled_calls(log.state, make_call(*begin)))))
        else:
            opened.check_writable()
            with commit_call(log, *begin[:2], options=begin[2]) as call:
                tell(_iterate_results(log, queue, jobs=options.jobs, cluster=options.cluster))
                summary = tell(_iterate_left(log, queue.plan(at for at in range(len(tasks)) if at not in results)))
                call.is_whole = shard is None
                record = _make_call_record(opened, summary, given, tasks, options.jobs)
                call.end = Entries(calls=(measure(record),))
        if log.state.number != before.number and log.state.runs:
            opened.write_index(log.state)
        _warn_of_unmatched_windows(ruling.mask.windows, log.state)
        return summary


ingest = as_function(IngestOptions, run_ingest)
"""`tcpipe.ingest`: its keywords are the fields of `IngestOptions`."""


_MOST_RUNS = 5  # named in one message


def _warn_of_unmatched_windows(windows: Iterable[TimeWindow], state: State) -> None:
    """Log a line for each pattern of time windows that fits no run of the store."""
    run_ids = sorted({row.run_id for row in state.runs.values()})
    for pattern, window in {time_window.run: time_window for time_window in windows}.items():
        if run_ids and not any(map(window.is_for, run_ids)):
            text = (
                "recipe mask.windows (or its CSV file): run = %r fits no run, so its windows have no effect; runs: %s"
            )
            logger.warning(text, pattern, list_first(run_ids, _MOST_RUNS))


def find_broken(store: Store, state: State, sources: Iterable[LogSource]) -> set[tuple[str, str]]:
    """Return the ingestions of what these logs hold or held of which a file is gone.

    Stores in buckets are not searched, which would need a request for every thousand files.
    """
    if store.place.path is None:
        return set()
    contents = {snapshot.sha256 for source in sources for snapshot in state.seen.get(source.lineage, ())}
    rows = [row for row in state.runs.values() if row.log and row.log.source.sha256 in contents]
    return {(row.run_id, row.recipe_id) for row, lost, _ in look_at_files(store.runs_place, rows) if lost}


def _make_call_record(
    store: Store, summary: IngestSummary, given: tuple[str, ...], tasks: Iterable[IngestTask], jobs: int
) -> CallRecord:
    """Return what the history holds of a call."""
    done, written_bytes = [result for result in summary.results if result.status in ("done", "damaged", "empty")], 0
    with suppress(StoreError):  # a figure of the history
        written_bytes = stored_bytes(store, [result.run.run_id for result in done if result.run])
    sizes = {task.source.name: task.source.size_bytes for task in tasks}
    return CallRecord(
        INGEST,
        __version__,
        summary.exit_code,
        Counter(result.status for result in summary.results),
        jobs,
        logs=given,
        failed={result.log: result.problems[0] for result in summary.results if result.transient and result.problems},
        done_bytes=sum(sizes.get(result.log, 0) for result in done),
        written_bytes=written_bytes,
    )


def _iterate_missing(found: FoundLogs) -> Iterator[tuple[int, IngestResult]]:
    """Yield the result of each path that holds no log."""
    for index, (path, lines) in enumerate(found.problems.items(), start=-len(found.problems)):
        name = clean_line(path)
        findings = find_failure(name, "LogError")
        yield index, IngestResult(name, "failed", causes=findings, problems=lines, transient=True)


def _iterate_left(log: LogWriter, steps: Mapping[int, Step]) -> Iterator[tuple[int, IngestResult]]:
    """Yield the result of each log that another call has ingested meanwhile or works on."""
    yield from _iterate_finished(log, steps)
    for index, step in steps.items():
        if step.is_todo:
            yield index, IngestResult(step.task.source.name, "waiting", notes=("another task of the array ingests it",))


def _iterate_finished(log: LogWriter, steps: Mapping[int, Step]) -> Iterator[tuple[int, IngestResult]]:
    """Yield the result of each log that is in the store, is known to fail, or has to wait."""
    parties = log.state.parties
    for index, step in steps.items():
        source, made = step.task.source, step.made
        if step.failure is not None:
            yield (
                index,
                IngestResult(
                    source.name,
                    "failed",
                    problems=step.failure.problems,
                    causes=step.failure.findings,
                    sha256=source.sha256,
                    known=True,
                    acknowledged=step.state == "quarantined",
                ),
            )
        elif made is not None:
            result = make_result(source, "unchanged", made, str(source.sha256), same_as=find_twin(made.log, source))
            if made.run_id in parties:
                superseded, notes = find_superseded(log.store, log.state, source, made.run_id, str(source.sha256))
                log.commit("superseded", Entries(superseded=tuple(superseded)))
                result = replace(result, notes=(*result.notes, *notes))
            if select_problems(result.findings):
                result = replace(result, known=True, acknowledged=is_acknowledged(find_problems(made), log.state))
            yield index, result
        elif not step.is_todo:
            yield index, check_age(step.task) or IngestResult(source.name, "waiting")


def _iterate_results(
    log: LogWriter, queue: LogQueue, *, jobs: int, cluster: str | None
) -> Iterator[tuple[int, IngestResult]]:
    """Yield what became of each log by its index, once that is committed; what ends within a second is one commit."""
    keep_state_here(log.store.place, log.state)
    begun = log.state.number
    for turn in queue.iterate_rounds():
        taken, waiting, last_s = list[Item](), list[tuple[int, IngestTask, Ingested]](), 0.0
        with closing(run_all(ingest_one, _take_tasks(turn, taken), jobs=jobs, cluster=cluster)) as outcomes:
            for outcome in outcomes:
                index, task = taken[outcome.index]
                waiting.append((index, task, outcome.result or Ingested(task.source, make_died_result(task.source))))
                if time.monotonic() - last_s >= _TOGETHER_S:
                    yield from _commit(log, waiting, begun)
                    waiting, last_s = [], time.monotonic()
        yield from _commit(log, waiting, begun)


def _take_tasks(turn: Iterable[Item], taken: list[Item]) -> Iterator[IngestTask]:
    for item in turn:
        taken.append(item)
        yield item[1]


def _commit(
    log: LogWriter, ended: Sequence[tuple[int, IngestTask, Ingested]], begun: int
) -> Iterator[tuple[int, IngestResult]]:
    """Commit what became of logs, and yield it with what the log says of it; a run that cannot be committed has failed for now.

    Nor are ingestions committed that were pruned after commit ``begun``: their files may be about to go.
    """
    before, entries, notes = log.state, Entries(), dict[int, tuple[str, ...]]()
    for index, task, ingested in ended:
        more, notes[index] = _make_entries(log, task, ingested)
        entries = Entries(*((*getattr(entries, name.name), *getattr(more, name.name)) for name in fields(Entries)))
    others, pruned = dict[str, str](), set[tuple[str, str]]()

    def make(state: State) -> Entries:
        """Return what is to be added; of two calls that gave one recording two names the first wins."""
        others.clear()
        pruned.clear()
        pruned.update(key for key, number in state.pruned.items() if number > begun)
        gone = {run_id for run_id, _ in pruned if not state.find_rows(run_id)}  # with all that lay in their directories
        pruned.update((row.run_id, row.recipe_id) for row in entries.runs if row.run_id in gone)
        for row in entries.runs:
            named = state.find_run(row.log.source.sha256) if row.log else None
            others.update({} if named in (None, row.run_id) else {row.run_id: named})
        kept = (row for row in entries.runs if row.run_id not in others and (row.run_id, row.recipe_id) not in pruned)
        return replace(entries, runs=tuple(kept))

    try:
        kind: Kind = "ingested" if entries.runs else "failed" if entries.failed else "seen"
        log.commit(kind, make)
    except StoreError as error:
        if not entries.runs:
            logger.error("%s", error)  # noqa: TRY400  one line
        ended = [
            (index, task, _fail_commit(ingested, error) if ingested.rows else ingested)
            for index, task, ingested in ended
        ]
    keep_state_here(log.store.place, log.state)
    for index, _, ingested in ended:
        result = replace(ingested.result, notes=(*ingested.result.notes, *notes[index]))
        if result.run and (by := others.get(result.run.run_id)):
            result = _adopt_committed_run(log.state.runs.get((by, result.run.recipe_id)), by, result, ingested.source)
        elif result.run and ingested.rows and (result.run.run_id, result.run.recipe_id) in pruned:
            result = _fail_for_now(result, f"'tcpipe prune' removed run {result.run.run_id} at the same time")
        yield index, _judge_result(log.state, result, ingested.source, before=before)


def _fail_commit(ingested: Ingested, error: StoreError) -> Ingested:
    """Return that a run is in the store and no commit names it: the next call finds it there."""
    problems = tuple(f"{ingested.result.log}: {problem}" for problem in error.problems)
    findings = find_failure(ingested.result.log, type(error).__name__)
    return replace(
        ingested,
        result=IngestResult(ingested.result.log, "failed", causes=findings, problems=problems, transient=True),
        rows=(),
    )


def _adopt_committed_run(made: RunFacts | None, run_id: str, result: IngestResult, source: LogSource) -> IngestResult:
    """Return what becomes of a log whose content another call has committed as ``run_id`` meanwhile: that run, if it is of this recipe."""
    if made is not None and made.log is not None:
        same_as = " + ".join(made.log.source.paths)
        return make_result(source, "unchanged", made, str(result.sha256), same_as=same_as)
    return _fail_for_now(result, f"another call ingested the same log as run {run_id} at the same time")


def _fail_for_now(result: IngestResult, reason: str) -> IngestResult:
    """Return that a log has failed by what another call did meanwhile."""
    problem, findings = f"{result.log}: {reason}; run the command again", find_failure(result.log, "StoreError")
    return IngestResult(
        result.log, "failed", causes=findings, problems=(problem,), sha256=result.sha256, transient=True
    )


def _make_entries(log: LogWriter, task: IngestTask, ingested: Ingested) -> tuple[Entries, tuple[str, ...]]:
    """Return what a commit has of the result of a log, and what is to be said of runs that it supersedes."""
    source, result, sha256 = ingested.source, ingested.result, ingested.result.sha256
    entries, notes = Entries(runs=ingested.rows), list[str]()
    new = sha256 is not None and bool(source.files) and not log.state.has_seen(source.sighting(sha256))
    run_id = result.run.run_id if result.run else None
    if run_id and sha256 and (new or result.status != "unchanged" or run_id in log.state.parties):
        try:
            superseded, notes = find_superseded(log.store, log.state, source, run_id, sha256)
            entries = replace(entries, superseded=tuple(superseded))
        except StoreError as error:
            notes += error.problems
    if result.status == "failed" and not result.transient:
        task, content = replace(task, source=replace(source, sha256=sha256)), sha256 or source.files_digest
        failure = Failure(task.failure_key, content, source.origins, result.problems, __version__, result.findings)
        entries = replace(entries, failed=(failure,))
    return replace(entries, seen=(source.sighting(sha256),) if new and sha256 else ()), tuple(notes)


def _judge_result(state: State, result: IngestResult, source: LogSource, *, before: State) -> IngestResult:
    """Return a result with whether its problems were known before, and are acknowledged."""
    if result.status == "failed":
        problem = make_failure(result.sha256 or source.files_digest, source.origins)
        return replace(result, acknowledged=result.acknowledged or is_acknowledged([problem], state))
    if result.run is None or not select_problems(result.findings):
        return result
    problems = find_problems(result.run)
    reported = {problem.key for old in before.find_rows(result.run.run_id) for problem in find_problems(old)}
    return replace(
        result,
        known=all(problem.key in reported for problem in problems),
        acknowledged=is_acknowledged(problems, state),
    )


_CONTAINED = 0.9
"""Where so large a share of an older run's measurements is in the newer one, it is the same recording, and loses nothing."""


def find_superseded(
    store: Store, state: State, source: LogSource, run_id: str, sha256: str
) -> tuple[list[Superseded], list[str]]:
    """Return which runs the content of a log supersedes, and a line about every run that was made from the same path before.

    A run counts again when its recording is seen again, wherever that is. A log that is as it was is looked at only where its run
    has a part in that.
    """
    found, notes, gone, parties = list[Superseded](), list[str](), state.superseded, state.parties
    if run_id in gone:
        found.append(Superseded(run_id, None))
        notes.append(f"run {run_id} counts again: its log is available again")
    seen = {sighting.sha256 for sighting in state.seen.get(source.lineage, ())}
    new = sha256 not in seen
    earlier = seen - {sha256} if new or run_id in parties else ()
    for older in sorted(filter(None, map(state.find_run, earlier))):
        if older != run_id and older not in gone and (new or older in parties):
            share = _compute_shared_fraction(store, older, run_id)
            elsewhere = _describe_elsewhere(state, older, source) if share >= _CONTAINED else ""
            if share >= _CONTAINED and not elsewhere:
                found.append(Superseded(older, run_id))
                notes.append(f"run {older}, made from this path before, is superseded: this log contains its content")
            elif new:
                held = f"this log contains {share:.0%} of it" if share else "its content differs"
                why = f"its log is at {elsewhere}" if elsewhere else held
                notes.append(f"run {older}, made from this path before, stays: {why}")
    return found, notes


def _describe_elsewhere(state: State, run_id: str, source: LogSource) -> str:
    """Return where else a run's recording lies, "" where it is gone."""
    contents = {row.log.source.sha256 for row in state.find_rows(run_id) if row.log}
    for lineage, sightings in state.seen.items():
        for sighting in sightings if lineage != source.lineage else ():
            if sighting.sha256 in contents and sighting.size_and_time and is_there(sighting):
                return " + ".join(sighting.log)
    return ""


def _compute_shared_fraction(store: Store, older: str, newer: str) -> float:
    """Return the share of a run's measurements that another has too."""
    shared = every = 0
    mine_of, theirs_of = store.find_stream_files(older), store.find_stream_files(newer)
    for role, path in mine_of.items():
        try:
            mine, theirs = read_table(path), read_table(theirs_of[role]) if role in theirs_of else None
        except StoreError:
            continue
        every += mine.num_rows
        shared += 0 if theirs is None else _count_shared_rows(mine, theirs)
    return shared / every if every else 0.0


def _count_shared_rows(mine: pa.Table, theirs: pa.Table) -> int:
    """Count the rows of one table that are in the other: recorded at one instant with the same values."""
    floating = [field.name for field in mine.schema if pa.types.is_floating(field.type)]
    names = ["log_time_ns", *(name for name in floating if name in theirs.column_names)]
    others = set(encode_rows(theirs, names))
    return sum(row in others for row in encode_rows(mine, names))
