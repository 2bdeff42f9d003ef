"""Ingestion of logs into labelled segments of the store: parallel tasks, one a log, each complete or without effect."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Literal, TypeAlias

from tcpipe import __version__
from tcpipe.errors import LogError, StoreError, TcpipeError, UsageError, clean_line, list_first
from tcpipe.execution import refuse_import_of_script, run_all
from tcpipe.formats.atomic import Location, make_scratch_directory
from tcpipe.formats.documents import State, make_key
from tcpipe.formats.json_files import Json
from tcpipe.formats.object_storage import is_presigned, make_absolute
from tcpipe.formats.recipe_toml import ingest_key, load_profiles, resolve_recipe
from tcpipe.formats.runs import LogFailure, LogSnapshot, find_lineage, find_problems, make_failure
from tcpipe.pipeline.calls import INGEST, RunningCall, record_call
from tcpipe.pipeline.ingest_run import Ingested, find_twin, ingest_one
from tcpipe.pipeline.log_sources import LogSource, find_failure, list_log_sources, make_definitions_key, select_shard
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.plan import (
    IngestResult,
    IngestTask,
    PlannedLog,
    check_age,
    make_died_result,
    make_result,
    plan_ingestion,
)
from tcpipe.pipeline.problems import is_acknowledged
from tcpipe.progress import logger
from tcpipe.recipe import Recipe, TimeWindow
from tcpipe.store import is_store, open_store
from tcpipe.tables.findings import select_problems
from tcpipe.tables.levels import RESULTS_VERSION
from tcpipe.tables.options import as_function


def make_tasks(
    sources: Iterable[LogSource], options: IngestOptions, root: Location, recipe: Recipe
) -> list[IngestTask]:
    """Return the task of each log; on a cluster, whose workers are elsewhere, with absolute paths."""
    definitions = None if options.msgdef is None else Path(options.msgdef)
    if options.cluster is not None:
        root = root.absolute() if isinstance(root, Path) else root
        definitions = definitions and definitions.absolute()
    robot, tags = options.robot or recipe.robot, dict(options.tag or {})
    how = (root, recipe, robot, tags, options.force, definitions, make_definitions_key(definitions))
    return [IngestTask(source, *how, options.retry_failed, options.min_age) for source in sources]


Item: TypeAlias = tuple[int, IngestTask]


def iterate_rounds(steps: Sequence[PlannedLog]) -> list[list[Item]]:
    """Return the logs to ingest in two rounds: logs whose size an earlier log has wait, since both may be equal."""
    sizes, rounds = set[int](), [list[Item](), list[Item]()]
    for index, step in enumerate(steps):
        if step.is_todo:
            size_bytes = step.task.source.size_bytes
            rounds[size_bytes in sizes].append((index, step.task))
            sizes.add(size_bytes)
    return rounds


_NO_LOGS = "no logs given; expected .mcap, .bag or .db3 files, ROS 2 bag directories, or folders of them or of tables"


@dataclass(frozen=True, slots=True)
class IngestSummary:
    """Results of the logs in the order given; ``exit_code`` is the contract's."""

    store: Location
    results: tuple[IngestResult, ...] = field(default_factory=tuple)

    @property
    def is_transient(self) -> bool:
        """Whether a log failed for a reason that may pass."""
        return any(result.transient for result in self.results)

    @property
    def exit_code(self) -> int:
        """0: no new problem; 1: all logs failed; 3: some failed, are damaged or empty."""
        if not any(result.is_new_problem for result in self.results):
            return 0
        return 1 if all(result.status == "failed" for result in self.results) else 3


@dataclass(frozen=True, slots=True)
class SummaryLine:
    """The last line of ``ingest --json``: the results of all logs."""

    recipe: str
    """The file of the recipe, or that it is the defaults."""
    store: str | None
    """None if no store was made."""
    exit_code: int
    transient: bool
    """Whether a log failed for a reason that may pass: the same call may succeed later."""
    results: tuple[IngestResult, ...]
    kind: Literal["summary"] = "summary"


@dataclass(frozen=True, slots=True)
class CallOptions:
    """Options of a call of ingest: `tcpipe status` repeats the call with them, and they identify its work."""

    robot: str | None = None
    as_one: bool = False
    message_definitions: str | None = None
    recipe: str | None = None
    """Key of the recipe in use; None if it could not be read. `tcpipe status` uses the one in use at its call."""


def run_ingest(options: IngestOptions) -> IngestSummary:
    """Ingest logs (files, ROS 2 bag directories, folders of them) that the store does not have yet.

    Raises `LogError`, `StoreError`, `RecipeError` or `UsageError` if the call cannot begin; errors of single logs are in
    their results.
    """
    refuse_import_of_script(options.jobs)
    opened = open_store(options.store, create=True)
    options = replace(options, logs=list(options.logs))
    given = tuple(make_absolute(path) for path in options.logs if not is_presigned(path))  # signed URLs are not stored
    definitions = options.msgdef and str(Path(options.msgdef).absolute())
    key = None
    with suppress(TcpipeError):  # an error in the recipe is an error of the call, which is recorded
        ruling = resolve_recipe(options.recipe)
        options, key = replace(options, recipe=ruling), ingest_key(ruling)
    how = CallOptions(options.robot, options.as_one, definitions or None, key)
    is_new = not is_store(opened.root)
    if is_new and options.existing_store:
        raise StoreError(f"{opened.root}: there is no store here (--existing-store); is a disk not mounted?")
    recorded = record_call(opened, INGEST, given, how, jobs=options.jobs)
    with recorded as call, make_scratch_directory() as staging:
        return _ingest_all(call, options, staging, is_new=is_new)


ingest = as_function(IngestOptions, run_ingest)
"""`tcpipe.ingest`: its keywords are the fields of `IngestOptions`."""


def _ingest_all(call: RunningCall, options: IngestOptions, staging: Path, *, is_new: bool) -> IngestSummary:
    """Ingest the logs of a recorded call; report and return the result of each."""
    ruling, shard, store = resolve_recipe(options.recipe), options.shard, call.store
    robot = options.robot or ruling.robot
    if robot is not None and robot not in (robots := load_profiles(ruling).robots):
        raise UsageError(f"robot {robot!r} is not known; known: {', '.join(sorted(robots))}")
    found = list_log_sources(list(options.logs), as_one=options.as_one, staging=staging, tables=ruling.tables)
    if not found.sources:
        raise (LogError if found.transient else UsageError)(*chain(*found.problems.values()) or [_NO_LOGS])
    sources = found.sources if shard is None else [found.sources[at] for at in select_shard(found.sources, shard)]
    tasks = make_tasks(sources, options, store.root, ruling)
    if options.on_found:
        sizes = {source.name: source.size_bytes for source in sources}
        options.on_found({**dict.fromkeys(map(clean_line, found.problems), 0), **sizes})
    results: dict[int, IngestResult] = {}

    def tell(ended: Iterable[tuple[int, IngestResult]]) -> None:
        for index, result in ended:
            results[index] = result
            if options.on_result:
                options.on_result(result)

    steps = plan_ingestion(tasks, call.state)
    _announce_new_results(steps, call.state)
    missing = (
        IngestResult(name, "failed", causes=find_failure(name, "LogError"), problems=lines, transient=True)
        for name, lines in ((clean_line(path), lines) for path, lines in found.problems.items())
    )
    tell(chain(enumerate(missing, start=-len(found.problems)), _iterate_finished(call.state, steps)))
    if any(step.is_todo for step in steps):
        call.begin()
        if call.error is not None:  # before logs are read for hours
            raise call.error
        if is_new and options.on_note:
            options.on_note(f"new store: {store.root}")
        tell(_iterate_results(call, steps, jobs=options.jobs, cluster=options.cluster))
    summary = IngestSummary(store.root, tuple(results[index] for index in sorted(results)))
    call.is_whole = shard is None
    call.result = _describe_call(summary)
    _warn_of_unmatched_windows(ruling.mask.windows, call.state)
    return summary


def _announce_new_results(steps: Sequence[PlannedLog], state: State) -> None:
    """Log how many runs are made again because this version of tcpipe gives other results."""
    contents = {row.log.sha256 for row in state.runs.values() if row.results_version != RESULTS_VERSION}
    outdated = [step for step in steps if step.state == "outdated" and step.task.source.sha256 in contents]
    if outdated:
        text = "tcpipe %s gives other results (version %d): %d runs are made again"
        logger.warning(text, __version__, RESULTS_VERSION, len(outdated))


_MOST_RUNS = 5  # named in one message


def _warn_of_unmatched_windows(windows: Iterable[TimeWindow], state: State) -> None:
    """Log a line for each pattern of time windows that fits no run of the store."""
    run_ids = sorted({row.run_id for row in state.runs.values()})
    for pattern, window in {time_window.run: time_window for time_window in windows}.items():
        if run_ids and not any(map(window.is_for, run_ids)):
            text = "recipe mask.windows: run = %r fits no run, so its windows have no effect; runs: %s"
            logger.warning(text, pattern, list_first(run_ids, _MOST_RUNS))


def _describe_call(summary: IngestSummary) -> dict[str, Json]:
    """Return the part of a call's record on its work."""
    failed = [result for result in summary.results if result.status == "failed" and not result.known]
    return {
        "exit_code": summary.exit_code,
        "message": "\n".join(problem for result in failed for problem in result.problems[:1]),
        "counts": dict(Counter(result.status for result in summary.results)),
        "failed": {
            result.log: result.problems[0] for result in summary.results if result.transient and result.problems
        },
    }


def _iterate_finished(state: State, steps: Sequence[PlannedLog]) -> Iterator[tuple[int, IngestResult]]:
    """Yield the result of each log that is in the store, failed before, or has to wait."""
    for index, step in enumerate(steps):
        source, made = step.task.source, step.made
        if step.failure is not None:
            result = IngestResult(
                source.name, "failed", problems=step.failure.problems, causes=step.failure.findings, sha256=source.sha256,
                known=True, acknowledged=step.state == "quarantined",
            )  # fmt: skip
            yield index, result
        elif made is not None and not step.is_todo:
            result = make_result(source, "unchanged", made, str(source.sha256), same_as=find_twin(made, source))
            if select_problems(result.findings):
                result = replace(result, known=True, acknowledged=is_acknowledged(find_problems(made), state))
            yield index, result
        elif not step.is_todo:
            yield index, check_age(step.task) or IngestResult(source.name, "waiting")


def _iterate_results(
    call: RunningCall, steps: Sequence[PlannedLog], *, jobs: int, cluster: str | None
) -> Iterator[tuple[int, IngestResult]]:
    """Yield the result of each log with its index, when it ends."""
    known = {problem.key for row in call.state.runs.values() for problem in find_problems(row)}
    for round_ in iterate_rounds(steps):
        with closing(run_all(ingest_one, [task for _, task in round_], jobs=jobs, cluster=cluster)) as outcomes:
            for outcome in outcomes:
                index, task = round_[outcome.index]
                ended = outcome.result or Ingested(task.source, make_died_result(task.source))
                yield index, _record_result(call, task, ended, known)


def _record_result(call: RunningCall, task: IngestTask, ended: Ingested, known: set[str]) -> IngestResult:
    """Record the content of a log, and its failure, in the store; return its result with the state of its problems."""
    source, result, state = ended.source, ended.result, call.state
    try:
        if result.status == "failed" and not result.transient:
            task, content = (
                replace(task, source=replace(source, sha256=result.sha256)),
                result.sha256 or source.files_digest,
            )
            failure = LogFailure(content, source.origins, result.problems, __version__, result.findings)
            call.store.put(state, "failed", task.failure_key, failure)
        if result.sha256 and source.files and result.status != "waiting":
            snapshot = LogSnapshot(source.origins, source.files, result.sha256)
            if state.find_seen(source.origins) != snapshot:
                call.store.put(state, "seen", make_key(find_lineage(source.origins)), snapshot)
    except StoreError as error:
        logger.error("%s", error)
    if result.status == "failed":
        problem = make_failure(result.sha256 or source.files_digest, source.origins)
        return replace(result, acknowledged=result.acknowledged or is_acknowledged([problem], state))
    if result.run is None:
        return result
    problems = find_problems(result.run)
    result = replace(result, notes=(*result.notes, *_note_supersession(call, result)))
    if not problems:
        return result
    is_known = all(problem.key in known for problem in problems)
    return replace(result, known=is_known, acknowledged=is_acknowledged(problems, state))


def _note_supersession(call: RunningCall, result: IngestResult) -> Iterator[str]:
    """Yield which runs the run of a log supersedes, or which run supersedes it."""
    run = result.run
    if run is None or result.status == "unchanged":
        return
    call.state.add_run(run)
    for row in call.state.list_rows():
        if row.run_id == run.run_id and row.recipe_id == run.recipe_id and row.superseded_by:
            yield f"run {row.superseded_by} supersedes it: its log begins in the same way and is longer"
        elif row.superseded_by == run.run_id and row.recipe_id == run.recipe_id:
            yield f"run {row.run_id} is superseded: this log begins in the same way and is longer"
