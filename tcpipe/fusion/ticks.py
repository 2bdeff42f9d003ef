"""Measurements of a section by tick of the track: motion between ticks, and the mean of each sensor at each tick.

Ticks are the multiples of the track's period, or of a fraction of it of at most 50 ms. If a sensor measures several
times in a tick, values and stamps are averaged. All measurements are sorted by stamp of measurement, so messages that
arrive late need no special treatment.

tcpipe adds constraints as measurements: the turning centre of the robot moves neither sideways nor upward, and a
stationary robot (`tcpipe.fusion.initial`) has no velocity, so its gyroscope measures its bias. Without an
accelerometer, roll and pitch are small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints
from tcpipe.compiled import compile_kernel
from tcpipe.fusion import state
from tcpipe.fusion.densities import PRIORS, NoiseModel
from tcpipe.fusion.filter_kernel import FilterModel, Memory, Tests, TickInputs
from tcpipe.fusion.level_motion import COURSE, get_turn_rates
from tcpipe.fusion.measurements import IMU, MAX_VARIANCE, VISUAL, WHEELS, BodyVelocities, Measurements
from tcpipe.fusion.process import UNSEEN_TURN_RADPS, make_motion_noise
from tcpipe.fusion.signals import (
    compute_interval_means,
    compute_median_period_ns,
    compute_running_median,
    compute_seconds,
    compute_slopes,
    is_covered,
)
from tcpipe.fusion.state import Kind, Mode
from tcpipe.geometry.rotation import rotation_vector_from_quat
from tcpipe.robust import estimate_robust_std

_LONGEST_NS = 50_000_000
_STATIONARY_EVERY_S = 0.2


@dataclass(frozen=True, slots=True)
class Ticks:
    """Ticks of a section.

    Attributes
    ----------
    stamp_ns : [ns], shape (K,). inputs : inputs of the filter.
    rows : by kind of measurement, the tick of each row of its sensor; -1: none.
    fix_variance_m2 : variance of the fixes' correlated error at each tick [m²], (K, 3).
    """

    stamp_ns: Ints
    inputs: TickInputs
    rows: dict[int, Ints]
    fix_variance_m2: Floats


@dataclass(slots=True)
class Pass:
    """One forward pass over a section: its model, checkpoints and tests by tick."""

    ticks: Ticks
    model: FilterModel
    checkpoints: list[Memory]
    tests: Tests
    last: Memory


def find_tick_period_ns(period_ns: int) -> int:
    """Return the time between ticks [ns]: the track's period divided by an integer, at most 50 ms."""
    return period_ns // -(-period_ns // _LONGEST_NS)


def build_ticks(  # noqa: C901, PLR0915  one array after the other
    m: Measurements, noise: NoiseModel, stationary_ns: Ints, start_ns: int, end_ns: int, *, output_ns: Ints
) -> Ticks:
    """Return the ticks from before ``start_ns`` to after ``end_ns``; ``stationary_ns``, shape (S, 2), are stops [ns].

    Every output stamp (``output_ns``, multiples of the track's period) is a tick.
    """
    tick_ns = find_tick_period_ns(compute_median_period_ns(output_ns) if output_ns.size > 1 else _LONGEST_NS)
    stamp_ns = np.arange(start_ns // tick_ns, -(-end_ns // tick_ns) + 1, dtype=np.int64) * tick_ns
    period_s = tick_ns * 1e-9
    size = stamp_ns.size
    value = np.full((size, state.KINDS, 3), np.nan)
    variance, tau, levers = np.ones_like(value), np.zeros((size, state.KINDS)), np.zeros((state.KINDS, 3))
    rows: dict[int, Ints] = {}

    def add_means(kind: int, source_ns: Ints, values: Floats, variances: Floats) -> None:
        """Write the mean of a sensor's values, variances and time offsets at each tick."""
        tick = np.rint((source_ns - stamp_ns[0]) / tick_ns).astype(np.int64)
        inside = (tick >= 0) & (tick < size)
        rows[kind] = np.where(inside, tick, -1)
        tick, values, variances = tick[inside], values[inside], variances[inside]
        offset_s = (source_ns[inside] - stamp_ns[tick]) * 1e-9
        count = np.bincount(tick, minlength=size)
        has_samples, width = count > 0, values.shape[1]

        def mean(samples: Floats) -> Floats:
            return np.bincount(tick, samples, size)[has_samples] / count[has_samples]

        for axis in range(width):
            value[has_samples, kind, axis] = mean(values[:, axis])
            variance[has_samples, kind, axis] = mean(variances[:, axis]) / count[has_samples]
        tau[has_samples, kind] = mean(offset_s)

    for kind, role, source in ((Kind.WHEELS, WHEELS, m.wheels), (Kind.VISUAL, VISUAL, m.visual)):
        if source is not None:
            levers[kind] = source.lever_arm_m
            axes = 1 if kind == Kind.WHEELS else 3
            add_means(
                kind, source.stamp_ns, source.velocity_mps[:, :axes], _make_velocity_variance(m, source, noise, role)
            )
    fix_variance = np.zeros((size, 3))
    if m.gnss is not None:
        white, correlated = _compute_shares(noise)
        add_means(Kind.FIX, m.gnss.stamp_ns, m.gnss.position_enu_m, m.gnss.variance_m2 * white)
        nearest = np.searchsorted(m.gnss.stamp_ns, stamp_ns).clip(0, m.gnss.stamp_ns.size - 1)
        fix_variance = m.gnss.variance_m2[nearest] * correlated
    attitude = np.zeros((size, 3))
    if m.gnss is not None and m.gnss.quat_xyzw is not None and m.gnss.rotation_variance_rad2 is not None:
        measured = np.where(np.isfinite(m.gnss.quat_xyzw).all(1), rows[Kind.FIX], -1)
        known = np.flatnonzero(measured >= 0)
        tick, first = np.unique(measured[known], return_index=True)  # rotations are not averaged: one per tick
        chosen = known[first]
        attitude[tick] = rotation_vector_from_quat(m.gnss.quat_xyzw[chosen])
        add_means(
            Kind.ATTITUDE, m.gnss.stamp_ns[chosen], np.zeros((tick.size, 3)), m.gnss.rotation_variance_rad2[chosen]
        )
        rows[Kind.ATTITUDE] = measured
    if m.gnss is not None and m.doppler is not None:
        # Weight of an error with a correlation time of 1.5 s.
        lasting = max(1.0, 3.0 * 1e9 / compute_median_period_ns(m.doppler.stamp_ns))
        variances = m.doppler.variance_m2ps2 * lasting
        if not m.has_tilt:
            variances = variances + _compute_unseen_turn_variance(m.doppler.stamp_ns, m.gnss.lever_arm_m)
        add_means(Kind.DOPPLER, m.doppler.stamp_ns, m.doppler.velocity_enu_mps, variances)
    _add_constraints(m, stationary_ns, stamp_ns, value, variance, period_s=period_s)
    if m.wheels is not None:
        levers[Kind.SIDEWAYS] = m.wheels.lever_arm_m

    before_ns = stamp_ns - tick_ns
    turn_rate, mode = _find_turn_rates(m, before_ns, stamp_ns, int(stamp_ns[0]))
    rate, around = _find_turn_rates(m, stamp_ns - tick_ns // 2, stamp_ns + tick_ns // 2, int(stamp_ns[0]))
    turned, gained = np.zeros((size, 9)), np.zeros((size, 6))
    turned[:, :3] = turn_rate * period_s
    by_gyro = np.flatnonzero(mode == Mode.GYRO_TURN)
    if m.imu is not None and by_gyro.size:
        imu_s, end_s = compute_seconds(m.imu.stamp_ns, int(stamp_ns[0])), compute_seconds(stamp_ns, int(stamp_ns[0]))
        _preintegrate(
            imu_s, m.imu.angular_velocity_radps, m.imu.specific_force_mps2, end_s, period_s, by_gyro, turned, gained
        )
        if m.imu.accelerometer_usable:
            mode[by_gyro] = Mode.INERTIAL
    kept, fix_noise = _make_fix_process(noise, fix_variance, period_s)
    inputs = TickInputs(
        period_s,
        mode,
        turned,
        gained,
        make_motion_noise(m, noise, stamp_ns, mode, turn_rate, period_s),
        rate,
        around >= Mode.GYRO_TURN,
        _compute_acceleration(m, stamp_ns),
        value,
        variance,
        tau,
        levers,
        kept,
        fix_noise,
        attitude,
    )
    return Ticks(stamp_ns, inputs, rows, fix_variance)


def _compute_shares(noise: NoiseModel) -> tuple[Floats, Floats]:
    """Return the white and the correlated share of the claimed variance of fixes, each east, north, up."""
    axes = [fix for fix in (noise.horizontal, noise.horizontal, noise.vertical) if fix is not None]
    shares = np.array([(fix.white / fix.claimed_m2, fix.correlated.variance / fix.claimed_m2) for fix in axes])
    return shares[:, 0], shares[:, 1]


def _make_fix_process(noise: NoiseModel, variance_m2: Floats, period_s: float) -> tuple[Floats, Floats]:
    """Return the decay factor of the fixes' correlated error over each tick, and the variance added to it."""
    size = variance_m2.shape[0]
    if noise.horizontal is None:
        return np.ones(size), np.zeros((size, 3))
    before = np.concatenate((variance_m2[:1], variance_m2[:-1]))
    shrunk = np.sqrt(np.minimum(1.0, variance_m2[:, 0] / np.maximum(before[:, 0], 1e-12)))
    kept = np.exp(-period_s / noise.horizontal.correlated.time_s) * shrunk
    return kept, compute_process_noise(kept, variance_m2)


def compute_process_noise(kept: Floats, variance: Floats) -> Floats:
    """Return the variance added in each tick to a process with this variance and decay factor ``kept``, (K, 3)."""
    before = np.concatenate((variance[:1], variance[:-1]))
    return np.maximum(variance - kept[:, None] ** 2 * before, 0.0)


def _make_velocity_variance(m: Measurements, source: BodyVelocities, noise: NoiseModel, role: str) -> Floats:
    """Return each sample's variance: forward from the run, larger if its claim is unusual; other axes as claimed."""
    rate_hz = 1e9 / compute_median_period_ns(source.stamp_ns)
    claimed = source.variance_m2ps2
    found = claimed.copy()
    relative = claimed[:, 0] / np.median(claimed[:, 0])
    speed_mps, of_run = source.velocity_mps[:, 0], noise.odometries[role]
    # Scatter of the samples of a moving robot around their neighbours; the median ignores outliers.
    second = np.diff(speed_mps, n=2)[(np.abs(speed_mps) > 0.05)[1:-1]]
    scatter = estimate_robust_std(second) ** 2 / 6.0 if second.size > 1 else 0.0
    density = max(of_run.white, PRIORS[f"{role} velocity"].variance)  # lower bound for the mean of a tick
    found[:, 0] = max(density * rate_hz, scatter) * np.maximum(relative, 1.0)
    for axis in range(1, 3):
        if not np.isfinite(claimed[:, axis]).all() or np.ptp(source.velocity_mps[:, axis]) == 0.0:
            found[:, axis] = MAX_VARIANCE  # an axis that is always zero is a constraint, not a measurement
    flat = source.turn_rate_radps is None and m.imu is None and role == VISUAL
    if flat:
        found = found + _compute_unseen_turn_variance(source.stamp_ns, source.lever_arm_m)
    return found


def _compute_unseen_turn_variance(stamp_ns: Ints, lever_arm_m: tuple[float, float, float]) -> Floats:
    """Return the velocity variance [m²/s²], (3,), by unmeasured turns at a lever arm; such turns last for a second."""
    x, y, z = np.square(lever_arm_m)
    lasting = max(1.0, 1e9 / compute_median_period_ns(stamp_ns))
    return np.array([z, z, x + y]) * UNSEEN_TURN_RADPS**2 * lasting


def _add_constraints(
    m: Measurements, stationary_ns: Ints, stamp_ns: Ints, value: Floats, variance: Floats, *, period_s: float
) -> None:
    if m.is_antenna_alone:  # the direction of the body is unknown
        return
    value[:, Kind.SIDEWAYS, :2] = 0.0
    # Sideways velocities are independent after 16 ms; slower ones are in the states of turning centre and mounting.
    variance[:, Kind.SIDEWAYS, :2] = m.nonholonomic_std_mps**2 * 0.016 / period_s
    imu = m.imu
    if imu is None or not imu.accelerometer_usable:
        interval_ticks = max(1, round(1.0 / period_s))  # each second
        value[::interval_ticks, Kind.LEVEL, :2] = 0.0
        variance[::interval_ticks, Kind.LEVEL, :2] = 0.7**2  # rad²
    if imu is None or not stationary_ns.size:
        return
    inside = np.zeros(stamp_ns.size, np.bool_)
    for first, last in stationary_ns:
        inside[np.searchsorted(stamp_ns, first) : np.searchsorted(stamp_ns, last)] = True
    rows = np.flatnonzero(inside)
    rows = rows[rows % max(1, round(_STATIONARY_EVERY_S / period_s)) == 0]
    zero = int(stamp_ns[0])
    at_s, half_s = compute_seconds(stamp_ns[rows], zero), 0.5 * _STATIONARY_EVERY_S
    samples = max(1.0, _STATIONARY_EVERY_S * 1e9 / compute_median_period_ns(imu.stamp_ns))
    value[rows, Kind.STATIONARY] = 0.0
    variance[rows, Kind.STATIONARY] = 0.01**2  # m²/s²: a stationary robot rocks
    imu_s = compute_seconds(imu.stamp_ns, zero)
    value[rows, Kind.STATIONARY_RATE] = compute_interval_means(
        imu_s, imu.angular_velocity_radps, at_s - half_s, at_s + half_s
    )
    variance[rows, Kind.STATIONARY_RATE] = imu.gyro_std_radps**2 / samples + 5e-4**2


@compile_kernel
def _preintegrate(  # noqa: PLR0917, C901  compiled
    t: Floats, w: Floats, f: Floats, ends: Floats, period_s: float, wanted: Ints, turned: Floats, gained: Floats
) -> None:
    """Fill rotation, velocity and displacement over the tick before each end, of linear samples (s, rad/s, m/s²)."""
    r, step, both = np.zeros(9), np.zeros(9), np.zeros(9)
    wm, fm, a = np.zeros(3), np.zeros(3), np.zeros(3)
    v, p = np.zeros(3), np.zeros(3)
    j = 0
    for k in wanted:
        now = ends[k] - period_s
        state.make_rotation(0.0, 0.0, 0.0, r)
        for i in range(3):
            v[i] = p[i] = 0.0
        while now < ends[k] - 1e-9:
            while j + 1 < t.size and t[j + 1] <= now + 1e-9:
                j += 1
            end = ends[k]
            if t[j] > now + 1e-9:
                end = min(t[j], end)
            elif j + 1 < t.size:
                end = min(t[j + 1], end)
            h, middle = end - now, 0.5 * (end + now)
            after = min(j + 1, t.size - 1)
            share = min(max((middle - t[j]) / (t[after] - t[j]), 0.0), 1.0) if after > j else 0.0
            for i in range(3):
                wm[i] = (1.0 - share) * w[j, i] + share * w[after, i]
                fm[i] = (1.0 - share) * f[j, i] + share * f[after, i]
            state.make_rotation(0.5 * h * wm[0], 0.5 * h * wm[1], 0.5 * h * wm[2], step)
            state.multiply_rotations(r, step, both)
            for i in range(3):
                a[i] = both[3 * i] * fm[0] + both[3 * i + 1] * fm[1] + both[3 * i + 2] * fm[2]
                p[i] += h * (v[i] + 0.5 * h * a[i])
                v[i] += h * a[i]
            state.multiply_rotations(both, step, r)
            now = end
        for i in range(9):
            turned[k, i] = r[i]
        for i in range(3):
            gained[k, i] = v[i]
            gained[k, 3 + i] = p[i]


def _compute_acceleration(m: Measurements, stamp_ns: Ints) -> Floats:
    """Return the forward acceleration at each tick by the mean change of odometries' velocities; 0 without one."""
    slopes = [_compute_slope(source, stamp_ns) for source in m.odometries().values()]
    return np.mean(slopes, axis=0) if slopes else np.zeros(stamp_ns.size)


def _compute_slope(source: BodyVelocities, stamp_ns: Ints) -> Floats:
    if source.stamp_ns.size < 3:
        return np.zeros(stamp_ns.size)
    slope = compute_slopes(source.stamp_ns, compute_running_median(source.velocity_mps[:, 0]), 0.4)
    zero = int(stamp_ns[0])
    found = np.interp(compute_seconds(stamp_ns, zero), compute_seconds(source.stamp_ns, zero), slope)
    return np.where(is_covered(source.stamp_ns, stamp_ns, stamp_ns), found, 0.0)


def _find_turn_rates(m: Measurements, before_ns: Ints, after_ns: Ints, zero_ns: int) -> tuple[Floats, NDArray[np.int8]]:
    """Return the mean angular velocity over each interval by the best source that covers it, and its mode of motion."""
    rate, mode = np.zeros((before_ns.size, 3)), np.full(before_ns.size, Mode.FLAT_TURN, np.int8)
    start_s, end_s = compute_seconds(before_ns, zero_ns), compute_seconds(after_ns, zero_ns)
    roles = [*m.turning_odometries(), *([] if m.imu is None else [IMU])]
    if not roles and m.gnss is not None and m.odometries():
        roles = [COURSE]
    for role in roles:
        stamp_ns, values = get_turn_rates(m, role)
        inside = is_covered(stamp_ns, before_ns, after_ns)
        if role == roles[0] != IMU:  # also used in gaps of the other sources
            inside[:] = True
        rate[inside] = compute_interval_means(
            compute_seconds(stamp_ns, zero_ns), values, start_s[inside], end_s[inside]
        )
        mode[inside] = {IMU: Mode.GYRO_TURN, VISUAL: Mode.VISUAL_TURN}.get(role, Mode.FLAT_TURN)
    return rate, mode
