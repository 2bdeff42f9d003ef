"""What class and slope leave of a label: its correlation over distance, effective sample sizes, and how well it repeats (ADR-19).

**Correlation.** The semivariogram γ(h) of the residuals, half the mean squared difference of residuals h apart, is fitted by
c0 + c1 (1 - exp(-h / L)) (Cressie, *Statistics for Spatial Data*, 1993, sections 2.4 and 2.6): L is the correlation length,
c1 / (c0 + c1) the share of variance that neighbours have in common. The mean of n samples then has the variance of the mean of

    n_eff = n² / Σij ρ(hij) = n / (1 + (n - 1) m),   ρ(h) = c1 / (c0 + c1) exp(-h / L) for i ≠ j, ρ = 1 for i = j,

independent ones, m being the mean of ρ over all pairs of two (Bayley and Hammersley, "The effective number of independent
observations in an autocorrelated time series", 1946; Cressie 1993, section 1.3).

**Repeatability.** A model that knows the ground alone cannot distinguish two passes. Two passes of one place and direction give
s² = (r1 - r2)² / 2 of their residuals r; the mean over P pairs that share no sample is the variance of one pass. Its interval is a
jackknife over blocks of ground, since the pairs of one block are not independent (Efron and Tibshirani, *An Introduction to the
Bootstrap*, 1993, chapter 11). The offset between two footprints makes the figure rather too large than too small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
from scipy.special import stdtrit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_LAGS = (0.0, 0.5, 1.5, 2.5, 3.5, 4.5, 6.0, 8.0, 11.0, 15.0, 20.0, 28.0, 40.0)
"""Borders between the distances whose pairs are taken together, in chords."""
_LENGTHS = np.geomspace(0.25, 40.0, 120)
"""Correlation lengths that are tried, in chords."""
_FEWEST_PAIRS = 30
_FEWEST_FITTED = 12
"""Below so many samples a class is described by its mean, not by a parabola over slope."""
_STRETCH, _MOST = 200, 2000
"""The semivariogram is made from whole stretches of so many samples, and from so many samples at most."""
_MOST_IN_CELL = 1000
"""Mean correlations are over the pairs of so many samples at most, the first ones: rows are in random order."""


@dataclass(frozen=True, slots=True)
class Correlation:
    """Correlation of residuals at distance h: ``share`` · exp(-h / ``length_m``)."""

    length_m: float
    share: float
    """From 0 to 1."""
    pairs: int
    """Pairs of samples that it was estimated from."""


def compute_slope_residuals(values: Floats, terrain_class: NDArray[np.integer], slope_rad: Floats) -> Floats:
    """Return what a parabola over slope, one a class, leaves of a label, shape (N,)."""
    left = np.empty(len(values))
    for kind in np.unique(terrain_class):
        rows = np.flatnonzero(terrain_class == kind)
        powers = 3 if len(rows) >= _FEWEST_FITTED else 1
        design = np.vander(slope_rad[rows], powers, increasing=True)
        left[rows] = values[rows] - design @ np.linalg.lstsq(design, values[rows])[0]
    return left


def fit_correlation(
    residual: Floats, xy_m: Floats, run: NDArray[np.integer], start_ns: Ints, *, chord_m: float
) -> Correlation | None:
    """Return the correlation of a label's residuals, shape (N,), over distance; None where too few samples are near each other.

    ``xy_m`` are centres of the footprints [m], shape (N, 2); ``run`` and ``start_ns`` [ns] order the samples, shape (N,).
    """
    rows = _draw_sections(run, start_ns)
    apart = pdist(xy_m[rows]) / chord_m
    bins, size = np.digitize(apart, _LAGS) - 1, len(_LAGS)
    pairs = np.bincount(bins, minlength=size)[: size - 1]
    enough = pairs >= _FEWEST_PAIRS
    if enough.sum() < 3:
        return None
    lag = np.bincount(bins, apart, size)[: size - 1][enough] / pairs[enough]
    half_squares = pdist(residual[rows, None], "sqeuclidean") / 2.0
    gamma = np.bincount(bins, half_squares, size)[: size - 1][enough] / pairs[enough]
    if not gamma.any():
        return None
    length, nugget, sill = _fit(lag, gamma, pairs[enough])
    return Correlation(length * chord_m, sill / (nugget + sill), int(pairs.sum())) if nugget + sill > 0.0 else None


def _draw_sections(run: NDArray[np.integer], start_ns: Ints) -> Ints:
    """Return rows of whole stretches of the drives, spread evenly; all rows where there are few."""
    order = np.lexsort((start_ns, run))
    if len(order) <= _MOST:
        return order
    firsts = np.linspace(0, len(order) - _STRETCH, _MOST // _STRETCH).astype(np.int64)
    return np.unique(np.concatenate([order[first : first + _STRETCH] for first in firsts]))


def _fit(lag: Floats, gamma: Floats, pairs: Ints) -> tuple[float, float, float]:
    """Return length, nugget and sill of the exponential model by weighted least squares (weights of Cressie 1985: pairs / γ²)."""
    weight = np.sqrt(pairs) / np.maximum(gamma, 1e-12 * gamma.max())
    best = (np.inf, 0.0, 1.0, 0.0)
    for length in _LENGTHS:
        design = np.column_stack([np.ones(len(lag)), 1.0 - np.exp(-lag / length)])
        (nugget, sill), misfit = nnls(design * weight[:, None], gamma * weight)
        best = min(best, (float(misfit), float(length), float(nugget), float(sill)))
    return best[1:]


def compute_effective_size(xy_m: Floats, *found: Correlation) -> float:
    """Return to how many independent samples those at ``xy_m`` [m], shape (n, 2), are worth: from 1 to n, 0 of none.

    Of several correlations, the one that leaves fewest counts.
    """
    count = len(xy_m)
    if count <= 1:
        return float(count)
    apart_m = pdist(xy_m[:_MOST_IN_CELL])
    alike = max(one.share * float(np.exp(apart_m / -one.length_m).mean()) for one in found)
    return count / (1.0 + (count - 1) * alike)


NEAR = 0.25
"""Footprints whose centres are at most so many chords apart are one place."""

ALONG_RAD = np.radians(10.0)
"""Courses that differ by at most so much are one direction [rad]; NEAR and this bound the two together, as an ellipsoid."""

_CHUNK = 65_536
"""Samples whose nearest are looked for together."""
_BLOCK = 10.0
"""Side of a jackknife block, in chords."""
_FEWEST_BLOCKS = 5
_CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Floor:
    """How well a label repeats itself, in the label's unit: the standard deviation of one pass, with its 95 % interval."""

    pairs: int
    places: int
    """Blocks of ground that the pairs lie in."""
    std: float
    std_low: float | None
    """None where there are too few places for an interval."""
    std_high: float | None
    share_of_variance: float
    """Of the label's own variance; no model explains more than the rest."""


def find_repeated_pairs(
    xy_m: Floats, course_rad: Floats, terrain_class: NDArray[np.integer], *, chord_m: float
) -> Ints:
    """Return pairs of samples that cover one place of one class in one direction, shape (P, 2); no sample is in two pairs.

    Samples of one pass never qualify: they begin a chord apart. Of several passes the two nearest are the pair.
    ``xy_m`` are centres of the footprints [m], shape (N, 2), ``course_rad`` their directions of travel [rad], shape (N,).
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
    """Return how well a label repeats itself over ``pairs``, shape (P, 2); None without pairs.

    ``values`` and ``residual`` are the label and its `compute_slope_residuals`, shape (N,), ``xy_m`` centres of the footprints [m], (N, 2).
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
