"""Time offsets between the stamps of a run's sensors, from their measurements of the same motion.

Small offsets are states of the estimator, and steps of a clock are hypotheses of it. Larger offsets are found before
fusion. Two signals of one motion are shifted against each other until one explains most of the other (`motions`): yaw
rates, speeds, accelerations. They are compared only where the robot turns or changes its speed: on a straight line only
the corrections of the controller remain, and these precede the motion of the body. The course of fixes is not compared
with the gyroscope: an antenna ahead of the turning point by l precedes the body's course by l / v, 0.1 s for 10 cm.

All pairs, in windows of at most ten minutes, determine each sensor's offset and drift from the clock that most sensors
share. A sensor has a wrong clock only if two other sensors agree with each other, differ from it, and no pair
contradicts. A coarse search for offsets of up to five minutes runs first.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion.checks.motions import (
    FIXES_S,
    GRID_S,
    NEAR_S,
    SMOOTH_S,
    Lag,
    average,
    compute_acceleration,
    compute_fix_velocity,
    compute_lag_sums,
    differentiate_course,
    estimate_lag,
    find_coarse_lag,
    find_liveliest_window_ns,
    find_quick_part,
    find_span_ns,
    iterate_windows_ns,
    prepare_coarse_signals,
    resample_imu,
    resample_twist,
)
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, VISUAL, WHEELS, Measurements, select_measurements
from tcpipe.fusion.signals import Plane, Signal, compute_moving_mean, compute_seconds
from tcpipe.robust import MIN_SIGMAS
from tcpipe.tables.facts import ClockFacts, ClockOffset, ClockPair

ROLES = (IMU, WHEELS, VISUAL, GNSS)
"""Sensors in the order of preference of their clocks as reference: a gyroscope's driver has the least to compute."""
NOTED_S = 0.05  # least time offset that a person should act on [s]
_MIN_EXPLAINED = 0.25
"""Least share of a signal's variance that another signal with the same clock explains [1]; the rest: noise and slip."""
_WINDOW_NS, _MIN_WINDOWS = (40_000_000_000, 600_000_000_000), 3
"""Least and largest window without drift [ns] (a fifth of the run within them); fewest windows to fit a drift [1]."""
_DRIFT_STD = 1e-3  # prior standard deviation of a clock's drift [1]: ten times that of a quartz
_COARSE_STD_S = 0.1  # standard deviation of an offset by the coarse search [s]


def find_clock_offsets(m: Measurements, *, clock_epoch: int = 0) -> ClockFacts:
    """Return the offsets between the stamps of a clock epoch's sensors."""
    first_ns, last_ns = find_span_ns(m) or (0, 0)
    middle_ns, span_s = (first_ns + last_ns) // 2, (last_ns - first_ns) * 1e-9
    evidence: dict[tuple[str, str, str], list[tuple[float, Plane]]] = {}
    for at_ns in iterate_windows_ns(m, round(np.clip(0.2e9 * span_s, *_WINDOW_NS))):
        inside = select_measurements(m, int(at_ns[0]), int(at_ns[-1]))
        at_s = float(compute_seconds((at_ns[0] + at_ns[-1]) // 2, middle_ns))
        for late, against, by, target, regressor in _iterate_signals(inside, at_ns):
            sums = compute_lag_sums(target, regressor)
            if sums is not None:
                evidence.setdefault((late, against, by), []).append((at_s, sums))
    pairs = [pair for names, windows in evidence.items() for pair in _list_pairs(*names, windows)]
    return solve_offsets(pairs, clock_epoch, span_s)


def find_other_clocks(m: Measurements, *, always: bool = False) -> dict[str, ClockOffset]:
    """Return, by role, the time offset of each sensor from the largest group of sensors that share a clock.

    Offsets beyond the range of the fine search are marked as ``is_significant``. Without any the result is {}, unless
    ``always``. Sensors with an unknown offset are left out.
    """
    coarse = find_coarse_offsets(m)
    if not always and not any(offset.is_significant for offset in coarse.values()):
        return {}
    solution = find_clock_offsets(shift_sensors(m, coarse, 0))
    fine = {solution.reference: ClockOffset(0.0, 0.0, is_significant=False)} | dict(solution.offsets)
    zero = next((fine[role] for role, each in coarse.items() if each.offset_s == 0.0 and role in fine), None)
    if zero is not None:
        for role in coarse.keys() & fine.keys():
            offset_s = coarse[role].offset_s + fine[role].offset_s - zero.offset_s
            coarse[role] = replace(coarse[role], offset_s=offset_s, std_s=fine[role].std_s + zero.std_s)
    return coarse


def find_coarse_offsets(m: Measurements) -> dict[str, ClockOffset]:
    """Return approximate delays of sensors' stamps against the largest group that shares a clock; its reference has 0.

    Offsets beyond the range of the fine search are marked as ``is_significant``. Returns {} if the pairs of sensors contradict
    each other.
    """
    pairs = [*_compare_roughly(m)]
    # The IMU comes last: it alone determines no track.
    solution = solve_offsets(pairs, near_s=NEAR_S, roles=(*ROLES[1:], IMU))
    offsets = {solution.reference: ClockOffset(0.0, _COARSE_STD_S, is_significant=False)} | dict(solution.offsets)
    if any(abs(_compute_misfit_s(pair, offsets)) > NEAR_S for pair in pairs if pair.late in offsets):
        return {}
    return {
        role: ClockOffset(each.offset_s, _COARSE_STD_S, is_significant=abs(each.offset_s) > NEAR_S, is_wrong=False)
        for role, each in offsets.items()
        if role
    }


def shift_sensors(m: Measurements, offsets: Mapping[str, ClockOffset], middle_ns: int) -> Measurements:
    """Return the measurements with corrected stamps: without time offsets, and without drifts about ``middle_ns``.

    A receiver's velocity has the same clock as its fixes.
    """
    offsets = {**offsets, **({DOPPLER: offsets[GNSS]} if GNSS in offsets else {})}
    corrected = ((role, sensor) for role, sensor in m.sensors().items() if role in offsets)
    return m.replace_sensors(
        {role: replace(of, stamp_ns=shift_stamps(of.stamp_ns, offsets[role], middle_ns)) for role, of in corrected}
    )


def shift_stamps(stamp_ns: Ints, offset: ClockOffset, middle_ns: int) -> Ints:
    """Return stamps [ns] corrected for an offset and its drift."""
    return stamp_ns - np.rint(1e9 * _compute_lateness(offset, compute_seconds(stamp_ns, middle_ns))).astype(np.int64)


def _compute_lateness(offset: ClockOffset, from_middle_s: Floats | float) -> Floats:
    return np.asarray(offset.offset_s + 1e-6 * offset.drift_ppm * from_middle_s)


def _is_significant(difference_s: float, std_s: float) -> bool:
    """Return whether a clock difference is significant, and large enough that a person should act on it."""
    return bool(abs(difference_s) > max(NOTED_S, MIN_SIGMAS * std_s))


def _list_pairs(late: str, against: str, by: str, windows: Sequence[tuple[float, Plane]]) -> list[ClockPair]:
    """Return comparisons of two sensors: one per window if three windows agree on offset and drift, else one."""
    lags = [(at_s, lag) for at_s, sums in windows if (lag := estimate_lag([sums]))]
    pairs = [replace(make_pair(late, against, by, lag), from_middle_s=at_s) for at_s, lag in lags]
    known = [pair for pair in pairs if pair.explained >= _MIN_EXPLAINED and pair.std_s <= NOTED_S]
    if len(known) >= _MIN_WINDOWS:
        at_s, offset_s, std_s = np.array([(pair.from_middle_s, pair.offset_s, pair.std_s) for pair in known]).T
        misfit_s = offset_s - np.polyval(np.polyfit(at_s, offset_s, 1, w=1.0 / std_s), at_s)
        if not any(map(_is_significant, misfit_s, std_s)):
            return [replace(pair, determined=True) for pair in known]
    whole = estimate_lag([sums for _, sums in windows])
    return [make_pair(late, against, by, whole)] if whole else []


def make_pair(late: str, against: str, by: str, lag: Lag) -> ClockPair:
    """Return a comparison of two sensors; a lag counts as determined if its σ is below 0.02 s or a tenth of the lag.

    A clock that steps has a larger σ.
    """
    std_s = max(lag.std_s, 0.02 if by == "acceleration" else 1e-3)  # slopes disturb accelerometers
    determined = std_s <= max(0.02, 0.1 * abs(lag.offset_s)) and lag.explained >= _MIN_EXPLAINED
    return ClockPair(late, against, by, lag.offset_s, std_s, lag.explained, determined)


def _iterate_signals(m: Measurements, at_ns: Ints) -> Iterator[tuple[str, str, str, Signal, Signal]]:
    """Yield the possible comparisons: late role, reference role, quantity, and both signals on the grid, shape (M,)."""
    twists = {role: resample_twist(source, at_ns) for role, source in m.odometries().items()}
    if m.imu is not None:
        turn, force, _ = resample_imu(m.imu, at_ns)
        for role, twist in twists.items():
            turning, changes = average(twist[:, 1], SMOOTH_S), find_quick_part(average(twist[:, 0], SMOOTH_S))
            yield role, IMU, "yaw rate", _select_near(turning, turning), average(turn, SMOOTH_S)
            if m.imu.accelerometer_usable:
                yield role, IMU, "acceleration", _select_near(changes, compute_acceleration(twist)), force
    if len(twists) == 2:
        target, seen = (find_quick_part(average(np.abs(twists[role][:, 0]), SMOOTH_S)) for role in (VISUAL, WHEELS))
        yield VISUAL, WHEELS, "speed", _select_near(seen, target), seen
    if m.gnss is not None:
        velocity = find_quick_part(np.abs(compute_fix_velocity(m.gnss, at_ns)))
        for role, twist in twists.items():
            speed = _compute_antenna_speed(twist, m.gnss.lever_arm_m)
            seen = find_quick_part(average(average(speed, FIXES_S), FIXES_S))
            yield GNSS, role, "speed", _select_near(seen, velocity), seen


def _select_near(lively: Floats, values: Signal) -> Signal:
    """Return the values within 2 s of a row in which ``lively`` exceeds 0.1 [rad/s or m/s], else NaN; shape (M,)."""
    is_near = compute_moving_mean(1.0 * (np.abs(lively) > 0.1), round(2.0 / GRID_S), least=0.0) > 0.0
    return np.where(is_near, values, np.nan)


def _compute_antenna_speed(twist: Floats, lever_arm_m: tuple[float, float, float]) -> Floats:
    """Return the antenna's speed [m/s], shape (M,), from an odometry's forward velocity and yaw rate (M, 2)."""
    forward, yaw_rate = twist.T
    speed: Floats = np.hypot(forward - yaw_rate * lever_arm_m[1], yaw_rate * lever_arm_m[0])
    return speed


def solve_offsets(
    pairs: Sequence[ClockPair],
    clock_epoch: int = 0,
    span_s: float = 0.0,
    *,
    near_s: float = NOTED_S,
    roles: Sequence[str] = ROLES,
) -> ClockFacts:
    """Return each sensor's offset from the clock of most sensors, by weighted least squares over determined pairs.

    Clocks within ``near_s`` count as one. On a tie, the reference is the role that comes first in ``roles``.
    """
    known = [pair for pair in pairs if pair.determined]
    solved = {
        role: _fit_offsets(role, known, span_s) for role in roles if any(role in {p.late, p.against} for p in known)
    }
    if not solved:
        return ClockFacts(clock_epoch, "", tuple(pairs), {})
    # Sensors near a reference agree with it whatever their σ: a reference with a large σ proves no offset.
    agreeing = {
        role: {role} | {each for each, of in offsets.items() if abs(of.offset_s) <= near_s and not of.drift_ppm}
        for role, offsets in solved.items()
    }
    reference = max(solved, key=lambda role: len(agreeing[role]))  # on a tie, the first
    offsets = {reference: ClockOffset(0.0, 0.0, is_significant=False)} | solved[reference]
    # A clock is wrong only if two other sensors agree, differ from it, and no pair contradicts.
    misfits = ((_compute_misfit_s(pair, offsets), pair.std_s) for pair in known if pair.late in offsets)
    is_sure = len(agreeing[reference]) > 1 and not any(_is_significant(*misfit) for misfit in misfits)
    decided = {
        role: replace(offset, is_wrong=is_sure and role not in agreeing[reference])
        for role, offset in solved[reference].items()
    }
    return ClockFacts(clock_epoch, reference, tuple(pairs), decided)


def _fit_offsets(reference: str, pairs: Sequence[ClockPair], span_s: float) -> dict[str, ClockOffset]:
    """Return offset and drift of each sensor that pairs connect to the reference; only significant drifts."""
    connected = _find_connected(reference, pairs)
    used = [pair for pair in pairs if pair.late in connected]
    free = [role for role in ROLES if role in connected and role != reference]
    std, at_s = np.array([(pair.std_s, pair.from_middle_s) for pair in used]).T
    signs = np.array([[(role == p.late) - float(role == p.against) for role in free] for p in used]) / std[:, None]
    prior = np.hstack((np.zeros((len(free), len(free))), np.eye(len(free)) / _DRIFT_STD))
    design = np.vstack((np.hstack((signs, signs * at_s[:, None])), prior))
    target = np.concatenate(([p.offset_s for p in used] / std, np.zeros(len(free))))
    inverse = np.linalg.pinv(design)
    solution, stds = inverse @ target, np.sqrt(np.square(inverse).sum(axis=1))
    # If windows scatter by more than their σ, the σ of a drift is inflated (Birge's ratio).
    birge = max(1.0, float(np.sum(np.square(target - design @ solution))) / max(1, len(used) - 2 * len(free)))
    offsets = {}
    for role, (offset_s, rate), (std_s, rate_std) in zip(
        free, solution.reshape(2, -1).T.tolist(), stds.reshape(2, -1).T.tolist(), strict=True
    ):
        has_drift = _is_significant(rate * span_s, np.sqrt(birge) * rate_std * span_s)
        is_significant = has_drift or _is_significant(offset_s, std_s)
        offsets[role] = ClockOffset(offset_s, std_s, is_significant, drift_ppm=1e6 * rate if has_drift else 0.0)
    return offsets


def _compute_misfit_s(pair: ClockPair, offsets: Mapping[str, ClockOffset]) -> float:
    """Return how much the offset of a pair differs from the offsets of its sensors [s]."""
    late_s, against_s = (
        float(_compute_lateness(offsets[each], pair.from_middle_s)) for each in (pair.late, pair.against)
    )
    return pair.offset_s - late_s + against_s


def _find_connected(role: str, pairs: Collection[ClockPair]) -> set[str]:
    """Return a sensor and those that pairs connect to it."""
    connected = {role}
    for _ in ROLES:
        connected |= {each for p in pairs if connected & {p.late, p.against} for each in (p.late, p.against)}
    return connected


def _compare_roughly(m: Measurements) -> Iterator[ClockPair]:
    """Yield coarse delays between sensors' stamps, by speed and turn rate in the half hour with most motion."""
    at_ns = find_liveliest_window_ns(m)
    if at_ns is None:
        return
    twists = {role: resample_twist(source, at_ns) for role, source in m.odometries().items()}
    motions = {role: (np.abs(twist[:, 0]), twist[:, 1]) for role, twist in twists.items()}
    if m.gnss is not None:
        velocity = compute_fix_velocity(m.gnss, at_ns)
        motions[GNSS] = np.abs(velocity), differentiate_course(velocity)
    if m.imu is not None:
        motions[IMU] = np.full(at_ns.size, np.nan), resample_imu(m.imu, at_ns)[0]
    signals = {role: prepare_coarse_signals(*motion) for role, motion in motions.items()}
    for against, late in combinations(signals, 2):
        lag_s = find_coarse_lag(signals[late], signals[against])
        if lag_s is not None:
            yield ClockPair(late, against, "speed", lag_s, _COARSE_STD_S, 1.0, determined=True)
