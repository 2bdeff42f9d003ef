"""The course over ground: which way fixes go, and how fast that turns; all there is where no sensor tells how the robot turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import BodyVelocities, Positions
from tcpipe.fusion.signals import interval_means, seconds

_GRID_S = 0.5
_WINDOWS_S = (1.0, 2.0, 4.0, 8.0, 16.0)
_CLEARLY = 3.0
_MOVING_M = 0.3
_MOVING_MPS = 0.2
_OFTEN = 0.3
_STEP_S = 1e-6


def course_rate(
    gnss: Positions, odometry: BodyVelocities | None, zero_ns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how fast the course over ground turns: stamps [s] from ``zero_ns`` on, twice a second at most, and rates [rad/s].

    The course is that of the way over a second, or over as many as it takes to be longer than the fixes are noisy; in between it turns
    evenly. Where the odometry goes backwards, the body looks the other way.
    """
    stamp_s = seconds(gnss.stamp_ns, zero_ns)
    grid_s = np.arange(stamp_s[0], stamp_s[-1], _GRID_S)
    least_m = max(_MOVING_M, _CLEARLY * float(np.sqrt(np.median(gnss.variance_m2[:, :2]))))
    for window_s in _WINDOWS_S:
        rows = round(window_s / _GRID_S)
        if grid_s.size <= rows:
            return stamp_s[:1], np.zeros(1)
        means = interval_means(stamp_s, gnss.position_enu_m[:, :2], grid_s - _GRID_S, grid_s + _GRID_S)
        way = (means[rows:] - means[:-rows]) @ np.array([1.0, 1j])
        at_s = 0.5 * (grid_s[rows:] + grid_s[:-rows])
        moving = np.abs(way) > least_m
        if moving.mean() > _OFTEN:
            break
    if odometry is not None:
        start_s, end_s = at_s - window_s / 2, at_s + window_s / 2
        driven = interval_means(seconds(odometry.stamp_ns, zero_ns), odometry.velocity_mps[:, :1], start_s, end_s)[:, 0]
        moving &= np.abs(driven) > _MOVING_MPS
        way = way * np.sign(driven)
    if moving.sum() < 2:
        return stamp_s[:1], np.zeros(1)
    course = np.unwrap(np.angle(way[moving]))
    at_s = at_s[moving]
    # Even turns in between, so that their integral is the course; before it first moves and after it last did, the robot does not turn.
    stamp_s = np.repeat(at_s, 2) + np.tile([-_STEP_S, _STEP_S], at_s.size)
    rate = np.repeat(np.diff(course) / np.diff(at_s), 2)
    return stamp_s, np.concatenate(([0.0], rate, [0.0]))


def course_of(velocity_mps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction of horizontal velocities (N, 3) [rad], continuous; that before it where the robot hardly moves."""
    moving = np.flatnonzero(np.hypot(velocity_mps[:, 0], velocity_mps[:, 1]) > _MOVING_MPS)
    if moving.size == 0:
        return np.zeros(velocity_mps.shape[0])
    course = np.unwrap(np.arctan2(velocity_mps[moving, 1], velocity_mps[moving, 0]))
    last = np.searchsorted(moving, np.arange(velocity_mps.shape[0]), "right") - 1
    held: NDArray[np.float64] = course[np.maximum(last, 0)]
    return held
