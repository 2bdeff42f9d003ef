"""Sections of a run that are fused one by one, and what an estimator returns: state of base_link, its uncertainty, rejected measurements.

A clock epoch is a section of its own: nothing is integrated across a step of the clock. So is what follows a pause of all sensors of more
than 5 s: the estimator does not carry its certainty over it.

Both estimators are called alike::

    run_error_state(measurements, initial, *, output_ns, gate_probability, smooth=True) -> Trajectory
    run_ukf15(measurements, initial, *, output_ns, gate_probability) -> Trajectory

``output_ns`` are the wanted stamps, increasing, inside the span of the measurements.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import IMU, Measurements, select_measurements
from tcpipe.fusion.signals import compute_median_period_ns, is_in_gap
from tcpipe.tables.facts import StretchFacts

DISPLACEMENT_LAGS_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Durations over which a smoother states the uncertainty of a displacement [s]."""


@dataclass(frozen=True, slots=True)
class Rejections:
    """Measurements that the gate rejected, in time order.

    Attributes
    ----------
    stamp_ns : [ns], shape (M,), int64.
    role : shape (M,), str; gnss, gnss_velocity, imu, wheel_odometry or visual_odometry.
    reason : shape (M,), str; gate (chi-square), invalid (not finite) or covariance (unusable).
    normalized_innovation_squared : [1], shape (M,); NaN where it was not computed.
    threshold : [1], shape (M,), the gate; NaN where it was not computed.
    """

    stamp_ns: NDArray[np.int64]
    role: NDArray[np.str_]
    reason: NDArray[np.str_]
    normalized_innovation_squared: NDArray[np.float64]
    threshold: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """States of base_link at ``stamp_ns``.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64: exactly the wanted stamps.
    position_enu_m, position_std_m : [m], shape (N, 3).
    quat_xyzw : shape (N, 4), enu_from_base_link, unit length.
    velocity_enu_mps : [m/s], shape (N, 3), velocity of base_link.
    angular_velocity_radps : [rad/s], shape (N, 3), base_link axes.
    yaw_std_rad : [rad], shape (N,).
    forward_velocity_std_mps : [m/s], shape (N,), of the velocity along base_link's x axis.
    rejections : what the gate refused.
    displacement_std_m : [m], shape (N, 6), of the horizontal displacement from each row to the one `DISPLACEMENT_LAGS_S` later, along
        its direction, the correlation of both ends counted exactly; NaN where no row stands there, and throughout in a forward filter,
        which does not know it. In between the variance may be interpolated in time, from zero at no time.
    facts : what the filter counted and settled on.
    corrected : the measurements without what it found to be wrong with them; None: as they were.
    """

    stamp_ns: NDArray[np.int64]
    position_enu_m: NDArray[np.float64]
    quat_xyzw: NDArray[np.float64]
    velocity_enu_mps: NDArray[np.float64]
    angular_velocity_radps: NDArray[np.float64]
    position_std_m: NDArray[np.float64]
    yaw_std_rad: NDArray[np.float64]
    forward_velocity_std_mps: NDArray[np.float64]
    rejections: Rejections
    displacement_std_m: NDArray[np.float64]
    facts: StretchFacts
    corrected: Measurements | None = None


_PAUSE_NS = 5_000_000_000  # a longer pause begins a new section


@dataclass(frozen=True, slots=True)
class TrackSection:
    """One section: its clock epoch, first and last stamp [ns] of a motion measurement, and its measurements."""

    clock_epoch: int
    start_ns: int
    end_ns: int
    measurements: Measurements


def cut_sections(measurements: Mapping[int, Measurements], cuts_ns: Sequence[int] = ()) -> list[TrackSection]:
    """Return the sections of measurements given by clock epoch, in order of epoch and time; those without motion are left out.

    A section ends at a pause, and before each of the stamps ``cuts_ns`` of a measurement.
    """
    found = []
    for epoch in sorted(measurements):
        whole = measurements[epoch]
        stamp = _make_stamps(whole, with_imu=True)
        if stamp.size == 0:
            continue
        pause = np.flatnonzero((np.diff(stamp) > _PAUSE_NS) | np.isin(stamp[1:], cuts_ns))
        first = stamp[np.concatenate(([0], pause + 1))]
        last = stamp[np.concatenate((pause, [stamp.size - 1]))]
        for start, end in zip(first.tolist(), last.tolist(), strict=True):
            inside = select_measurements(whole, start, end)
            motion = _make_stamps(inside, with_imu=False)
            if motion.size > 1:
                found.append(TrackSection(epoch, int(motion[0]), int(motion[-1]), inside))
    return found


def make_track_stamps(section: TrackSection, *, period_ns: int, max_gap_ns: int) -> NDArray[np.int64]:
    """Return the multiples of the period inside a section [ns], without those in a gap.

    A gap is a time without any of GNSS, wheels and visual odometry longer than ``max_gap_ns`` and than 2.5 times their usual spacing:
    the IMU alone does not determine a track. A gap is a step in the stamps.
    """
    first = -(-section.start_ns // period_ns) * period_ns
    stamp = np.arange(first, section.end_ns + 1, period_ns, dtype=np.int64)
    motion = _make_stamps(section.measurements, with_imu=False)
    longest = max(max_gap_ns, int(2.5 * compute_median_period_ns(motion)))
    return stamp[~is_in_gap(motion, stamp, stamp, longest_ns=longest)]


def _make_stamps(measurements: Measurements, *, with_imu: bool) -> NDArray[np.int64]:
    stamps = [sensor.stamp_ns for role, sensor in measurements.sensors().items() if with_imu or role != IMU]
    return np.unique(np.concatenate(stamps)) if stamps else np.empty(0, np.int64)
