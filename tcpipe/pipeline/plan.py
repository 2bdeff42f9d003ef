"""What each log needs: the one decision that ``ingest`` executes and that ``ingest --dry-run`` and ``status`` show."""

from __future__ import annotations

import time
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from tcpipe import __version__
from tcpipe.formats.commits import CallRecord, Failure, State
from tcpipe.formats.finding_lines import describe_finding
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.pipeline.ingest_task import IngestTask, check_age
from tcpipe.pipeline.problems import find_problems, is_acknowledged, make_failure
from tcpipe.tables.findings import Finding

Standing: TypeAlias = Literal[
    "done", "partial", "empty", "pending", "outdated", "growing", "failed_permanent", "failed_transient", "quarantined", "superseded"
]  # fmt: skip

STANDINGS: tuple[Standing, ...] = get_args(Standing)
TO_DO: tuple[Standing, ...] = ("pending", "outdated", "failed_transient")
"""What the next ingest works on."""
TROUBLE: tuple[Standing, ...] = ("failed_permanent", "failed_transient", "partial", "empty")
"""What somebody should look at."""


@dataclass(frozen=True, slots=True)
class Step:
    """What a log needs."""

    task: IngestTask
    standing: Standing
    cause: str = ""
    made: RunFacts | None = None
    """The ingestion of the log as it would be made now, where there is one."""
    failure: Failure | None = None
    """Why the log is not tried again."""
    findings: tuple[Finding, ...] = ()
    """What is wrong with it, where that is known as data."""
    has_failed: bool = False
    """Whether it failed before, under whatever conditions."""

    @property
    def is_todo(self) -> bool:
        """Whether the next ingest works on it."""
        return self.standing in TO_DO


@dataclass(frozen=True, slots=True)
class _Known:
    """A state by content."""

    state: State
    made: Mapping[str, list[RunFacts]]
    failures: Mapping[str, list[Failure]]
    passing: Mapping[str, str]
    broken: Iterable[str]


def plan(
    tasks: Iterable[IngestTask], state: State, *, broken: Container[tuple[str, str]] = (), now_ns: int | None = None
) -> tuple[Step, ...]:
    """Return what each log needs.

    Parameters
    ----------
    tasks : the logs, with the hashes that are remembered of them, and how they are to be ingested.
    state : what the log of the store says.
    broken : runs and recipes of which files are gone.
    now_ns : the time; that of the clock.
    """
    now_ns = time.time_ns() if now_ns is None else now_ns
    made, failures, names = dict[str, list[RunFacts]](), dict[str, list[Failure]](), set[str]()
    for key, row in state.runs.items():
        if key in broken:
            names.add(row.run_id)
        elif row.log is not None:
            made.setdefault(row.log.source.sha256, []).append(row)
    for failure in state.failed.values():
        failures.setdefault(failure.content, []).append(failure)
    known = _Known(state, made, failures, list_transient_failures(state.calls), names)
    return tuple(_decide(task, known, now_ns) for task in tasks)


def _decide(task: IngestTask, known: _Known, now_ns: int) -> Step:
    source, sha256 = task.source, None if task.force else task.source.sha256
    made = known.made.get(sha256, []) if sha256 else []
    current = next((row for row in made if task.is_made_by(row)), None)
    if current is not None and task.tags.items() <= current.tags.items():
        return _stand(task, current, known.state)
    failed = None if task.force or task.retry_failed else known.state.failed.get(task.failure_key)
    if failed is not None:
        acknowledged = is_acknowledged([make_failure(failed.content, failed.log)], known.state)
        cause = _remove_name("".join(failed.problems[:1]), task)
        standing: Standing = "quarantined" if acknowledged else "failed_permanent"
        return Step(task, standing, cause, failure=failed, findings=failed.findings)
    if check_age(task, now_ns):
        return Step(task, "growing", has_failed=_describe_content(task) in known.failures)
    if source.name in known.passing:
        return Step(task, "failed_transient", _remove_name(known.passing[source.name], task))
    if current is not None:
        return Step(task, "outdated", "its tags change")
    return (
        Step(task, "outdated", _describe_outdated(made[-1], task))
        if made
        else Step(task, "pending", _describe_pending(task, known), has_failed=_describe_content(task) in known.failures)
    )


def _describe_content(task: IngestTask) -> str:
    return task.source.sha256 or task.source.files_digest


def _stand(task: IngestTask, made: RunFacts, state: State) -> Step:
    """Return the step of a log that is in the store as it would be made now."""
    if made.superseded_by:
        return Step(task, "superseded", "a longer recording has taken its place", made)
    problems = find_problems(made)
    if not problems:
        return Step(task, "done", made=made)
    if is_acknowledged(problems, state):
        return Step(task, "done", f"{made.defect}, acknowledged", made)
    findings = tuple(problem.finding for problem in problems)
    cause = describe_finding((*made.damage, *findings)[0])
    return Step(task, "empty" if made.is_empty else "partial", cause, made, findings=findings)


def _describe_pending(task: IngestTask, known: _Known) -> str:
    """Return why a log that was seen before is to be ingested; "" of a new one."""
    sha256 = task.source.sha256
    if before := known.failures.get(_describe_content(task)):
        acknowledged = is_acknowledged([make_failure(of.content, of.log) for of in before], known.state)
        return f"{_describe_failure(before, task)}{', acknowledged' if acknowledged else ''}; to be tried again"
    if task.force:
        return "to be done again if it is there already"
    if sha256 and any(run_id.endswith(f"-{sha256[:8]}") for run_id in known.broken):
        return "files of its run are missing"
    return "its content is another than before" if task.source.lineage in known.state.seen and not sha256 else ""


def _describe_failure(before: Sequence[Failure], task: IngestTask) -> str:
    if task.force or task.retry_failed:
        return "failed before"
    latest = max(of.version for of in before)
    if __version__ not in {of.version for of in before}:
        return f"failed with {f'tcpipe {latest}' if latest else 'another version'}"
    return "failed under another recipe, for another robot or with other message definitions"


def _describe_outdated(made: RunFacts, task: IngestTask) -> str:
    """Return in which an ingestion differs from what would be made now."""
    if made.ingest_key != ingest_key(task.recipe):
        return f"made under another recipe ({made.recipe_id})"
    if made.tcpipe_version != __version__:
        return f"made by tcpipe {made.tcpipe_version}"
    return "made for another robot, or with other message definitions"


def list_transient_failures(calls: Sequence[CallRecord]) -> dict[str, str]:
    """Return the logs whose latest failure may pass, and what that was."""
    found: dict[str, str] = {}
    for call in reversed(calls):
        found.update(call.failed)
    return found


def _remove_name(line: str, task: IngestTask) -> str:
    """Return what is wrong without the name of the log."""
    for name in (task.source.name, *task.source.origins):
        line = line.replace(f"{name}: ", "").replace(name, "it")
    return line
