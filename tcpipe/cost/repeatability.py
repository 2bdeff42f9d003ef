"""Repeatability of labels where the robot drove the same ground twice in one direction (docs/how-to/trust.md).

A model that knows only the ground cannot distinguish two passes. Two passes of one place and direction give s² = (r1 -
r2)² / 2 of their residuals r; the mean over P pairs without common samples is the variance of one pass. Its interval is
a jackknife over blocks of ground, since the pairs of one block are not independent (Efron and Tibshirani, *An
Introduction to the Bootstrap*, 1993, chapter 11). The offset between two footprints makes the figure rather too large
than too small.
"""

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import stdtrit

from tcpipe.arrays import AnyInts, Floats, Ints
from tcpipe.tables.facts import Floor

_FEWEST_FITTED = 12  # fewest samples of a class for a parabola over slope; else its mean


def compute_slope_residuals(values: Floats, terrain_class: AnyInts, slope_rad: Floats) -> Floats:
    """Return the residuals of a label from a parabola over slope for each class, shape (N,)."""
    residual = np.empty(len(values))
    for kind in np.unique(terrain_class):
        rows = np.flatnonzero(terrain_class == kind)
        powers = 3 if len(rows) >= _FEWEST_FITTED else 1
        design = np.vander(slope_rad[rows], powers, increasing=True)
        residual[rows] = values[rows] - design @ np.linalg.lstsq(design, values[rows])[0]
    return residual


NEAR = 0.25
"""Largest distance of centres of footprints at one place [chords]."""

ALONG_RAD = np.radians(10.0)
"""Largest difference of courses of one direction [rad]; with NEAR it bounds position and course as an ellipsoid."""

_CHUNK = 65_536  # samples per nearest-neighbour query
_BLOCK = 10.0  # side of a jackknife block, in chords
_FEWEST_BLOCKS = 5
_CONFIDENCE = 0.95


def find_repeated_pairs(xy_m: Floats, course_rad: Floats, terrain_class: AnyInts, *, chord_m: float) -> Ints:
    """Return pairs of samples of one place, class and direction, shape (P, 2); no sample is in two pairs.

    Samples of one pass never qualify: they begin a chord apart. Of several passes the two nearest are the pair.
    ``xy_m``: centres of the footprints [m], shape (N, 2); ``course_rad``: directions of travel [rad], shape (N,).
    """
    if len(xy_m) < 2:
        return np.empty((0, 2), np.int64)
    reach_m = NEAR * chord_m
    turned_m = reach_m / (2.0 * np.sin(ALONG_RAD / 2.0))  # a circle on which ALONG_RAD apart is reach_m apart
    points = np.column_stack([xy_m, turned_m * np.cos(course_rad), turned_m * np.sin(course_rad)])
    tree, other = cKDTree(points), np.full(len(points), -1, np.int32)
    for first in range(0, len(points), _CHUNK):
        rows = np.arange(first, min(first + _CHUNK, len(points)))
        apart_m, near = tree.query(points[rows], k=2, distance_upper_bound=reach_m * (1.0 + 1e-9))
        itself = near[:, 0] == rows
        nearest = np.where(itself, near[:, 1], near[:, 0])
        found = np.isfinite(np.where(itself, apart_m[:, 1], apart_m[:, 0]))
        other[rows[found]] = nearest[found]
    ours = np.flatnonzero(other >= 0)
    mutual = ours[(other[other[ours]] == ours) & (ours < other[ours])]
    pairs = np.column_stack([mutual, other[mutual]]).astype(np.int64)
    return np.asarray(pairs[terrain_class[pairs[:, 0]] == terrain_class[pairs[:, 1]]])


def estimate_repeatability(
    values: Floats, residual: Floats, pairs: Ints, xy_m: Floats, *, chord_m: float
) -> Floor | None:
    """Return the repeatability of a label over ``pairs``, shape (P, 2); None without pairs.

    ``values``, ``residual``: the label and its `compute_slope_residuals`, shape (N,); ``xy_m``: centres of the
    footprints [m], (N, 2).
    """
    if not len(pairs):
        return None
    half_squares = (residual[pairs[:, 0]] - residual[pairs[:, 1]]) ** 2 / 2.0
    cells = np.floor(xy_m[pairs[:, 0]] / (_BLOCK * chord_m)).astype(np.int64)
    block = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    variance = float(half_squares.mean())
    low, high = _bootstrap_interval(half_squares, block)
    own = float(values.var())
    return Floor(
        pairs=len(pairs),
        places=int(block.max()) + 1,
        std=float(np.sqrt(variance)),
        std_low=low,
        std_high=high,
        share_of_variance=variance / own if own > 0 else 1.0,
    )


def _bootstrap_interval(half_squares: Floats, block: Ints) -> tuple[float | None, float | None]:
    """Return both ends of the 95 % interval of the root of the mean: delete-one-block jackknife of its logarithm."""
    sums, counts = np.bincount(block, half_squares), np.bincount(block)
    blocks = len(sums)
    if blocks < _FEWEST_BLOCKS or not half_squares.any():
        return None, None
    without = (sums.sum() - sums) / (counts.sum() - counts)
    if not (without > 0.0).all():
        return None, None
    logs = np.log(without) / 2.0
    error = np.sqrt((blocks - 1) / blocks * ((logs - logs.mean()) ** 2).sum())
    reach = float(stdtrit(blocks - 1, 0.5 + _CONFIDENCE / 2.0)) * error
    std = np.sqrt(half_squares.mean())
    return float(std * np.exp(-reach)), float(std * np.exp(reach))
