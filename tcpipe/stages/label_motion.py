"""How the robot moved over every segment of one epoch: its turn, attitude, slip and vibration."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.cost.labels import Labels
from tcpipe.fusion.measurements import IMU
from tcpipe.fusion.process import gyro_density
from tcpipe.fusion.signals import median_period_ns, white_noise
from tcpipe.geometry.piecewise_linear import interpolate, mean_between
from tcpipe.motion.vibration import vibration_mps2
from tcpipe.tables.arrays import rows_where
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.levels import Streams, TrackInfo

Arrays = dict[str, NDArray[np.float64]]

_ROLLING_MPS = 0.05
"""Wheels slower than this stand: no slip can be told."""
_GRAVITY_BAND_MPS2 = (8.0, 12.0)
"""Of the median specific force: another one is of another unit, or without gravity, and its vibration is not known."""


def motion_columns(cut: pa.Table, rows: pa.Table, streams: Streams, info: TrackInfo, cost: Labels) -> Arrays:
    """Return the columns `tcpipe.tables.segment_columns.MOTION_COLUMNS` of one epoch's segments, shape (M,) each.

    Parameters
    ----------
    cut, rows : the epoch's segments, and its rows of the gated track.
    streams : for the IMU's samples.
    cost : of the segments, for how sure their velocity is.
    """
    epoch = int(integers(cut, "epoch")[0])
    imu = rows_where(streams.tables["imu"], "epoch", epoch) if "imu" in streams.tables else None
    spans = integers(cut, "start_ns"), integers(cut, "end_ns")
    return {
        **_turns(cut, rows, imu, info),
        **_attitude(rows, spans[0] + (spans[1] - spans[0]) // 2),
        **_slip(cut, rows, cost),
        "vibration_mps2": _vibration(imu, *spans),
    }


def _turns(cut: pa.Table, rows: pa.Table, imu: pa.Table | None, info: TrackInfo) -> Arrays:
    stamp_ns, start_ns, end_ns = integers(rows, "stamp_ns"), integers(cut, "start_ns"), integers(cut, "end_ns")
    yaw_rad = np.unwrap(floats(rows, "yaw_rad"))
    turn_rad = interpolate(stamp_ns, yaw_rad, end_ns) - interpolate(stamp_ns, yaw_rad, start_ns)
    duration_s, arc_m = (end_ns - start_ns) * 1e-9, floats(cut, "arc_length_m")
    std_rad = np.sqrt(_turn_density(cut, imu, info) * duration_s)
    return {
        "turn_rad": turn_rad,
        "turn_std_rad": std_rad,
        "turn_rate_radps": mean_between(stamp_ns, np.abs(floats(rows, "yaw_rate_radps")), start_ns, end_ns),
        "turn_rate_std_radps": std_rad / duration_s,
        "curvature_radpm": turn_rad / arc_m,
        "curvature_std_radpm": std_rad / arc_m,
    }


def _turn_density(cut: pa.Table, imu: pa.Table | None, info: TrackInfo) -> NDArray[np.float64]:
    """Return how fast the variance of a turn grows [rad²/s], shape (M,): over a metre the gyroscope alone tells it.

    NaN without a gyroscope, and in a forward filter, whose yaw moves with every measurement.

    Positions and odometry hold the yaw itself; of how it changes within a second they tell far less.
    """
    start_ns, density = integers(cut, "start_ns"), np.full(cut.num_rows, np.nan)
    facts = info.report.facts.fuse
    if imu is None or imu.num_rows < 2 or facts is None or info.estimator != "smoother":
        return density
    rate_hz = 1e9 / median_period_ns(np.unique(integers(imu, "stamp_ns")))
    epoch = int(integers(cut, "epoch")[0])
    for each in facts.stretches:
        if each.epoch == epoch and IMU in each.sensors and each.gyro_noise_radps is not None:
            mine = (start_ns >= each.start_ns) & (start_ns <= each.end_ns)
            density[mine] = gyro_density(each.gyro_noise_radps, rate_hz)
    return density


def _attitude(rows: pa.Table, middle_ns: NDArray[np.int64]) -> Arrays:
    stamp_ns = integers(rows, "stamp_ns")
    return {name: interpolate(stamp_ns, floats(rows, name), middle_ns) for name in ("roll_rad", "pitch_rad")}


def _slip(cut: pa.Table, rows: pa.Table, cost: Labels) -> Arrays:
    """Return the slip, and how sure it is: of the way over ground, and of the wheels' white noise."""
    stamp_ns, wheel_mps = integers(rows, "stamp_ns"), floats(rows, "wheel_velocity_mps")
    mean_mps = mean_between(stamp_ns, wheel_mps, integers(cut, "start_ns"), integers(cut, "end_ns"))
    rolling_mps = np.where(np.abs(mean_mps) > _ROLLING_MPS, mean_mps, np.nan)
    ratio = floats(cut, "fused_velocity_mps") / rolling_mps
    noise_mps = white_noise(wheel_mps[np.isfinite(wheel_mps), None])
    period_s = median_period_ns(stamp_ns) * 1e-9
    wheel_std_mps = noise_mps * np.sqrt(period_s / cost.duration_s)
    relative = np.hypot(cost.velocity_std_mps / cost.velocity_mps, wheel_std_mps / rolling_mps)
    return {"slip_fraction": 1.0 - ratio, "slip_std_fraction": np.abs(ratio) * relative}


def _vibration(imu: pa.Table | None, start_ns: NDArray[np.int64], end_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    unknown = np.full(len(start_ns), np.nan)
    if imu is None:
        return unknown
    force = np.column_stack([floats(imu, f"linear_acceleration_{axis}_mps2") for axis in "xyz"])
    told = np.isfinite(force).all(axis=1)
    low, high = _GRAVITY_BAND_MPS2
    if not told.any() or not low <= float(np.median(np.linalg.norm(force[told], axis=1))) <= high:
        return unknown
    return vibration_mps2(integers(imu, "stamp_ns")[told], force[told], start_ns, end_ns)
