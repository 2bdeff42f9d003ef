"""Maps that Nav2's map_server loads: a grey picture (.pgm) and what it means (.yaml), mode ``scale``.

In that mode grey falls from white (cost 0) in even steps to almost black (98). Black alone is above ``occupied_thresh``: lethal to every
reader, also to those that end the scale at 99. A .pgm has no alpha, so unknown would look like lethal: what is not known is lethal.

The style (QML) in which QGIS shows a band of a cost map.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.atomic import write_atomic_file, write_text
from tcpipe.terrain.target_grid import MapGrid

LETHAL = 100
"""Cost of what is never crossed."""

HIGHEST = 98
"""Largest cost of what can be crossed: current static layers take 99 for inscribed, which is an obstacle."""

_OCCUPIED = 0.995
"""Between the darkest grey of `HIGHEST` and black."""


def write_nav2_map(path: Path, cost: NDArray[np.uint8], grid: MapGrid, *, frame: str, meaning: str) -> None:
    """Write ``path`` (.yaml) and the picture of the same name beside it.

    ``cost`` is from 0 to `HIGHEST`, or `LETHAL`, shape (rows, cols), north first; ``grid`` places the cells in the frame; ``frame`` and
    ``meaning`` are lines that say what x and y, and what a cost is.
    """
    grey = np.where(cost == LETHAL, 0.0, np.rint(255.0 * (1.0 - _OCCUPIED * cost / 100.0))).astype(np.uint8)
    picture = path.with_suffix(".pgm")
    with write_atomic_file(picture) as temporary:
        temporary.write_bytes(f"P5\n{grid.cols} {grid.rows}\n255\n".encode() + grey.tobytes())
    x_min, y_min, _, _ = grid.bounds_m
    lines = (
        f"# {meaning}",
        f"# frame: {frame}",
        f"image: {picture.name}",
        "mode: scale",
        f"resolution: {grid.pixel_size_m!r}",
        f"origin: [{x_min!r}, {y_min!r}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {_OCCUPIED}",
        "free_thresh: 0.0",
        "",
    )
    write_text(path, "\n".join(lines))


_COLOURS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
"""Viridis: from the least to the greatest; its colours differ for any colour vision, and in grey."""
_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n<qgis version=\"3.22.0\">\n"


def make_raster_style(band: int, low: float, high: float) -> str:
    """Return the style of a raster whose band, counted from 1, is coloured from the least value to the greatest."""
    step = (high - low) / (len(_COLOURS) - 1)
    stops = [(low + at * step, colour) for at, colour in enumerate(_COLOURS)]
    items = "".join(f'<item alpha="255" color="{colour}" value="{at!r}" label="{at:.4g}"/>' for at, colour in stops)
    shader = f'colorRampType="INTERPOLATED" classificationMode="1" minimumValue="{low!r}" maximumValue="{high!r}"'
    bounds = f'classificationMin="{low!r}" classificationMax="{high!r}"'
    return (
        f'{_HEAD}<pipe><rasterrenderer type="singlebandpseudocolor" band="{band}" opacity="1" {bounds}>'
        f"<rastershader><colorrampshader {shader}>{items}</colorrampshader></rastershader></rasterrenderer></pipe>\n</qgis>\n"
    )
