"""State of every log of a store's sources and of its outputs, with the reason, and what to do.

Only size and time of a log are read.
"""

from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TypeAlias

from tcpipe.errors import UsageError, clean_lines
from tcpipe.formats.atomic import Location, make_scratch_directory
from tcpipe.formats.documents import State
from tcpipe.formats.finding_lines import MOST_LINES, format_count, format_finding, group_findings
from tcpipe.formats.object_storage import format_path
from tcpipe.formats.recipe_toml import ingest_key, resolve_recipe
from tcpipe.formats.runs import Call, Problem
from tcpipe.pipeline.calls import INGEST, OpenCall, format_duration, list_open_calls
from tcpipe.pipeline.ingest import CallOptions, make_tasks
from tcpipe.pipeline.log_sources import list_log_sources, select_shard
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.plan import LOG_STATES, TO_DO, TROUBLE, IngestTask, LogState, PlannedLog, plan_ingestion
from tcpipe.pipeline.problems import find_incomplete_maps, find_incomplete_runs, find_stale_outputs, make_missing
from tcpipe.recipe import Recipe
from tcpipe.store import open_store
from tcpipe.tables.findings import Findings

_MOST_NAMES = 3
_MOST_CALLS = 7
_IN_WORDS: Mapping[LogState, str] = {"failed_permanent": "failed permanently", "failed_transient": "failed temporarily"}


@dataclass(frozen=True, slots=True)
class Group:
    """Logs in one state for one reason."""

    state: LogState
    cause: str
    logs: tuple[str, ...]
    size_bytes: int

    def __str__(self) -> str:
        """Return the group as one line."""
        more = f" and {len(self.logs) - _MOST_NAMES} more" if len(self.logs) > _MOST_NAMES else ""
        names = f": {', '.join(self.logs[:_MOST_NAMES])}{more}" if self.state != "done" else ""
        cause = f", {self.cause}" if self.cause else ""
        return f"{len(self.logs):>7} {_format_words(self.state)}{cause}{names}"


@dataclass(frozen=True, slots=True)
class Status:
    """State of the logs of a store's sources, and of its outputs."""

    store: str
    to_do_now: str
    """Next action for the user, as one line."""
    sources: tuple[str, ...]
    counts: Mapping[LogState, int]
    """Logs by state."""
    groups: tuple[Group, ...]
    """By state and cause."""
    problems: Findings
    """Sources that cannot be read, runs that are not complete, calls that were killed, damaged documents,
    outputs that are out of date or whose last call failed."""
    gone: tuple[str, ...]
    """Sources that cannot be read and that only calls before the latest ingest were given."""
    superseded_runs: int
    open_calls: tuple[OpenCall, ...]
    """Calls that have begun and not ended."""
    history: tuple[Call, ...]
    """The latest calls, the last one first."""
    runs: int
    """Under the current recipe."""
    findings: Mapping[str, int]
    """Number of runs with each warning and error, by code, the worst first."""
    exit_code: int
    """3 if a log, a run or an output has a problem, else 0."""

    def __str__(self) -> str:
        """Return the lines as one text."""
        counts_text = ", ".join(f"{count} {_format_words(state)}" for state, count in self.counts.items()) or "no logs"
        lines = [self.to_do_now, f"{self.store}: {counts_text}", *(str(group) for group in self.groups)]
        lines += [f"of earlier calls: {line}" for line in self.gone]
        lines += [f"{self.superseded_runs} superseded runs"] if self.superseded_runs else []
        lines += [f"{call.state}: {call}" for call in self.open_calls if call.state != "killed"]
        lines += [f"  {format_count(code, count, self.runs)}" for code, count in [*self.findings.items()][:MOST_LINES]]
        lines += ["history:"] if self.history else []
        return clean_lines([*lines, *(_format_call(call) for call in self.history[:_MOST_CALLS])])


def find_log_states(options: IngestOptions, *, create: bool = False) -> Status:
    """Return the state that a call of ingest with these options would find; with ``create`` the store need not exist.

    Without logs, it uses those that the latest calls of ingest were given, and the options of these calls. A log that
    was written more recently than ``min_age_s`` is growing.

    Raises `StoreError`, `UsageError`, `RecipeError`: there is no store, or nothing is known of its sources.
    """
    ruling = resolve_recipe(options.recipe)
    opened = open_store(options.store, create=create)
    state, given = opened.scan(), [str(log) for log in options.logs]
    asked = _list_asked(state)
    if not given and not state.calls:
        raise UsageError(f"{opened.root}: no earlier call of ingest is known; give the logs or their folders")
    tasks, missing = _find_tasks(options, asked, opened.root, ruling)
    steps = plan_ingestion(tasks, state)
    open_calls, acknowledged = list_open_calls(state), state.acknowledged
    killed = [call for call in open_calls if call.state == "killed"]
    latest_logs = given or next(iter(asked.values()), ((), CallOptions()))[0]
    problems = [
        *state.problems,
        *find_incomplete_runs(state),
        *find_incomplete_maps(state),
        *(call.problem for call in killed),
    ]
    problems += [make_missing(path, state) for path in missing if path in latest_logs]
    problems += [] if create else find_stale_outputs(opened, state)
    problems = [problem for problem in problems if problem.key not in acknowledged]
    groups = tuple(_iterate_groups(steps))
    current = [run.facts for run in opened.runs(state) if run.facts.ingest_key == ingest_key(ruling)]
    warnings = ((run.run_id, [each for each in run.findings if each.severity != "note"]) for run in current)
    by_code = group_findings(warnings)
    return Status(
        store=str(opened.root),
        to_do_now=_describe_first(problems, groups),
        sources=tuple(format_path(log) for log in given),
        counts=dict(sum((Counter({group.state: len(group.logs)}) for group in groups), Counter())),
        groups=groups,
        problems=tuple(problem.finding for problem in problems),
        gone=tuple(chain(*(lines for path, lines in missing.items() if path not in latest_logs))),
        superseded_runs=sum(bool(row.superseded_by) for row in state.runs.values()),
        open_calls=tuple(call for call in open_calls if call.problem.key not in acknowledged),
        history=tuple(call for _, call in state.calls if call.exit_code is not None)[:_LATEST_CALLS],
        runs=len(current),
        findings={group.code: len(group.of) for group in by_code},
        exit_code=3 if problems or any(group.state in TROUBLE for group in groups) else 0,
    )


_LATEST_CALLS = 50
Asked: TypeAlias = Mapping[str, tuple[tuple[str, ...], CallOptions]]
"""By log or folder: all inputs and options of the last call of ingest with it; the latest call comes first."""


def _list_asked(state: State) -> Asked:
    asked = dict[str, tuple[tuple[str, ...], CallOptions]]()
    for _, call in state.calls:
        if call.command == INGEST and call.exit_code != UsageError.exit_code:
            how = CallOptions(**call.options)  # type: ignore[arg-type]  # written by ingest
            for log in call.works_on:
                asked.setdefault(log, (call.works_on, how))
    return asked


def _find_tasks(
    options: IngestOptions, asked: Asked, root: Location, recipe: Recipe
) -> tuple[list[IngestTask], dict[str, tuple[str, ...]]]:
    """Return the tasks of the given logs, or of those of earlier calls with equal options; and inputs without logs."""
    logs = [str(log) for log in options.logs]
    calls = dict(asked.values())
    groups = [(logs, options)] if logs else []
    for works_on, how in [] if logs else calls.items():
        own_logs = [log for log in works_on if asked[log][0] == works_on]
        robot = options.robot or how.robot
        same_options = replace(options, robot=robot, as_one=how.as_one, msgdef=how.message_definitions)
        groups.append((own_logs, same_options))
    tasks, missing = list[IngestTask](), dict[str, tuple[str, ...]]()
    for own_logs, same_options in groups:
        with make_scratch_directory() as staging:
            found = list_log_sources(own_logs, as_one=same_options.as_one, staging=staging, tables=recipe.tables)
        missing |= found.problems
        new = make_tasks(found.sources, same_options, root, recipe)
        new = new if options.shard is None else [new[at] for at in select_shard(found.sources, options.shard)]
        known = {task.source.origins for task in tasks}  # of later calls
        tasks += [task for task in new if task.source.origins not in known]
    return tasks, missing


def _describe_first(problems: Sequence[Problem], groups: Sequence[Group]) -> str:
    """Return the next step: the first problem, else the first problem of logs, else the logs to ingest."""
    if problems:
        more = f" (and {len(problems) - 1} more problems)" if len(problems) > 1 else ""
        return f"to do now: {format_finding(problems[0].finding)}{more}"
    for group in groups:
        if group.state == "failed_transient":
            return f"to do now: correct the cause, then tcpipe ingest ({_count_logs(group.logs)}): {group.cause}"
        if group.state in TROUBLE:
            them = "it" if len(group.logs) == 1 else "them"
            return f"to do now: look at {_count_logs(group.logs)} ({_format_words(group.state)}), or acknowledge {them}"
    waiting = list(chain(*(group.logs for group in groups if group.state in TO_DO)))
    return f"to do now: tcpipe ingest ({_count_logs(waiting)})" if waiting else "nothing to do"


def _count_logs(logs: Sequence[str]) -> str:
    return f"{len(logs)} log{'s' * (len(logs) != 1)}"


def _iterate_groups(steps: Iterable[PlannedLog]) -> Iterator[Group]:
    """Yield logs of one state with findings of equal codes and subjects; without findings, of equal cause."""
    groups: dict[tuple[LogState, Hashable], list[PlannedLog]] = {}
    for step in steps:
        with_equal_remedy = frozenset(
            (finding.code, None if finding.subject.kind in ("log", "run") else finding.subject)
            for finding in step.findings
        )
        groups.setdefault((step.state, with_equal_remedy or step.cause), []).append(step)
    for (state, _), group in sorted(groups.items(), key=lambda item: (LOG_STATES.index(item[0][0]), -len(item[1]))):
        causes = list(dict.fromkeys(step.cause for step in group))
        cause = causes[0] if len(causes) == 1 else f"{len(causes)} reasons, the first: {causes[0]}"
        yield Group(
            state,
            cause,
            tuple(step.task.source.name for step in group),
            sum(step.task.source.size_bytes for step in group),
        )


def _format_words(state: LogState) -> str:
    return _IN_WORDS.get(state, state)


def _format_call(call: Call) -> str:
    """Return a call as one line."""
    counts = ", ".join(f"{count} {what}" for what, count in call.counts.items() if count) or "nothing"
    times = f"{format_duration(call.wall_s)}, CPU {format_duration(call.cpu_s)}"
    why = f": {call.message.partition(chr(10))[0]}" if call.exit_code and call.message else ""
    return f"  {call.begin[:19]} {call.command}: {counts}; {times}, exit code {call.exit_code}{why}"
