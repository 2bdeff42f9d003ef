"""Where a section starts: position, attitude and gyroscope bias, found offline from all that follows.

Yaw comes from the course over ground: the path that the odometry and the gyroscope draw from an arbitrary yaw is laid
over the GNSS fixes by the rotation that fits best (the planar case of Wahba's problem: the angle of the sum of products
of complex numbers). At least 5 m at 0.2 m/s or more are asked for, ten standard deviations of the fixes where that is
longer. Since the odometry's velocity has a sign, a run may start in reverse; since the path is drawn, it may start with
a turn. Roll and pitch come from the specific force.

The robot is stationary where the wheels do not turn and the gyroscope is quiet; wheels at rest on a robot that slides,
or a gyroscope at rest on a straight, are not enough. It gives two more measurements (zero velocity, and the gyroscope's
bias) and the initial bias.

Source: B. K. P. Horn, "Closed-form solution of absolute orientation using unit quaternions", JOSA A 4 (4), 1987
(section 2.B, planar).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion.dead_reckoning import reckon_dead
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, InitialState, Measurements, Positions
from tcpipe.fusion.signals import (
    Plane,
    compute_interval_means,
    compute_median_period_ns,
    compute_seconds,
    compute_slopes,
    compute_window_means,
    remove_wild_places,
)
from tcpipe.geometry.rotation import quat_from_rpy, rotate, rpy_from_quat

_UNKNOWN_YAW_STD_RAD = 0.6  # the sigma points of a wider one would meet behind the robot


def find_initial_state(measurements: Measurements, stationary_ns: Ints, start_ns: int) -> InitialState:
    """Return the state at ``start_ns`` [ns], the first stamp of a section; ``stationary_ns`` [ns], (K, 2): stops."""
    bias, bias_std = _estimate_gyro_bias(measurements.imu, stationary_ns)
    roll, pitch, tilt_std = _estimate_tilt(measurements.imu, stationary_ns, start_ns)
    path = _Path(measurements, start_ns, bias)
    yaw, yaw_std, heading_from = _estimate_yaw(measurements, path, start_ns, bias_std)
    quat = quat_from_rpy(roll, pitch, yaw)
    position, position_std = _estimate_position(measurements.gnss, path, quat, yaw)
    velocity, velocity_std = path.start_velocity(yaw, pitch)
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


class _Path:
    """The path by `DeadReckoning`; without odometry the robot drives forward at the speed of the fixes."""

    def __init__(self, m: Measurements, start_ns: int, bias: Floats) -> None:
        self.start_ns, self.is_shown, self._has_odometry = start_ns, not m.is_antenna_alone, bool(m.odometries())
        if m.gnss is not None and self.is_shown and not self._has_odometry:
            m = replace(m, wheels=_read_speeds(m.gnss))
        self.reckoned = reckon_dead(m, start_ns, float(bias[2]))
        self._lever = 0j if m.gnss is None else complex(*m.gnss.lever_arm_m[:2])

    def antenna(self, at_s: Floats, yaw: float = 0.0) -> Plane:
        """Return the antenna east + i north [m] for a yaw at the start [rad]."""
        body = self.reckoned.place(at_s) + self._lever * np.exp(1j * self.reckoned.yaw(at_s))
        placed: Plane = body * np.exp(1j * yaw)
        return placed

    def start_velocity(self, yaw: float, pitch: float) -> tuple[Floats, float]:
        """Return the velocity at the start and its standard deviation [m/s]."""
        if not self.reckoned.forward_mps.size:
            return np.zeros(3), 2.0  # no sensor shows it
        speed, std_mps = float(np.median(self.reckoned.forward_mps[:5])), 0.3 if self._has_odometry else 1.0
        return speed * np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)]), std_mps


def _read_speeds(gnss: Positions) -> BodyVelocities:
    """Return how fast fixes move, as the odometry of a robot that drives forward."""
    places, window_s = remove_wild_places(gnss.position_enu_m), max(1.0, 3e-9 * compute_median_period_ns(gnss.stamp_ns))
    velocity, unknown = np.full((2, places.size, 3), np.nan)
    velocity[:, 0] = np.hypot(*(compute_slopes(gnss.stamp_ns, axis, window_s) for axis in (places.real, places.imag)))
    return BodyVelocities(gnss.stamp_ns, velocity, unknown, unknown[:, 0])


def _estimate_yaw(measurements: Measurements, path: _Path, start_ns: int, bias_std: float) -> tuple[float, float, str]:
    """Return the yaw at the start [rad], its standard deviation, and its source."""
    gnss, imu = measurements.gnss, measurements.imu
    oriented = (
        np.empty((0, 4))
        if imu is None
        else imu.quat_xyzw[np.isfinite(imu.quat_xyzw).all(1) & (imu.stamp_ns >= start_ns)]
    )
    own, source = (float(rpy_from_quat(oriented[0])[2]), "orientation") if len(oriented) else (0.0, "")
    if gnss is None:
        return own, 0.01, source or "local frame"
    posed = np.flatnonzero(np.isfinite(gnss.quat_xyzw).all(1))[:1] if gnss.quat_xyzw is not None else np.empty(0, int)
    fit = _fit_course(gnss, path) if path.is_shown else None
    if fit is not None:
        std = float(np.hypot(np.hypot(fit.yaw_std_rad, 0.03), bias_std * fit.centre_s))
        return fit.yaw_rad, min(std, _UNKNOWN_YAW_STD_RAD), "course over ground"
    if gnss.quat_xyzw is not None and posed.size:  # the first attitude of a pose, less what the robot turned until then
        turned = path.reckoned.yaw(compute_seconds(gnss.stamp_ns[posed], start_ns))
        return float(rpy_from_quat(gnss.quat_xyzw[posed[0]])[2] - turned[0]), 0.1, "pose"  # rad: its frame and mounting
    return own, _UNKNOWN_YAW_STD_RAD, source or "unknown"


@dataclass(frozen=True, slots=True)
class _Fit:
    """Yaw at the start by a window of fixes, its σ, the fixes' RMS distance from the path, the window's middle."""

    yaw_rad: float
    yaw_std_rad: float
    residual_m: float
    centre_s: float


def _fit_course(gnss: Positions, path: _Path) -> _Fit | None:
    """Return the fit of the first window of fixes to the drawn path; the best of all where none fits well."""
    stamp_s = compute_seconds(gnss.stamp_ns, path.start_ns)
    fixes = remove_wild_places(gnss.position_enu_m)
    noise = float(np.median(np.sqrt(gnss.variance_m2[:, :2].mean(1))))
    wanted = max(5.0, 10.0 * noise)  # [m]: yaw to 6°
    drawn = path.antenna(stamp_s)
    found: list[_Fit] = []
    for first in np.unique(np.searchsorted(stamp_s, np.arange(stamp_s[0], stamp_s[-1], 2.0))):  # step [s]
        near = slice(first, int(np.searchsorted(stamp_s, stamp_s[first] + 120.0, "right")))  # longest [s]
        far = np.flatnonzero(np.abs(fixes[near] - fixes[first]) >= wanted)
        if far.size == 0:
            continue
        rows = slice(first, first + int(far[0]) + 1)
        fit = _fit(fixes[rows], drawn[rows], stamp_s[rows], noise)
        if fit is not None:
            found.append(fit)
            if fit.residual_m <= max(3 * noise, 0.05 * wanted):
                return fit
    return min(found, key=lambda each: each.residual_m, default=None)


def _fit(fixes: Plane, drawn: Plane, stamp_s: Floats, noise_m: float) -> _Fit | None:
    """Return the rotation (and scale) that fits the drawn path to the fixes; None if only the fixes move."""
    a, b = fixes - fixes.mean(), drawn - drawn.mean()
    extent2 = float(np.sum(np.abs(b) ** 2))
    if extent2 < 1.0 or np.sqrt(extent2) < 0.2 * np.sqrt(np.sum(np.abs(a) ** 2)):
        return None
    product = np.sum(a * np.conj(b))
    residual = float(np.sqrt(np.mean(np.abs(a - product / extent2 * b) ** 2)))
    std = max(noise_m, residual) / np.sqrt(extent2 / min(fixes.size, 10))
    return _Fit(float(np.angle(product)), float(std), residual, float(stamp_s.mean()))


def _estimate_position(gnss: Positions | None, path: _Path, quat: Floats, yaw: float) -> tuple[Floats, Floats]:
    """Return base_link at the start and its σ: the median of the first fixes less the displacement since the start."""
    if gnss is None:
        return np.zeros(3), np.full(3, 1e-3)
    few = slice(0, int(np.clip(np.searchsorted(gnss.stamp_ns, gnss.stamp_ns[0] + 1_000_000_000, "right"), 3, 10)))
    at_s = compute_seconds(gnss.stamp_ns[few], path.start_ns)
    drawn = path.antenna(at_s, yaw)
    off = gnss.position_enu_m[few] - np.column_stack((drawn.real, drawn.imag, np.zeros(at_s.size)))
    position: Floats = np.median(off, axis=0) - [0.0, 0.0, rotate(quat, gnss.lever_arm_m)[2]]
    std: Floats = 3 * np.sqrt(np.median(gnss.variance_m2[few], axis=0))
    if (
        not gnss.has_heights
    ):  # they count from the start: kilometres of uncertainty would lean on the plane by every tilt
        std[2] = 0.0
    driven_m = path.reckoned.length(float(at_s[-1]))
    return position, std + np.array([0.1, 0.1, 0.2]) * max(driven_m, 1.0) + np.ptp(off, axis=0)


_WINDOW_NS = 500_000_000  # window of means and scatter


def find_stationary_intervals(measurements: Measurements) -> Ints:
    """Return certain stops: first and last stamp of each stop of at least 0.3 s [ns], shape (K, 2), sorted.

    Empty without wheels or without gyroscope.
    """
    wheels, imu = measurements.wheels, measurements.imu
    if wheels is None or imu is None:
        return np.empty((0, 2), np.int64)
    stamp = wheels.stamp_ns
    # Clipped, so that a single wild sample does not wake the robot.
    clipped = np.clip(wheels.velocity_mps[:, :1], -0.2, 0.2)
    still = _is_steady(stamp, stamp, clipped, 0.02, 0.06)  # m/s: encoders at rest
    quiet_radps = max(0.012, 4 * imu.gyro_std_radps)  # noise at rest [rad/s]; judged
    still &= _is_steady(stamp, imu.stamp_ns, imu.angular_velocity_radps, 0.05, quiet_radps)  # a bias is less
    return _find_intervals(stamp, still)


def _is_steady(at_ns: Ints, stamp_ns: Ints, values: Floats, largest: float, spread: float) -> NDArray[np.bool_]:
    """Return whether mean and standard deviation of samples (N, k) around each stamp are small."""
    mean, square = (compute_window_means(stamp_ns, each, at_ns, _WINDOW_NS) for each in (values, values**2))
    small: NDArray[np.bool_] = (np.abs(mean) < largest) & (np.sqrt(np.maximum(square - mean**2, 0.0)) < spread)
    return np.asarray(small.all(axis=1))


def _find_intervals(stamp_ns: Ints, still: NDArray[np.bool_]) -> Ints:
    """Return the runs of True, shape (K, 2), without short ones; gaps of half a second end them, and ends are cut."""
    joined = still[1:] & still[:-1] & (np.diff(stamp_ns) < _WINDOW_NS)
    first = np.flatnonzero(still & ~np.concatenate(([False], joined)))
    last = np.flatnonzero(still & ~np.concatenate((joined, [False])))
    found = np.stack((stamp_ns[first], stamp_ns[last]), -1)
    # Shorter stops do not count; the robot rocks at both ends.
    inner: Ints = found[found[:, 1] - found[:, 0] >= 600_000_000] + np.array([150_000_000, -150_000_000])
    return inner
