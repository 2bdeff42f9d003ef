"""The pictures of a report, as SVG text: the same numbers give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tcpipe.report.colours import DROPPED, FAINT, INK, KEPT

Array = NDArray[np.float64]
S = TypeVar("S", bound=np.generic)

_MAX_POINTS = 4000

_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "tcpipe",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "text.color": INK,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}


@contextmanager
def figure_svg(width: float, height: float) -> Iterator[tuple[Figure, list[str]]]:
    """Yield a figure in the house's style and a list that receives its SVG text."""
    out: list[str] = []
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasSVG(figure)
        yield figure, out
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, dpi=110)
    text = stream.getvalue()
    out.append(text[text.index("<svg") :])


def _thin(array: NDArray[S]) -> NDArray[S]:
    return array[:: max(1, len(array) // _MAX_POINTS)]


def path_on_map(
    x_m: Array,
    y_m: Array,
    groups: NDArray[np.object_],
    colours: Mapping[str, str],
    *,
    backdrop: NDArray[np.uint8] | None = None,
    extent_m: tuple[float, float, float, float] | None = None,
    outlines_m: Sequence[Array] = (),
    labels: tuple[str, str] = ("east [m]", "north [m]"),
) -> str:
    """Draw points in the plane, coloured by group, over a grey or RGB backdrop, with outlines (regions).

    Parameters
    ----------
    x_m, y_m : ndarray, shape (N,)
        Positions.
    groups : ndarray of str, shape (N,)
        Group of each point; drawn in the order of ``colours``.
    backdrop : ndarray, shape (R, C) or (R, C, 3), optional
        Picture, row 0 north, spanning ``extent_m`` = (left, right, bottom, top).

    """
    left, right, bottom, top = extent_m or (x_m.min(), x_m.max(), y_m.min(), y_m.max())
    height = 0.7 + 5.3 * np.clip((top - bottom) / max(right - left, 1e-9), 0.2, 1.1)
    with figure_svg(8.2, float(height)) as (figure, out):
        axes = figure.add_subplot()
        if backdrop is not None:
            axes.imshow(backdrop, extent=extent_m, cmap="gray", vmin=0, vmax=255, alpha=0.85, interpolation="nearest")
        for outline in outlines_m:
            axes.plot(outline[:, 0], outline[:, 1], color="#b3202a", lw=1.6, ls="--")
        for name, colour in colours.items():
            mask = groups == name
            if mask.any():
                x, y = _thin(x_m[mask]), _thin(y_m[mask])
                axes.plot(
                    x, y, ".", ms=2.6, color=colour, label=f"{name} ({int(mask.sum())})", rasterized=len(x) > 1500
                )
        axes.set_aspect("equal")
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        axes.ticklabel_format(useOffset=False, style="plain")
        if len(x_m):
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, markerscale=3)
    return out[0]


def over_distance(distance_m: Array, series: Mapping[str, tuple[Array, str]], kept: NDArray[np.bool_]) -> str:
    """Draw series (label → values, colour) over the distance driven, one panel each; what is not kept is shaded."""
    with figure_svg(8.2, 1.7 * len(series) + 0.3) as (figure, out):
        panels = np.atleast_1d(figure.subplots(len(series), 1, sharex=True))
        distance, keep = _thin(distance_m), _thin(kept)
        for axes, (label, (values, colour)) in zip(panels, series.items(), strict=True):
            thin = _thin(values)
            axes.fill_between(
                distance, 0, 1, where=~keep, transform=axes.get_xaxis_transform(), color="#00000012", lw=0
            )
            axes.plot(distance, thin, color=colour, lw=0.9)
            axes.set_ylabel(label)
        panels[-1].set_xlabel("distance driven [m]  (shaded: not used)")
    return out[0]


def ledger_bars(ledger_m: Mapping[str, float]) -> str:
    """Draw where every metre went: kept first, then each loss, the largest first."""
    losses = sorted((item for item in ledger_m.items() if item[0] != "kept" and item[1] > 0), key=lambda item: -item[1])
    entries = [("kept", ledger_m.get("kept", 0.0)), *losses]
    with figure_svg(8.2, 0.32 * len(entries) + 0.7) as (figure, out):
        axes = figure.add_subplot()
        names = [name.replace("_", " ") for name, _ in entries]
        values = np.array([metres for _, metres in entries])
        colours = [KEPT if name == "kept" else DROPPED for name in names]
        bars = axes.barh(names, values, color=colours, height=0.7)
        total = max(values.sum(), 1e-9)
        axes.bar_label(
            bars, [f"{v:.1f} m  ({100 * v / total:.1f} %)" for v in values], color=INK, fontsize=8, padding=3
        )
        axes.invert_yaxis()
        axes.set_xlim(0, max(values.max() * 1.25, 1.0))
        axes.set_xlabel("metres")
    return out[0]


def histograms(values: Mapping[str, Array]) -> str:
    """Draw one histogram a label."""
    with figure_svg(8.2, 2.1) as (figure, out):
        for axes, (label, data) in zip(np.atleast_1d(figure.subplots(1, len(values))), values.items(), strict=True):
            finite = data[np.isfinite(data)]
            if len(finite):
                axes.hist(finite, bins=min(40, max(5, int(np.sqrt(len(finite))))), color="#2a6fb0")
            axes.set_xlabel(label)
        figure.axes[0].set_ylabel("segments")
    return out[0]
