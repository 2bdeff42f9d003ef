"""Motion of the body from one odometry and turn rates, in a level frame, aligned robustly with the fixes.

Attitude is dead reckoning: the product of the gyroscope's increments, in a frame that drifts. The up direction in that
frame is the specific force averaged over seconds, less the accelerations of the odometry. Heading is the direction of
the body's x-axis about it, and drifts with the gyroscope. The alignment estimates the odometry's scale, the slow drift
of heading, an error of the antenna's lever arm and a time offset, by iterated least squares with weights that fall with
the square of a residual (Cauchy's loss).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion.course import compute_course_rate
from tcpipe.fusion.measurements import IMU, BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.fusion.signals import (
    Plane,
    compute_interval_means,
    compute_median_period_ns,
    compute_moving_mean,
    compute_seconds,
    remove_spikes,
    solve_least_squares,
)
from tcpipe.geometry.rotation import matrix_from_quat, multiply, normalize, quat_from_rotation_vector, quat_from_rpy

_Number = TypeVar("_Number", np.float64, np.complex128)

COURSE = "course over ground"  # source of the yaw rate if no sensor measures it
STEP_S, KNOT_S = 0.05, 60.0  # step of the time grid, and time between knots of the heading drift [s]
_ROUNDS, _MIN_COUNT = 8, 4
"""Rounds of weighted least squares, and fewest samples or windows for a turn or heading [1] (by judgement)."""


@dataclass(frozen=True, slots=True)
class Attitude:
    """Attitude on a grid of times [s], in a level frame whose heading drifts.

    ``rotation`` (n, 3, 3) level_from_base_link; ``yaw_rad`` (n,) continuous; ``rate_radps`` (n, 3) in base_link;
    ``role``: the source of the yaw rate; ``is_level``: roll and pitch are measured.
    """

    time_s: Floats
    rotation: Floats
    yaw_rad: Floats
    rate_radps: Floats
    role: str
    source_ns: Ints
    is_level: bool


def get_turn_rates(measurements: Measurements, role: str) -> tuple[Ints, Floats]:
    """Return stamps [ns] and angular velocities (N, 3) of a sensor or `COURSE`; zero about x and y if not measured."""
    if role == IMU and measurements.imu is not None:
        return measurements.imu.stamp_ns, measurements.imu.angular_velocity_radps
    if role == COURSE and measurements.gnss is not None:
        zero_ns = int(measurements.gnss.stamp_ns[0])
        stamp_s, yaw_rate = compute_course_rate(measurements.gnss, measurements.first_odometry, zero_ns)
        return zero_ns + np.rint(1e9 * stamp_s).astype(np.int64), yaw_rate[:, None] * np.array([0.0, 0.0, 1.0])
    source = measurements.odometries()[role]
    finite = np.isfinite(source.yaw_rate_radps)
    rate = np.zeros((int(finite.sum()), 3))
    rate[:, 2] = source.yaw_rate_radps[finite]
    if source.turn_rate_radps is not None:
        rate[:, :2] = source.turn_rate_radps[finite, :2]
    return source.stamp_ns[finite], rate


def find_attitude(measurements: Measurements, zero_ns: int, end_s: float) -> Attitude | None:
    """Return the attitude from ``zero_ns`` to ``end_s``; None if no sensor measures turns."""
    imu = measurements.imu
    # Slower IMUs do not resolve turns [ns].
    is_imu_usable = (
        imu is not None and imu.stamp_ns.size >= _MIN_COUNT and compute_median_period_ns(imu.stamp_ns) <= 100_000_000
    )
    role = IMU if is_imu_usable else next(reversed(measurements.turning_odometries()), COURSE)
    if end_s < 2 * STEP_S or (role == COURSE and measurements.gnss is None):
        return None
    time_s = np.arange(0.0, end_s + STEP_S, STEP_S)
    stamp_ns, rate = get_turn_rates(measurements, role)
    means = compute_interval_means(compute_seconds(stamp_ns, zero_ns), rate, time_s[:-1], time_s[1:])
    rate = np.concatenate((means, means[-1:]))
    if role != IMU or imu is None or not imu.accelerometer_usable:
        yaw = integrate_grid(rate[:, 2])
        rotation = matrix_from_quat(quat_from_rpy(0.0 * yaw, 0.0 * yaw, yaw))
        return Attitude(time_s, rotation, yaw, rate, role, stamp_ns, is_level=False)
    force = _average_force(measurements, imu, zero_ns, time_s, rate)
    quat = _multiply_increments(rate[:-1] * STEP_S)
    up = _find_up(quat, force)
    # The gyroscope's bias about the level axes rotates the up direction in the drifting frame.
    turn = np.cross(up, np.gradient(up, STEP_S, axis=0))
    bias = np.median(np.einsum("nji,nj->ni", matrix_from_quat(quat), turn), axis=0)
    quat = _multiply_increments((rate[:-1] - bias) * STEP_S)
    up = _find_up(quat, force)
    rotation = compute_levelling_rotations(up) @ matrix_from_quat(quat)
    yaw = np.unwrap(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    return Attitude(time_s, rotation, yaw, rate - bias, IMU, stamp_ns, is_level=True)


def _average_force(
    measurements: Measurements, imu: InertialMeasurements, zero_ns: int, time_s: Floats, rate: Floats
) -> Floats:
    """Return the specific force minus the acceleration of an odometry, (n, 3)."""
    means = compute_interval_means(
        compute_seconds(imu.stamp_ns, zero_ns), imu.specific_force_mps2, time_s - 0.5 * STEP_S, time_s + 0.5 * STEP_S
    )
    source = measurements.first_odometry
    if source is None:
        return means
    speed_s = compute_seconds(source.stamp_ns, zero_ns)
    speed = average_grid(np.interp(time_s, speed_s, source.velocity_mps[:, 0])[:, None], 0.5)[:, 0]
    acceleration = (np.gradient(speed, STEP_S), rate[:, 2] * speed, -rate[:, 1] * speed)
    return np.asarray(means - np.stack(acceleration, -1))


def average_grid(values: Floats, window_s: float) -> Floats:
    """Return the centred moving mean over a window, along the first axis; windows are shorter at the ends."""
    return compute_moving_mean(values, max(1, round(0.5 * window_s / STEP_S)), least=0.0)


def _multiply_increments(turn_rad: Floats) -> Floats:
    """Return cumulative products of rotation vectors (n, 3), quaternions (n + 1, 4): a prefix scan by doubling."""
    quat = np.concatenate(([[0.0, 0.0, 0.0, 1.0]], quat_from_rotation_vector(turn_rad)))
    step = 1
    while step < len(quat):
        quat[step:] = multiply(quat[:-step], quat[step:])
        step *= 2
    return quat


def _find_up(quat: Floats, force: Floats) -> Floats:
    """Return the direction of the averaged specific force in the drifting frame, (n, 3)."""
    up = average_grid(np.einsum("nij,nj->ni", matrix_from_quat(quat), force), 10.0)  # averaging time [s]
    return np.asarray(up / np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9))


def compute_levelling_rotations(up: Floats) -> Floats:
    """Return the smallest rotations (n, 3, 3) that turn unit vectors (n, 3) to +z."""
    x, y, z = up.T
    is_down = 1.0 + z < 1e-9
    return matrix_from_quat(normalize(np.stack((y + is_down, -x, 0.0 * x, 1.0 + z), -1)))


@dataclass(frozen=True, slots=True)
class OdometryTrack:
    """Track of one odometry on the grid of its attitude.

    Attributes
    ----------
    speed_mps : (n,) horizontal, forward positive, scaled to the fixes.
    heading_rad : (n,) of base_link's x-axis; zero is east if there are fixes.
    path_m : (n, 3) of base_link, starting at zero; east, north, up if there are fixes.
    arm_m : (n, 3) antenna from base_link in the same axes, plus the displacement by a time offset of the fixes.
    heading_std_rad : standard deviation of the heading from the fixes.
    """

    speed_mps: Floats
    heading_rad: Floats
    path_m: Floats
    arm_m: Floats
    heading_std_rad: float = 0.0


def compute_forward_mps(source: BodyVelocities, attitude: Attitude, zero_ns: int) -> Floats:
    """Return base_link's forward velocity on the attitude's grid (n,), without spikes."""
    speed = remove_spikes(source.velocity_mps[:, 0])
    stamp_s, half = compute_seconds(source.stamp_ns, zero_ns), 0.5 * STEP_S
    means = compute_interval_means(stamp_s, speed[:, None], attitude.time_s - half, attitude.time_s + half)[:, 0]
    _, y, z = source.lever_arm_m
    return np.asarray(means + attitude.rate_radps[:, 2] * y - attitude.rate_radps[:, 1] * z)


def integrate_grid(rate: NDArray[_Number]) -> NDArray[_Number]:
    """Return the integral of samples (n,) or (n, k) over a grid of `STEP_S`, starting at zero."""
    total = np.zeros_like(rate)
    np.cumsum(0.5 * (rate[1:] + rate[:-1]) * STEP_S, axis=0, out=total[1:])
    return total


def make_free_track(forward_mps: Floats, attitude: Attitude) -> OdometryTrack:
    """Return a track in the level frame, without alignment to fixes."""
    path = integrate_grid(forward_mps[:, None] * attitude.rotation[:, :, 0])
    horizontal_mps = np.hypot(attitude.rotation[:, 0, 0], attitude.rotation[:, 1, 0])
    return OdometryTrack(forward_mps * horizontal_mps, attitude.yaw_rad, path, np.zeros_like(path))


@dataclass(frozen=True, slots=True)
class LevelMotion:
    """Motion of a section from its odometries and turn rates.

    Attributes
    ----------
    zero_ns : zero of all times [ns]: the first measurement of fixes or odometries.
    attitude : on the grid.
    forward_mps : by odometry, base_link's forward velocity on the grid, (n,).
    tracks : by odometry, aligned with the fixes; empty if the fixes do not move.
    """

    zero_ns: int
    attitude: Attitude
    forward_mps: Mapping[str, Floats]
    tracks: Mapping[str, OdometryTrack]


def find_level_motion(measurements: Measurements) -> LevelMotion | None:
    """Return the motion of the body; None without odometry or turn rates."""
    odometries, gnss = measurements.odometries(), measurements.gnss
    stamps = [each.stamp_ns for each in odometries.values()] + ([] if gnss is None else [gnss.stamp_ns])
    zero_ns = min((int(stamp_ns[0]) for stamp_ns in stamps), default=0)
    end_s = (max((int(stamp_ns[-1]) for stamp_ns in stamps), default=0) - zero_ns) * 1e-9
    attitude = find_attitude(measurements, zero_ns, end_s)
    if attitude is None or not odometries:
        return None
    forward = {role: compute_forward_mps(each, attitude, zero_ns) for role, each in odometries.items()}
    tracks = {} if gnss is None else align_tracks(forward, gnss, attitude, zero_ns)
    return LevelMotion(zero_ns, attitude, forward, tracks)


def align_tracks(
    forward_mps: Mapping[str, Floats], gnss: Positions, attitude: Attitude, zero_ns: int
) -> dict[str, OdometryTrack]:
    """Return the tracks of odometries in the frame of the fixes; empty if the fixes do not move.

    Heading, lever arm and time offset come from the odometry that fits the fixes best, also for the others; each has
    its own scale.
    """
    alignment = _Alignment(gnss, attitude, zero_ns)
    fits = {role: fit for role, forward in forward_mps.items() if (fit := alignment.fit(forward)) is not None}
    if not fits:
        return {}
    best = min(fits.values(), key=lambda fit: fit.noise_m)
    return {
        role: alignment.make_track(forward_mps[role], replace(best, scale=fit.scale))
        for role, fit in fits.items()
        if fit.scale > 0.2  # else it measures another motion
    }


@dataclass(frozen=True, slots=True)
class _Fit:
    """Transformation of a dead-reckoned track to fixes.

    ``turn_rad`` (n,) on the grid; ``noise_m``: median residual; ``turn_std_rad``: σ of a window's heading.
    """

    turn_rad: Floats
    scale: float = 1.0
    arm_m: complex = 0j
    offset_s: float = 0.0
    noise_m: float = np.inf
    turn_std_rad: float = np.inf


class _Alignment:
    """Windows of fixes, and least squares over them; the horizontal plane as complex numbers."""

    def __init__(self, gnss: Positions, attitude: Attitude, zero_ns: int) -> None:
        self._attitude = attitude
        self._arm_m = attitude.rotation @ np.asarray(gnss.lever_arm_m)
        time_s, end_s = compute_seconds(gnss.stamp_ns, zero_ns), float(attitude.time_s[-1])
        std_m = float(np.sqrt(np.median(gnss.variance_m2[:, :2])))
        for share in (1.0, 0.5, 0.25, 0.125):  # with gaps of fixes, shorter windows are more
            window_s = share * min(10.0, 0.25 * end_s)
            apart = max(1, round(0.2 * window_s * 1e9 / compute_median_period_ns(gnss.stamp_ns)))
            first = np.arange(0, time_s.size, apart)
            last = np.minimum(np.searchsorted(time_s, time_s[first] + window_s), time_s.size - 1)
            near = np.abs(time_s[last] - time_s[first] - window_s) < 0.3 * window_s
            if near.sum() >= 3 * _MIN_COUNT or window_s < 40.0 * std_m:  # at 0.5 m/s half of it determines no heading
                break
        first, last = first[near], last[near]
        self._start_s, self._end_s = time_s[first], time_s[last]
        self._moved_m = gnss.position_enu_m[last] - gnss.position_enu_m[first]
        self._knots_s = np.linspace(0.0, end_s, max(2, round(end_s / KNOT_S) + 1))
        self._middle_s = 0.5 * (self._start_s + self._end_s)
        self._hats = np.maximum(0.0, 1.0 - np.abs(self._middle_s[:, None] - self._knots_s) / self._knots_s[1])
        # The turn scale of an odometry is an error of heading that grows with the turn.
        self._turn = (attitude.yaw_rad - attitude.yaw_rad.mean()) * (attitude.role != IMU)

    def _compute_changes(self, values: Floats | Plane) -> Plane:
        """Return the change over each window of values on the grid (n,)."""
        time_s = self._attitude.time_s
        plane = np.asarray(values, np.complex128)
        return np.interp(self._end_s, time_s, plane) - np.interp(self._start_s, time_s, plane)

    def _rotate_to_plane(self, forward: Floats, fit: _Fit) -> tuple[Plane, Plane]:
        """Return horizontal velocity and lever arm, complex, on the grid."""
        turn, rotation = np.exp(1j * fit.turn_rad), self._attitude.rotation
        velocity = fit.scale * forward * (rotation[:, 0, 0] + 1j * rotation[:, 1, 0]) * turn
        ahead = np.exp(1j * (self._attitude.yaw_rad + fit.turn_rad))
        arm = (self._arm_m[:, 0] + 1j * self._arm_m[:, 1]) * turn + fit.arm_m * ahead + fit.offset_s * velocity
        return velocity, arm

    def fit(self, forward: Floats) -> _Fit | None:
        """Return scale, heading by knots, turn scale, lever arm and time offset; None if the fixes do not move."""
        fix = self._moved_m[:, 0] + 1j * self._moved_m[:, 1]
        fit, time_s = _Fit(np.zeros_like(forward)), self._attitude.time_s
        turn = np.interp(self._middle_s, time_s, self._turn)
        for number in range(_ROUNDS):
            velocity, arm = self._rotate_to_plane(forward, fit)
            moved = self._compute_changes(integrate_grid(velocity) + arm)
            length = np.abs(moved)
            # Shorter displacements determine no heading [m].
            moving = length > max(0.3 * float(np.median(length)) if length.size else 0.0, 0.2)
            if moving.sum() < _MIN_COUNT:
                return None
            unit = np.conj(moved) / np.maximum(length, 1e-9)
            residual = fix * unit - length
            if number == 0:  # a heading at each knot, without a prior
                seen = np.where(moving, fix * unit / np.maximum(np.abs(fix), 1e-9), 0.0)
                towards = np.einsum("mk,m->k", self._hats, seen)
                usable = np.abs(towards) > 0.5
                if not usable.any():
                    return None
                angle = np.unwrap(np.angle(towards[usable]))
                fit = replace(fit, turn_rad=np.interp(time_s, self._knots_s[usable], angle))
                continue
            noise = float(np.median(np.abs(residual[moving]))) + 1e-6
            root = np.where(moving, 1.0, 0.0) / (1.0 + np.square(np.abs(residual) / (2.5 * noise)))
            spin = self._compute_changes(np.exp(1j * (self._attitude.yaw_rad + fit.turn_rad))) * unit
            columns = np.column_stack(
                (length, 1j * length * turn, spin, 1j * spin, self._compute_changes(velocity) * unit, 1j * length[:, None] * self._hats)
            )  # fmt: skip
            # σ of scale and turn scale, lever arm [m], time offset [s] and headings [rad].
            prior = np.concatenate(([1.0, 0.5, 0.3, 0.3, 0.3], np.ones(self._knots_s.size)))
            before = np.zeros(prior.size)
            before[2:5] = fit.arm_m.real, fit.arm_m.imag, fit.offset_s  # these priors apply to the sum of all rounds
            columns, residual = columns * root[:, None], residual * root
            matrix = np.concatenate((columns.real, columns.imag, np.diag(noise / prior)))
            target = np.concatenate((residual.real, residual.imag, -before * noise / prior))
            found = solve_least_squares(matrix, target)
            fit = _Fit(
                fit.turn_rad + found[1] * self._turn + np.interp(time_s, self._knots_s, found[5:]),
                fit.scale * (1.0 + float(found[0])),
                fit.arm_m + complex(found[2], found[3]),
                fit.offset_s + float(found[4]),
                noise,
                noise / float(np.median(length[moving])),
            )
        return fit

    def make_track(self, forward: Floats, fit: _Fit) -> OdometryTrack:
        """Return the track, aligned with the fixes."""
        velocity, arm = self._rotate_to_plane(forward, fit)
        speed = fit.scale * forward
        climb = speed * self._attitude.rotation[:, 2, 0]
        path = integrate_grid(np.stack((velocity.real, velocity.imag, climb), -1))
        horizontal_mps = np.abs(velocity) * np.sign(speed)
        heading = self._attitude.yaw_rad + fit.turn_rad
        arm_m = np.stack((arm.real, arm.imag, self._arm_m[:, 2]), -1)
        return OdometryTrack(horizontal_mps, heading, path, arm_m, fit.turn_std_rad)
