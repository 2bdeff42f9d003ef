"""Motion by each sensor of a set on a common grid of time: speed, yaw rate, acceleration and places; and lags between them.

The time offset of one signal against another, and the factor between them, come from their correlation at every lag.
Signals are real, or complex for vectors in the plane, NaN where unknown: masked normalised cross-correlation by FFT (Padfield, CVPR 2010).
The lag at which one signal explains most of the other's variance is the offset, refined by a parabola.

The fine search, over a second, is by groups of time. Its standard deviation is the larger of two: that of least squares, and that of the
delete-a-group jackknife (Miller 1974, Biometrika 61), which needs no model of the residuals. The coarse search, over minutes, is by speed
and turn rate together; its best lag has the largest log-likelihood ratio of both. It is known only if it is far above noise, and if every
other peak, and no lag, explain the same rows worse in several separate windows and hardly better in any: a straight shows no lag, repeated
lanes show several.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion.dead_reckoning import MIN_SPEED_MPS, DeadReckoning
from tcpipe.fusion.level_motion import compute_levelling_rotations
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.fusion.signals import (
    MAX_GAP_NS,
    Plane,
    Signal,
    compute_moving_mean,
    compute_seconds,
    integrate_signal,
    is_covered,
    remove_spikes,
    remove_wild_places,
)

GRID_S = 0.02
"""Spacing of the grid [s]."""
GRID_NS = round(GRID_S * 1e9)
FIXES_S = 0.5
"""A velocity is made of fixes averaged over, and taken apart by, this long [s]: their noise is below the motion."""

_LONGEST_NS, _STEP_NS = 1800 * 10**9, 300 * 10**9  # the window that is judged, and from one candidate to the next
SMOOTH_S, _ACCELERATION_S, _SLOW_S = 0.1, 0.3, 4.0
"""Times over which speeds and yaw rates are averaged, and accelerations; slower changes are also slip and slopes [s]."""


def make_grid_ns(first_ns: int, last_ns: int) -> Ints:
    """Return a grid's stamps [ns] from first to last, two at least."""
    return np.arange(first_ns, max(last_ns, first_ns + GRID_NS) + 1, GRID_NS, dtype=np.int64)


def find_span_ns(m: Measurements) -> tuple[int, int] | None:
    """Return first and last stamp of a set's measurements; None where no sensor has two."""
    stamps = [sensor.stamp_ns for sensor in m.sensors().values() if sensor.stamp_ns.size > 1]
    return (min(int(s[0]) for s in stamps), max(int(s[-1]) for s in stamps)) if stamps else None


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
    source, gnss = m.first_odometry, m.gnss
    if source is not None:
        stamp_ns = source.stamp_ns
        steps_m = np.nan_to_num(np.abs(source.velocity_mps[1:, 0])) * np.diff(
            compute_seconds(stamp_ns, int(stamp_ns[0]))
        )
    elif gnss is not None:
        rows = np.unique(np.searchsorted(gnss.stamp_ns, np.arange(gnss.stamp_ns[0], gnss.stamp_ns[-1] + 1, 10**10)))
        stamp_ns, steps_m = gnss.stamp_ns[rows], np.hypot(*np.diff(gnss.position_enu_m[rows, :2], axis=0).T)
    else:
        return np.zeros(at_ns.shape)
    driven_m: Floats = np.interp(at_ns, stamp_ns, np.concatenate(([0.0], np.cumsum(steps_m))))
    return driven_m


def resample_signal(stamp_ns: Ints, values: Floats, at_ns: Ints) -> Floats:
    """Return the means of the piecewise-linear signal (N, k) over each grid cell, shape (M, k); NaN outside and in gaps.

    A gap is longer than half a second and than three periods.
    """
    if len(values) < 2:
        return np.full((at_ns.size, values.shape[1]), np.nan)
    edges_s: Floats = (np.arange(at_ns.size + 1, dtype=np.float64) - 0.5) * GRID_S
    means = np.diff(integrate_signal(compute_seconds(stamp_ns, int(at_ns[0])), values, edges_s), axis=0) / GRID_S
    half = GRID_NS // 2
    means[~is_covered(stamp_ns, at_ns - half, at_ns + half, least_ns=MAX_GAP_NS)] = np.nan
    return means


def resample_twist(source: BodyVelocities, at_ns: Ints) -> Floats:
    """Return forward velocity and yaw rate, shape (M, 2), single wild samples bridged; the yaw rate 0 where the source gives none."""
    twist = np.column_stack((source.velocity_mps[:, 0], source.yaw_rate_radps))
    if not np.isfinite(twist[:, 1]).any():
        twist[:, 1] = 0.0
    known = np.isfinite(twist).all(1)
    return resample_signal(source.stamp_ns[known], np.apply_along_axis(remove_spikes, 0, twist[known]), at_ns)


def resample_fixes(gnss: Positions, at_ns: Ints) -> Plane:
    """Return the antenna's places [m], east and i times north, averaged over half a second, shape (M,); wild fixes are bridged."""
    places = remove_wild_places(gnss.position_enu_m).view(np.float64).reshape(-1, 2)
    return average(resample_signal(gnss.stamp_ns, places, at_ns) @ np.array([1.0, 1j]), FIXES_S)


def compute_fix_velocity(gnss: Positions, at_ns: Ints) -> Plane:
    """Return the antenna's velocity [m/s], east and i times north, shape (M,); wild fixes are bridged, NaN in gaps."""
    return _differentiate(resample_fixes(gnss, at_ns), np.subtract)


def differentiate_course(velocity_mps: Plane) -> Floats:
    """Return how fast the direction of travel turns [rad/s], shape (M,), NaN below 0.2 m/s.

    An antenna ahead of the turning point by l leads the body's course by l / v: good for a sign, not for a clock.
    """
    quick = np.where(np.abs(velocity_mps) > MIN_SPEED_MPS, velocity_mps, np.nan)
    return _differentiate(quick, lambda later, earlier: np.angle(later * np.conj(earlier)))


def _differentiate(values: Signal, subtract: Callable[[Signal, Signal], Signal]) -> Signal:
    """Return the rates of change over `FIXES_S` of values on the grid (M,), by their differences; NaN at the ends."""
    half = round(FIXES_S / 2 / GRID_S)
    changes = subtract(values[2 * half :], values[: -2 * half]) / (2 * half * GRID_S)
    rates: Signal = np.pad(changes, half, constant_values=np.nan)[: values.size]
    return rates


def resample_imu(imu: InertialMeasurements, at_ns: Ints) -> tuple[Floats, Plane, Floats]:
    """Return yaw rate and quick horizontal specific force (forward, i times left), shape (M,) each, and the rotation (3, 3) that levels.

    The unit is levelled by the mean direction of its force where this contains gravity.
    """
    signals = (imu.angular_velocity_radps, imu.specific_force_mps2)
    rate, force = (resample_signal(imu.stamp_ns, values, at_ns) for values in signals)
    gravity = np.nan_to_num(force).sum(0) if imu.accelerometer_usable else np.zeros(3)
    up = gravity / np.linalg.norm(gravity) if gravity.any() else np.array([0.0, 0.0, 1.0])
    level = compute_levelling_rotations(up[None])[0]
    horizontal = average(force @ level[:2].T @ np.array([1.0, 1j]), _ACCELERATION_S)
    return rate @ level[2], find_quick_part(horizontal), level


def compute_acceleration(twist: Floats) -> Plane:
    """Return the quick part of the acceleration of a twist [m/s²], forward and, by its turns, i times left, shape (M,)."""
    speed = average(twist[:, 0], _ACCELERATION_S)
    return find_quick_part(np.gradient(speed, GRID_S) + 1j * speed * average(twist[:, 1], _ACCELERATION_S))


def average(values: Signal, width_s: float) -> Signal:
    """Return the running mean of a signal on the grid, NaN where any of the width is unknown."""
    return compute_moving_mean(values, round(width_s / GRID_S / 2))


def find_quick_part(values: Signal) -> Signal:
    """Return values without their slow part, which slip and terrain change, and starts, stops and turns do not need."""
    quick: Signal = values - average(values, _SLOW_S)
    return quick


def dead_reckon(twist: Floats) -> Plane:
    """Return the path [m] of a twist (M, 2), from the origin along the real axis, shape (M,); NaN where the twist is unknown."""
    known = np.asarray(np.isfinite(twist).all(1))
    forward_mps, yaw_rate_radps = np.where(known[:, None], twist, 0.0).T
    at_s: Floats = GRID_S * np.arange(len(twist), dtype=np.float64)
    return np.where(known, DeadReckoning(at_s, forward_mps, at_s, yaw_rate_radps).place(at_s), np.nan)


# Lags between signals

MAX_LAG_S = 1.2
"""Largest lag of the fine search [s]."""
_STEPS = round(MAX_LAG_S / GRID_S)
_GROUPS, _MIN_GROUPS, _MIN_GROUP_S, _MIN_SPANS = 20, 8, 2.0, 4
"""Most and fewest groups of the jackknife, their least length [s], and how many separate spans of time have to show a lag."""
_INDEPENDENT = 10
"""Rows between independent residuals: signals are smoothed over 0.1 s to 0.2 s, those of the coarse search over 1 s, which is 5 rows."""
_MIN_CHI_SQUARED = 10.83  # by how much a rival peak must fit worse [1]: 99.9 % of χ² with one degree of freedom
_TINY = 1e-12  # least variance, and least share of it, that a division bears


@dataclass(frozen=True, slots=True)
class Lag:
    """How much later the target's stamps are than the regressor's [s], its standard deviation, the variance explained (0 to 1).

    The target is ``factor`` times the regressor; that of vectors in the plane is complex, its angle turns the regressor into the target.
    """

    offset_s: float
    std_s: float
    explained: float
    factor: complex = 1.0


class Products:
    """Sums of products of a target and a regressor by group of time and lag."""

    def __init__(self, sums: Plane) -> None:
        """Take the sums of `sum_products`, shape (6, G, L)."""
        n, x, xx, y, yx, yy = sums
        self.rows = np.rint(n.real)
        count = np.maximum(self.rows, 1.0)
        self.target = yy.real - np.abs(y) ** 2 / count
        self.regressor = xx.real - np.abs(x) ** 2 / count
        self.product = np.conj(yx - y * x / count)

    @property
    def explained(self) -> Floats:
        """Share of the target's variance that the regressor explains, shape (G, L); 0 where one of them does not vary."""
        varies = (self.target > _TINY) & (self.regressor > _TINY)
        size = np.where(varies, self.target * self.regressor, 1.0)
        return np.where(varies, np.minimum(np.abs(self.product) ** 2 / size, 1.0 - _TINY), 0.0)


def sum_products(target: Signal, regressor: Signal, most: int, groups: int = 1) -> Plane:
    """Return sums over a target y and a regressor x, shape (M,), by groups of time of equal length and lags up to ``most`` rows.

    They are of 1, x, |x|², conj(y), conj(y) x and |y|² where both are known, shape (6, G, L).
    """
    length = target.size // groups
    y = target[: groups * length].reshape(groups, length)
    padded = np.pad(regressor, most, constant_values=np.nan)
    x = np.lib.stride_tricks.sliding_window_view(padded, length + 2 * most)[: groups * length : length]
    size = 1 << (length + 2 * most - 1).bit_length()
    powers = ([known, np.where(known, each, 0.0)] for each in (y, x) for known in [np.isfinite(each)])
    of_y, of_x = (np.fft.fft([known, each, np.abs(each) ** 2], size) for known, each in powers)
    pairs = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0))
    return np.stack([np.fft.ifft(np.conj(of_y[k]) * of_x[j])[:, 2 * most :: -1] for k, j in pairs])


# Clocks that are nearly the same


def find_lag(target: Signal, regressor: Signal) -> Lag | None:
    """Return how late the target's stamps are against the regressor's, or None where that is unknown.

    Signals, shape (M,), are on a grid of `GRID_S`. The lag is unknown where few values are, where the best lag is at the end of the search
    or another is as good, or where a constant explains the target.
    """
    sums = compute_lag_sums(target, regressor)
    return None if sums is None else estimate_lag([sums])


def compute_lag_sums(target: Signal, regressor: Signal) -> Plane | None:
    """Return what `estimate_lag` needs of a window, shape (6, G, L); parameters are `find_lag`'s. None where the window is too short."""
    groups = min(_GROUPS, int((target.size - 2 * _STEPS) * GRID_S / _MIN_GROUP_S))
    return None if groups < _MIN_GROUPS else sum_products(target, regressor, _STEPS, groups)


def estimate_lag(windows: Sequence[Plane]) -> Lag | None:
    """Return the lag of several windows of time together; ``windows`` are of `compute_lag_sums`, of the same signals."""
    sums = np.concatenate(windows, axis=1)
    together = -(-sums.shape[1] // (2 * _GROUPS))  # fewer, longer groups
    sums = np.add.reduceat(sums, np.arange(0, sums.shape[1], together), axis=1)
    sums = sums[:, (sums[0].real > 0.5).all(axis=1)]
    groups = sums.shape[1]
    if groups < _MIN_SPANS:
        return None
    total = sums.sum(axis=1, keepdims=True)
    whole, left_out = Products(total), Products(total - sums)
    rows, explained = whole.rows[0], whole.explained[0]
    if rows.min() < 0.5 * rows.max() or rows.max() * GRID_S < _MIN_GROUP_S:
        return None
    best, independent = int(np.argmax(explained)), float(rows.max()) / _INDEPENDENT
    offsets_s = [_find_peak_s(each) for each in (explained, *left_out.explained)]
    if not np.isfinite(offsets_s).all() or _has_rival(explained, best, independent):
        return None
    jackknife_s = float(np.sqrt((groups - 1) * np.var(offsets_s[1:])))
    std_s = max(jackknife_s, _compute_peak_std_s(explained, best, independent))
    factor = complex(whole.product[0, best] / whole.regressor[0, best])
    return Lag(offsets_s[0], std_s, float(explained[best]), factor)


def find_turn(target: Plane, regressor: Plane, late_s: float) -> tuple[float, float, float] | None:
    """Return by what angle a vector (M,) is turned against another, its standard deviation [rad], and the coherence (0 to 1)."""
    sums = compute_lag_sums(target, regressor)
    if sums is None:
        return None
    at = _STEPS + round(late_s / GRID_S)
    total = sums.sum(axis=1, keepdims=True)
    whole, left_out = Products(total), Products(total - sums)
    angle = float(np.angle(whole.product[0, at]))
    off = np.angle(left_out.product[:, at] * np.exp(-1j * angle))
    return angle, float(np.sqrt((len(off) - 1) * np.mean(off**2))), float(np.sqrt(whole.explained[0, at]))


def _find_peak_s(explained: Floats) -> float:
    """Return the lag of the maximum [s], by a parabola through its neighbours; NaN at the end of the search and without one."""
    best = int(np.argmax(explained))
    if best in {0, explained.size - 1}:
        return float("nan")
    return (best - explained.size // 2 + _refine_peak(explained, best)) * GRID_S


def _refine_peak(values: Floats, best: int) -> float:
    """Return how many rows the top of the parabola through a maximum and its neighbours is later."""
    before, at, after = values[best - 1 : best + 2].tolist()
    return float(0.5 * (after - before) / max(2.0 * at - before - after, _TINY))


def _compute_peak_std_s(explained: Floats, best: int, independent: float) -> float:
    """Return the standard deviation of a peak [s] by least squares: the noise that is left over the peak's curvature."""
    before, at, after = explained[best - 1 : best + 2]
    curvature = (2 * at - before - after) / GRID_S**2
    return float(np.sqrt(2 * max(1.0 - at, 0.0) / (independent * curvature))) if curvature > 0 else np.inf


def _has_rival(explained: Floats, best: int, independent: float) -> bool:
    """Return whether another peak is about as high: a motion that repeats itself shows no lag."""
    peaks = _find_peaks(explained)
    others = explained[peaks[np.abs(peaks - best) > 1]]
    worse = independent * np.log((1.0 - others) / (1.0 - explained[best]))
    return bool((worse < _MIN_CHI_SQUARED).any())


def _find_peaks(values: Floats) -> NDArray[np.int64]:
    """Return the rows of local maxima."""
    inner = values[1:-1]
    return 1 + np.flatnonzero((inner >= values[:-2]) & (inner >= values[2:]))


# Clocks that are seconds to minutes apart

COARSE_S = 0.2
"""Spacing of the rows of the coarse search [s]."""
NEAR_S = MAX_LAG_S - COARSE_S
"""Largest lag that the fine search surely finds [s]."""
_MOST = 1500  # largest lag that is searched [rows], 5 min
_SMOOTH, _SLOW = 2, 75
"""Half the rows over which signals are averaged, and about whose mean they are compared: 1 s and 30 s in all."""
_MANOEUVRES = (0.15, 0.1)  # least size of a signal that varies [m/s], [rad/s]
_MIN_ROWS = 450  # rows of the least overlap, 90 s
_MIN_SCORE, _MIN_EXPLAINED = 18.0, 0.16
"""Least log-likelihood ratio of the best lag, 6 σ: noise reaches 4 σ in 3,000 lags; and least share explained of one signal."""
_APART, _MAX_RIVAL = 15, 0.5
"""Rows between separate peaks, 3 s, and largest log-likelihood ratio of a row at another peak over that at the best [1]."""


def prepare_coarse_signals(speed_mps: Floats, turn_radps: Floats) -> Floats:
    """Return speed and turn rate for `find_coarse_lag`, shape (2, N): averaged, less the mean around each.

    NaN throughout if a signal does not vary.
    """
    width, prepared = round(COARSE_S / GRID_S), []
    for values, least in zip((speed_mps, turn_radps), _MANOEUVRES, strict=True):
        rows = values[: values.size // width * width].reshape(-1, width).mean(1)
        smooth = np.where(np.isfinite(rows), compute_moving_mean(rows, _SMOOTH, least=0.0), np.nan)
        quick = smooth - compute_moving_mean(smooth, _SLOW, least=0.0)
        varies = (np.abs(quick) > least).sum() > 2 * _SMOOTH + 1
        prepared.append(quick if varies else np.full(quick.size, np.nan))
    return np.stack(prepared)


def find_coarse_lag(late: Floats, against: Floats) -> float | None:
    """Return how much later the stamps of one sensor are than another's [s], None where this is unknown; signals of shape (2, N)."""
    if late.shape[1] < _MIN_ROWS:
        return None
    pairs = [Products(sum_products(y, x, _MOST)) for y, x in zip(late, against, strict=True)]
    # A short overlap, and one without motion, show nothing.
    sizes = np.array([[pair.target[0], pair.regressor[0]] for pair in pairs])
    varies = (sizes > 0.2 * np.median(sizes, axis=2, keepdims=True) + 1e-9).all(1)
    rows = np.array([pair.rows[0] for pair in pairs])
    known = varies & (rows >= _MIN_ROWS) & np.array([pair.product[0].real > 0.0 for pair in pairs])
    explained = np.where(known, [pair.explained[0] for pair in pairs], 0.0)
    log_ratio = -0.5 * np.log(1.0 - explained)
    score, height = (rows * log_ratio).sum(0) / _INDEPENDENT, log_ratio.sum(0)
    best = int(np.argmax(score))
    if best in {0, 2 * _MOST} or score[best] < _MIN_SCORE or explained[:, best].max() < _MIN_EXPLAINED:
        return None
    is_rival = (np.abs(np.arange(height.size) - best) > _APART) & (height > _MAX_RIVAL * height[best])
    if abs(best - _MOST) * COARSE_S > NEAR_S and is_rival.any():
        return None
    return (best - _MOST + _refine_peak(score, best)) * COARSE_S
