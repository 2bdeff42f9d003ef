"""Sensors that cannot be right: frozen, too slow, in another unit, mounted otherwise, or unlike the other sensors.

Sensors are compared in pairs by three quantities: the distance that they drive, how they turn, and whether they drive forward. Of two that
differ, the one that fewer others confirm is excluded; both are, on a tie. Two facts need no second sensor of motion: gravity shows the tilt
of an IMU, and the size of its specific force the unit. An odometry's accelerations show the yaw of an IMU.

Nothing else is decided before fusion: a section that its sensors do not explain is doubted as a whole afterwards.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats
from tcpipe.fusion.checks.motions import (
    GRID_S,
    SMOOTH_S,
    Lag,
    average,
    compute_acceleration,
    compute_fix_velocity,
    dead_reckon,
    differentiate_course,
    find_lag,
    find_liveliest_window_ns,
    find_turn,
    resample_fixes,
    resample_imu,
    resample_signal,
    resample_twist,
)
from tcpipe.fusion.dead_reckoning import MIN_SPEED_MPS
from tcpipe.fusion.measurements import (
    DOPPLER,
    GNSS,
    IMU,
    PAUSE_NS,
    VISUAL,
    WHEELS,
    InertialMeasurements,
    Measurements,
    Positions,
)
from tcpipe.fusion.preparation import GRAVITY_BAND_MPS2
from tcpipe.fusion.signals import Plane, hold_last
from tcpipe.fusion.state import GRAVITY_MPS2
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rpy

COMMAND = "command"
"""The command among the sensors; it is never excluded."""
FORWARD, YAW = np.diag([-1.0, -1.0, 1.0]), np.diag([1.0, -1.0, -1.0])
"""Rotations that turn only the x axis of a body round, or only its yaw rate."""
_CONTRADICTIONS = {
    "distance": ("distance-contradicted", (0.5, 2.0), None),
    "turn": ("yaw-rate-sign", (0.0, np.inf), YAW),
    "direction": ("drives-backwards", (0.0, np.inf), FORWARD),
}
"""By quantity: code of the finding, ratios of two sensors that agree [1], and what sets an odometry right."""
CONSTANT_FAULTS = frozenset({"drives-backwards", "imu-rotated", "imu-units", "yaw-rate-sign"})
"""Codes of exclusions for units and mounting, which no restart of a clock changes."""


@dataclass(frozen=True, slots=True)
class SensorExclusion:
    """A sensor that is not to be fused.

    Attributes
    ----------
    code, names, numbers : of the finding; the name ``suspect`` is the other role that may be wrong instead.
    units : value of the recipe's ``imu_units`` that sets it right.
    turned_by : rotation (3, 3) from what the extrinsics in use make of the sensor to base_link.
    scale : of an odometry, how many times as far as the fixes it drives.
    """

    role: str
    code: str
    names: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    units: str | None = None
    turned_by: Floats | None = None
    scale: float | None = None


Exclusions = dict[str, SensorExclusion]
"""By role, in order."""


@dataclass(frozen=True, slots=True)
class Command:
    """Commands of a clock epoch: stamps [ns], forward velocity [m/s] and yaw rate [rad/s], in order, shape (N,) each."""

    stamp_ns: NDArray[np.int64]
    forward_velocity_mps: Floats
    yaw_rate_radps: Floats


def check_sensors(m: Measurements, command: Command | None, *, is_imu_stated: bool, felt: float) -> Exclusions:
    """Return which sensors of a clock epoch are not to be fused.

    Parameters
    ----------
    m : measurements in base_link axes, by the extrinsics in use.
    is_imu_stated : whether the extrinsics of the IMU are stated (recipe, transforms, message in base_link) rather than assumed.
    felt : median size of the specific force as the IMU measured it, before its lever arm was taken out; NaN without an IMU.
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
    # 2. Units and mounting of the IMU.
    rates = {role: twist[:, 1] for role, twist in twists.items()}
    rates |= {} if m.gnss is None else {GNSS: differentiate_course(compute_fix_velocity(m.gnss, at_ns))}
    turn, yaws_rad = _check_imu(found, m.imu, at_ns, twists, rates, felt=felt)
    rates = {IMU: turn, **rates} if turn.size else rates
    # 3. Distances, by the turns of the gyroscope if there is one; turns and directions of pairs.
    signs = {role: lag.factor.real for role, lag in _compare_turns(rates, _TURN_S).items()}
    for role, twist in twists.items() if turn.size else ():
        twist[:, 1] = np.where(np.isfinite(turn), turn, twist[:, 1])
        paths[role] = dead_reckon(twist)
    forward = {role: twist[:, 0] for role, twist in twists.items()}
    if command is not None:
        forward[COMMAND] = hold_last(command.stamp_ns, command.forward_velocity_mps, at_ns)
    trust = {COMMAND: 1.0, IMU: float(is_imu_stated), WHEELS: 0.5, VISUAL: 0.25}
    paths = {role: path for role, path in paths.items() if role not in found}
    confirmed = {role for role, sign in signs.items() if turn.size and sign > 0.0}
    _exclude(found, "distance", _compare_distances(paths, noise_m2, confirmed), {})
    _exclude(found, "turn", {(a, b): signs[b] / signs[a] for a, b in combinations(signs, 2)}, trust | {GNSS: 0.5})
    _exclude(found, "direction", _compare_directions(forward, yaws_rad), trust)
    return found


_SLOWEST_S = 0.11
"""Longest period of an IMU that shows the motion between its samples [s]: 10 Hz, with the jitter of its driver."""
_MIN_VALUES = 20
"""Samples that show that a sensor is frozen [1] (ruling)."""


def _find_slow_rate_hz(stamp_ns: NDArray[np.int64]) -> float | None:
    """Return the median rate of an IMU whose samples are mostly too far apart to show the motion between them; pauses do not count."""
    step_s = np.diff(stamp_ns) * 1e-9
    known_s = step_s[step_s <= PAUSE_NS * 1e-9]
    is_slow = step_s.size > 0 and float(known_s[known_s < _SLOWEST_S].sum()) <= 0.5 * float(known_s.sum())
    return 1.0 / float(np.median(step_s)) if is_slow else None


def _list_constants(m: Measurements) -> Iterator[tuple[str, str, int]]:
    """Yield the sensors of which a quantity is the same to the last digit throughout, the quantity, and the number of messages."""
    values = [(role, "velocity", source.velocity_mps) for role, source in m.odometries().items()]
    values += [] if m.gnss is None else [(GNSS, "position", m.gnss.position_enu_m)]
    if m.imu is not None:
        values += [
            (IMU, "acceleration", m.imu.specific_force_mps2),
            (IMU, "angular_velocity", m.imu.angular_velocity_radps),
        ]
    for role, quantity, each in values:
        if len(each) >= _MIN_VALUES and np.array_equal(each, np.broadcast_to(each[0], each.shape), equal_nan=True):
            yield role, quantity, len(each)


# Units and mounting of the IMU

_IN_DEGREES, _MAX_YAW_RATE_RADPS = 1.0 / 15.0, 15.0
"""Largest factor from a yaw rate in degrees to one in radians, 1/57 ideally [1]; and a yaw rate that no robot reaches [rad/s]."""
_TILTED_RAD, _ASIDE_RAD, _BACKWARDS_RAD = np.radians([30.0, 60.0, 120.0])
"""Least tilt of a rotated IMU: slopes average out, and the steepest that is driven is 22.5°; yaws that look aside and backwards [rad]."""
_MIN_AGREEMENT, _MIN_COHERENCE, _MAX_YAW_STD_RAD = 0.5, 0.3, 0.1
"""Least agreement of two turns or directions, and of accelerations (0 to 1), and the largest σ of a yaw by accelerations [rad]."""


def _check_imu(
    found: Exclusions,
    imu: InertialMeasurements | None,
    at_ns: NDArray[np.int64],
    twists: Mapping[str, Floats],
    rates: Mapping[str, Floats],
    *,
    felt: float,
) -> tuple[Floats, dict[str, float]]:
    """Check units and mounting of an IMU; return its yaw rate and its yaw by each odometry [rad], nothing where it is excluded."""
    if imu is not None:
        turn, force, level = resample_imu(imu, at_ns)
        turns = _compare_turns({IMU: turn, **rates}, SMOOTH_S)
        yaws_rad = _find_yaws(force, twists, turns)
        if IMU not in found:
            _check_units(found, turns, turn, felt)
        if IMU not in found and imu.accelerometer_usable:
            _check_mounting(found, level, yaws_rad)
        if IMU not in found:
            return turn, yaws_rad
    return np.empty(0), {}


def _compare_turns(rates: Mapping[str, Floats], width_s: float) -> dict[str, Lag]:
    """Return by sensor how its yaw rate follows from that of the first that has one; the first follows from itself."""
    smooth = {role: average(rate, width_s) for role, rate in rates.items() if np.nan_to_num(rate).any()}
    if not smooth:
        return {}
    first, *others = smooth
    lags = {role: find_lag(smooth[role], smooth[first]) for role in others}
    known = {role: lag for role, lag in lags.items() if lag is not None and lag.explained > _MIN_AGREEMENT}
    return {first: Lag(0.0, 0.0, 1.0)} | known


def _find_yaws(force: Plane, twists: Mapping[str, Floats], turns: Mapping[str, Lag]) -> dict[str, float]:
    """Return by odometry the yaw of the levelled IMU [rad] where accelerations show it."""
    found = {}
    for role, twist in twists.items():
        turned = find_turn(compute_acceleration(twist), force, turns[role].offset_s if role in turns else 0.0)
        if turned is not None and turned[1] < _MAX_YAW_STD_RAD and turned[2] > _MIN_COHERENCE:
            found[role] = turned[0]
    return found


def _check_units(found: Exclusions, turns: Mapping[str, Lag], turn: Floats, felt: float) -> None:
    """Exclude an IMU that seems to be in other units: by how many times as fast as another sensor it turns, and the median force."""
    evidence: dict[str, dict[str, float]] = {}
    factors = [abs(lag.factor) for role, lag in turns.items() if role != IMU]
    scale, known = float(np.median(factors or [1.0])), np.abs(turn[np.isfinite(turn)])
    if scale < _IN_DEGREES:
        evidence["deg"] = {"turn_ratio": 1.0 / scale}
    elif not factors and known.size and np.percentile(known, 99.5) > _MAX_YAW_RATE_RADPS:
        evidence["deg"] = {"rate_max": float(known.max())}
    low, high = GRAVITY_BAND_MPS2
    evidence |= {"g": {"force_median": felt}} if low <= felt * GRAVITY_MPS2 <= high else {}
    if evidence:
        units = "_".join(evidence)
        numbers = {name: value for of_unit in evidence.values() for name, value in of_unit.items()}
        found[IMU] = SensorExclusion(IMU, "imu-units", {"units": units}, numbers, units)


def _check_mounting(found: Exclusions, level: Floats, yaws_rad: Mapping[str, float]) -> None:
    """Exclude an IMU that the rotation by which gravity levels it shows to be tilted, or accelerations to look aside."""
    off_rad = float(np.arccos(np.clip(level[2, 2], -1.0, 1.0)))
    is_aside = yaws_rad and all(_ASIDE_RAD < abs(each) <= _BACKWARDS_RAD for each in yaws_rad.values())
    if off_rad > _TILTED_RAD or is_aside:
        yaw_rad = next(iter(yaws_rad.values()), 0.0)
        turned_by = find_nearest_mounting(matrix_from_quat(quat_from_rpy(0.0, 0.0, yaw_rad)) @ level)
        by_gravity = off_rad > _TILTED_RAD
        names = {"evidence": "gravity" if by_gravity else "acceleration"}
        numbers = {"off_rad": off_rad if by_gravity else yaw_rad}
        found[IMU] = SensorExclusion(IMU, "imu-rotated", names, numbers, turned_by=turned_by)


_AXIS_ALIGNED_RAD = 0.25
"""Angle within which a mounting is taken as along the axes [rad] (ruling)."""


def find_nearest_mounting(base_from_sensor: Floats) -> Floats:
    """Return the rotation (3, 3) with axes along axes that is nearest, or the given one where none is near."""
    largest = np.argmax(np.abs(base_from_sensor), axis=1)
    aligned = np.zeros((3, 3))
    aligned[np.arange(3), largest] = np.sign(base_from_sensor[np.arange(3), largest])
    if abs(np.linalg.det(aligned) - 1.0) > 1e-9:
        return base_from_sensor
    angle = np.arccos(np.clip((np.trace(aligned.T @ base_from_sensor) - 1) / 2, -1.0, 1.0))
    return aligned if angle < _AXIS_ALIGNED_RAD else base_from_sensor


# Comparisons

Ratios = dict[tuple[str, str], float]
"""By two sensors, how many times as large a quantity of the second is as that of the first, negative for the other sign [1]."""
_TURN_S = 2.0
"""Time over which yaw rates are averaged before their signs are compared [s]: the noise of centimetres in fixes is below a turn."""
_WINDOWS_S = (20.0, 60.0, 180.0)
"""Windows of paths [s]: longer ones where the noise of fixes hides what is driven in shorter ones."""
_FAR_M, _MIN_MOVING_WINDOWS = 1.0, 3
"""Size of a path that moves [m], and number of windows that show how far a robot drives (rulings)."""
_MAX_SCALE, _STILL_RATIO = 5.0, 20.0
"""Ratios of distances up to which an odometry has another scale, and from which on the shorter one does not move [1]."""
_NODE = round(0.5 / GRID_S)
"""Rows of the grid between the places that are compared [1]."""
_MIN_MOVING_ROWS = round(2.0 / GRID_S)
"""Rows of the grid that show how two directions agree, 2 s [1]."""


def _compute_noise_m2(gnss: Positions | None) -> float:
    """Return the mean square that the noise of fixes adds to a path [m²]."""
    return 0.0 if gnss is None else 2.0 * float(np.median(gnss.variance_m2[:, :2]))


def compute_distance_ratio(a: Plane, b: Plane, noise_m2: float) -> float | None:
    """Return how many times as far as path a path b goes, in windows as short as the noise of fixes allows; None if neither moves."""
    both = np.stack((a, b))[:, ::_NODE]
    for window_s in _WINDOWS_S:
        size = round(window_s / GRID_S / _NODE)
        if both.shape[1] < size:
            return None
        rows = np.lib.stride_tricks.sliding_window_view(both, size, axis=1)[:, :: size // 4]
        square_m2 = rows[:, np.isfinite(rows.sum((0, 2)))].var(axis=2)
        far = (square_m2 > _FAR_M**2 + 2.0 * noise_m2).any(0)
        if far.sum() >= _MIN_MOVING_WINDOWS:
            a_m, b_m = np.sqrt(np.median(square_m2[:, far], axis=1))
            return float(b_m / max(a_m, 1e-3))
    return None


def _compare_distances(paths: Mapping[str, Plane], noise_m2: float, confirmed: Collection[str]) -> Ratios:
    """Return ratios of distances; wheels that spin on the spot contradict nothing.

    If one of two sensors does not move, the gyroscope confirms the other where it turns with it.
    """
    pairs = {(a, b): compute_distance_ratio(paths[a], paths[b], noise_m2) for a, b in combinations(paths, 2)}
    ratios = {names: ratio for names, ratio in pairs.items() if ratio is not None}
    same = [names for names, ratio in ratios.items() if _is_same("distance", ratio)]
    for names, ratio in [*ratios.items()]:
        fast = names[1] if ratio > 1.0 else names[0]
        if not 1.0 / _STILL_RATIO < ratio < _STILL_RATIO:
            if fast in confirmed:
                ratios[fast, IMU] = 1.0
            elif fast == WHEELS and not any(fast in each for each in same):
                del ratios[names]
    return ratios


def _compare_directions(forward: Mapping[str, Floats], yaws_rad: Mapping[str, float]) -> Ratios:
    """Return whether odometries, command and accelerations go forward at once, as -1 to 1; an IMU that looks aside shows nothing."""
    is_aside = {role: _ASIDE_RAD < abs(yaw) <= _BACKWARDS_RAD for role, yaw in yaws_rad.items()}
    found = {(role, IMU): float(np.cos(yaw)) for role, yaw in yaws_rad.items() if not is_aside[role]}
    for a, b in combinations(forward, 2):
        agreement = compute_agreement(forward[a], forward[b])
        if agreement is not None and abs(agreement) > _MIN_AGREEMENT:
            found[a, b] = agreement
    return found


def compute_agreement(velocity_mps: Floats, other_mps: Floats) -> float | None:
    """Return by how much two signed velocities go the same way, -1 to 1, or None where one of them hardly moves; shape (M,) each."""
    moving = (np.abs(velocity_mps) > MIN_SPEED_MPS) & (np.abs(other_mps) > MIN_SPEED_MPS)
    if moving.sum() < _MIN_MOVING_ROWS:
        return None
    return float(np.mean(np.sign(velocity_mps[moving] * other_mps[moving])))


def _is_same(quantity: str, ratio: float) -> bool:
    low, high = _CONTRADICTIONS[quantity][1]
    return low <= ratio <= high


def _exclude(found: Exclusions, quantity: str, ratios: Ratios, trust: Mapping[str, float]) -> None:
    """Exclude of each pair that differs the sensor that fewer confirm; both on a tie.

    ``trust`` counts as confirmations. Fixes are right about the scale of a single odometry, as long as it is one.
    """
    same = {names: _is_same(quantity, ratio) for names, ratio in ratios.items()}
    for (a, b), ratio in ratios.items():
        if same[a, b]:
            continue
        is_scale = quantity == "distance" and a == GNSS and 1.0 / _MAX_SCALE < ratio < _MAX_SCALE
        support = {name: trust.get(name, 0.0) + 0.5 * (is_scale and name == GNSS) for name in (a, b)}
        for name in support:
            support[name] += sum(is_same and name in pair for pair, is_same in same.items())
        for role, other, times in ((a, b, 1.0 / ratio), (b, a, ratio)):
            if support[role] <= support[other] and role != COMMAND:
                suspect = {"suspect": other} if support[role] == support[other] else {}
                scale = ratio if is_scale and role == b else None
                made = _make_exclusion(role, quantity, {"reference": other, **suspect}, times, scale)
                before = found.setdefault(role, made)
                if before.turned_by is not None and made.turned_by is not None and before.code != made.code:
                    found[role] = replace(made, turned_by=made.turned_by @ before.turned_by)


def _make_exclusion(
    role: str, quantity: str, names: Mapping[str, str], ratio: float, scale: float | None
) -> SensorExclusion:
    """Return the exclusion of a sensor that measures ``ratio`` times what another one does."""
    code, _, turned_by = _CONTRADICTIONS[quantity]
    if quantity == "distance":
        return SensorExclusion(role, code, names, {"distance_ratio": ratio}, scale=scale)
    if role == IMU and quantity == "direction":
        names = {**names, "evidence": "acceleration"}
        return SensorExclusion(role, "imu-rotated", names, {"off_rad": np.pi}, turned_by=turned_by)
    return SensorExclusion(role, code, names, turned_by=None if role in {IMU, GNSS} else turned_by)


_MAX_MISFIT = 0.25
"""Share of the path of fixes by which the path of the receiver's velocity may differ from it [1]: 14° of direction (ruling)."""


def check_ground_velocity(m: Measurements) -> SensorExclusion | None:
    """Return why the receiver's velocity of a clock epoch is not to be fused; None where the fixes confirm it."""
    at_ns = find_liveliest_window_ns(m)
    if m.doppler is None or at_ns is None:
        return None
    velocity = resample_signal(m.doppler.stamp_ns, m.doppler.velocity_enu_mps[:, :2], at_ns) @ np.array([1.0, 1j])
    path = np.where(np.isfinite(velocity), np.cumsum(np.nan_to_num(velocity)) * GRID_S, np.nan)
    fixes = np.full_like(path, np.nan) if m.gnss is None else resample_fixes(m.gnss, at_ns)
    misfit = compute_distance_ratio(fixes, path - fixes, _compute_noise_m2(m.gnss))
    return None if misfit is not None and misfit <= _MAX_MISFIT else SensorExclusion(DOPPLER, "velocity-unverified")
