"""What each sensor of a set measures of the robot's motion, on a common grid of time: speed, yaw rate, acceleration and places."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.dead_reckoning import MIN_SPEED_MPS, DeadReckoning
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
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rotation_vector

GRID_S = 0.02
"""Spacing of the grid [s]."""
GRID_NS = round(GRID_S * 1e9)
FIXES_S = 0.5
"""A velocity is made of fixes averaged over, and taken apart by, this long [s]: their noise is below the motion."""

_LONGEST_NS, _STEP_NS = 1800 * 10**9, 300 * 10**9  # the window that is judged, and from one candidate to the next
SMOOTH_S, _ACCELERATION_S, _SLOW_S = 0.1, 0.3, 4.0
"""Times over which speeds and yaw rates are averaged, and accelerations; slower changes are also slip and slopes [s]."""
_MIN_STEADINESS = 0.4
"""Least length of the mean direction of a force that shows up [1]: that of a unit whose gravity is removed changes."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


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


def compute_course_rate(velocity_mps: Plane) -> Floats:
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


def find_up_axis(force: Floats) -> Floats:
    """Return the mean direction of the specific force (N, 3), shape (3,); z where the force has no steady direction."""
    size = np.linalg.norm(force, axis=1, keepdims=True)
    directions = np.divide(force, size, out=np.zeros_like(force), where=size > 0)
    mean: Floats = directions.sum(axis=0) / max(len(force), 1)
    length = np.linalg.norm(mean)
    return mean / length if length > _MIN_STEADINESS else np.array([0.0, 0.0, 1.0])


def compute_levelling_rotation(up: Floats) -> Floats:
    """Return the smallest rotation, as a matrix (3, 3), that turns a unit vector to +z."""
    cross = np.cross(up, [0.0, 0.0, 1.0])
    size = float(np.linalg.norm(cross))
    if size < 1e-9:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    matrix: Floats = matrix_from_quat(quat_from_rotation_vector(cross / size * np.arctan2(size, up[2])))
    return matrix


def resample_imu(imu: InertialMeasurements, at_ns: Ints) -> tuple[Floats, Plane, Floats]:
    """Return yaw rate and quick horizontal specific force (forward, i times left), shape (M,) each, and the rotation (3, 3) that levels.

    The unit is levelled by the mean direction of its force.
    """
    signals = (imu.angular_velocity_radps, imu.specific_force_mps2)
    rate, force = (resample_signal(imu.stamp_ns, values, at_ns) for values in signals)
    level = compute_levelling_rotation(find_up_axis(force[np.isfinite(force).all(1)]))
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
