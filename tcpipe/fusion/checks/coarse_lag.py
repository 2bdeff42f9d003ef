"""Sensors whose clock is seconds to minutes off the others': by speed and turn rate, over lags of up to five minutes.

Two sensors' signals without their slow parts are correlated at every lag; unknown rows have no weight (masked normalised
cross-correlation: Padfield, CVPR 2010). The best lag has the largest log-likelihood ratio of both signals. It is known only if it is far
above noise, and if every other peak, and no lag, explain the same rows worse in several separate windows and hardly better in any: a
straight shows no lag, repeated lanes show several.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.lags import (
    GRID_S,
    MAX_LAG_S,
    Floats,
    compute_course_rate,
    compute_fix_velocity,
    find_liveliest_window_ns,
    resample_signal,
    resample_twist,
)
from tcpipe.fusion.measurements import GNSS, IMU, Measurements

_ROW_S = 0.2
NEAR_S = MAX_LAG_S - _ROW_S
"""Largest lag that the fine search surely finds [s]."""
_MOST = 1500
"""Largest lag that is searched [rows], 5 min."""
_SMOOTH, _SLOW = 5, 151
"""Rows over which signals are averaged, and about whose mean they are compared: 1 s and 30 s."""
_MANOEUVRES = (0.15, 0.1)
"""Least size of a signal that varies [m/s], [rad/s]."""
_FEWEST, _INDEPENDENT = 450, 10
"""Rows of the least overlap, 90 s, and between independent ones, 2 s."""
_MIN_SCORE, _MIN_CORRELATION = 18.0, 0.4
"""Least log-likelihood ratio of the best lag, 6 σ: noise reaches 4 σ in 3,000 lags; and least correlation of one signal."""
_WINDOW, _MIN_WINDOWS = 50, 4
"""Rows in which two lags are compared, 10 s, and windows that have to prefer the best lag."""
_APART, _PEAKS = 15, 25
"""Rows between separate peaks, 3 s, and most peaks that are compared with the best."""


def find_coarse_offsets(m: Measurements) -> dict[str, float]:
    """Return how late sensors' stamps are against those of the largest group that shares a clock [s], those of the group about 0.

    Sensors whose offset is unknown are missing; {} if the pairs of sensors contradict each other.
    """
    at_ns = find_liveliest_window_ns(m)
    if at_ns is None or at_ns.size * GRID_S < _FEWEST * _ROW_S:
        return {}
    signals = _compute_motion(m, at_ns)
    lags = dict[tuple[str, str], float]()
    for against, late in combinations(signals, 2):
        lag_s = find_coarse_lag(signals[late], signals[against])
        lags |= {} if lag_s is None else {(late, against): lag_s, (against, late): -lag_s}
    late_s = {first: 0.0 for first, _ in sorted(lags, key=lambda pair: abs(lags[pair]) <= NEAR_S)[:1]}
    for _ in signals:
        for (late, against), lag_s in lags.items():
            if against in late_s:
                late_s.setdefault(late, late_s[against] + lag_s)
    if any(abs(late_s[a] - late_s[b] - lag_s) > NEAR_S for (a, b), lag_s in lags.items() if a in late_s):
        return {}
    groups = [{role: each - late_s[first] for role, each in late_s.items()} for first in signals if first in late_s]
    # Of equal groups, that of the first sensor.
    return max(groups, key=lambda group: sum(abs(each) <= NEAR_S for each in group.values()), default={})


def _compute_motion(m: Measurements, at_ns: NDArray[np.int64]) -> dict[str, Floats]:
    """Return speed and turn rate of each sensor by rows of 0.2 s, shape (2, N); odometries first, the IMU last."""
    found, unknown = dict[str, tuple[Floats, Floats]](), np.full(at_ns.size, np.nan)
    for role, source in m.odometries().items():
        forward, yaw_rate = resample_twist(source, at_ns).T
        found[role] = np.abs(forward), yaw_rate
    if m.gnss is not None:
        velocity = compute_fix_velocity(m.gnss, at_ns)
        found[GNSS] = np.abs(velocity), compute_course_rate(velocity)
    if m.imu is not None:
        up = np.median(m.imu.specific_force_mps2, axis=0) if m.imu.accelerometer_usable else np.array([0.0, 0.0, 1.0])
        rate = resample_signal(m.imu.stamp_ns, m.imu.angular_velocity_radps, at_ns)
        found[IMU] = unknown, rate @ up / max(float(np.linalg.norm(up)), 1e-9)
    return {
        role: np.stack([_remove_slow_parts(*each) for each in zip(pair, _MANOEUVRES, strict=True)])
        for role, pair in found.items()
    }


def _remove_slow_parts(values: Floats, least: float) -> Floats:
    """Return a signal in windows of rows, smoothed over 1 s, less the mean of 30 s around each; NaN if it varies by less than ``least``."""
    width = round(_ROW_S / GRID_S)
    rows = values[: values.size // (width * _WINDOW) * width * _WINDOW].reshape(-1, width).mean(1)
    smooth = np.where(np.isfinite(rows), _average(rows, _SMOOTH), np.nan)
    quick = smooth - _average(smooth, _SLOW)
    return quick if (np.abs(quick) > least).sum() > _SMOOTH else np.full(quick.size, np.nan)


def _average(values: Floats, width: int) -> Floats:
    """Return the mean of the known values among ``width`` rows around each."""
    known, inside = np.isfinite(values), slice(width // 2, width // 2 + values.size)
    sums, counts = (np.convolve(each, np.ones(width))[inside] for each in (np.where(known, values, 0.0), known))
    mean: Floats = sums / np.maximum(counts, 1.0)
    return mean


def find_coarse_lag(late: Floats, against: Floats) -> float | None:
    """Return how much later the stamps of one sensor are than another's [s], None where this is unknown; signals of shape (2, N)."""
    correlation, rows = _correlate(late, against)
    log_ratio = -0.5 * np.log(1.0 - np.maximum(correlation, 0.0) ** 2)
    score, height = (rows * log_ratio).sum(0) / _INDEPENDENT, log_ratio.sum(0)
    best = int(np.argmax(score))
    if best in {0, 2 * _MOST} or score[best] < _MIN_SCORE or correlation[:, best].max() < _MIN_CORRELATION:
        return None
    if abs(best - _MOST) * _ROW_S > NEAR_S:
        peaks = 1 + np.flatnonzero((height[1:-1] >= height[:-2]) & (height[1:-1] > height[2:]))
        peaks = peaks[np.abs(peaks - best) > _APART]
        peaks = np.append(peaks[np.argsort(-height[peaks], kind="stable")][:_PEAKS], _MOST)
        if any(_is_rival(late, against, best - _MOST, int(peak) - _MOST) for peak in peaks if height[peak] > 0):
            return None
    before, at, after = score[best - 1 : best + 2]
    return float((best - _MOST + 0.5 * (after - before) / max(2.0 * at - before - after, 1e-9)) * _ROW_S)


def _correlate(late: Floats, against: Floats) -> tuple[Floats, Floats]:
    """Return the correlation of each signal at all lags, and the rows in which both are known, shape (2, 2 `_MOST` + 1) each."""
    size = 1 << (late.shape[1] + _MOST).bit_length()

    def multiply(a: Floats, b: Floats) -> Floats:
        """Return the sums of a(t) b(t + lag)."""
        sums = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
        return np.concatenate((sums[:, -_MOST:], sums[:, : _MOST + 1]), axis=1)

    a, b, known_a, known_b = (
        np.nan_to_num(against),
        np.nan_to_num(late),
        1.0 * np.isfinite(against),
        1.0 * np.isfinite(late),
    )
    rows = np.rint(multiply(known_a, known_b))
    sum_a, sum_b, counts = multiply(a, known_b), multiply(known_a, b), np.maximum(rows, 1.0)
    squares = np.stack((multiply(a**2, known_b) - sum_a**2 / counts, multiply(known_a, b**2) - sum_b**2 / counts))
    # A short overlap, and one without motion, show nothing.
    enough = (rows >= _FEWEST) & (squares > 0.2 * np.median(squares, axis=2, keepdims=True) + 1e-9).all(0)
    products = np.where(enough, multiply(a, b) - sum_a * sum_b / counts, 0.0)
    return np.clip(products / np.sqrt(np.where(enough, squares.prod(0), 1.0)), -0.9999, 0.9999), rows


def _is_rival(late: Floats, against: Floats, best: int, other: int) -> bool:
    """Return whether a lag [rows] explains the same rows about as well as the best: few windows prefer the best, or some the other."""
    residuals, of_other = (_compute_residuals(late, against, lag) for lag in (best, other))
    noise = np.nansum(residuals, axis=1) / np.maximum(np.isfinite(residuals).sum(1), 1)
    worse = ((of_other - residuals) / np.maximum(noise, 1e-12)[:, None]).reshape(2, -1, _WINDOW)
    clear = 0.5 * np.maximum(np.isfinite(worse).sum((0, 2)), _WINDOW)
    total = np.nansum(worse, axis=(0, 2))
    return bool((total > clear).sum() - 3 * (total < -clear).sum() < _MIN_WINDOWS)


def _compute_residuals(late: Floats, against: Floats, lag: int) -> Floats:
    """Return the squares of what the other signals, ``lag`` rows later, leave of the late ones, shape (2, N); NaN where unknown."""
    moved, size = np.full_like(late, np.nan), late.shape[1]
    moved[:, max(lag, 0) : max(size + lag, 0)] = against[:, max(-lag, 0) : max(size - lag, 0)]
    known = np.isfinite(moved) & np.isfinite(late)
    counts = np.maximum(known.sum(1, keepdims=True), 1)
    x, y = (
        np.where(known, each - np.sum(each, axis=1, where=known, keepdims=True) / counts, 0.0) for each in (moved, late)
    )
    slope = np.sum(x * y, axis=1, keepdims=True) / np.maximum(np.sum(x * x, axis=1, keepdims=True), 1e-12)
    return np.where(known, (y - np.maximum(slope, 0.0) * x) ** 2, np.nan)
