"""Course over ground by fixes and velocities, and how it turns."""

from __future__ import annotations

import numpy as np

from tcpipe.arrays import Floats
from tcpipe.fusion.measurements import BodyVelocities, Positions
from tcpipe.fusion.signals import compute_interval_means, compute_seconds, remove_wild_places

MIN_SPEED_MPS = 0.2
"""Speed below which motion shows no course [m/s] (ruling)."""
_GRID_S = 0.5
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
