"""A receiver's own velocity against the fixes of the same receiver, before it is fused: it helps, so where it is in doubt it stays out.

Its integral over windows is held against the displacement of the fixes. Windows are as long as it takes for the way in them to be far
longer than the fixes are noisy. Zero while the fixes move is a frozen one; a way as long as theirs in other directions is that of another
frame; one that is late or early against the odometry is off by what the robot's velocity changes meanwhile, as is one that
is not of the fixes' time; which of these two is off nobody can tell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.clock_offsets import compute_antenna_speed, select_speed_changes
from tcpipe.fusion.checks.distances import refuse_frozen
from tcpipe.fusion.checks.lags import (
    FIXES_S,
    Lag,
    compute_fix_velocity,
    compute_moving_mean,
    find_lag,
    find_liveliest_window_ns,
    resample_signal,
    resample_twist,
)
from tcpipe.fusion.checks.plausibility import SensorExclusion
from tcpipe.fusion.measurements import DOPPLER, GNSS, GroundVelocities, Measurements, Positions
from tcpipe.fusion.signals import compute_median_period_ns, compute_seconds, integrate_signal, is_in_gap

_WINDOWS_S = (4.0, 8.0, 16.0, 32.0, 64.0)
_FEWEST_WINDOWS = 3  # windows in which fixes show motion
_CLEARLY = 4.0  # σ of fixes that a distance needs
_MOVES_M = 1.0  # shorter distances do not count; windows 4 to 64 s
_OFF = 0.25  # allowed share of disagreement in the right frame
_STANDS = 0.1  # a velocity with less distance is frozen
_LATE_S = 0.05  # smallest reported offset: 2 cm/s at 0.5 rad/s
_SURE = 4.0  # σ
_MAX_STD_S = 0.03  # of a reported offset
_MIN_EXPLAINED = 0.5  # variance shared by two speeds
_MAX_GAP_NS = 1_000_000_000


def check_ground_velocity(m: Measurements) -> SensorExclusion | None:
    """Return why the receiver's velocity of a clock epoch is not to be fused; None where the fixes confirm it."""
    if m.doppler is None:
        return None
    if m.gnss is None:
        return SensorExclusion(DOPPLER, "velocity-unverified")
    windows = _compute_displacements(m.gnss, m.doppler)
    if windows is None:
        return SensorExclusion(DOPPLER, "velocity-unverified")
    return _check_frame(*windows, m.doppler.stamp_ns.size) or _check_time_offset(m)


def _compute_displacements(
    gnss: Positions, doppler: GroundVelocities
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]] | None:
    """Return the displacement by the fixes and by the velocity in windows [m], east and i times north; None where too few fixes move."""
    noise_m = float(np.sqrt(2.0 * np.median(gnss.variance_m2[:, :2])))
    zero = int(gnss.stamp_ns[0])
    fix_s = compute_seconds(gnss.stamp_ns, zero)
    east_north = np.array([1.0, 1j])
    longest_ns = max(_MAX_GAP_NS, 3 * compute_median_period_ns(doppler.stamp_ns))
    for window_s in _WINDOWS_S:
        last = np.searchsorted(fix_s, fix_s + window_s)
        first = np.flatnonzero(last < fix_s.size)
        last = last[first]
        whole = ~is_in_gap(doppler.stamp_ns, gnss.stamp_ns[first], gnss.stamp_ns[last], longest_ns=longest_ns)
        first, last = first[whole], last[whole]
        by_fixes = (gnss.position_enu_m[last, :2] - gnss.position_enu_m[first, :2]) @ east_north
        far = np.abs(by_fixes) > max(_MOVES_M, _CLEARLY * noise_m)
        apart = max(1, round(window_s * 1e9 / compute_median_period_ns(gnss.stamp_ns)))
        if far.sum() < _FEWEST_WINDOWS * apart:
            continue
        total = (
            integrate_signal(compute_seconds(doppler.stamp_ns, zero), doppler.velocity_enu_mps[:, :2], fix_s)
            @ east_north
        )
        return by_fixes[far], (total[last] - total[first])[far]
    return None


def _check_frame(
    by_fixes: NDArray[np.complex128], by_velocity: NDArray[np.complex128], messages: int
) -> SensorExclusion | None:
    """Return what is wrong with the directions or the size of the velocity."""

    def off(told: NDArray[np.complex128]) -> float:
        return float(np.median(np.abs(by_fixes - told) / np.abs(by_fixes)))

    if off(by_velocity) <= _OFF:
        return None
    size = float(np.median(np.abs(by_velocity) / np.abs(by_fixes)))
    if size < _STANDS:
        return refuse_frozen(DOPPLER, "velocity", messages)
    if off(1j * np.conj(by_velocity)) <= _OFF:
        return SensorExclusion(DOPPLER, "velocity-frame", {"frame": "north-east-down"})
    if abs(size - 1.0) <= _OFF:
        return SensorExclusion(DOPPLER, "velocity-frame", {"frame": "unknown"})
    return SensorExclusion(DOPPLER, "distance-contradicted", {"reference": GNSS}, {"distance_ratio": size})


def _check_time_offset(m: Measurements) -> SensorExclusion | None:
    """Return the exclusion for a time offset: against the first odometry or, where that shows no lag, against the fixes."""
    at_ns = find_liveliest_window_ns(m)
    if at_ns is None or m.doppler is None or m.gnss is None:
        return None
    velocity = resample_signal(m.doppler.stamp_ns, m.doppler.velocity_enu_mps[:, :2], at_ns)
    for role, odometry in list(m.odometries().items())[:1]:
        speed = compute_moving_mean(np.linalg.norm(velocity, axis=1)[:, None], _SMOOTH_S)
        of_odometry = compute_antenna_speed(resample_twist(odometry, at_ns), m.gnss.lever_arm_m)
        lag = find_lag(*select_speed_changes(speed, compute_moving_mean(of_odometry, _SMOOTH_S)))
        if lag is not None and _is_known(lag):
            return _refuse_late("time-offset", role, lag, late_s=lag.offset_s) if _is_off(lag) else None
    seen = compute_fix_velocity(m.gnss, at_ns)
    for axis, of_fixes in zip(compute_moving_mean(velocity, FIXES_S).T, (seen.real, seen.imag), strict=True):
        lag = find_lag(axis, compute_moving_mean(of_fixes[:, None], _SMOOTH_S))
        if lag is not None and _is_known(lag) and _is_off(lag):
            return _refuse_late("clocks-differ", GNSS, lag)
    return None


def _refuse_late(code: str, reference: str, lag: Lag, *, late_s: float | None = None) -> SensorExclusion:
    numbers = {"offset_s": lag.offset_s, "offset_2std_s": 2 * lag.std_s, "apart_s": abs(lag.offset_s)}
    return SensorExclusion(DOPPLER, code, {"reference": reference}, numbers, late_s=late_s)


_SMOOTH_S = 0.3  # averaging of speeds


def _is_known(lag: Lag) -> bool:
    return lag.std_s <= _MAX_STD_S and lag.explained >= _MIN_EXPLAINED


def _is_off(lag: Lag) -> bool:
    return abs(lag.offset_s) > max(_LATE_S, _SURE * lag.std_s)
