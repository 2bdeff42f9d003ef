"""Sensors that contradict physics or each other, and what would set each right; such a sensor is not to be fused.

An IMU in degrees or in g, one that does not stand upright, one that looks elsewhere; an odometry that drives or turns the other way;
an IMU too slow to be integrated; fixes on a mirrored path; a sensor that is frozen, or goes another distance than the rest. Where two
disagree a third decides: the command, the camera, the course of the fixes. Mountings that somebody stated weigh more than assumed ones.

A receiver's own velocity against the fixes of the same receiver, before it is fused: it helps, so where it is in doubt it stays out.

Its integral over windows is held against the displacement of the fixes. Windows are as long as it takes for the way in them to be far
longer than the fixes are noisy. Zero while the fixes move is a frozen one; a way as long as theirs in other directions is that of another
frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.distances import (
    COMMAND,
    Distances,
    compare_path_of_fixes,
    estimate_far_scale,
    find_contradictions,
    find_distances,
    find_frozen_sensors,
    refuse_frozen,
)
from tcpipe.fusion.checks.lags import (
    GRID_S,
    Floats,
    compute_course_rate,
    compute_fix_velocity,
    compute_moving_mean,
    find_liveliest_window_ns,
    resample_signal,
    resample_twist,
)
from tcpipe.fusion.checks.odometry_scale import Scale
from tcpipe.fusion.checks.plausibility import (
    SensorExclusion,
    YawAxis,
    compute_agreement,
    compute_levelling_rotation,
    find_forward_yaw_rad,
    find_nearest_mounting,
    find_up_axis,
    find_yaw_axis,
    join_names,
    refuse_fixes,
)
from tcpipe.fusion.measurements import (
    DOPPLER,
    GNSS,
    IMU,
    VISUAL,
    WHEELS,
    GroundVelocities,
    InertialMeasurements,
    Measurements,
    Positions,
)
from tcpipe.fusion.signals import compute_median_period_ns, compute_seconds, hold_last, integrate_signal, is_in_gap
from tcpipe.tables.facts import AxisFacts, SensorChecks, make_vector

_SMOOTH_S = 0.1
_IN_G = (0.8, 1.25)
_IN_MPS2 = (8.0, 12.0)
_IN_DEGREES = 1.0 / 15.0  # rad/s by the wheels over the gyroscope's rate; in radians 0.5 to 2
_NO_ROBOT_TURNS_RADPS = 15.0
_TILTED_RAD = np.radians(30.0)  # slopes average out; the steepest that is driven is 22.5 degrees
_LOOKS_ELSEWHERE_RAD = np.radians(60.0)
_BACKWARDS_RAD = np.radians(120.0)
_OTHER_WAY = -0.5
_LONGEST_IMU_STEP_S = 0.11  # 10 Hz, with the jitter of its driver
_MOSTLY = 0.5

FORWARD = np.diag([-1.0, -1.0, 1.0])
"""Turns a body's x axis round and leaves its yaw rate."""
YAW = np.diag([1.0, -1.0, -1.0])
"""Turns a body's yaw rate round and leaves its x axis."""


@dataclass(slots=True)
class Checks:
    """Exclusions in order, the scale of an odometry that is far off throughout, and the facts behind them."""

    refusals: list[SensorExclusion] = field(default_factory=list)
    scales: dict[str, Scale] = field(default_factory=dict)
    facts: SensorChecks = field(default_factory=SensorChecks)

    @property
    def yaw_axis(self) -> Mapping[str, AxisFacts]:
        """About which axis of the IMU the others turn."""
        return self.facts.yaw_axis or {}


@dataclass(frozen=True, slots=True)
class CommandedSpeed:
    """Commanded forward velocity: stamps [ns] and values [m/s], in order."""

    stamp_ns: NDArray[np.int64]
    forward_velocity_mps: Floats


def check_sensors(
    measurements: Measurements, *, command: CommandedSpeed | None, stated: Mapping[str, bool], felt: float
) -> Checks:
    """Return which sensors of a clock epoch are not to be fused.

    Parameters
    ----------
    measurements : in base_link axes, by the extrinsics in use.
    stated : by role, whether the extrinsics are stated (recipe, transforms, message in base_link) rather than assumed.
    felt : median size of the specific force as the IMU measured it, before its lever arm was taken out; NaN without an IMU.
    """
    checks = Checks()
    slow = None if measurements.imu is None else _refuse_slow(measurements.imu)
    if slow is not None:
        checks.refusals.append(slow)
        measurements = replace(measurements, imu=None)
    at_ns = find_liveliest_window_ns(measurements)
    if at_ns is None:
        return checks
    twists = {role: resample_twist(source, at_ns) for role, source in measurements.odometries().items()}
    if measurements.gnss is not None:
        checks.scales = _estimate_scales(measurements.gnss, twists, command, at_ns)
        twists |= {role: twists[role] / [scale.factor, 1.0] for role, scale in checks.scales.items()}
    found = find_distances(measurements.gnss, _add_command(twists, command, at_ns), at_ns)
    frozen = find_frozen_sensors(measurements, found)
    checks.refusals += frozen.values()
    twists = {role: twist for role, twist in twists.items() if role not in frozen}
    gnss = None if GNSS in frozen else measurements.gnss
    turning = {role: compute_moving_mean(twist, _SMOOTH_S)[:, 1] for role, twist in twists.items()}
    if gnss is not None:
        turning[GNSS] = compute_course_rate(compute_fix_velocity(gnss, at_ns))
    looks: dict[str, float] = {}
    if measurements.imu is not None and IMU not in frozen:
        looks = _check_imu(checks, measurements.imu, at_ns, felt, twists=twists, turning=turning, stated=stated)
    _check_directions(checks, twists, at_ns, command=command, looks=looks, stated=stated)
    _check_distances(checks, found.without(frozen))
    if gnss is not None:
        _check_path(checks, gnss, _replace_yaw_rate(checks, twists, measurements.imu, at_ns), at_ns)
    return checks


def _refuse_slow(imu: InertialMeasurements) -> SensorExclusion | None:
    """Return the exclusion of an IMU whose samples are mostly too far apart to show the motion between them."""
    step_s = np.diff(imu.stamp_ns) * 1e-9
    span_s = float(step_s.sum())
    if span_s > 0 and float(step_s[step_s < _LONGEST_IMU_STEP_S].sum()) >= _MOSTLY * span_s:
        return None
    return SensorExclusion(IMU, "imu-too-slow", numbers={"rate_hz": step_s.size / max(span_s, 1.0)})


def _estimate_scales(
    gnss: Positions, twists: Mapping[str, Floats], command: CommandedSpeed | None, at_ns: NDArray[np.int64]
) -> dict[str, Scale]:
    """Return the scale of the only odometry, by role, where its path is that of the fixes but far longer or shorter.

    A second odometry decides which of them errs (`find_contradictions`); a command at which the robot goes by the odometry confirms that.
    """
    if len(twists) != 1:
        return {}
    (role,) = twists
    scale = estimate_far_scale(gnss, twists[role], at_ns)
    if scale is None:
        return {}
    driven_m = {
        name: float(np.nansum(np.abs(twist[:, 0]))) * GRID_S
        for name, twist in _add_command(twists, command, at_ns).items()
    }
    told_m = driven_m.get(COMMAND, 0.0)
    if told_m and abs(np.log(told_m / driven_m[role])) < abs(np.log(scale[0])) / 2:
        return {}
    return {role: Scale(*scale, driven_m=driven_m[role])}


def _add_command(
    twists: Mapping[str, Floats], command: CommandedSpeed | None, at_ns: NDArray[np.int64]
) -> dict[str, Floats]:
    """Return the twists and, under `COMMAND`, the commanded speed with the yaw rate of an odometry."""
    if command is None or not twists:
        return dict(twists)
    wanted = hold_last(command.stamp_ns, command.forward_velocity_mps, at_ns)
    return {**twists, COMMAND: np.column_stack((wanted, next(iter(twists.values()))[:, 1]))}


def _check_distances(checks: Checks, found: Distances) -> None:
    """Check that all sensors go about as far."""
    turning = frozenset(role for role in checks.yaw_axis if role != GNSS)
    far_m = {role: float(np.nanmedian(chord)) for role, chord in found.chord_m.items() if np.isfinite(chord).any()}
    checks.facts = replace(checks.facts, distance_m=far_m)
    refused = {refusal.role for refusal in checks.refusals}
    checks.refusals += [of for role, of in find_contradictions(found, turning=turning).items() if role not in refused]


def _replace_yaw_rate(
    checks: Checks, twists: Mapping[str, Floats], imu: InertialMeasurements | None, at_ns: NDArray[np.int64]
) -> dict[str, Floats]:
    """Return the twists with the yaw rate of the gyroscope where it confirms theirs: wheels that skid turn by too much."""
    confirmed = {role for role, axis in checks.yaw_axis.items() if axis.axis[2] > -_OTHER_WAY}
    if imu is None or any(refusal.role == IMU for refusal in checks.refusals):
        return dict(twists)
    felt = resample_signal(imu.stamp_ns, imu.angular_velocity_radps, at_ns)[:, 2]
    return {
        role: np.column_stack((twist[:, 0], np.where(np.isfinite(felt), felt, twist[:, 1])))
        if role in confirmed
        else twist
        for role, twist in twists.items()
    }


def _check_path(checks: Checks, gnss: Positions, twists: Mapping[str, Floats], at_ns: NDArray[np.int64]) -> None:
    """Check that fixes and odometries have the same path; one odometry that no gyroscope confirms is as doubtful as the fixes."""
    refused = {refusal.role for refusal in checks.refusals}
    told = {role: compare_path_of_fixes(gnss, twist, at_ns) for role, twist in twists.items() if role not in refused}
    against = [role for role, how in told.items() if how in {"mirrored", "unlike"}]
    if GNSS in refused or not against or "alike" in told.values():
        return
    confirmed = len(against) > 1 or against[0] in checks.yaw_axis
    names = {"reference": join_names(against)}
    if "unlike" in told.values():
        if confirmed:
            checks.refusals.append(refuse_fixes("path-unlike", told, names))
    elif confirmed:
        checks.refusals.append(SensorExclusion(GNSS, "path-mirrored", names))
    else:
        checks.refusals.append(SensorExclusion(GNSS, "path-mirrored", {**names, "suspect": against[0]}))
        names = {"reference": GNSS, "suspect": GNSS}
        checks.refusals.append(SensorExclusion(against[0], "yaw-rate-sign", names, turned_by=YAW))


def _check_imu(
    checks: Checks,
    imu: InertialMeasurements,
    at_ns: NDArray[np.int64],
    felt: float,
    *,
    twists: Mapping[str, Floats],
    turning: Mapping[str, Floats],
    stated: Mapping[str, bool],
) -> dict[str, float]:
    """Check units, gravity and yaw; return the yaw of the unit by each odometry [rad] where it is upright."""
    rate = compute_moving_mean(resample_signal(imu.stamp_ns, imu.angular_velocity_radps, at_ns), _SMOOTH_S)
    axes = {role: found for role, yaw in turning.items() if (found := find_yaw_axis(yaw, rate)) is not None}
    up = find_up_axis(imu.specific_force_mps2)
    told = {role: AxisFacts(make_vector(axis.axis), axis.scale) for role, axis in axes.items()}
    checks.facts = replace(checks.facts, specific_force_median=felt, up=make_vector(up), yaw_axis=told)
    units = _find_units(rate, axes, felt)
    if units is not None:
        checks.refusals.append(
            SensorExclusion(IMU, "imu-units", {"units": units}, _collect_unit_evidence(units, axes, rate, felt), units)
        )
        return {}
    if felt == 0.0:
        checks.refusals.append(SensorExclusion(IMU, "imu-no-acceleration"))
    if not _IN_MPS2[0] <= felt <= _IN_MPS2[1]:
        return {}
    level = compute_levelling_rotation(up)
    force = resample_signal(imu.stamp_ns, imu.specific_force_mps2 @ level.T, at_ns)
    late_s = {role: axis.late_s for role, axis in axes.items()}
    ahead = {role: find_forward_yaw_rad(twist, force, late_s.get(role, 0.0)) for role, twist in twists.items()}
    looks_rad = {role: yaw for role, yaw in ahead.items() if yaw is not None}
    checks.facts = replace(checks.facts, looks_rad=looks_rad or None)
    looks = {role: yaw for role, (yaw, _) in looks_rad.items()}
    if up[2] < np.cos(_TILTED_RAD):
        tilt = {"off_rad": float(np.arccos(up[2]))}
        checks.refusals.append(
            SensorExclusion(
                IMU, "imu-rotated", {"evidence": "gravity"}, tilt, turned_by=_find_upright_rotation(level, looks)
            )
        )
        return {}
    return _check_yaw_sign(checks, axes, looks, stated)


def _find_units(rate: Floats, axes: Mapping[str, YawAxis], felt: float) -> str | None:
    """Return the recipe's word for the units an IMU seems to be in, or None where they are SI."""
    if axes:
        degrees = float(np.median([axis.scale for axis in axes.values()])) < _IN_DEGREES
    else:
        known = np.linalg.norm(rate[np.isfinite(rate.sum(1))], axis=1)
        degrees = known.size > 0 and float(np.percentile(known, 99.5)) > _NO_ROBOT_TURNS_RADPS
    words = (["deg"] if degrees else []) + (["g"] if _IN_G[0] <= felt <= _IN_G[1] else [])
    return "_".join(words) or None


def _collect_unit_evidence(units: str, axes: Mapping[str, YawAxis], rate: Floats, felt: float) -> dict[str, float]:
    """Return what shows the units: times the gyroscope turns as fast as another sensor (degrees: 57), or its fastest; median force."""
    evidence = {"force_median": felt} if "g" in units.split("_") else {}
    if "deg" in units and axes:
        evidence["turn_ratio"] = 1 / next(iter(axes.values())).scale
    elif "deg" in units:
        evidence["rate_max"] = float(np.nanmax(np.abs(rate)))
    return evidence


def _find_upright_rotation(level: Floats, looks: Mapping[str, float]) -> Floats:
    """Return the rotation that levels an IMU and, where acceleration shows it, turns it forward."""
    yaw = next(iter(looks.values()), 0.0)
    return find_nearest_mounting(_rotate_about_z(yaw) @ level)


def _rotate_about_z(yaw_rad: float) -> Floats:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _check_yaw_sign(
    checks: Checks, axes: Mapping[str, YawAxis], looks: dict[str, float], stated: Mapping[str, bool]
) -> dict[str, float]:
    """Check that gyroscope, odometries and fixes turn the same way, the IMU being upright by gravity."""
    against = [role for role, axis in axes.items() if axis.axis[2] < _OTHER_WAY]
    others = [role for role, axis in axes.items() if axis.axis[2] > -_OTHER_WAY]
    blamed = [role for role in against if role != GNSS]
    if not blamed:
        return looks
    if others or (len(against) == 1 and stated.get(IMU, False)):
        names = {"reference": join_names((IMU, *others))}
        checks.refusals += [SensorExclusion(role, "yaw-rate-sign", names, turned_by=YAW) for role in blamed]
        return looks
    checks.refusals.append(SensorExclusion(IMU, "imu-sign", {"reference": join_names(against)}))
    return {}


def _check_directions(
    checks: Checks,
    twists: Mapping[str, Floats],
    at_ns: NDArray[np.int64],
    *,
    command: CommandedSpeed | None,
    looks: Mapping[str, float],
    stated: Mapping[str, bool],
) -> None:
    """Check that the odometries go forward when the command or, without one, the accelerations say so."""
    forward = {role: twist[:, 0] for role, twist in twists.items()}
    against = _check_against_command(forward, command, at_ns)
    if against:
        for role in (role for role, backwards in against.items() if backwards):
            _add_turned(checks, role, {"reference": COMMAND})
        return
    backwards = {role: yaw for role, yaw in looks.items() if abs(yaw) > _BACKWARDS_RAD}
    if backwards and len(backwards) == len(forward) and (len(forward) > 1 or not stated.get(IMU, False)):
        checks.refusals.append(_refuse_yaw(backwards, FORWARD))
        return
    for role in backwards:
        _add_turned(checks, role, {"reference": IMU})
    same = compute_agreement(forward[WHEELS], forward[VISUAL]) if len(forward) > 1 and not looks else None
    if same is not None and same < _OTHER_WAY:
        _add_turned(checks, VISUAL, {"reference": WHEELS, "suspect": WHEELS})
    aside = {role: yaw for role, yaw in looks.items() if _LOOKS_ELSEWHERE_RAD < abs(yaw) <= _BACKWARDS_RAD}
    if aside and len(aside) == len(looks):
        checks.refusals.append(_refuse_yaw(aside, find_nearest_mounting(_rotate_about_z(next(iter(aside.values()))))))


def _refuse_yaw(looks: Mapping[str, float], turned_by: Floats) -> SensorExclusion:
    """Return the exclusion of an IMU that the accelerations of odometries show to be turned, by yaw [rad]."""
    names = {"evidence": "acceleration", "reference": join_names(looks)}
    numbers = {"off_rad": next(iter(looks.values()))}
    return SensorExclusion(IMU, "imu-rotated", names, numbers, turned_by=turned_by)


def _check_against_command(
    forward: Mapping[str, Floats], command: CommandedSpeed | None, at_ns: NDArray[np.int64]
) -> dict[str, bool]:
    """Return for each odometry that moves under a command whether it moves the other way."""
    if command is None:
        return {}
    wanted = hold_last(command.stamp_ns, command.forward_velocity_mps, at_ns)
    same = {role: compute_agreement(velocity, wanted) for role, velocity in forward.items()}
    return {role: value < _OTHER_WAY for role, value in same.items() if value is not None}


def _add_turned(checks: Checks, role: str, names: Mapping[str, str]) -> None:
    """Refuse an odometry that drives backwards, in one with a yaw rate that turns the other way."""
    before = next((refusal for refusal in checks.refusals if refusal.role == role), None)
    turned_by = FORWARD
    if before is not None and before.turned_by is not None:
        checks.refusals.remove(before)
        turned_by = FORWARD @ before.turned_by
    checks.refusals.append(SensorExclusion(role, "drives-backwards", names, turned_by=turned_by))


_WINDOWS_S = (4.0, 8.0, 16.0, 32.0, 64.0)
_FEWEST_WINDOWS = 3  # windows in which fixes show motion
_CLEARLY = 4.0  # σ of fixes that a distance needs
_MOVES_M = 1.0  # shorter distances do not count; windows 4 to 64 s
_OFF = 0.25  # allowed share of disagreement in the right frame
_STANDS = 0.1  # a velocity with less distance is frozen
_MAX_GAP_NS = 1_000_000_000


def check_ground_velocity(m: Measurements) -> SensorExclusion | None:
    """Return why the receiver's velocity of a clock epoch is not to be fused; None where the fixes confirm it."""
    if m.doppler is None:
        return None
    if m.gnss is None:
        return SensorExclusion(DOPPLER, "velocity-unverified")
    windows = _compute_displacements(m.gnss, m.doppler)
    if windows is None:
        return SensorExclusion(DOPPLER, "velocity-unverified")
    return _check_frame(*windows, m.doppler.stamp_ns.size)


def _compute_displacements(
    gnss: Positions, doppler: GroundVelocities
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]] | None:
    """Return the displacement by the fixes and by the velocity in windows [m], east and i times north; None where too few fixes move."""
    noise_m = float(np.sqrt(2.0 * np.median(gnss.variance_m2[:, :2])))
    zero = int(gnss.stamp_ns[0])
    fix_s = compute_seconds(gnss.stamp_ns, zero)
    east_north = np.array([1.0, 1j])
    longest_ns = max(_MAX_GAP_NS, 3 * compute_median_period_ns(doppler.stamp_ns))
    for window_s in _WINDOWS_S:
        last = np.searchsorted(fix_s, fix_s + window_s)
        first = np.flatnonzero(last < fix_s.size)
        last = last[first]
        whole = ~is_in_gap(doppler.stamp_ns, gnss.stamp_ns[first], gnss.stamp_ns[last], longest_ns=longest_ns)
        first, last = first[whole], last[whole]
        by_fixes = (gnss.position_enu_m[last, :2] - gnss.position_enu_m[first, :2]) @ east_north
        far = np.abs(by_fixes) > max(_MOVES_M, _CLEARLY * noise_m)
        apart = max(1, round(window_s * 1e9 / compute_median_period_ns(gnss.stamp_ns)))
        if far.sum() < _FEWEST_WINDOWS * apart:
            continue
        total = (
            integrate_signal(compute_seconds(doppler.stamp_ns, zero), doppler.velocity_enu_mps[:, :2], fix_s)
            @ east_north
        )
        return by_fixes[far], (total[last] - total[first])[far]
    return None


def _check_frame(
    by_fixes: NDArray[np.complex128], by_velocity: NDArray[np.complex128], messages: int
) -> SensorExclusion | None:
    """Return what is wrong with the directions or the size of the velocity."""

    def off(told: NDArray[np.complex128]) -> float:
        return float(np.median(np.abs(by_fixes - told) / np.abs(by_fixes)))

    if off(by_velocity) <= _OFF:
        return None
    size = float(np.median(np.abs(by_velocity) / np.abs(by_fixes)))
    if size < _STANDS:
        return refuse_frozen(DOPPLER, "velocity", messages)
    if off(1j * np.conj(by_velocity)) <= _OFF:
        return SensorExclusion(DOPPLER, "velocity-frame", {"frame": "north-east-down"})
    if abs(size - 1.0) <= _OFF:
        return SensorExclusion(DOPPLER, "velocity-frame", {"frame": "unknown"})
    return SensorExclusion(DOPPLER, "distance-contradicted", {"reference": GNSS}, {"distance_ratio": size})
