"""The time offset of one signal against others, by least squares over the lag; and signals on the grid that both need.

At every lag the target is fitted by the regressors and a constant; the lag that explains most of the target's variance is the offset,
refined by a parabola. With one regressor this is the peak of the normalised cross-correlation. Its standard deviation is the larger of two:
that of least squares, and that of the delete-a-group jackknife over contiguous groups of time (Miller 1974, Biometrika 61), which needs no
model of the residuals.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import BodyVelocities, Measurements, Positions
from tcpipe.fusion.signals import (
    compute_median_of_five,
    compute_seconds,
    integrate_signal,
    is_covered,
)

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
    """Return how late the target's stamps are against the regressors', or None where that is unknown.

    ``target``, shape (M,), and ``regressors``, shape (M, k), are on a grid of `GRID_S`, NaN where unknown. The lag is unknown where few
    values are, where the best lag is at the end of the search or another is as good, or where a constant explains the target.
    """
    products = compute_lag_products(target, regressors)
    return None if products is None else estimate_lag([products])


def estimate_lag(windows: Sequence[Floats]) -> Lag | None:
    """Return the lag of several windows of time together; ``windows`` are of `compute_lag_products`, of the same signals."""
    products = np.concatenate(windows, axis=1)
    together = -(-products.shape[1] // (2 * _GROUPS))  # fewer, longer groups
    products = np.add.reduceat(products, np.arange(0, products.shape[1], together), axis=1)
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
    """Whether another peak is about as high: a motion that repeats itself shows no lag."""
    inner = explained[1:-1]
    peaks = 1 + np.flatnonzero((inner >= explained[:-2]) & (inner >= explained[2:]))
    others = explained[peaks[np.abs(peaks - best) > 1]]
    worse = independent * np.log(np.maximum(1.0 - others, _TINY) / max(1.0 - explained[best], _TINY))
    return bool((worse < _CLEARLY).any())


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
    samples = np.take_along_axis(grouped, np.argsort(~known, axis=1, kind="stable")[:, :fullest], axis=1)
    columns = np.ones((*samples.shape, regressors.shape[1] + 2))
    found = np.empty((2 * steps + 1, groups, columns.shape[2], columns.shape[2]))
    for i, lag in enumerate(range(-steps, steps + 1)):
        # Stamps that are late by the lag: what happened `lag` rows earlier.
        columns[...] = 1.0
        columns[:, :, :-2], columns[:, :, -1] = regressors[samples - lag], target[samples]
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


Ints = NDArray[np.int64]

_LONGEST_NS, _STEP_NS, _PLACES_NS = 1800 * 10**9, 300 * 10**9, 10 * 10**9


def iterate_windows_ns(m: Measurements, length_ns: int) -> Iterator[Ints]:
    """Yield grids [ns] of about ``length_ns`` that follow each other over the time of a set, wherever it has measurements."""
    span = find_span_ns(m)
    if span is None:
        return
    count = max(1, round((span[1] - span[0]) / length_ns))
    edges = np.linspace(*span, count + 1).astype(np.int64)
    stamps = [sensor.stamp_ns for sensor in m.sensors().values()]
    heard = np.unique(np.concatenate([np.searchsorted(edges, stamp, side="right") - 1 for stamp in stamps]))
    for window in np.unique(np.clip(np.concatenate((heard - 1, heard, heard + 1)), 0, count - 1)):
        yield make_grid_ns(int(edges[window]), int(edges[window + 1]))


def find_span_ns(m: Measurements) -> tuple[int, int] | None:
    """Return first and last stamp of a set's measurements; None where no sensor has two."""
    stamps = [sensor.stamp_ns for sensor in m.sensors().values() if sensor.stamp_ns.size > 1]
    return (min(int(s[0]) for s in stamps), max(int(s[-1]) for s in stamps)) if stamps else None


def find_liveliest_window_ns(m: Measurements) -> Ints | None:
    """Return the grid [ns] of the half hour in which the robot drives most; None without measurements."""
    span = find_span_ns(m)
    if span is None:
        return None
    first_ns, last_ns = span
    begin = np.arange(first_ns, max(last_ns - _LONGEST_NS, first_ns) + 1, _STEP_NS, dtype=np.int64)
    driven_m = np.diff(compute_driven_m(m, np.stack((begin, begin + _LONGEST_NS))), axis=0)
    best = int(begin[np.argmax(driven_m)])
    return make_grid_ns(best, min(last_ns, best + _LONGEST_NS))


def compute_driven_m(m: Measurements, at_ns: Ints) -> Floats:
    """Return the distance driven before each time [m], by the first sensor that measures it."""
    source = m.first_odometry
    if source is not None:
        stamp_ns, speed_mps = source.stamp_ns, np.nan_to_num(np.abs(source.velocity_mps[:, 0]))
        steps_m = speed_mps[1:] * np.diff(compute_seconds(stamp_ns, int(stamp_ns[0])))
    elif m.gnss is not None:
        stamp_ns = np.arange(m.gnss.stamp_ns[0], m.gnss.stamp_ns[-1] + 1, _PLACES_NS, dtype=np.int64)
        places = [np.interp(stamp_ns, m.gnss.stamp_ns, axis) for axis in m.gnss.position_enu_m[:, :2].T]
        steps_m = np.hypot(*np.diff(places, axis=1))
    else:
        return np.zeros(at_ns.shape)
    driven_m: Floats = np.interp(at_ns, stamp_ns, np.concatenate(([0.0], np.cumsum(steps_m))))
    return driven_m


FIXES_S = 0.5
"""A velocity is made of fixes averaged over, and taken apart by, this long [s]."""

_MAX_GAP_NS = 500_000_000
_STRAY_M = 0.3
_STRAY = 6.0
_COURSE_MPS = 0.3


def resample_signal(stamp_ns: NDArray[np.int64], values: Floats, at_ns: NDArray[np.int64]) -> Floats:
    """Return the means of the piecewise-linear signal (N, k) over each grid cell, shape (M, k); NaN outside and in gaps.

    A gap is longer than half a second and than three periods.
    """
    edges_s: Floats = (np.arange(at_ns.size + 1, dtype=np.float64) - 0.5) * GRID_S
    means = np.diff(integrate_signal(compute_seconds(stamp_ns, int(at_ns[0])), values, edges_s), axis=0) / GRID_S
    half = GRID_NS // 2
    means[~is_covered(stamp_ns, at_ns - half, at_ns + half, least_ns=_MAX_GAP_NS)] = np.nan
    return means


def resample_twist(source: BodyVelocities, at_ns: NDArray[np.int64]) -> Floats:
    """Return forward velocity and yaw rate, shape (M, 2), single wild samples bridged; the yaw rate 0 where the source gives none."""
    forward, yaw_rate = source.velocity_mps[:, 0], source.yaw_rate_radps
    if not np.isfinite(yaw_rate).any():
        yaw_rate = np.zeros_like(forward)
    known = np.isfinite(forward + yaw_rate)
    for values in (forward, yaw_rate):
        off = np.abs(values - compute_median_of_five(values))
        known &= ~(off > _STRAY * max(float(np.nanpercentile(off, 90)), 1e-9))
    if known.sum() < 2:
        return np.full((at_ns.size, 2), np.nan)
    return resample_signal(source.stamp_ns[known], np.column_stack((forward, yaw_rate))[known], at_ns)


def resample_fixes(gnss: Positions, at_ns: NDArray[np.int64]) -> NDArray[np.complex128]:
    """Return the antenna's places [m], east and i times north, averaged over half a second, shape (M,); wild fixes are bridged."""
    place = gnss.position_enu_m[:, :2]
    wild = np.zeros(place.shape[0], np.bool_)
    for axis in place.T:
        off = np.abs(axis - compute_median_of_five(axis))
        wild |= off > _STRAY_M + _STRAY * float(np.median(off))
    if (~wild).sum() < 2:
        return np.full(at_ns.size, np.nan + 0j)
    smooth = compute_moving_mean(resample_signal(gnss.stamp_ns[~wild], place[~wild], at_ns), FIXES_S)
    return smooth[:, 0] + 1j * smooth[:, 1]


def compute_fix_velocity(gnss: Positions, at_ns: NDArray[np.int64]) -> NDArray[np.complex128]:
    """Return the antenna's velocity [m/s], east and i times north, shape (M,); wild fixes are bridged, NaN in gaps."""
    velocity = np.full(at_ns.size, np.nan + 0j)
    half = round(FIXES_S / 2 / GRID_S)
    if at_ns.size > 2 * half:
        place = resample_fixes(gnss, at_ns)
        velocity[half:-half] = (place[2 * half :] - place[: -2 * half]) / (2 * half * GRID_S)
    return velocity


def compute_course_rate(velocity_mps: NDArray[np.complex128]) -> Floats:
    """Return how fast the direction of travel turns [rad/s], shape (M,), NaN below 0.3 m/s.

    An antenna ahead of the turning point by l leads the body's course by l / v: good for a sign, not for a clock.
    """
    half = round(FIXES_S / 2 / GRID_S)
    rate = np.full(velocity_mps.size, np.nan)
    if velocity_mps.size <= 2 * half:
        return rate
    quick = np.abs(velocity_mps) > _COURSE_MPS
    turned = np.angle(velocity_mps[2 * half :] * np.conj(velocity_mps[: -2 * half]))
    rate[half:-half] = np.where(quick[2 * half :] & quick[: -2 * half], turned / (2 * half * GRID_S), np.nan)
    return rate
