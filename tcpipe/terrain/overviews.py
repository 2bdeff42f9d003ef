"""Coarser levels of a map, so that a patch whose pixels are wider than the map's shows what is there on average, not every n-th pixel.

A level's pixel spans ``factor`` x ``factor`` map pixels: what is continuous is their mean, a class the commonest (ties go to the lower id,
no data votes like a class). As everywhere, a mean with a part that is missing is missing. A patch takes the coarsest level that is not
coarser than its own pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.terrain.grid import MapGrid
from tcpipe.terrain.layers import Layer, Pixels
from tcpipe.terrain.resampling_kernel import reduce_majority

COARSEST_M = 1.0
"""No level has wider pixels than this, the length of a segment [m]."""

_WIDEST_FACTOR = 1024
_SLACK = 1.01


def list_factors(grid: MapGrid) -> tuple[int, ...]:
    """Return the factors of a map's levels, rising: 1, 2, 4 … while pixels stay below `COARSEST_M` and two remain each way."""
    factors = [1]
    while (
        (factor := 2 * factors[-1]) <= _WIDEST_FACTOR
        and factor * grid.pixel_size_m <= COARSEST_M
        and min(grid.rows, grid.cols) // factor >= 2
    ):
        factors.append(factor)
    return tuple(factors)


def make_overview_grid(grid: MapGrid, factor: int) -> MapGrid:
    """Return the grid of a level: the same corner, wider pixels; what does not fill one at the far edges is left out."""
    return replace(grid, pixel_size_m=grid.pixel_size_m * factor, rows=grid.rows // factor, cols=grid.cols // factor)


def choose_factor(factors: Sequence[int], map_pitch_m: float, pixel_size_m: float) -> int:
    """Return the largest factor whose pixels are not wider than ``pixel_size_m``; the smallest where all are."""
    return max((factor for factor in factors if factor * map_pitch_m <= _SLACK * pixel_size_m), default=min(factors))


def iterate_levels(layer: Layer, values: Pixels, factors: Sequence[int]) -> Iterator[tuple[int, Pixels]]:
    """Yield each factor above 1 and the layer at it.

    Parameters
    ----------
    layer : what it is.
    values : pixels of the map, shape (R, C): floats with NaN, or bytes with 0, as no data.
    factors : powers of two, rising, as `list_factors` gives them.
    """
    if layer.kind == "categorical":
        for factor in factors[1:]:
            out = np.empty((values.shape[0] // factor, values.shape[1] // factor), np.uint8)
            reduce_majority(values, factor, out)
            yield factor, out
        return
    grey = layer.stack == "greys"
    means = np.where(values == 0, np.float32(np.nan), values.astype(np.float32)) if grey else values
    for factor in factors[1:]:
        means = _halve(means)
        yield factor, _to_grey(means) if grey else means


def _halve(values: Pixels) -> Pixels:
    """Return means of 2 x 2 pixels; an odd last row or column is left out."""
    even = values[: values.shape[0] // 2 * 2, : values.shape[1] // 2 * 2]
    rows = even[0::2] + even[1::2]
    return np.asarray((rows[:, 0::2] + rows[:, 1::2]) * rows.dtype.type(0.25))


def _to_grey(means: Pixels) -> NDArray[np.uint8]:
    return np.where(np.isfinite(means), np.rint(means), 0.0).astype(np.uint8)
