"""Figures of an evaluation's page: every sample measured against predicted, errors by class and slope, calibration, the worst metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.dataset import Dataset
from tcpipe.dataset.batches import Pixels
from tcpipe.formats.json_files import Json
from tcpipe.learning.metrics import QUANTITIES, UNITS
from tcpipe.learning.predictions import (
    LEVELS,
    compute_calibration,
    compute_cost_errors,
    find_main_cost,
    find_worst_rows,
    make_column_name,
)
from tcpipe.report.colours import CLASS_COLOURS, FAINT, SPLIT_COLOURS, find_class_colour
from tcpipe.report.page import Column, Section, Shaded, make_shown_column, pack_columns
from tcpipe.report.pictures import choose_thinning, make_sheets
from tcpipe.report.plots import Plot, make_plot
from tcpipe.tables.columns import to_floats, to_texts
from tcpipe.tables.findings import read_threshold

_CALLED = {"w": "power w", "v": "velocity v", "T": "time T", "E": "energy E"}
_DIGITS = {"w": 1, "v": 3, "T": 3, "E": 1}
_COLOURS = dict(zip(QUANTITIES, CLASS_COLOURS, strict=False))
_MOST_SHOWN = 20_000
"""Samples of a split that can be clicked: the first ones, in random order."""
_WORST = 30
"""Of each split, with their patches."""
_SLOPE_EDGES_DEG = (-15.0, -10.0, -5.0, -2.0, 2.0, 5.0, 10.0, 15.0)
"""Between the ranges of slope along travel [deg]; the paper's robot climbs 22.5°."""
_SLOPE_NAMES = (
    *("below -15°", "-15° to -10°", "-10° to -5°", "-5° to -2°", "-2° to 2°"),
    *("2° to 5°", "5° to 10°", "10° to 15°", "above 15°"),
)
_WHOLE_JOULE = 10.0
"""Error of E from which whole joules suffice, so that nine ranges of slope fit."""


@dataclass(frozen=True, slots=True)
class EvaluatedSamples:
    """Samples of the page: ``predictions.parquet``, and sheets of the worst samples' patches, if any."""

    table: pa.Table
    shown: NDArray[np.int64]
    """The rows on the page, rising: the first of each split, and the worst."""
    patches: Json


def select_evaluated_samples(table: pa.Table, data: Dataset) -> EvaluatedSamples:
    """Return the samples that a page shows, with patches from their dataset."""
    rows, splits = find_worst_rows(table, _WORST), to_texts(table.column("split"))
    first = [np.flatnonzero(splits == name)[:_MOST_SHOWN] for name in dict.fromkeys(splits.tolist())]
    shown, split = np.unique(np.concatenate([*first, rows])), splits[rows]
    plain = tuple(name for name, layer in data.card.layers.items() if "bands" not in layer)  # several make no picture
    parts: list[Pixels] = []
    for name in dict.fromkeys(split.tolist()):
        ids, view = table.column("sample_id").take(pa.array(rows[split == name])), data[name].view
        known = pa.array(data[name].column("sample_id").tolist(), pa.string())
        at = pc.index_in(ids.combine_chunks(), value_set=known).to_numpy()
        parts.append(view.stored.gather(view.at[at], plain))
    if not parts:
        return EvaluatedSamples(table, shown, None)
    step = choose_thinning(data.card.patch_px)
    pixels = {layer: np.concatenate([part[layer][:, ::step, ::step] for part in parts]) for layer in plain}
    files = data[str(split[0])].view.stored.files
    return EvaluatedSamples(table, shown, make_sheets(np.searchsorted(shown, rows).tolist(), pixels, files))


def make_page_data(samples: EvaluatedSamples) -> Json:
    """Return the data of the page's script."""
    table = samples.table.take(pa.array(samples.shown))
    split, name = (to_texts(table.column(column)) for column in ("split", "terrain_name"))
    splits, class_id = list(dict.fromkeys(split.tolist())), table.column("terrain_class").to_numpy()
    columns: dict[str, Column] = {
        "id": ("text", to_texts(table.column("sample_id"))),
        "split": ("u8", np.array([splits.index(part) for part in split.tolist()], np.int64)),
        "class": ("u8", class_id),
        "slope": ("half", np.degrees(to_floats(table, "slope_rad"))),
    }
    for q in QUANTITIES:
        predicted = to_floats(table, make_column_name(q, "predicted"))
        columns[q] = make_shown_column(_DIGITS[q], to_floats(table, make_column_name(q)))
        columns[f"{q} predicted"] = make_shown_column(_DIGITS[q], predicted)
        columns[f"{q} std"] = ("half", to_floats(table, make_column_name(q, "std")))
        for end in ("low", "high"):
            columns[f"{q} {end}"] = ("half", to_floats(table, make_column_name(q, f"predicted_{end}")) - predicted)
    return {
        "samples": pack_columns(columns),
        "splits": [{"name": part, "colour": SPLIT_COLOURS[part]} for part in splits],
        "classes": [
            {"id": int(number), "name": str(name[class_id == number][0]), "colour": find_class_colour(int(number))}
            for number in np.unique(class_id)
        ],
        "quantities": [
            {"key": q, "called": _CALLED[q], "unit": UNITS[q], "digits": _DIGITS[q]}
            for q in reversed(QUANTITIES)
            if table.column(make_column_name(q)).null_count < table.num_rows
        ],
        "patches": samples.patches,
    }


WORST = Section(
    "Worst segments",
    f"The {_WORST} samples of each split with the largest errors of E, or of T without energy, largest first; click for details.\n"
    "Travel is to the right. Look for a common cause: a wrong class in the map, a step missing in the heights, a label with a large σ.",
    controls="gallery.html",
)


def draw_predictions(samples: EvaluatedSamples, audit: str) -> Section:
    """Return the section with a point for each sample; ``audit`` says how far they are from training."""
    text = "Each point is a segment; on the line the prediction is exact. Click, draw a box, or step from the largest error."
    if samples.table.num_rows > len(samples.shown):
        text += f" {len(samples.shown)} of {samples.table.num_rows} are shown, drawn at random, and the worst."
    text += f"\n{audit}"
    corners = {name: [0.0, 1.0] for name in ("measured", "predicted", "slope", "error")}
    start = {**corners, "fill": ["#ffffff"] * 2, "class": [""] * 2}  # until the page's script has unpacked the samples
    against, points = _draw_scatter("against", "samples", "measured", "predicted", start)
    off, _ = _draw_scatter("off", "samples off", "slope", "error", points.data_source)
    return Section("Measured against predicted", text, controls="evaluation.html", plots=[against, off])


def _draw_scatter(name: str, points_name: str, across: str, up: str, source: Any) -> tuple[Plot, Any]:
    """Return a plot of every sample with the line of those that are right, and its points; the page's script fills both."""
    plot = make_plot(
        name,
        alt=f"{up.capitalize()} over {across}, a point a sample; the tables below list the figures by class.",
        axes=("slope along travel [°]", "predicted less measured") if across == "slope" else (across, up),
        height_px=380,
        tools="box_select,pan,wheel_zoom,box_zoom,reset,save",
        drag="box_select",
        tooltips=[
            ("measured", "@measured{0.00}"),
            ("predicted", "@predicted{0.00}"),
            ("slope", "@slope{0.0}°"),
            ("", "@class"),
        ],
    )
    points = plot.figure.scatter(
        across, up, size=6, fill_color="fill", line_color=None, fill_alpha=0.6, nonselection_fill_alpha=0.1,
        selection_line_color="#000000", source=source, name=points_name,
    )  # fmt: skip
    line = plot.figure.line([0.0, 1.0], [0.0, 1.0], color=FAINT, line_width=2, line_dash="dashed", name=f"right {name}")
    line.level = "underlay"
    plot.figure.hover.renderers = [points]
    return plot, points


def make_slope_section(table: pa.Table) -> Section:
    """Return the RMSE of E, or of T without energy, by split, class and range of slope, as a heat map."""
    part, quantity = table.filter(pc.is_valid(table.column("slope_rad"))), find_main_cost(table)
    off = compute_cost_errors(part, quantity)
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
    errors = {cell: off[rows & np.isfinite(off)] for cell, rows in cells.items()}
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
        f"RMSE of {quantity} [{UNITS[quantity]}], in brackets the number of segments; darker is worse. * and a dashed border: "
        f"90 % intervals cover fewer than {100 * least:.0f} % of {enough:.0f} labels or more there: do not rely on them."
    )
    header = ["split", "class", *(_SLOPE_NAMES[at].replace(" to ", "…") for at in columns)]
    rows = [[*line, *(shade((*line, at)) for at in columns)] for line in sorted(lines)]
    return Section("Error by class and slope", text, header=header, rows=rows)


def draw_calibration(table: pa.Table) -> list[Plot]:
    """Return for each split the share of labels below each quantile that the model states."""
    plots: list[Plot] = []
    for split in pc.unique(table.column("split")).to_pylist():
        part = table.filter(pc.equal(table.column("split"), split))
        found = {q: shares for q in QUANTITIES if (shares := compute_calibration(part, q)) is not None}
        if not found:
            continue
        plot = make_plot(
            f"calibration {split}",
            alt=f"Share of labels of {split} below each quantile that the model states; on the diagonal the model is calibrated.",
            axes=("share stated", f"share of {split} labels below"),
            legend={} if plots else {_CALLED[q]: _COLOURS[q] for q in found},
            height_px=320,
            tools="save,hover",
            waits=True,
        )
        plot.figure.hover.tooltips = [("", "$name"), ("stated", "@stated{0 %}"), ("found", "@found{0.0 %}")]
        plot.figure.line([0, 1], [0, 1], color=FAINT, line_dash="dashed", line_width=2, name="known")
        lines = [
            plot.figure.line(
                "stated", "found", source={"stated": LEVELS, "found": shares}, color=_COLOURS[q], line_width=2, name=_CALLED[q]
            )
            for q, shares in found.items()
        ]  # fmt: skip
        plot.figure.hover.renderers = lines
        plots.append(plot)
    return plots
