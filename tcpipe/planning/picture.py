"""The picture of a plan: the paths of least energy, time and distance side by side on the hill, and their profiles below."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from numpy.typing import NDArray

from tcpipe.formats.atomic import write_atomic_file
from tcpipe.planning.plan import Plan
from tcpipe.report.colours import CLASS_COLOURS
from tcpipe.report.pictures import colour_classes, shade_heights
from tcpipe.tables.columns import to_floats
from tcpipe.terrain.tiles import MapReader, choose_level, read_window

Array = NDArray[np.float64]

_INK, _FAINT = "#1d2830", "#7b8893"
_COLOURS = {"energy": "#d4600c", "time": "#1668b8", "distance": "#4a4f55"}
_LINES = {"energy": "-", "time": "-", "distance": (0, (5, 2))}
_PANEL_PX = 900

_PANEL_WIDTH_IN = 4.4
_REST_IN = 3.3
_TITLE_IN = 0.4
_MARGIN = 0.14
_LEAST_SIDE_M = 40.0
_NICE_M = tuple(step * 10.0**power for power in range(5) for step in (1.0, 2.0, 5.0))
"""Lengths of the scale bar."""
_ASPECT = 1.12
_COST_MAP = "plasma"
_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": _INK,
    "axes.edgecolor": _FAINT,
    "axes.labelcolor": _INK,
    "xtick.color": _FAINT,
    "ytick.color": _FAINT,
}
_WHITE = [patheffects.withStroke(linewidth=3.0, foreground="white")]


def draw_plans(path: Path, source: MapReader, plans: Sequence[Plan]) -> None:
    """Draw plans between the same points as PNG, a panel each; the same plans give the same bytes."""
    bounds = _crop(source, np.concatenate([plan.xy_m for plan in plans]))
    backdrop = _Backdrop(source, bounds)
    tables = [plan.cost.path_segments for plan in plans]
    spent = [to_floats(table, "energy_joule") / to_floats(table, "arc_length_m") for table in tables]
    known = np.concatenate(spent)
    known = known[np.isfinite(known)]
    scale = Normalize(*(np.percentile(known, (2.0, 98.0)) if known.size else (0.0, 1.0)))
    with mpl.rc_context(_STYLE):
        left, bottom, right, top = bounds
        tall = _PANEL_WIDTH_IN * (top - bottom) / (right - left)
        free = 1.0 - _TITLE_IN / (tall + _REST_IN)
        figure = Figure(
            figsize=(15.0, tall + _REST_IN),
            layout=ConstrainedLayoutEngine(rect=(0.0, 0.0, 1.0, free)),
            facecolor="white",
        )
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(2, len(plans), height_ratios=(tall + 0.6, 1.35), hspace=0.03)
        panels = [figure.add_subplot(grid[0, column]) for column in range(len(plans))]
        for axes, plan, values in zip(panels, plans, spent, strict=True):
            backdrop.draw(axes)
            for other in plans:
                if other is not plan:
                    axes.plot(*other.xy_m.T, color="white", lw=1.6, ls=(0, (1.2, 1.6)), alpha=0.95)
            line = _draw_path(axes, plan, values, scale)
            _draw_ends(axes, plan)
            _draw_title(axes, plan, plans)
        _draw_scale_bar(panels[0], bounds)
        bar = figure.colorbar(line, ax=panels, shrink=0.7, pad=0.008, aspect=28)
        bar.set_label("energy a metre along the path [J/m]")
        bar.outline.set_visible(False)
        _draw_profiles(figure.add_subplot(grid[1, :]), backdrop, plans)
        if backdrop.classes:
            figure.legend(
                handles=[Patch(facecolor=colour, label=name, alpha=0.75) for name, colour in backdrop.classes],
                loc="outside lower center", ncols=len(backdrop.classes), frameon=False, fontsize=9,
            )  # fmt: skip
        with write_atomic_file(path) as temporary:
            figure.savefig(temporary, format="png", dpi=130, metadata={"Software": None})


def _compute_distance(xy_m: Array) -> Array:
    """Return the distance along a line at each of its points [m], shape (N,)."""
    return np.asarray(np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])


def _crop(source: MapReader, xy_m: Array) -> tuple[float, float, float, float]:
    """Return x min, y min, x max, y max [m] around points: with a margin, near to the panel's shape, on the map as far as it goes."""
    low, high = xy_m.min(axis=0), xy_m.max(axis=0)
    side = (high - low) * (1.0 + 2.0 * _MARGIN)
    side = np.maximum(side, max(side.max() * 0.6, _LEAST_SIDE_M))
    side = np.array([max(side[0], side[1] * _ASPECT), max(side[1], side[0] / _ASPECT)])
    x_min, y_min, x_max, y_max = source.grid.bounds_m
    side = np.minimum(side, (x_max - x_min, y_max - y_min))
    first = np.clip((low + high) / 2.0 - side / 2.0, (x_min, y_min), np.array([x_max, y_max]) - side)
    (left, bottom), (right, top) = first.tolist(), (first + side).tolist()
    return left, bottom, right, top


class _Backdrop:
    """The hill: shaded relief under the orthophoto, tinted by class."""

    def __init__(self, source: MapReader, bounds: tuple[float, float, float, float]) -> None:
        left, bottom, right, top = bounds
        level = choose_level(source, max(right - left, top - bottom) / _PANEL_PX)
        corners = level.grid.px_from_xy(np.array([(left, top), (right, bottom)])) + 0.5
        (col0, row0), (col1, row1) = np.floor(corners[0]).astype(int), np.ceil(corners[1]).astype(int)
        step = max(1, max(row1 - row0, col1 - col0) // _PANEL_PX)
        window = (int(row0), int(row1), int(col0), int(col1))
        layers = {layer: read_window(level, layer, *window)[::step, ::step] for layer in level.layers}
        self._height = layers["height"].astype(np.float64) + level.height_reference_m
        self._extent = (left, right, bottom, top)
        self._picture = _blend_picture(layers, shade_heights(self._height, level.grid.pixel_size_m * step))
        ids = np.unique(layers["terrain"]).tolist() if "terrain" in layers else []
        self.classes = [(source.classes.name(i), CLASS_COLOURS[(i - 1) % len(CLASS_COLOURS)]) for i in ids if i]

    def height_at(self, xy_m: Array) -> Array:
        """Return the height of the nearest pixel [m], shape (N,)."""
        left, right, bottom, top = self._extent
        rows, cols = self._height.shape
        share = (xy_m - (left, bottom)) / (right - left, top - bottom)
        col, row = (share * (cols, -rows) + (0, rows)).astype(np.int64).T
        return np.asarray(self._height[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)])

    def draw(self, axes: Axes) -> None:
        """Draw it."""
        axes.imshow(self._picture, extent=self._extent, interpolation="bilinear")
        axes.set(xlim=self._extent[:2], ylim=self._extent[2:], xticks=[], yticks=[], aspect="equal")
        axes.spines[:].set_visible(False)


def _blend_picture(layers: dict[str, NDArray[Any]], light: NDArray[np.uint8]) -> Array:
    """Return the orthophoto under shaded relief, tinted by class, RGB in [0, 1]; what has no data is white."""
    is_missing = np.any([layers[name] == 0 for name in ("ortho", "terrain") if name in layers], axis=0)
    grey = layers["ortho"] / 255.0 if "ortho" in layers else np.full(light.shape, 0.7)
    picture = np.repeat(grey[..., None], 3, axis=2)
    if "terrain" in layers:
        picture = 0.45 * picture + 0.55 * colour_classes(layers["terrain"].astype(np.int64)) / 255.0
    picture = np.clip(picture * (0.45 + 0.75 * light / 255.0)[..., None], 0.0, 1.0)
    return np.where((is_missing | ~np.isfinite(layers["height"]))[..., None], 1.0, picture)


def _draw_path(axes: Axes, plan: Plan, values: Array, scale: Normalize) -> LineCollection:
    """Draw the path, coloured by what its metres cost; return the coloured line."""
    points = plan.xy_m
    length = _compute_distance(points)
    ends = np.r_[to_floats(plan.cost.path_segments, "distance_m"), plan.totals.length_m]
    at = ends / ends[-1] * length[-1]
    cuts = np.stack([np.interp(at, length, points[:, axis]) for axis in (0, 1)], axis=1)
    axes.plot(*points.T, color="white", lw=7.0, solid_capstyle="round", solid_joinstyle="round")
    line = LineCollection(list(np.stack([cuts[:-1], cuts[1:]], axis=1)), cmap=_COST_MAP, norm=scale, linewidths=4.2)
    line.set_array(np.ma.masked_invalid(values))
    line.set_capstyle("round")
    axes.add_collection(line)
    return line


def _draw_ends(axes: Axes, plan: Plan) -> None:
    (x0, y0), (x1, y1) = plan.xy_m[[0, -1]].tolist()
    axes.plot(x0, y0, "o", ms=11, color="white", mec=_INK, mew=2.2, zorder=5)
    axes.plot(x1, y1, "*", ms=19, color="white", mec=_INK, mew=1.6, zorder=5)
    for x, y, name in ((x0, y0, "start"), (x1, y1, "goal")):
        _write_above(axes, name, x, y)


def _write_above(axes: Axes, text: str, x: float, y: float) -> None:
    axes.annotate(
        text, (x, y), (0, 9), textcoords="offset points", ha="center", fontsize=9, weight="bold", path_effects=_WHITE
    )


def _draw_title(axes: Axes, plan: Plan, plans: Sequence[Plan]) -> None:
    colour = _COLOURS[plan.totals.objective]
    axes.set_title(f"Least {plan.totals.objective}", loc="left", pad=28, fontsize=16, weight="bold", color=colour)
    totals, parts = plan.totals, []
    texts = {
        "energy_joule": f"{totals.known_energy_joule / 1000.0:.2f} kJ",
        "duration_s": f"{totals.duration_s:.0f} s",
        "length_m": f"{totals.length_m:.0f} m",
    }
    for name, text in texts.items():
        best = min(getattr(other.totals, name) for other in plans)
        more = getattr(totals, name) / best - 1.0 if best > 0.0 else 0.0
        parts.append(f"{text} (+{more:.1%})" if more >= 0.0005 else text)
    axes.annotate(
        "     ".join(parts), (0.0, 1.0), (0, 9), xycoords="axes fraction", textcoords="offset points", fontsize=10.5
    )


def _draw_scale_bar(axes: Axes, bounds: tuple[float, float, float, float]) -> None:
    left, bottom, right, top = bounds
    length = max(step for step in _NICE_M if step <= max((right - left) / 4.0, _NICE_M[0]))
    x, y = left + 0.04 * (right - left), bottom + 0.05 * (top - bottom)
    axes.plot((x, x + length), (y, y), color="white", lw=6, solid_capstyle="butt")
    axes.plot((x, x + length), (y, y), color=_INK, lw=3, solid_capstyle="butt")
    _write_above(axes, f"{length:g} m", x + length / 2.0, y)


def _draw_profiles(axes: Axes, backdrop: _Backdrop, plans: Sequence[Plan]) -> None:
    """Draw height over distance along every path."""
    for plan in plans:
        length = _compute_distance(plan.xy_m)
        at = np.linspace(0.0, length[-1], max(int(length[-1] * 2.0), 2))
        height = backdrop.height_at(np.stack([np.interp(at, length, plan.xy_m[:, axis]) for axis in (0, 1)], axis=1))
        colour, style = _COLOURS[plan.totals.objective], _LINES[plan.totals.objective]
        distance = at / length[-1] * plan.totals.length_m
        axes.plot(distance, height, color=colour, lw=2.2, ls=style, label=f"least {plan.totals.objective}")
    axes.set_xlabel("distance [m]")
    axes.set_ylabel("height [m]")
    axes.margins(x=0.01)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e3e7ea", lw=0.8)
    axes.legend(frameon=False, ncols=len(plans), loc="upper right", bbox_to_anchor=(1.0, 1.22), fontsize=9)
