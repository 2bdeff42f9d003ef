"""The course over ground: which way fixes go, and how fast that turns; all there is where no sensor tells how the robot turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import BodyVelocities, Positions
from tcpipe.fusion.signals import compute_interval_means, compute_seconds

_GRID_S = 0.5  # grid of the course
_WINDOWS_S = (1.0, 2.0, 4.0, 8.0, 16.0)
_CLEARLY = 3.0  # σ of fixes that a baseline needs
_MOVING_M = 0.3  # shorter baselines show no course
_MOVING_MPS = 0.2  # slower motion shows no course
_OFTEN = 0.3  # share of usable baselines before longer ones
_STEP_S = 1e-6  # step between two rates
_WILD = 5.0  # σ off its neighbours' line: fix is bridged
_TURNS_MPS2 = 2.0  # largest bend of that line in a turn


def compute_course_rate(
    gnss: Positions, odometry: BodyVelocities | None, zero_ns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how fast the course over ground turns: stamps [s] from ``zero_ns`` on, twice a second at most, and rates [rad/s].

    The course is that of the displacement over a second, or over as many as it takes to exceed the noise of the fixes; in between it turns
    evenly. Where the odometry goes backwards, the body looks the other way. Single wild fixes are bridged.
    """
    stamp_s = compute_seconds(gnss.stamp_ns, zero_ns)
    grid_s = np.arange(stamp_s[0], stamp_s[-1], _GRID_S)
    std_m = float(np.sqrt(np.median(gnss.variance_m2[:, :2])))
    least_m = max(_MOVING_M, _CLEARLY * std_m)
    places = _bridge_outliers(stamp_s, gnss.position_enu_m[:, :2] @ np.array([1.0, 1j]), std_m)[:, None]
    for window_s in _WINDOWS_S:
        rows = round(window_s / _GRID_S)
        if grid_s.size <= rows:
            return stamp_s[:1], np.zeros(1)
        means = compute_interval_means(
            stamp_s, np.column_stack((places.real, places.imag)), grid_s - _GRID_S, grid_s + _GRID_S
        )
        way = (means[rows:] - means[:-rows]) @ np.array([1.0, 1j])
        at_s = 0.5 * (grid_s[rows:] + grid_s[:-rows])
        moving = np.abs(way) > least_m
        if moving.mean() > _OFTEN:
            break
    if odometry is not None:
        start_s, end_s = at_s - window_s / 2, at_s + window_s / 2
        driven = compute_interval_means(
            compute_seconds(odometry.stamp_ns, zero_ns), odometry.velocity_mps[:, :1], start_s, end_s
        )[:, 0]
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


def _bridge_outliers(
    stamp_s: NDArray[np.float64], places: NDArray[np.complex128], std_m: float
) -> NDArray[np.complex128]:
    """Return places [m], shape (N,), those on the line between their neighbours that lie further off it than noise and a turn explain."""
    if places.size < 3:
        return places
    step_s = stamp_s[2:] - stamp_s[:-2]
    share = (stamp_s[1:-1] - stamp_s[:-2]) / np.maximum(step_s, _STEP_S)
    between = places[:-2] + share * (places[2:] - places[:-2])
    off_m = np.concatenate(([0.0], np.abs(places[1:-1] - between), [0.0]))
    wild = off_m[1:-1] > _WILD * std_m + _TURNS_MPS2 * step_s**2 / 8
    wild &= off_m[1:-1] >= np.maximum(off_m[:-2], off_m[2:])  # its neighbours lie half as far off their lines
    found = places.copy()
    found[1:-1][wild] = between[wild]
    return found


def compute_course(velocity_mps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction of horizontal velocities (N, 3) [rad], continuous; that before it where the robot hardly moves."""
    moving = np.flatnonzero(np.hypot(velocity_mps[:, 0], velocity_mps[:, 1]) > _MOVING_MPS)
    if moving.size == 0:
        return np.zeros(velocity_mps.shape[0])
    course = np.unwrap(np.arctan2(velocity_mps[moving, 1], velocity_mps[moving, 0]))
    last = np.searchsorted(moving, np.arange(velocity_mps.shape[0]), "right") - 1
    held: NDArray[np.float64] = course[np.maximum(last, 0)]
    return held
