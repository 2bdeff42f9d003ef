"""What the sensors say of the motion, on one grid and smoothed alike, so that they can be compared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.lags import GRID_S, Floats, average_on_grid, compute_moving_mean
from tcpipe.fusion.measurements import BodyVelocities, Positions
from tcpipe.fusion.signals import compute_median_of_five, compute_median_period_ns

FIXES_S = 0.5
"""A velocity is made of fixes averaged over, and taken apart by, this long [s]."""

_MAX_GAP_NS = 500_000_000
_STRAY_M = 0.3
_STRAY = 6.0
_COURSE_MPS = 0.3


def resample_signal(stamp_ns: NDArray[np.int64], values: Floats, at_ns: NDArray[np.int64]) -> Floats:
    """Return a signal (N, k) on the grid, shape (M, k); NaN in gaps of half a second or three periods."""
    return average_on_grid(
        stamp_ns, values, at_ns, longest_gap_ns=max(_MAX_GAP_NS, 3 * compute_median_period_ns(stamp_ns))
    )


def resample_twist(source: BodyVelocities, at_ns: NDArray[np.int64]) -> Floats:
    """Return forward velocity and yaw rate, shape (M, 2), single wild samples bridged; the yaw rate 0 where the source gives none."""
    forward, yaw_rate = source.velocity_mps[:, 0], source.yaw_rate_radps
    if not np.isfinite(yaw_rate).any():
        yaw_rate = np.zeros_like(forward)
    known = np.isfinite(forward + yaw_rate) & ~_find_strays(forward) & ~_find_strays(yaw_rate)
    if known.sum() < 2:
        return np.full((at_ns.size, 2), np.nan)
    return resample_signal(source.stamp_ns[known], np.column_stack((forward, yaw_rate))[known], at_ns)


def resample_fixes(gnss: Positions, at_ns: NDArray[np.int64]) -> NDArray[np.complex128]:
    """Return the antenna's places [m], east and i times north, averaged over half a second, shape (M,); wild fixes are bridged."""
    place = gnss.position_enu_m[:, :2]
    wild = np.zeros(place.shape[0], np.bool_)
    for axis in place.T:
        off = _compute_neighbour_distance(axis)
        wild |= off > _STRAY_M + _STRAY * float(np.median(off))
    if (~wild).sum() < 2:
        return np.full(at_ns.size, np.nan + 0j)
    smooth = compute_moving_mean(resample_signal(gnss.stamp_ns[~wild], place[~wild], at_ns), FIXES_S)
    return smooth[:, 0] + 1j * smooth[:, 1]


def compute_fix_velocity(gnss: Positions, at_ns: NDArray[np.int64]) -> NDArray[np.complex128]:
    """Return the antenna's velocity [m/s], east and i times north, shape (M,); wild fixes are bridged, NaN in gaps."""
    velocity = np.full(at_ns.size, np.nan + 0j)
    half = round(FIXES_S / 2 / GRID_S)
    if at_ns.size > 2 * half:
        place = resample_fixes(gnss, at_ns)
        velocity[half:-half] = (place[2 * half :] - place[: -2 * half]) / (2 * half * GRID_S)
    return velocity


def compute_course_rate(velocity_mps: NDArray[np.complex128]) -> Floats:
    """Return how fast the direction of travel turns [rad/s], shape (M,), NaN below 0.3 m/s.

    An antenna ahead of the turning point by l leads the body's course by l / v: good for a sign, not for a clock.
    """
    half = round(FIXES_S / 2 / GRID_S)
    rate = np.full(velocity_mps.size, np.nan)
    if velocity_mps.size <= 2 * half:
        return rate
    quick = np.abs(velocity_mps) > _COURSE_MPS
    turned = np.angle(velocity_mps[2 * half :] * np.conj(velocity_mps[: -2 * half]))
    rate[half:-half] = np.where(quick[2 * half :] & quick[: -2 * half], turned / (2 * half * GRID_S), np.nan)
    return rate


def _find_strays(values: Floats) -> NDArray[np.bool_]:
    """Return which samples lie far off the median of their neighbours."""
    off = _compute_neighbour_distance(values)
    stray: NDArray[np.bool_] = off > _STRAY * max(float(np.nanpercentile(off, 90)), 1e-9)
    return stray


def _compute_neighbour_distance(values: Floats) -> Floats:
    """Return each sample's distance from the median of the five around it; 0 for fewer than five samples."""
    return np.abs(values - compute_median_of_five(values))
