"""Where every log of a store's sources stands, why, and what is still to do; nothing is read of a log but its size and time."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Literal, get_args

from tcpipe import __version__
from tcpipe.errors import UsageError, plain_lines
from tcpipe.formats.atomic import scratch_directory
from tcpipe.formats.finding_lines import (
    MOST_LINES,
    describe_finding,
    format_count,
    format_loss,
    format_verdict,
    group_findings,
)
from tcpipe.formats.index_files import RunFacts, uncollected
from tcpipe.formats.object_storage import is_url, shown_path
from tcpipe.formats.places import local_output
from tcpipe.formats.recipe_toml import ingest_key, recipe_of
from tcpipe.formats.record_files import Call
from tcpipe.motion.remedies import StoreLoss, losses_of
from tcpipe.pipeline.begun_calls import BegunCall, begun_calls, is_below
from tcpipe.pipeline.calls import INGEST, Estimate, estimate, in_time, latest_calls
from tcpipe.pipeline.ingest_task import IngestTask, too_young
from tcpipe.pipeline.known_runs import KnownRuns, known_runs
from tcpipe.pipeline.known_trouble import Trouble, trouble_of_call, trouble_of_run, trouble_of_waiting
from tcpipe.pipeline.log_sources import FoundLogs, definitions_key, find_sources, in_shard, remembered
from tcpipe.pipeline.store_verdict import judge_runs
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import select_findings
from tcpipe.tables.verdicts import Verdict

State = Literal[
    "done", "partial", "empty", "pending", "outdated", "growing", "failed_permanent", "failed_transient", "quarantined", "superseded"
]  # fmt: skip

STATES: tuple[State, ...] = get_args(State)
TO_DO: tuple[State, ...] = ("pending", "outdated", "failed_transient")
"""What the next ingest takes on."""
TROUBLE: tuple[State, ...] = ("failed_permanent", "failed_transient", "partial", "empty")
"""What somebody should look at."""

_NUMBER = re.compile(r"\d[\d.,]*")
_MOST_NAMES = 3
_MOST_CALLS = 7
_TWO_NIGHTS_NS = 2 * 86_400 * 10**9
_IN_WORDS: Mapping[State, str] = {"failed_permanent": "failed for what it holds", "failed_transient": "failed for now"}


@dataclass(frozen=True, slots=True)
class Group:
    """Logs that stand at one point for one reason."""

    state: State
    cause: str
    logs: tuple[str, ...]
    size_bytes: int

    def __str__(self) -> str:
        """Return the group as one line."""
        more = f" and {len(self.logs) - _MOST_NAMES} more" if len(self.logs) > _MOST_NAMES else ""
        names = f": {', '.join(self.logs[:_MOST_NAMES])}{more}" if self.state != "done" else ""
        cause = f", {self.cause}" if self.cause else ""
        return f"{len(self.logs):>7} {_words(self.state)}{cause}{names}"


@dataclass(frozen=True, slots=True)
class Status:
    """Where the logs of a store's sources stand."""

    store: str
    sources: tuple[str, ...]
    counts: Mapping[State, int]
    """Logs by state."""
    groups: tuple[Group, ...]
    """By state and cause."""
    to_do: Estimate | None
    """What the next ingest will take; None where nothing is to do."""
    problems: tuple[str, ...]
    """Sources that cannot be looked at, runs that are not complete, logs that wait for too long, calls that were killed."""
    gone: tuple[str, ...]
    """Sources that cannot be looked at and that only calls before the latest ingest were given."""
    superseded_runs: int
    begun: tuple[BegunCall, ...]
    """Calls that have begun and not ended: they run, perhaps run, or were killed and nobody accepted that."""
    history: tuple[Call, ...]
    """The latest calls, the last one first."""
    verdict: Verdict
    """On the runs under the ruling recipe together; of each code the worst finding is a reason."""
    runs: int
    """Under the ruling recipe."""
    findings: Mapping[str, int]
    """Of those, how many have a finding, by code: what is no note, the worst first."""
    losses: tuple[StoreLoss, ...]
    """The ten largest, over the runs under the ruling recipe."""
    exit_code: int
    """3 where somebody should look at a log or a run, else 0."""

    def __str__(self) -> str:
        """Return the lines as one text."""
        said = ", ".join(f"{count} {_words(state)}" for state, count in self.counts.items()) or "no logs"
        lines = [f"{self.store}: {said}", *(str(group) for group in self.groups)]
        lines += [f"to do: {self.to_do}"] if self.to_do else []
        lines += [f"of earlier calls: {line}" for line in self.gone]
        lines += [f"{self.superseded_runs} superseded runs"] if self.superseded_runs else []
        lines += [f"{call.state}: {call}" for call in self.begun if call.state != "killed"]
        lines += [f"verdict: {format_verdict(self.verdict)}"] if self.runs else []
        lines += [f"  {format_count(code, count, self.runs)}" for code, count in [*self.findings.items()][:MOST_LINES]]
        lines += ["losses:", *map(format_loss, self.losses)] if self.losses else []
        lines += ["history:"] if self.history else []
        return plain_lines([*lines, *(_told(call) for call in self.history[:_MOST_CALLS])])


@uncollected()
def status(
    logs: Iterable[str | Path] = (),
    *,
    store: str | Path = "tcpipe-store",
    recipe: Recipe | str | Path | None = None,
    robot: str | None = None,
    as_one: bool = False,
    shard: tuple[int, int] | None = None,
    min_age_s: float = 600.0,
    message_definitions: Path | None = None,
    force: bool = False,
    retry_failed: bool = False,
    jobs: int = 1,
    create: bool = False,
) -> Status:
    """Return where every log stands; parameters as those of `tcpipe.pipeline.ingest.ingest`.

    Parameters
    ----------
    logs
        Logs and folders; none: those that the store's latest calls of ingest were given.
    min_age_s
        A log that was written since so many seconds is growing.
    create
        The store need not be there, and nothing is written.

    Raises
    ------
    StoreError, UsageError, RecipeError
        There is no store, or nothing is known of its sources.

    """
    ruling = recipe_of(recipe)
    opened = Store(store if is_url(store) else local_output(store)) if create else open_store(store)
    calls, begun = latest_calls(opened), begun_calls(opened)
    given = [str(log) for log in logs]
    ingests = [(call.begin, call.logs) for call in calls if call.logs]
    ingests += [(call.begin, call.works_on) for call in begun if call.command == INGEST]
    asked = list(dict.fromkeys(log for _, logs in sorted(ingests, reverse=True) for log in logs))
    lately: Sequence[str] = [*map(shown_path, given)] or (max(ingests)[1] if ingests else ())
    given = given or asked
    if not given and not calls:
        raise UsageError(f"{opened.root}: no call of ingest is remembered here; give the logs or their folders")
    known, definitions = known_runs(opened, force=force), definitions_key(message_definitions)
    if not create:
        opened.keep_index(known.runs)
    with scratch_directory() as staging:
        found = find_sources(given, as_one=as_one, staging=staging, tables=ruling.tables)
    mine = found.sources if shard is None else in_shard(found.sources, shard)
    passing = failed_for_now(calls)
    failures = _failures(opened) if known.failed else {}
    groups: dict[tuple[State, str], list[tuple[IngestTask, str]]] = {}
    for source in mine:
        task_source = remembered(source, known.seen.get(source.lineage, ()))
        task = IngestTask(
            task_source, opened.root, ruling, robot or ruling.robot, {}, force, message_definitions, definitions, retry_failed, min_age_s
        )  # fmt: skip
        state, cause = _standing(task, opened, known, passing, failures)
        alike = _NUMBER.sub("#", cause) if state in (*TROUBLE, "quarantined") else cause
        groups.setdefault((state, alike), []).append((task, cause))
    told = tuple(
        _group(*of, tasks)
        for of, tasks in sorted(groups.items(), key=lambda item: (STATES.index(item[0][0]), -len(item[1])))
    )
    current = [run.facts for run in known.runs.finished if run.facts.ingest_key == ingest_key(ruling)]
    waiting = list[tuple[State, IngestTask]]()
    if (
        not create
        and all(call.state == "killed" for call in begun)
        and all(is_below(log, asked) for log in map(_absolute, given))
    ):
        every = ((state, task) for (state, _), tasks in groups.items() for task, _ in tasks)
        waiting = [of for of in every if (of[1].source.sha256 or of[1].source.files_digest) not in failures]
    begun = [call for call in begun if not (call.state == "killed" and trouble_of_call(call).is_accepted(opened))]
    killed = [call.problem for call in begun if call.state == "killed"]
    gone = tuple(line for path, lines in found.problems.items() if path not in lately for line in lines)
    found = replace(found, problems={path: lines for path, lines in found.problems.items() if path in lately})
    summed = _summed(
        opened,
        told,
        found,
        known,
        calls,
        sources=[*map(shown_path, given)],
        jobs=jobs,
        more=(*_waiting_too_long(waiting, opened), *killed),
    )
    by_code = group_findings((run.run_id, run.findings) for run in current)
    return replace(
        summed,
        verdict=judge_runs(current),
        runs=len(current),
        findings={of.code: len(of.of) for of in by_code if of.severity != "note"},
        losses=losses_of(run.ledger_m for run in current),
        gone=gone,
        begun=tuple(begun),
    )


def _waiting_too_long(tasks: Iterable[tuple[State, IngestTask]], store: Store) -> Iterator[str]:
    """Yield a line about the logs that lie there for more than two nights, were never ingested, and nobody accepted that.

    Since when is told by the file system, not by the modification time, which a copy may keep.
    """
    before_ns = time.time_ns() - _TWO_NIGHTS_NS
    late: dict[State, list[str]] = {"pending": [], "growing": []}
    for state, task in tasks:
        if (
            state in late
            and task.source.arrival_ns < before_ns
            and not trouble_of_waiting(task.source).is_accepted(store)
        ):
            late[state].append(task.source.name)
    for state, how in (
        ("pending", "run 'tcpipe ingest' over them and see how it ends"),
        (
            "growing",
            "their modification times lie in the future, so that --min-age never passes: set them with 'touch'",
        ),
    ):
        if names := late[state]:
            more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
            named = f"{', '.join(names[:_MOST_NAMES])}{more}"
            yield f"{len(names)} {state} for more than two nights: {named}; {how}, or 'tcpipe accept LOG'"


def _absolute(log: str) -> str:
    return log if is_url(log) else str(Path(log).absolute())


def _group(state: State, alike: str, tasks: Sequence[tuple[IngestTask, str]]) -> Group:
    """Return logs whose causes are ``alike`` but for numbers, which are told where they are the same."""
    cause = alike if any(cause != tasks[0][1] for _, cause in tasks) else tasks[0][1]
    return Group(state, cause, tuple(task.source.name for task, _ in tasks), sum(_bytes(task) for task, _ in tasks))


def _standing(
    task: IngestTask,
    store: Store,
    known: KnownRuns,
    passing: Mapping[str, str],
    failures: Mapping[str, Sequence[Trouble]],
) -> tuple[State, str]:
    """Return where a log stands, and why."""
    source, sha256 = task.source, None if task.force else task.source.sha256
    made = known.made.get(sha256, []) if sha256 else []
    current = next((facts for facts in made if task.is_made_by(facts)), None)
    if current is not None:
        return _standing_of(current, task, store)
    failed = None if task.force or task.retry_failed else store.recall(task.failure, Trouble)
    if failed is not None:
        return "quarantined" if failed.is_accepted(store) else "failed_permanent", _cause(
            "".join(failed.lines[:1]), task
        )
    if too_young(task):
        return "growing", ""
    if source.name in passing:
        return "failed_transient", _cause(passing[source.name], task)
    return (
        ("outdated", _why_outdated(made[-1], task)) if made else ("pending", _why_pending(task, store, known, failures))
    )


def _standing_of(made: RunFacts, task: IngestTask, store: Store) -> tuple[State, str]:
    """Return where a log stands that is in the store as it would be made now."""
    if made.superseded_by:
        return "superseded", "a longer recording has taken its place"
    trouble = trouble_of_run(
        made.run_id, made.findings, made.damage, content=str(task.source.sha256), log=task.source.origins
    )
    if trouble is None:
        return "done", ""
    if trouble.is_accepted(store):
        return "done", f"{trouble.kind}, accepted"
    if made.is_empty:
        return "empty", describe_finding(select_findings(made.findings, "no-segments")[0])
    return "partial", _cause(trouble.lines[0], task)


def _why_pending(task: IngestTask, store: Store, known: KnownRuns, failures: Mapping[str, Sequence[Trouble]]) -> str:
    """Return why a log that was seen before is to be ingested; "" of a new one."""
    sha256 = task.source.sha256
    if before := failures.get(sha256 or task.source.files_digest):
        accepted = ", accepted" if any(of.is_accepted(store) for of in before) else ""
        return f"{_how_it_failed(before, task)}{accepted}; to be tried again"
    if task.force:
        return "to be done again if it is there already"
    if sha256 and any(run_id.endswith(f"-{sha256[:8]}") for run_id in known.broken):
        return "its run is not as it was written"
    return "its content is another than before" if task.source.lineage in known.seen and not sha256 else ""


def _failures(store: Store) -> dict[str, list[Trouble]]:
    """Return what failed, however it was read, by content."""
    failures: dict[str, list[Trouble]] = {}
    for of in store.records("failed", Trouble):
        failures.setdefault(of.content, []).append(of)
    return failures


def _how_it_failed(before: Sequence[Trouble], task: IngestTask) -> str:
    if task.force or task.retry_failed:
        return "failed before"
    latest = max(of.version or "" for of in before)
    if __version__ not in {of.version for of in before}:
        return f"failed with {f'tcpipe {latest}' if latest else 'another version'}"
    return "failed under another recipe, for another robot or with other message definitions"


def _why_outdated(made: RunFacts, task: IngestTask) -> str:
    """Return in which an ingestion differs from what would be made now."""
    if made.ingest_key != ingest_key(task.recipe):
        return f"made under another recipe ({made.recipe_id})"
    if made.tcpipe_version != __version__:
        return f"made by tcpipe {made.tcpipe_version}"
    return "made for another robot, or with other message definitions"


def failed_for_now(calls: Sequence[Call]) -> dict[str, str]:
    """Return the logs whose latest failure may pass, and what that was."""
    found: dict[str, str] = {}
    for call in reversed(calls):
        found.update(call.failed)
    return found


def _cause(line: str, task: IngestTask) -> str:
    """Return what is wrong without the name of the log."""
    for name in (task.source.name, *task.source.origins):
        line = line.replace(f"{name}: ", "").replace(name, "it")
    return line


def _summed(
    store: Store,
    told: tuple[Group, ...],
    found: FoundLogs,
    known: KnownRuns,
    calls: Sequence[Call],
    *,
    sources: Sequence[str],
    jobs: int,
    more: Sequence[str],
) -> Status:
    counts = Counter[State]()
    for group in told:
        counts[group.state] += len(group.logs)
    waiting = sum(group.size_bytes for group in told if group.state in TO_DO)
    trouble = any(group.state in TROUBLE for group in told)
    outdated = (f"run {name}: of data model {head.data_model_version}" for name, head in known.runs.outdated.items())
    problems = (*chain(*found.problems.values()), *dict.fromkeys(known.runs.damaged.values()), *outdated, *more)
    return Status(
        store=str(store.root),
        sources=tuple(sources),
        counts=dict(counts),
        groups=told,
        to_do=estimate(calls, INGEST, waiting, jobs=jobs) if any(counts[state] for state in TO_DO) else None,
        problems=problems,
        gone=(),
        superseded_runs=len(known.runs.superseded),
        begun=(),
        history=tuple(calls),
        verdict=Verdict(),
        runs=0,
        findings={},
        losses=(),
        exit_code=3 if trouble or problems else 0,
    )


def _bytes(task: IngestTask) -> int:
    return sum(size for size, _ in task.source.files)


def _words(state: State) -> str:
    return _IN_WORDS.get(state, state)


def _told(call: Call) -> str:
    """Return a call as one line."""
    said = ", ".join(f"{count} {what}" for what, count in call.counts.items() if count) or "nothing"
    return f"  {call.begin[:19]} {call.command}: {said}; {in_time(call.wall_s)}, CPU {in_time(call.cpu_s)}, exit code {call.exit_code}"
