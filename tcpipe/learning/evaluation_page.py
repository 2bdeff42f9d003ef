"""Page of an evaluation: verdict, samples, and tables with the paper's (Eder and Steinbauer-Wagner, section V)."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tcpipe.cost.coverage import Coverage
from tcpipe.dataset.energies import ENERGIES
from tcpipe.learning.baselines import SPLITS
from tcpipe.learning.evaluation import EXPECTED, OURS, UNKNOWN_DISTANCE, Evaluation
from tcpipe.learning.metrics import ALL, LEAST, UNITS, Errors
from tcpipe.learning.predictions import compute_cost_errors, find_main_cost, find_worst_rows, make_column_name
from tcpipe.learning.predictor import find_kind
from tcpipe.report.colours import FAINT, choose_class_colours
from tcpipe.report.page import PageSection, Shaded, render_page, show_verdict
from tcpipe.report.plots import Plot, make_plot, show_text
from tcpipe.tables.columns import to_floats, to_texts
from tcpipe.tables.findings import judge_again, read_threshold
from tcpipe.terrain.layers import TerrainClass

MEASURES = {"rmse": "RMSE", "mape_percent": "MAPE"}

COUNTED = "In brackets after a MAPE: the labels that it counts, if some are below " + " or ".join(
    f"{LEAST[quantity]:g} {UNITS[quantity]}" for quantity in "ET"
)
_DIGITS = {"w": 2, "v": 3, "T": 3, "E": 2}
_CALLED = {"test": "test samples of the known area", "unseen": "the unseen area"}


def render_evaluation_page(found: Evaluation, table: pa.Table) -> str:
    """Return the HTML page of an evaluation and its table of predictions."""
    name, of_power = found.dataset.name, found.model.label_energy
    note = "" if of_power == "total" else f" (w and E {ENERGIES[of_power].words})"
    costs = "time T and energy E" if "E" in found.costs else "time T"
    paper = PageSection(
        "Comparison with the paper",
        "The paper's tables with the figures of this model; "
        "'tcpipe benchmark' and 'reproduce' add its other networks.\n" + COUNTED,
        parts=[part for part in (*_make_class_sections(found), *_make_other_sections(found)) if part.rows],
    )
    audits = (f"{split}: {found.splits[split].leakage or UNKNOWN_DISTANCE}" for split in found.ordered_splits)
    sections = [
        draw_predictions(table, " ".join(audits)),
        _make_baselines_section(found),
        _make_coverage_section(found),
        make_slope_section(table),
        make_worst_section(table),
        paper,
    ]
    return render_page(
        title=f"Evaluation on {name}",
        lead=f"Model {Path(found.model.name).name} on dataset {name}: errors of {costs}{note}.",
        numbers=[
            (
                f"{found.splits[split].errors[quantity][ALL].mape_percent or float('nan'):.2f} %",
                f"MAPE of {quantity}, {split}",
            )
            for split in found.ordered_splits
            for quantity in found.costs
        ],
        verdict=show_verdict(judge_again(found.verdict, found.findings), found.findings, labels=found.judged),
        sections=[section for section in sections if section.rows or section.text],
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


def _make_baselines_section(found: Evaluation) -> PageSection:
    """Return the model and the baselines, with the ratio of their errors."""
    title, splits = "Comparison with baselines", found.ordered_splits
    if not found.baselines:
        return PageSection(title)
    by_cell = {(row.baseline, row.split, row.quantity): row for row in found.baselines}
    names = list(dict.fromkeys(row.baseline for row in found.baselines))
    rows: list[tuple[str, ...]] = []
    for quantity in found.costs:
        own = (found.splits[split].errors[quantity][ALL] for split in splits)
        cells = (cell for error in own for cell in (_format_figure(error, "rmse", quantity), ""))
        rows.append((quantity, "the model", *cells))
        for name in names:
            results = [by_cell.get((name, split, quantity)) for split in splits]
            cells = (
                cell
                for row in results
                for cell in (
                    _format_figure(None if row is None else row.errors, "rmse", quantity),
                    "" if row is None else str(row.rmse_ratio),
                )
            )
            rows.append(("", name, *cells))
    header = ("", "", *(f"{split}, {column}" for split in splits for column in ("RMSE", "ratio")))
    text = (
        "Ratio: RMSE of the model over that of each baseline, on the same samples, with its 95 % interval; "
        "below 1 the model is better.\n"
        "All are centred by class with the same rule, from their own held-out predictions "
        "(evaluation.json has all ratios). Intervals: paired bootstrap over runs or blocks, ten at least. "
        "Physics and boosting also know the turn of each segment."
    )
    return PageSection(title, text, header=header, rows=rows)


def _make_coverage_section(found: Evaluation) -> PageSection:
    """Return the coverage of 90 % intervals with its own interval, and the scores of the stated errors."""
    rows = [
        (
            split,
            quantity,
            _format_coverage(coverage),
            f"{error.nll:.2f}",
            f"{error.crps:.{_DIGITS[quantity]}f} {UNITS[quantity]}",
        )
        for split in found.ordered_splits
        for quantity in found.costs
        if (coverage := found.splits[split].coverage.get(quantity)) is not None
        and (error := found.splits[split].errors[quantity][ALL]).nll is not None
        and error.crps is not None
    ]
    if not rows:
        return PageSection("Uncertainty", "The model states no uncertainty: too few samples were held out.")
    training = found.model.training
    is_network, count = find_kind(training.kind).stops_by_fold, training.samples["held out"]
    held_out = (
        "that stopped it early, so that they are slightly too narrow" if is_network else "predicted by the other folds"
    )
    text = (
        f"Intervals rest on errors on {count} samples of train {held_out}. The 95 % CI of a coverage, "
        "if there are enough runs, is "
        "binomial, clustered by run."
    )
    header = ("", "", "inside the 90 % interval", "NLL [nat]", "CRPS")
    return PageSection("Uncertainty", text, header=header, rows=rows)


def _format_coverage(coverage: Coverage) -> str:
    interval = (
        ""
        if coverage.low is None or coverage.high is None
        else f" ({100 * coverage.low:.0f}–{100 * coverage.high:.0f})"
    )
    return f"{100 * coverage.fraction:.1f} %{interval}"


def _make_class_sections(found: Evaluation) -> list[PageSection]:
    """Return tables I and II."""
    sections = []
    for number, split in zip(("I", "II"), SPLITS, strict=True):
        if split not in found.splits:
            continue
        part = found.splits[split]
        rows = [row for quantity in found.costs for row in _iterate_class_rows(found, split, quantity)]
        header = ("", "", *(f"{name} ({part.classes[name]})" for name in part.class_order), f"all ({part.samples})")
        sections.append(PageSection(f"Table {number}: {_CALLED[split]}", _TEXT[split], header=header, rows=rows))
    return sections


def _iterate_class_rows(found: Evaluation, split: str, quantity: str) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a quantity in table I or II: measures, the paper's values and lower bounds."""
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
        yield make_row("", "label noise alone", part.label_floor[quantity], measure)


_TEXT = {
    "test": "Label noise alone: the error of a perfect prediction, without the error that all labels of a run share.",
    "unseen": "The paper calls it validation; tcpipe uses it neither for tuning nor for early stopping.",
}


def _make_other_sections(found: Evaluation) -> list[PageSection]:
    """Return tables III and V: other inputs, the expected time."""
    ablation = {
        "+".join(row.layers): {split: row.errors[split]["E"] for split in found.ordered_splits}
        for row in found.ablation
        if "E" in found.costs
    }
    noise = f"Layers not named are replaced by noise ({found.config.noise_draws} draws)."
    times = {EXPECTED: found.time[EXPECTED]} if EXPECTED in found.time else {}
    of_time = "The expected time is d / v at the robot's maximum speed."
    return [
        _make_other_section("Table III: ablation, E", noise, found, "E", ablation),
        _make_other_section("Table V: time against the expected time", of_time, found, "T", times),
    ]


def _make_other_section(
    title: str, text: str, found: Evaluation, quantity: Literal["E", "T"], errors: Mapping[str, Mapping[str, Errors]]
) -> PageSection:
    """Return errors of a quantity by predictor on every split, with the paper's errors."""
    splits = found.ordered_splits
    rows: list[tuple[str, ...]] = []
    for name, by_split in errors.items():
        figures = (_format_figure(by_split.get(split), measure, quantity) for split in splits for measure in MEASURES)
        rows.append((name, "", *figures))
        if name in PAPER:
            values = (value for split in splits for value in PAPER[name][SPLITS.index(split)])
            rows.append(("", "paper", *map(_format_paper_figure, values)))
    header = ("", "", *(f"{split}, {_format_measure(measure, quantity)}" for split in splits for measure in MEASURES))
    return PageSection(title, text, header=header, rows=rows)


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
    EXPECTED: ((0.22, 17.45), (0.17, 13.82)),
}
"""Tables III (remaining layers) to V: RMSE [J or s] and MAPE [%] of E, or of T for the expected time, on test and on
unseen."""


_CALLED_QUANTITY = {"w": "power w", "v": "velocity v", "T": "time T", "E": "energy E"}
_MOST_DRAWN = 5_000  # largest number of samples in a scatter plot; samples are in random order
_WORST = 10  # samples of each split in the table of the largest errors
# Between the ranges of slope along travel [deg]; the paper's robot climbs 22.5°.
_SLOPE_EDGES_DEG = (-15.0, -10.0, -5.0, -2.0, 2.0, 5.0, 10.0, 15.0)
_SLOPE_NAMES = (
    *("below -15°", "-15° to -10°", "-10° to -5°", "-5° to -2°", "-2° to 2°"),
    *("2° to 5°", "5° to 10°", "10° to 15°", "above 15°"),
)
_WHOLE_JOULE = 10.0  # RMSE of E from which whole joules are printed [J], so that nine ranges of slope fit


def draw_predictions(table: pa.Table, audit: str) -> PageSection:
    """Return a point for each sample, E and T; ``audit`` gives their distance from training samples."""
    text = "Each point is a segment, coloured by class; on the line the prediction is exact. Point at one for its name."
    plotted = table.slice(0, _MOST_DRAWN)
    if plotted.num_rows < table.num_rows:
        text += f" {plotted.num_rows} of {table.num_rows} are drawn, at random."
    class_id, names = plotted.column("terrain_class").to_numpy(), to_texts(plotted.column("terrain_name"))
    found = dict(zip(class_id.tolist(), map(str, names), strict=True))
    classes = [TerrainClass(number, found[number], traversable=True) for number in sorted(found)]
    legend = {found[number]: colour for number, colour in choose_class_colours(classes).items()}
    plots = list[Plot]()
    for quantity in ("E", "T"):
        label, predicted = (to_floats(plotted, make_column_name(quantity, part)) for part in ("", "predicted"))
        known = np.isfinite(label + predicted)
        if not known.any():
            continue
        plot = make_plot(
            f"against {quantity}",
            alt=(
                f"Predicted over measured {_CALLED_QUANTITY[quantity]}, a point a sample; "
                "the tables below list the figures by class."
            ),
            axes=(f"{_CALLED_QUANTITY[quantity]}, measured [{UNITS[quantity]}]", f"predicted [{UNITS[quantity]}]"),
            legend={} if plots else legend,
            height_px=380,
        )
        source = {
            "x": label[known], "y": predicted[known], "colour": [legend[str(name)] for name in names[known]],
            "text": to_texts(plotted.column("sample_id"))[known].tolist(),
        }  # fmt: skip
        show_text(plot, plot.figure.scatter("x", "y", size=5, color="colour", alpha=0.6, source=source))
        ends = [float(label[known].min()), float(label[known].max())]
        plot.figure.line(ends, ends, color=FAINT, line_width=2, line_dash="dashed")
        plots.append(plot)
    return PageSection("Measured against predicted", f"{text}\n{audit}", plots=plots)


def make_worst_section(table: pa.Table) -> PageSection:
    """Return the samples of each split with the largest errors of E, or of T without energy, largest first."""
    worst, quantity = table.take(find_worst_rows(table, _WORST)), find_main_cost(table)
    off, slope = compute_cost_errors(worst, quantity), np.degrees(to_floats(worst, "slope_rad"))
    label, std = (to_floats(worst, make_column_name(quantity, part)) for part in ("", "std"))
    texts = [to_texts(worst.column(name)) for name in ("split", "sample_id", "terrain_name")]
    rows = [
        (split, sample, name, f"{degrees:.1f}°", f"{true:.1f} ± {own:.1f}", f"{error:+.1f}")
        for split, sample, name, degrees, true, own, error in zip(*texts, slope, label, std, off, strict=True)
    ]
    header = ("", "sample", "class", "slope", f"{quantity} [{UNITS[quantity]}]", "predicted less measured")
    text = (
        "Look for a common cause: a wrong class in the map, a step missing in the heights, a label with a large σ.\n"
        "'tcpipe explain SAMPLE' says where a sample came from."
    )
    return PageSection("Worst segments", text, header=header, rows=rows, folded=True)


def make_slope_section(table: pa.Table) -> PageSection:
    """Return the RMSE of E, or of T without energy, by split, class and range of slope, as a heat map."""
    part, quantity = table.filter(pc.is_valid(table.column("slope_rad"))), find_main_cost(table)
    errors_ = compute_cost_errors(part, quantity)
    ranges = np.searchsorted(np.radians(_SLOPE_EDGES_DEG), to_floats(part, "slope_rad"), side="right")
    label, low, high = (
        to_floats(part, make_column_name(quantity, kind)) for kind in ("", "predicted_low", "predicted_high")
    )
    is_outside = (label < low) | (label > high)
    splits, classes = (to_texts(part.column(name)) for name in ("split", "terrain_name"))
    lines = list(dict.fromkeys(zip(splits.tolist(), classes.tolist(), strict=True)))
    columns = np.unique(ranges).tolist()
    cells = {
        (*line, at): (splits == line[0]) & (classes == line[1]) & (ranges == at) for line in lines for at in columns
    }
    errors = {cell: errors_[rows & np.isfinite(errors_)] for cell, rows in cells.items()}
    rmse = {cell: float(np.sqrt(np.mean(part**2))) for cell, part in errors.items() if len(part)}
    most = max(rmse.values(), default=1.0) or 1.0
    digits = 0 if most >= _WHOLE_JOULE else 2
    enough, least = (
        read_threshold("energy-overconfident", f"min_cell_{name}") for name in ("count", "coverage_fraction")
    )

    def shade(cell: tuple[str, str, int]) -> str | Shaded:
        if cell not in rmse:
            return ""
        count = len(errors[cell])
        is_doubtful = count >= enough and bool(is_outside[cells[cell]].mean() > 1.0 - least)
        text = f"{rmse[cell]:.{digits}f} ({count}){'*' if is_doubtful else ''}"
        return Shaded(text, rmse[cell] / most, alarm=is_doubtful)

    text = (
        f"RMSE of {quantity} [{UNITS[quantity]}], in brackets the number of segments; darker is worse. "
        "* and a dashed border: "
        f"90 % intervals cover fewer than {100 * least:.0f} % of {enough:.0f} labels or more there: "
        "do not rely on them."
    )
    header = ["split", "class", *(_SLOPE_NAMES[at].replace(" to ", "…") for at in columns)]
    rows = [[*line, *(shade((*line, at)) for at in columns)] for line in sorted(lines)]
    return PageSection("Error by class and slope", text, header=header, rows=rows)
