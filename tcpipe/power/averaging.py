"""Whether a power source averages over its message period, told by the motion: a mean comes half a period after what it is the mean of.

A clock that is off by half a period looks the same, and costs the same: values that are held backwards from their stamps lie right then.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

_FEWEST = 60
_LATE = np.linspace(-1.0, 1.5, 26)
"""Delays that are tried, in periods: 0 is a sample's, a half is a mean's."""
_NEAR = 0.25
_CLEARLY = 0.9
"""The better of two delays says so when its squared residuals are below this share of the other's."""


def is_stated_averaged(
    power_ns: Stamps, power_watt: Floats, motion_ns: Stamps, forward_mps: Floats, yaw_rate_radps: Floats
) -> bool | None:
    """Return whether each value is the mean since the one before it (True) or sampled (False); None where motion tells neither.

    Power is fitted by standing, speed, its square, turning and the gain of speed, as means over one period about a time that lies so and so
    long before each stamp; which delay fits best tells, unless that is neither's, or hardly better than the other.

    Parameters
    ----------
    power_ns, power_watt : [ns], [W], shape (N,), rising stamps, finite.
    motion_ns, forward_mps, yaw_rate_radps : [ns], [m/s], [rad/s], shape (M,), rising stamps, finite.
    """
    if min(power_ns.size, motion_ns.size) < _FEWEST:
        return None
    period_ns = float(np.median(np.diff(power_ns)))
    margin_ns = 2.0 * period_ns
    inside = (power_ns > motion_ns[0] + margin_ns) & (power_ns < motion_ns[-1] - margin_ns)
    if inside.sum() < _FEWEST:
        return None
    at_s, motion_s, period_s = (
        (power_ns[inside] - motion_ns[0]) / 1e9,
        (motion_ns - motion_ns[0]) / 1e9,
        period_ns / 1e9,
    )
    sums = _integrate_causes(motion_s, _collect_causes(motion_s, forward_mps, yaw_rate_radps))
    left = np.array(
        [
            _compute_unexplained(power_watt[inside], _mean_about(at_s - late * period_s, period_s, motion_s, sums))
            for late in _LATE
        ]
    )
    best = _LATE[int(np.argmin(left))]
    sampled, averaged = (float(np.interp(late, _LATE, left)) for late in (0.0, 0.5))
    if min(abs(best), abs(best - 0.5)) > _NEAR or min(sampled, averaged) > _CLEARLY * max(sampled, averaged):
        return None
    return averaged < sampled


def _collect_causes(motion_s: Floats, forward_mps: Floats, yaw_rate_radps: Floats) -> Floats:
    """Return what power follows, shape (M, 5)."""
    speed, turning = np.abs(forward_mps), np.abs(yaw_rate_radps)
    gained = np.gradient(0.5 * speed**2, motion_s)
    return np.column_stack((np.ones_like(speed), speed, speed**2, turning, gained))


def _integrate_causes(motion_s: Floats, causes: Floats) -> Floats:
    """Return the integral of each cause from the first time, shape (M, 5)."""
    steps = np.diff(motion_s)[:, None] * (causes[1:] + causes[:-1]) / 2.0
    return np.concatenate((np.zeros((1, causes.shape[1])), np.cumsum(steps, axis=0)))


def _mean_about(at_s: Floats, width_s: float, motion_s: Floats, sums: Floats) -> Floats:
    """Return the means of the causes over a width about each time, shape (N, 5)."""
    later, earlier = at_s + width_s / 2, at_s - width_s / 2
    return (
        np.column_stack([np.interp(later, motion_s, of) - np.interp(earlier, motion_s, of) for of in sums.T]) / width_s
    )


def _compute_unexplained(power_watt: Floats, causes: Floats) -> float:
    fitted = causes @ np.linalg.lstsq(causes, power_watt, rcond=None)[0]
    return float(np.sum((power_watt - fitted) ** 2))
