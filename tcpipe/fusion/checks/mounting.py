"""Estimate the lever arm of the antenna and the tilt of the IMU from a first track and the sensors.

The error of a lever arm turns with the robot. In windows of 40 s the fixes less the path by odometry and the track's attitude are a
position, a scale and a rotation of that path, each the window's own, and the arm's error turned by the attitude, common to the run. So is
a time offset of the fixes, which at constant speed looks like an antenna further back; changes of speed separate them. What the turns do
not show stays at its prior. Wheels do not measure how the robot slides sideways while it turns, and a turning point ahead of base_link
looks like an antenna behind it: that uncertainty remains.

A pitched IMU measures a slope that the robot does not climb: its forward specific force less acceleration, over gravity, differs from the
rise of the fixes. A rolled IMU measures a part of every turn about its y axis: on any plane a robot turns about its own z axis, so the
rate about y is proportional to the rate about z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import VISUAL, WHEELS, BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.fusion.signals import (
    compute_interval_means,
    compute_median_of_five,
    compute_median_period_ns,
    compute_seconds,
    is_in_gap,
)
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S, Trajectory
from tcpipe.geometry.rotation import invert, matrix_from_quat, multiply, quat_from_rpy, rotate

Floats = NDArray[np.float64]

ARM_STD_M = 0.5
"""An unknown antenna is within the size of a robot."""
LATE_STD_S = 0.1
"""What is known beforehand of the lag of its stamps."""

_SURELY_LATE, _LATE_S = 4.0, 0.06  # σ of a reported time offset; a shorter one costs less than a fix's σ
_GRAVITY_MPS2 = 9.80665  # as `state_kernel.GRAVITY_MPS2`
_WINDOW_S = 40.0  # odometry drifts little, a robot turns
_FEWEST = 20  # fixes for nine unknowns
_FEWEST_WINDOWS = 3
"""Errors of the fixes last: how far windows disagree is not told by fewer."""
_WILD = 5.0  # medians off: left to the gate
_LEAST_TURN_RAD = 1.0  # with less turning the arm is constant
_TURNS_RADPS = 0.1  # slower turns are noise
_TURNING_POINT_STD_M = {WHEELS: 0.03, VISUAL: 0.01}
_MOVES_MPS = 0.3  # slower travel has no direction
_BLOCK_S = 10.0  # blocks that give σ
_HELD_S = 30.0  # odometry is accurate for this long
_CLIMB_S = 4.0  # spacing of fixes that give slope
_LEAST_TILT_STD_RAD = 0.004  # accelerometer bias of 0.04 m/s²
_STATED_TILT_STD_RAD = 0.0175  # extrinsics are stated to a degree
_LEAST_WAY_M = 1e-3  # shorter distances have no direction


@dataclass(frozen=True, slots=True)
class ArmEvidence:
    """Normal equations of an arm's error [m] and the lag of the fixes [s] in W windows, (W, 4, 4) and (W, 4), weighted by the residuals.

    The odometry's own turning point may be up to ``unseen_std_m`` [m] ahead of base_link.
    """

    matrix: Floats
    vector: Floats
    unseen_std_m: float


@dataclass(frozen=True, slots=True)
class Arm:
    """An arm's error in base_link axes [m] and the lag of the fixes [s], shape (4,), and their covariance, shape (4, 4)."""

    error: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True)
class TiltEvidence:
    """Sums over B blocks: of the rate about z squared, its product with that about y, rows moved, and the slope felt beyond the fixes'."""

    turning: Floats
    beside: Floats
    moving: Floats
    felt: Floats


@dataclass(frozen=True, slots=True)
class Tilt:
    """Roll and pitch of an IMU against how it is taken to be mounted [rad], shape (2,), with standard deviations."""

    rad: Floats
    std_rad: Floats


def collect_arm_evidence(found: Trajectory, m: Measurements) -> ArmEvidence | None:
    """Return what one section shows of the antenna's lever arm; None without fixes or odometry."""
    role, source = (VISUAL, m.visual) if m.visual is not None else (WHEELS, m.wheels)
    if m.gnss is None or source is None or found.stamp_ns.size < _FEWEST:
        return None
    rotation, path = matrix_from_quat(found.quat_xyzw), _draw_path(found, source)
    zero = int(found.stamp_ns[0])
    row_s, fix_s = compute_seconds(found.stamp_ns, zero), compute_seconds(m.gnss.stamp_ns, zero)
    known = (fix_s > row_s[0]) & (fix_s < row_s[-1])
    fix_s = fix_s[known]

    def at(values: Floats) -> Floats:
        columns = values.reshape(values.shape[0], -1).T
        return np.column_stack([np.interp(fix_s, row_s, c) for c in columns])

    axes = np.concatenate((rotation[:, :2, :], -found.velocity_enu_mps[:, :2, None]), axis=2)
    axes = at(axes).reshape(-1, 2, 4)
    place = m.gnss.position_enu_m[known, :2] - axes[:, :, :3] @ np.asarray(m.gnss.lever_arm_m)
    drawn, claim = at(path), np.sqrt(m.gnss.variance_m2[known, :2].mean(1))
    told = []
    for begin in np.arange(0.0, row_s[-1], _WINDOW_S):
        rows = (fix_s >= begin) & (fix_s < begin + _WINDOW_S)
        if rows.sum() >= _FEWEST and _compute_turned_range_rad(axes[rows]) > _LEAST_TURN_RAD:
            told.append(_build_window_equations(place[rows], drawn[rows], axes[rows], float(np.median(claim[rows]))))
    if not told:
        return None
    return ArmEvidence(
        np.stack([matrix for matrix, _ in told]), np.stack([vector for _, vector in told]), _TURNING_POINT_STD_M[role]
    )


def _compute_turned_range_rad(axes: Floats) -> float:
    """Return between which yaws the robot turned."""
    return float(np.ptp(np.unwrap(np.arctan2(axes[:, 1, 0], axes[:, 0, 0]))))


def _draw_path(found: Trajectory, source: BodyVelocities) -> Floats:
    """Return the horizontal path that an odometry draws with the track's attitude [m], shape (N, 2)."""
    zero = int(found.stamp_ns[0])
    row_s, step_s = compute_seconds(found.stamp_ns, zero), np.diff(compute_seconds(found.stamp_ns, zero))
    rotation = matrix_from_quat(found.quat_xyzw)
    point = np.nan_to_num(source.velocity_mps)
    said = compute_interval_means(compute_seconds(source.stamp_ns, zero), point, row_s[:-1], row_s[1:])
    turn = (found.angular_velocity_radps[1:] + found.angular_velocity_radps[:-1]) / 2.0
    body = said - np.cross(turn, source.lever_arm_m)
    body[:, ~source.measured] = 0.0  # along an axis that it does not measure a robot slides little
    steps = np.einsum("kij,kj->ki", (rotation[1:] + rotation[:-1]) / 2.0, body)[:, :2] * step_s[:, None]
    return np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))


def _build_window_equations(place: Floats, drawn: Floats, axes: Floats, claim_m: float) -> tuple[Floats, Floats]:
    """Return the normal equations of arm and lag in one window, its own place, scale and turn taken out; wild fixes are left out."""
    path = drawn - drawn.mean(0)
    rows = np.ones(len(place), np.bool_)
    matrix, vector = np.zeros((4, 4)), np.zeros(4)
    for _ in range(2):
        own = np.zeros((rows.sum(), 2, 4))
        own[:, 0, 0] = own[:, 1, 1] = 1.0
        own[:, 0, 2], own[:, 1, 2] = path[rows].T
        own[:, 0, 3], own[:, 1, 3] = -path[rows, 1], path[rows, 0]
        basis = _make_orthonormal_basis(own.reshape(-1, 4))
        arm, target = axes[rows].reshape(-1, 4), (place - path)[rows].reshape(-1)
        arm, target = (values - basis @ (basis.T @ values) for values in (arm, target))
        solved = np.linalg.lstsq(arm, target, rcond=1e-6)[0]
        left = np.linalg.norm((target - arm @ solved).reshape(-1, 2), axis=1)
        weight = 1.0 / max(claim_m, float(np.sqrt(np.mean(left**2) / 2.0))) ** 2
        matrix, vector = weight * arm.T @ arm, weight * arm.T @ target
        wild = left > _WILD * max(float(np.median(left)), claim_m)
        if not wild.any():
            break
        rows[np.flatnonzero(rows)[wild]] = False
    return matrix, vector


def _make_orthonormal_basis(columns: Floats) -> Floats:
    """Return orthonormal columns that span the given ones (N, k): standing still has no path."""
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    spanning: Floats = left[:, size > 1e-6 * size[0]]
    return spanning


def solve_arm(told: Sequence[ArmEvidence | None], moved_m: Floats, *, height_std_m: float = ARM_STD_M) -> Arm | None:
    """Return the error of the arm by the evidence of all sections, and its covariance; None without evidence of three windows.

    Fixes of one window err together: by how windows scatter more than their fixes claim (Huber's sandwich), they count as fewer. No
    standard deviation exceeds the prior's, which for the antenna's height is ``height_std_m``. The error includes ``moved_m`` [m], shape
    (3,), by which the arm was corrected already.
    """
    evidence = [each for each in told if each is not None]
    if not evidence:
        return None
    matrix, vector = (np.concatenate([getattr(e, name) for e in evidence]) for name in ("matrix", "vector"))
    if len(matrix) < _FEWEST_WINDOWS:
        return None
    vector = vector + matrix[:, :, :3] @ moved_m
    known = np.array([ARM_STD_M, ARM_STD_M, height_std_m, LATE_STD_S])
    prior = np.diag(1.0 / known**2)
    alike = np.linalg.inv(matrix.sum(0) + prior)
    scatter = vector - matrix @ (alike @ vector.sum(0))
    windows = len(matrix)
    spread = scatter.T @ scatter * windows / max(windows - 1, 1)
    fewer = max(1.0, float(np.mean(np.diag(alike @ (spread + prior) @ alike) / np.diag(alike))))
    covariance = np.linalg.inv(matrix.sum(0) / fewer + prior)
    error = covariance @ vector.sum(0) / fewer
    covariance[0, 0] += max(e.unseen_std_m for e in evidence) ** 2
    beyond = np.minimum(known / np.sqrt(np.diag(covariance)), 1.0)
    return Arm(error, covariance * np.outer(beyond, beyond))


def solve_lag(told: Sequence[ArmEvidence | None], moved_m: Floats) -> tuple[float, float] | None:
    """Return by how much the fixes lag behind the path [s] and its deviation, where that is sure and matters; None elsewhere."""
    arm = solve_arm(told, moved_m)
    if arm is None:
        return None
    lag_s, std_s = float(arm.error[3]), float(np.sqrt(arm.covariance[3, 3]))
    return (lag_s, std_s) if abs(lag_s) > max(_SURELY_LATE * std_s, _LATE_S) else None


def estimate_antenna_uncertainty(
    arm: Arm | None, tilt: Tilt | None, lever_arm_m: tuple[float, float, float]
) -> Floats | None:
    """Return the covariance of the arm that what was mended leaves [m²], shape (3, 3): a tilted IMU moves an antenna above it.

    A mounting that was not mended is as it is stated.
    """
    if arm is None and tilt is None:
        return None
    covariance = np.zeros((3, 3)) if arm is None else arm.covariance[:3, :3].copy()
    if tilt is not None:
        left_rad = np.where(tilt.rad != 0.0, tilt.std_rad, 0.0)
        covariance[np.diag_indices(2)] += (left_rad[::-1] * lever_arm_m[2]) ** 2
    return covariance


def make_unknown_arm() -> Arm:
    """Return the prior of an unknown lever arm."""
    return Arm(np.zeros(4), np.diag(np.square([ARM_STD_M] * 3 + [0.0])))


def collect_tilt_evidence(found: Trajectory, m: Measurements) -> TiltEvidence | None:
    """Return what one section shows of the IMU's roll and pitch; None without fixes, which show the slope, or a usable IMU."""
    if m.imu is None or m.gnss is None or not m.imu.accelerometer_usable or found.stamp_ns.size < _FEWEST:
        return None
    zero = int(found.stamp_ns[0])
    row_s, imu_s = compute_seconds(found.stamp_ns, zero), compute_seconds(m.imu.stamp_ns, zero)
    felt = compute_interval_means(imu_s, m.imu.specific_force_mps2[:, :1], row_s[:-1], row_s[1:])[:, 0]
    rate = compute_interval_means(imu_s, m.imu.angular_velocity_radps[:, 1:], row_s[:-1], row_s[1:])
    velocity = (found.velocity_enu_mps[1:] + found.velocity_enu_mps[:-1]) / 2.0
    speed = np.linalg.norm(velocity, axis=1)
    ahead = np.sum(matrix_from_quat(found.quat_xyzw)[:-1, :, 0] * velocity, axis=1)
    quicker = np.diff(np.sign(ahead.mean()) * np.linalg.norm(found.velocity_enu_mps, axis=1)) / np.diff(row_s)
    climb, known = _compute_climb_mps(m.gnss, found.stamp_ns)
    moving = known & (speed > _MOVES_MPS) & (np.sign(ahead) == np.sign(ahead.mean()))
    rise = np.sign(ahead) * climb / np.maximum(speed, _MOVES_MPS)
    beyond = np.where(moving, (felt - quicker) / _GRAVITY_MPS2 - rise, 0.0)
    rate = rate - np.median(rate, axis=0)
    rate[np.abs(rate[:, 1]) < _TURNS_RADPS] = 0.0
    block = max(1, round(_BLOCK_S * 1e9 / compute_median_period_ns(found.stamp_ns)))
    first = np.arange(0, row_s.size - 1, block)
    sums = (rate[:, 1] ** 2, rate[:, 0] * rate[:, 1], moving.astype(np.float64), beyond)
    return TiltEvidence(*(np.add.reduceat(values, first) for values in sums))


def _compute_climb_mps(gnss: Positions, stamp_ns: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
    """Return how fast the fixes climb in each row's interval, wild ones bridged, and where they tell it, shape (N - 1,).

    The track would not do: an IMU that is surely pitched may have led it off the fixes.
    """
    zero, reach_ns = int(stamp_ns[0]), int(_CLIMB_S * 0.5e9)
    height = compute_median_of_five(gnss.position_enu_m[:, 2])
    before, after = stamp_ns[:-1] - reach_ns, stamp_ns[1:] + reach_ns
    fix_s = compute_seconds(gnss.stamp_ns, zero)
    low, high = (np.interp(compute_seconds(at_ns, zero), fix_s, height) for at_ns in (before, after))
    longest_ns = max(int(_CLIMB_S * 1e9), 3 * compute_median_period_ns(gnss.stamp_ns))
    inside = (before >= gnss.stamp_ns[0]) & (after <= gnss.stamp_ns[-1])
    known = inside & ~is_in_gap(gnss.stamp_ns, before, after, longest_ns=longest_ns)
    return (high - low) / ((after - before) * 1e-9), known


def solve_tilt(told: Sequence[TiltEvidence | None]) -> Tilt | None:
    """Return roll and pitch of the IMU by all sections, with deviations from how blocks of ten seconds scatter; None if nothing tells.

    A roll that no turn shows stays at what is known beforehand: none.
    """
    evidence = [each for each in told if each is not None]
    if not evidence:
        return None
    turning, beside, moving, felt = (
        np.concatenate([getattr(e, name) for e in evidence]) for name in TiltEvidence.__slots__
    )
    (roll, roll_std), (pitch, pitch_std) = _estimate_ratio(beside, turning), _estimate_ratio(-felt, moving)
    return Tilt(np.array([roll, pitch]), np.array([roll_std, np.hypot(pitch_std, _LEAST_TILT_STD_RAD)]))


def _estimate_ratio(above: Floats, below: Floats) -> tuple[float, float]:
    """Return the ratio of two sums over blocks, and its deviation by the scatter of the blocks.

    Where fewer than three blocks tell it, what is stated stays.
    """
    blocks = int(np.count_nonzero(below))
    if blocks < _FEWEST_WINDOWS:
        return 0.0, _STATED_TILT_STD_RAD
    value = float(above.sum() / below.sum())
    std = float(np.sqrt(np.sum((above - value * below) ** 2) * blocks / (blocks - 1))) / float(below.sum())
    return value, std


def level_imu(imu: InertialMeasurements, tilt_rad: Floats) -> InertialMeasurements:
    """Return the measurements of an IMU whose roll and pitch against the robot are taken out."""
    base_from_unit = quat_from_rpy(float(tilt_rad[0]), float(tilt_rad[1]), 0.0)
    return replace(
        imu,
        angular_velocity_radps=rotate(base_from_unit, imu.angular_velocity_radps),
        specific_force_mps2=rotate(base_from_unit, imu.specific_force_mps2),
        quat_xyzw=multiply(imu.quat_xyzw, invert(base_from_unit)),
    )


def move_antenna(gnss: Positions, error_m: Floats) -> Positions:
    """Return the fixes with a corrected lever arm."""
    x, y, z = (np.asarray(gnss.lever_arm_m) + error_m).tolist()
    return replace(gnss, lever_arm_m=(x, y, z))


def add_antenna_uncertainty(found: Trajectory, covariance_m2: Floats, gnss: Positions) -> Trajectory:
    """Return the trajectory with what is not known of the arm: it turns with the robot, so that ways and speeds err where it turns.

    They err as far as the fixes tell them: a metre that odometry tells, between fixes of a metre, knows nothing of the arm.
    """
    rotation, rate = matrix_from_quat(found.quat_xyzw), found.angular_velocity_radps
    doubt_m2 = np.einsum("kij,jl,kil->ki", rotation, covariance_m2, rotation)
    ahead = np.column_stack((np.zeros(rate.shape[0]), -rate[:, 2], rate[:, 1]))  # of w x l
    speed_m2ps2 = np.einsum("ki,ij,kj->k", ahead, covariance_m2, ahead)
    share = _compute_share_of_fixes(found, gnss)
    swung_m = share * _compute_swing_std_m(found, rotation, covariance_m2)
    return replace(
        found,
        position_std_m=np.sqrt(found.position_std_m**2 + doubt_m2),
        forward_velocity_std_mps=np.sqrt(found.forward_velocity_std_mps**2 + share[:, 0] ** 2 * speed_m2ps2),
        displacement_std_m=np.hypot(found.displacement_std_m, swung_m),
    )


def _compute_share_of_fixes(found: Trajectory, gnss: Positions) -> Floats:
    """Return how much of what is known of each displacement the fixes may tell, shape (N, 4), at most 1.

    Those within half a minute, for so long odometry holds, tell it to no less than 2 var / number [m²].
    """
    count = max(1.0, _HELD_S * 1e9 / compute_median_period_ns(gnss.stamp_ns))
    alone_m2 = 2.0 * float(np.median(gnss.variance_m2[:, :2])) / count
    return np.asarray(np.minimum(1.0, np.nan_to_num(found.displacement_std_m, nan=np.inf) ** 2 / alone_m2))


def _compute_swing_std_m(found: Trajectory, rotation: Floats, covariance_m2: Floats) -> Floats:
    """Return how far an arm's error goes round along the robot's way within each of `DISPLACEMENT_LAGS_S` [m], shape (N, 4)."""
    swung_m2 = np.zeros((rotation.shape[0], len(DISPLACEMENT_LAGS_S)))
    period_s = compute_median_period_ns(found.stamp_ns) * 1e-9
    for column, lag_s in enumerate(DISPLACEMENT_LAGS_S):
        rows = round(lag_s / period_s)
        if not 0 < rows < rotation.shape[0]:
            continue
        way = (found.position_enu_m[rows:] - found.position_enu_m[:-rows])[:, :2]
        along = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), _LEAST_WAY_M)
        beside = np.einsum("ki,kij->kj", along, (rotation[rows:] - rotation[:-rows])[:, :2])
        swung_m2[:-rows, column] = np.einsum("ki,ij,kj->k", beside, covariance_m2, beside)
    return np.sqrt(swung_m2)
