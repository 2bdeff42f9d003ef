"""How an IMU is mounted, by gravity, and by the turns and accelerations that another sensor measures.

A robot stands upright on average, so the mean specific force shows a unit's up. Its yaw rate, told by wheels, camera or fixes, is a
linear function of the gyroscope's axes whose coefficients show the gyroscope's unit and axis at once. Speeding up and turning accelerate
it forward and to the side, so the horizontal specific force shows which way the unit looks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.lags import GRID_S, Floats, compute_moving_mean, find_lag
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rotation_vector

_SMOOTH_S, _SLOW_S = 0.6, 4.0  # between which accelerations count
_FEWEST_ROWS = 100
_GROUPS = 20
_EXPLAINED = 0.5
_COHERENT = 0.3
_SURE_RAD = 0.2
_AXIS_ALIGNED_RAD = 0.25


@dataclass(frozen=True, slots=True)
class YawAxis:
    """How a yaw rate follows from a gyroscope: the axis (unit vector, shape (3,)), yaw rate per unit of rate about it, and the lag [s]."""

    axis: Floats
    scale: float
    late_s: float


def find_yaw_axis(yaw_rate_radps: Floats, rate: Floats) -> YawAxis | None:
    """Return the axis of a gyroscope about which the robot yaws, or None where its rates do not explain the yaw rate.

    ``yaw_rate_radps`` [rad/s], shape (M,), is another sensor's on the grid of `lags`, NaN where unknown; ``rate``, shape (M, 3), has any
    unit and axes.
    """
    lag = find_lag(yaw_rate_radps, rate)
    if lag is None or lag.explained < _EXPLAINED:
        return None
    rate = _shift_later(rate, lag.offset_s)
    known = np.isfinite(yaw_rate_radps) & np.isfinite(rate.sum(1))
    design = np.column_stack((rate[known], np.ones(known.sum())))
    coefficients = np.linalg.lstsq(design, yaw_rate_radps[known], rcond=None)[0][:3]
    scale = float(np.linalg.norm(coefficients))
    return YawAxis(coefficients / scale, scale, lag.offset_s) if scale > 0 else None


def find_up_axis(force: Floats) -> Floats:
    """Return the direction of the mean specific force (N, 3), shape (3,); of none at all that is z."""
    size = np.linalg.norm(force, axis=1, keepdims=True)
    mean: Floats = np.mean(np.divide(force, size, out=np.zeros_like(force), where=size > 0), axis=0)
    length = np.linalg.norm(mean)
    return mean / length if length > 0 else np.array([0.0, 0.0, 1.0])


def compute_levelling_rotation(up: Floats) -> Floats:
    """Return the smallest rotation, as a matrix (3, 3), that turns a unit vector to +z."""
    cross = np.cross(up, [0.0, 0.0, 1.0])
    size = float(np.linalg.norm(cross))
    if size < 1e-9:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    matrix: Floats = matrix_from_quat(quat_from_rotation_vector(cross / size * np.arctan2(size, up[2])))
    return matrix


def find_forward_yaw_rad(twist: Floats, level_force_mps2: Floats, late_s: float) -> float | None:
    """Return the yaw of a levelled IMU in base_link [rad], or None where acceleration does not show it.

    In base_link a = dv/dt forward and v w to the left; the unit measures a turned by minus its yaw. With both as complex numbers the yaw is
    the angle of the sum of a times the conjugate of the measured (the planar case of Wahba's problem, 1965). ``twist`` is forward velocity
    [m/s] and yaw rate [rad/s] on the grid, shape (M, 2), ``late_s`` [s] behind the IMU; the force has z up, shape (M, 3).
    """

    def remove_slow_part(values: Floats) -> NDArray[np.complex128]:
        values = values - compute_moving_mean(values, _SLOW_S)
        return np.asarray(values[:, 0] + 1j * values[:, 1])

    smooth = compute_moving_mean(twist, _SMOOTH_S)
    driven = remove_slow_part(np.column_stack((np.gradient(smooth[:, 0], GRID_S), smooth[:, 0] * smooth[:, 1])))
    felt = remove_slow_part(compute_moving_mean(_shift_later(level_force_mps2[:, :2], late_s), _SMOOTH_S))
    known = np.isfinite(driven) & np.isfinite(felt)
    products = driven[known] * np.conj(felt[known])
    power = np.sum(np.abs(driven[known]) ** 2) * np.sum(np.abs(felt[known]) ** 2)
    if known.sum() < _FEWEST_ROWS or np.abs(products.sum()) <= _COHERENT * np.sqrt(power):
        return None
    sums = np.array([part.sum() for part in np.array_split(products, _GROUPS)])
    yaw = float(np.angle(sums.sum()))
    left_out = np.angle((sums.sum() - sums) * np.exp(-1j * yaw))
    std = np.sqrt((_GROUPS - 1) / _GROUPS * np.sum(left_out**2))
    begin, end = sums[: _GROUPS // 2].sum(), sums[_GROUPS // 2 :].sum()
    changed = abs(np.angle(begin * np.conj(end))) > 6.0 * std  # three standard deviations of the difference of halves
    return yaw if std < _SURE_RAD and not changed else None


def find_nearest_mounting(base_from_sensor: Floats) -> Floats:
    """Return the rotation (3, 3) with axes along axes that is nearest, or the given one where none is near."""
    largest = np.argmax(np.abs(base_from_sensor), axis=1)
    aligned = np.zeros((3, 3))
    aligned[np.arange(3), largest] = np.sign(base_from_sensor[np.arange(3), largest])
    if abs(np.linalg.det(aligned) - 1.0) > 1e-9:
        return base_from_sensor
    angle = np.arccos(np.clip((np.trace(aligned.T @ base_from_sensor) - 1) / 2, -1.0, 1.0))
    return aligned if angle < _AXIS_ALIGNED_RAD else base_from_sensor


def rotate_about_z(yaw_rad: float) -> Floats:
    """Return the rotation (3, 3) by a yaw."""
    return matrix_from_quat(quat_from_rotation_vector(np.array([0.0, 0.0, yaw_rad])))


def _shift_later(values: Floats, late_s: float) -> Floats:
    """Return values moved to ``late_s`` later on the grid, NaN where they came from outside."""
    rows = round(late_s / GRID_S)
    moved = np.full_like(values, np.nan)
    first, last = max(rows, 0), len(values) + min(rows, 0)
    moved[first:last] = values[first - rows : last - rows]
    return moved
