"""The page of a store: all runs, changes over time, losses, findings, datasets and failed logs."""

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Any, TypeAlias, cast

import numpy as np

from tcpipe.cost.physics import PHYSICS_UNITS
from tcpipe.formats.documents import State
from tcpipe.formats.finding_lines import FindingGroup, describe_finding, group_findings
from tcpipe.formats.json_files import Json
from tcpipe.formats.runs import RunFacts
from tcpipe.power.witnesses import compare_batteries
from tcpipe.report.colours import CLASS_COLOURS
from tcpipe.report.label_sections import make_losses_sections
from tcpipe.report.page import Link, PageSection, render_page, show_verdict
from tcpipe.report.plots import Plot, make_plot
from tcpipe.store import Store, counts
from tcpipe.tables.findings import judge_by_code, select_problems
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
_SHOWN = ("tags", "segments", "driven", "energy", "wh_per_km", "used", "floor", "verdict", "findings")
"""Values of a run in the last of these columns."""


@dataclass(frozen=True, slots=True)
class StoredDataset:
    """A dataset built from the store: its place, its runs, whether it is unchanged, and its page from the store's."""

    out: str
    runs: tuple[RunKey, ...]
    there: bool
    page: str | None = None


@dataclass(frozen=True, slots=True)
class StoreFacts:
    """The content of a store's page."""

    store: Store
    state: State
    ruling: str
    """Key of the current recipe."""
    acknowledged: Collection[str]
    """Runs whose problems a person has acknowledged."""
    pages: Mapping[RunKey, str]
    """Names of the pages of runs in the store."""
    datasets: Sequence[StoredDataset]
    failed: Sequence[tuple[str, str, str]]
    """Name, state and reason of each log without a run."""


@dataclass(frozen=True, slots=True)
class RunRow:
    """A run under one recipe, and its values by name for the page's script."""

    facts: RunFacts
    is_current: bool
    """Whether it counts: it is of the current recipe, complete, and not superseded."""
    values: Mapping[str, Json]


def sort_runs(content: StoreFacts, groups: Sequence[FindingGroup], terms: Sequence[str]) -> list[RunRow]:
    """Return a row for each run and recipe, the latest first; then those without a segment.

    ``groups``: findings of the current runs by code; ``terms``: of the physics of all runs.
    """
    members, codes = dict[RunKey, list[int]](), dict[str, list[int]]()
    for number, dataset in enumerate(content.datasets):
        for part in dataset.runs if dataset.there else ():
            members.setdefault(part, []).append(number)
    for number, group in enumerate(groups):
        for run_id in group.of:
            codes.setdefault(run_id, []).append(number)
    rows = list[RunRow]()
    for facts in list_runs(content.state):
        key, why_not = (facts.run_id, facts.recipe_id), _find_why_not_current(facts, content)
        defect = facts.defect and f"{facts.defect}{', acknowledged' * (facts.run_id in content.acknowledged)}"
        values: dict[str, Json] = {
            "run": facts.run_id,
            "href": content.pages.get(key, ""),
            "start_ms": None if facts.start_ns is None else facts.start_ns // 10**6,
            "robot": facts.robot,
            "state": why_not or defect or "current",
            "superseded_by": facts.superseded_by or "",
            "tags": ", ".join(f"{name}={value}" for name, value in facts.tags.items()),
            "segments": facts.segments,
            "driven": round(facts.driven_m, 1),
            "energy": None if facts.energy_joule is None else round(facts.energy_joule / 3600, 2),
            "wh_per_km": None if facts.wh_per_km is None else round(facts.wh_per_km, 1),
            "used": round(100.0 * facts.kept_m / facts.driven_m, 2) if facts.driven_m > 0 else None,
            "floor": round(100.0 * facts.energy_budget.total, 2) if facts.energy_budget else None,
            "verdict": facts.verdict.worst,
            "findings": sum(finding.severity != "note" for finding in facts.findings),
            "datasets": [*members.get(key, ())],
            "codes": [] if why_not else [*codes.get(facts.run_id, ())],
            "idle": facts.idle_watt,
            "terms": [facts.physics[term][0] if term in facts.physics else None for term in terms],
        }
        rows.append(RunRow(facts, not why_not, values))
    rows.sort(key=lambda row: (row.facts.run_id, not row.is_current, row.facts.recipe_id))
    return sorted(rows, key=lambda row: -(row.facts.start_ns or 0))


def list_runs(state: State) -> list[RunFacts]:
    """Return all runs that were not pruned, one for each recipe."""
    return [row for row in state.list_rows() if row.blob]


def _find_why_not_current(facts: RunFacts, content: StoreFacts) -> str:
    """Return why a run is not part of the sums; "" of one that is."""
    if facts.data_model_version != DATA_MODEL_VERSION:
        return f"of data model {facts.data_model_version}"
    if not content.state.has_payload(facts):
        return _INCOMPLETE
    if facts.superseded_by:
        return "superseded"
    return _OTHER_RECIPE if facts.ingest_key != content.ruling else ""


def name_datasets(datasets: Sequence[StoredDataset]) -> list[str]:
    """Return a unique name of each dataset: the last part of its path, or the whole path."""
    short = [PurePosixPath(dataset.out).name for dataset in datasets]
    return [name if short.count(name) == 1 else dataset.out for name, dataset in zip(short, datasets, strict=True)]


def store_report(content: StoreFacts, tracks: Plot | None = None) -> str:
    """Return the HTML page of a store; with ``tracks`` of few runs on the map, these and the table come first."""
    all_runs = list_runs(content.state)
    current = [facts for facts in all_runs if counts(facts, content.state) and facts.ingest_key == content.ruling]
    groups = group_findings(((facts.run_id, facts.findings) for facts in current), len(current))
    terms = sorted({term for facts in all_runs for term in facts.physics if not term.startswith("idle")})
    runs = sort_runs(content, groups, terms)
    changes = tuple(compare_batteries((facts.run_id, facts.robot, facts.findings) for facts in current))
    verdict = judge_by_code([*changes, *(finding for facts in current for finding in facts.findings)])
    ledgers = [run.facts.distance_by_reason_m for run in runs if run.is_current]
    losses = make_losses_sections(ledgers, "The largest losses of distance and their remedies.", names_runs=True)
    drift, table = _make_drift_sections(runs), _make_table_section(content, runs)
    problem = "The store has no usable runs. 'tcpipe ingest LOG' adds runs; 'tcpipe preflight LOG' checks a log."
    if any(run.values["state"] == _OTHER_RECIPE for run in runs):
        problem = "The store has no runs of the current recipe. 'tcpipe report --recipe FILE' shows those of another."
    return render_page(
        title=f"Store {content.store.root}",
        lead="All runs. Sums, trends and losses use the runs of the current recipe and exclude superseded runs.",
        verdict=show_verdict(verdict, changes, groups) if current else None,
        numbers=_make_numbers(content, [run.facts for run in runs if run.is_current]),
        warnings=[] if current else [problem],
        sections=[
            *([PageSection("Tracks", plots=[tracks]), *table] if tracks else []),
            *(drift or losses),
            *([] if tracks else table),
            *(losses if drift else []),
            *_make_datasets_sections(content, runs),
            *_make_problem_sections(content, runs),
        ],
        script="store.js" if runs else "",
        data={
            "fields": list(runs[0].values) if runs else [],
            "rows": [[*run.values.values()] for run in runs],
            "robots": [list(robot) for robot in _list_robots(runs)],
            "datasets": name_datasets(content.datasets),
            "codes": [f"{group.severity}: {group.code.replace('-', ' ')}" for group in groups],
            "terms": [f"{term} [{PHYSICS_UNITS.get(term.partition(' ')[0], '')}]" for term in terms],
        },
    )


def _make_numbers(content: StoreFacts, facts: Sequence[RunFacts]) -> list[tuple[str, str]]:
    driven_m, kept_m = (math.fsum(getattr(each, name) for each in facts) for name in ("driven_m", "kept_m"))
    floors = [each.energy_budget.total for each in facts if each.energy_budget]
    return [
        (f"{len(facts)}", "runs"),
        (f"{sum(run_facts.segments for run_facts in facts)}", "segments"),
        (f"{driven_m:.0f} m", "driven"),
        *([(f"{100 * kept_m / driven_m:.0f} %", "of the metres used")] if driven_m > 0 else []),
        *([(f"{100 * float(np.median(floors)):.1f} %", "noise floor of E, median")] if floors else []),
        (f"{sum(dataset.there for dataset in content.datasets)}", "datasets"),
        *([(f"{len(content.failed)}", "logs without a run")] if content.failed else []),
    ]


def _make_table_section(content: StoreFacts, runs: Sequence[RunRow]) -> list[PageSection]:
    if not runs:
        return []
    names = name_datasets(content.datasets)
    rows = [
        (
            Link(run.facts.run_id, str(run.values["href"])) if run.values["href"] else run.facts.run_id,
            "" if start_ns is None else f"{datetime.fromtimestamp(start_ns // 10**9, UTC):%Y-%m-%d %H:%M}",
            run.facts.robot,
            f"superseded by {run.facts.superseded_by}" if run.facts.superseded_by else run.values["state"],
            ", ".join(names[number] for number in cast("list[int]", run.values["datasets"])),
            *("" if run.values[name] is None else run.values[name] for name in _SHOWN),
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


def _make_datasets_sections(content: StoreFacts, runs: Sequence[RunRow]) -> list[PageSection]:
    current_runs = {(run.facts.run_id, run.facts.recipe_id) for run in runs if run.is_current}
    rows = [
        (
            Link(dataset.out, dataset.page) if dataset.page else dataset.out,
            len(dataset.runs),
            len(current_runs.difference(dataset.runs)) if dataset.there else "",
            "" if dataset.there else "replaced by another dataset",
        )
        for dataset in content.datasets[-_MOST_LISTED:]
    ]
    header = ("dataset", "runs in it", "runs not in it", "")
    return (
        [PageSection("Datasets", "Datasets that were built from this store.", header=header, rows=rows)] if rows else []
    )


def _make_problem_sections(content: StoreFacts, runs: Sequence[RunRow]) -> list[PageSection]:
    """Return the logs without a run, the runs that are damaged or cannot be read, and damaged documents."""
    damaged = map(content.store.place.where, sorted(content.state.damaged))
    rows = [*content.failed, *((where, "damaged", "its bytes have changed since it was written") for where in damaged)]
    for run in runs:
        facts, state = run.facts, str(run.values["state"])
        if run.is_current and facts.defect:
            line = describe_finding((*facts.damage, *select_problems(facts.findings))[0])
            rows.append((facts.run_id, state, line))
        elif state == _INCOMPLETE or facts.data_model_version != DATA_MODEL_VERSION:
            rows.append((facts.run_id, state, "ingest its log again"))
    if not rows:
        return []
    text = "Use 'tcpipe acknowledge' for problems that cannot be repaired."
    if len(rows) > _MOST_LISTED:
        text += f" The first {_MOST_LISTED} of {len(rows)}; the table above has every run."
    header = ("log or run", "is", "why")
    return [
        PageSection("Failed, damaged and empty", text, header=header, rows=rows[:_MOST_LISTED], folded=len(rows) > 20)
    ]
