"""Sensors whose clock is seconds to minutes off the others': by speed and turn rate, over lags of up to five minutes.

Two signals without their slow parts are correlated at every lag; unknown rows have no weight (masked normalised cross-correlation:
Padfield, CVPR 2010). The score of a lag is the log-likelihood ratio of all signals, by their numbers of independent rows (Bartlett). The
best lag is known only if its correlation is far above noise, separate manoeuvres overlap, and every other peak explains the same rows
worse, in several separate windows and hardly better in any: repeated lanes are ambiguous.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
_MOST = round(300.0 / _ROW_S)
"""Largest lag that is searched [rows]."""
NEAR_S = MAX_LAG_S - _ROW_S
"""Largest lag that the fine search surely finds [s]."""
_SMOOTH, _SLOW = 5, 151
"""Rows over which signals are averaged, and about whose mean they are compared: 1 s and 30 s."""
_LEAST = {"speed": 0.15, "turn": 0.1}
"""Least size of a manoeuvre, by signal [m/s], [rad/s]."""
_FEWEST_ROWS = 450
"""Least overlap, 90 s."""
_WINDOW, _APART = 50, 15
"""Rows in which two lags are compared, and between separate manoeuvres and peaks: 10 s and 3 s."""
_MIN_Z, _MIN_CORRELATION, _MIN_MANOEUVRES = 6.0, 0.4, 6
_PEAKS = 25
_MIN_WINDOWS, _MIN_LOG_RATIO = 4, 10.0
"""Windows that prefer the best lag to a rival, and the least logarithm of the ratio of their likelihoods."""

Signals = Mapping[str, Floats]
"""Speed [m/s] and turn rate [rad/s] of a sensor in rows of 0.2 s, without their slow parts, shape (N,); NaN where unknown."""


def find_coarse_offsets(m: Measurements) -> tuple[str, dict[str, float]]:
    """Return a sensor of the largest group that shares a clock, and how much later the stamps of other sensors are [s].

    Only offsets beyond the fine search are returned; ("", {}) if there are none, or the pairs of sensors contradict each other.
    """
    at_ns = find_liveliest_window_ns(m)
    signals = {} if at_ns is None else _compute_motion(m, at_ns)
    lags = dict[tuple[str, str], float]()
    for against, late in combinations(signals, 2):
        lag_s = find_coarse_lag(signals[late], signals[against])
        lags |= {} if lag_s is None else {(late, against): lag_s, (against, late): -lag_s}
    clock_s = next(({late: 0.0} for (late, _), lag_s in lags.items() if abs(lag_s) > NEAR_S), {})
    for _ in signals:
        for (late, against), lag_s in lags.items():
            if against in clock_s:
                clock_s.setdefault(late, clock_s[against] + lag_s)
    found = {
        reference: {role: clock_s[role] - clock_s[reference] for role in clock_s}
        for reference in signals
        if reference in clock_s
    }
    if any(abs(found[against][late] - lag_s) > NEAR_S for (late, against), lag_s in lags.items() if late in clock_s):
        return "", {}
    others = {
        reference: {role: late_s for role, late_s in of.items() if abs(late_s) > NEAR_S}
        for reference, of in found.items()
    }
    return min(
        others.items(), key=lambda item: len(item[1]), default=("", {})
    )  # of equal groups, that of the first sensor


def _compute_motion(m: Measurements, at_ns: NDArray[np.int64]) -> dict[str, Signals]:
    """Return the signals of each sensor on a grid of `GRID_S`; of two groups of equal size, that of the first sensor is taken for right."""
    found = dict[str, dict[str, Floats]]()
    for role, source in m.odometries().items():
        forward, yaw_rate = resample_twist(source, at_ns).T
        found[role] = {"speed": np.abs(forward), "turn": yaw_rate}
    if m.gnss is not None:
        velocity = compute_fix_velocity(m.gnss, at_ns)
        found[GNSS] = {"speed": np.abs(velocity), "turn": compute_course_rate(velocity)}
    if m.imu is not None:
        up = np.median(m.imu.specific_force_mps2, axis=0) if m.imu.accelerometer_usable else np.array([0.0, 0.0, 1.0])
        rate = resample_signal(m.imu.stamp_ns, m.imu.angular_velocity_radps, at_ns)
        found[IMU] = {"turn": rate @ up / max(float(np.linalg.norm(up)), 1e-9)}
    return {role: {name: _remove_slow_parts(values) for name, values in of.items()} for role, of in found.items()}


def _remove_slow_parts(values: Floats) -> Floats:
    """Return a signal by rows of 0.2 s, smoothed over 1 s, less the mean of 30 s around each."""
    width = round(_ROW_S / GRID_S)
    rows = values[: values.size // width * width].reshape(-1, width).mean(1)
    smooth = np.where(np.isfinite(rows), _average(rows, _SMOOTH), np.nan)
    return smooth - _average(smooth, _SLOW)


def _average(values: Floats, width: int) -> Floats:
    """Return the mean of the known values among ``width`` rows around each."""
    known, first = np.isfinite(values), width // 2
    sums, counts = (
        np.convolve(each, np.ones(width))[first : first + known.size] for each in (np.where(known, values, 0.0), known)
    )
    return sums / np.maximum(counts, 1.0)


@dataclass(frozen=True, slots=True)
class _Comparison:
    """Two signals of one kind, shape (N,), and at each lag their correlation and number of independent rows, shape (2 `_MOST` + 1,)."""

    late: Floats
    against: Floats
    least: float
    correlation: Floats
    independent: Floats

    @property
    def log_ratio(self) -> Floats:
        """Log-likelihood ratio of a linear relation to none, by independent row."""
        return -0.5 * np.log(1.0 - np.maximum(self.correlation, 0.0) ** 2)

    def compute_residuals(self, lag: int) -> Floats:
        """Return the squares of what the other signal, ``lag`` rows later, leaves of the late one, over its variance; NaN where unknown."""
        residuals = np.full(self.late.size, np.nan)
        residuals[max(lag, 0) : max(residuals.size + lag, 0)] = self.against[
            max(-lag, 0) : max(residuals.size - lag, 0)
        ]
        known = np.isfinite(residuals) & np.isfinite(self.late)
        x, y = (
            (each[known] - np.mean(each[known]) for each in (residuals, self.late))
            if known.any()
            else (np.zeros(1),) * 2
        )
        slope = max(float(x @ y), 0.0) / max(float(x @ x), 1e-12)
        residuals[known] = (y - slope * x) ** 2 / max(float(np.mean(y**2)), 1e-12)
        return np.where(known, residuals, np.nan)

    def count_manoeuvres(self, lag: int) -> int:
        """Return how many separate manoeuvres of the late signal overlap the other one."""
        moves = np.isfinite(self.compute_residuals(lag)) & (np.abs(np.nan_to_num(self.late)) > self.least)
        return int((np.diff(np.flatnonzero(moves), prepend=-_APART) >= _APART).sum())


def find_coarse_lag(late: Signals, against: Signals) -> float | None:
    """Return how much later the stamps of one sensor are than another's [s]; None where this is unknown."""
    pairs = [
        _compare(late[name], against[name], least) for name, least in _LEAST.items() if name in late and name in against
    ]
    compared = [pair for pair in pairs if pair is not None]
    if not compared:
        return None
    score = np.sum([pair.independent * pair.log_ratio for pair in compared], axis=0)
    best = int(np.argmax(score))
    lag, strongest = best - _MOST, max(pair.correlation[best] for pair in compared)
    z2 = sum(np.arctanh(max(pair.correlation[best], 0.0)) ** 2 * (pair.independent[best] - 3.0) for pair in compared)
    if abs(lag) == _MOST or strongest < _MIN_CORRELATION or z2 < _MIN_Z**2:
        return None
    if abs(lag) * _ROW_S > NEAR_S:
        manoeuvres = sum(pair.count_manoeuvres(lag) for pair in compared)
        if manoeuvres < _MIN_MANOEUVRES or any(_is_rival(peak, lag, compared) for peak in _find_peaks(compared, lag)):
            return None
    before, at, after = score[best - 1 : best + 2]
    return (lag + 0.5 * float((after - before) / max(2.0 * at - before - after, 1e-9))) * _ROW_S


def _compare(late: Floats, against: Floats, least: float) -> _Comparison | None:
    """Return two signals compared at all lags; None where one is short or has no manoeuvre."""
    if any(np.isfinite(x).sum() < _FEWEST_ROWS or (np.abs(x) > least).sum() < _SMOOTH for x in (late, against)):
        return None
    size = 1 << (late.size + _MOST).bit_length()

    def multiply(a: Floats, b: Floats) -> Floats:
        """Return the sums of a(t) b(t + lag)."""
        sums = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
        return np.concatenate((sums[-_MOST:], sums[: _MOST + 1]))

    a, b, known_a, known_b = (
        np.nan_to_num(against),
        np.nan_to_num(late),
        1.0 * np.isfinite(against),
        1.0 * np.isfinite(late),
    )
    rows = np.rint(multiply(known_a, known_b))
    sum_a, sum_b, counts = multiply(a, known_b), multiply(known_a, b), np.maximum(rows, 1.0)
    squares = multiply(a**2, known_b) - sum_a**2 / counts, multiply(known_a, b**2) - sum_b**2 / counts
    # An overlap without motion shows nothing.
    enough = np.all([each > max(0.2 * float(np.median(each[rows > 0])), 1e-9) for each in squares], axis=0) & (
        rows >= _FEWEST_ROWS
    )
    sizes = np.sqrt(np.where(enough, squares[0] * squares[1], 1.0))
    correlation = np.where(enough, (multiply(a, b) - sum_a * sum_b / counts) / sizes, 0.0)
    # Bartlett: by the autocorrelations of both over 20 s.
    memory = [[float(x[k:] @ x[:-k]) / max(float(x @ x), 1e-12) for k in range(1, 2 * _WINDOW)] for x in (a, b)]
    independence = 1.0 / max(1.0, 1.0 + 2.0 * sum(p * q for p, q in zip(*memory, strict=True)))
    return _Comparison(late, against, least, np.clip(correlation, -0.9999, 0.9999), rows * independence)


def _find_peaks(compared: Sequence[_Comparison], lag: int) -> list[int]:
    """Return the lags that may explain as much as the best [rows]: the highest other peaks, and 0."""
    ratio = np.sum([pair.log_ratio for pair in compared], axis=0)
    peaks = 1 + np.flatnonzero((ratio[1:-1] >= ratio[:-2]) & (ratio[1:-1] > ratio[2:])) - _MOST
    peaks = peaks[np.abs(peaks - lag) > _APART]
    highest = peaks[np.argsort(-ratio[peaks + _MOST], kind="stable")][:_PEAKS].tolist()
    return (
        [*highest, 0]
        if any(pair.independent[_MOST] > 0 and pair.correlation[_MOST] != 0 for pair in compared)
        else highest
    )


def _is_rival(rival: int, lag: int, compared: Sequence[_Comparison]) -> bool:
    """Return whether a lag explains the same rows about as well as the best: too few windows prefer the best, or some prefer the rival."""
    worse, rows = np.zeros((2, compared[0].late.size // _WINDOW + 1))
    log_ratio = 0.0
    for pair in compared:
        residuals = pair.compute_residuals(lag)
        differences = (pair.compute_residuals(rival) - residuals) / np.nanmean(residuals)
        known = np.flatnonzero(np.isfinite(differences))
        worse += np.bincount(known // _WINDOW, differences[known], worse.size)
        rows += np.bincount(known // _WINDOW, minlength=rows.size)
        mean = float(differences[known].sum()) / np.isfinite(residuals).sum()
        log_ratio += 0.5 * pair.independent[lag + _MOST] * np.log1p(max(mean, 0.0))
    clear = 0.5 * np.maximum(rows, _WINDOW)
    windows = int((worse > clear).sum()) - 3 * int((worse < -clear).sum())
    return bool(windows < _MIN_WINDOWS or log_ratio < _MIN_LOG_RATIO)
