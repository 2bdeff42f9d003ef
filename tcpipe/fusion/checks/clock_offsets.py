"""The clock doctor: offsets between the stamps of a run's sensors, and their drift, from what they say of the same motion.

Speed of the wheels against that of the fixes, yaw rate against the gyroscope, changes of speed against the accelerometer, power against
what speed and acceleration cost. A pair is compared only where the robot turns or changes its speed: on a straight there is nothing to
compare but what the controller corrects, and that leads the body. Each gives a lag with its standard deviation (`lags`), over the whole run
and in windows of ten minutes, through which a line tells the drift; the pairs together give each sensor's offset from the clock that most
of them share. A sensor is blamed only where two others agree against it and no pair contradicts; else two differ, and nobody knows which
is off. Offsets are taken out of the stamps before fusion; the estimator's lags carry what is left. The course of the fixes is not held
against the gyroscope: an antenna that sits ahead of the turning point by l leads the body's course by l / v, 0.1 s for 10 cm.

Stamps of fixes may jitter: receivers and localisation nodes that stamp a fix when they send it, some tenths of a second after they
measured it, make positions that stand still and then leap, whatever variance they claim. Over each pair of successive fixes the distance
between them is compared with the distance driven by the odometry (times the local ratio of the two, so that slip does not count). What
this residual spreads beyond the claimed noise, divided by the speed, is the jitter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.attitude import add_turn_variance
from tcpipe.fusion.checks.lags import (
    FIXES_S,
    GRID_S,
    Floats,
    compute_fix_velocity,
    compute_lag_products,
    compute_moving_mean,
    estimate_lag,
    find_span_ns,
    iterate_windows_ns,
    resample_signal,
    resample_twist,
)
from tcpipe.fusion.measurements import (
    DOPPLER,
    GNSS,
    IMU,
    VISUAL,
    WHEELS,
    BodyVelocities,
    GroundVelocities,
    InertialMeasurements,
    Measurements,
    Positions,
    select_measurements,
)
from tcpipe.fusion.signals import compute_median_period_ns, compute_seconds, integrate_signal
from tcpipe.tables.findings import Finding, Subject, make_finding

POWER = "power"
ROLES = (IMU, WHEELS, VISUAL, GNSS, POWER)
"""In the order in which a clock is taken for the right one where as many agree with either: a gyroscope has the least to compute."""

_NOTED_S = {POWER: 0.08}
_NOTED_MOTION_S = 0.05
_SURE = 4.0  # standard deviations
_CLEARLY = 10.0
"""Standard deviations of an offset that is not known well: the mean of a clock that steps scatters by more."""
_MAX_STD_S = {POWER: 0.04}
_MAX_MOTION_STD_S = 0.02
_MIN_EXPLAINED = 0.25
_TURNS_RADPS = 0.1
_CHANGES_MPS = 0.1
_LIVELY_S = 2.0
"""Rows this near to a turn or a change of speed are compared [s]."""
_ODOMETRY_S = 0.1
_ACCELERATION_S = 0.3
_POWER_S = 0.2
_DOPPLER_S = 0.3
_SLOW_S = 4.0
_STOPPED_MPS = 0.1
_NEAR_STOP_S = 3.0
_WINDOW_NS = 600_000_000_000
_MARGIN_NS = 5_000_000_000
_FEWEST_WINDOWS = 3
_LEAST_STD_S = 1e-3
_LEAST_BY_FORCE_S = 0.02
"""Slopes act as accelerations: the accelerometer is a check of a clock rather than a measure [s]."""

YAW_RATE, SPEED, ACCELERATION = "yaw rate", "speed", "acceleration"

Signals = tuple[str, str, str, Floats, Floats]


@dataclass(frozen=True, slots=True)
class Pair:
    """Two sensors compared: by what, how late the first's stamps are against the second's [s], and how much one explains the other.

    ``offset_s`` is that of the middle of the run where the drift [s/h] is sure; ``windows`` are (seconds into the run, offset [s], its
    standard deviation) of parts that tell enough; a drift needs three of them and is NaN otherwise.
    """

    late: str
    against: str
    by: str
    offset_s: float
    std_s: float
    explained: float
    drift_s_per_h: float = math.nan
    drift_std_s_per_h: float = math.nan
    windows: tuple[tuple[float, float, float], ...] = ()

    @property
    def determined(self) -> bool:
        """Whether the offset is known well enough to be spoken of: to a small error, or as surely not zero."""
        return _is_determined(self.late, self.offset_s, self.std_s, self.explained)

    @property
    def weight_std_s(self) -> float:
        """Its standard deviation beside other pairs' [s]."""
        return max(self.std_s, _LEAST_BY_FORCE_S if self.by == ACCELERATION else _LEAST_STD_S)


@dataclass(frozen=True, slots=True)
class RoleOffset:
    """How late a sensor's stamps are against the reference's [s], their drift [s/h, NaN where unknown], with standard deviations.

    ``noted`` and ``drifts``: whether a person should act on either. ``blamed``: whether two others agree against it and nothing
    contradicts; otherwise it and the reference differ, and which of them is off is not known.
    """

    offset_s: float
    std_s: float
    noted: bool
    drift_s_per_h: float = math.nan
    drift_std_s_per_h: float = math.nan
    drifts: bool = False
    blamed: bool = False


@dataclass(frozen=True, slots=True)
class PowerSignal:
    """The robot's power: stamps [ns] and values [W], shape (N,); ``averaged`` over the period that ends at each stamp."""

    stamp_ns: NDArray[np.int64]
    power_watt: Floats
    averaged: bool


@dataclass(frozen=True, slots=True)
class ClockOffsets:
    """Every pair compared, the sensor with the reference clock, and the offsets of those connected to it.

    ``span_s`` is how long the run is.
    """

    pairs: tuple[Pair, ...]
    reference: str
    offsets: Mapping[str, RoleOffset]
    span_s: float = 0.0


def find_clock_offsets(measurements: Measurements, power: PowerSignal | None) -> ClockOffsets:
    """Return the offsets between the stamps of a clock epoch's sensors, and their drift; ``power`` is the sum over the drive rails.

    Extrinsics need not be right, since a yaw rate is compared with all three axes of a gyroscope.
    """
    span = find_span_ns(measurements)
    if span is None:
        return ClockOffsets((), "", {})
    told: dict[tuple[str, str, str], list[tuple[float, Floats]]] = {}
    for at_ns in iterate_windows_ns(measurements, _WINDOW_NS):
        first_ns, last_ns = int(at_ns[0]) - _MARGIN_NS, int(at_ns[-1]) + _MARGIN_NS
        middle_s = ((int(at_ns[0]) + int(at_ns[-1])) / 2 - span[0]) * 1e-9
        for late, against, by, target, regressors in _iterate_signals(
            select_measurements(measurements, first_ns, last_ns), _select_power(power, first_ns, last_ns), at_ns
        ):
            products = compute_lag_products(target, regressors)
            if products is not None:
                told.setdefault((late, against, by), []).append((middle_s, products))
    span_s = (span[1] - span[0]) * 1e-9
    pairs = (_pair(names, windows, span_s) for names, windows in told.items())
    return _solve_offsets(tuple(pair for pair in pairs if pair is not None), span_s)


def shift_stamps(stamp_ns: NDArray[np.int64], offset: RoleOffset, first_ns: int, span_s: float) -> NDArray[np.int64]:
    """Return stamps [ns] without an offset and its drift; the run begins at ``first_ns`` and lasts ``span_s``."""
    late_s = np.full(stamp_ns.size, offset.offset_s)
    if offset.drifts:
        late_s += offset.drift_s_per_h / 3600.0 * (compute_seconds(stamp_ns, first_ns) - span_s / 2.0)
    return stamp_ns - np.rint(late_s * 1e9).astype(np.int64)


def _iterate_signals(m: Measurements, power: PowerSignal | None, at_ns: NDArray[np.int64]) -> Iterable[Signals]:
    """Yield what can be compared in a window: whose stamps against whose, by what, target and regressors on the grid."""
    twists = {role: resample_twist(source, at_ns) for role, source in m.odometries().items()}
    if m.imu is not None:
        yield from _compare_with_imu(m.imu, twists, m.gnss, at_ns)
    speeds = {role: compute_moving_mean(np.abs(of[:, :1]), _ODOMETRY_S) for role, of in twists.items()}
    if len(twists) == 2:
        yield VISUAL, WHEELS, SPEED, *select_speed_changes(speeds[VISUAL], speeds[WHEELS])
    for role, twist in twists.items():
        if m.gnss is not None:
            seen = compute_moving_mean(
                compute_moving_mean(compute_antenna_speed(twist, m.gnss.lever_arm_m), FIXES_S), FIXES_S
            )
            yield GNSS, role, SPEED, *select_speed_changes(np.abs(compute_fix_velocity(m.gnss, at_ns))[:, None], seen)
    if m.doppler is not None:
        yield from _compare_doppler(m.doppler, m.gnss, twists, at_ns)
    if power is not None and twists:
        role = next(iter(twists))
        yield POWER, role, "power of speed, acceleration and turning", *_prepare_power(power, twists[role], at_ns)


def _compare_doppler(
    doppler: GroundVelocities, gnss: Positions | None, twists: Mapping[str, Floats], at_ns: NDArray[np.int64]
) -> Iterable[Signals]:
    """Yield the comparisons of a receiver's velocity: its size with that of an odometry, its axes with the fixes."""
    if gnss is None:
        return
    velocity = resample_signal(doppler.stamp_ns, doppler.velocity_enu_mps[:, :2], at_ns)
    for role, twist in list(twists.items())[:1]:
        seen = compute_moving_mean(compute_antenna_speed(twist, gnss.lever_arm_m), _DOPPLER_S)
        size = compute_moving_mean(np.linalg.norm(velocity, axis=1)[:, None], _DOPPLER_S)
        yield DOPPLER, role, SPEED, *select_speed_changes(size, seen)
    by_fixes = compute_fix_velocity(gnss, at_ns)
    smooth = compute_moving_mean(velocity, FIXES_S).T
    for axis, own, seen in zip(("east", "north"), smooth, (by_fixes.real, by_fixes.imag), strict=True):
        yield DOPPLER, GNSS, f"velocity {axis}", own, compute_moving_mean(seen[:, None], _DOPPLER_S)


def _compare_with_imu(
    imu: InertialMeasurements, twists: Mapping[str, Floats], gnss: Positions | None, at_ns: NDArray[np.int64]
) -> Iterable[Signals]:
    """Yield the comparisons of gyroscope and accelerometer: turns and changes of speed."""
    gyro = compute_moving_mean(resample_signal(imu.stamp_ns, imu.angular_velocity_radps, at_ns), _ODOMETRY_S)
    for role, twist in twists.items():
        turning = compute_moving_mean(twist, _ODOMETRY_S)[:, 1]
        yield role, IMU, YAW_RATE, np.where(_find_rows_near(np.abs(turning) > _TURNS_RADPS), turning, np.nan), gyro
    if not imu.accelerometer_usable:
        return
    force = resample_signal(imu.stamp_ns, imu.specific_force_mps2, at_ns)
    for role, twist in twists.items():
        yield (
            role,
            IMU,
            ACCELERATION,
            *_compute_accelerations(
                compute_moving_mean(twist[:, :1], _ACCELERATION_S), compute_moving_mean(force, _ACCELERATION_S)
            ),
        )
    if gnss is not None:
        ahead = np.sign(next(iter(twists.values()))[:, 0]) if twists else 1.0
        speed = compute_moving_mean((ahead * np.abs(compute_fix_velocity(gnss, at_ns)))[:, None], FIXES_S)
        yield (
            GNSS,
            IMU,
            ACCELERATION,
            *_compute_accelerations(
                speed, compute_moving_mean(compute_moving_mean(compute_moving_mean(force, FIXES_S), FIXES_S), FIXES_S)
            ),
        )


def _compute_accelerations(speed: Floats, force: Floats) -> tuple[Floats, Floats]:
    """Return how fast a speed (M, 1) changes [m/s²] and the force (M, 3) that would do it, where the speed changes."""
    lively = _find_rows_near(np.abs(_remove_slow_parts(speed)[:, 0]) > _CHANGES_MPS)
    rate = _remove_slow_parts(np.gradient(speed, GRID_S, axis=0))[:, 0]
    return np.where(lively, rate, np.nan), _remove_slow_parts(force)


def select_speed_changes(target: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Return two speeds (M, 1) without their slow parts, the first only near changes of the second."""
    quick = _remove_slow_parts(seen)
    return np.where(
        _find_rows_near(np.abs(quick[:, 0]) > _CHANGES_MPS), _remove_slow_parts(target)[:, 0], np.nan
    ), quick


def _find_rows_near(lively: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return what lies near something lively, shape (M,)."""
    beside: NDArray[np.bool_] = compute_moving_mean(lively.astype(np.float64)[:, None], 2 * _LIVELY_S)[:, 0] > 0
    return beside


def _select_power(power: PowerSignal | None, first_ns: int, last_ns: int) -> PowerSignal | None:
    """Return the part of a power signal between two stamps; None where there is too little."""
    if power is None:
        return None
    rows = slice(*np.searchsorted(power.stamp_ns, (first_ns, last_ns + 1)))
    if rows.stop - rows.start < 2:
        return None
    return PowerSignal(power.stamp_ns[rows], power.power_watt[rows], power.averaged)


def _pair(names: tuple[str, str, str], windows: list[tuple[float, Floats]], span_s: float) -> Pair | None:
    """Return a pair of the whole run; where it drifts for sure, as it is in the middle of the run."""
    lags = [(at_s, estimate_lag([products])) for at_s, products in windows] if len(windows) > 1 else []
    known = [
        (at_s, lag) for at_s, lag in lags if lag and _is_determined(names[0], lag.offset_s, lag.std_s, lag.explained)
    ]
    told = tuple((at_s, lag.offset_s, lag.std_s) for at_s, lag in known)
    whole, drift, middle_s, rate = estimate_lag([products for _, products in windows]), (math.nan, math.nan), 0.0, 0.0
    if len(told) >= _FEWEST_WINDOWS:
        (middle_s, rate), (middle_std_s, rate_std) = _fit_offset_line(np.array(told), span_s)
        drift = (3600.0 * rate, 3600.0 * rate_std)
    if len(told) >= _FEWEST_WINDOWS and (whole is None or abs(rate) > _SURE * rate_std):
        explained = float(np.median([lag.explained for _, lag in known]))
        return Pair(*names, middle_s, middle_std_s, explained, *drift, told)
    return None if whole is None else Pair(*names, whole.offset_s, whole.std_s, whole.explained, *drift, told)


def _fit_offset_line(told: Floats, span_s: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return offset in the middle of the run [s] and its rate [s/s] by weighted least squares, and their standard deviations.

    Windows that scatter by more than they claim widen the deviations (Birge's ratio).
    """
    at_s, offset_s, std_s = told.T
    weight = 1.0 / np.maximum(std_s, _LEAST_STD_S)
    design = np.column_stack((np.ones_like(at_s), at_s - span_s / 2)) * weight[:, None]
    covariance = np.linalg.inv(design.T @ design)
    solved = covariance @ design.T @ (offset_s * weight)
    left = offset_s * weight - design @ solved
    birge = max(1.0, float(left @ left) / (at_s.size - 2))
    middle_std_s, rate_std = np.sqrt(birge * np.diagonal(covariance)).tolist()
    return (float(solved[0]), float(solved[1])), (middle_std_s, rate_std)


def _is_determined(role: str, offset_s: float, std_s: float, explained: float) -> bool:
    limit_s = _MAX_STD_S.get(role, _MAX_MOTION_STD_S)
    known = std_s <= limit_s or (std_s <= 3 * limit_s and abs(offset_s) > _CLEARLY * std_s)
    return known and explained >= _MIN_EXPLAINED


def _remove_slow_parts(values: Floats) -> Floats:
    """Return (M, k) values without their slow parts, which slip and terrain change, and starts, stops and turns do not need."""
    return values - compute_moving_mean(values, _SLOW_S)


def compute_antenna_speed(twist: Floats, lever_arm_m: tuple[float, float, float]) -> Floats:
    """Return the antenna's speed by forward velocity and yaw rate, shape (M, 2), of an odometry [m/s], shape (M, 1)."""
    forward, yaw_rate = twist.T
    speed: Floats = np.hypot(forward - yaw_rate * lever_arm_m[1], yaw_rate * lever_arm_m[0])
    return speed[:, None]


def _prepare_power(power: PowerSignal, twist: Floats, at_ns: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return power, and what it may depend on, without their slow parts."""
    stamp_ns = power.stamp_ns
    if power.averaged:
        stamp_ns = stamp_ns - compute_median_period_ns(stamp_ns) // 2
    drawn = resample_signal(stamp_ns, power.power_watt[:, None], at_ns)
    speed, turning = np.abs(twist).T
    causes = compute_moving_mean(np.column_stack((drawn, speed, turning, turning * speed, speed**2)), _POWER_S)
    # Speed times acceleration, as half the slope of the squared speed: smoothed like the power itself.
    causes[:, -1] = np.gradient(causes[:, -1], GRID_S) / 2
    fast = _remove_slow_parts(causes)
    near_stop = compute_moving_mean((speed < _STOPPED_MPS).astype(np.float64)[:, None], _NEAR_STOP_S)[:, 0] > 0
    return np.where(near_stop, fast[:, 0], np.nan), fast[:, 1:]


def _solve_offsets(pairs: tuple[Pair, ...], span_s: float = 0.0) -> ClockOffsets:
    """Return each sensor's offset from the clock that most sensors share, by weighted least squares over the pairs that are determined.

    The receiver's velocity has no say: it has the clock of the fixes, and no label needs it.
    """
    known = [pair for pair in pairs if pair.determined and pair.late != DOPPLER]
    linked = [role for role in ROLES if any(role in {pair.late, pair.against} for pair in known)]
    best: dict[str, RoleOffset] = {}
    reference = ""
    for role in linked:
        offsets = _solve_against_reference(role, linked, known, span_s)
        if not best or len(_find_agreeing(offsets)) > len(_find_agreeing(best)):
            best, reference = offsets, role
    agreeing = _find_agreeing(best)
    told = {
        role: replace(offset, blamed=role not in agreeing and _is_blamed(role, agreeing, best, known))
        for role, offset in best.items()
        if role != reference
    }
    of_doppler = [pair for pair in pairs if pair.determined and pair.late == DOPPLER]
    if of_doppler:
        reference = reference or of_doppler[0].against
        offsets = _solve_against_reference(reference, [*linked, reference, DOPPLER], [*known, *of_doppler], span_s)
        told |= {DOPPLER: replace(offsets[DOPPLER], blamed=True)} if DOPPLER in offsets else {}
    return ClockOffsets(pairs, reference, told, span_s)


def _find_agreeing(offsets: Mapping[str, RoleOffset]) -> frozenset[str]:
    """Return the sensors that are near the reference; how surely does not matter: against a doubtful clock nobody is surely off."""
    return frozenset(
        role
        for role, offset in offsets.items()
        if abs(offset.offset_s) <= _NOTED_S.get(role, _NOTED_MOTION_S) and not offset.drifts
    )


def _is_blamed(role: str, agreeing: frozenset[str], offsets: Mapping[str, RoleOffset], pairs: Sequence[Pair]) -> bool:
    """Whether two sensors that agree speak against a role by the same kind of motion, and no pair contradicts any of them.

    A yaw rate says nothing of the clock of a speed: a filter may pass the gyroscope's on at once and smooth the wheels'.
    """
    among = [pair for pair in pairs if {pair.late, pair.against} <= agreeing | {role}]
    apart = (abs(p.offset_s - offsets[p.late].offset_s + offsets[p.against].offset_s) for p in among)
    if any(gap_s > max(_SURE * p.weight_std_s, _NOTED_MOTION_S) for gap_s, p in zip(apart, among, strict=True)):
        return False
    for turning in (True, False):
        links = [{p.late, p.against} for p in among if (p.by == YAW_RATE) == turning]
        heard = {role}
        for _ in links:
            heard |= {each for link in links if link & heard for each in link}
        if len(heard) > 2:
            return True
    return False


def _solve_against_reference(
    reference: str, roles: list[str], pairs: list[Pair], span_s: float
) -> dict[str, RoleOffset]:
    """Return the offsets of the sensors that pairs connect to the reference, its own (zero) included."""
    offsets = _solve_network(reference, roles, [(p.late, p.against, p.offset_s, p.weight_std_s) for p in pairs])
    least = 3600.0 * _LEAST_STD_S / max(span_s, 1.0)
    told = [p for p in pairs if math.isfinite(p.drift_s_per_h)]
    drifts = _solve_network(
        reference, roles, [(p.late, p.against, p.drift_s_per_h, max(p.drift_std_s_per_h, least)) for p in told]
    )
    found = {}
    for role, (offset_s, std_s) in offsets.items():
        limit_s = _NOTED_S.get(role, _NOTED_MOTION_S)
        rate, rate_std = drifts.get(role, (math.nan, math.nan))
        wanders = abs(rate) > max(_SURE * rate_std, limit_s * 3600.0 / max(span_s, 1.0))
        noted = abs(offset_s) > max(limit_s, _SURE * std_s)
        found[role] = RoleOffset(offset_s, std_s, noted, rate, rate_std, drifts=bool(wanders))
    return found


def _solve_network(
    reference: str, roles: list[str], differences: list[tuple[str, str, float, float]]
) -> dict[str, tuple[float, float]]:
    """Return each connected role's value against the reference's zero, with its standard deviation.

    ``differences`` are (role, other, value of the role less that of the other, standard deviation).
    """
    connected = {reference}
    for _ in roles:
        connected |= {r for a, b, *_ in differences if connected & {a, b} for r in (a, b)}
    free = [role for role in roles if role in connected and role != reference]
    if not free:
        return {reference: (0.0, 0.0)}
    used = [each for each in differences if each[0] in connected]
    design = np.array([[(r == a) - float(r == b) for r in free] for a, b, *_ in used])
    values, std = np.array([each[2:] for each in used]).T
    weighted = design / std[:, None]
    covariance = np.linalg.inv(weighted.T @ weighted)
    solved = covariance @ weighted.T @ (values / std)
    deviations = np.sqrt(np.diagonal(covariance))
    return {reference: (0.0, 0.0)} | dict(
        zip(free, zip(solved.tolist(), deviations.tolist(), strict=True), strict=True)
    )


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
    jitter_s = estimate_stamp_jitter_s(gnss, odometry)
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


def estimate_stamp_jitter_s(gnss: Positions, odometry: BodyVelocities) -> NDArray[np.float64]:
    """Return the standard deviation of the stamps around each fix [s], shape (N,); 0 where it does not matter or is unknown.

    It matters above 0.05 s and where it moves the fix by more than twice its claimed deviation. While the robot is stationary it is
    unknown: the value of the nearest motion is held. Of the odometry the forward velocity is used.
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

    Twice, since such fixes are late and never early, by about as much on average as they scatter, and one late fix follows another: the
    filter, for which errors are white, must not average them away.
    """
    zero = int(gnss.stamp_ns[0])
    speed = np.abs(odometry.velocity_mps[:, 0])
    speed = np.interp(compute_seconds(gnss.stamp_ns, zero), compute_seconds(odometry.stamp_ns, zero), speed)
    variance = gnss.variance_m2.copy()
    variance[:, :2] += ((2 * speed * jitter_s) ** 2)[:, None]
    return add_turn_variance(replace(gnss, variance_m2=variance), 2 * jitter_s)


def _make_windows(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a window centred on each value, shape (N, 41), the signal mirrored at its ends."""
    padded = np.pad(values, _PAIRS // 2, mode="reflect")
    return np.lib.stride_tricks.sliding_window_view(padded, _PAIRS)
