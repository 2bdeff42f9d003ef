"""How fixes err: what scatters from one to the next, and what lasts.

A receiver's covariance is one number for both. Their difference is what matters: the part that scatters averages out, the part that lasts
(a float solution's ambiguities, satellite-based corrections, multipath) moves a track with it. Fixes are laid, over twenty seconds, on the
path that odometry and gyroscope draw, by rotation, scale and the bend of a gyroscope's bias. Second differences of what is left are the
white part. Where it is a quarter of the claimed variance or less, the rest of the claim lasts; where it is far more, it counts instead.
What is left itself, where it is far more than claimed, is an error that lasts and was not claimed. Where a receiver claims nothing, the
scatter is the white part, and nothing lasts but where the fixes bend off the path by more than an odometry does in twenty seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import Measurements, Positions
from tcpipe.fusion.process import turn_sources
from tcpipe.fusion.signals import compute_median_period_ns, compute_seconds, integrate_signal

Floats = NDArray[np.float64]

_BLOCK_S = 20.0
_FEWEST = 15
_WINDOW_S = 6.0
_LITTLE = 0.25
_FAR_MORE = 6.0
_UNCLAIMED = 3.0
_DRAWN_HOLDS_M = 0.15
_SHARE_SEEN = 6.0
_BENDS_M, _LEAST_M = 0.09, 0.01
_FLOAT_M = 0.5
_LASTS_S, _METRES_LAST_S = 45.0, 120.0
_LARGE_M = 0.03
_SQUARES_OF_TWO = 1.3863
_SQUARES_OF_ONE = 0.4549


@dataclass(frozen=True, slots=True)
class FixErrors:
    """Errors of fixes: variances [m²] of the white part and of the part that lasts, shape (N, 3), and how long that lasts [s], (N,)."""

    white_m2: Floats
    lasting_m2: Floats
    lasts_s: Floats

    @property
    def matters(self) -> bool:
        """Whether the part that lasts is larger anywhere than what odometry holds over seconds, and is not one of metres throughout."""
        return bool((self.lasting_m2[:, :2] > _LARGE_M**2).any()) and not self.of_metres

    @property
    def of_metres(self) -> bool:
        """Whether an error of half a metre or more lasts most of the time."""
        return float(np.median(self.lasting_m2[:, 0])) > _FLOAT_M**2


def find_fix_errors(measurements: Measurements) -> FixErrors | None:
    """Return the errors of the fixes; None without any."""
    gnss = measurements.gnss
    if gnss is None or gnss.stamp_ns.size == 0:
        return None
    claimed = gnss.variance_m2
    white, lasting = claimed.copy(), np.zeros_like(claimed)
    drawn = _draw_path(measurements, gnss)
    left = _compute_residual_path(gnss, drawn)
    scatter = np.empty_like(claimed)
    second = _compute_second_differences(left)
    scatter[:, 0] = scatter[:, 1] = _compute_rolling_median(gnss, second) / (6 * _SQUARES_OF_TWO)
    scatter[:, 2] = _compute_rolling_median(gnss, _compute_second_differences(gnss.position_enu_m[:, 2])) / (
        6 * _SQUARES_OF_ONE
    )
    least = np.minimum(np.maximum(0.01 * claimed, _LEAST_M**2), claimed)  # a robot that stands does not show it
    little = scatter < _LITTLE * claimed
    white[little] = np.maximum(scatter, least)[little]
    lasting[little] = np.minimum(claimed - scatter, 0.99 * claimed)[little]
    if drawn is not None and gnss.unclaimed is not None:
        unclaimed = gnss.unclaimed & np.isfinite(scatter).all(1)
        white[unclaimed] = np.maximum(scatter, _LEAST_M**2)[unclaimed]
        lasting[unclaimed] = _compute_bends(gnss, np.abs(left) ** 2)[unclaimed]
    if drawn is not None:
        much = scatter > _FAR_MORE * claimed
        white[much] = scatter[much]
        wander_m2 = float(np.nanmedian(np.abs(left) ** 2)) / _SQUARES_OF_TWO if np.isfinite(left).any() else 0.0
        if wander_m2 > max(_UNCLAIMED**2 * float(np.median(claimed[:, 0])), _DRAWN_HOLDS_M**2):
            white = np.maximum(scatter, least)
            lasting[:] = np.maximum(lasting, _SHARE_SEEN**2 * wander_m2)
    lasts_s = np.where(lasting[:, 0] > _FLOAT_M**2, _METRES_LAST_S, _LASTS_S)
    return FixErrors(white, lasting, lasts_s)


def _compute_bends(gnss: Positions, left_m2: Floats) -> Floats:
    """Return what lasts of fixes that claim nothing: where they bend off the drawn path by more than an odometry does, shape (N, 3)."""
    wander_m2 = _compute_rolling_median(gnss, left_m2, _BLOCK_S) / _SQUARES_OF_TWO
    seen = np.where(wander_m2 > _BENDS_M**2, _SHARE_SEEN**2 * wander_m2, 0.0)
    return np.asarray(seen[:, None] * np.array([1.0, 1.0, 4.0]))


def _draw_path(measurements: Measurements, gnss: Positions) -> NDArray[np.complex128] | None:
    """Return the antenna's places as odometry and turn rates draw them, from any yaw; None where they do not."""
    odometries = list(measurements.odometries().values())
    imu, sources = measurements.imu, turn_sources(measurements)
    if not odometries or (imu is None and not sources):
        return None
    zero = int(gnss.stamp_ns[0])
    source = odometries[-1]
    if imu is not None:
        turn_s, turn = compute_seconds(imu.stamp_ns, zero), imu.angular_velocity_radps[:, 2:]
    else:
        known = np.isfinite(sources[-1].yaw_rate_radps)
        turn_s, turn = compute_seconds(sources[-1].stamp_ns[known], zero), sources[-1].yaw_rate_radps[known, None]
    at_s, driven_s = compute_seconds(gnss.stamp_ns, zero), compute_seconds(source.stamp_ns, zero)
    yaw = integrate_signal(turn_s, turn, driven_s)[:, 0]
    velocity = source.velocity_mps[:, :1] * np.stack((np.cos(yaw), np.sin(yaw)), -1)
    places = integrate_signal(driven_s, velocity, at_s) @ np.array([1.0, 1j])
    lever = complex(*gnss.lever_arm_m[:2])
    return np.asarray(places + lever * np.exp(1j * integrate_signal(turn_s, turn, at_s)[:, 0]), np.complex128)


def _compute_residual_path(gnss: Positions, drawn: NDArray[np.complex128] | None) -> NDArray[np.complex128]:
    """Return what is left of the fixes, east and i times north [m], when the drawn path is laid on them block by block; NaN in between."""
    places = gnss.position_enu_m[:, :2] @ np.array([1.0, 1j])
    at_s = compute_seconds(gnss.stamp_ns, int(gnss.stamp_ns[0]))
    length_s = max(_BLOCK_S, _FEWEST * 1e-9 * compute_median_period_ns(gnss.stamp_ns))
    left = np.full(places.size, np.nan + 0j)
    for first_s in np.arange(0.0, at_s[-1], length_s):
        rows = slice(*np.searchsorted(at_s, (first_s, first_s + length_s)))
        if rows.stop - rows.start < _FEWEST:
            continue
        block = places[rows] - np.mean(places[rows])
        if drawn is not None:
            step = np.diff(drawn[rows], prepend=drawn[rows][:1])
            bent = np.cumsum(1j * (at_s[rows] - first_s) * step)  # by a gyroscope's bias
            columns = np.column_stack((np.ones(block.size), drawn[rows] - drawn[rows][0], bent))
            block = block - columns @ np.linalg.lstsq(columns, block, rcond=1e-6)[0]
        left[rows] = block
    return left


def _compute_second_differences(values: NDArray[np.complex128] | Floats) -> Floats:
    """Return the squared size of each second difference, NaN at the ends and beside NaN, shape (N,)."""
    squared = np.full(values.size, np.nan)
    squared[1:-1] = np.abs(np.diff(values, n=2)) ** 2
    return squared


def _compute_rolling_median(gnss: Positions, values: Floats, window_s: float = _WINDOW_S) -> Floats:
    """Return the median of the known values over some seconds around each fix, shape (N,); where none is known, that of all."""
    count = max(_FEWEST, round(window_s * 1e9 / compute_median_period_ns(gnss.stamp_ns)))
    known = np.flatnonzero(np.isfinite(values))
    if known.size < count:
        return np.full(values.size, np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(values[known], count)[:: max(1, count // 6)]
    medians = np.median(windows, axis=1)
    centres = known[count // 2 :][:: max(1, count // 6)][: medians.size]
    return np.asarray(np.interp(np.arange(values.size), centres, medians))
