"""Extrinsics, units and signs of sensors, compared with each other: gravity, yaw rate, acceleration, direction of travel.

A robot stands upright on average, so the mean specific force shows a unit's up. Its yaw rate, told by wheels, camera or fixes, is a
linear function of the gyroscope's axes whose coefficients show the gyroscope's unit and axis at once. Speeding up and turning accelerate
it forward and to the side, so the horizontal specific force shows which way the unit looks. All of it is told by least squares over the
whole run, after the lag between the two sensors has been taken out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.lags import GRID_S, Floats, compute_moving_mean, find_lag
from tcpipe.fusion.measurements import GNSS
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rotation_vector


@dataclass(frozen=True, slots=True)
class SensorExclusion:
    """A sensor that is not to be fused.

    Attributes
    ----------
    code : of the finding (`tcpipe.tables.findings`).
    names, numbers : of the finding; the name ``suspect`` is the other role that may be wrong instead.
    units : value of the recipe's ``imu_units`` that sets it right.
    turned_by : rotation (3, 3) from what the extrinsics in use make of the sensor to base_link.
    is_suspect_excludable : whether excluding the suspect instead sets it right.
    """

    role: str
    code: str
    names: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    units: str | None = None
    turned_by: NDArray[np.float64] | None = None
    is_suspect_excludable: bool = False


def refuse_fixes(code: str, odometries: Collection[str], names: Mapping[str, str] | None = None) -> SensorExclusion:
    """Return the exclusion of fixes that odometries contradict; a single odometry is suspect, even if a gyroscope confirms its turns."""
    if len(odometries) != 1:
        return SensorExclusion(GNSS, code, names or {})
    return SensorExclusion(GNSS, code, {**(names or {}), "suspect": next(iter(odometries))}, is_suspect_excludable=True)


def join_names(roles: Collection[str]) -> str:
    """Return several roles as one name of a finding."""
    return ", ".join(roles)


_MIN_EXPLAINED = 0.5
_SLOW_S = 4.0
_SMOOTH_S = 0.6
_GROUPS = 20
_SURE_RAD = 0.2
_MIN_COHERENCE = 0.3
_AXIS_ALIGNED_RAD = 0.25
_MOVING_MPS = 0.2
_FEWEST_ROWS = 100


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
    if lag is None or lag.explained < _MIN_EXPLAINED:
        return None
    target, axes = _select_known(yaw_rate_radps, _shift_later(rate, lag.offset_s))
    solved = np.linalg.lstsq(np.column_stack((axes, np.ones(target.size))), target, rcond=None)
    coefficients: Floats = solved[0][:3].astype(np.float64)
    scale = float(np.linalg.norm(coefficients))
    return YawAxis(np.divide(coefficients, scale), scale, lag.offset_s) if scale > 0 else None


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


def find_forward_yaw_rad(twist: Floats, level_force_mps2: Floats, late_s: float) -> tuple[float, float] | None:
    """Return the yaw of a levelled IMU in base_link [rad] and its standard deviation, or None where acceleration does not show it.

    In base_link a = dv/dt forward and v w to the left; the unit measures a turned by minus its yaw. With both as complex numbers the yaw is
    the angle of the sum of a times the conjugate of the measured (the planar case of Wahba's problem, 1965). ``twist`` is forward velocity
    [m/s] and yaw rate [rad/s] on the grid, shape (M, 2), ``late_s`` [s] behind the IMU; the force has z up, shape (M, 3).
    """
    smooth = compute_moving_mean(twist, _SMOOTH_S)
    driven = np.gradient(smooth[:, 0], GRID_S) + 1j * smooth[:, 0] * smooth[:, 1]
    level = compute_moving_mean(_shift_later(level_force_mps2[:, :2], late_s), _SMOOTH_S)
    level = level - compute_moving_mean(level, _SLOW_S)
    slow = compute_moving_mean(np.column_stack((driven.real, driven.imag)), _SLOW_S)
    driven = driven - (slow[:, 0] + 1j * slow[:, 1])
    felt = level[:, 0] + 1j * level[:, 1]
    known = np.isfinite(driven) & np.isfinite(felt)
    if known.sum() < _FEWEST_ROWS:
        return None
    products = driven[known] * np.conj(felt[known])
    power = np.sum(np.abs(driven[known]) ** 2) * np.sum(np.abs(felt[known]) ** 2)
    coherence = np.abs(products.sum()) / np.sqrt(power) if power > 0 else 0.0
    sums = np.array([part.sum() for part in np.array_split(products, _GROUPS)])
    yaw = float(np.angle(sums.sum()))
    left_out = np.angle((sums.sum() - sums) * np.exp(-1j * yaw))
    std = float(np.sqrt((_GROUPS - 1) / _GROUPS * np.sum(left_out**2)))
    return (yaw, std) if coherence > _MIN_COHERENCE and std < _SURE_RAD else None


def find_nearest_mounting(base_from_sensor: Floats) -> Floats:
    """Return the rotation (3, 3) with axes along axes that is nearest, or the given one where none is near."""
    largest = np.argmax(np.abs(base_from_sensor), axis=1)
    aligned = np.zeros((3, 3))
    aligned[np.arange(3), largest] = np.sign(base_from_sensor[np.arange(3), largest])
    if abs(np.linalg.det(aligned) - 1.0) > 1e-9:
        return base_from_sensor
    angle = np.arccos(np.clip((np.trace(aligned.T @ base_from_sensor) - 1) / 2, -1.0, 1.0))
    return aligned if angle < _AXIS_ALIGNED_RAD else base_from_sensor


def compute_agreement(velocity_mps: Floats, other_mps: Floats) -> float | None:
    """Return by how much two signed velocities go the same way, -1 to 1, or None where one of them hardly moves; shape (M,) each."""
    moving = (np.abs(velocity_mps) > _MOVING_MPS) & (np.abs(other_mps) > _MOVING_MPS)
    if moving.sum() < _FEWEST_ROWS:
        return None
    return float(np.mean(np.sign(velocity_mps[moving] * other_mps[moving])))


def _shift_later(values: Floats, late_s: float) -> Floats:
    """Return values moved to ``late_s`` later on the grid, NaN where they came from outside."""
    rows = round(late_s / GRID_S)
    moved = np.full_like(values, np.nan)
    if rows >= 0:
        moved[rows:] = values[: values.shape[0] - rows]
    else:
        moved[:rows] = values[-rows:]
    return moved


def _select_known(target: Floats, regressors: Floats) -> tuple[Floats, Floats]:
    known: NDArray[np.bool_] = np.isfinite(target) & np.isfinite(regressors.sum(1))
    return target[known], regressors[known]
