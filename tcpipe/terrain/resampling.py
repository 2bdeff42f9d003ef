"""Resampling a raster onto a map's grid, and a map's coarser levels.

A raster as coarse as the grid or coarser is interpolated bilinearly, a finer one averaged (classes: nearest or
majority). A bilinear tap or a part of a mean without data leaves the pixel without data. A tap of weight zero does not
count, so a raster on the grid passes unchanged. The kernels take a *lattice* of positions: source pixel coordinates
(centres are integers) of every 16th pixel of the grid, beginning one step outside; they interpolate positions between.

A pixel of a level spans ``factor`` x ``factor`` map pixels: their mean, or their commonest class (on a tie the lower
id; no data counts as a class). A patch takes the coarsest level that is not coarser than its own pixels.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tcpipe.arrays import Bytes, Floats, Ints
from tcpipe.compiled import compile_kernel
from tcpipe.terrain.layers import Layer, Pixels
from tcpipe.terrain.target_grid import LATTICE_STEP_PX, MapGrid

SNAP_PX = 1e-4
"""A position nearer than this to a source pixel's centre is at the centre [source px]."""


@compile_kernel
def _position(lattice: Floats, row: float, col: float) -> tuple[float, float]:
    i, j = row / LATTICE_STEP_PX + 1.0, col / LATTICE_STEP_PX + 1.0
    a, b = min(int(i), lattice.shape[0] - 2), min(int(j), lattice.shape[1] - 2)
    v, u = i - a, j - b
    return _blend(lattice, a, b, 0, u, v), _blend(lattice, a, b, 1, u, v)


@compile_kernel
def _blend(lattice: Floats, a: int, b: int, axis: int, u: float, v: float) -> float:  # noqa: PLR0917
    """Return a coordinate between rows a and a + 1 and columns b and b + 1 of a lattice, at shares v and u of these."""
    upper = (1 - u) * lattice[a, b, axis] + u * lattice[a, b + 1, axis]
    return float((1 - v) * upper + v * ((1 - u) * lattice[a + 1, b, axis] + u * lattice[a + 1, b + 1, axis]))


@compile_kernel
def resample_bilinear(source: Floats, lattice: Floats, out: Floats) -> None:
    """Interpolate ``source`` (NaN: no data), shape (H, W), at each pixel of ``out``; NaN if a tap is outside or NaN."""
    rows, cols = source.shape
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            x, y = _position(lattice, i, j)
            near_x, near_y = np.floor(x + 0.5), np.floor(y + 0.5)
            x = near_x if abs(x - near_x) < SNAP_PX else x
            y = near_y if abs(y - near_y) < SNAP_PX else y
            if not (0.0 <= x <= cols - 1 and 0.0 <= y <= rows - 1):
                out[i, j] = np.nan
                continue
            a, b = int(y), int(x)
            v, u = y - a, x - b
            right, below = min(b + 1, cols - 1), min(a + 1, rows - 1)
            upper, lower = source[a, b], source[below, b]
            if u > 0.0:
                upper += u * (source[a, right] - upper)
                lower += u * (source[below, right] - lower)
            out[i, j] = upper + v * (lower - upper) if v > 0.0 else upper


@compile_kernel
def mean(source: Floats, lattice: Floats, parts: int, out: Floats) -> None:
    """Average ``source`` (NaN: no data) over each pixel of ``out`` at parts x parts points; NaN if any has no data."""
    rows, cols = source.shape
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            for p in range(parts):
                for q in range(parts):
                    x, y = _position(lattice, i + (p + 0.5) / parts - 0.5, j + (q + 0.5) / parts - 0.5)
                    a, b = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
                    total += source[a, b] if 0 <= a < rows and 0 <= b < cols else np.nan
            out[i, j] = total / (parts * parts)


@compile_kernel
def _vote(votes: Ints, found: int, best: int) -> int:
    """Count a vote; return the commonest class, the lower of two."""
    votes[found] += 1
    more = votes[found] - votes[best]
    return found if more > 0 or (more == 0 and found < best) else best


@compile_kernel
def resample_majority(source: Bytes, lattice: Floats, parts: int, out: Bytes) -> None:
    """Write each pixel's commonest class at parts x parts points (1: nearest); 0 (no data) counts; ties go low."""
    rows, cols = source.shape
    votes = np.zeros(256, np.int64)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            best = 0
            for p in range(parts):
                for q in range(parts):
                    x, y = _position(lattice, i + (p + 0.5) / parts - 0.5, j + (q + 0.5) / parts - 0.5)
                    a, b = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
                    found = int(source[a, b]) if 0 <= a < rows and 0 <= b < cols else 0
                    best = _vote(votes, found, best)
            out[i, j] = best
            if parts == 1:
                votes[best] = 0
            else:
                votes[:] = 0


@compile_kernel
def reduce_majority(ids: Bytes, factor: int, out: Bytes) -> None:
    """Write the commonest class of each ``factor`` x ``factor`` block of ``ids``; 0 (no data) counts; ties go low."""
    votes = np.zeros(256, np.int64)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            best = 0
            for a in range(i * factor, (i + 1) * factor):
                for b in range(j * factor, (j + 1) * factor):
                    best = _vote(votes, int(ids[a, b]), best)
            out[i, j] = best
            for a in range(i * factor, (i + 1) * factor):
                for b in range(j * factor, (j + 1) * factor):
                    votes[ids[a, b]] = 0


COARSEST_M = 1.0
"""No level has wider pixels than this, the length of a segment [m]."""

_WIDEST_FACTOR = 1024
_SLACK = 1.01


def list_factors(grid: MapGrid) -> tuple[int, ...]:
    """Return the factors of a map's levels: 1, 2, 4 … with pixels below `COARSEST_M` and at least two each way."""
    powers = range(1, _WIDEST_FACTOR.bit_length())
    fits = (2**n for n in powers if 2**n * grid.pixel_size_m <= COARSEST_M and min(grid.rows, grid.cols) >> n >= 2)
    return (1, *fits)


def make_overview_grid(grid: MapGrid, factor: int) -> MapGrid:
    """Return the grid of a level: same corner, wider pixels, without incomplete pixels at the far edges."""
    return replace(grid, pixel_size_m=grid.pixel_size_m * factor, rows=grid.rows // factor, cols=grid.cols // factor)


def choose_factor(factors: Sequence[int], map_pitch_m: float, pixel_size_m: float) -> int:
    """Return the largest factor whose pixels are not wider than ``pixel_size_m``; the smallest where all are."""
    return max((factor for factor in factors if factor * map_pitch_m <= _SLACK * pixel_size_m), default=min(factors))


def iterate_levels(layer: Layer, values: Pixels, factors: Sequence[int]) -> Iterator[tuple[int, Pixels]]:
    """Yield each factor above 1 with the layer reduced by it.

    Parameters
    ----------
    layer : the layer, whose kind determines the reduction.
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
        yield factor, np.where(np.isfinite(means), np.rint(means), 0.0).astype(np.uint8) if grey else means


def _halve(values: Pixels) -> Pixels:
    """Return means of 2 x 2 pixels; a single last row or column is left out."""
    even = values[: values.shape[0] // 2 * 2, : values.shape[1] // 2 * 2]
    rows = even[0::2] + even[1::2]
    return np.asarray((rows[:, 0::2] + rows[:, 1::2]) * rows.dtype.type(0.25))
