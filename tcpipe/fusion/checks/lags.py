"""How late one signal's stamps are against others', by least squares over the lag.

Both sides stand on one grid, smoothed alike, so that smoothing moves neither. For every lag the target is fitted by the regressors
(linear, with a constant); the best lag is where that explains most of the target's variance, refined by a parabola. With one regressor
this is the peak of the normalised cross-correlation. Its standard deviation is the larger of two. That of least squares: the noise that is
left over the curvature of the peak, so that a flat peak tells little. And the delete-a-group jackknife's over contiguous groups of time
(Miller 1974, Biometrika 61), which needs no model of the residuals. Where fewer than four groups hold anything, or another peak is
nearly as high, nothing is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.signals import compute_seconds, integrate_signal, is_in_gap

GRID_S = 0.02
"""Spacing of the grid [s]."""
GRID_NS = round(GRID_S * 1e9)
MAX_LAG_S = 1.2
"""Largest lag that is looked for [s]."""

_TARGET_ROWS = 5  # the target is taken at every fifth row: nothing smoothed over 0.1 s is lost
_GROUPS = 20
_FEWEST_GROUPS = 8
_FEWEST_EVENTS = 4
_MIN_GROUP_S = 2.0
_ALIKE_ROWS = 2
"""What is left is alike over this many rows: signals are smoothed over 0.1 to 0.2 s."""
_CLEARLY = 10.83
"""99.9 % of chi-squared with one degree of freedom: a rival peak must fit worse by this."""
_TINY = 1e-12

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Lag:
    """How much later the target's stamps are than the regressors' [s], its standard deviation, and the variance explained (0 to 1)."""

    offset_s: float
    std_s: float
    explained: float


def make_grid_ns(first_ns: int, last_ns: int) -> NDArray[np.int64]:
    """Return a grid's stamps [ns] from first to last."""
    return np.arange(first_ns, last_ns + 1, GRID_NS, dtype=np.int64)


def average_on_grid(
    stamp_ns: NDArray[np.int64], values: Floats, at_ns: NDArray[np.int64], *, longest_gap_ns: int
) -> Floats:
    """Return the means of the piecewise-linear signal (N, k) over each grid cell, shape (M, k); NaN in gaps and outside."""
    zero = int(at_ns[0])
    edges_s: Floats = (np.arange(at_ns.size + 1, dtype=np.float64) - 0.5) * GRID_S
    means = np.diff(integrate_signal(compute_seconds(stamp_ns, zero), values, edges_s), axis=0) / GRID_S
    half = GRID_NS // 2
    means[is_in_gap(stamp_ns, at_ns - half, at_ns + half, longest_ns=longest_gap_ns)] = np.nan
    return means


def compute_moving_mean(values: Floats, width_s: float) -> Floats:
    """Return the centred running mean over ``width_s`` of (M, k) values, NaN where the window holds one or leaves the grid."""
    half = round(width_s / GRID_S / 2)
    known = np.isfinite(values.sum(1))
    filled = np.where(known[:, None], values, 0.0)
    sums = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(filled, axis=0)))
    counts = np.concatenate(([0], np.cumsum(known)))
    width = 2 * half + 1
    mean = np.full_like(values, np.nan)
    if values.shape[0] >= width:
        whole = counts[width:] - counts[:-width] == width
        mean[half : values.shape[0] - half] = np.where(whole[:, None], (sums[width:] - sums[:-width]) / width, np.nan)
    return mean


def find_lag(target: Floats, regressors: Floats) -> Lag | None:
    """Return how late the target's stamps are against the regressors', or None where nothing can be said.

    Parameters
    ----------
    target : shape (M,), on a grid of `GRID_S`, NaN where unknown.
    regressors : shape (M, k), likewise.

    Returns
    -------
    None where too little is known, where the best lag lies at the end of the search or another is as good, or where a constant explains
    the target.
    """
    products = compute_lag_products(target, regressors)
    return None if products is None else estimate_lag([products])


def estimate_lag(windows: Sequence[Floats]) -> Lag | None:
    """Return the lag of several windows of time together; ``windows`` are of `compute_lag_products`, of the same signals."""
    products = _merge_products(np.concatenate(windows, axis=1))
    products = products[:, (products[:, :, -2, -2] > 0).all(axis=0)]
    groups = products.shape[1]
    if groups < _FEWEST_EVENTS:
        return None
    whole = products.sum(1)
    explained = _compute_explained_variance(whole)
    offset_s = _find_peak(explained)
    left_out = [_find_peak(_compute_explained_variance(whole - products[:, g])) for g in range(groups)]
    if not np.isfinite([offset_s, *left_out]).all():
        return None
    best = int(np.argmax(explained))
    independent = float(whole[best, -2, -2]) / _ALIKE_ROWS
    if _has_rival(explained, best, independent):
        return None
    jackknife_s = float(np.sqrt((groups - 1) / groups * np.sum((np.array(left_out) - np.mean(left_out)) ** 2)))
    return Lag(offset_s, max(jackknife_s, _compute_peak_std_s(explained, best, independent)), float(explained[best]))


def _compute_peak_std_s(explained: Floats, best: int, independent: float) -> float:
    """Return the standard deviation of a peak [s] by least squares: the noise that is left over the peak's curvature."""
    before, at, after = explained[best - 1 : best + 2]
    curvature = (2 * at - before - after) / GRID_S**2
    return float(np.sqrt(2 * max(1.0 - at, 0.0) / (independent * curvature))) if curvature > 0 else np.inf


def _has_rival(explained: Floats, best: int, independent: float) -> bool:
    """Whether another peak is about as high: of a motion that repeats itself no lag can be told."""
    inner = explained[1:-1]
    peaks = 1 + np.flatnonzero((inner >= explained[:-2]) & (inner >= explained[2:]))
    others = explained[peaks[np.abs(peaks - best) > 1]]
    worse = independent * np.log(np.maximum(1.0 - others, _TINY) / max(1.0 - explained[best], _TINY))
    return bool((worse < _CLEARLY).any())


def _merge_products(products: Floats) -> Floats:
    """Return the products of fewer, longer groups of time, at most twice `_GROUPS`."""
    together = -(-products.shape[1] // (2 * _GROUPS))
    first = np.arange(0, products.shape[1], together)
    merged: Floats = np.add.reduceat(products, first, axis=1)
    return merged


def compute_lag_products(target: Floats, regressors: Floats) -> Floats | None:
    """Return what `estimate_lag` needs of a window: sums of products of (regressors, 1, target) by lag and group of time.

    Shape (L, G, k + 2, k + 2); parameters are `find_lag`'s. None where the window is too short.
    """
    steps = round(MAX_LAG_S / GRID_S)
    rows = np.arange(steps, target.size - steps, _TARGET_ROWS)
    groups = min(_GROUPS, int(rows.size * _TARGET_ROWS * GRID_S / _MIN_GROUP_S))
    if groups < _FEWEST_GROUPS:
        return None
    grouped = rows[: rows.size // groups * groups].reshape(groups, -1)
    known = np.isfinite(target[grouped])
    # Only rows in which the target is known; a group that has fewer than the fullest goes on with unknown ones, which count 0.
    fullest = int(known.sum(1).max())
    told = np.take_along_axis(grouped, np.argsort(~known, axis=1, kind="stable")[:, :fullest], axis=1)
    columns = np.ones((*told.shape, regressors.shape[1] + 2))
    found = np.empty((2 * steps + 1, groups, columns.shape[2], columns.shape[2]))
    for i, lag in enumerate(range(-steps, steps + 1)):
        # Stamps that are late by the lag: what happened `lag` rows earlier.
        columns[...] = 1.0
        columns[:, :, :-2], columns[:, :, -1] = regressors[told - lag], target[told]
        columns[~np.isfinite(columns).all(2)] = 0.0
        found[i] = np.matmul(columns.transpose(0, 2, 1), columns)
    return found


def _compute_explained_variance(products: Floats) -> Floats:
    """Return the share of the target's variance that the regressors explain at each lag, shape (L,)."""
    k = products.shape[1] - 2
    counts = products[:, k, k]
    if (counts < 0.5 * counts.max()).any() or counts.max() < 10 * (k + 2):
        return np.full(counts.size, np.nan)
    # Everything about its mean: the constant is fitted.
    about_mean = products - products[:, :, k : k + 1] * products[:, k : k + 1, :] / counts[:, None, None]
    inner, cross, total = about_mean[:, :k, :k], about_mean[:, :k, -1], about_mean[:, -1, -1]
    scale = np.sqrt(np.maximum(np.diagonal(inner, axis1=1, axis2=2), _TINY))
    inner = inner / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(k)
    cross = cross / scale
    fitted = np.linalg.solve(inner, cross[:, :, None])[:, :, 0]
    return np.where(total > _TINY, np.sum(fitted * cross, axis=1) / np.maximum(total, _TINY), np.nan)


def _find_peak(explained: Floats) -> float:
    """Return the lag of the maximum [s], by a parabola through its neighbours; NaN at the end of the search and without one."""
    if not np.isfinite(explained).all():
        return float("nan")
    best = int(np.argmax(explained))
    if best in {0, explained.size - 1}:
        return float("nan")
    before, at, after = explained[best - 1 : best + 2]
    curvature = before - 2 * at + after
    shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return float((best - explained.size // 2 + shift) * GRID_S)
