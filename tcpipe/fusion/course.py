"""Course over ground from fixes and velocities, and its rate."""

from __future__ import annotations

import numpy as np

from tcpipe.arrays import Floats
from tcpipe.fusion.measurements import BodyVelocities, Positions
from tcpipe.fusion.signals import compute_interval_means, compute_seconds, remove_xy_spikes

MIN_SPEED_MPS = 0.2  # speed below which the course is undefined [m/s] (by judgement)
_GRID_S = 0.5  # time between two courses [s]


def compute_course_rate(gnss: Positions, odometry: BodyVelocities | None, zero_ns: int) -> tuple[Floats, Floats]:
    """Return the rate of the course over ground: stamps [s] from ``zero_ns``, at most two a second, and rates [rad/s].

    The course is the direction of the displacement over one second, or over a longer baseline if the displacement does
    not exceed the noise of the fixes. Between two courses the rate is constant. Where the odometry drives backwards,
    the course is that of the reversed displacement. Single outliers are interpolated.
    """
    stamp_s = compute_seconds(gnss.stamp_ns, zero_ns)
    grid_s = np.arange(stamp_s[0], stamp_s[-1], _GRID_S)
    std_m = float(np.sqrt(np.median(gnss.variance_m2[:, :2])))
    least_m = max(0.3, 3.0 * std_m)  # a shorter baseline determines no course
    values = remove_xy_spikes(gnss.position_enu_m).view(np.float64).reshape(-1, 2)
    for window_s in (1.0, 2.0, 4.0, 8.0, 16.0):  # baselines [s]
        rows = round(window_s / _GRID_S)
        if grid_s.size <= rows:
            return stamp_s[:1], np.zeros(1)
        mean_m = compute_interval_means(stamp_s, values, grid_s - _GRID_S, grid_s + _GRID_S)
        displacement = (mean_m[rows:] - mean_m[:-rows]) @ np.array([1.0, 1j])
        at_s = 0.5 * (grid_s[rows:] + grid_s[:-rows])
        moving = np.abs(displacement) > least_m
        if moving.mean() > 0.3:  # least share of usable baselines [1] (by judgement)
            break
    if odometry is not None:
        odometry_s = compute_seconds(odometry.stamp_ns, zero_ns)
        ends_s = at_s - window_s / 2, at_s + window_s / 2
        driven = compute_interval_means(odometry_s, odometry.velocity_mps[:, :1], *ends_s)[:, 0]
        moving &= np.abs(driven) > MIN_SPEED_MPS
        displacement = displacement * np.sign(driven)
    if moving.sum() < 2:
        return stamp_s[:1], np.zeros(1)
    course = np.unwrap(np.angle(displacement[moving]))
    at_s = at_s[moving]
    # The rate is constant between two courses, so that its integral is the course. It is 0 before the first and after
    # the last motion.
    stamp_s = np.repeat(at_s, 2) + np.tile([-1e-6, 1e-6], at_s.size)
    rate = np.repeat(np.diff(course) / np.diff(at_s), 2)
    return stamp_s, np.concatenate(([0.0], rate, [0.0]))


def compute_course(velocity_mps: Floats) -> Floats:
    """Return the direction of horizontal velocities (N, 3) [rad], continuous; at low speed the last direction."""
    moving = np.flatnonzero(np.hypot(velocity_mps[:, 0], velocity_mps[:, 1]) > MIN_SPEED_MPS)
    if moving.size == 0:
        return np.zeros(velocity_mps.shape[0])
    course = np.unwrap(np.arctan2(velocity_mps[moving, 1], velocity_mps[moving, 0]))
    last = np.searchsorted(moving, np.arange(velocity_mps.shape[0]), "right") - 1
    held: Floats = course[np.maximum(last, 0)]
    return held
