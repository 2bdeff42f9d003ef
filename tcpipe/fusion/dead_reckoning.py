"""The path of a robot by its own speeds and turns, without fixes; and how its course over ground turns, by fixes.

The yaw rate is the gyroscope's, and in its gaps that of an odometry or of the course over ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tcpipe.arrays import Floats
from tcpipe.fusion.measurements import BodyVelocities, Measurements, Positions
from tcpipe.fusion.signals import (
    Plane,
    compute_interval_means,
    compute_seconds,
    integrate_signal,
    is_covered,
    remove_wild_places,
)

MIN_SPEED_MPS = 0.2
"""Speed below which motion shows no course [m/s] (ruling)."""


@dataclass(frozen=True, slots=True)
class DeadReckoning:
    """The path from the origin, first along the real axis, as a function of time; speeds are held at the ends.

    Attributes
    ----------
    stamp_s, forward_mps : samples of the forward velocity, shape (N,); without any the path stays at the origin.
    yaw_s, yaw_rate_radps : samples of the yaw rate, shape (M,); without any the path is straight.
    """

    stamp_s: Floats
    forward_mps: Floats
    yaw_s: Floats
    yaw_rate_radps: Floats

    def yaw(self, at_s: Floats) -> Floats:
        """Return the yaw turned since time zero [rad]."""
        return _integrate_from_zero(self.yaw_s, self.yaw_rate_radps[:, None], at_s)[:, 0]

    def place(self, at_s: Floats) -> Plane:
        """Return places [m]."""
        yaw = self.yaw(self.stamp_s)
        velocity = self.forward_mps[:, None] * np.stack((np.cos(yaw), np.sin(yaw)), -1)
        place: Plane = _integrate_from_zero(self.stamp_s, velocity, at_s) @ np.array([1.0, 1j])
        return place

    def length(self, until_s: float) -> float:
        """Return the distance driven since time zero [m]."""
        return float(_integrate_from_zero(self.stamp_s, np.abs(self.forward_mps)[:, None], np.array([until_s]))[0, 0])


def _integrate_from_zero(stamp_s: Floats, values: Floats, at_s: Floats) -> Floats:
    """Return the integral of samples (N, k) from time zero on, shape (M, k); 0 without samples."""
    if stamp_s.size == 0:
        return np.zeros((at_s.size, values.shape[1]))
    return integrate_signal(stamp_s, values, at_s) - integrate_signal(stamp_s, values, np.zeros(1))


def reckon_dead(m: Measurements, start_ns: int, bias_radps: float) -> DeadReckoning:
    """Return the path by the first odometry and the turns from ``start_ns`` on; the gyroscope's yaw rate has a bias."""
    source, sources, imu = m.first_odometry, list(m.turning_odometries().values()), m.imu
    yaw_s, rate, stamp_s, forward_mps = np.empty((4, 0))
    if source is not None:
        stamp_s, forward_mps = compute_seconds(source.stamp_ns, start_ns), source.velocity_mps[:, 0]
    if sources:
        known = np.isfinite(sources[-1].yaw_rate_radps)
        yaw_s, rate = compute_seconds(sources[-1].stamp_ns[known], start_ns), sources[-1].yaw_rate_radps[known]
    elif source is not None and m.gnss is not None:
        yaw_s, rate = compute_course_rate(m.gnss, source, start_ns)
    if imu is not None:
        stamp_ns = start_ns + np.rint(yaw_s * 1e9).astype(np.int64)
        missing = ~is_covered(imu.stamp_ns, stamp_ns, stamp_ns)
        yaw_s = np.concatenate((compute_seconds(imu.stamp_ns, start_ns), yaw_s[missing]))
        rate = np.concatenate((imu.angular_velocity_radps[:, 2] - bias_radps, rate[missing]))
    order = np.argsort(yaw_s, kind="stable")
    return DeadReckoning(stamp_s, forward_mps, yaw_s[order], rate[order])


_GRID_S = 0.5  # of the course
"""Time between two courses [s]."""


def compute_course_rate(gnss: Positions, odometry: BodyVelocities | None, zero_ns: int) -> tuple[Floats, Floats]:
    """Return the turn rate of the course over ground: stamps [s] from ``zero_ns``, at most two a second, rates [rad/s].

    The course is that of the displacement over a second, or over as many as it takes to exceed the noise of the fixes;
    in between it turns evenly. Where the odometry goes backwards, the body looks the other way. Single wild fixes are
    bridged.
    """
    stamp_s = compute_seconds(gnss.stamp_ns, zero_ns)
    grid_s = np.arange(stamp_s[0], stamp_s[-1], _GRID_S)
    std_m = float(np.sqrt(np.median(gnss.variance_m2[:, :2])))
    least_m = max(0.3, 3.0 * std_m)  # a shorter baseline shows no course
    values = remove_wild_places(gnss.position_enu_m).view(np.float64).reshape(-1, 2)
    for window_s in (1.0, 2.0, 4.0, 8.0, 16.0):  # baselines [s]
        rows = round(window_s / _GRID_S)
        if grid_s.size <= rows:
            return stamp_s[:1], np.zeros(1)
        means = compute_interval_means(stamp_s, values, grid_s - _GRID_S, grid_s + _GRID_S)
        way = (means[rows:] - means[:-rows]) @ np.array([1.0, 1j])
        at_s = 0.5 * (grid_s[rows:] + grid_s[:-rows])
        moving = np.abs(way) > least_m
        if moving.mean() > 0.3:  # share of usable baselines [1] (ruling)
            break
    if odometry is not None:
        odometry_s = compute_seconds(odometry.stamp_ns, zero_ns)
        ends_s = at_s - window_s / 2, at_s + window_s / 2
        driven = compute_interval_means(odometry_s, odometry.velocity_mps[:, :1], *ends_s)[:, 0]
        moving &= np.abs(driven) > MIN_SPEED_MPS
        way = way * np.sign(driven)
    if moving.sum() < 2:
        return stamp_s[:1], np.zeros(1)
    course = np.unwrap(np.angle(way[moving]))
    at_s = at_s[moving]
    # Even turns in between, so that their integral is the course; before it first moves and after it last did, the
    # robot does not turn.
    stamp_s = np.repeat(at_s, 2) + np.tile([-1e-6, 1e-6], at_s.size)
    rate = np.repeat(np.diff(course) / np.diff(at_s), 2)
    return stamp_s, np.concatenate(([0.0], rate, [0.0]))


def compute_course(velocity_mps: Floats) -> Floats:
    """Return the direction of horizontal velocities (N, 3) [rad], continuous; the last one at low speed."""
    moving = np.flatnonzero(np.hypot(velocity_mps[:, 0], velocity_mps[:, 1]) > MIN_SPEED_MPS)
    if moving.size == 0:
        return np.zeros(velocity_mps.shape[0])
    course = np.unwrap(np.arctan2(velocity_mps[moving, 1], velocity_mps[moving, 0]))
    last = np.searchsorted(moving, np.arange(velocity_mps.shape[0]), "right") - 1
    held: Floats = course[np.maximum(last, 0)]
    return held
