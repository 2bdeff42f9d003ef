"""When the robot stands: the wheels do not turn and the gyroscope is quiet.

Standing gives two more measurements (zero velocity, and the gyroscope's bias itself) and the gyroscope's bias for the start. Both
signs are asked for: wheels at rest on a robot that slides, or a gyroscope at rest on a straight, are not standing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import Measurements

_WINDOW_NS = 500_000_000
_MAX_WHEEL_MPS = 0.02  # mean over the window; single samples are noisy
_MAX_WHEEL_SPREAD_MPS = 0.06
_MAX_SAMPLE_MPS = 0.2
_MAX_BIAS_RADPS = 0.05  # a gyroscope at rest may show this much
_MIN_SPREAD_RADPS = 0.012
_MIN_LENGTH_NS = 600_000_000
_MARGIN_NS = 150_000_000


def find_stationary_intervals(measurements: Measurements) -> NDArray[np.int64]:
    """Return when the robot stands for certain.

    Returns
    -------
    [ns], shape (K, 2), int64: first and last stamp of each stay of at least 0.3 s, in order. Empty without wheels or without gyroscope.
    """
    wheels, imu = measurements.wheels, measurements.imu
    if wheels is None or imu is None or wheels.stamp_ns.size == 0 or imu.stamp_ns.size == 0:
        return np.empty((0, 2), np.int64)
    stamp = wheels.stamp_ns
    # Clipped, so that a single wild sample does not wake the robot.
    clipped = np.clip(wheels.velocity_mps[:, :1], -_MAX_SAMPLE_MPS, _MAX_SAMPLE_MPS)
    mean, spread = _compute_window_statistics(stamp, stamp, clipped)
    still = (np.abs(mean[:, 0]) < _MAX_WHEEL_MPS) & (spread[:, 0] < _MAX_WHEEL_SPREAD_MPS)
    mean, spread = _compute_window_statistics(stamp, imu.stamp_ns, imu.angular_velocity_radps)
    quiet = max(_MIN_SPREAD_RADPS, 4 * imu.gyro_std_radps)
    still &= (np.abs(mean) < _MAX_BIAS_RADPS).all(1) & (spread < quiet).all(1)
    return _find_intervals(stamp, still)


def _compute_window_statistics(
    at_ns: NDArray[np.int64], stamp_ns: NDArray[np.int64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation of (N, k) values within half a window of each stamp; NaN where there are none."""
    first = np.searchsorted(stamp_ns, at_ns - _WINDOW_NS // 2, "left")
    last = np.searchsorted(stamp_ns, at_ns + _WINDOW_NS // 2, "right")
    count = np.where(last > first, last - first, 1)
    mean, spread = np.empty((2, at_ns.size, values.shape[1]))
    total = np.zeros(stamp_ns.size + 1)
    for k, value in enumerate(values.T):  # one by one: a long signal takes room
        np.cumsum(value, out=total[1:])
        mean[:, k] = (total[last] - total[first]) / count
        np.cumsum(value**2, out=total[1:])
        spread[:, k] = np.sqrt(np.maximum((total[last] - total[first]) / count - mean[:, k] ** 2, 0.0))
    mean[last == first] = spread[last == first] = np.nan
    return mean, spread


def _find_intervals(stamp_ns: NDArray[np.int64], still: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Find runs of True, not bridged over gaps of half a second, shortened at both ends, the short ones left out."""
    joined = still[1:] & still[:-1] & (np.diff(stamp_ns) < _WINDOW_NS)
    first = np.flatnonzero(still & ~np.concatenate(([False], joined)))
    last = np.flatnonzero(still & ~np.concatenate((joined, [False])))
    found = np.stack((stamp_ns[first], stamp_ns[last]), -1)
    long = found[found[:, 1] - found[:, 0] >= _MIN_LENGTH_NS]
    return np.stack((long[:, 0] + _MARGIN_NS, long[:, 1] - _MARGIN_NS), -1)
