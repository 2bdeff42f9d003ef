"""Problems of runs, logs and calls, which cause exit code 3 until acknowledged; identified by code and content."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tcpipe.errors import UsageError, clean_lines, list_first
from tcpipe.formats.atomic import Location, make_scratch_directory
from tcpipe.formats.documents import State, make_key, make_run_key, read_record
from tcpipe.formats.runs import Call, Problem, Run, RunFacts, find_problems, make_failure
from tcpipe.pipeline.calls import ACKNOWLEDGE, BUILD, INGEST, close_call, list_open_calls, record_call
from tcpipe.pipeline.log_sources import list_log_sources
from tcpipe.store import Store, open_store
from tcpipe.tables.findings import Subject, find_entry, make_finding

_MOST_CANDIDATES = 10


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """Problems that are acknowledged now, and those that were before."""

    acknowledged: tuple[Problem, ...]
    before: tuple[Problem, ...]

    def __str__(self) -> str:
        """Return a line for each problem."""
        words = [*(("acknowledged", each) for each in self.acknowledged)]
        words += (("acknowledged before", each) for each in self.before)
        lines = [
            f"{word}: {each.name}: {find_entry(each.finding.code).title} [{each.finding.code}]" for word, each in words
        ]
        if not self.acknowledged:
            lines.append("nothing to do: these problems are already acknowledged")
        return clean_lines(lines)


def find_incomplete_runs(state: State, run_id: str | None = None) -> Iterator[Problem]:
    """Yield the runs, or those under one name, whose folders of payload are missing."""
    for row in state.list_rows(run_id):
        if row.blob and not state.has_payload(row):
            folder = row.blob if row.blob not in state.blobs else row.streams_blob
            finding = make_finding("run-incomplete", Subject("run", row.run_id), names={"file": f"blobs/{folder}"})
            yield Problem(finding, f"{row.run_id}/{row.recipe_id} {row.blob}", run_id=row.run_id)


def find_incomplete_maps(state: State, name: str | None = None) -> Iterator[Problem]:
    """Yield the maps, or the one of a name, whose folder of payload is missing."""
    for record in state.maps.values():
        if name in (None, record.name) and record.blob not in state.blobs:
            finding = make_finding(
                "map-incomplete", Subject("map", record.name), names={"file": f"blobs/{record.blob}"}
            )
            yield Problem(finding, f"{record.name} {record.blob}")


def make_missing(path: str, state: State) -> Problem:
    """Return the problem that a path given to `ingest` has no log; each later call with the path raises a new one."""
    latest = max((call.begin for call in _list_ingests(state) if path in call.works_on), default="")
    return Problem(make_finding("log-missing", Subject("log", path)), f"{path} {latest}", (path,))


def _list_ingests(state: State) -> list[Call]:
    return [call for _, call in state.calls if call.command == INGEST]


def is_acknowledged(problems: Sequence[Problem], state: State) -> bool:
    """Return whether a person has acknowledged all of some problems."""
    known = state.acknowledged if problems else set()
    return bool(problems) and all(problem.key in known for problem in problems)


def find_known_problems(state: State) -> Iterator[Problem]:
    """Yield the problems in a store's documents: of logs and runs, of killed calls, and of the documents themselves."""
    for failure in state.failed.values():
        yield make_failure(failure.content, failure.log)
    for row in state.runs.values():
        yield from find_problems(row)
    yield from (call.problem for call in list_open_calls(state) if call.state != "running")
    yield from state.problems


def find_stale_outputs(store: Store, state: State) -> Iterator[Problem]:
    """Yield the outputs whose last call failed, or whose inputs have changed, unless a call is running."""
    if not state.outputs:
        return
    from tcpipe.pipeline.dataset.build import find_changed_parts  # noqa: PLC0415  only for stores with datasets

    running = [call.call for call in list_open_calls(state) if call.state != "killed" and call.call.command == BUILD]
    for output in state.outputs.values():
        subject = Subject("dataset", output.where)
        if any(output.where in call.works_on for call in running):
            continue
        if output.exit_code not in (0, 3):
            names = {"message": output.message.partition("\n")[0], "at": output.at[:19]}
            yield Problem(make_finding("output-failed", subject, names=names), f"{output.where} {output.at}")
        elif changes := find_changed_parts(store, state, output):
            found = make_finding("output-outdated", subject, names={"changes": changes})
            yield Problem(found, f"{output.where} {output.inputs}")


def acknowledge(names: Sequence[str], *, store: Location = "tcpipe-store") -> Acknowledged:
    """Acknowledge problems of runs, logs, datasets and killed calls: no exit code 3 until their content changes.

    A run whose tables are missing is no longer expected, and a killed call counts as ended. Raises `StoreError`: there
    is no store, or it cannot be written; `UsageError`: a name does not fit one run, log or dataset with problems.
    """
    opened = open_store(store)
    with record_call(opened, ACKNOWLEDGE, names) as call:
        state = call.state
        known = {problem.key: problem for problem in (*find_known_problems(state), *find_stale_outputs(opened, state))}
        chosen, unmatched = dict[str, Problem](), list[str]()
        for name in dict.fromkeys(names):
            matches = (
                _name_problems(name, known.values(), state)
                or list(find_incomplete_runs(state, name))
                or list(find_incomplete_maps(state, name))
                or _make_missing_problem(name, state)
            )
            if len({problem.name for problem in matches}) == 1:
                chosen |= {problem.key: problem for problem in matches}
            else:
                candidates = [problem for problem in known.values() if problem.key not in state.acknowledged]
                unmatched.append(_describe_no_match(name, matches, candidates, state, opened.root))
        if unmatched:
            raise UsageError(*unmatched)
        before = state.acknowledged
        now = tuple(problem for key, problem in chosen.items() if key not in before)
        for problem in now:
            opened.put(state, "acknowledged", make_key(problem.key), problem)
        _give_up(opened, state, now)
        return Acknowledged(now, tuple(problem for key, problem in chosen.items() if key in before))


def _give_up(store: Store, state: State, problems: Sequence[Problem]) -> None:
    """Close the killed calls, and give up the runs without tables, that were acknowledged."""
    names = {problem.name for problem in problems}
    for call in list_open_calls(state):
        if call.name in names:
            close_call(store, state, call, "acknowledged as killed")
    gone = {problem.run_id for problem in problems if problem.finding.code == "run-incomplete"}
    for row in [row for row in state.runs.values() if row.run_id in gone and not state.has_payload(row)]:
        forget_tables(store, state, row)


def forget_tables(store: Store, state: State, row: RunFacts) -> None:
    """Write that a run has no tables any more."""
    run = read_record(store.place, state.names["runs", make_run_key(row.log.sha256, row.recipe_id)], Run)
    store.put_run(state, replace(run, blob="", tables={}, streams_blob="", streams={}))


def _name_problems(name: str, known: Iterable[Problem], state: State) -> list[Problem]:
    paths = {name, str(Path(name).absolute()), str(Path(name).resolve())}
    contents = {seen.sha256 for path in paths if (seen := state.find_seen((path,))) is not None}
    known = list(known)
    exact = [
        failure
        for failure in known
        if failure.content in contents or paths & {failure.name, " + ".join(failure.log), *failure.log}
    ]
    return exact or [failure for failure in known if name in {Path(origin).name for origin in failure.log}]


def _make_missing_problem(name: str, state: State) -> list[Problem]:
    """Return the problem of a path of `ingest` that contains no log."""
    given = {log for call in _list_ingests(state) for log in call.works_on}
    path = next((path for path in (name, str(Path(name).absolute())) if path in given), None)
    if path is None:
        return []
    with make_scratch_directory() as staging:
        return [make_missing(path, state)] if list_log_sources([path], as_one=False, staging=staging).problems else []


def _describe_no_match(
    name: str, found: Sequence[Problem], candidates: Sequence[Problem], state: State, root: Location
) -> str:
    if found:
        return f"{name}: {len(found)} logs have this name; give the path of one: {_format_list(found)}"
    if state.list_rows(name):
        return f"{name}: this run has no known problem; there is nothing to acknowledge"
    listed = f"known problems: {_format_list(candidates)}" if candidates else "there are no known problems"
    return f"{name}: is no run, log or dataset with a known problem in {root}; {listed}"


def _format_list(problems: Sequence[Problem]) -> str:
    return list_first(sorted({problem.name for problem in problems}), _MOST_CANDIDATES)
