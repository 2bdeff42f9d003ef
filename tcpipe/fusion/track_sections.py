"""Cutting a run into stretches that are fused one by one, and the stamps of the track in each.

A clock epoch is a stretch of its own: nothing is integrated across a step of the clock. So is what follows a pause of all sensors
longer than 5 s (a paused recording): whatever happened meanwhile, the estimator does not carry its certainty over.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import IMU, Measurements, select_measurements
from tcpipe.fusion.signals import compute_median_period_ns, is_in_gap

_PAUSE_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class TrackSection:
    """One stretch: its clock epoch, first and last stamp [ns] of a motion measurement, and its measurements."""

    clock_epoch: int
    start_ns: int
    end_ns: int
    measurements: Measurements


def cut_stretches(measurements: Mapping[int, Measurements]) -> list[TrackSection]:
    """Return the stretches of measurements given by clock epoch, in order of epoch and time; those without motion are left out."""
    found = []
    for epoch in sorted(measurements):
        whole = measurements[epoch]
        stamp = _make_stamps(whole, with_imu=True)
        if stamp.size == 0:
            continue
        pause = np.flatnonzero(np.diff(stamp) > _PAUSE_NS)
        first = stamp[np.concatenate(([0], pause + 1))]
        last = stamp[np.concatenate((pause, [stamp.size - 1]))]
        for start, end in zip(first.tolist(), last.tolist(), strict=True):
            inside = select_measurements(whole, start, end)
            motion = _make_stamps(inside, with_imu=False)
            if motion.size > 1:
                found.append(TrackSection(epoch, int(motion[0]), int(motion[-1]), inside))
    return found


def track_stamps(stretch: TrackSection, *, period_ns: int, max_gap_ns: int) -> NDArray[np.int64]:
    """Return the multiples of the period inside a stretch [ns], those left out that lie in a gap of motion measurements.

    A gap is a time without any of GNSS, wheels and visual odometry longer than ``max_gap_ns`` and than 2.5 times their usual spacing:
    the IMU alone does not bear a track. A gap is a step in the stamps.
    """
    first = -(-stretch.start_ns // period_ns) * period_ns
    stamp = np.arange(first, stretch.end_ns + 1, period_ns, dtype=np.int64)
    motion = _make_stamps(stretch.measurements, with_imu=False)
    longest = max(max_gap_ns, int(2.5 * compute_median_period_ns(motion)))
    return stamp[~is_in_gap(motion, stamp, stamp, longest_ns=longest)]


def _make_stamps(measurements: Measurements, *, with_imu: bool) -> NDArray[np.int64]:
    stamps = [sensor.stamp_ns for role, sensor in measurements.sensors().items() if with_imu or role != IMU]
    return np.unique(np.concatenate(stamps)) if stamps else np.empty(0, np.int64)
