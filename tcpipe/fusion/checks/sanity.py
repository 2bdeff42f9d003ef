"""Sensors that cannot be right: in another unit or frame, of the other sign, mounted otherwise, frozen, of another drive, or too slow.

Sensors are compared in pairs. Paths, in windows: one is laid on the other by rotation and scale, and on its mirror image. Directions of
travel: do both go forward at once? Turns: a yaw rate is a linear function of the gyroscope's three rates, whose coefficients show its
unit, axis and sign. Accelerations: an odometry's against the level specific force show the yaw of the IMU, and gravity shows its tilt.

Of two that differ, the one that fewer others confirm is excluded; both are, where that is a tie. A mounting that somebody stated counts
as a confirmation. A lone odometry whose path is that of the fixes, but far longer or shorter, has another scale, which is taken out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.lags import (
    GRID_S,
    Floats,
    compute_course_rate,
    compute_fix_velocity,
    compute_moving_mean,
    find_liveliest_window_ns,
    resample_fixes,
    resample_signal,
    resample_twist,
)
from tcpipe.fusion.checks.mounting import (
    YawAxis,
    compute_levelling_rotation,
    find_forward_yaw_rad,
    find_nearest_mounting,
    find_up_axis,
    find_yaw_axis,
    rotate_about_z,
)
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
from tcpipe.fusion.signals import compute_median_period_ns, compute_seconds, hold_last, integrate_signal, is_covered

Path = NDArray[np.complex128]
"""Places on the grid [m], east and i times north, NaN where unknown, shape (M,)."""

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
    paths |= {role: _dead_reckon(twist) for role, twist in twists.items()}
    noise_m2 = _compute_noise_m2(m.gnss)
    # 1. Turns and accelerations show units and mounting of the IMU, and signs of yaw rates.
    axes: dict[str, YawAxis] = {}
    looks: dict[str, float] = {}
    if m.imu is not None:
        drives = any(compare_paths(path, path, _SHORT_S, noise_m2) for path in paths.values())
        values = {"acceleration": m.imu.specific_force_mps2, "angular_velocity": m.imu.angular_velocity_radps}
        if drives and (frozen := [quantity for quantity, each in values.items() if _is_constant(each)]):
            found[IMU] = _make_frozen_exclusion(IMU, frozen[0], len(m.imu.stamp_ns))
        axes, looks = _check_imu(found, m.imu, m.gnss, twists, at_ns, felt=felt, is_stated=stated.get(IMU, False))
    # 2. Paths show what is frozen, in another unit, or of another drive; yaw rates are the gyroscope's where it confirms them.
    if m.imu is not None and IMU not in found:
        rate = resample_signal(m.imu.stamp_ns, m.imu.angular_velocity_radps, at_ns)[:, 2]
        for role in (role for role in twists if role in axes and axes[role].axis[2] > _SAME_WAY):
            twists[role][:, 1] = np.where(np.isfinite(rate), rate, twists[role][:, 1])
            paths[role] = _dead_reckon(twists[role])
    if wanted is not None and twists:
        paths[COMMAND] = _dead_reckon(np.column_stack((wanted, next(iter(twists.values()))[:, 1])))
    scales = _check_distances(found, m, paths, noise_m2, axes)
    _check_shapes(found, paths, noise_m2, axes)
    # 3. Directions of travel show what looks backwards.
    forward = {role: twist[:, 0] for role, twist in twists.items()}
    _check_directions(found, forward, wanted, looks, is_stated=stated.get(IMU, False))
    return found, scales


# Of two that differ


def _find_outvoted(
    apart: Iterable[tuple[str, str]], count_votes: Callable[[str], float]
) -> Iterator[tuple[str, str, float]]:
    """Yield of each pair that differs the sensor that fewer confirm, the other, and by how many; both where it is a tie."""
    for a, b in apart:
        lead = count_votes(b) - count_votes(a)
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

_SHORT_S, _LONG_S = 10.0, 20.0  # windows of distances and of shapes
_LENGTHENED = (1, 3, 9)  # windows, where the noise of fixes hides what is driven in shorter ones
_FAR_M = 1.0
_FEWEST_WINDOWS = 3
_FACTOR = 2.0  # between distances that agree
_STILL = 20.0  # ratio of distances from which on the shorter one is no motion
_UNLIKE = 0.3  # share of the size of a path that slip may bend, and of windows that may be unlike
_BEND_M = 0.3  # a path that bends less is its own mirror image
_CLEARLY = 3.0  # ratio of misfits that decides between a path and its mirror image
_MOST = 5.0  # largest scale of an odometry that is taken out
_UNITS = {"km/h": (3.2, 4.0), "radians": (1 / 75, 1 / 30)}
_NODE = round(0.5 / GRID_S)


def _compute_noise_m2(gnss: Positions | None) -> float:
    """Return the mean square that the noise of fixes adds to a path [m²]."""
    return 0.0 if gnss is None else 2.0 * float(np.median(gnss.variance_m2[:, :2]))


def _dead_reckon(twist: Floats) -> Path:
    """Return the path that a twist (M, 2) adds up to."""
    known = np.isfinite(twist.sum(1))
    forward, yaw_rate = np.where(known[:, None], twist, 0.0).T
    place = np.cumsum(forward * np.exp(1j * np.cumsum(yaw_rate) * GRID_S)) * GRID_S
    return np.where(known, place, np.nan)


@dataclass(frozen=True, slots=True)
class Pair:
    """Two paths a and b in W windows, each about its mean, as mean products [m²]: of each with itself, b with conj(a), and b with a."""

    a_m2: Floats
    b_m2: Floats
    product: Path
    mirrored: Path

    @property
    def ratio(self) -> float:
        """How many times as far as a b goes."""
        return float(np.sqrt(np.median(self.b_m2)) / max(np.sqrt(np.median(self.a_m2)), 1e-3))

    def compute_misfits_m2(self) -> tuple[Floats, Floats]:
        """Return the mean square that is left of a when b, turned and scaled, is laid on it, and b's mirror image."""
        size = np.maximum(self.b_m2, 1e-9)
        return self.a_m2 - np.abs(self.product) ** 2 / size, self.a_m2 - np.abs(self.mirrored) ** 2 / size

    def find_scale(self) -> float:
        """Return how many times as far as a b goes, whatever the noise of a."""
        return float(np.median(self.b_m2 / np.maximum(np.abs(self.product), 1e-9)))

    def has_same_shape(self, noise_m2: float) -> bool:
        """Return whether the paths have the same shape in most windows."""
        return bool(np.mean(self.compute_misfits_m2()[0] < noise_m2 + _UNLIKE**2 * self.a_m2) > 1.0 - _UNLIKE)


def compare_paths(a: Path, b: Path, shortest_s: float, noise_m2: float) -> Pair | None:
    """Return two paths in windows in which one goes far, as short as the noise of fixes allows; None where there are hardly any."""
    a, b = a[::_NODE], b[::_NODE]
    for times in _LENGTHENED:
        size = round(times * shortest_s / GRID_S / _NODE)
        if a.size < size:
            return None
        rows = np.lib.stride_tricks.sliding_window_view(np.stack((a, b)), size, axis=1)[:, :: max(size // 2, 1)]
        rows = rows[:, np.isfinite(rows.sum((0, 2)))]
        a_rows, b_rows = rows - rows.mean(2, keepdims=True)
        a_m2, b_m2 = (np.mean(np.abs(each) ** 2, axis=1) for each in (a_rows, b_rows))
        far = np.maximum(a_m2, b_m2) > _FAR_M**2 + 2.0 * noise_m2
        if far.sum() >= _FEWEST_WINDOWS:
            product = np.mean(b_rows * np.conj(a_rows), axis=1), np.mean(b_rows * a_rows, axis=1)
            return Pair(a_m2[far], b_m2[far], product[0][far], product[1][far])
    return None


def _check_distances(
    found: Exclusions, m: Measurements, paths: Mapping[str, Path], noise_m2: float, turning: Collection[str]
) -> dict[str, float]:
    """Exclude what is frozen, or goes more than twice as far as the rest; return the scale of a lone odometry where that is its error.

    The gyroscope confirms the yaw rate of ``turning`` sensors.
    """
    pairs = {
        (a, b): pair
        for a, b in combinations(paths, 2)
        if (pair := compare_paths(paths[a], paths[b], _SHORT_S, noise_m2))
    }
    values = {role: source.velocity_mps for role, source in m.odometries().items()}
    values |= {} if m.gnss is None else {GNSS: m.gnss.position_enu_m}
    for role, of_role in values.items():
        if _is_constant(of_role) and any(role in names and _has_unequal_lengths(pair) for names, pair in pairs.items()):
            found[role] = _make_frozen_exclusion(role, "velocity" if role != GNSS else "position", len(of_role))
    ratios = {names: pair.ratio for names, pair in pairs.items() if not found.keys() & set(names)}
    agreeing = [names for names, ratio in ratios.items() if 1 / _FACTOR <= ratio <= _FACTOR]
    scales = {}
    for names, ratio in ratios.items():
        if names in agreeing or COMMAND in names:  # a robot may be slower than it is told
            continue
        fast = names[1] if ratio > 1.0 else names[0]
        is_still = not 1 / _STILL < ratio < _STILL
        # A command tells how fast a robot that moves is to go, not that it moves; a gyroscope that turns with it does.
        votes = {
            name: sum(name in pair and not (is_still and name == fast and COMMAND in pair) for pair in agreeing)
            for name in names
        }
        votes[fast] += is_still and fast in turning
        if is_still and fast == WHEELS and not votes[fast]:
            continue  # the wheels turn, the robot stands: stuck
        if GNSS in names and pairs[names].has_same_shape(noise_m2) and 1 / _MOST < ratio < _MOST:
            odometry = names[1]
            if votes[odometry] <= votes[GNSS] and len(m.odometries()) == 1:
                scales[odometry] = pairs[names].find_scale()
                continue
        for role, other, lead in _find_outvoted([names], votes.__getitem__):
            times = ratio if role == names[1] else 1 / ratio
            found.setdefault(role, _make_distance_exclusion(role, other, times, is_tie=lead == 0))
    return scales


def _is_constant(values: Floats) -> bool:
    """Return whether all rows of (N, k) are the same to the last digit, and enough of them."""
    return len(values) >= _FEWEST_VALUES and np.array_equal(
        values, np.broadcast_to(values[0], values.shape), equal_nan=True
    )


def _has_unequal_lengths(pair: Pair) -> bool:
    """Return whether one path is clearly longer than the other in some windows."""
    sizes = np.sqrt((pair.a_m2, pair.b_m2))
    return bool((np.abs(np.diff(sizes, axis=0)) > 0.5 * sizes.max(0)).sum() > 1)


def _make_frozen_exclusion(role: str, quantity: str, messages: int) -> SensorExclusion:
    return SensorExclusion(role, "frozen", {"quantity": quantity}, {"message_count": messages})


def _make_distance_exclusion(role: str, other: str, ratio: float, *, is_tie: bool) -> SensorExclusion:
    """Return the exclusion of a sensor that goes ``ratio`` times as far as another."""
    names = {"reference": other} | ({"suspect": other} if is_tie else {})
    for unit, (least, most) in _UNITS.items():
        if least < ratio < most and (unit != "radians" or role == GNSS):
            return SensorExclusion(role, "unit-suspected", names | {"unit": unit}, {"distance_ratio": ratio})
    return SensorExclusion(role, "distance-contradicted", names, {"distance_ratio": ratio})


def _check_shapes(found: Exclusions, paths: Mapping[str, Path], noise_m2: float, turning: Collection[str]) -> None:
    """Exclude fixes whose path is not that of the odometries; one odometry that no gyroscope confirms is as doubtful as they are."""
    if GNSS not in paths or GNSS in found:
        return
    shapes = {
        role: _find_shape(compare_paths(paths[GNSS], path, _LONG_S, noise_m2), noise_m2)
        for role, path in paths.items()
        if role not in {GNSS, COMMAND, *found}
    }
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


def _find_shape(pair: Pair | None, noise_m2: float) -> Literal["alike", "mirrored", "unlike"] | None:
    """Return how the path of fixes lies to an odometry's; None where it bends too little.

    Unlike is what fits neither way, by more than the fixes' noise, what slip bends, and a metre.
    """
    if pair is None:
        return None
    misfits = np.array(pair.compute_misfits_m2())
    bound = _FAR_M**2 + 18.0 * noise_m2 + _UNLIKE**2 * pair.a_m2
    if (np.mean(misfits > bound, axis=1) > _UNLIKE).all():
        return "unlike"
    plain, mirrored = misfits.mean(1)
    if max(plain, mirrored) < max(_BEND_M**2 + 18.0 * noise_m2, _CLEARLY * min(plain, mirrored)):
        return None
    return "alike" if plain < mirrored else "mirrored"


# The IMU

_TURN_SMOOTH_S = 0.1
_SLOWEST_S = 0.11  # 10 Hz, with the jitter of its driver
_FEWEST_VALUES = 20
_IN_G, _IN_MPS2 = (0.8, 1.25), (8.0, 12.0)
_IN_DEGREES = 1.0 / 15.0  # yaw rate [rad/s] by the gyroscope's rate; in radians 0.5 to 2
_NO_ROBOT_TURNS_RADPS = 15.0
_TILTED_RAD = np.radians(30.0)  # slopes average out; the steepest that is driven is 22.5 degrees
_ASIDE_RAD, _BACKWARDS_RAD = np.radians(60.0), np.radians(120.0)
_SAME_WAY = 0.5


def _find_slow_rate_hz(stamp_ns: NDArray[np.int64]) -> float | None:
    """Return the median rate of an IMU whose samples are mostly too far apart to show the motion between them; pauses do not count."""
    step_s = np.diff(stamp_ns) * 1e-9
    known_s = step_s[step_s <= PAUSE_NS * 1e-9]
    is_slow = step_s.size > 0 and float(known_s[known_s < _SLOWEST_S].sum()) <= 0.5 * float(known_s.sum())
    return 1.0 / float(np.median(step_s)) if is_slow else None


def _check_imu(
    found: Exclusions,
    imu: InertialMeasurements,
    gnss: Positions | None,
    twists: Mapping[str, Floats],
    at_ns: NDArray[np.int64],
    *,
    felt: float,
    is_stated: bool,
) -> tuple[dict[str, YawAxis], dict[str, float]]:
    """Check units, tilt and signs; return the yaw axis by each sensor, and the yaw of the upright unit by each odometry [rad]."""
    rate = compute_moving_mean(resample_signal(imu.stamp_ns, imu.angular_velocity_radps, at_ns), _TURN_SMOOTH_S)
    turns = {role: compute_moving_mean(twist, _TURN_SMOOTH_S)[:, 1] for role, twist in twists.items()}
    if gnss is not None:
        turns[GNSS] = compute_course_rate(compute_fix_velocity(gnss, at_ns))
    axes = {role: axis for role, turn in turns.items() if (axis := find_yaw_axis(turn, rate)) is not None}
    evidence = _find_other_units(axes, rate, felt)
    if IMU in found:
        return axes, {}
    if evidence:
        units = "_".join(evidence)
        numbers = {name: value for of_unit in evidence.values() for name, value in of_unit.items()}
        found[IMU] = SensorExclusion(IMU, "imu-units", {"units": units}, numbers, units)
        return axes, {}
    if felt == 0.0:
        found[IMU] = SensorExclusion(IMU, "imu-no-acceleration")
    if not _IN_MPS2[0] <= felt <= _IN_MPS2[1]:
        return axes, {}
    up = find_up_axis(imu.specific_force_mps2)
    level = compute_levelling_rotation(up)
    force = resample_signal(imu.stamp_ns, imu.specific_force_mps2 @ level.T, at_ns)
    looks: dict[str, float] = {}
    for role, twist in twists.items():
        yaw = find_forward_yaw_rad(twist, force, axes[role].late_s if role in axes else 0.0)
        looks |= {} if yaw is None else {role: yaw}
    yaw = next(iter(looks.values()), 0.0)
    turned_by = find_nearest_mounting(rotate_about_z(yaw) @ level)
    if up[2] < np.cos(_TILTED_RAD):
        names, numbers = {"evidence": "gravity"}, {"off_rad": float(np.arccos(up[2]))}
        found[IMU] = SensorExclusion(IMU, "imu-rotated", names, numbers, turned_by=turned_by)
        return axes, {}
    signs = {role: bool(axis.axis[2] > 0) for role, axis in axes.items() if abs(axis.axis[2]) > _SAME_WAY}
    _check_yaw_signs(found, signs, is_stated=is_stated)
    if looks and all(_ASIDE_RAD < abs(each) <= _BACKWARDS_RAD for each in looks.values()):
        found.setdefault(IMU, _make_yaw_exclusion(looks, turned_by))
    return axes, {} if IMU in found else looks


def _find_other_units(axes: Mapping[str, YawAxis], rate: Floats, felt: float) -> dict[str, dict[str, float]]:
    """Return the recipe's words for the units an IMU seems to be in where they are not SI, with what shows them.

    That is how many times as fast as another sensor the gyroscope turns (degrees: 57), or its fastest rate, and the median force.
    """
    found: dict[str, dict[str, float]] = {}
    if axes:
        scale = float(np.median([axis.scale for axis in axes.values()]))
        found |= {"deg": {"turn_ratio": 1.0 / scale}} if scale < _IN_DEGREES else {}
    else:
        known = np.linalg.norm(rate[np.isfinite(rate.sum(1))], axis=1)
        if known.size and float(np.percentile(known, 99.5)) > _NO_ROBOT_TURNS_RADPS:
            found["deg"] = {"rate_max": float(np.nanmax(np.abs(rate)))}
    return found | ({"g": {"force_median": felt}} if _IN_G[0] <= felt <= _IN_G[1] else {})


def _check_yaw_signs(found: Exclusions, signs: Mapping[str, bool], *, is_stated: bool) -> None:
    """Check that gyroscope, odometries and fixes turn the same way, the IMU being upright by gravity."""

    def count_votes(name: str) -> float:
        return sum(signs.values()) + is_stated if name == IMU else sum(not sign for sign in signs.values()) - 0.5

    against = [role for role, sign in signs.items() if not sign and role != GNSS]
    for role, _, _ in _find_outvoted([(role, IMU) for role in against], count_votes):
        if role == IMU:
            found.setdefault(IMU, SensorExclusion(IMU, "imu-sign", {"reference": ", ".join(against)}))
        else:
            names = {"reference": ", ".join((IMU, *(other for other, sign in signs.items() if sign)))}
            found.setdefault(role, SensorExclusion(role, "yaw-rate-sign", names, turned_by=YAW))


def _make_yaw_exclusion(looks: Mapping[str, float], turned_by: Floats) -> SensorExclusion:
    """Return the exclusion of an IMU that the accelerations of odometries show to be turned, by yaw [rad]."""
    names, numbers = (
        {"evidence": "acceleration", "reference": ", ".join(looks)},
        {"off_rad": next(iter(looks.values()))},
    )
    return SensorExclusion(IMU, "imu-rotated", names, numbers, turned_by=turned_by)


# Directions

_MOVING_MPS = 0.2
_FEWEST_ROWS = 100


def _check_directions(
    found: Exclusions,
    forward: Mapping[str, Floats],
    wanted: Floats | None,
    looks: Mapping[str, float],
    *,
    is_stated: bool,
) -> None:
    """Check that odometries, command and accelerations go forward at once."""
    velocities = dict(forward) if wanted is None else {**forward, COMMAND: wanted}
    same = {
        (role, IMU): abs(yaw) < _ASIDE_RAD for role, yaw in looks.items() if not _ASIDE_RAD < abs(yaw) <= _BACKWARDS_RAD
    }
    for a, b in combinations(velocities, 2):
        agreement = compute_agreement(velocities[a], velocities[b])
        if agreement is not None and abs(agreement) > _SAME_WAY:
            same[a, b] = agreement > 0.0
    trust = {COMMAND: 1.0, IMU: float(is_stated), WHEELS: 0.5, VISUAL: 0.25}

    def count_votes(name: str) -> float:
        return trust[name] + sum(name in pair for pair, is_same in same.items() if is_same)

    turned = set()
    for role, other, lead in _find_outvoted([pair for pair, is_same in same.items() if not is_same], count_votes):
        if role == IMU:
            backwards = {each: yaw for each, yaw in looks.items() if abs(yaw) > _BACKWARDS_RAD}
            found.setdefault(IMU, _make_yaw_exclusion(backwards, FORWARD))
        elif role != COMMAND and role not in turned:
            turned.add(role)
            names = {"reference": other} | ({"suspect": other} if other in forward and lead < 1.0 else {})
            before = found[role].turned_by if role in found else None
            if role not in found or before is not None:  # and its yaw rate turns the other way
                turn = FORWARD if before is None else FORWARD @ before
                found[role] = SensorExclusion(role, "drives-backwards", names, turned_by=turn)


def compute_agreement(velocity_mps: Floats, other_mps: Floats) -> float | None:
    """Return by how much two signed velocities go the same way, -1 to 1, or None where one of them hardly moves; shape (M,) each."""
    moving = (np.abs(velocity_mps) > _MOVING_MPS) & (np.abs(other_mps) > _MOVING_MPS)
    if moving.sum() < _FEWEST_ROWS:
        return None
    return float(np.mean(np.sign(velocity_mps[moving] * other_mps[moving])))


# The receiver's own velocity, scales

_OFF = 0.25  # allowed share of disagreement in the right frame
_MAX_GAP_NS = 1_000_000_000


def check_ground_velocity(m: Measurements) -> SensorExclusion | None:
    """Return why the receiver's velocity of a clock epoch is not to be fused; None where the fixes confirm it."""
    at_ns = find_liveliest_window_ns(m)
    if m.doppler is None or at_ns is None:
        return None
    velocity, stamp_ns = m.doppler.velocity_enu_mps[:, :2], m.doppler.stamp_ns
    at_s, stamp_s = (compute_seconds(each, int(at_ns[0])) for each in (at_ns, stamp_ns))
    path = integrate_signal(stamp_s, velocity, at_s) @ np.array([1.0, 1j])
    path[~is_covered(stamp_ns, at_ns, at_ns, least_ns=_MAX_GAP_NS)] = np.nan
    fixes = np.full_like(path, np.nan) if m.gnss is None else resample_fixes(m.gnss, at_ns)
    pair, driven = (compare_paths(fixes, each, _SHORT_S, _compute_noise_m2(m.gnss)) for each in (path, fixes))
    if pair is None or driven is None:
        return SensorExclusion(DOPPLER, "velocity-unverified")

    def compute_misfit(product: Path) -> float:
        misfit_m2 = np.maximum(pair.a_m2 + pair.b_m2 - 2.0 * product.real, 0.0)
        return float(np.median(np.sqrt(misfit_m2 / np.maximum(pair.a_m2, 1e-9))))

    if compute_misfit(pair.product) <= _OFF:
        return None
    if pair.ratio < 0.1:
        return _make_frozen_exclusion(DOPPLER, "velocity", stamp_ns.size)
    is_ned = compute_misfit(-1j * pair.mirrored) <= _OFF
    if is_ned or abs(pair.ratio - 1.0) <= _OFF:
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


_SHORTEST_NS = 40_000_000_000  # shorter may be one place of slip
_HELD_NS = 3_000_000_000  # a command this long is reached
_STEP_MPS = 0.1  # smaller steps are jitter (`mask.command_step_mps`)
_DRIVES_MPS = 0.3  # motors round slower commands
_FASTER = 1.03  # of a command: no controller overshoots more


def compute_command_ratio(m: Measurements, command: Command | None) -> float | None:
    """Return the ratio of the wheels' speed to the command where it is surely too high, and no other sensor shows the scale; else None.

    Only times count in which a command has been constant for three seconds: a robot that brakes is faster than its command.
    """
    wheels = m.wheels
    if wheels is None or m.gnss is not None or m.visual is not None or command is None or command.stamp_ns.size == 0:
        return None
    commanded_mps = hold_last(command.stamp_ns, command.forward_velocity_mps, wheels.stamp_ns)
    # A difference to an unknown command is NaN, which is a change.
    changed = np.flatnonzero(~(np.abs(np.diff(commanded_mps, prepend=commanded_mps[0])) <= _STEP_MPS))
    began = np.concatenate(([0], changed))[np.searchsorted(changed, np.arange(commanded_mps.size), "right")]
    is_held = wheels.stamp_ns - wheels.stamp_ns[began] > _HELD_NS
    rows = is_held & (np.abs(commanded_mps) > _DRIVES_MPS) & np.isfinite(commanded_mps)
    if rows.sum() * compute_median_period_ns(wheels.stamp_ns) < _SHORTEST_NS:
        return None
    ratio = wheels.velocity_mps[rows, 0] / commanded_mps[rows]
    return float(np.median(ratio)) if np.quantile(ratio, 0.25) > _FASTER else None
