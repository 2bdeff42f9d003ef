"""The page of a store: all runs, changes over time, losses, findings, datasets and failed logs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Any, TypeAlias

import numpy as np

from tcpipe.cost.physics import PHYSICS_UNITS
from tcpipe.formats.finding_lines import FindingGroup, describe_finding
from tcpipe.formats.json_files import Json
from tcpipe.formats.runs import RunFacts
from tcpipe.report.colours import CLASS_COLOURS
from tcpipe.report.label_sections import make_losses_sections
from tcpipe.report.page import Link, Number, PageSection, render_page, show_verdict
from tcpipe.report.plots import Plot, make_plot
from tcpipe.tables.findings import Finding, Verdict, select_problems
from tcpipe.tables.levels import DATA_MODEL_VERSION

RunKey: TypeAlias = tuple[str, str]
"""Run and recipe."""
_INCOMPLETE, _OTHER_RECIPE = "tables missing", "of another recipe"
MOST_ROWS = 200
"""Runs that can be read without scripts: with them, all."""
_MOST_LISTED = 500

_COLUMNS = (
    *("run", "began (UTC)", "robot", "state", "in datasets", "tags", "segments", "driven [m]", "E [Wh]", "Wh/km"),
    *("used [%]", "noise floor of E [%]", "verdict", "findings"),
)


@dataclass(frozen=True, slots=True)
class StoredDataset:
    """A dataset built from the store: its place, its runs, whether it is unchanged, and its page from the store's."""

    out: str
    runs: tuple[RunKey, ...]
    there: bool
    page: str | None = None


@dataclass(frozen=True, slots=True)
class FailedLog:
    """A log without a run: reason and state."""

    log: str
    why: str
    state: str


@dataclass(frozen=True, slots=True)
class StoreFacts:
    """The content of a store's page."""

    where: str
    rows: tuple[RunFacts, ...]
    """All runs that were not pruned, one for each recipe."""
    ruling: str
    """Key of the current recipe."""
    incomplete: frozenset[RunKey]
    """Runs whose tables are missing."""
    damaged: tuple[str, ...]
    """Documents that are not as they were written."""
    acknowledged: frozenset[str]
    """Runs whose problems a person has acknowledged."""
    pages: Mapping[RunKey, str]
    """Names of the pages of runs in the store."""
    datasets: tuple[StoredDataset, ...]
    verdict: Verdict
    """On the current runs together."""
    changes: tuple[Finding, ...]
    """Changes in the latest of them."""
    groups: tuple[FindingGroup[str], ...]
    """Findings of the current runs by code, the worst first."""
    failed: tuple[FailedLog, ...]


@dataclass(frozen=True, slots=True)
class RunRow:
    """A row of the page: a run under one recipe with its state, page, datasets and codes of findings."""

    state: str
    facts: RunFacts
    href: str
    datasets: tuple[int, ...]
    codes: tuple[int, ...]
    """Places in `StoreFacts.groups`."""
    is_current: bool = False
    """Whether it counts: it is of the current recipe, complete, and not superseded."""

    def row(self, terms: Sequence[str]) -> list[Json]:
        """Return the values of `_FIELDS` for the page's script."""
        facts = self.facts
        return [
            facts.run_id,
            self.href,
            None if facts.start_ns is None else facts.start_ns // 10**6,
            facts.robot,
            self.state,
            facts.superseded_by or "",
            ", ".join(f"{key}={value}" for key, value in facts.tags.items()),
            facts.segments,
            round(facts.driven_m, 1),
            None if facts.energy_joule is None else round(facts.energy_joule / 3600, 2),
            None if facts.wh_per_km is None else round(facts.wh_per_km, 1),
            round(100.0 * facts.kept_m / facts.driven_m, 2) if facts.driven_m > 0 else None,
            round(100.0 * facts.energy_budget.total, 2) if facts.energy_budget else None,
            facts.verdict.worst,
            sum(finding.severity != "note" for finding in facts.findings),
            list(self.datasets),
            list(self.codes),
            facts.idle_watt,
            [facts.physics[term][0] if term in facts.physics else None for term in terms],
        ]


_FIELDS = (
    *("run", "href", "start_ms", "robot", "state", "superseded_by", "tags", "segments", "driven"),
    *("energy", "wh_per_km", "used", "floor", "verdict", "findings", "datasets", "codes", "idle", "terms"),
)


def sort_runs(store: StoreFacts) -> list[RunRow]:
    """Return a row for each run and recipe, the latest first; then those without a segment."""
    members, codes = dict[RunKey, list[int]](), dict[str, list[int]]()
    for number, dataset in enumerate(store.datasets):
        for part in dataset.runs if dataset.there else ():
            members.setdefault(part, []).append(number)
    for number, group in enumerate(store.groups):
        for run_id in group.of:
            codes.setdefault(run_id, []).append(number)
    rows = list[RunRow]()
    for facts in store.rows:
        key, why_not = (facts.run_id, facts.recipe_id), _find_why_not_current(facts, store)
        defect = facts.defect and f"{facts.defect}{', acknowledged' * (facts.run_id in store.acknowledged)}"
        state = why_not or defect or "current"
        its_codes = () if why_not else tuple(codes.get(facts.run_id, ()))
        rows.append(RunRow(state, facts, store.pages.get(key, ""), tuple(members.get(key, ())), its_codes, not why_not))
    rows.sort(key=lambda row: (row.facts.run_id, not row.is_current, row.facts.recipe_id))
    return sorted(rows, key=lambda row: -(row.facts.start_ns or 0))


def _find_why_not_current(facts: RunFacts, store: StoreFacts) -> str:
    """Return why a run is not part of the sums; "" of one that is."""
    if facts.data_model_version != DATA_MODEL_VERSION:
        return f"of data model {facts.data_model_version}"
    if (facts.run_id, facts.recipe_id) in store.incomplete:
        return _INCOMPLETE
    if facts.superseded_by:
        return "superseded"
    return _OTHER_RECIPE if facts.ingest_key != store.ruling else ""


def name_datasets(datasets: Sequence[StoredDataset]) -> list[str]:
    """Return a unique name of each dataset: the last part of its path, or the whole path."""
    short = [PurePosixPath(dataset.out).name for dataset in datasets]
    return [name if short.count(name) == 1 else dataset.out for name, dataset in zip(short, datasets, strict=True)]


def store_report(store: StoreFacts, tracks: Plot | None = None) -> str:
    """Return the HTML page of a store; with ``tracks`` of few runs on the map, these and the table come first."""
    runs = sort_runs(store)
    current = [run for run in runs if run.is_current]
    groups = [(group, len(current), "runs") for group in store.groups]
    ledgers = [run.facts.distance_by_reason_m for run in current]
    losses = make_losses_sections(ledgers, "The largest losses of distance and their remedies.", names_runs=True)
    drift, table = _make_drift_sections(runs), _make_table_section(store, runs)
    problem = "The store has no usable runs. 'tcpipe ingest LOG' adds runs; 'tcpipe preflight LOG' checks a log."
    if any(run.state == _OTHER_RECIPE for run in runs):
        problem = "The store has no runs of the current recipe. 'tcpipe report --recipe FILE' shows those of another."
    return render_page(
        title=f"Store {store.where}",
        lead="All runs. Sums, trends and losses use the runs of the current recipe and exclude superseded runs.",
        verdict=show_verdict(store.verdict, store.changes, groups) if current else None,
        numbers=_make_numbers(store, current),
        warnings=[] if current else [problem],
        sections=[
            *([PageSection("Tracks", plots=[tracks]), *table] if tracks else []),
            *(drift or losses),
            *([] if tracks else table),
            *(losses if drift else []),
            *_make_datasets_sections(store, runs),
            *_make_problem_sections(store, runs),
        ],
        script="store.js" if runs else "",
        data=_make_data(store, runs),
    )


def _make_numbers(store: StoreFacts, current: Sequence[RunRow]) -> list[Number]:
    facts = [run.facts for run in current]
    driven_m, kept_m = (math.fsum(getattr(each, name) for each in facts) for name in ("driven_m", "kept_m"))
    floors = [each.energy_budget.total for each in facts if each.energy_budget]
    return [
        Number(f"{len(current)}", "runs"),
        Number(f"{sum(run_facts.segments for run_facts in facts)}", "segments"),
        Number(f"{driven_m:.0f} m", "driven"),
        *([Number(f"{100 * kept_m / driven_m:.0f} %", "of the metres used")] if driven_m > 0 else []),
        *([Number(f"{100 * float(np.median(floors)):.1f} %", "noise floor of E, median")] if floors else []),
        Number(f"{sum(dataset.there for dataset in store.datasets)}", "datasets"),
        *([Number(f"{len(store.failed)}", "logs without a run")] if store.failed else []),
    ]


def _make_table_section(store: StoreFacts, runs: Sequence[RunRow]) -> list[PageSection]:
    if not runs:
        return []
    names = name_datasets(store.datasets)
    rows = [
        (
            Link(run.facts.run_id, run.href) if run.href else run.facts.run_id,
            "" if start_ns is None else f"{datetime.fromtimestamp(start_ns // 10**9, UTC):%Y-%m-%d %H:%M}",
            run.facts.robot,
            f"superseded by {run.facts.superseded_by}" if run.facts.superseded_by else run.state,
            ", ".join(names[number] for number in run.datasets),
            *("" if cell is None else cell for cell in run.row([])[6:15]),
        )
        for run in runs[:MOST_ROWS]
        for start_ns in (run.facts.start_ns,)
    ]
    text = "Click a column head to sort; a selection in the plots filters the table."
    if len(runs) > MOST_ROWS:
        text += f" Without scripts the table shows the first {MOST_ROWS} of {len(runs)}."
    return [PageSection("All runs", text, header=_COLUMNS, rows=rows, controls="store.html")]


def _make_drift_sections(runs: Sequence[RunRow]) -> list[PageSection]:
    """Return the plots over time; the page's script fills them."""
    dated = [run for run in runs if run.facts.start_ns is not None]
    is_known = {
        "metres used [%]": ("used", any(run.facts.driven_m > 0 for run in dated)),
        "noise floor of E [%]": ("floor", any(run.facts.energy_budget for run in dated)),
        "idle power [W]": ("idle", any(run.facts.idle_watt is not None for run in dated)),
        "term of physics": ("term", any(run.facts.physics for run in dated)),
    }
    names = {name: label for label, (name, known) in is_known.items() if known}
    if not names:
        return []
    corners = {name: [0.0, 1.0] for name in ("used", "floor", "idle", "term")}  # until the page's script fills it
    source: Any = {"run": [""] * 2, "fill": ["#ffffff"] * 2, "start_ms": [0.0, 1e12], **corners}
    plots: list[Plot] = []
    for name, label in names.items():
        plot = make_plot(
            f"drift {name}",
            alt=f"{label} of every run over the time at which it began; the table lists the same values.",
            axes=("", label),
            legend={} if plots else dict(_list_robots(runs)),
            height_px=260,
            tools="box_select,tap,pan,wheel_zoom,reset,save",
            drag="box_select",
            tooltips=[("", "@run"), (label, f"@{name}{{0.00}}")],
            x_axis_type="datetime",
            **({"x_range": plots[0].figure.x_range} if plots else {}),
        )
        plot.figure.x_range.default_span = 86_400_000  # of a single time: a day, in milliseconds
        points = plot.figure.scatter(
            "start_ms",
            name,
            size=7,
            fill_color="fill",
            line_color=None,
            nonselection_fill_alpha=0.12,
            source=source,
            name=name,
        )
        source = points.data_source
        plots.append(plot)
    text = "Each point is a run. A box drawn here selects runs in the table; the filters of the table apply here."
    return [PageSection("Trends over time", text, plots=plots, controls="store-drift.html" if "term" in names else "")]


def _list_robots(runs: Sequence[RunRow]) -> list[tuple[str, str]]:
    """Return the robots with their colours, those of most runs first."""
    counts = Counter(run.facts.robot for run in runs)
    return [(robot, CLASS_COLOURS[n % len(CLASS_COLOURS)]) for n, (robot, _) in enumerate(counts.most_common())]


def _make_datasets_sections(store: StoreFacts, runs: Sequence[RunRow]) -> list[PageSection]:
    current_runs = {(run.facts.run_id, run.facts.recipe_id) for run in runs if run.is_current}
    rows = [
        (
            Link(dataset.out, dataset.page) if dataset.page else dataset.out,
            len(dataset.runs),
            len(current_runs.difference(dataset.runs)) if dataset.there else "",
            "" if dataset.there else "replaced by another dataset",
        )
        for dataset in store.datasets[-_MOST_LISTED:]
    ]
    header = ("dataset", "runs in it", "runs not in it", "")
    return (
        [PageSection("Datasets", "Datasets that were built from this store.", header=header, rows=rows)] if rows else []
    )


def _make_problem_sections(store: StoreFacts, runs: Sequence[RunRow]) -> list[PageSection]:
    """Return the logs without a run, the runs that are damaged or cannot be read, and damaged documents."""
    rows = [(log.log, log.state, log.why) for log in store.failed]
    rows += [(document, "damaged", "its bytes have changed since it was written") for document in store.damaged]
    for run in runs:
        facts = run.facts
        if run.is_current and facts.defect:
            line = describe_finding((*facts.damage, *select_problems(facts.findings))[0])
            rows.append((facts.run_id, run.state, line))
        elif run.state == _INCOMPLETE or facts.data_model_version != DATA_MODEL_VERSION:
            rows.append((facts.run_id, run.state, "ingest its log again"))
    if not rows:
        return []
    text = "Use 'tcpipe acknowledge' for problems that cannot be repaired."
    if len(rows) > _MOST_LISTED:
        text += f" The first {_MOST_LISTED} of {len(rows)}; the table above has every run."
    header = ("log or run", "is", "why")
    return [
        PageSection("Failed, damaged and empty", text, header=header, rows=rows[:_MOST_LISTED], folded=len(rows) > 20)
    ]


def _make_data(store: StoreFacts, runs: Sequence[RunRow]) -> Json:
    terms = sorted({term for run in runs for term in run.facts.physics if not term.startswith("idle")})
    return {
        "fields": list(_FIELDS),
        "rows": [run.row(terms) for run in runs],
        "robots": [list(robot) for robot in _list_robots(runs)],
        "datasets": name_datasets(store.datasets),
        "codes": [f"{group.severity}: {group.code.replace('-', ' ')}" for group in store.groups],
        "terms": [f"{term} [{PHYSICS_UNITS.get(term.partition(' ')[0], '')}]" for term in terms],
    }
