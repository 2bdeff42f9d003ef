"""How much the stamps of GNSS fixes jitter, seen from the odometry: a fix that is late lies behind on the path.

Receivers and localisation nodes that stamp a fix when they send it, some tenths of a second after they measured it, make positions that
stand still and then leap, whatever variance they claim; an estimator that believes the claim refuses half of them. Over each pair of
successive fixes the distance between them is compared with the distance driven by the odometry (times the local ratio of the two, so
that slip does not count). What this residual spreads beyond the claimed noise, divided by the speed, is the jitter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import GNSS, BodyVelocities, Positions
from tcpipe.fusion.signals import compute_seconds, integrate_signal
from tcpipe.tables.findings import Finding, Subject, make_finding

_MIN_SPEED_MPS = 0.3
_MAX_INTERVAL_S = 2.0
_PAIRS = 41
_MIN_JITTER_S = 0.05


def smooth_stamps(
    gnss: Positions | None, odometry: BodyVelocities | None
) -> tuple[Positions | None, tuple[Finding, ...]]:
    """Return the fixes with the variance of those raised whose stamps jitter against the odometry, and the finding of it."""
    if gnss is None or odometry is None:
        return gnss, ()
    jitter_s = stamp_jitter_s(gnss, odometry)
    jumpy = jitter_s > 0
    if not jumpy.any():
        return gnss, ()
    finding = make_finding(
        "stamp-jitter",
        Subject("role", GNSS),
        jitter_fraction=float(jumpy.mean()),
        jitter_s=float(np.median(jitter_s[jumpy])),
    )
    return add_jitter_variance(gnss, odometry, jitter_s), (finding,)


def stamp_jitter_s(gnss: Positions, odometry: BodyVelocities) -> NDArray[np.float64]:
    """Return the standard deviation of the stamps around each fix [s], shape (N,); 0 where it does not matter or cannot be known.

    It matters above 0.05 s and where it moves the fix by more than twice its claimed deviation. While the robot stands nothing can be
    known: the value of the nearest motion is held.

    Parameters
    ----------
    gnss : fixes of one clock epoch.
    odometry : wheels or visual odometry over the same time; its forward velocity is used.
    """
    zero = int(gnss.stamp_ns[0])
    stamp_s = compute_seconds(gnss.stamp_ns, zero)
    speed = np.abs(odometry.velocity_mps[:, :1])
    driven_m = np.diff(integrate_signal(compute_seconds(odometry.stamp_ns, zero), speed, stamp_s), axis=0)[:, 0]
    interval_s = np.diff(stamp_s)
    moved_m = np.hypot(*np.diff(gnss.position_enu_m[:, :2], axis=0).T)
    moving = (driven_m > _MIN_SPEED_MPS * interval_s) & (interval_s < _MAX_INTERVAL_S)
    if moving.sum() < _PAIRS:
        return np.zeros(stamp_s.size)
    driven_m, moved_m, mean_speed = driven_m[moving], moved_m[moving], driven_m[moving] / interval_s[moving]
    # A median: neither slip nor an outlying fix is jitter.
    ratio = np.median(_make_windows(moved_m / driven_m), axis=1)
    residual_s = (moved_m - ratio * driven_m) / mean_speed
    claimed_s2 = (gnss.variance_m2[:-1, :2].mean(1) + gnss.variance_m2[1:, :2].mean(1))[moving] / 2 / mean_speed**2
    # One outlying fix spoils two pairs: the fourth fifth bears one in ten, yet sees tails that the median does not.
    spread_s = np.quantile(_make_windows(np.abs(residual_s)), 0.8, axis=1) / 1.2816
    claimed_s2 = _make_windows(claimed_s2).mean(1)
    excess_s2 = spread_s**2 / 2 - claimed_s2
    matters = excess_s2 > np.maximum(_MIN_JITTER_S**2, 4 * claimed_s2)
    middle_s = (0.5 * (stamp_s[1:] + stamp_s[:-1]))[moving]
    return np.interp(stamp_s, middle_s, np.sqrt(np.where(matters, excess_s2, 0.0)))


def add_jitter_variance(gnss: Positions, odometry: BodyVelocities, jitter_s: NDArray[np.float64]) -> Positions:
    """Return the fixes with horizontal variances raised by (2 speed jitter)².

    Twice, since such fixes are late and never early, by about as much on average as they spread, and one late fix follows another: they
    err together, which the filter, to which they are white, must not average away.
    """
    zero = int(gnss.stamp_ns[0])
    speed = np.abs(odometry.velocity_mps[:, 0])
    speed = np.interp(compute_seconds(gnss.stamp_ns, zero), compute_seconds(odometry.stamp_ns, zero), speed)
    variance = gnss.variance_m2.copy()
    variance[:, :2] += ((2 * speed * jitter_s) ** 2)[:, None]
    return replace(gnss, variance_m2=variance)


def _make_windows(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a window centred on each value, shape (N, 41), the signal mirrored at its ends."""
    padded = np.pad(values, _PAIRS // 2, mode="reflect")
    return np.lib.stride_tricks.sliding_window_view(padded, _PAIRS)
