"""The verdict on a store: what the findings of its current runs say, and what has changed from run to run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.cost.physics import PHYSICS_UNITS
from tcpipe.formats.index_files import RunFacts
from tcpipe.tables.catalogue import Severity, read_threshold
from tcpipe.tables.findings import Finding, Subject, Verdict, judge_by_code, make_finding

_CHANGE = "run-to-run-change"
_IN_PERCENT = 100.0


def judge_runs(runs: Iterable[RunFacts], changes: Iterable[Finding]) -> Verdict:
    """Return the verdict on runs together and on their `find_changes`; of each code the worst finding is a reason."""
    return judge_by_code([*changes, *(finding for run in runs for finding in run.findings)])


def find_changes(runs: Iterable[RunFacts]) -> tuple[Finding, ...]:
    """Return a finding for each measure of a robot that its latest runs have changed."""
    series = dict[tuple[str, str, str], list[float]]()
    dated = [run for run in runs if run.start_ns is not None]
    for run in sorted(dated, key=lambda run: (run.start_ns or 0, run.run_id)):
        for measure, unit, value in _iterate_measures(run):
            series.setdefault((run.robot, measure, unit), []).append(value)
    return tuple(_find_changes(series.items()))


def _find_changes(series: Iterable[tuple[tuple[str, str, str], Sequence[float]]]) -> Iterator[Finding]:
    for (robot, measure, unit), values in series:
        if (shift := find_shift(values)) is not None:
            severity: Severity | None = "note" if measure == _USED else None
            names = {"robot": robot, "unit": unit}
            yield make_finding(
                _CHANGE,
                Subject("column", measure),
                severity=severity,
                names=names,
                before=shift.before,
                after=shift.after,
                earlier_count=shift.earlier_count,
                latest_count=shift.latest_count,
            )


_USED = "used share of the distance"


def _iterate_measures(run: RunFacts) -> Iterator[tuple[str, str, float]]:
    """Yield name, unit and value of measures that should stay the same from run to run."""
    if run.driven_m > 0.0:
        yield _USED, "%", _IN_PERCENT * run.kept_m / run.driven_m
    if run.energy_budget is not None:
        yield "noise floor of E", "%", _IN_PERCENT * run.energy_budget.total
    if run.standing_watt is not None:
        yield "standing power", PHYSICS_UNITS["standing"], run.standing_watt
    for term, (value, std) in run.physics.items():
        if not term.startswith("standing") and abs(value) > read_threshold(_CHANGE, "min_scatter_ratio") * std:
            yield f"physics term {term}", PHYSICS_UNITS.get(term.partition(" ")[0], ""), value


@dataclass(frozen=True, slots=True)
class Shift:
    """The medians of a series' latest values and of those before, and how many there are of each."""

    before: float
    after: float
    earlier_count: int
    latest_count: int


def find_shift(values: Sequence[float]) -> Shift | None:
    """Return how the latest values of a series differ from those before; None where they do not.

    The latest quarter of the values, at most 20, is compared with those before: the medians must differ by more than three robust standard
    deviations (1.4826 times the median absolute deviation) of the earlier values and by 5 % of their median (thresholds of the catalogue).
    """
    if len(values) < read_threshold(_CHANGE, "min_runs_count"):
        return None
    count = int(
        min(len(values) * read_threshold(_CHANGE, "latest_fraction"), read_threshold(_CHANGE, "max_latest_count"))
    )
    earlier, latest = np.array(values[:-count], float), np.array(values[-count:], float)
    before, after = float(np.median(earlier)), float(np.median(latest))
    scatter = 1.4826 * float(np.median(np.abs(earlier - before)))
    enough = max(
        read_threshold(_CHANGE, "min_scatter_ratio") * scatter,
        read_threshold(_CHANGE, "min_change_fraction") * abs(before),
    )
    if abs(after - before) <= enough:
        return None
    return Shift(before, after, len(earlier), count)
