"""Draw paths of least energy, time and distance side by side on the shaded hill, coloured by energy a metre."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tcpipe.formats.atomic import write_atomic_file
from tcpipe.planning.plan import Plan
from tcpipe.report.pictures import colour_classes, shade_heights
from tcpipe.tables.columns import to_floats
from tcpipe.terrain.tiles import MapReader, choose_level, read_tile_window

Array = NDArray[np.float64]
Bounds = tuple[float, float, float, float]

_PANEL_PX = 900
_PANEL_WIDTH_IN, _REST_IN = 4.4, 2.2
"""Width of a panel, and height besides it."""
_MARGIN, _LEAST_SIDE_M = 0.14, 40.0
_COST_MAP = "plasma"


def draw_plans(path: Path, source: MapReader, plans: Sequence[Plan]) -> None:
    """Draw plans between the same points as PNG, a panel each; the same plans give the same bytes."""
    left, bottom, right, top = bounds = _crop(source, np.concatenate([plan.xy_m for plan in plans]))
    hill = _make_hill(source, bounds)
    tables = [plan.cost.path_segments for plan in plans]
    spent = [to_floats(table, "energy_joule") / to_floats(table, "arc_length_m") for table in tables]
    known = np.concatenate(spent)
    known = known[np.isfinite(known)]
    scale = Normalize(*(np.percentile(known, (2.0, 98.0)) if known.size else (0.0, 1.0)))
    tall = _PANEL_WIDTH_IN * (top - bottom) / (right - left)
    with mpl.rc_context({"font.family": "sans-serif", "font.size": 10}):
        figure = Figure(figsize=(15.0, tall + _REST_IN), layout="constrained", facecolor="white")
        FigureCanvasAgg(figure)
        panels = [figure.add_subplot(1, len(plans), column) for column in range(1, len(plans) + 1)]
        for axes, plan, values in zip(panels, plans, spent, strict=True):
            axes.imshow(hill, extent=(left, right, bottom, top), interpolation="bilinear")
            for other in plans:
                axes.plot(*other.xy_m.T, color="white", lw=7.0 if other is plan else 1.6)
            line = _draw_path(axes, plan, values, scale)
            axes.plot(*plan.xy_m[0], "o", ms=11, color="white", mec="black")
            axes.plot(*plan.xy_m[-1], "*", ms=19, color="white", mec="black")
            totals = plan.totals
            axes.set_title(
                f"Least {totals.objective}: {totals.known_energy_joule / 1000.0:.2f} kJ, {totals.duration_s:.0f} s, "
                f"{totals.length_m:.0f} m"
            )
            axes.set(xlim=(left, right), ylim=(bottom, top), xlabel="east [m]", ylabel="north [m]", aspect="equal")
            axes.xaxis.set_major_formatter(lambda x, _: f"{x - left:.0f}")
            axes.yaxis.set_major_formatter(lambda y, _: f"{y - bottom:.0f}")
        figure.colorbar(line, ax=panels, shrink=0.7, label="energy a metre along the path [J/m]")
        with write_atomic_file(path) as temporary:
            figure.savefig(temporary, format="png", dpi=130, bbox_inches="tight", metadata={"Software": None})


def _crop(source: MapReader, xy_m: Array) -> Bounds:
    """Return x min, y min, x max, y max [m] around points, with a margin, on the map as far as it goes."""
    low, high = xy_m.min(axis=0), xy_m.max(axis=0)
    side = (high - low) * (1.0 + 2.0 * _MARGIN)
    side = np.maximum(side, max(side.max() * 0.6, _LEAST_SIDE_M))
    x_min, y_min, x_max, y_max = source.grid.bounds_m
    side = np.minimum(side, (x_max - x_min, y_max - y_min))
    first = np.clip((low + high) / 2.0 - side / 2.0, (x_min, y_min), np.array([x_max, y_max]) - side)
    (left, bottom), (right, top) = first.tolist(), (first + side).tolist()
    return left, bottom, right, top


def _make_hill(source: MapReader, bounds: Bounds) -> Array:
    """Return the orthophoto under shaded relief, tinted by class, RGB in [0, 1]; pixels without data are white."""
    left, bottom, right, top = bounds
    level = choose_level(source, max(right - left, top - bottom) / _PANEL_PX)
    corners = level.grid.px_from_xy(np.array([(left, top), (right, bottom)])) + 0.5
    (col0, row0), (col1, row1) = np.floor(corners[0]).astype(int), np.ceil(corners[1]).astype(int)
    step, window = max(1, max(row1 - row0, col1 - col0) // _PANEL_PX), (int(row0), int(row1), int(col0), int(col1))
    layers = {layer: read_tile_window(level, layer, *window)[::step, ::step] for layer in level.layers}
    light = shade_heights(layers["height"].astype(np.float64), level.grid.pixel_size_m * step)
    is_missing = np.any([layers[name] == 0 for name in ("ortho", "terrain") if name in layers], axis=0)
    grey = layers["ortho"] / 255.0 if "ortho" in layers else np.full(light.shape, 0.7)
    picture = np.repeat(grey[..., None], 3, axis=2)
    if "terrain" in layers:
        picture = 0.45 * picture + 0.55 * colour_classes(layers["terrain"], level.layers["terrain"].classes) / 255.0
    picture = np.clip(picture * (0.45 + 0.75 * light / 255.0)[..., None], 0.0, 1.0)
    return np.where((is_missing | ~np.isfinite(layers["height"]))[..., None], 1.0, picture)


def _draw_path(axes: Axes, plan: Plan, values: Array, scale: Normalize) -> LineCollection:
    """Draw the path, coloured by what its metres cost; return the coloured line."""
    steps = np.linalg.norm(np.diff(plan.xy_m, axis=0), axis=1)
    length = np.r_[0.0, np.cumsum(steps)]
    ends = np.r_[to_floats(plan.cost.path_segments, "distance_m"), plan.totals.length_m]
    at = ends / ends[-1] * length[-1]
    cuts = np.stack([np.interp(at, length, plan.xy_m[:, axis]) for axis in (0, 1)], axis=1)
    line = LineCollection(list(np.stack([cuts[:-1], cuts[1:]], axis=1)), cmap=_COST_MAP, norm=scale, linewidths=4.2)
    line.set_array(np.ma.masked_invalid(values))
    axes.add_collection(line)
    return line
