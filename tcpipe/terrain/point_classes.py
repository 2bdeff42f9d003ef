"""The terrain class under points: the map's own pixel, nearest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.terrain.tiles import MapReader, group_by_tile, read_window

OFF_THE_MAP = -1
"""Instead of a class id where a point is not on the map."""


def find_classes_at(source: MapReader, xy_m: NDArray[np.float64]) -> NDArray[np.int16]:
    """Return the class id under each point, 0 without data, `OFF_THE_MAP` where the map ends, shape (N,).

    Parameters
    ----------
    source : a map with a terrain layer.
    xy_m : points in the map's CRS [m], shape (N, 2); what is not finite is off the map.
    """
    found = np.full(len(xy_m), OFF_THE_MAP, np.int16)
    finite = np.flatnonzero(np.isfinite(xy_m).all(axis=1))
    on = finite[source.grid.contains(xy_m[finite])]
    px = source.grid.px_from_xy(xy_m[on])
    for group in group_by_tile(px, source):
        col, row = np.floor(px[group] + 0.5).astype(np.int64).T
        col, row = np.clip(col, 0, source.grid.cols - 1), np.clip(row, 0, source.grid.rows - 1)
        top, left = int(row.min()), int(col.min())
        window = read_window(source, "terrain", top, int(row.max()) + 1, left, int(col.max()) + 1)
        found[on[group]] = window[row - top, col - left]
    return found
