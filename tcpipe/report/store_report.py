"""The page of a store: all its runs, what is drifting over the nights, what was lost, and what is in which dataset."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from tcpipe.cost.physics import PHYSICS_UNITS
from tcpipe.formats.finding_lines import advise_on_loss, describe_finding, format_group
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.json_files import Json
from tcpipe.motion.remedies import StoreLoss, find_largest_losses
from tcpipe.report.colours import CLASS_COLOURS
from tcpipe.report.page import Link, Number, Section, render_page
from tcpipe.report.plots import Plot, draw_waterfall, make_plot
from tcpipe.report.store_runs import FIELDS, StoredRun, StoreFacts, format_day, name_datasets, sort_runs
from tcpipe.report.verdict import show_groups
from tcpipe.tables.findings import select_problems

MOST_ROWS = 200
"""Runs that can be read without scripts: with them, all."""
_MOST_LISTED = 500

_COLUMNS = ("run", "began (UTC)", "robot", "state", "in datasets", "tags", "segments", "driven [m]", "used [%]")
_MORE_COLUMNS = ("noise floor of E [%]", "verdict", "findings")


def store_report(store: StoreFacts) -> str:
    """Return the HTML page of a store."""
    runs = sort_runs(store)
    current = [run for run in runs if run.is_current]
    losses = find_largest_losses(run.facts.ledger_m for run in current if run.facts)
    return render_page(
        title=f"Store {store.where}",
        lead="All its runs. Sums, drift and losses are of the recipe that most runs are of, superseded runs left aside.",
        verdict=show_groups(store.verdict, store.groups, len(current), findings=store.changes) if current else None,
        numbers=_make_numbers(store, current),
        warnings=[]
        if current
        else ["No run can be used. 'tcpipe ingest LOG' adds runs; 'tcpipe preflight LOG' checks a log."],
        sections=[
            *_make_table_section(store, runs),
            *_make_drift_sections(runs),
            *_make_losses_sections(current, losses),
            *_make_findings_sections(store, current),
            *_make_datasets_sections(store, runs),
            *_make_problem_sections(store, runs),
        ],
        script="store.js" if runs else "",
        data=_make_data(store, runs),
    )


def _make_numbers(store: StoreFacts, current: Sequence[StoredRun]) -> list[Number]:
    facts = [run.facts for run in current if run.facts]
    driven_m, kept_m = math.fsum(of.driven_m for of in facts), math.fsum(of.kept_m for of in facts)
    floors = [run.floor for run in current if run.floor is not None]
    return [
        Number(f"{len(current)}", "runs"),
        Number(f"{sum(of.segments for of in facts)}", "segments"),
        Number(f"{driven_m:.0f} m", "driven"),
        *([Number(f"{100 * kept_m / driven_m:.0f} %", "of the metres used")] if driven_m > 0 else []),
        *([Number(f"{100 * float(np.median(floors)):.1f} %", "noise floor of E, median")] if floors else []),
        Number(f"{sum(of.there for of in store.datasets)}", "datasets"),
        *([Number(f"{len(store.failed)}", "logs without a run")] if store.failed else []),
    ]


def _make_table_section(store: StoreFacts, runs: Sequence[StoredRun]) -> list[Section]:
    if not runs:
        return []
    names = name_datasets(store.datasets)
    rows = [
        (
            Link(run.run_id, run.href) if run.href else run.run_id,
            format_day(run.facts),
            run.facts.robot if run.facts else "",
            f"superseded by {run.facts.superseded_by}" if run.facts and run.facts.superseded_by else run.state,
            ", ".join(names[number] for number in run.datasets),
            *("" if cell is None else cell for cell in run.row([])[6:13]),
        )
        for run in runs[:MOST_ROWS]
    ]
    text = "A click on a head sorts; what is chosen in the plots below stands alone here."
    if len(runs) > MOST_ROWS:
        text += f" Without scripts the first {MOST_ROWS} of {len(runs)} stand here."
    return [Section("All runs", text, header=(*_COLUMNS, *_MORE_COLUMNS), rows=rows, controls="store.html")]


def _make_drift_sections(runs: Sequence[StoredRun]) -> list[Section]:
    """Return the plots over time; the page's script fills them."""
    dated = [run for run in runs if run.facts and run.facts.start_ns is not None]
    labels = {}
    if any(run.used_share is not None for run in dated):
        labels["used"] = "metres used [%]"
    if any(run.floor is not None for run in dated):
        labels["floor"] = "noise floor of E [%]"
    if any(run.facts and run.facts.standing_watt is not None for run in dated):
        labels["standing"] = "standing power [W]"
    if any(run.facts and run.facts.physics for run in dated):
        labels["term"] = "term of physics"
    if not labels:
        return []
    plots = list[Plot]()
    for name, label in labels.items():
        plots.append(_draw_over_time(name, label, dict(_list_robots(runs)), plots))
    text = "A point is a run. A box drawn here chooses runs in the table, and the table's filters choose here."
    return [Section("Over the nights", text, plots=plots, controls="store-drift.html" if "term" in labels else "")]


def _draw_over_time(name: str, label: str, colours: dict[str, str], drawn: Sequence[Plot]) -> Plot:
    plot = make_plot(
        f"drift {name}",
        alt=f"{label} of every run over the time at which it began; the table has the same figures.",
        axes=("", label),
        legend=colours,
        height_px=260,
        tools="box_select,tap,pan,wheel_zoom,reset,save",
        drag="box_select",
        tooltips=[("", "@run"), (label, f"@{name}{{0.00}}")],
        over_time=True,
        beside=drawn[0] if drawn else None,
    )
    # Corners, until the page's script has filled it.
    ends = {"start_ms": [0.0, 1e12], **{measure: [0.0, 1.0] for measure in ("used", "floor", "standing", "term")}}
    source = drawn[0].figure.renderers[0].data_source if drawn else {"run": [""] * 2, "fill": ["#ffffff"] * 2, **ends}
    plot.figure.scatter(
        "start_ms",
        name,
        size=7,
        fill_color="fill",
        line_color=None,
        nonselection_fill_alpha=0.12,
        source=source,
        name=name,
    )
    return plot


def _list_robots(runs: Sequence[StoredRun]) -> list[tuple[str, str]]:
    """Return the robots with their colours, those of most runs first."""
    counts = Counter(run.facts.robot for run in runs if run.facts)
    return [(robot, CLASS_COLOURS[n % len(CLASS_COLOURS)]) for n, (robot, _) in enumerate(counts.most_common())]


def _make_losses_sections(current: Sequence[StoredRun], losses: Sequence[StoreLoss]) -> list[Section]:
    ledger_m = Counter[str]()
    for run in current:
        ledger_m.update(run.facts.ledger_m if run.facts else {})
    if not ledger_m:
        return []
    rows = [
        (
            loss.reason.replace("_", " "),
            f"{loss.metres:.0f}",
            f"{100 * loss.share:.1f} %",
            loss.runs,
            advise_on_loss(loss.reason),
        )
        for loss in losses
    ]
    header = ("lost to", "metres", "of all", "runs", "to lose less")
    text = "The largest losses, and how to lose less; 'tcpipe status' lists the same."
    return [Section("Where every metre went", text, header=header, rows=rows, plots=[draw_waterfall(ledger_m)])]


def _make_findings_sections(store: StoreFacts, current: Sequence[StoredRun]) -> list[Section]:
    rows = [(of.severity, format_group(of, len(current)), len(of.of), ", ".join([*of.of][:3])) for of in store.groups]
    header = ("severity", "finding", "runs", "such as")
    text = "Of the current runs, by code, the worst first; each run's own page has all of its own."
    return [Section("Findings by code", text, header=header, rows=rows)] if rows else []


def _make_datasets_sections(store: StoreFacts, runs: Sequence[StoredRun]) -> list[Section]:
    here = {(run.run_id, run.recipe_id) for run in runs if run.is_current}
    rows = [
        (
            Link(of.out, of.page) if of.page else of.out,
            len(of.runs),
            len(here.difference(of.runs)) if of.there else "",
            "" if of.there else "another dataset lies there now",
        )
        for of in store.datasets[-_MOST_LISTED:]
    ]
    header = ("dataset", "runs in it", "runs not in it", "")
    return [Section("Datasets", "Those that were built of this store.", header=header, rows=rows)] if rows else []


def _make_problem_sections(store: StoreFacts, runs: Sequence[StoredRun]) -> list[Section]:
    """Return the logs without a run, and the runs that are damaged or cannot be read."""
    rows = [(of.log, of.state, of.why) for of in store.failed]
    for run in runs:
        if run.facts is None or (run.is_current and (run.facts.damage or run.facts.is_empty)):
            line = store.found.damaged.get((run.run_id, run.recipe_id), "ingest its log again")
            rows.append((run.run_id, run.state, _describe_problem(run.facts) if run.facts else line))
    if not rows:
        return []
    text = "'tcpipe acknowledge' marks what cannot be repaired."
    if len(rows) > _MOST_LISTED:
        text += f" The first {_MOST_LISTED} of {len(rows)}; the table above has every run."
    header = ("log or run", "is", "why")
    return [Section("Failed, damaged and empty", text, header=header, rows=rows[:_MOST_LISTED], folded=len(rows) > 20)]


def _describe_problem(facts: RunFacts) -> str:
    return next(iter(facts.damage), "") or describe_finding(select_problems(facts.findings)[0])


def _make_data(store: StoreFacts, runs: Sequence[StoredRun]) -> Json:
    terms = sorted({term for run in runs if run.facts for term in run.facts.physics if not term.startswith("standing")})
    return {
        "fields": list(FIELDS),
        "rows": [run.row(terms) for run in runs],
        "robots": [list(of) for of in _list_robots(runs)],
        "datasets": name_datasets(store.datasets),
        "codes": [f"{of.severity}: {of.code.replace('-', ' ')}" for of in store.groups],
        "terms": [f"{term} [{PHYSICS_UNITS.get(term.partition(' ')[0], '')}]" for term in terms],
    }
