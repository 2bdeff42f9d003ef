"""The page of a split that is judged: a map of the samples by split, and the figures of each held-out split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.report.colours import CLASS_COLOURS, CURSOR, SPLIT_COLOURS
from tcpipe.report.page import Section, render_page
from tcpipe.report.plots import make_map_plot

_MOST_POINTS = 50_000
"""On the map: of more, equally spaced ones."""


def render_split_page(
    lines: Sequence[str], rows: Sequence[Sequence[str]], places_m: Mapping[str, NDArray[np.float64]]
) -> str:
    """Return the HTML page: ``lines`` of text, the table ``rows``, head first, and a map of ``places_m``.

    These are the positions [m], (N, 2), of each split by its name, and at last those of the samples that leak.
    """
    others = iter(CLASS_COLOURS[1:] * len(places_m))
    colours = {name: SPLIT_COLOURS.get(name) or next(others) for name in places_m} | {"leaking samples": CURSOR}
    alt = "Map of the samples by split; the table below lists the counts."
    plot = replace(make_map_plot(alt=alt, axes=("x [m]", "y [m]"), height_px=420), legend=colours)
    every = -(-sum(map(len, places_m.values())) // _MOST_POINTS)
    for name, xy_m in places_m.items():
        look = {"size": 9, "fill_alpha": 0.0} if name == "leaking samples" else {"size": 5}
        plot.figure.scatter(*xy_m[::every].T, color=colours[name], **look)
    parts = [Section("Held-out splits", "Distances are between footprints.", header=rows[0], rows=rows[1:])]
    sections = [Section("Map", f"One of {every} samples." if every > 1 else "", plots=[plot]), *parts]
    return render_page(title="Check of a split", lead=lines[0], numbers=[], warnings=lines[1:], sections=sections)
