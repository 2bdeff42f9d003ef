"""The page of an evaluation: a verdict, its samples, and its tables beside those of the paper.

The paper's own results (Eder and Steinbauer-Wagner, section V), to stand beside a dataset's: tables I to V.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple
from typing import Literal

from tcpipe.cost.coverage import Coverage
from tcpipe.learning.baselines import ALL_LAYERS_PER_CLASS, GRASS_ONLY, OURS, PER_CLASS
from tcpipe.learning.evaluation import EXPECTED
from tcpipe.learning.evaluation_facts import SPLITS, Evaluation, Leakage
from tcpipe.learning.evaluation_figures import (
    WORST,
    EvaluatedSamples,
    draw_calibration,
    draw_predictions,
    make_page_data,
    make_slope_section,
)
from tcpipe.learning.metrics import ALL, LEAST, UNITS, Errors
from tcpipe.learning.predictor import find_kind
from tcpipe.report.page import Number, Section, render_page, show_verdict
from tcpipe.report.plots import draw_ratios
from tcpipe.tables.findings import judge_again

FLOORS = {"label_floor": "label noise alone", "simulation_floor": "simulation's own floor"}
"""Lower bounds of errors, and their names on the page."""

MEASURES = {"rmse": "RMSE", "mape_percent": "MAPE"}

COUNTED = "In brackets after a MAPE: the labels that it counts, if some are below " + " or ".join(
    f"{LEAST[quantity]:g} {UNITS[quantity]}" for quantity in "ET"
)
_DIGITS = {"w": 2, "v": 3, "T": 3, "E": 2}
_CALLED = {"test": "test samples of the known area", "unseen": "the unseen area"}


def render_evaluation_page(
    found: Evaluation, samples: EvaluatedSamples, *, title: str, lead: str, warnings: Sequence[str] = ()
) -> str:
    """Return the HTML page of what `evaluate` found; ``warnings`` come first."""
    has_samples = bool(samples.table.num_rows)
    parts = [*_make_class_sections(found), *_make_other_sections(found)]
    paper = Section(
        "Comparison with the paper",
        "The paper's five tables with the figures of this model.\n" + COUNTED,
        parts=[part for part in parts if part.rows],
    )
    audits = (f"{split}: {format_leakage(found.splits[split].leakage)}" for split in found.ordered_splits)
    sections = [
        *([draw_predictions(samples, " ".join(audits))] if has_samples else []),
        _make_baselines_section(found),
        _make_coverage_section(found, samples),
        *([make_slope_section(samples.table), WORST] if has_samples else []),
        paper,
    ]
    return render_page(
        title=title,
        lead=lead,
        numbers=[
            Number(
                f"{found.splits[name].errors[quantity][ALL].mape_percent or float('nan'):.2f} %",
                f"MAPE of {quantity}, {name}",
            )
            for name in found.ordered_splits
            for quantity in found.costs
        ],
        verdict=show_verdict(judge_again(found.verdict, found.findings), found.findings, labels=found.judged),
        warnings=warnings,
        sections=[section for section in sections if section.rows or section.text],
        script="evaluation.js" if has_samples else "",
        data=make_page_data(samples) if has_samples else None,
    )


def _format_figure(error: Errors | None, measure: str, quantity: str) -> str:
    value = None if error is None else getattr(error, measure)
    if error is None or value is None:
        return "–"
    if measure == "mape_percent":
        return f"{value:.2f}" + ("" if error.mape_count == error.count else f" ({error.mape_count})")
    return f"{value:.{_DIGITS[quantity]}f}"


def _format_paper_figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _format_measure(measure: str, quantity: str) -> str:
    """Return the name of a measure with its unit."""
    return f"{MEASURES[measure]} [{'%' if measure == 'mape_percent' else UNITS[quantity]}]"


def _make_baselines_section(found: Evaluation) -> Section:
    """Return the model and the baselines, with the ratio of their errors."""
    title, splits = "Comparison with baselines", found.ordered_splits
    if not found.baselines:
        return Section(title)
    by_cell = {(row.baseline, row.split, row.quantity): row for row in (*found.baselines, *found.networks)}
    names = list(dict.fromkeys(row.baseline for row in found.baselines))
    rows: list[tuple[str, ...]] = []
    for quantity in found.costs:
        own = (found.splits[split].errors[quantity][ALL] for split in splits)
        rows.append((quantity, "the model", *(_format_figure(error, "rmse", quantity) for error in own)))
        for name in names:
            results = (by_cell.get((name, split, quantity)) for split in splits)
            cells = (_format_figure(None if row is None else row.errors, "rmse", quantity) for row in results)
            rows.append(("", name, *cells))
    header = ("", "", *(f"{split}, RMSE" for split in splits))
    text = (
        "RMSE of the model over that of each baseline, on the same samples, with its 95 % interval: left of 1 the model is better.\n"
        "All are centred by class with the same rule, from their own held-out predictions (evaluation.json has all ratios). "
        "Intervals: paired bootstrap over runs or blocks, ten at least. Physics and boosting also know the turn of each segment."
    )
    table = Section("RMSE", header=header, rows=rows)
    plots = [
        draw_ratios(
            f"ratio {quantity}",
            f"RMSE ratio of {quantity}",
            [
                (f"{split}: {name}", astuple(row.rmse_ratio))
                for (name, split, row_quantity), row in by_cell.items()
                if row_quantity == quantity
            ],
        )
        for quantity in found.costs
    ]
    return Section(title, text, plots=plots, parts=[table])


def _make_coverage_section(found: Evaluation, samples: EvaluatedSamples) -> Section:
    """Return how well the model knows its errors: calibration, and the share of labels that 90 % intervals cover, with its own interval."""
    rows = [
        (
            split,
            quantity,
            _format_coverage(coverage),
            f"{error.nll:.2f}",
            f"{error.crps:.{_DIGITS[quantity]}f} {UNITS[quantity]}",
        )
        for split in found.ordered_splits
        for quantity, coverage in found.splits[split].coverage.items()
        if quantity in "ET"
        and (error := found.splits[split].errors[quantity][ALL]).nll is not None
        and error.crps is not None
    ]
    if not rows:
        return Section("Uncertainty", "The model states no uncertainty: too few samples were held out.")
    training = found.model.training
    count, config = training.samples["held out"], training.config
    is_network = find_kind(training.kind).stops_by_fold and not config.cross_fit
    text = (
        "Share of labels below each quantile of the stated errors; on the diagonal the model is calibrated.\n"
        "Steeper in the middle: underconfident; flatter: overconfident; all above: too large. Intervals rest on "
        f"errors on {count} samples of train "
        f"{'that stopped it early, which makes them slightly too small' if is_network else ', each predicted by the other folds'}. "
        "The 95 % CI of a coverage, where there are enough runs, is binomial, clustered by run."
    )
    header = ("", "", "inside the 90 % interval", "NLL [nat]", "CRPS")
    plots = draw_calibration(samples.table) if samples.table.num_rows else []
    return Section("Uncertainty", text, header=header, rows=rows, plots=plots)


def _format_coverage(coverage: Coverage) -> str:
    interval = (
        ""
        if coverage.low is None or coverage.high is None
        else f" ({100 * coverage.low:.0f}–{100 * coverage.high:.0f})"
    )
    return f"{100 * coverage.fraction:.1f} %{interval}"


def _make_class_sections(found: Evaluation) -> list[Section]:
    """Return tables I and II."""
    sections = []
    for number, split in zip(("I", "II"), SPLITS, strict=True):
        if split not in found.splits:
            continue
        part = found.splits[split]
        rows = [row for quantity in found.costs for row in _iterate_class_rows(found, split, quantity)]
        header = ("", "", *(f"{name} ({part.classes[name]})" for name in part.class_order), f"all ({part.samples})")
        sections.append(Section(f"Table {number}: {_CALLED[split]}", _TEXT[split], header=header, rows=rows))
    return sections


def _iterate_class_rows(found: Evaluation, split: str, quantity: str) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a quantity in table I or II: measures beside the paper's and their lower bounds."""
    part = found.splits[split]
    classes = [*part.class_order, ALL]

    def make_row(first: str, second: str, by_class: Mapping[str, Errors], measure: str) -> tuple[str, ...]:
        return first, second, *(_format_figure(by_class.get(name), measure, quantity) for name in classes)

    for measure in MEASURES:
        yield make_row(f"{quantity}, {_format_measure(measure, quantity)}", "", part.errors[quantity], measure)
        of_paper = dict(zip(CLASSES, BY_CLASS[split, quantity, measure], strict=True))
        yield ("", "paper", *(_format_paper_figure(of_paper.get(name)) for name in classes))
        if measure != "rmse":
            continue
        if split == "test" and found.blocks is not None:
            yield make_row("", "blocks of train", found.blocks[quantity], measure)
        for floor, errors in part.floors.items():
            yield make_row("", FLOORS[floor], errors[quantity], measure)
        if (repeats := found.repeatability[quantity]) is not None:
            blank = [""] * len(part.classes)
            yield ("", "repeatability", *blank, f"{repeats.std:.{_DIGITS[quantity]}f}")


def format_leakage(leakage: Leakage | None) -> str:
    """Return how near to training a split is, in words."""
    if leakage is None:
        return "Its distance from training is unknown."
    sharing = "" if leakage.sharing_percent is None else f"; {leakage.sharing_percent:.0f} % share ground with one"
    return (
        f"Audit (test held out by {leakage.holdout}): the middles of {leakage.near_percent:.0f} % of these samples are within "
        f"{leakage.within_m:.2f} m of a training sample's{sharing}."
    )


_TEXT = {
    "test": "Blocks of train are held out. Label noise alone: the error of a perfect prediction, by what labels of a run do not share.",
    "unseen": "The paper calls it validation; tcpipe uses it neither for tuning nor for early stopping.",
}


def _make_other_sections(found: Evaluation) -> list[Section]:
    """Return tables III to V: other inputs, other networks, the expected time."""
    ablation = {
        "+".join(row.layers): {split: row.on(split)["E"] for split in found.ordered_splits}
        for row in found.ablation
        if "E" in found.costs
    }
    noise = f"Layers not named are replaced by noise ({found.config.noise_draws} draws)."
    networks = (
        "Beside the one network: one of each class with all layers, and Wei and Isler's, which predict E from heights alone.\n"
        "Each takes as many steps as ours and is centred by class; ratios stand among those of the baselines. "
    )
    if not found.networks:
        networks += "They are trained only if the model is a network."
    compared = (OURS, ALL_LAYERS_PER_CLASS, PER_CLASS, GRASS_ONLY)
    others = {name: found.energy[name] for name in compared if name in found.energy}
    times = {EXPECTED: found.time[EXPECTED]} if EXPECTED in found.time else {}
    of_time = "The expected time is d / v at the robot's maximum speed."
    return [
        _make_other_section("Table III: ablation, E", noise, found, "E", ablation),
        _make_other_section("Table IV: energy, one network or one per class", networks, found, "E", others),
        _make_other_section("Table V: time against the expected time", of_time, found, "T", times),
    ]


def _make_other_section(
    title: str,
    text: str,
    found: Evaluation,
    quantity: Literal["E", "T"],
    errors: Mapping[str, Mapping[str, Errors]],
) -> Section:
    """Return errors of a quantity by predictor, on every split, beside the paper's."""
    splits = found.ordered_splits
    rows: list[tuple[str, ...]] = []
    for name, by_split in errors.items():
        figures = (_format_figure(by_split.get(split), measure, quantity) for split in splits for measure in MEASURES)
        rows.append((name, "", *figures))
        if name in PAPER:
            values = (value for split in splits for value in PAPER[name][SPLITS.index(split)])
            rows.append(("", "paper", *map(_format_paper_figure, values)))
    header = ("", "", *(f"{split}, {_format_measure(measure, quantity)}" for split in splits for measure in MEASURES))
    return Section(title, text, header=header, rows=rows)


CLASSES = ("grass", "mud", "unpaved road", "paved road", "all")
"""Columns of `BY_CLASS`."""

BY_CLASS = {
    ("test", "T", "rmse"): (0.06, 0.10, 0.03, 0.07, 0.06),
    ("test", "T", "mape_percent"): (3.26, 5.50, 1.74, 3.52, 3.37),
    ("test", "E", "rmse"): (18.22, 29.26, 10.98, 25.55, 21.51),
    ("test", "E", "mape_percent"): (11.06, 10.64, 6.15, 12.90, 10.77),
    ("unseen", "T", "rmse"): (0.09, 0.09, 0.04, 0.09, 0.08),
    ("unseen", "T", "mape_percent"): (5.74, 5.18, 2.91, 5.67, 5.04),
    ("unseen", "E", "rmse"): (27.50, 49.58, 19.24, 22.69, 26.63),
    ("unseen", "E", "mape_percent"): (13.04, 22.46, 10.12, 13.69, 12.80),
}
"""Tables I and II: split (the paper's validation is ``unseen``), quantity, measure, to a value a class."""

PAPER = {
    "O+C+H": ((21.51, 10.77), (26.63, 12.80)),
    "C+H": ((30.35, 12.29), (27.59, 14.53)),
    "O+H": ((22.17, 10.92), (34.95, 17.38)),
    "O+C": ((67.59, 47.84), (73.75, 52.20)),
    "O": ((57.34, 57.17), (87.39, 60.39)),
    "C": ((91.93, 47.16), (79.83, 40.07)),
    "H": ((28.67, 13.31), (32.09, 17.36)),
    OURS: ((21.51, 10.77), (26.63, 12.80)),
    GRASS_ONLY: ((51.39, 27.25), (56.16, 28.37)),
    PER_CLASS: ((34.52, 14.64), (32.92, 16.96)),
    EXPECTED: ((0.22, 17.45), (0.17, 13.82)),
}
"""Tables III (layers that are left) to V: RMSE [J or s] and MAPE [%] of E, or of T for the expected time, on test and on unseen."""
