"""Find implausible sensors: frozen, too slow, in other units, mounted differently, or in conflict with other sensors.

Sensors are compared in pairs by three quantities: driven distance, turn rate, and direction (forward or backward). If
two differ, the one that fewer other sensors confirm is excluded; on a tie, both. Two checks need no second motion
sensor: gravity determines the tilt of an IMU, and the norm of its specific force the unit. The accelerations of an
odometry determine the yaw of an IMU.

All other conflicts are judged after fusion, for a whole section.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion.checks.motions import (
    GRID_S,
    average,
    compute_acceleration,
    compute_fix_velocity,
    dead_reckon,
    differentiate_course,
    find_lag,
    find_liveliest_window_ns,
    resample_fixes,
    resample_imu,
    resample_signal,
    resample_twist,
)
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, PAUSE_NS, VISUAL, WHEELS, Measurements, Positions
from tcpipe.fusion.preparation import GRAVITY_BAND_MPS2
from tcpipe.fusion.signals import Plane, hold_last
from tcpipe.fusion.state import GRAVITY_MPS2
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rpy

COMMAND = "command"  # name of the command in comparisons; it is never excluded
_CONTRADICTIONS = {
    "distance": ("distance-contradicted", (0.5, 2.0), None),
    "turn": ("yaw-rate-sign", (0.0, np.inf), np.diag([1.0, -1.0, -1.0])),
    "direction": ("drives-backwards", (0.0, np.inf), np.diag([-1.0, -1.0, 1.0])),
}
"""By quantity: code of the finding, ratio range of sensors that agree [1], rotation that corrects an odometry."""
CONSTANT_FAULTS = frozenset({"drives-backwards", "imu-rotated", "imu-units", "yaw-rate-sign"})
"""Codes of exclusions for units and mounting: they are the same in every clock epoch."""


@dataclass(frozen=True, slots=True)
class SensorExclusion:
    """A sensor that is not to be fused.

    Attributes
    ----------
    code, names, numbers : of the finding; the name ``suspect`` is the other role that may be wrong instead.
    units : value of the recipe's ``imu_units`` that corrects it.
    turned_by : rotation (3, 3) from the sensor's axes by the current extrinsics to base_link.
    scale : distance by the odometry over distance by the fixes [1].
    """

    role: str
    code: str
    names: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    units: str | None = None
    turned_by: Floats | None = None
    scale: float | None = None


Exclusions = dict[str, SensorExclusion]  # by role, in order


@dataclass(frozen=True, slots=True)
class Command:
    """Commands of a clock epoch: stamps [ns], forward velocity [m/s] and yaw rate [rad/s], sorted, shape (N,) each."""

    stamp_ns: Ints
    forward_velocity_mps: Floats
    yaw_rate_radps: Floats


def check_sensors(m: Measurements, command: Command | None, *, is_imu_stated: bool, force_mps2: float) -> Exclusions:
    """Return the sensors of a clock epoch to be excluded from fusion, with the reasons.

    Parameters
    ----------
    m : measurements in base_link axes, by the current extrinsics.
    is_imu_stated : whether the extrinsics of the IMU are stated (recipe, transforms, message in base_link) rather than
    assumed.
    force_mps2 : median norm of the specific force as measured, not corrected for the lever arm; NaN without an
    IMU.
    """
    found: Exclusions = {}
    if m.imu is not None and (rate_hz := _find_slow_rate_hz(m.imu.stamp_ns)) is not None:
        found[IMU] = SensorExclusion(IMU, "imu-too-slow", numbers={"rate_hz": rate_hz})
        m = replace(m, imu=None)
    at_ns = find_liveliest_window_ns(m)
    if at_ns is None:
        return found
    # 1. Motion by each sensor, and sensors without any.
    twists = {role: resample_twist(source, at_ns) for role, source in m.odometries().items()}
    paths = {} if m.gnss is None else {GNSS: resample_fixes(m.gnss, at_ns)}
    paths |= {role: dead_reckon(twist) for role, twist in twists.items()}
    noise_m2 = _compute_noise_m2(m.gnss)
    moving = {role for role, path in paths.items() if compute_distance_ratio(path, path, noise_m2)}
    for role, quantity, messages in _list_constants(m):
        if moving - {role}:
            found.setdefault(role, SensorExclusion(role, "frozen", {"quantity": quantity}, {"message_count": messages}))
    # 2. Turns of pairs; units and mounting of the IMU.
    rates = {role: twist[:, 1] for role, twist in twists.items()}
    rates |= {} if m.gnss is None else {GNSS: differentiate_course(compute_fix_velocity(m.gnss, at_ns))}
    turn, level, yaws_rad = np.empty(0), np.eye(3), dict[str, float]()
    if m.imu is not None and IMU not in found:
        turn, force, level = resample_imu(m.imu, at_ns)
        rates = {IMU: turn, **rates}
        yaws_rad = _find_yaws(force, twists) if m.imu.accelerometer_usable else {}
    # Over 2 s the noise of RTK fixes is below a turn; the mean is the bias of a gyroscope.
    smooth = {role: average(rate, 2.0) for role, rate in rates.items() if role not in found}
    turns = _compare_signals(smooth, centred=True)
    turn_ratios = [abs(ratio) for pair, ratio in turns.items() if IMU in pair]
    wrong = (_check_units(turn, turn_ratios, force_mps2) or _check_mounting(level, yaws_rad)) if turn.size else None
    if wrong is not None:
        found[IMU], turn, yaws_rad = wrong, np.empty(0), {}
        turns = {pair: ratio for pair, ratio in turns.items() if IMU not in pair}
    # 3. Distances and directions of pairs, with the turns of the gyroscope if there is one.
    for role, twist in twists.items() if turn.size else ():
        twist[:, 1] = np.where(np.isfinite(turn), turn, twist[:, 1])
        paths[role] = dead_reckon(twist)
    paths = {role: path for role, path in paths.items() if role not in found}
    distances = {(a, b): compute_distance_ratio(paths[a], paths[b], noise_m2) or 1.0 for a, b in combinations(paths, 2)}
    forward = {role: twist[:, 0] for role, twist in twists.items()}
    if command is not None:
        forward[COMMAND] = hold_last(command.stamp_ns, command.forward_velocity_mps, at_ns)
    directions = _compare_signals(forward)
    directions |= {(role, IMU): float(np.cos(yaw)) for role, yaw in yaws_rad.items()}
    trust = {COMMAND: 1.0, IMU: float(is_imu_stated), WHEELS: 0.5, GNSS: 0.5, VISUAL: 0.25}
    _exclude(found, "distance", distances, {}, [pair for pair, ratio in turns.items() if ratio > 0.0])
    _exclude(found, "turn", turns, trust)
    _exclude(found, "direction", directions, trust)
    return found


def _find_slow_rate_hz(stamp_ns: Ints) -> float | None:
    """Return the median rate of an IMU if most of its periods are too long to measure the motion, without pauses."""
    step_s = np.diff(stamp_ns) * 1e-9
    known_s = step_s[step_s <= PAUSE_NS * 1e-9]
    # 10 Hz, with a margin for jitter of the driver.
    is_slow = step_s.size > 0 and float(known_s[known_s < 0.11].sum()) <= 0.5 * float(known_s.sum())
    return 1.0 / float(np.median(step_s)) if is_slow else None


def _list_constants(m: Measurements) -> Iterator[tuple[str, str, int]]:
    """Yield each quantity that is exactly constant: sensor, quantity, and number of messages."""
    values = [(role, "velocity", source.velocity_mps) for role, source in m.odometries().items()]
    values += [] if m.gnss is None else [(GNSS, "position", m.gnss.position_enu_m)]
    if m.imu is not None:
        values += [
            (IMU, "acceleration", m.imu.specific_force_mps2),
            (IMU, "angular_velocity", m.imu.angular_velocity_radps),
        ]
    for role, quantity, each in values:
        if len(each) >= 20 and np.array_equal(each, np.broadcast_to(each[0], each.shape), equal_nan=True):  # ruling
            yield role, quantity, len(each)


# Units and mounting of the IMU


def _find_yaws(force: Plane, twists: Mapping[str, Floats]) -> dict[str, float]:
    """Return by odometry the yaw of the levelled IMU [rad], if accelerations determine it."""
    lags = {role: find_lag(compute_acceleration(twist), force) for role, twist in twists.items()}
    # Slopes disturb accelerometers, so the explained share is small; threshold by judgement.
    return {role: float(np.angle(lag.factor)) for role, lag in lags.items() if lag and lag.explained > 0.1}


def _check_units(turn: Floats, ratios: Sequence[float], force_mps2: float) -> SensorExclusion | None:
    """Return the exclusion of an IMU in other units, by ratios of yaw rates (others to its own) and its force."""
    names, numbers = [], dict[str, float]()
    rate_radps = np.abs(turn[np.isfinite(turn)])
    if ratios and np.median(ratios) < 1.0 / 15.0:  # 1/57 in degrees
        names, numbers = ["deg"], {"turn_ratio": 1.0 / float(np.median(ratios))}
    elif not ratios and np.count_nonzero(rate_radps > 15.0) > 0.005 * turn.size:  # no robot turns this fast
        names, numbers = ["deg"], {"rate_max": float(rate_radps.max())}
    low, high = GRAVITY_BAND_MPS2
    if low <= force_mps2 * GRAVITY_MPS2 <= high:
        names, numbers = [*names, "g"], numbers | {"force_median": force_mps2}
    units = "_".join(names)
    return SensorExclusion(IMU, "imu-units", {"units": units}, numbers, units) if names else None


def _check_mounting(level: Floats, yaws_rad: Mapping[str, float]) -> SensorExclusion | None:
    """Return the exclusion of an IMU that is tilted (by gravity) or rotated about the vertical (by accelerations)."""
    tilt_rad = float(np.arccos(np.clip(level[2, 2], -1.0, 1.0)))
    by_gravity = tilt_rad > np.radians(30.0)  # slopes average out; the steepest driven slope is 22.5°
    is_rotated = yaws_rad and all(abs(np.cos(each)) < 0.5 for each in yaws_rad.values())
    if not by_gravity and not is_rotated:
        return None
    yaw_rad = next(iter(yaws_rad.values()), 0.0)
    turned_by = find_nearest_mounting(matrix_from_quat(quat_from_rpy(0.0, 0.0, yaw_rad)) @ level)
    names = {"evidence": "gravity" if by_gravity else "acceleration"}
    off_rad = tilt_rad if by_gravity else yaw_rad
    return SensorExclusion(IMU, "imu-rotated", names, {"off_rad": off_rad}, turned_by=turned_by)


def find_nearest_mounting(base_from_sensor: Floats) -> Floats:
    """Return the nearest rotation (3, 3) by multiples of 90°, or the given one if none is within about 14°."""
    aligned = np.round(base_from_sensor)
    return aligned if np.abs(aligned - base_from_sensor).max() < 0.25 else base_from_sensor


# Comparisons

Ratios = dict[tuple[str, str], float]
"""Ratio of a quantity of two sensors, second over first, negative for the other sign [1]."""
_MAX_SCALE = 5.0
"""Largest ratio of distances that a wrong scale explains [1]; beyond it the two measure different motions."""


def _compute_noise_m2(gnss: Positions | None) -> float:
    """Return the mean square by which the noise of fixes lengthens a path [m²]."""
    return 0.0 if gnss is None else 2.0 * float(np.median(gnss.variance_m2[:, :2]))


def compute_distance_ratio(a: Plane, b: Plane, noise_m2: float) -> float | None:
    """Return the ratio of lengths of paths b and a, in windows as short as the noise allows; None without motion."""
    step_s = 0.5  # between compared positions
    both = np.stack((a, b))[:, :: round(step_s / GRID_S)]
    for window_s in (20.0, 60.0, 180.0):
        size = round(window_s / step_s)
        if both.shape[1] < size:
            return None
        rows = np.lib.stride_tricks.sliding_window_view(both, size, axis=1)[:, :: size // 4]
        square_m2 = rows[:, np.isfinite(rows.sum((0, 2)))].var(axis=2)
        far = (square_m2 > 1.0 + 2.0 * noise_m2).any(0)  # moved by more than a metre
        if far.sum() >= 3:
            a_m, b_m = np.sqrt(np.median(square_m2[:, far], axis=1))
            return float(max(b_m, 1e-3) / max(a_m, 1e-3))
    return None


_MIN_CORRELATION = 0.7  # least correlation of two signals of one motion [1]: one explains half of the other


def _compare_signals(signals: Mapping[str, Floats], *, centred: bool = False) -> Ratios:
    """Return the factors between correlated signals on the grid (M,); ``centred``: subtract their means first."""
    ratios = {}
    for a, b in combinations(signals, 2):
        both = np.stack((signals[a], signals[b]))
        both = both[:, np.isfinite(both).all(0)]
        if both.shape[1] * GRID_S < 5.0:  # a few metres are not enough
            continue
        x, y = both - both.mean(axis=1, keepdims=True) if centred else both
        power, product, other = (float(np.sum(each)) for each in (x * x, x * y, y * y))
        if abs(product) > _MIN_CORRELATION * np.sqrt(power * other):
            ratios[a, b] = product / power
    return ratios


def _exclude(
    found: Exclusions,
    quantity: str,
    ratios: Ratios,
    trust: Mapping[str, float],
    turning: Collection[tuple[str, str]] = (),
) -> None:
    """Exclude from each pair in conflict the sensor that fewer other sensors confirm; on a tie, both.

    ``trust`` counts as extra confirmations. If only fixes can check the scale of an odometry, the fixes are right. If
    two sensors measure unrelated distances, agreement of their turns with other sensors (the pairs ``turning``) also
    confirms a sensor.
    """
    code, (low, high), turned_by = _CONTRADICTIONS[quantity]
    same = [pair for pair, ratio in ratios.items() if low <= ratio <= high]
    for (a, b), ratio in ratios.items():
        if (a, b) in same:
            continue
        is_scale = quantity == "distance" and 1.0 / _MAX_SCALE < ratio < _MAX_SCALE
        confirming = same if is_scale else [*same, *turning]
        support = {role: trust.get(role, 0.0) + sum(role in pair for pair in confirming) for role in (a, b)}
        support[a] += 0.5 * (is_scale and a == GNSS)
        for role, other, times in ((a, b, 1.0 / ratio), (b, a, ratio)):
            if support[role] > support[other] or role == COMMAND:
                continue
            names = {"reference": other} | ({"suspect": other} if support[role] == support[other] else {})
            made = SensorExclusion(role, code, names, turned_by=None if role in {IMU, GNSS} else turned_by)
            if quantity == "distance":
                scale = ratio if is_scale and a == GNSS and role == b else None
                made = replace(made, numbers={"distance_ratio": times}, scale=scale)
            elif role == IMU and quantity == "direction":
                names, numbers = {**names, "evidence": "acceleration"}, {"off_rad": np.pi}
                made = SensorExclusion(role, "imu-rotated", names, numbers, turned_by=turned_by)
            before = found.setdefault(role, made)
            if before.turned_by is not None and made.turned_by is not None and before.code != made.code:
                found[role] = replace(made, turned_by=made.turned_by @ before.turned_by)


def check_ground_velocity(m: Measurements) -> SensorExclusion | None:
    """Return why the receiver's velocity of a clock epoch is excluded from fusion; None if the fixes confirm it."""
    at_ns = find_liveliest_window_ns(m)
    if m.doppler is None or at_ns is None:
        return None
    velocity = resample_signal(m.doppler.stamp_ns, m.doppler.velocity_enu_mps[:, :2], at_ns) @ np.array([1.0, 1j])
    path = np.where(np.isfinite(velocity), np.cumsum(np.nan_to_num(velocity)) * GRID_S, np.nan)
    fixes = np.full_like(path, np.nan) if m.gnss is None else resample_fixes(m.gnss, at_ns)
    misfit = compute_distance_ratio(fixes, path - fixes, _compute_noise_m2(m.gnss))
    # A quarter of the path of fixes is 14° of direction.
    return None if misfit is not None and misfit <= 0.25 else SensorExclusion(DOPPLER, "velocity-unverified")
