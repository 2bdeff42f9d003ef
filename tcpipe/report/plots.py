"""Interactive plots of pages: the only module that imports Bokeh.

A page makes a plot, calls the glyph methods of ``plot.figure``, and hands it to a section
(`tcpipe.report.page.PageSection`)::

    plot = new_plot("speed", alt="Speed over time", axes=("time [s]", "speed [m/s]"))
    plot.figure.line(time_s, speed_mps, color=KEPT)

Colours of axes and grids follow the page's light or dark scheme (``page.css``); those of glyphs come from
`tcpipe.report.colours`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import bokeh
import numpy as np
from bokeh.document import Document
from bokeh.models import HoverTool
from bokeh.models.annotations.geometry import Span
from bokeh.plotting import figure

from tcpipe.arrays import Box
from tcpipe.errors import clean_line
from tcpipe.formats.json_files import Json
from tcpipe.report.colours import CURSOR, DROPPED, KEPT, SPLIT_COLOURS

BOKEH_SCRIPT = Path(bokeh.__file__).parent / "server/static/js/bokeh.min.js"
"""The part of BokehJS that a page needs."""
_TEX = re.compile(r"\$\$|\\\(|\\\[")
_UNREAD = "\u2060"  # between the signs of a formula it keeps a name from being read as one; it takes no room


@dataclass(frozen=True, slots=True)
class Plot:
    """A figure with a description for screen readers and colours by name; scripts find it by ``figure.name``."""

    figure: Any
    alt: str
    legend: Mapping[str, str] = field(default_factory=dict)
    waits: bool = False
    """Whether it is drawn after the page answers; the page's script receives each such view (``page.js``)."""


def make_plot(
    name: str,
    *,
    alt: str,
    axes: tuple[str, str],
    legend: Mapping[str, str] | None = None,
    height_px: int = 300,
    tools: str = "pan,wheel_zoom,box_zoom,reset,save",
    drag: str | None = None,
    waits: bool = False,
    **settings: Any,
) -> Plot:
    """Return an empty plot as wide as the page.

    Parameters
    ----------
    name, alt : of the figure, unique on its page; what it shows, in a sentence.
    axes : quantities of the axes, with unit.
    legend : colours by name, written below the plot.
    tools, drag : Bokeh's tools, and which one a drag uses at first; without one a finger scrolls the page.
    waits : whether it is drawn after the page answers.
    settings : more of `bokeh.plotting.figure`, as ``tooltips``, ``x_range`` or ``match_aspect``.
    """
    new_figure = figure(
        name=name,
        x_axis_label=axes[0],
        y_axis_label=axes[1],
        height=height_px,
        tools=tools,
        active_drag=drag,
        active_scroll=None,
        toolbar_location="above",
        sizing_mode="stretch_width",
        background_fill_alpha=0.0,
        border_fill_alpha=0.0,
        outline_line_color=None,
        **settings,
    )
    new_figure.toolbar.logo = None
    new_figure.axis.axis_label_text_font_style = "normal"
    new_figure.axis.axis_label_text_font_size = "13px"
    new_figure.axis.major_label_text_font_size = "12px"
    new_figure.axis.minor_tick_line_color = None
    return Plot(new_figure, alt, legend or {}, waits)


def make_map_plot(
    *,
    alt: str,
    axes: tuple[str, str],
    height_px: float,
    legend: Mapping[str, str],
    tools: str = "pan,wheel_zoom,box_zoom,reset,save",
) -> Plot:
    """Return an empty map, true to scale, of a height that leaves room on the first screen."""
    height = int(np.clip(height_px, 330, 420))
    plot = make_plot(
        "map", alt=alt, axes=axes, height_px=height, legend=legend, tools=tools, drag="pan", match_aspect=True
    )
    plot.figure.xgrid.visible = plot.figure.ygrid.visible = False
    plot.figure.axis.formatter.use_scientific = False
    plot.figure.axis.ticker.desired_num_ticks = 4
    return plot


def lay_picture(plot: Plot, name: str, uri: str, bounds_m: Box, *, visible: bool) -> None:
    """Lay a picture over ``bounds_m`` (least x and y, greatest x and y) under all else, as ``layer <name>``."""
    x_min_m, y_min_m, x_max_m, y_max_m = bounds_m
    renderer = plot.figure.image_url(
        url=[uri],
        x=x_min_m,
        y=y_max_m,
        w=x_max_m - x_min_m,
        h=y_max_m - y_min_m,
        anchor="top_left",
        name=f"layer {name}",
    )
    renderer.level = "image"
    renderer.visible = visible


def add_cursor(plot: Plot) -> None:
    """Add a vertical line, ``cursor <name>``, invisible until the page's script places it."""
    name = f"cursor {plot.figure.name}"
    plot.figure.add_layout(Span(dimension="height", location=np.nan, line_color=CURSOR, line_width=1.5, name=name))


def show_text(plot: Plot, renderer: Any) -> None:
    """Show the column ``text`` of a renderer where the mouse is on it."""
    plot.figure.add_tools(HoverTool(renderers=[renderer], tooltips=[("", "@text")]))


def draw_waterfall(distance_by_reason_m: Mapping[str, float]) -> Plot:
    """Return a waterfall of distances: driven, each loss with the largest first, and kept."""
    losses = sorted(
        ((n, m) for n, m in distance_by_reason_m.items() if n != "kept" and m > 0), key=lambda item: -item[1]
    )
    total, kept = sum(distance_by_reason_m.values()), distance_by_reason_m.get("kept", 0.0)
    ends = total - np.cumsum([metres for _, metres in losses])
    names = ["driven", *(name.replace("_", " ") for name, _ in losses), "kept"]
    metres = [total, *(metres for _, metres in losses), kept]
    plot = make_plot(
        "ledger",
        alt=f"Distance breakdown: of {total:.0f} m driven, {kept:.0f} m are kept.",
        axes=("metres", ""),
        height_px=90 + 26 * len(names),
        tools="save",
        y_range=names[::-1],
        tooltips=[("", "@name"), ("metres", "@metres{0.0}"), ("share", "@share{0.0} %")],
        waits=True,
    )
    plot.figure.hbar(
        y="name",
        left="left",
        right="right",
        height=0.7,
        color="colour",
        source={
            "name": names,
            "left": [0.0, *ends, 0.0],
            "right": [total, *(ends + [m for _, m in losses]), kept],
            "metres": metres,
            "share": [100.0 * value / max(total, 1e-9) for value in metres],
            "colour": [SPLIT_COLOURS["buffer"], *[DROPPED] * len(losses), KEPT],
        },
    )
    plot.figure.x_range.start = 0
    plot.figure.xaxis.formatter.use_scientific = False
    plot.figure.ygrid.visible = False
    return plot


def render_plots(plots: Sequence[Plot]) -> tuple[Json, list[str]]:
    """Return Bokeh's JSON and the id of each plot; the same plots have the same ids in each process.

    ``first`` is a Bokeh document of all plots that do not wait. ``later`` are the roots that join it, in the order of
    the page; parts that they share with earlier plots, such as an axis, are named there and written once.
    """
    if not plots:
        return None, []
    whole, ids = Document(), dict[str, str]()
    ordered = sorted(plots, key=lambda plot: plot.waits)
    with whole.models.freeze():  # else every root that is added looks through all others again
        for plot in ordered:
            whole.add_root(plot.figure)
    document = cast("dict[str, Json]", _make_plot_json(cast("Json", whole.to_json(deferred=False)), ids))
    roots, soon = cast("list[Json]", document["roots"]), sum(not plot.waits for plot in plots)
    return {"first": {**document, "roots": roots[:soon]}, "later": roots[soon:]}, [
        ids[plot.figure.id] for plot in plots
    ]


def _make_plot_json(value: Json, ids: dict[str, str]) -> Json:
    """Return a part of Bokeh's JSON with ids in order, and texts without formulas or control characters."""
    if isinstance(value, Mapping):
        return {
            key: ids.setdefault(part, f"p{len(ids) + 1}")
            if key == "id" and isinstance(part, str)
            else _make_plot_json(part, ids)
            for key, part in value.items()
        }
    if isinstance(value, str):
        text = value if value.isprintable() else clean_line(value)
        return _TEX.sub(lambda found: found[0][0] + _UNREAD + found[0][1:], text)
    return [_make_plot_json(part, ids) for part in value] if isinstance(value, Sequence) else value
