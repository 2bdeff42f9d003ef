"""State at the start of a section: position, attitude and gyroscope bias, from all later measurements.

Yaw and position come from the track of an odometry that is aligned with the fixes (`tcpipe.fusion.level_motion`). Since
the odometry's velocity has a sign, a run may start with reverse driving or with a turn. Roll and pitch come from the
specific force.

The robot is stationary where the wheels do not turn and the gyroscope measures no rotation. Both are needed: wheels may
stand on a robot that slides, and a gyroscope measures no rotation on a straight line. A stop gives two more
measurements (zero velocity, and the gyroscope's bias) and the initial bias.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask
from tcpipe.fusion.course import MIN_SPEED_MPS
from tcpipe.fusion.level_motion import STEP_S, LevelMotion, OdometryTrack, find_level_motion
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, InitialState, Measurements, Positions
from tcpipe.fusion.signals import (
    compute_interval_means,
    compute_median_period_ns,
    compute_seconds,
    compute_slopes,
    compute_window_means,
    interpolate_signal,
    remove_xy_spikes,
)
from tcpipe.geometry.rotation import quat_from_rpy, rotate, rpy_from_quat

_UNKNOWN_YAW_STD_RAD = 0.6  # sigma points of a larger σ would wrap around


def find_initial_state(measurements: Measurements, stationary_ns: Ints, start_ns: int) -> InitialState:
    """Return the state at ``start_ns`` [ns], the first stamp of a section.

    ``stationary_ns`` [ns], shape (K, 2), are first and last stamps of stops.
    """
    bias, bias_std = _estimate_gyro_bias(measurements.imu, stationary_ns)
    roll, pitch, tilt_std = _estimate_tilt(measurements.imu, stationary_ns, start_ns)
    m, has_odometry = measurements, bool(measurements.odometries())
    if m.imu is not None:
        m = replace(m, imu=replace(m.imu, angular_velocity_radps=m.imu.angular_velocity_radps - bias))
    if m.gnss is not None and not m.is_antenna_alone and not has_odometry:  # assume that it drives forward
        m = replace(m, wheels=_make_fix_odometry(m.gnss))
    motion = find_level_motion(m)
    track = next(iter(motion.tracks.values()), None) if motion is not None else None
    yaw, yaw_std, heading_from = _estimate_yaw(m, motion, track, start_ns, bias_std)
    quat = quat_from_rpy(roll, pitch, yaw)
    position, position_std = _estimate_position(m.gnss, motion, track, quat, start_ns)
    velocity, velocity_std = np.zeros(3), 2.0  # m/s: no sensor measures it
    if m.first_odometry is not None:
        along = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
        velocity = float(np.median(m.first_odometry.velocity_mps[:5, 0])) * along
        velocity_std = 0.3 if has_odometry else 1.0
    return InitialState(
        position_enu_m=position,
        position_std_m=position_std,
        quat_xyzw=quat,
        tilt_std_rad=tilt_std,
        yaw_std_rad=yaw_std,
        velocity_enu_mps=velocity,
        velocity_std_mps=velocity_std,
        gyro_bias_radps=bias,
        gyro_bias_std_radps=bias_std,
        heading_from=heading_from,
    )


def _estimate_gyro_bias(imu: InertialMeasurements | None, stationary_ns: Ints) -> tuple[Floats, float]:
    if imu is not None and stationary_ns.size:
        inside = (imu.stamp_ns >= stationary_ns[0, 0]) & (imu.stamp_ns <= stationary_ns[0, 1])
        if inside.sum() >= 10:
            return imu.angular_velocity_radps[inside].mean(0), max(0.002, imu.gyro_std_radps / np.sqrt(inside.sum()))
    return np.zeros(3), 0.02  # turn-on bias of a MEMS gyroscope, 1°/s


def _estimate_tilt(imu: InertialMeasurements | None, stationary_ns: Ints, start_ns: int) -> tuple[float, float, float]:
    """Return roll and pitch [rad] at the start, and their standard deviation."""
    if imu is None or not imu.accelerometer_usable:
        return 0.0, 0.0, 0.2
    stands = stationary_ns.size > 0 and stationary_ns[0, 0] < start_ns + 2_000_000_000
    first, end = stationary_ns[0].tolist() if stands else (start_ns, start_ns + 1_500_000_000)
    span_s = np.array([[first - start_ns], [end - start_ns]]) * 1e-9
    fx, fy, fz = compute_interval_means(compute_seconds(imu.stamp_ns, start_ns), imu.specific_force_mps2, *span_s)[0]
    roll, pitch = float(np.arctan2(fy, fz)), float(np.arctan2(-fx, np.hypot(fy, fz)))
    return roll, pitch, 0.03 if stands else 0.08


def _make_fix_odometry(gnss: Positions) -> BodyVelocities:
    """Return the speed of fixes as an odometry of a robot that drives forward."""
    places, window_s = (
        remove_xy_spikes(gnss.position_enu_m),
        max(1.0, 3e-9 * compute_median_period_ns(gnss.stamp_ns)),
    )
    velocity, unknown = np.full((2, places.size, 3), np.nan)
    velocity[:, 0] = np.hypot(*(compute_slopes(gnss.stamp_ns, axis, window_s) for axis in (places.real, places.imag)))
    return BodyVelocities(gnss.stamp_ns, velocity, unknown, unknown[:, 0])


def _estimate_yaw(
    m: Measurements, motion: LevelMotion | None, track: OdometryTrack | None, start_ns: int, bias_std: float
) -> tuple[float, float, str]:
    """Return the yaw at the start [rad], its standard deviation, and its source."""
    gnss, imu = m.gnss, m.imu
    oriented = (
        np.empty((0, 4))
        if imu is None
        else imu.quat_xyzw[np.isfinite(imu.quat_xyzw).all(1) & (imu.stamp_ns >= start_ns)]
    )
    own_yaw, source = (float(rpy_from_quat(oriented[0])[2]), "orientation") if len(oriented) else (0.0, "")
    if gnss is None:
        return own_yaw, 0.01, source or "local frame"
    if track is not None:
        moving_s = STEP_S * float(np.argmax(np.abs(track.speed_mps) > MIN_SPEED_MPS))
        std = float(np.hypot(np.hypot(track.heading_std_rad, 0.03), bias_std * moving_s))
        return float(track.heading_rad[0]), min(std, _UNKNOWN_YAW_STD_RAD), "course over ground"
    posed = np.flatnonzero(np.isfinite(gnss.quat_xyzw).all(1))[:1] if gnss.quat_xyzw is not None else np.empty(0, int)
    if gnss.quat_xyzw is not None and posed.size:  # first attitude of a pose, less the turn until then
        at_s, turned = compute_seconds(gnss.stamp_ns[posed], start_ns), 0.0
        if motion is not None:
            turned = float(np.interp(at_s, motion.attitude.time_s, motion.attitude.yaw_rad)[0])
        return float(rpy_from_quat(gnss.quat_xyzw[posed[0]])[2]) - turned, 0.1, "pose"  # rad: its frame and mounting
    return own_yaw, _UNKNOWN_YAW_STD_RAD, source or "unknown"


def _estimate_position(
    gnss: Positions | None, motion: LevelMotion | None, track: OdometryTrack | None, quat: Floats, start_ns: int
) -> tuple[Floats, Floats]:
    """Return base_link at the start and its σ: the median of the first fixes minus the displacement since the start."""
    if gnss is None:
        return np.zeros(3), np.full(3, 1e-3)
    few = slice(0, int(np.clip(np.searchsorted(gnss.stamp_ns, gnss.stamp_ns[0] + 1_000_000_000, "right"), 3, 10)))
    at_s, driven_m = compute_seconds(gnss.stamp_ns[few], start_ns), 0.0
    antenna_m = rotate(quat, gnss.lever_arm_m)
    if motion is not None and track is not None:
        grid_s = motion.attitude.time_s
        turned = np.exp(1j * np.interp(at_s, grid_s, track.heading_rad)) * complex(*gnss.lever_arm_m[:2])
        moved_m = interpolate_signal(grid_s, track.path_m, at_s)
        antenna_m = moved_m + np.column_stack((turned.real, turned.imag, np.full(at_s.size, antenna_m[2])))
        driven_m = STEP_S * float(np.abs(track.speed_mps[grid_s < at_s[-1]]).sum())
    residual = gnss.position_enu_m[few] - antenna_m
    std: Floats = 3 * np.sqrt(np.median(gnss.variance_m2[few], axis=0))
    if not gnss.has_heights:  # heights count from the start: a σ of kilometres would disturb the plane by tilt
        std[2] = 0.0
    position: Floats = np.median(residual, axis=0)
    return position, std + np.array([0.1, 0.1, 0.2]) * max(driven_m, 1.0) + np.ptp(residual, axis=0)


_WINDOW_NS = 500_000_000  # window of means and scatter


def find_stationary_intervals(measurements: Measurements) -> Ints:
    """Return reliably detected stops of at least 0.3 s: first and last stamp [ns], shape (K, 2), sorted.

    Empty without wheels or without gyroscope.
    """
    wheels, imu = measurements.wheels, measurements.imu
    if wheels is None or imu is None:
        return np.empty((0, 2), np.int64)
    stamp = wheels.stamp_ns
    # Clipped, so that a single outlier does not end a stop.
    clipped = np.clip(wheels.velocity_mps[:, :1], -0.2, 0.2)
    still = _is_steady(stamp, stamp, clipped, 0.02, 0.06)  # m/s: encoders at rest
    quiet_radps = max(0.012, 4 * imu.gyro_std_radps)  # noise at rest [rad/s]; by judgement
    still &= _is_steady(stamp, imu.stamp_ns, imu.angular_velocity_radps, 0.05, quiet_radps)  # larger than any bias
    return _find_stops(stamp, still)


def _is_steady(at_ns: Ints, stamp_ns: Ints, values: Floats, largest: float, largest_std: float) -> Mask:
    """Return whether mean and standard deviation of samples (N, k) around each stamp are small."""
    mean, square = (compute_window_means(stamp_ns, each, at_ns, _WINDOW_NS) for each in (values, values**2))
    small: Mask = (np.abs(mean) < largest) & (np.sqrt(np.maximum(square - mean**2, 0.0)) < largest_std)
    return np.asarray(small.all(axis=1))


def _find_stops(stamp_ns: Ints, still: Mask) -> Ints:
    """Return first and last stamp [ns] of each stop, shape (K, 2), cut by 0.15 s at both ends.

    A gap of half a second ends a stop. Stops shorter than 0.6 s are left out.
    """
    is_continued = still[1:] & still[:-1] & (np.diff(stamp_ns) < _WINDOW_NS)
    first = np.flatnonzero(still & ~np.concatenate(([False], is_continued)))
    last = np.flatnonzero(still & ~np.concatenate((is_continued, [False])))
    stops_ns = np.stack((stamp_ns[first], stamp_ns[last]), -1)
    # The robot rocks at both ends of a stop.
    inner: Ints = stops_ns[stops_ns[:, 1] - stops_ns[:, 0] >= 600_000_000] + np.array([150_000_000, -150_000_000])
    return inner
