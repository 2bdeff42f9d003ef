"""Tasks and results of ``ingest``, and the state and next step of each log, which ``--dry-run`` and ``status`` show."""

import time
import traceback
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias, TypeVar, get_args

from tcpipe import __version__
from tcpipe.errors import TcpipeError, clean_line, hide_secrets
from tcpipe.formats.atomic import Location
from tcpipe.formats.documents import State, make_key
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.runs import Call, LogFailure, RunFacts, find_problems, make_failure
from tcpipe.pipeline.log_sources import LogSource, find_failure, is_transient, recall_hash
from tcpipe.progress import logger
from tcpipe.recipe import Recipe
from tcpipe.tables.findings import Findings, Verdict, select_problems
from tcpipe.tables.levels import DATA_MODEL_VERSION, RESULTS_VERSION

R = TypeVar("R")

Status = Literal["done", "unchanged", "damaged", "empty", "failed", "waiting"]


@dataclass(frozen=True, slots=True)
class IngestTask:
    """A log to ingest, and the settings for it."""

    source: LogSource
    store: Location
    recipe: Recipe
    robot: str | None
    tags: Mapping[str, str]
    force: bool
    message_definitions: Path | None = None
    """A directory of .msg files for types that the log does not define."""
    definitions: str = ""
    """Their `definitions_key`."""
    retry_failed: bool = False
    min_age_s: float = 0.0

    def is_made_by(self, made: RunFacts) -> bool:
        """Return whether a run is up to date; each version reads damaged logs again."""
        same_robot = made.robot_requested == self.robot or (self.robot is not None and made.robot == self.robot)
        same_version = (made.data_model_version, made.results_version) == (DATA_MODEL_VERSION, RESULTS_VERSION)
        same_version &= made.tcpipe_version == __version__ or not made.damage
        same_settings = made.ingest_key == ingest_key(self.recipe) and made.message_definitions == self.definitions
        return same_version and same_settings and same_robot

    @property
    def failure_key(self) -> str:
        """Key of a failure because of the log's content: the same content with the same settings fails again."""
        content = self.source.sha256 or self.source.files_digest
        return make_key(content, __version__, ingest_key(self.recipe), self.robot, self.definitions)


@dataclass(frozen=True, slots=True)
class IngestResult:
    """Result of one log."""

    log: str
    status: Status
    run: RunFacts | None = None
    """Run in the store; None if the log waits or failed."""
    verdict: Verdict | None = None
    """Findings of the run."""
    causes: Findings = ()
    """Findings on why the log failed."""
    problems: tuple[str, ...] = ()
    """Why it failed, as lines."""
    same_as: str | None = None
    """The log from which the same recording was ingested before, under another path; it is one run."""
    sha256: str | None = None
    notes: tuple[str, ...] = ()
    """Notes: why it waits, which runs it supersedes."""
    transient: bool = False
    """Whether the failure may be temporary: a full disk, a killed worker."""
    known: bool = False
    """Whether it failed before and was not tried again, or the problem of its run was reported before."""
    acknowledged: bool = False
    """Whether a person has acknowledged its problem (`tcpipe acknowledge`)."""
    traceback: str | None = None
    """Origin of an internal error."""

    @property
    def findings(self) -> Findings:
        """On the run, or on the log that failed."""
        return self.run.findings if self.run else self.causes

    @property
    def is_new_problem(self) -> bool:
        """Whether it has a problem that is neither reported before nor acknowledged."""
        is_wrong = self.status == "failed" or bool(select_problems(self.findings))
        return is_wrong and not self.known and not self.acknowledged


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine(IngestResult):
    """Result of one log, as ``ingest --json`` prints it when the log ends."""

    kind: Literal["log"] = "log"
    is_new_problem: bool = False


def make_result(source: LogSource, status: Status, made: RunFacts, sha256: str, *, same_as: str | None) -> IngestResult:
    """Return the result of a log whose run is in the store."""
    if status == "done":
        status = made.defect or status
    return IngestResult(source.name, status, made, made.verdict, same_as=same_as, sha256=sha256)


def check_age(task: IngestTask, now_ns: int | None = None) -> IngestResult | None:
    """Return the result of a log that is too young and has to wait, else None."""
    youngest_ns = max((time_ns for _, time_ns in task.source.files), default=0)
    age_s = ((time.time_ns() if now_ns is None else now_ns) - youngest_ns) / 1e9
    if not task.source.files or age_s >= task.min_age_s or not task.min_age_s:
        return None
    note = f"it was written {max(age_s, 0.0):.0f} s ago; it is ingested when it is {task.min_age_s:g} s old"
    return IngestResult(task.source.name, "waiting", notes=(note,))


def make_died_result(source: LogSource) -> IngestResult:
    """Return the result of a log whose process has died."""
    problem = f"{source.name}: its worker process died (killed, or out of memory); run it again"
    findings = find_failure(source.name, "WorkerDied")
    return IngestResult(source.name, "failed", causes=findings, problems=(problem,), transient=True)


def mark_reported(task: IngestTask, act: Callable[[IngestTask], R]) -> R | IngestResult:
    """Apply a function to a task; return an error as the result of its log."""
    try:
        return act(task)
    except Exception as error:  # noqa: BLE001  also internal errors, so that other logs go on
        for line in "".join(traceback.format_exception(error)).splitlines():
            logger.debug("%s: %s", task.source.name, line)
        problems, trace = _format_error(error, task.source)
        causes = error.findings if isinstance(error, TcpipeError) else ()
        return IngestResult(
            task.source.name,
            "failed",
            causes=(*find_failure(task.source.name, type(error).__name__), *causes),
            problems=problems,
            transient=is_transient(error) or not task.source.files,
            traceback=trace,
        )


def _format_error(error: Exception, source: LogSource) -> tuple[tuple[str, ...], str | None]:
    """Return lines on the errors of a log, and on the origin of an internal error."""
    if isinstance(error, TcpipeError):
        return _add_log_name(source, error.problems), None
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return _add_log_name(source, (clean_line(f"{where}{error.strerror or error}"),)), None
    if isinstance(error, MemoryError):
        return (f"{source.name}: not enough memory; fewer --jobs need less",), None
    what = f"internal error, {type(error).__name__}: {error}; please report it (tcpipe --debug shows where)"
    return (clean_line(f"{source.name}: {what}"),), hide_secrets("".join(traceback.format_exception(error)))


def _add_log_name(source: LogSource, problems: tuple[str, ...]) -> tuple[str, ...]:
    """Return the problems with the log's name in the first, unless a file of it is named there."""
    if any(clean_line(origin) in problems[0] for origin in source.origins):
        return problems
    return (f"{source.name}: {problems[0]}", *problems[1:])


LogState: TypeAlias = Literal[
    "done", "partial", "empty", "pending", "outdated", "growing", "failed_permanent", "failed_transient", "quarantined", "superseded"
]  # fmt: skip

LOG_STATES: tuple[LogState, ...] = get_args(LogState)
TO_DO: tuple[LogState, ...] = ("pending", "outdated", "failed_transient")
"""States of logs that the next ingest reads."""
TROUBLE: tuple[LogState, ...] = ("failed_permanent", "failed_transient", "partial", "empty")
"""States of logs that need attention."""


@dataclass(frozen=True, slots=True)
class PlannedLog:
    """State of a log, and its next step."""

    task: IngestTask
    state: LogState
    cause: str = ""
    made: RunFacts | None = None
    """The existing ingestion of the log with the current settings, if any."""
    failure: LogFailure | None = None
    """Reason why the log is not tried again."""
    findings: Findings = ()
    """Findings on its problems."""

    @property
    def is_todo(self) -> bool:
        """Whether the next ingest works on it."""
        return self.state in TO_DO


@dataclass(frozen=True, slots=True)
class _Known:
    """Runs and failures of a store by the hash of their log, and temporary failures by the name of their log."""

    state: State
    acknowledged: Collection[str]
    made: Mapping[str, list[RunFacts]]
    failures: Mapping[str, list[LogFailure]]
    passing: Mapping[str, str]


def plan_ingestion(tasks: Iterable[IngestTask], state: State) -> tuple[PlannedLog, ...]:
    """Return the work for each log that is to be ingested now."""
    made, failures = dict[str, list[RunFacts]](), dict[str, list[LogFailure]]()
    for row in state.runs.values():
        made.setdefault(row.log.sha256, []).append(row)
    for failure in state.failed.values():
        failures.setdefault(failure.content, []).append(failure)
    passing = list_transient_failures([call for _, call in state.calls])
    known = _Known(state, state.acknowledged, made, failures, passing)
    now_ns = time.time_ns()
    return tuple(_decide(task, known, now_ns) for task in tasks)


def _decide(task: IngestTask, known: _Known, now_ns: int) -> PlannedLog:  # noqa: PLR0911  one for each state
    """Return the state of a log and the next step for it."""
    if not task.force:
        task = replace(task, source=recall_hash(task.source, known.state.find_seen(task.source.origins)))
    source, sha256 = task.source, None if task.force else task.source.sha256
    made = known.made.get(sha256, []) if sha256 else []
    current = next((row for row in made if task.is_made_by(row)), None)
    is_there = current is not None and (not current.blob or known.state.has_payload(current))
    if current is not None and is_there and task.tags.items() <= current.tags.items():
        return _stand(task, current, known)
    failed = None if task.force or task.retry_failed else known.state.failed.get(task.failure_key)
    if failed is not None:
        is_acknowledged = make_failure(failed.content, failed.log).key in known.acknowledged
        cause = _remove_name("".join(failed.problems[:1]), task)
        state: LogState = "quarantined" if is_acknowledged else "failed_permanent"
        return PlannedLog(task, state, cause, failure=failed, findings=failed.findings)
    if source.name in known.passing:  # it was old enough before
        return PlannedLog(task, "failed_transient", _remove_name(known.passing[source.name], task))
    if check_age(task, now_ns):
        return PlannedLog(task, "growing")
    if current is not None:
        return PlannedLog(
            task, *(("outdated", "its tags change") if is_there else ("pending", "the files of its run are missing"))
        )
    if made:
        return PlannedLog(task, "outdated", _describe_outdated(made[-1], task))
    return PlannedLog(task, "pending", _describe_pending(task, known))


def _stand(task: IngestTask, made: RunFacts, known: _Known) -> PlannedLog:
    """Return the state of a log whose run in the store is up to date."""
    if not made.blob:
        return PlannedLog(task, "superseded", "its run was pruned; --force ingests it again", made)
    if made.superseded_by:
        return PlannedLog(task, "superseded", "superseded by a longer log", made)
    problems = find_problems(made)
    if not problems:
        return PlannedLog(task, "done", made=made)
    if all(problem.key in known.acknowledged for problem in problems):
        return PlannedLog(task, "done", f"{made.defect}, acknowledged", made)
    findings = tuple(problem.finding for problem in problems)
    cause = describe_finding((*made.damage, *findings)[0])
    return PlannedLog(task, "empty" if made.is_empty else "partial", cause, made, findings=findings)


def _describe_pending(task: IngestTask, known: _Known) -> str:
    """Return why a known log is to be ingested again; "" for a new one."""
    if before := known.failures.get(task.source.sha256 or task.source.files_digest):
        is_acknowledged = all(make_failure(each.content, each.log).key in known.acknowledged for each in before)
        return f"{_describe_failure(before, task)}{', acknowledged' if is_acknowledged else ''}; to be tried again"
    if task.force:
        return "to be ingested again if present"
    return "its content has changed" if known.state.find_seen(task.source.origins) and not task.source.sha256 else ""


def _describe_failure(before: Sequence[LogFailure], task: IngestTask) -> str:
    if task.force or task.retry_failed:
        return "failed before"
    latest = max(failure.version for failure in before)
    if __version__ not in {failure.version for failure in before}:
        return f"failed with {f'tcpipe {latest}' if latest else 'another version'}"
    return "failed under another recipe, for another robot or with other message definitions"


def _describe_outdated(made: RunFacts, task: IngestTask) -> str:
    """Return the settings in which an ingestion differs from the current ones."""
    if made.ingest_key != ingest_key(task.recipe):
        return f"made under another recipe ({made.recipe_id})"
    if made.results_version != RESULTS_VERSION:
        return f"made with version {made.results_version} of the results, which now are version {RESULTS_VERSION}"
    if made.damage and made.tcpipe_version != __version__:
        return f"its damaged log was read by tcpipe {made.tcpipe_version}"
    return "made for another robot, or with other message definitions"


def list_transient_failures(calls: Sequence[Call]) -> dict[str, str]:
    """Return the logs whose latest failure may be temporary, with the failure; ``calls`` begin with the latest."""
    failures: dict[str, str] = {}
    for call in reversed(calls):
        failures.update(call.failed)
    return failures


def _remove_name(line: str, task: IngestTask) -> str:
    """Return the problem without the name of the log."""
    for name in (task.source.name, *task.source.origins):
        line = line.replace(f"{name}: ", "").replace(name, "it")
    return line
