"""Sensors that cannot be right: in another unit or frame, of the other sign, mounted otherwise, frozen, of another drive, or too slow.

Sensors are compared in pairs. Paths, in windows: one is laid on the other by rotation and scale, and on its mirror image. Directions of
travel: whether both go forward at once. Turns: the factor from the levelled gyroscope's yaw rate to another sensor's shows unit and sign.
Accelerations: an odometry's against the level specific force show the yaw of the IMU, and gravity shows its tilt.

Of two that differ, the one that fewer others confirm is excluded; both are, where that is a tie. A mounting that somebody stated counts
as a confirmation. A lone odometry whose path is that of the fixes, but far longer or shorter, has another scale, which is taken out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

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
    Measurements,
    Positions,
)
from tcpipe.fusion.preparation import GRAVITY_BAND_MPS2
from tcpipe.fusion.signals import (
    Plane,
    compute_median_period_ns,
    hold_last,
)
from tcpipe.fusion.state import GRAVITY_MPS2
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rpy

Floats = NDArray[np.float64]
COMMAND = "command"
"""The command among the sensors; it is never excluded."""
FORWARD = np.diag([-1.0, -1.0, 1.0])
"""Turns a body's x axis round and leaves its yaw rate."""
YAW = np.diag([1.0, -1.0, -1.0])
"""Turns a body's yaw rate round and leaves its x axis."""


@dataclass(frozen=True, slots=True)
class SensorExclusion:
    """A sensor that is not to be fused.

    Attributes
    ----------
    code, names, numbers : of the finding; the name ``suspect`` is the other role that may be wrong instead.
    units : value of the recipe's ``imu_units`` that sets it right.
    turned_by : rotation (3, 3) from what the extrinsics in use make of the sensor to base_link.
    is_suspect_excludable : whether excluding the suspect instead sets it right.
    """

    role: str
    code: str
    names: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    units: str | None = None
    turned_by: Floats | None = None
    is_suspect_excludable: bool = False


CONSTANT_FAULTS = frozenset({
    "drives-backwards", "imu-rotated", "imu-sign", "imu-units", "path-mirrored", "unit-suspected", "velocity-frame", "yaw-rate-sign",
})  # fmt: skip
"""Codes of exclusions for units and mounting, which no restart of a clock changes."""

Exclusions = dict[str, SensorExclusion]
"""By role, in order."""


@dataclass(frozen=True, slots=True)
class Command:
    """Commands of a clock epoch: stamps [ns], forward velocity [m/s] and yaw rate [rad/s], in order, shape (N,) each."""

    stamp_ns: NDArray[np.int64]
    forward_velocity_mps: Floats
    yaw_rate_radps: Floats


def check_sensors(
    m: Measurements, *, command: Command | None, stated: Mapping[str, bool], felt: float
) -> tuple[Exclusions, dict[str, float]]:
    """Return which sensors of a clock epoch are not to be fused, and the scale of an odometry that is far from 1.

    Parameters
    ----------
    m : measurements in base_link axes, by the extrinsics in use.
    stated : by role, whether the extrinsics are stated (recipe, transforms, message in base_link) rather than assumed.
    felt : median size of the specific force as the IMU measured it, before its lever arm was taken out; NaN without an IMU.
    """
    found: Exclusions = {}
    if m.imu is not None and (rate_hz := _find_slow_rate_hz(m.imu.stamp_ns)) is not None:
        found[IMU] = SensorExclusion(IMU, "imu-too-slow", numbers={"rate_hz": rate_hz})
        m = replace(m, imu=None)
    at_ns = find_liveliest_window_ns(m)
    if at_ns is None:
        return found, {}
    twists = {role: resample_twist(source, at_ns) for role, source in m.odometries().items()}
    wanted = None if command is None else hold_last(command.stamp_ns, command.forward_velocity_mps, at_ns)
    paths = {} if m.gnss is None else {GNSS: resample_fixes(m.gnss, at_ns)}
    paths |= {role: dead_reckon(twist) for role, twist in twists.items()}
    if wanted is not None and twists:
        paths[COMMAND] = dead_reckon(np.column_stack((wanted, next(iter(twists.values()))[:, 1])))
    noise_m2 = _compute_noise_m2(m.gnss)
    moving = {role for role, path in paths.items() if compare_paths(path, path, noise_m2)}
    for role, quantity in _list_constants(m):
        if moving - {role}:
            found.setdefault(role, _make_frozen_exclusion(role, quantity, m.sensors()[role].stamp_ns.size))
    # 1. Turns and accelerations show units and mounting of the IMU, and signs of yaw rates.
    trust = {COMMAND: 1.0, IMU: float(stated.get(IMU, False)), WHEELS: 0.5, VISUAL: 0.25}
    turn, turns, yaws_rad = _check_imu(found, m, twists, at_ns, felt=felt, trust=trust)
    # 2. Paths show another unit or another drive; yaw rates are the gyroscope's where it confirms them, or there are none.
    confirmed = {role for role, lag in turns.items() if lag.factor.real > 0.0}
    for role in twists if turn.size and IMU not in found else ():
        if role in confirmed or not np.nan_to_num(twists[role][:, 1]).any():
            twists[role][:, 1] = np.where(np.isfinite(turn), turn, twists[role][:, 1])
            paths[role] = dead_reckon(twists[role])
    pairs = {(a, b): compare_paths(paths[a], paths[b], noise_m2) for a, b in combinations(paths, 2)}
    known = {names: pair for names, pair in pairs.items() if pair is not None}
    scales = _check_distances(found, known, turns, is_alone=len(twists) == 1)
    _check_shapes(found, known, turns)
    # 3. Directions of travel show what looks backwards.
    forward = {role: twist[:, 0] for role, twist in twists.items()} | ({} if wanted is None else {COMMAND: wanted})
    _check_directions(found, forward, yaws_rad, trust)
    return found, scales


def _list_constants(m: Measurements) -> Iterator[tuple[str, str]]:
    """Yield the sensors of which a quantity is the same to the last digit throughout, and the quantity."""
    values = [(role, "velocity", source.velocity_mps) for role, source in m.odometries().items()]
    values += [] if m.gnss is None else [(GNSS, "position", m.gnss.position_enu_m)]
    if m.imu is not None:
        values += [
            (IMU, "acceleration", m.imu.specific_force_mps2),
            (IMU, "angular_velocity", m.imu.angular_velocity_radps),
        ]
    for role, quantity, each in values:
        if len(each) >= _MIN_VALUES and np.array_equal(each, np.broadcast_to(each[0], each.shape), equal_nan=True):
            yield role, quantity


def _make_frozen_exclusion(role: str, quantity: str, messages: int) -> SensorExclusion:
    return SensorExclusion(role, "frozen", {"quantity": quantity}, {"message_count": messages})


def _find_outvoted(
    same: Mapping[tuple[str, str], bool], trust: Mapping[str, float]
) -> Iterator[tuple[str, str, float]]:
    """Yield of each pair that differs the sensor that fewer confirm, the other, and by how many; both where it is a tie."""
    for a, b in (pair for pair, is_same in same.items() if not is_same):
        lead = sum(
            sign * (trust.get(name, 0.0) + sum(is_same and name in pair for pair, is_same in same.items()))
            for name, sign in ((b, 1), (a, -1))
        )
        if lead >= 0:
            yield a, b, lead
        if lead <= 0:
            yield b, a, -lead


def make_fix_exclusion(
    code: str, odometries: Collection[str], names: Mapping[str, str] | None = None
) -> SensorExclusion:
    """Return the exclusion of fixes that odometries contradict; a single odometry is suspect, even if a gyroscope confirms its turns."""
    if len(odometries) != 1:
        return SensorExclusion(GNSS, code, names or {})
    return SensorExclusion(GNSS, code, {**(names or {}), "suspect": next(iter(odometries))}, is_suspect_excludable=True)


# Paths

_WINDOWS_S = (20.0, 60.0, 180.0)
"""Windows of paths [s]: longer ones where the noise of fixes hides what is driven in shorter ones."""
_FAR_M, _BEND_M = 1.0, 0.3
"""Size of a path that moves, and size by which a path bends that differs from its mirror image [m]."""
_MIN_MOVING_WINDOWS = 3  # windows that show how far or along which path a robot drives
_MAX_RATIO, _STILL_RATIO, _MAX_SCALE = 2.0, 20.0, 5.0
"""Ratios of distances: that agree; from which on the shorter one is no motion; of an odometry whose scale is taken out."""
_MAX_MISFIT = 0.3  # share of the size of a path that slip may bend, and of windows that may be unlike
_MIRROR_RATIO = 3.0  # ratio of misfits that decides between a path and its mirror image
_UNITS = {"km/h": (3.2, 4.0), "radians": (1 / 75, 1 / 30)}  # ratios of distances by which a unit is named
_NODE = round(0.5 / GRID_S)  # rows of the grid between the places that are compared


def _compute_noise_m2(gnss: Positions | None) -> float:
    """Return the mean square that the noise of fixes adds to a path [m²]."""
    return 0.0 if gnss is None else 2.0 * float(np.median(gnss.variance_m2[:, :2]))


@dataclass(frozen=True, slots=True)
class Pair:
    """Two paths a and b in W windows, each about its mean, as mean products [m²]: of each with itself, b with conj(a), and b with a."""

    a_m2: Floats
    b_m2: Floats
    product: Plane
    mirrored: Plane
    noise_m2: float

    @property
    def ratio(self) -> float:
        """How many times as far as a b goes."""
        return float(np.sqrt(np.median(self.b_m2)) / max(np.sqrt(np.median(self.a_m2)), 1e-3))

    def find_scale(self) -> float:
        """Return how many times as far as a b goes, whatever the noise of a."""
        return float(np.median(self.b_m2 / np.maximum(np.abs(self.product), 1e-9)))

    def find_shape(self) -> Literal["alike", "mirrored", "unlike"] | None:
        """Return how b lies to a when it, or its mirror image, is turned and scaled to fit; None where it bends too little.

        Unlike is what fits neither way, by more than the noise, what slip bends, and a metre.
        """
        products_m4 = np.square(np.abs((self.product, self.mirrored)))
        misfits_m2 = self.a_m2 - products_m4 / np.maximum(self.b_m2, 1e-9)
        bound_m2 = _FAR_M**2 + 18.0 * self.noise_m2 + _MAX_MISFIT**2 * self.a_m2
        if (np.mean(misfits_m2 > bound_m2, axis=1) > _MAX_MISFIT).all():
            return "unlike"
        plain, mirrored = misfits_m2.mean(1)
        if max(plain, mirrored) < max(_BEND_M**2 + 18.0 * self.noise_m2, _MIRROR_RATIO * min(plain, mirrored)):
            return None
        return "alike" if plain < mirrored else "mirrored"


def compare_paths(a: Plane, b: Plane, noise_m2: float) -> Pair | None:
    """Return two paths in windows in which one goes far, as short as the noise of fixes allows; None where there are hardly any."""
    both = np.stack((a, b))[:, ::_NODE]
    for window_s in _WINDOWS_S:
        size = round(window_s / GRID_S / _NODE)
        if both.shape[1] < size:
            return None
        rows = np.lib.stride_tricks.sliding_window_view(both, size, axis=1)[:, :: size // 4]
        rows = rows[:, np.isfinite(rows.sum((0, 2)))]
        a_rows, b_rows = rows - rows.mean(2, keepdims=True)
        a_m2, b_m2 = (np.mean(np.abs(each) ** 2, axis=1) for each in (a_rows, b_rows))
        far = np.maximum(a_m2, b_m2) > _FAR_M**2 + 2.0 * noise_m2
        if far.sum() >= _MIN_MOVING_WINDOWS:
            product, mirrored = (np.mean(b_rows * each, axis=1)[far] for each in (np.conj(a_rows), a_rows))
            return Pair(a_m2[far], b_m2[far], product, mirrored, noise_m2)
    return None


def _check_distances(
    found: Exclusions, pairs: Mapping[tuple[str, str], Pair], turning: Collection[str], *, is_alone: bool
) -> dict[str, float]:
    """Exclude what goes more than twice as far as the rest; return the scale of an odometry that is alone where that is its error.

    The gyroscope confirms the yaw rate of ``turning`` sensors.
    """
    ratios = {names: pair.ratio for names, pair in pairs.items() if not found.keys() & {*names}}
    same = {names: 1 / _MAX_RATIO <= ratio <= _MAX_RATIO for names, ratio in ratios.items()}
    scales = {}
    # A robot may be slower than its command.
    for names in [names for names, is_same in same.items() if not is_same and COMMAND not in names]:
        ratio, of_pair = ratios[names], {each: is_same for each, is_same in same.items() if is_same or each == names}
        fast, trust = names[1] if ratio > 1.0 else names[0], dict[str, float]()
        if not 1 / _STILL_RATIO < ratio < _STILL_RATIO:
            # A command does not show that a robot moves; a gyroscope that turns with the sensor does.
            of_pair.pop((fast, COMMAND), None)
            trust = {fast: float(fast in turning)}
            if fast == WHEELS and not trust[fast] and not any(fast in each for each in of_pair if each != names):
                continue  # the wheels turn, the robot stands: stuck
        losers = [*_find_outvoted(of_pair, trust)]
        odometry = names[1]
        is_scale = is_alone and 1 / _MAX_SCALE < ratio < _MAX_SCALE and any(odometry == role for role, _, _ in losers)
        if is_scale and GNSS in names and pairs[names].find_shape() not in {"mirrored", "unlike"}:
            scales[odometry] = pairs[names].find_scale()
            continue
        for role, other, lead in losers:
            times = ratio if role == odometry else 1 / ratio
            found.setdefault(role, _make_distance_exclusion(role, other, times, is_tie=lead == 0))
    return scales


def _make_distance_exclusion(role: str, other: str, ratio: float, *, is_tie: bool) -> SensorExclusion:
    """Return the exclusion of a sensor that goes ``ratio`` times as far as another."""
    names = {"reference": other} | ({"suspect": other} if is_tie else {})
    for unit, (least, most) in _UNITS.items():
        if least < ratio < most and (unit != "radians" or role == GNSS):
            return SensorExclusion(role, "unit-suspected", names | {"unit": unit}, {"distance_ratio": ratio})
    return SensorExclusion(role, "distance-contradicted", names, {"distance_ratio": ratio})


def _check_shapes(found: Exclusions, pairs: Mapping[tuple[str, str], Pair], turning: Collection[str]) -> None:
    """Exclude fixes whose path is not that of the odometries; one odometry that no gyroscope confirms is as doubtful as they are."""
    odometries = {WHEELS, VISUAL} - found.keys() if GNSS not in found else set()
    shapes = {role: pair.find_shape() for (a, role), pair in pairs.items() if a == GNSS and role in odometries}
    against = [role for role, shape in shapes.items() if shape in {"mirrored", "unlike"}]
    if not against or "alike" in shapes.values():
        return
    is_confirmed = len(against) > 1 or against[0] in turning
    names = {"reference": ", ".join(against)}
    if "unlike" in shapes.values():
        found |= {GNSS: make_fix_exclusion("path-unlike", shapes, names)} if is_confirmed else {}
    elif is_confirmed:
        found[GNSS] = SensorExclusion(GNSS, "path-mirrored", names)
    else:
        found[GNSS] = SensorExclusion(GNSS, "path-mirrored", {**names, "suspect": against[0]})
        names = {"reference": GNSS, "suspect": GNSS}
        found[against[0]] = SensorExclusion(against[0], "yaw-rate-sign", names, turned_by=YAW)


# The IMU

_SLOWEST_S = 0.11
"""Longest period of an IMU that shows the motion between its samples [s]: 10 Hz, with the jitter of its driver."""
_MIN_VALUES = 20  # values that show that a sensor is frozen
_IN_DEGREES, _MAX_YAW_RATE_RADPS = 1.0 / 15.0, 15.0
"""Largest factor from a yaw rate in degrees to one in radians, 1/57 ideally; and a yaw rate that no robot reaches."""
_TILTED_RAD, _ASIDE_RAD, _BACKWARDS_RAD = np.radians([30.0, 60.0, 120.0])
"""Least tilt of a rotated IMU: slopes average out, and the steepest that is driven is 22.5°; yaws that look aside and backwards."""
_AXIS_ALIGNED_RAD = 0.25  # angle within which a mounting is taken as along the axes
_MIN_AGREEMENT, _MIN_COHERENCE, _MAX_YAW_STD_RAD = 0.5, 0.3, 0.1
"""Least agreement of two turns or directions, and of accelerations (0 to 1), and the largest σ of a yaw by accelerations."""


def _find_slow_rate_hz(stamp_ns: NDArray[np.int64]) -> float | None:
    """Return the median rate of an IMU whose samples are mostly too far apart to show the motion between them; pauses do not count."""
    step_s = np.diff(stamp_ns) * 1e-9
    known_s = step_s[step_s <= PAUSE_NS * 1e-9]
    is_slow = step_s.size > 0 and float(known_s[known_s < _SLOWEST_S].sum()) <= 0.5 * float(known_s.sum())
    return 1.0 / float(np.median(step_s)) if is_slow else None


def _check_imu(
    found: Exclusions,
    m: Measurements,
    twists: Mapping[str, Floats],
    at_ns: NDArray[np.int64],
    *,
    felt: float,
    trust: Mapping[str, float],
) -> tuple[Floats, dict[str, Lag], dict[str, float]]:
    """Check units, tilt and signs; return the yaw rate, how other sensors' follow from it, and the unit's yaw by each odometry [rad]."""
    if m.imu is None:
        return np.empty(0), {}, {}
    turn, force, level = resample_imu(m.imu, at_ns)
    turns = _compare_turns(turn, m.gnss, twists, at_ns)
    yaws_rad = _compare_accelerations(force, twists, turns)
    if IMU not in found:
        _check_units(found, turns, turn, felt)
    if IMU not in found and m.imu.accelerometer_usable:
        _check_mounting(found, level, yaws_rad)
        if IMU not in found:
            _check_yaw_signs(found, turns, trust)
    return turn, turns, {} if IMU in found else yaws_rad


def _compare_turns(
    turn: Floats, gnss: Positions | None, twists: Mapping[str, Floats], at_ns: NDArray[np.int64]
) -> dict[str, Lag]:
    """Return by sensor how its yaw rate follows from the gyroscope's."""
    rates = {role: average(twist[:, 1], SMOOTH_S) for role, twist in twists.items()}
    rates |= {} if gnss is None else {GNSS: differentiate_course(compute_fix_velocity(gnss, at_ns))}
    lags = {role: find_lag(rate, average(turn, SMOOTH_S)) for role, rate in rates.items()}
    return {role: lag for role, lag in lags.items() if lag is not None and lag.explained > _MIN_AGREEMENT}


def _compare_accelerations(force: Plane, twists: Mapping[str, Floats], turns: Mapping[str, Lag]) -> dict[str, float]:
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
    if turns:
        scale = float(np.median([abs(lag.factor) for lag in turns.values()]))
        evidence |= {"deg": {"turn_ratio": 1.0 / scale}} if scale < _IN_DEGREES else {}
    elif (known := np.abs(turn[np.isfinite(turn)])).size and np.percentile(known, 99.5) > _MAX_YAW_RATE_RADPS:
        evidence["deg"] = {"rate_max": float(known.max())}
    low, high = GRAVITY_BAND_MPS2
    evidence |= {"g": {"force_median": felt}} if low <= felt * GRAVITY_MPS2 <= high else {}
    if evidence:
        units = "_".join(evidence)
        numbers = {name: value for of_unit in evidence.values() for name, value in of_unit.items()}
        found[IMU] = SensorExclusion(IMU, "imu-units", {"units": units}, numbers, units)
    elif felt == 0.0:
        found[IMU] = SensorExclusion(IMU, "imu-no-acceleration")


def _check_mounting(found: Exclusions, level: Floats, yaws_rad: Mapping[str, float]) -> None:
    """Exclude an IMU that the rotation by which gravity levels it shows to be tilted, or accelerations to look aside."""
    yaw_rad = next(iter(yaws_rad.values()), 0.0)
    turned_by = find_nearest_mounting(matrix_from_quat(quat_from_rpy(0.0, 0.0, yaw_rad)) @ level)
    off_rad = float(np.arccos(np.clip(level[2, 2], -1.0, 1.0)))
    if off_rad > _TILTED_RAD:
        names, numbers = {"evidence": "gravity"}, {"off_rad": off_rad}
        found[IMU] = SensorExclusion(IMU, "imu-rotated", names, numbers, turned_by=turned_by)
    elif yaws_rad and all(_ASIDE_RAD < abs(each) <= _BACKWARDS_RAD for each in yaws_rad.values()):
        found[IMU] = _make_yaw_exclusion(yaws_rad, turned_by)


def find_nearest_mounting(base_from_sensor: Floats) -> Floats:
    """Return the rotation (3, 3) with axes along axes that is nearest, or the given one where none is near."""
    largest = np.argmax(np.abs(base_from_sensor), axis=1)
    aligned = np.zeros((3, 3))
    aligned[np.arange(3), largest] = np.sign(base_from_sensor[np.arange(3), largest])
    if abs(np.linalg.det(aligned) - 1.0) > 1e-9:
        return base_from_sensor
    angle = np.arccos(np.clip((np.trace(aligned.T @ base_from_sensor) - 1) / 2, -1.0, 1.0))
    return aligned if angle < _AXIS_ALIGNED_RAD else base_from_sensor


def _make_yaw_exclusion(yaws_rad: Mapping[str, float], turned_by: Floats) -> SensorExclusion:
    """Return the exclusion of an IMU that the accelerations of odometries show to be turned, by yaw [rad]."""
    names = {"evidence": "acceleration", "reference": ", ".join(yaws_rad)}
    numbers = {"off_rad": next(iter(yaws_rad.values()))}
    return SensorExclusion(IMU, "imu-rotated", names, numbers, turned_by=turned_by)


# Directions

_MIN_MOVING_ROWS = 100  # rows of the grid that show how two directions agree, 2 s


def _check_yaw_signs(found: Exclusions, turns: Mapping[str, Lag], trust: Mapping[str, float]) -> None:
    """Check that gyroscope, odometries and fixes turn the same way, the IMU being upright by gravity."""
    signs = {IMU: True} | {role: lag.factor.real > 0.0 for role, lag in turns.items()}
    same = {(a, b): signs[a] == signs[b] for a, b in combinations(signs, 2)}
    for role, other, _ in _find_outvoted(same, {IMU: trust[IMU]} | dict.fromkeys(turns, 0.5)):
        reference = {"reference": ", ".join(each for each, sign in signs.items() if sign != signs[role])}
        if role == IMU:
            found.setdefault(IMU, SensorExclusion(IMU, "imu-sign", reference))
        elif other == IMU and role != GNSS:
            found.setdefault(role, SensorExclusion(role, "yaw-rate-sign", reference, turned_by=YAW))


def _check_directions(
    found: Exclusions, forward: Mapping[str, Floats], yaws_rad: Mapping[str, float], trust: Mapping[str, float]
) -> None:
    """Check that odometries, command and accelerations go forward at once."""
    is_aside = {role: _ASIDE_RAD < abs(yaw) <= _BACKWARDS_RAD for role, yaw in yaws_rad.items()}
    same = {(role, IMU): abs(yaw) < _ASIDE_RAD for role, yaw in yaws_rad.items() if not is_aside[role]}
    for a, b in combinations(forward, 2):
        agreement = compute_agreement(forward[a], forward[b])
        if agreement is not None and abs(agreement) > _MIN_AGREEMENT:
            same[a, b] = agreement > 0.0
    turned = set()
    for role, other, lead in _find_outvoted(same, trust):
        if role == IMU:
            backwards = {each: yaw for each, yaw in yaws_rad.items() if abs(yaw) > _BACKWARDS_RAD}
            found.setdefault(IMU, _make_yaw_exclusion(backwards, FORWARD))
        elif role != COMMAND and role not in turned:
            turned.add(role)
            names = {"reference": other} | ({"suspect": other} if other in {WHEELS, VISUAL} and lead < 1.0 else {})
            before = found[role].turned_by if role in found else None
            if role not in found or before is not None:  # and its yaw rate turns the other way
                turn = FORWARD if before is None else FORWARD @ before
                found[role] = SensorExclusion(role, "drives-backwards", names, turned_by=turn)


def compute_agreement(velocity_mps: Floats, other_mps: Floats) -> float | None:
    """Return by how much two signed velocities go the same way, -1 to 1, or None where one of them hardly moves; shape (M,) each."""
    moving = (np.abs(velocity_mps) > MIN_SPEED_MPS) & (np.abs(other_mps) > MIN_SPEED_MPS)
    if moving.sum() < _MIN_MOVING_ROWS:
        return None
    return float(np.mean(np.sign(velocity_mps[moving] * other_mps[moving])))


# The receiver's own velocity, scales

_MAX_FRAME_MISFIT = 0.25
"""Share of its size by which the path of a velocity in the right frame may differ from that of the fixes."""


def check_ground_velocity(m: Measurements) -> SensorExclusion | None:
    """Return why the receiver's velocity of a clock epoch is not to be fused; None where the fixes confirm it."""
    at_ns = find_liveliest_window_ns(m)
    if m.doppler is None or at_ns is None:
        return None
    velocity = resample_signal(m.doppler.stamp_ns, m.doppler.velocity_enu_mps[:, :2], at_ns) @ np.array([1.0, 1j])
    path = np.where(np.isfinite(velocity), np.cumsum(np.nan_to_num(velocity)) * GRID_S, np.nan)
    fixes = np.full_like(path, np.nan) if m.gnss is None else resample_fixes(m.gnss, at_ns)
    pair, driven = (compare_paths(fixes, each, _compute_noise_m2(m.gnss)) for each in (path, fixes))
    if pair is None or driven is None:
        return SensorExclusion(DOPPLER, "velocity-unverified")

    def compute_misfit(product: Plane) -> float:
        misfit_m2 = np.maximum(pair.a_m2 + pair.b_m2 - 2.0 * product.real, 0.0)
        return float(np.median(np.sqrt(misfit_m2 / np.maximum(pair.a_m2, 1e-9))))

    if compute_misfit(pair.product) <= _MAX_FRAME_MISFIT:
        return None
    if pair.ratio < 0.1:
        return _make_frozen_exclusion(DOPPLER, "velocity", m.doppler.stamp_ns.size)
    is_ned = compute_misfit(-1j * pair.mirrored) <= _MAX_FRAME_MISFIT
    if is_ned or abs(pair.ratio - 1.0) <= _MAX_FRAME_MISFIT:
        return SensorExclusion(DOPPLER, "velocity-frame", {"frame": "north-east-down" if is_ned else "unknown"})
    return SensorExclusion(DOPPLER, "distance-contradicted", {"reference": GNSS}, {"distance_ratio": pair.ratio})


def rescale_odometries(m: Measurements, scales: Mapping[str, float]) -> Measurements:
    """Return measurements without the scales of odometries that are known; their claims do not become better."""
    rescaled = {}
    for role, source in m.odometries().items():
        if role in scales:
            variance = source.variance_m2ps2 * max(1.0, scales[role] ** -2.0)
            rescaled[role] = replace(source, velocity_mps=source.velocity_mps / scales[role], variance_m2ps2=variance)
    return m.replace_sensors(rescaled)


_MIN_COMMANDED_NS = 40_000_000_000
"""Time under constant commands that shows a ratio [ns]: less may be one place of slip."""
_MAX_STEP_MPS = 0.1  # largest change of a command that is jitter [m/s] (`mask.command_step_mps`)
_MIN_COMMAND_RATIO = 1.03  # ratio of speed to command that no controller overshoots to [1]


def compute_command_ratio(m: Measurements, command: Command | None) -> float | None:
    """Return the ratio of the wheels' speed to the command where it is surely too high, and no other sensor shows the scale; else None.

    Only times count in which a command has been constant for three seconds: a robot that brakes is faster than its command.
    """
    wheels = m.wheels
    if wheels is None or m.gnss is not None or m.visual is not None or command is None or command.stamp_ns.size == 0:
        return None
    commands_mps = [
        hold_last(command.stamp_ns, command.forward_velocity_mps, wheels.stamp_ns - ago_ns)
        for ago_ns in range(0, 3_500_000_000, 500_000_000)
    ]
    # A difference to an unknown command is NaN, which is a change.
    rows = (np.ptp(commands_mps, axis=0) <= _MAX_STEP_MPS) & (np.abs(commands_mps[0]) > MIN_SPEED_MPS)
    if rows.sum() * compute_median_period_ns(wheels.stamp_ns) < _MIN_COMMANDED_NS:
        return None
    ratio = wheels.velocity_mps[rows, 0] / commands_mps[0][rows]
    return float(np.median(ratio)) if np.quantile(ratio, 0.25) > _MIN_COMMAND_RATIO else None
