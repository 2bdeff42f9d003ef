"""What the page of a store shows: its runs, datasets and failed logs, the verdict, and changes from run to run."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from tcpipe.cost.physics import PHYSICS_UNITS
from tcpipe.errors import DatasetError, StoreError
from tcpipe.formats.dataset_files import CARD, REPORT, read_card
from tcpipe.formats.documents import State
from tcpipe.formats.finding_lines import group_findings
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.runs import Output, RunFacts, find_problems, make_failure
from tcpipe.pipeline.plan import list_transient_failures
from tcpipe.pipeline.problems import is_acknowledged
from tcpipe.power.witnesses import compare_batteries
from tcpipe.recipe import Recipe
from tcpipe.report.store_report import FailedLog, RunKey, StoredDataset, StoreFacts
from tcpipe.robust import estimate_robust_std
from tcpipe.store import Store
from tcpipe.tables.findings import Finding, Subject, Verdict, judge_by_code, make_finding, read_threshold


def make_store_facts(store: Store, state: State, ruling: Recipe, pages: Mapping[RunKey, str]) -> StoreFacts:
    """Return the content of the page of a store; ``pages`` are the names of the pages of runs in the store."""
    key = ingest_key(ruling)
    counted = [run.facts for run in store.runs(state)]
    current = [facts for facts in counted if facts.ingest_key == key]
    changes = find_changes(current)
    return StoreFacts(
        where=str(store.root),
        rows=tuple(row for row in state.list_rows() if row.blob),
        ruling=key,
        incomplete=frozenset(
            (row.run_id, row.recipe_id) for row in state.runs.values() if row.blob and not state.has_payload(row)
        ),
        damaged=tuple(map(store.place.where, sorted(state.damaged))),
        acknowledged=frozenset(row.run_id for row in counted if is_acknowledged(find_problems(row), state)),
        pages=pages,
        datasets=tuple(_describe_dataset(store, output) for output in state.outputs.values() if output.inputs),
        verdict=judge_runs(current, changes),
        changes=changes,
        groups=tuple(group_findings((facts.run_id, facts.findings) for facts in current)),
        failed=tuple(_iterate_failed(state)),
    )


def _describe_dataset(store: Store, output: Output) -> StoredDataset:
    """Return a dataset; the page of the store links to its page if both are on this machine."""
    is_there, page = not _is_replaced(output), Path(output.where) / REPORT
    is_near = is_there and not is_url(output.where) and not is_url(store.root) and page.is_file()
    link = os.path.relpath(page, Path(store.root).absolute()) if is_near else None
    return StoredDataset(output.where, output.runs, is_there, link)


def _is_replaced(output: Output) -> bool:
    """Return whether another dataset is in this directory now."""
    out = Path(output.where)
    try:
        return (out / CARD).is_file() and read_card(out, proved=False).inputs != output.inputs
    except (DatasetError, StoreError):
        return False


def _iterate_failed(state: State) -> Iterator[FailedLog]:
    """Yield each log that failed and whose content has given no run since."""
    made = [row.log for row in state.runs.values()]
    contents, names = {log.sha256 for log in made}, {" + ".join(log.paths) for log in made}
    last = {failure.content: failure for failure in sorted(state.failed.values(), key=lambda failure: failure.version)}
    for failure in sorted(last.values(), key=lambda failure: failure.log):
        if failure.content not in contents:
            names.add(name := " + ".join(failure.log))
            acknowledged = is_acknowledged([make_failure(failure.content, failure.log)], state)
            yield FailedLog(
                name, "".join(failure.problems[:1]), "acknowledged" if acknowledged else "failed for what it holds"
            )
    for name, why in list_transient_failures([call for _, call in state.calls]).items():
        if name not in names:
            yield FailedLog(name, why, "failed for now")


_CHANGE = "run-to-run-change"
_IN_PERCENT = 100.0


def judge_runs(runs: Iterable[RunFacts], changes: Iterable[Finding]) -> Verdict:
    """Return the verdict on runs together and on their `find_changes`; of each code the worst finding is a reason."""
    return judge_by_code([*changes, *(finding for run in runs for finding in run.findings)])


def find_changes(runs: Iterable[RunFacts]) -> tuple[Finding, ...]:
    """Return a finding for each measure of a robot that its latest runs have changed, and for runs with another battery resistance."""
    runs = tuple(runs)
    series = dict[tuple[str, str, str], list[float]]()
    dated = [run for run in runs if run.start_ns is not None]
    for run in sorted(dated, key=lambda run: (run.start_ns or 0, run.run_id)):
        for measure, unit, value in _iterate_measures(run):
            series.setdefault((run.robot, measure, unit), []).append(value)
    found = ((key, shift) for key, values in series.items() if (shift := find_shift(values)) is not None)
    batteries = compare_batteries((run.run_id, run.robot, run.findings) for run in runs)
    return *batteries, *(
        make_finding(
            _CHANGE,
            Subject("column", measure),
            severity="note" if measure == _USED else None,
            names={"robot": robot, "unit": unit},
            before=shift["before"],
            after=shift["after"],
            earlier_count=shift["earlier_count"],
            latest_count=shift["latest_count"],
        )
        for (robot, measure, unit), shift in found
    )


_USED = "used share of the distance"


def _iterate_measures(run: RunFacts) -> Iterator[tuple[str, str, float]]:
    """Yield name, unit and value of measures that should stay the same from run to run."""
    if run.driven_m > 0.0:
        yield _USED, "%", _IN_PERCENT * run.kept_m / run.driven_m
    if run.energy_budget is not None:
        yield "noise floor of E", "%", _IN_PERCENT * run.energy_budget.total
    if run.idle_watt is not None:
        yield "idle power", PHYSICS_UNITS["idle"], run.idle_watt
    for term, (value, std) in run.physics.items():
        if not term.startswith("idle") and abs(value) > read_threshold(_CHANGE, "min_scatter_ratio") * std:
            yield f"physics term {term}", PHYSICS_UNITS.get(term.partition(" ")[0], ""), value


def find_shift(values: Sequence[float]) -> dict[str, float] | None:
    """Return the medians of a series' latest values and of those before, and how many they are; None where they do not differ.

    The latest quarter of the values, at most 20, is compared with those before: the medians must differ by more than three robust standard
    deviations (by the median absolute deviation) of the earlier values and by 5 % of their median (thresholds of the catalogue).
    """
    if len(values) < read_threshold(_CHANGE, "min_runs_count"):
        return None
    count = int(
        min(len(values) * read_threshold(_CHANGE, "latest_fraction"), read_threshold(_CHANGE, "max_latest_count"))
    )
    earlier, latest = np.array(values[:-count], float), np.array(values[-count:], float)
    before, after = float(np.median(earlier)), float(np.median(latest))
    scatter = estimate_robust_std(earlier - before)
    enough = max(
        read_threshold(_CHANGE, "min_scatter_ratio") * scatter,
        read_threshold(_CHANGE, "min_change_fraction") * abs(before),
    )
    if abs(after - before) <= enough:
        return None
    return {"before": before, "after": after, "earlier_count": len(earlier), "latest_count": count}
