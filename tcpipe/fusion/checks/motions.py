"""Motion by each sensor on a common time grid: speed, yaw rate, acceleration and position; and lags between them.

The time offset of one signal against another, and the factor between them, come from their correlation at every lag.
Signals are real, or complex for vectors in the plane; NaN: unknown. Method: masked normalised cross-correlation by FFT
(Padfield, CVPR 2010). The lag at which one signal explains most of the other's variance is the offset, refined by a
parabola. Its standard deviation is that of the delete-a-group jackknife (Miller 1974, Biometrika 61), which needs no
model of the residuals. The coarse search, over minutes, is by speed and turn rate together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion.course import MIN_SPEED_MPS
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
    remove_xy_spikes,
)

GRID_S = 0.02  # spacing of the grid [s]
GRID_NS = round(GRID_S * 1e9)
FIXES_S = 0.5
"""Averaging time of fixes, and time difference over which they give a velocity [s]: keeps noise below the motion."""

SMOOTH_S, _ACCELERATION_S, _SLOW_S = 0.1, 0.3, 4.0
"""Averaging times of speeds and yaw rates, accelerations, and slow changes (also by slip and slopes) [s]."""


def make_grid_ns(first_ns: int, last_ns: int) -> Ints:
    """Return the grid's stamps [ns] from first to last, at least two."""
    return np.arange(first_ns, max(last_ns, first_ns + GRID_NS) + 1, GRID_NS, dtype=np.int64)


def find_span_ns(m: Measurements) -> tuple[int, int] | None:
    """Return first and last stamp [ns] of all measurements; None if no sensor has two."""
    stamps = [sensor.stamp_ns for sensor in m.sensors().values() if sensor.stamp_ns.size > 1]
    return (min(int(s[0]) for s in stamps), max(int(s[-1]) for s in stamps)) if stamps else None


def iterate_windows_ns(m: Measurements, length_ns: int) -> Iterator[Ints]:
    """Yield consecutive grids [ns] of about ``length_ns`` that contain measurements."""
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
    windows = iterate_windows_ns(m, 1800 * 10**9)  # grids of half an hour stay small
    return max(windows, key=lambda at_ns: float(np.diff(compute_driven_m(m, at_ns[[0, -1]]))[0]), default=None)


def compute_driven_m(m: Measurements, at_ns: Ints) -> Floats:
    """Return the distance driven until each time [m], by the first sensor that measures it."""
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
    """Return the means of the piecewise-linear signal (N, k) over grid cells, shape (M, k); NaN outside and in gaps.

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
    """Return forward velocity and yaw rate (0 if not measured), shape (M, 2); single outliers are interpolated."""
    twist = np.column_stack((source.velocity_mps[:, 0], source.yaw_rate_radps))
    if not np.isfinite(twist[:, 1]).any():
        twist[:, 1] = 0.0
    known = np.isfinite(twist).all(1)
    return resample_signal(source.stamp_ns[known], np.apply_along_axis(remove_spikes, 0, twist[known]), at_ns)


def resample_fixes(gnss: Positions, at_ns: Ints) -> Plane:
    """Return the antenna's position [m], east + i north, averaged over half a second, shape (M,), without outliers."""
    places = remove_xy_spikes(gnss.position_enu_m).view(np.float64).reshape(-1, 2)
    return average(resample_signal(gnss.stamp_ns, places, at_ns) @ np.array([1.0, 1j]), FIXES_S)


def compute_fix_velocity(gnss: Positions, at_ns: Ints) -> Plane:
    """Return the antenna's velocity [m/s], east + i north, shape (M,); outliers are interpolated, gaps are NaN."""
    return _differentiate(resample_fixes(gnss, at_ns), np.subtract)


def differentiate_course(velocity_mps: Plane) -> Floats:
    """Return the rate of the direction of travel [rad/s], shape (M,), NaN below 0.2 m/s.

    An antenna ahead of the turning point by l precedes the body's course by l / v, so the rate shows no offset.
    """
    quick = np.where(np.abs(velocity_mps) > MIN_SPEED_MPS, velocity_mps, np.nan)
    return _differentiate(quick, lambda later, earlier: np.angle(later * np.conj(earlier)))


def _differentiate(values: Signal, subtract: Callable[[Signal, Signal], Signal]) -> Signal:
    """Return the rate of change of values on the grid (M,), by differences over `FIXES_S`; NaN at the ends."""
    half = round(FIXES_S / 2 / GRID_S)
    changes = subtract(values[2 * half :], values[: -2 * half]) / (2 * half * GRID_S)
    rates: Signal = np.pad(changes, half, constant_values=np.nan)[: values.size]
    return rates


def resample_imu(imu: InertialMeasurements, at_ns: Ints) -> tuple[Floats, Plane, Floats]:
    """Return yaw rate (M,), high-pass horizontal force (forward + i left) (M,), and levelling rotation (3, 3).

    If the specific force contains gravity, its mean direction defines level.
    """
    signals = (imu.angular_velocity_radps, imu.specific_force_mps2)
    rate, force = (resample_signal(imu.stamp_ns, values, at_ns) for values in signals)
    gravity = np.nan_to_num(force).sum(0) if imu.accelerometer_usable else np.zeros(3)
    up = gravity / np.linalg.norm(gravity) if gravity.any() else np.array([0.0, 0.0, 1.0])
    level = compute_levelling_rotations(up[None])[0]
    horizontal = average(force @ level[:2].T @ np.array([1.0, 1j]), _ACCELERATION_S)
    return rate @ level[2], find_quick_part(horizontal), level


def compute_acceleration(twist: Floats) -> Plane:
    """Return the high-pass acceleration of a twist [m/s²], forward + i left (centripetal), shape (M,)."""
    speed = average(twist[:, 0], _ACCELERATION_S)
    return find_quick_part(np.gradient(speed, GRID_S) + 1j * speed * average(twist[:, 1], _ACCELERATION_S))


def average(values: Signal, width_s: float) -> Signal:
    """Return the running mean of a signal on the grid, NaN if any value within the width is unknown."""
    return compute_moving_mean(values, round(width_s / GRID_S / 2))


def find_quick_part(values: Signal) -> Signal:
    """Return the high-pass part of a signal: slip and terrain cause slow changes; starts, stops and turns do not."""
    quick: Signal = values - average(values, _SLOW_S)
    return quick


def dead_reckon(twist: Floats) -> Plane:
    """Return the path [m] of a twist (M, 2) from the origin along the real axis, shape (M,); NaN if unknown."""
    known = np.asarray(np.isfinite(twist).all(1))
    forward_mps, yaw_rate_radps = np.where(known[:, None], twist, 0.0).T
    yaw_rad = GRID_S * (np.cumsum(yaw_rate_radps) - 0.5 * yaw_rate_radps)
    return np.where(known, GRID_S * np.cumsum(forward_mps * np.exp(1j * yaw_rad)), np.nan)


# Lags between signals

_FINE_RANGE_S = 1.2  # largest lag of the fine search [s]
_STEPS = round(_FINE_RANGE_S / GRID_S)
_GROUPS, _MIN_GROUPS, _MIN_GROUP_S = 20, 4, 2.0
"""Largest and smallest number of groups of the jackknife [1], and least length of a group [s]."""
_INDEPENDENT = 10
"""Rows between independent residuals [1]: signals are smoothed over 0.1 s to 0.2 s, or over 5 coarse rows."""
_TINY = 1e-12  # smallest divisor: a variance, or a share of it


@dataclass(frozen=True, slots=True)
class Lag:
    """Delay of the target's stamps relative to the regressor's [s], its σ, and the explained share of variance [1].

    The target is ``factor`` times the regressor; that of vectors in the plane is complex, its angle turns the regressor
    into the target.
    """

    offset_s: float
    std_s: float
    explained: float
    factor: complex = 1.0


# Clocks that are nearly the same


def find_lag(target: Signal, regressor: Signal) -> Lag | None:
    """Return the delay of the target's stamps relative to the regressor's, or None if it is unknown.

    Signals, shape (M,), are on a grid of `GRID_S`. The delay is unknown if few values are known, if the best lag is at
    the end of the search range, if another lag is as good, or if a constant explains the target.
    """
    sums = compute_lag_sums(target, regressor)
    return None if sums is None else estimate_lag([sums])


def compute_lag_sums(target: Signal, regressor: Signal) -> Plane | None:
    """Return the sums over target y and regressor x of a window, shape (M,), by groups of equal duration and by lag.

    The sums are of 1, x, |x|², conj(y), conj(y) x and |y|² over rows with both values, shape (6, G, L). None if the
    window is too short.
    """
    groups = min(_GROUPS, int((target.size - 2 * _STEPS) * GRID_S / _MIN_GROUP_S))
    if groups < _MIN_GROUPS:
        return None
    length = target.size // groups
    y = target[: groups * length].reshape(groups, length)
    padded = np.pad(regressor, _STEPS, constant_values=np.nan)
    x = np.lib.stride_tricks.sliding_window_view(padded, length + 2 * _STEPS)[: groups * length : length]
    size = 1 << (length + 2 * _STEPS - 1).bit_length()
    powers = ([known, np.where(known, each, 0.0)] for each in (y, x) for known in [np.isfinite(each)])
    of_y, of_x = (np.fft.fft([known, each, np.abs(each) ** 2], size) for known, each in powers)
    pairs = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0))
    return np.stack([np.fft.ifft(np.conj(of_y[k]) * of_x[j])[:, 2 * _STEPS :: -1] for k, j in pairs])


def estimate_lag(windows: Sequence[Plane]) -> Lag | None:
    """Return the lag of several windows together; ``windows``: `compute_lag_sums` of the same signals."""
    sums = np.concatenate(windows, axis=1)
    together = -(-sums.shape[1] // (2 * _GROUPS))  # fewer, longer groups
    sums = np.add.reduceat(sums, np.arange(0, sums.shape[1], together), axis=1)
    sums = sums[:, (sums[0].real > 0.5).all(axis=1)]
    groups, total = sums.shape[1], sums.sum(axis=1, keepdims=True)
    rows = total[0, 0].real if groups else np.zeros(1)
    if groups < _MIN_GROUPS or rows.min() < 0.5 * rows.max() or rows.max() * GRID_S < _MIN_GROUP_S:
        return None
    # First all groups, then all but one.
    explained_share, factors = _compute_explained_share(np.concatenate((total, total - sums), axis=1))
    offsets_s, best = [GRID_S * _find_peak(each) for each in explained_share], int(np.argmax(explained_share[0]))
    if not np.isfinite(offsets_s).all() or _has_rival(explained_share[0], best, float(rows.max()) / _INDEPENDENT):
        return None
    std_s = float(np.sqrt((groups - 1) * np.var(offsets_s[1:])))
    return Lag(offsets_s[0], std_s, float(explained_share[0, best]), complex(factors[0, best]))


def _compute_explained_share(sums: Plane) -> tuple[Floats, Plane]:
    """Return the explained share of the target's variance (0 if constant), and the regressor's factor; (G, L)."""
    n, x, xx, y, yx, yy = sums
    count = np.maximum(np.rint(n.real), 1.0)
    target, regressor = yy.real - np.abs(y) ** 2 / count, xx.real - np.abs(x) ** 2 / count
    product = np.conj(yx - y * x / count)
    varies = (target > _TINY) & (regressor > _TINY)
    target, regressor = np.where(varies, target, 1.0), np.where(varies, regressor, 1.0)
    explained_share = np.where(varies, np.minimum(np.abs(product) ** 2 / (target * regressor), 1.0 - _TINY), 0.0)
    return explained_share, product / regressor


def _find_peak(values: Floats) -> float:
    """Return the rows from the middle to the maximum, refined by a parabola through its neighbours; NaN at the ends."""
    best = int(np.argmax(values))
    if best in {0, values.size - 1}:
        return float("nan")
    before, at, after = values[best - 1 : best + 2].tolist()
    return float(best - values.size // 2 + 0.5 * (after - before) / max(2.0 * at - before - after, _TINY))


def _has_rival(explained_share: Floats, best: int, independent: float) -> bool:
    """Return whether another peak is almost as high, judged by the number of ``independent`` rows."""
    inner = explained_share[1:-1]
    peaks = 1 + np.flatnonzero((inner >= explained_share[:-2]) & (inner >= explained_share[2:]))
    others = explained_share[peaks[np.abs(peaks - best) > 1]]
    log_ratio = independent * np.log((1.0 - others) / (1.0 - explained_share[best]))
    return bool((log_ratio < 10.83).any())  # 99.9 % of χ² with one degree of freedom


# Clocks that are seconds to minutes apart

_COARSE_S = 0.2  # spacing of the rows of the coarse search [s]
NEAR_S = _FINE_RANGE_S - _COARSE_S  # largest lag that the fine search finds reliably [s]


def prepare_coarse_signals(speed_mps: Floats, turn_radps: Floats) -> Floats:
    """Return speed and turn rate for `find_coarse_lag`, (2, N): means over 1 s less means over 30 s, 0 if unknown."""
    rows = np.stack((speed_mps, turn_radps))[:, : speed_mps.size // 10 * 10].reshape(2, -1, 10).mean(2).T
    smooth = np.where(np.isfinite(rows), compute_moving_mean(rows, 2, least=0.0), np.nan)
    quick: Floats = np.nan_to_num(smooth - compute_moving_mean(smooth, 75, least=0.0)).T
    return quick


def find_coarse_lag(late: Floats, against: Floats) -> float | None:
    """Return the delay of one sensor's stamps relative to another's [s], None if unknown; signals have shape (2, N)."""
    most = round(300.0 / _COARSE_S)  # five minutes
    size = 1 << (late.shape[1] + most).bit_length()
    spectra = np.fft.rfft(late, size) * np.conj(np.fft.rfft(against, size))
    power = np.sqrt(np.sum(late**2, axis=1) * np.sum(against**2, axis=1))
    shares = np.fft.irfft(spectra, size) / np.maximum(power, _TINY)[:, None]
    correlation = np.concatenate((shares[:, -most:], shares[:, : most + 1]), axis=1).sum(0)
    best, lag_s = int(np.argmax(correlation)), _COARSE_S * _find_peak(correlation)
    # Noise reaches 4σ in 3,000 lags. Repeated lanes cause several peaks of similar height.
    is_noise = float(correlation[best]) * np.sqrt(late.shape[1] / _INDEPENDENT) < 6.0
    is_other_peak = np.abs(np.arange(correlation.size) - best) * _COARSE_S > 3.0
    # On periodic drives another lag explains as much; threshold from simulated drives.
    has_rival = abs(lag_s) > NEAR_S and float(correlation[is_other_peak].max()) > 0.7 * float(correlation[best])
    return None if is_noise or np.isnan(lag_s) or has_rival else lag_s
