"""Everything that happens to the error-state filter, sorted by time: measurements, constraints, and the stamps that are wanted.

Late messages are no problem offline: events are sorted by stamp of measurement. The IMU is not an event but an input: each event
carries the mean angular velocity and specific force since the event before, integrated through the IMU's samples. So the filter takes
one step from event to event, at most 50 ms, whatever the IMU's rate.

Constraints are events of our own making:

- sideways and vertical body velocity are about zero (a wheeled robot), folded into the wheels' events, else 10 times a second. The
  error of this constraint (side slip, a lever arm to the turning centre) lasts, so it must not be counted as white at 50 Hz with a
  small deviation: that locks GNSS out. Its information is that of 0.15 m/s ten times a second, whatever the wheels' rate; so is that of
  the wheels themselves, as far as they claim a larger variance than they scatter by: such an error, slip, lasts as well.
- a receiver's own velocity errs alike for a while (its filter, multipath): it counts once in three seconds, whatever its rate.
- standing (`tcpipe.fusion.initial`): zero velocity, and the gyroscope shows its bias, five times a second.
- level, where no accelerometer tells up from down: roll and pitch are small. A slope lasts, so 20° are counted once in four seconds: as 40°
  once a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion import state_kernel as kernel
from tcpipe.fusion.initial import compute_course_rate
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements
from tcpipe.fusion.process import (
    DOPPLER_LASTS_S,
    UNSEEN_TURN_RADPS,
    estimate_shake_density,
    is_gliding,
    level_stds_rad,
    turn_sources,
)
from tcpipe.fusion.signals import compute_interval_means, compute_median_period_ns, compute_seconds, is_covered

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_MAX_STEP_NS = 50_000_000  # longest step: one row
_NONHOLONOMIC_HZ = 10.0  # rate of the sideways constraint
_MOVING_MPS = 0.05  # slower is stationary (ruling)
_UNSEEN_TURN_S = 1.0  # duration of `process.UNSEEN_TURN_RADPS`
_MEDIAN_OF_SQUARES = 0.4549  # of a normal variable of variance 1
_STANDING_NS = 200_000_000  # spacing of stationary updates
_STANDING_STD_MPS = 0.01  # rocking of a stationary robot
_LEVEL_NS = 1_000_000_000  # spacing of level updates without sensors
_PIECE = 1 << 15


@dataclass(frozen=True, slots=True)
class EventTimeline:
    """Events in order of time, as `tcpipe.fusion.error_state_kernel.filter_block` takes them.

    Attributes
    ----------
    stamp_ns : [ns], shape (E,). dt_s : [s], since the event before. kind, mode : see the kernel.
    shake_m2ps3 : noise density of the velocity, shape (E,), see `tcpipe.fusion.process`.
    value, variance : shape (E, 3); unused entries are 0 and 1.
    turn_rate_radps, force_mps2 : mean over the time since the event before, shape (E, 3).
    turn_rate_now_radps : at the event, shape (E, 3).
    output : row of the wanted stamps, or -1.
    output_rate_radps : angular velocity around each wanted stamp, shape (N, 3), bias not taken off; and whether a gyroscope says so.
    """

    stamp_ns: Ints
    dt_s: Floats
    kind: NDArray[np.int8]
    mode: NDArray[np.int8]
    shake_m2ps3: Floats
    value: Floats
    variance: Floats
    turn_rate_radps: Floats
    force_mps2: Floats
    turn_rate_now_radps: Floats
    output: Ints
    output_rate_radps: Floats
    output_has_gyro: NDArray[np.bool_]


def build_timeline(measurements: Measurements, stationary_ns: Ints, output_ns: Ints) -> EventTimeline:
    """Merge measurements of one section, constraints and wanted stamps [ns]; ``stationary_ns`` [ns], shape (K, 2), are stops."""
    parts = _make_measured_parts(measurements)
    start = min(int(part[0][0]) for part in parts if part[0].size)
    end = max(int(part[0][-1]) for part in parts if part[0].size)
    parts += _make_constraints(measurements, stationary_ns, start, end)
    parts.append(_make_plain_part(output_ns, kernel.PREDICT))
    parts.append(_make_plain_part(_make_filler_stamps(np.concatenate([part[0] for part in parts])), kernel.PREDICT))
    stamp = np.concatenate([part[0] for part in parts])
    kind = np.concatenate([np.full(part[0].size, part[1], np.int8) for part in parts])
    output = np.full(stamp.size, -1, np.int64)
    fillers = parts[-1][0].size
    output[stamp.size - fillers - output_ns.size : stamp.size - fillers] = np.arange(output_ns.size)
    # Wanted stamps come last among events of one stamp: they see every measurement of their time.
    order = np.lexsort((np.where(output >= 0, 1, 0), stamp))
    stamp, kind, output = stamp[order], kind[order], output[order]
    before = np.concatenate((stamp[:1], stamp[:-1]))
    rate, force, mode = _make_inputs(measurements, before, stamp, start)
    rate_now, _ = _turn_rates(measurements, stamp, stamp, start)
    half = (compute_median_period_ns(output_ns) if output_ns.size > 1 else _MAX_STEP_NS) // 2
    around, around_mode = _turn_rates(measurements, output_ns - half, output_ns + half, start)
    return EventTimeline(
        stamp,
        np.asarray(stamp - before, np.float64) * 1e-9,
        kind,
        mode,
        estimate_shake_density(measurements, stamp, mode),
        np.concatenate([part[2] for part in parts])[order],
        np.concatenate([part[3] for part in parts])[order],
        rate,
        force,
        rate_now,
        output,
        around,
        around_mode >= kernel.GYRO_TURN,
    )


_Part = tuple[Ints, int, Floats, Floats]


def _make_plain_part(stamp_ns: Ints, kind: int) -> _Part:
    return stamp_ns, kind, np.zeros((stamp_ns.size, 3)), np.ones((stamp_ns.size, 3))


def _make_constant_part(stamp_ns: Ints, kind: int, std: tuple[float, float, float]) -> _Part:
    return stamp_ns, kind, np.zeros((stamp_ns.size, 3)), np.tile(np.square(std), (stamp_ns.size, 1))


def _make_measured_parts(measurements: Measurements) -> list[_Part]:
    parts: list[_Part] = []
    gnss, wheels, visual = measurements.gnss, measurements.wheels, measurements.visual
    if gnss is not None and gnss.stamp_ns.size:
        parts.append((gnss.stamp_ns, kernel.GNSS_POSITION, gnss.position_enu_m, gnss.variance_m2))
    if wheels is not None and wheels.stamp_ns.size:
        parts.append(_make_wheel_part(wheels, measurements.nonholonomic_std_mps))
    if visual is not None and visual.stamp_ns.size:
        flat = measurements.imu is None and visual.turn_rate_radps is None
        variance = visual.variance_m2ps2 + (
            _compute_unseen_turn_variance(visual.stamp_ns, visual.lever_arm_m) if flat else 0.0
        )
        parts.append((visual.stamp_ns, kernel.VISUAL_VELOCITY, visual.velocity_mps, variance))
    doppler = measurements.doppler
    if gnss is not None and doppler is not None and doppler.stamp_ns.size:
        variance = doppler.variance_m2ps2 * max(1.0, DOPPLER_LASTS_S * 1e9 / compute_median_period_ns(doppler.stamp_ns))
        if measurements.imu is None and (visual is None or visual.turn_rate_radps is None):
            variance = variance + _compute_unseen_turn_variance(doppler.stamp_ns, gnss.lever_arm_m)
        parts.append((doppler.stamp_ns, kernel.GNSS_VELOCITY, doppler.velocity_enu_mps, variance))
    return parts


def _compute_unseen_turn_variance(stamp_ns: Ints, lever_arm_m: tuple[float, float, float]) -> Floats:
    """Variance [m²/s²], shape (3,), that turns which no sensor measures cause at a sensor off base_link; they last, as the ground does."""
    rate_hz = 1e9 / compute_median_period_ns(stamp_ns)
    x, y, z = np.square(lever_arm_m)
    lasting: Floats = np.array([z, z, x + y]) * UNSEEN_TURN_RADPS**2 * max(1.0, rate_hz * _UNSEEN_TURN_S)
    return lasting


def _make_wheel_part(wheels: BodyVelocities, nonholonomic_std_mps: float) -> _Part:
    """Take what the wheels' samples scatter by as white, and what their variance claims beyond that as an error that lasts."""
    rate_hz = 1e9 / compute_median_period_ns(wheels.stamp_ns) if wheels.stamp_ns.size > 1 else _NONHOLONOMIC_HZ
    together = max(1.0, rate_hz / _NONHOLONOMIC_HZ)
    value = np.zeros_like(wheels.velocity_mps)
    variance = np.full_like(value, nonholonomic_std_mps**2 * together)
    claimed = wheels.variance_m2ps2[:, 0]
    white = np.minimum(claimed, _estimate_white_variance(wheels.velocity_mps[:, 0]))
    value[:, 0], variance[:, 0] = wheels.velocity_mps[:, 0], white + (claimed - white) * together
    return wheels.stamp_ns, kernel.WHEEL_VELOCITY, value, variance


def _estimate_white_variance(velocity_mps: Floats) -> float:
    """Estimate the variance of a moving wheel's white noise by the median of squared second differences, which wild ones do not move."""
    second = np.diff(velocity_mps, n=2)
    moving = (np.abs(velocity_mps) > _MOVING_MPS)[1:-1]
    return float(np.median(second[moving] ** 2) / (6 * _MEDIAN_OF_SQUARES)) if moving.sum() > 1 else 0.0


def _make_constraints(measurements: Measurements, stationary_ns: Ints, start: int, end: int) -> list[_Part]:
    parts: list[_Part] = []
    if is_gliding(measurements):  # which way the body looks is not known
        return parts
    if measurements.wheels is None or measurements.wheels.stamp_ns.size == 0:
        grid = np.arange(start, end, int(1e9 / _NONHOLONOMIC_HZ), dtype=np.int64)
        std = measurements.nonholonomic_std_mps
        parts.append((grid, kernel.SIDEWAYS, np.zeros((grid.size, 3)), np.tile([std**2, std**2, 1.0], (grid.size, 1))))
    imu = measurements.imu
    if imu is None or not imu.accelerometer_usable:
        grid = np.arange(start, end, _LEVEL_NS, dtype=np.int64)
        parts.append(_make_constant_part(grid, kernel.LEVEL, (*level_stds_rad(measurements), 1.0)))
    if imu is not None and stationary_ns.size:
        grid = np.concatenate([np.arange(a, b, _STANDING_NS, dtype=np.int64) for a, b in stationary_ns])
        grid = grid[(grid >= start) & (grid <= end)]
        parts.append(_make_constant_part(grid, kernel.STANDING, (_STANDING_STD_MPS,) * 3))
        parts.append(_make_stationary_part(imu, grid))
    return parts


def _make_stationary_part(imu: InertialMeasurements, grid: Ints) -> _Part:
    """Measure the gyroscope's bias of a stationary robot by its mean around each stamp."""
    zero = int(imu.stamp_ns[0])
    stamp_s, centre_s = compute_seconds(imu.stamp_ns, zero), compute_seconds(grid, zero)
    half_s = 0.5e-9 * _STANDING_NS
    bias = compute_interval_means(stamp_s, imu.angular_velocity_radps, centre_s - half_s, centre_s + half_s)
    samples = max(1.0, _STANDING_NS / compute_median_period_ns(imu.stamp_ns))
    variance = imu.gyro_std_radps**2 / samples + 5e-4**2
    return grid, kernel.STANDING_RATE, bias, np.full((grid.size, 3), variance)


def _make_filler_stamps(stamp_ns: Ints) -> Ints:
    """Stamps that split every step longer than the longest allowed."""
    stamp = np.unique(stamp_ns)
    step = np.diff(stamp)
    pieces = -(-step // _MAX_STEP_NS)
    wide = np.flatnonzero(pieces > 1)
    count = pieces[wide] - 1
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + 1
    filled: Ints = np.repeat(stamp[wide], count) + within * np.repeat(step[wide] // pieces[wide], count)
    return filled


def _make_inputs(
    measurements: Measurements, before_ns: Ints, after_ns: Ints, zero_ns: int
) -> tuple[Floats, Floats, NDArray[np.int8]]:
    """Mean angular velocity and specific force over each interval, and the process mode they allow: the best source that covers it."""
    rate, mode = _turn_rates(measurements, before_ns, after_ns, zero_ns)
    force = np.zeros((before_ns.size, 3))
    imu = measurements.imu
    if imu is not None and imu.accelerometer_usable:
        felt = mode == kernel.GYRO_TURN
        force[felt] = _compute_interval_means(imu, imu.specific_force_mps2, before_ns[felt], after_ns[felt], zero_ns)
        mode[felt] = kernel.INERTIAL
    return rate, force, mode


def _turn_rates(
    measurements: Measurements, before_ns: Ints, after_ns: Ints, zero_ns: int
) -> tuple[Floats, NDArray[np.int8]]:
    """Mean angular velocity over each interval by the best source that covers it, and the process mode that goes with it."""
    imu = measurements.imu
    if imu is None or imu.stamp_ns.size == 0:
        return _compute_odometric_turn_rate(measurements, before_ns, after_ns, zero_ns)
    rate, mode = np.zeros((before_ns.size, 3)), np.full(before_ns.size, kernel.GYRO_TURN, np.int8)
    covered = is_covered(imu.stamp_ns, before_ns, after_ns)
    rate[covered] = _compute_interval_means(
        imu, imu.angular_velocity_radps, before_ns[covered], after_ns[covered], zero_ns
    )
    rate[~covered], mode[~covered] = _compute_odometric_turn_rate(
        measurements, before_ns[~covered], after_ns[~covered], zero_ns
    )
    return rate, mode


def _compute_interval_means(
    imu: InertialMeasurements, values: Floats, before_ns: Ints, after_ns: Ints, zero_ns: int
) -> Floats:
    """Mean of an IMU's signal over each interval; these are in order and go piece by piece: a long log takes little room."""
    found = np.empty((before_ns.size, 3))
    for first in range(0, before_ns.size, _PIECE):
        piece = slice(first, first + _PIECE)
        begin, end = before_ns[piece], after_ns[piece]
        low, high = np.searchsorted(imu.stamp_ns, (begin[0], end[-1]))
        rows = slice(max(low - 1, 0), high + 1)
        stamp_s = compute_seconds(imu.stamp_ns[rows], zero_ns)
        found[piece] = compute_interval_means(
            stamp_s, values[rows], compute_seconds(begin, zero_ns), compute_seconds(end, zero_ns)
        )
    return found


def _compute_odometric_turn_rate(
    measurements: Measurements, before_ns: Ints, after_ns: Ints, zero_ns: int
) -> tuple[Floats, NDArray[np.int8]]:
    """Mean angular velocity by the odometries, shape (M, 3), and the process mode; by the course over ground where there are none."""
    rate = np.zeros((before_ns.size, 3))
    mode = np.full(before_ns.size, kernel.FLAT_TURN, np.int8)
    start_s, end_s = compute_seconds(before_ns, zero_ns), compute_seconds(after_ns, zero_ns)
    sources = turn_sources(measurements)
    odometry = next(iter(measurements.odometries().values()), None)
    if not sources and measurements.gnss is not None and not is_gliding(measurements):
        stamp_s, values = compute_course_rate(measurements.gnss, odometry, zero_ns)
        rate[:, 2] = compute_interval_means(stamp_s, values[:, None], start_s, end_s)[:, 0]
    for rank, source in enumerate(sources):
        known = np.isfinite(source.yaw_rate_radps)
        turns = source.turn_rate_radps
        values = np.stack((0 * source.yaw_rate_radps,) * 2 + (source.yaw_rate_radps,), -1) if turns is None else turns
        inside = is_covered(source.stamp_ns[known], before_ns, after_ns) | (rank == 0)
        stamp_s = compute_seconds(source.stamp_ns[known], zero_ns)
        rate[inside] = compute_interval_means(stamp_s, values[known], start_s[inside], end_s[inside])
        mode[inside] = kernel.VISUAL_TURN if source is measurements.visual else kernel.FLAT_TURN
    return rate, mode
