"""Time offsets between the stamps of a run's sensors, by what they measure of the same motion.

Small offsets are states of the estimator, and steps of a clock are hypotheses of it. Larger offsets are found before fusion. Two signals of
one motion are shifted against each other until one explains most of the other (`lags`): the yaw rate of an odometry and the gyroscope,
speeds, changes of speed and the accelerometer. They are compared only where the robot turns or changes its speed: on a straight there is
nothing to compare but what the controller corrects, and that leads the body. The course of the fixes is not held against the gyroscope: an
antenna that sits ahead of the turning point by l leads the body's course by l / v, 0.1 s for 10 cm.

The pairs together, in windows of ten minutes, give each sensor's offset and drift from the clock that most of them share. A sensor is
blamed only where two others agree against it and no pair contradicts; else two differ, and it is unknown which is wrong.

Clocks that are up to five minutes apart are found first, by speed and turn rate without their slow parts, correlated at every lag; unknown
rows have no weight (masked normalised cross-correlation: Padfield, CVPR 2010). The best lag has the largest log-likelihood ratio of both
signals. It is known only if it is far above noise, and if every other peak, and no lag, explain the same rows worse in several separate
windows and hardly better in any: a straight shows no lag, repeated lanes show several.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.lags import (
    FIXES_S,
    GRID_S,
    MAX_LAG_S,
    Floats,
    Lag,
    compute_course_rate,
    compute_fix_velocity,
    compute_lag_products,
    compute_moving_mean,
    estimate_lag,
    find_liveliest_window_ns,
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
    InertialMeasurements,
    Measurements,
    select_measurements,
)
from tcpipe.fusion.signals import compute_seconds
from tcpipe.tables.facts import ClockFacts, ClockOffset, ClockPair

ROLES = (IMU, WHEELS, VISUAL, GNSS)
"""In the order in which a clock is taken for the right one where as many agree with either: a gyroscope has the least to compute."""

_NOTED_S = 0.05
_SURE = 4.0  # standard deviations
_MAX_STD_S = 0.02
# Standard deviations of an offset that is not known well: the mean of a clock that steps scatters by more.
_CLEARLY = 10.0
_MIN_EXPLAINED = 0.25
_LEAST_STD_S = 1e-3
_COARSE_STD_S = 0.1
_WINDOW_NS, _MARGIN_NS = 600_000_000_000, 5_000_000_000
_FEWEST_WINDOWS = 3  # that show a drift
_DRIFT = 1e-3  # of a clock, 1σ
_LEAST_BY_FORCE_S = 0.02  # slopes act as accelerations: the accelerometer checks a clock rather than measures it
_TURNS_RADPS = 0.1
_CHANGES_MPS = 0.1
_LIVELY_S = 2.0  # rows this near to a turn or a change of speed are compared
_ODOMETRY_S, _ACCELERATION_S = 0.1, 0.3  # both sides are averaged over so much
_SLOW_S = 4.0  # what changes more slowly is also slip and terrain

YAW_RATE, SPEED, ACCELERATION = "yaw rate", "speed", "acceleration"

Signals = tuple[str, str, str, Floats, Floats]


def find_clock_offsets(m: Measurements, *, clock_epoch: int = 0) -> ClockFacts:
    """Return the offsets between the stamps of a clock epoch's sensors.

    Extrinsics need not be right, since a yaw rate is compared with all three axes of a gyroscope.
    """
    middle_ns, span_s = find_middle_ns(m)
    evidence: dict[tuple[str, str, str], list[tuple[float, Floats]]] = {}
    for at_ns in iterate_windows_ns(m, _WINDOW_NS):
        inside = select_measurements(m, int(at_ns[0]) - _MARGIN_NS, int(at_ns[-1]) + _MARGIN_NS)
        for late, against, by, target, regressors in _iterate_signals(inside, at_ns):
            products = compute_lag_products(target, regressors)
            if products is not None:
                at_s = (0.5 * float(at_ns[-1] - at_ns[0]) + float(at_ns[0] - middle_ns)) * 1e-9
                evidence.setdefault((late, against, by), []).append((at_s, products))
    pairs = [pair for names, windows in evidence.items() for pair in _list_pairs(*names, windows)]
    return solve_offsets(pairs, clock_epoch, span_s)


def find_middle_ns(m: Measurements) -> tuple[int, float]:
    """Return the middle of a set's measurements [ns], and how long they last [s]; 0 without any."""
    first_ns, last_ns = find_span_ns(m) or (0, 0)
    return (first_ns + last_ns) // 2, (last_ns - first_ns) * 1e-9


def find_other_clocks(m: Measurements, *, always: bool = False) -> dict[str, ClockOffset]:
    """Return by role the time offset of each sensor from the largest group of sensors that share a clock.

    Offsets that the fine search cannot find are noted. Returns {} if there are none, unless ``always``. Sensors whose offset is unknown
    are missing.
    """
    late_s = find_coarse_offsets(m)
    coarse = {
        role: ClockOffset(each, _COARSE_STD_S, noted=abs(each) > NEAR_S, blamed=False) for role, each in late_s.items()
    }
    if not always and not any(offset.noted for offset in coarse.values()):
        return {}
    found = find_clock_offsets(shift_sensors(m, coarse, 0))
    fine = {found.reference: ClockOffset(0.0, 0.0, noted=False)} | dict(found.offsets)
    zero = next((fine[role] for role, each in late_s.items() if each == 0.0 and role in fine), None)
    if zero is not None:
        for role in coarse.keys() & fine.keys():
            offset_s = late_s[role] + fine[role].offset_s - zero.offset_s
            coarse[role] = replace(coarse[role], offset_s=offset_s, std_s=fine[role].std_s + zero.std_s)
    return coarse


def shift_sensors(m: Measurements, offsets: Mapping[str, ClockOffset], middle_ns: int) -> Measurements:
    """Return measurements whose stamps are without the offsets of their sensors, and the drifts about ``middle_ns``."""
    off = {role: sensor for role, sensor in m.sensors().items() if role in offsets}
    stamps = {role: shift_stamps(sensor.stamp_ns, offsets[role], middle_ns) for role, sensor in off.items()}
    return m.replace_sensors({role: replace(sensor, stamp_ns=stamps[role]) for role, sensor in off.items()})


def shift_stamps(stamp_ns: NDArray[np.int64], offset: ClockOffset, middle_ns: int) -> NDArray[np.int64]:
    """Return stamps [ns] without an offset and its drift."""
    return stamp_ns - np.rint(1e9 * _compute_lateness(offset, compute_seconds(stamp_ns, middle_ns))).astype(np.int64)


def _compute_lateness(offset: ClockOffset, from_middle_s: Floats | float) -> Floats:
    return np.asarray(offset.offset_s + 1e-6 * offset.drift_ppm * from_middle_s)


def _list_pairs(late: str, against: str, by: str, windows: Sequence[tuple[float, Floats]]) -> list[ClockPair]:
    """Return two sensors compared: in each window if three determine the offset, else over the run."""
    found = [(at_s, estimate_lag([products])) for at_s, products in windows] if len(windows) >= _FEWEST_WINDOWS else []
    pairs = [pair for at_s, lag in found if lag and (pair := make_pair(late, against, by, lag, at_s)).determined]
    if len(pairs) >= _FEWEST_WINDOWS:
        return pairs
    whole = estimate_lag([products for _, products in windows])
    return [make_pair(late, against, by, whole)] if whole and np.isfinite(whole.std_s) else []


def make_pair(late: str, against: str, by: str, lag: Lag, from_middle_s: float = 0.0) -> ClockPair:
    """Return two sensors compared; a lag is determined where its error is small or it is surely not zero."""
    is_clear = lag.std_s <= 3 * _MAX_STD_S and abs(lag.offset_s) > _CLEARLY * lag.std_s
    known = lag.std_s <= _MAX_STD_S or is_clear
    return ClockPair(
        late,
        against,
        by,
        lag.offset_s,
        lag.std_s,
        lag.explained,
        known and lag.explained >= _MIN_EXPLAINED,
        from_middle_s,
    )


def _iterate_signals(m: Measurements, at_ns: NDArray[np.int64]) -> Iterator[Signals]:
    """Yield what can be compared: whose stamps against whose, by what, target and regressors on the grid."""
    twists = {role: resample_twist(source, at_ns) for role, source in m.odometries().items()}
    if m.imu is not None:
        yield from _compare_with_imu(m.imu, twists, at_ns)
    if len(twists) == 2:
        speed = {role: compute_moving_mean(np.abs(twist[:, :1]), _ODOMETRY_S) for role, twist in twists.items()}
        yield VISUAL, WHEELS, SPEED, *_select_speed_changes(speed[VISUAL], speed[WHEELS])
    if m.gnss is not None:
        velocity = compute_fix_velocity(m.gnss, at_ns)
        for role, twist in twists.items():
            seen = compute_moving_mean(_compute_antenna_speed(twist, m.gnss.lever_arm_m), FIXES_S)
            yield (
                GNSS,
                role,
                SPEED,
                *_select_speed_changes(np.abs(velocity)[:, None], compute_moving_mean(seen, FIXES_S)),
            )
        if m.doppler is not None:
            of_receiver = resample_signal(m.doppler.stamp_ns, m.doppler.velocity_enu_mps[:, :2], at_ns)
            own = compute_moving_mean(compute_moving_mean(of_receiver, FIXES_S), FIXES_S)
            yield DOPPLER, GNSS, "velocity east", own[:, 0], velocity.real[:, None]
            yield DOPPLER, GNSS, "velocity north", own[:, 1], velocity.imag[:, None]


def _compare_with_imu(
    imu: InertialMeasurements, twists: Mapping[str, Floats], at_ns: NDArray[np.int64]
) -> Iterator[Signals]:
    """Yield the comparisons of odometries with gyroscope and accelerometer: turns and changes of speed."""
    gyro = compute_moving_mean(resample_signal(imu.stamp_ns, imu.angular_velocity_radps, at_ns), _ODOMETRY_S)
    force = resample_signal(imu.stamp_ns, imu.specific_force_mps2, at_ns)
    force = _remove_slow_parts(compute_moving_mean(force, _ACCELERATION_S))
    for role, twist in twists.items():
        turning = compute_moving_mean(twist, _ODOMETRY_S)[:, 1]
        yield role, IMU, YAW_RATE, np.where(_find_rows_near(np.abs(turning) > _TURNS_RADPS), turning, np.nan), gyro
        if imu.accelerometer_usable:
            speed = compute_moving_mean(twist[:, :1], _ACCELERATION_S)
            rate = _remove_slow_parts(np.gradient(speed, GRID_S, axis=0))[:, 0]
            yield role, IMU, ACCELERATION, np.where(_find_speed_changes(speed), rate, np.nan), force


def _select_speed_changes(target: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Return two speeds (M, 1) without their slow parts, the first only near changes of the second."""
    return np.where(_find_speed_changes(seen), _remove_slow_parts(target)[:, 0], np.nan), _remove_slow_parts(seen)


def _find_speed_changes(speed: Floats) -> NDArray[np.bool_]:
    return _find_rows_near(np.abs(_remove_slow_parts(speed)[:, 0]) > _CHANGES_MPS)


def _find_rows_near(lively: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return what lies near something lively, shape (M,)."""
    beside: NDArray[np.bool_] = compute_moving_mean(lively.astype(np.float64)[:, None], 2 * _LIVELY_S)[:, 0] > 0
    return beside


def _remove_slow_parts(values: Floats) -> Floats:
    """Return (M, k) values without their slow parts, which slip and terrain change, and starts, stops and turns do not need."""
    return values - compute_moving_mean(values, _SLOW_S)


def _compute_antenna_speed(twist: Floats, lever_arm_m: tuple[float, float, float]) -> Floats:
    """Return the antenna's speed by forward velocity and yaw rate, shape (M, 2), of an odometry [m/s], shape (M, 1)."""
    forward, yaw_rate = twist.T
    speed: Floats = np.hypot(forward - yaw_rate * lever_arm_m[1], yaw_rate * lever_arm_m[0])
    return speed[:, None]


def solve_offsets(pairs: Sequence[ClockPair], clock_epoch: int = 0, span_s: float = 0.0) -> ClockFacts:
    """Return each sensor's offset from the clock that most sensors share, by weighted least squares over the pairs that are determined.

    The receiver's velocity has no say: it has the clock of the fixes, and no label needs it.
    """
    known = [pair for pair in pairs if pair.determined]
    solved = {
        role: _solve_against(role, known, span_s) for role in ROLES if any(role in {p.late, p.against} for p in known)
    }
    if not solved:
        return ClockFacts(clock_epoch, "", tuple(pairs), {})
    agreeing = {role: {role, *_find_agreeing(offsets)} for role, offsets in solved.items()}
    reference = max(solved, key=lambda role: len(agreeing[role]))  # the first of equals
    offsets = {reference: ClockOffset(0.0, 0.0, noted=False)} | solved[reference]
    blamed = {role: role == DOPPLER or _is_blamed(role, agreeing[reference], offsets, known) for role in offsets}
    decided = {role: replace(offset, blamed=blamed[role]) for role, offset in solved[reference].items()}
    return ClockFacts(clock_epoch, reference, tuple(pairs), decided)


def _get_std_s(pair: ClockPair) -> float:
    """Return the standard deviation of a pair beside those of others [s]."""
    return max(pair.std_s, _LEAST_BY_FORCE_S if pair.by == ACCELERATION else _LEAST_STD_S)


def _solve_against(reference: str, pairs: Sequence[ClockPair], span_s: float) -> dict[str, ClockOffset]:
    """Return offset and drift of each sensor that pairs connect to the reference; no drift unless windows determine it."""
    connected = _find_connected(reference, pairs)
    used = [pair for pair in pairs if pair.late in connected]
    free = [role for role in (*ROLES, DOPPLER) if role in connected and role != reference]
    std, at_s = np.array([_get_std_s(pair) for pair in used]), np.array([pair.from_middle_s for pair in used])
    signs = np.array([[(role == p.late) - float(role == p.against) for role in free] for p in used]) / std[:, None]
    prior = np.hstack((np.zeros((len(free), len(free))), np.eye(len(free)) / _DRIFT))
    design = np.vstack((np.hstack((signs, signs * at_s[:, None])), prior))
    target = np.concatenate(([p.offset_s for p in used] / std, np.zeros(len(free))))
    inverse = np.linalg.pinv(design)
    found, stds = inverse @ target, np.sqrt(np.square(inverse).sum(axis=1))
    # Windows that scatter by more than they claim widen the deviation of a drift (Birge's ratio).
    birge = max(1.0, float(np.sum(np.square(target - design @ found))) / max(1, len(used) - 2 * len(free)))
    offsets = {}
    for role, (offset_s, rate), (std_s, rate_std) in zip(
        free, found.reshape(2, -1).T.tolist(), stds.reshape(2, -1).T.tolist(), strict=True
    ):
        drifts = abs(rate) > max(_SURE * np.sqrt(birge) * rate_std, _NOTED_S / max(span_s, 1.0))
        noted = bool(drifts or abs(offset_s) > max(_NOTED_S, _SURE * std_s))
        offsets[role] = ClockOffset(offset_s, std_s, noted, drift_ppm=1e6 * rate if drifts else 0.0)
    return offsets


def _find_connected(role: str, pairs: Collection[ClockPair]) -> set[str]:
    """Return a sensor and those that pairs connect to it."""
    connected = {role}
    for _ in ROLES:
        connected |= {each for p in pairs if connected & {p.late, p.against} for each in (p.late, p.against)}
    return connected


def _find_agreeing(offsets: Mapping[str, ClockOffset]) -> set[str]:
    """Return the sensors near the reference, however certain: a reference clock with a large σ proves no offset."""
    near = {role for role, offset in offsets.items() if abs(offset.offset_s) <= _NOTED_S and not offset.drift_ppm}
    return near - {DOPPLER}


def _is_blamed(
    role: str, agreeing: Collection[str], offsets: Mapping[str, ClockOffset], pairs: Sequence[ClockPair]
) -> bool:
    """Whether two sensors that agree speak against a role by the same kind of motion, and no pair contradicts any of them.

    A yaw rate says nothing of the clock of a speed: a filter may pass the gyroscope's on at once and smooth the wheels'.
    """
    if role in agreeing:
        return False
    among = [p for p in pairs if {p.late, p.against} <= {role, *agreeing}]
    for p in among:
        late_s, against_s = (float(_compute_lateness(offsets[each], p.from_middle_s)) for each in (p.late, p.against))
        if abs(p.offset_s - late_s + against_s) > max(_SURE * _get_std_s(p), _NOTED_S):
            return False
    kinds = ([p for p in among if (p.by == YAW_RATE) == turning] for turning in (True, False))
    return any(len(_find_connected(role, of_kind)) > 2 for of_kind in kinds)


# Clocks that are seconds to minutes apart

_ROW_S = 0.2
NEAR_S = MAX_LAG_S - _ROW_S
"""Largest lag that the fine search surely finds [s]."""
_MOST = 1500
"""Largest lag that is searched [rows], 5 min."""
_SMOOTH, _SLOW = 5, 151
"""Rows over which signals are averaged, and about whose mean they are compared: 1 s and 30 s."""
_MANOEUVRES = (0.15, 0.1)
"""Least size of a signal that varies [m/s], [rad/s]."""
_FEWEST, _INDEPENDENT = 450, 10
"""Rows of the least overlap, 90 s, and between independent ones, 2 s."""
_MIN_SCORE, _MIN_CORRELATION = 18.0, 0.4
"""Least log-likelihood ratio of the best lag, 6 σ: noise reaches 4 σ in 3,000 lags; and least correlation of one signal."""
_WINDOW, _MIN_WINDOWS = 50, 4
"""Rows in which two lags are compared, 10 s, and windows that have to prefer the best lag."""
_APART, _PEAKS = 15, 25
"""Rows between separate peaks, 3 s, and most peaks that are compared with the best."""


def find_coarse_offsets(m: Measurements) -> dict[str, float]:
    """Return how late sensors' stamps are against those of the largest group that shares a clock [s], those of the group about 0.

    Sensors whose offset is unknown are missing; {} if the pairs of sensors contradict each other.
    """
    at_ns = find_liveliest_window_ns(m)
    if at_ns is None or at_ns.size * GRID_S < _FEWEST * _ROW_S:
        return {}
    signals = _compute_motion(m, at_ns)
    lags = dict[tuple[str, str], float]()
    for against, late in combinations(signals, 2):
        lag_s = find_coarse_lag(signals[late], signals[against])
        lags |= {} if lag_s is None else {(late, against): lag_s, (against, late): -lag_s}
    late_s = {first: 0.0 for first, _ in sorted(lags, key=lambda pair: abs(lags[pair]) <= NEAR_S)[:1]}
    for _ in signals:
        for (late, against), lag_s in lags.items():
            if against in late_s:
                late_s.setdefault(late, late_s[against] + lag_s)
    if any(abs(late_s[a] - late_s[b] - lag_s) > NEAR_S for (a, b), lag_s in lags.items() if a in late_s):
        return {}
    groups = [{role: each - late_s[first] for role, each in late_s.items()} for first in signals if first in late_s]
    # Of equal groups, that of the first sensor.
    return max(groups, key=lambda group: sum(abs(each) <= NEAR_S for each in group.values()), default={})


def _compute_motion(m: Measurements, at_ns: NDArray[np.int64]) -> dict[str, Floats]:
    """Return speed and turn rate of each sensor by rows of 0.2 s, shape (2, N); odometries first, the IMU last."""
    found, unknown = dict[str, tuple[Floats, Floats]](), np.full(at_ns.size, np.nan)
    for role, source in m.odometries().items():
        forward, yaw_rate = resample_twist(source, at_ns).T
        found[role] = np.abs(forward), yaw_rate
    if m.gnss is not None:
        velocity = compute_fix_velocity(m.gnss, at_ns)
        found[GNSS] = np.abs(velocity), compute_course_rate(velocity)
    if m.imu is not None:
        up = np.median(m.imu.specific_force_mps2, axis=0) if m.imu.accelerometer_usable else np.array([0.0, 0.0, 1.0])
        rate = resample_signal(m.imu.stamp_ns, m.imu.angular_velocity_radps, at_ns)
        found[IMU] = unknown, rate @ up / max(float(np.linalg.norm(up)), 1e-9)
    return {
        role: np.stack([_find_quick_part(*each) for each in zip(pair, _MANOEUVRES, strict=True)])
        for role, pair in found.items()
    }


def _find_quick_part(values: Floats, least: float) -> Floats:
    """Return a signal in windows of rows, smoothed over 1 s, less the mean of 30 s around each; NaN if it varies by less than ``least``."""
    width = round(_ROW_S / GRID_S)
    rows = values[: values.size // (width * _WINDOW) * width * _WINDOW].reshape(-1, width).mean(1)
    smooth = np.where(np.isfinite(rows), _average(rows, _SMOOTH), np.nan)
    quick = smooth - _average(smooth, _SLOW)
    return quick if (np.abs(quick) > least).sum() > _SMOOTH else np.full(quick.size, np.nan)


def _average(values: Floats, width: int) -> Floats:
    """Return the mean of the known values among ``width`` rows around each."""
    known, inside = np.isfinite(values), slice(width // 2, width // 2 + values.size)
    sums, counts = (np.convolve(each, np.ones(width))[inside] for each in (np.where(known, values, 0.0), known))
    mean: Floats = sums / np.maximum(counts, 1.0)
    return mean


def find_coarse_lag(late: Floats, against: Floats) -> float | None:
    """Return how much later the stamps of one sensor are than another's [s], None where this is unknown; signals of shape (2, N)."""
    correlation, rows = _correlate(late, against)
    log_ratio = -0.5 * np.log(1.0 - np.maximum(correlation, 0.0) ** 2)
    score, height = (rows * log_ratio).sum(0) / _INDEPENDENT, log_ratio.sum(0)
    best = int(np.argmax(score))
    if best in {0, 2 * _MOST} or score[best] < _MIN_SCORE or correlation[:, best].max() < _MIN_CORRELATION:
        return None
    if abs(best - _MOST) * _ROW_S > NEAR_S:
        peaks = 1 + np.flatnonzero((height[1:-1] >= height[:-2]) & (height[1:-1] > height[2:]))
        peaks = peaks[np.abs(peaks - best) > _APART]
        peaks = np.append(peaks[np.argsort(-height[peaks], kind="stable")][:_PEAKS], _MOST)
        if any(_is_rival(late, against, best - _MOST, int(peak) - _MOST) for peak in peaks if height[peak] > 0):
            return None
    before, at, after = score[best - 1 : best + 2]
    return float((best - _MOST + 0.5 * (after - before) / max(2.0 * at - before - after, 1e-9)) * _ROW_S)


def _correlate(late: Floats, against: Floats) -> tuple[Floats, Floats]:
    """Return the correlation of each signal at all lags, and the rows in which both are known, shape (2, 2 `_MOST` + 1) each."""
    size = 1 << (late.shape[1] + _MOST).bit_length()

    def multiply(a: Floats, b: Floats) -> Floats:
        """Return the sums of a(t) b(t + lag)."""
        sums = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
        return np.concatenate((sums[:, -_MOST:], sums[:, : _MOST + 1]), axis=1)

    a, b, known_a, known_b = (
        np.nan_to_num(against),
        np.nan_to_num(late),
        1.0 * np.isfinite(against),
        1.0 * np.isfinite(late),
    )
    rows = np.rint(multiply(known_a, known_b))
    sum_a, sum_b, counts = multiply(a, known_b), multiply(known_a, b), np.maximum(rows, 1.0)
    squares = np.stack((multiply(a**2, known_b) - sum_a**2 / counts, multiply(known_a, b**2) - sum_b**2 / counts))
    # A short overlap, and one without motion, show nothing.
    enough = (rows >= _FEWEST) & (squares > 0.2 * np.median(squares, axis=2, keepdims=True) + 1e-9).all(0)
    products = np.where(enough, multiply(a, b) - sum_a * sum_b / counts, 0.0)
    return np.clip(products / np.sqrt(np.where(enough, squares.prod(0), 1.0)), -0.9999, 0.9999), rows


def _is_rival(late: Floats, against: Floats, best: int, other: int) -> bool:
    """Return whether a lag [rows] explains the same rows about as well as the best: few windows prefer the best, or some the other."""
    residuals, of_other = (_compute_residuals(late, against, lag) for lag in (best, other))
    noise = np.nansum(residuals, axis=1) / np.maximum(np.isfinite(residuals).sum(1), 1)
    worse = ((of_other - residuals) / np.maximum(noise, 1e-12)[:, None]).reshape(2, -1, _WINDOW)
    clear = 0.5 * np.maximum(np.isfinite(worse).sum((0, 2)), _WINDOW)
    total = np.nansum(worse, axis=(0, 2))
    return bool((total > clear).sum() - 3 * (total < -clear).sum() < _MIN_WINDOWS)


def _compute_residuals(late: Floats, against: Floats, lag: int) -> Floats:
    """Return the squares of what the other signals, ``lag`` rows later, leave of the late ones, shape (2, N); NaN where unknown."""
    moved, size = np.full_like(late, np.nan), late.shape[1]
    moved[:, max(lag, 0) : max(size + lag, 0)] = against[:, max(-lag, 0) : max(size - lag, 0)]
    known = np.isfinite(moved) & np.isfinite(late)
    counts = np.maximum(known.sum(1, keepdims=True), 1)
    x, y = (
        np.where(known, each - np.sum(each, axis=1, where=known, keepdims=True) / counts, 0.0) for each in (moved, late)
    )
    slope = np.sum(x * y, axis=1, keepdims=True) / np.maximum(np.sum(x * x, axis=1, keepdims=True), 1e-12)
    return np.where(known, (y - np.maximum(slope, 0.0) * x) ** 2, np.nan)
