"""Problems of runs, logs and calls: what causes exit code 3 until somebody acknowledges it; identified by code and content."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcpipe.errors import UsageError, list_first
from tcpipe.formats.atomic import make_scratch_directory
from tcpipe.formats.commits import Entries, Problem, State, find_lineage
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.stored_runs import Ingestions
from tcpipe.pipeline.calls import LogWriter, list_begun_calls
from tcpipe.pipeline.log_sources import LogSource, find_sources
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import Finding, Subject, make_finding, select_problems

_MOST_CANDIDATES = 10


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """Problems that are acknowledged now, and those that were before."""

    acknowledged: tuple[Problem, ...]
    before: tuple[Problem, ...]


def find_problems(row: RunFacts) -> tuple[Problem, ...]:
    """Return what is wrong with a run: damage of its log, or that it has no segments."""
    log = row.log.source if row.log else None
    return tuple(
        Problem(finding, log.sha256, log.paths, row.run_id) for finding in select_problems(row.findings) if log
    )


def make_failure(content: str, log: tuple[str, ...]) -> Problem:
    """Return the problem that a log failed because of its content."""
    return Problem(Finding("log-failed", "error", Subject("log", " + ".join(log)), "rejected"), content, log)


def find_incomplete_runs(found: Ingestions) -> Iterator[Problem]:
    """Yield the runs of which files are missing."""
    for (run_id, recipe_id), lost in found.lost.items():
        finding = make_finding("run-incomplete", Subject("run", run_id), names={"file": lost.where})
        yield Problem(finding, f"{run_id}/{recipe_id} {found.rows[run_id, recipe_id].commit}", run_id=run_id)


def make_waiting(source: LogSource, state: str) -> Problem:
    """Return the problem that a log lies there and no call takes it in; that of other content, written since, is another."""
    finding = make_finding("log-waiting", Subject("log", source.name), names={"state": state})
    return Problem(finding, source.files_digest, source.origins)


def make_missing(path: str, state: State) -> Problem:
    """Return the problem that a path given to `ingest` holds no log; after the next call that is given the path it is a new one."""
    latest = max((call.begin for call in state.calls if path in call.logs), default="")
    return Problem(make_finding("log-missing", Subject("log", path)), f"{path} {latest}", (path,))


def is_acknowledged(problems: Sequence[Problem], state: State) -> bool:
    """Return whether a person has acknowledged all of some problems."""
    return bool(problems) and all(problem.key in state.acknowledged for problem in problems)


def find_known_problems(state: State) -> Iterator[Problem]:
    """Yield the problems that the log of a store has: of logs and runs, of killed calls, and of commits."""
    for failure in state.failed.values():
        yield make_failure(failure.content, failure.log)
    for row in state.runs.values():
        yield from find_problems(row)
    yield from (call.problem for call in list_begun_calls(state) if call.state == "killed")
    yield from state.problems


def acknowledge(names: Sequence[str], *, store: str | Path = "tcpipe-store") -> Acknowledged:
    """Acknowledge the problems of runs, logs and killed calls: they cause no exit code 3 any more, until the content is another.

    A run of which files are missing is given up: the log of the store no longer names it.

    Raises `StoreError`: there is no store, or it cannot be written; `UsageError`: a name is none of a run or log with a problem, or of
    several logs; nothing was acknowledged then.
    """
    opened = open_store(store)
    opened.place.clear()
    log = LogWriter(opened, state := opened.state())
    known = {problem.key: problem for problem in find_known_problems(state)}
    chosen, wrong = dict[str, Problem](), list[str]()
    for name in dict.fromkeys(names):
        found = (
            _name_problems(name, known.values(), state)
            or _make_lost_problem(name, opened, state)
            or _make_missing_problem(name, state)
            or _make_waiting_problem(name, state)
        )
        if len({problem.name for problem in found}) == 1:
            chosen |= {problem.key: problem for problem in found}
        else:
            wrong.append(
                _describe_no_match(
                    name,
                    found,
                    [problem for problem in known.values() if problem.key not in state.acknowledged],
                    state,
                    opened.root,
                )
            )
    if wrong:
        raise UsageError(*wrong)
    now = tuple(problem for key, problem in chosen.items() if key not in state.acknowledged)
    log.commit("acknowledged", Entries(acknowledged=now))
    gone = {problem.run_id for problem in now if problem.finding.code == "run-incomplete"}
    log.commit(
        "excluded", Entries(removed=tuple(key for name in gone for key in opened.ingestions(name, state=state).lost))
    )
    return Acknowledged(now, tuple(problem for problem in chosen.values() if problem not in now))


def _name_problems(name: str, known: Iterable[Problem], state: State) -> list[Problem]:
    paths = {name, str(Path(name).absolute()), str(Path(name).resolve())}
    contents = {sighting.sha256 for path in paths for sighting in state.seen.get(find_lineage((path,)), ())}
    known = list(known)
    exact = [
        failure
        for failure in known
        if failure.content in contents or paths & {failure.name, " + ".join(failure.log), *failure.log}
    ]
    return exact or [failure for failure in known if name in {Path(origin).name for origin in failure.log}]


def _make_lost_problem(name: str, store: Store, state: State) -> list[Problem]:
    """Return the problem of a run of which files are missing: to acknowledge it is to give the run up."""
    return list(find_incomplete_runs(store.ingestions(name, state=state))) if state.find_rows(name) else []


def _make_missing_problem(name: str, state: State) -> list[Problem]:
    """Return the problem of a path that `ingest` was given and that holds no log."""
    given = {log for call in state.calls for log in call.logs}
    path = next((path for path in (name, str(Path(name).absolute())) if path in given), None)
    if path is None:
        return []
    with make_scratch_directory() as staging:
        return [make_missing(path, state)] if find_sources([path], as_one=False, staging=staging).problems else []


def _make_waiting_problem(name: str, state: State) -> list[Problem]:
    """Return the problem of a log by its path or URL that the store does not hold: nobody wants to be told that it waits."""
    with make_scratch_directory() as staging:
        sources = find_sources([name], as_one=False, staging=staging).sources
    return [make_waiting(source, "pending") for source in sources if source.lineage not in state.seen]


def _describe_no_match(
    name: str, found: Sequence[Problem], candidates: Sequence[Problem], state: State, root: Path | str
) -> str:
    if found:
        return f"{name}: {len(found)} logs have this name; give the path of one: {_format_list(found)}"
    if state.find_rows(name):
        return f"{name}: this run has no known problem; there is nothing to acknowledge"
    listed = f"known problems: {_format_list(candidates)}" if candidates else "there are no known problems"
    return f"{name}: is no run or log with a known problem in {root}; {listed}"


def _format_list(problems: Sequence[Problem]) -> str:
    return list_first(sorted({problem.name for problem in problems}), _MOST_CANDIDATES)
