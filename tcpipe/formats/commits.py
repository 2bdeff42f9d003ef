"""Commits: what each call wrote into the log of its store; and the state that they add up to, a pure function (ADR-29)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import pairwise
from typing import Literal, TypeAlias

from tcpipe.formats.index_files import RunFacts
from tcpipe.tables.findings import LEFT_OUT, Finding

Kind: TypeAlias = Literal[
    "begun", "ended", "seen", "ingested", "failed", "acknowledged", "superseded", "built", "excluded", "pruned", "snapshot"
]  # fmt: skip

LATEST_CALLS = 50
"""So many calls are remembered."""

_KEPT_FOR = timedelta(days=7)
"""So long a generation stays after the next one was committed: readers that began with it may finish."""

_UNFINISHED = ".active"
"""Ending of a ROS 1 bag that is still recorded, or was when its recorder died."""


@dataclass(frozen=True, slots=True)
class LogSnapshot:
    """A log when it was seen: its files, the size [byte] and modification time [ns] of each, and the hash of its content."""

    log: tuple[str, ...]
    size_and_time: tuple[tuple[int, int], ...]
    sha256: str


@dataclass(frozen=True, slots=True)
class Failure:
    """A log that failed because of its content: the same call would fail again."""

    key: str
    """Hash of the content and of what else decides: version, recipe, robot, message definitions."""
    content: str
    """The sha256 of the log; where nothing could be read, a hash of its path, sizes and times."""
    log: tuple[str, ...]
    problems: tuple[str, ...]
    version: str
    """Of the program that failed."""
    findings: tuple[Finding, ...] = field(default=(), metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True)
class Problem:
    """A finding that causes exit code 3 until somebody acknowledges it."""

    finding: Finding
    content: str
    """The sha256 of the log, or what else identifies the subject: a problem of other content is a new one."""
    log: tuple[str, ...] = field(default=(), metadata=LEFT_OUT)
    run_id: str | None = field(default=None, metadata=LEFT_OUT)

    @property
    def key(self) -> str:
        """What identifies it: code, content, and the subject where that is not the content itself."""
        subject = self.finding.subject
        return f"{self.finding.code} {self.content} {'' if subject.kind in ('log', 'run', 'call') else subject.name}"

    @property
    def name(self) -> str:
        """What a person calls it: the run, or the log or call."""
        return self.run_id or " + ".join(self.log) or self.finding.subject.name


@dataclass(frozen=True, slots=True)
class Superseded:
    """That another run takes a run's place, or, by None, that the run counts again."""

    run_id: str
    by: str | None


@dataclass(frozen=True, slots=True)
class Dataset:
    """Which ingestions a dataset is made of, and where it was written; nothing that it refers to is removed."""

    out: str
    inputs: str
    """The digest in its card."""
    runs: tuple[tuple[str, str], ...] = ()
    """Runs and their recipes."""


@dataclass(frozen=True, slots=True)
class Generation:
    """One build of what lies at a URL: a dataset, a model, a cost map or an evaluation (ADR-30)."""

    folder: str
    """Where its files are, from the URL."""
    card: str
    """The name of its card in that folder."""
    at: str
    """When it was committed: UTC, ISO 8601."""


@dataclass(frozen=True, slots=True)
class Process:
    """What distinguishes a process from any other; "" where the system does not say."""

    host: str
    machine: str
    """Identity of the installed system (machine-id)."""
    boot: str
    """Identity of this start of the machine."""
    namespace: str
    """In which ``pid`` counts: a container has its own."""
    pid: int
    start: str
    """When it began, in ticks since the start of the machine."""


@dataclass(frozen=True, slots=True)
class Begun:
    """That a call of ingest or build-dataset has begun; process, time and number are those of its commit."""

    command: str
    version: str
    works_on: tuple[str, ...]
    """Logs and folders, or the dataset, in full."""
    options: str
    """Hash of the options that distinguish its work from that of another call."""
    number: int = 0
    begin: str = ""
    process: Process | None = None


@dataclass(frozen=True, slots=True)
class CallRecord:
    """What a call of ingest or build-dataset did and took; times are of the clock of where it ran."""

    command: str
    version: str
    exit_code: int
    counts: Mapping[str, int]
    """Logs by what became of them; or samples and runs."""
    jobs: int = 1
    begin: str = ""
    """UTC, ISO 8601."""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    """Of its process and its workers, also those of a cluster."""
    logs: tuple[str, ...] = ()
    """As they were given, in full."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """By log, why it failed for a reason that may pass."""
    done_bytes: int = 0
    """Size of the logs that came in [byte]."""
    written_bytes: int = 0
    """What was written for them, or the size of the dataset [byte]."""

    @property
    def end(self) -> str:
        """When it ended, as ``begin``."""
        return (datetime.fromisoformat(self.begin) + timedelta(seconds=self.wall_s)).isoformat(timespec="milliseconds")


@dataclass(frozen=True, slots=True)
class Entries:
    """What a commit adds."""

    seen: tuple[LogSnapshot, ...] = field(default=(), metadata=LEFT_OUT)
    runs: tuple[RunFacts, ...] = field(default=(), metadata=LEFT_OUT)
    """Ingestions, each in the place of an earlier one of the same run and recipe."""
    failed: tuple[Failure, ...] = field(default=(), metadata=LEFT_OUT)
    acknowledged: tuple[Problem, ...] = field(default=(), metadata=LEFT_OUT)
    superseded: tuple[Superseded, ...] = field(default=(), metadata=LEFT_OUT)
    datasets: tuple[Dataset, ...] = field(default=(), metadata=LEFT_OUT)
    forgotten: tuple[Dataset, ...] = field(default=(), metadata=LEFT_OUT)
    """Datasets that are gone: overwritten by a build, or given up by a person."""
    generations: tuple[Generation, ...] = field(default=(), metadata=LEFT_OUT)
    removed: tuple[tuple[str, str], ...] = field(default=(), metadata=LEFT_OUT)
    """Runs and recipes that were pruned, or whose files were lost."""
    begun: tuple[Begun, ...] = field(default=(), metadata=LEFT_OUT)
    ended: tuple[int, ...] = field(default=(), metadata=LEFT_OUT)
    """Numbers of the commits of calls that ended, or whose work another call has done."""
    calls: tuple[CallRecord, ...] = field(default=(), metadata=LEFT_OUT)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to write."""
        return self == Entries()


@dataclass(frozen=True, slots=True)
class Commit:
    """One entry of the log of a store, or of what is built to a URL."""

    number: int
    parent: str
    """Seal of the commit before; "" of the first."""
    kind: Kind
    who: Process
    at: str
    """UTC, ISO 8601."""
    entries: Entries


@dataclass(frozen=True, slots=True)
class State:
    """What a log says."""

    number: int = 0
    """Of the last commit."""
    digest: str = ""
    """Its seal."""
    snapshot: int = 0
    """Number of the last snapshot that was read or written."""
    tail_bytes: int = 0
    """Size of the commits after it."""
    runs: Mapping[tuple[str, str], RunFacts] = field(default_factory=dict)
    """By run and recipe."""
    seen: Mapping[str, tuple[LogSnapshot, ...]] = field(default_factory=dict)
    """By `find_lineage` the log."""
    failed: Mapping[str, Failure] = field(default_factory=dict)
    """By key."""
    acknowledged: Mapping[str, Problem] = field(default_factory=dict)
    """By key."""
    supersessions: tuple[Superseded, ...] = ()
    datasets: Mapping[tuple[str, str], Dataset] = field(default_factory=dict)
    """By place and digest."""
    forgotten: frozenset[tuple[str, str]] = frozenset()
    pruned: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """Ingestions that a prune took from the log, and when (number of a commit): their files are gone, or go with the next prune."""
    generations: tuple[Generation, ...] = ()
    """Those that are kept, the newest last."""
    begun: Mapping[int, Begun] = field(default_factory=dict)
    """Calls that have not ended, by the number of their commit."""
    calls: tuple[CallRecord, ...] = ()
    """The latest, the last one first."""
    problems: tuple[Problem, ...] = ()
    """Commits that are missing or damaged."""

    @property
    def superseded(self) -> dict[str, str]:
        """Runs that another has taken the place of, and that other."""
        latest = {supersession.run_id: supersession.by for supersession in self.supersessions}
        return {run_id: by for run_id, by in latest.items() if by is not None}

    @property
    def parties(self) -> set[str]:
        """Runs that another has taken the place of, or did once, and those others."""
        return {name for supersession in self.supersessions for name in (supersession.run_id, supersession.by) if name}

    def find_rows(self, run_id: str) -> list[RunFacts]:
        """Return the ingestions of a run."""
        return [row for (name, _), row in self.runs.items() if name == run_id]

    def find_run(self, sha256: str) -> str | None:
        """Return the run of a content; None where there is none."""
        return next((row.run_id for row in self.runs.values() if row.log and row.log.source.sha256 == sha256), None)

    def has_seen(self, sighting: LogSnapshot) -> bool:
        """Return whether a log was seen as it is now."""
        return sighting in self.seen.get(find_lineage(sighting.log), ())


def find_lineage(log: tuple[str, ...]) -> str:
    """Return what identifies the place of a log; a recording that is finished (``.active`` goes) stays where it was."""
    return "\n".join(path.removesuffix(_UNFINISHED) for path in log)


def fold(commits: Iterable[Commit], state: State | None = None) -> State:
    """Return the state after commits that follow ``state``."""
    state = State() if state is None else state
    runs, seen, failed, acknowledged = dict(state.runs), dict(state.seen), dict(state.failed), dict(state.acknowledged)
    datasets, begun, forgotten = dict(state.datasets), dict(state.begun), set(state.forgotten)
    pruned = dict(state.pruned)
    calls, supersessions, number = state.calls, state.supersessions, state.number
    generations = state.generations
    gone = state.superseded
    for commit in commits:
        entries, number = commit.entries, commit.number
        supersessions += entries.superseded
        _supersede(runs, gone, entries.superseded)
        _add_runs(runs, gone, commit)
        _add_pruned(pruned, commit)
        for sighting in entries.seen:
            lineage = find_lineage(sighting.log)
            seen[lineage] = (*(old for old in seen.get(lineage, ()) if old != sighting), sighting)
        failed.update({failure.key: failure for failure in entries.failed})
        acknowledged.update({problem.key: problem for problem in entries.acknowledged})
        _add_datasets(datasets, forgotten, entries)
        generations = _keep_generations((*generations, *entries.generations)) if entries.generations else generations
        begun.update(_number(call, commit) for call in entries.begun)
        begun = {key: call for key, call in begun.items() if key not in entries.ended}
        calls = (*reversed(entries.calls), *calls)[:LATEST_CALLS]
    return replace(
        state, number=number, runs=runs, seen=seen, failed=failed, acknowledged=acknowledged, supersessions=supersessions,
        datasets=datasets, forgotten=frozenset(forgotten), pruned=pruned, generations=generations, begun=begun, calls=calls,
    )  # fmt: skip


def _supersede(runs: dict[tuple[str, str], RunFacts], gone: dict[str, str], superseded: Iterable[Superseded]) -> None:
    for each in superseded:
        gone.pop(each.run_id, None)
        gone.update({each.run_id: each.by} if each.by else {})
        for key in [key for key in runs if key[0] == each.run_id]:
            runs[key] = replace(runs[key], superseded_by=each.by)


def _add_runs(runs: dict[tuple[str, str], RunFacts], gone: Mapping[str, str], commit: Commit) -> None:
    for row in commit.entries.runs:
        by, key = gone.get(row.run_id), (row.run_id, row.recipe_id)
        known = runs.get(key)
        number = row.commit or (known.commit if known and _is_same(known, row) else commit.number)
        is_settled = (row.commit, row.superseded_by) == (number, by)
        runs[key] = row if is_settled else replace(row, superseded_by=by, commit=number)
    for key in commit.entries.removed:
        runs.pop(key, None)


def _add_pruned(pruned: dict[tuple[str, str], int], commit: Commit) -> None:
    for row in commit.entries.runs:
        pruned.pop((row.run_id, row.recipe_id), None)
    if commit.kind != "excluded":  # its files were gone before
        pruned.update(dict.fromkeys(commit.entries.removed, commit.number))


def _is_same(known: RunFacts, row: RunFacts) -> bool:
    """Return whether a row is of the tables that the state knows: it may be committed again with other documents of its log."""
    return (known.segments_sha256, known.track_file) == (row.segments_sha256, row.track_file)


def _add_datasets(datasets: dict[tuple[str, str], Dataset], forgotten: set[tuple[str, str]], entries: Entries) -> None:
    for dataset in entries.forgotten:
        forgotten.add((dataset.out, dataset.inputs))
        datasets.pop((dataset.out, dataset.inputs), None)
    for dataset in entries.datasets:
        forgotten.discard((dataset.out, dataset.inputs))
        datasets[dataset.out, dataset.inputs] = dataset


def _keep_generations(generations: tuple[Generation, ...]) -> tuple[Generation, ...]:
    """Return the newest two generations, and those that were not replaced for long when the newest was committed."""
    times = [datetime.fromisoformat(generation.at) for generation in generations]
    kept = [
        generation
        for generation, (_, replaced) in zip(generations, pairwise(times), strict=False)
        if times[-1] - replaced <= _KEPT_FOR
    ]
    return (*kept, *generations[-1:])


def _number(call: Begun, commit: Commit) -> tuple[int, Begun]:
    """Return a call with the number, time and process of its commit, unless a snapshot has them."""
    known = call if call.number else replace(call, number=commit.number, begin=commit.at, process=commit.who)
    return known.number, known


def compact_state(state: State) -> Entries:
    """Return the entries of one commit that adds up to a state."""
    return Entries(
        seen=tuple(sighting for sightings in state.seen.values() for sighting in sightings),
        runs=tuple(state.runs.values()),
        failed=tuple(state.failed.values()),
        acknowledged=tuple(state.acknowledged.values()),
        superseded=state.supersessions,
        datasets=tuple(state.datasets.values()),
        forgotten=tuple(Dataset(out, inputs) for out, inputs in sorted(state.forgotten)),
        removed=tuple(state.pruned),
        generations=state.generations,
        begun=tuple(state.begun.values()),
        calls=tuple(reversed(state.calls)),
    )
