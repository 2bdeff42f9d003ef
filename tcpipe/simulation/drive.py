"""Drives a robot over a world: manoeuvres in, truth out.

Time runs at 200 Hz. Along a leg only position on the path and wheel speed are integrated (`robot.drive_along`); everything else follows
exactly: the pose stands tangent on the surface, ground metres from the projection, power from the plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.errors import UsageError
from tcpipe.geometry.rotation import invert, multiply, quat_from_matrix, rotation_vector_from_quat
from tcpipe.simulation.robot import SimulatedRobot, compute_rolling_resistance, drive_along, make_correlated_noise
from tcpipe.simulation.route import (
    PATH_GRID_M,
    Leg,
    Manoeuvre,
    Path,
    Pause,
    Reverse,
    Stuck,
    Turn,
    compute_moving_average,
    make_leg_path,
    make_straight_path,
)
from tcpipe.simulation.truth import Truth
from tcpipe.simulation.world import Float, World

STEP_NS = 5_000_000
_DT_S = STEP_NS * 1e-9
_BRAKE_BEFORE_M = 0.5
_SMALL_TURN_RAD = 1e-6
_DIGGING_RESISTANCE = 0.3
"""Of wheels that turn while the robot is stuck."""


@dataclass(frozen=True, slots=True)
class _Stretch:
    """One manoeuvre, sampled: position in the map from the site's corner, direction in the map, wheel speed, slip, commands."""

    uv_m: Float
    yaw_map_rad: Float
    wheel_mps: Float
    slip: Float
    command_mps: Float
    command_radps: Float


def simulate_drive(
    world: World,
    plan: Sequence[Manoeuvre],
    *,
    start_m: tuple[float, float],
    start_yaw_rad: float = 0.0,
    start_ns: int = 0,
    robot: SimulatedRobot,
    weave_m: float = 0.04,
    rng: np.random.Generator,
) -> Truth:
    """Drive ``plan`` from ``start_m`` (from the site's south-west corner) and return the truth.

    ``start_yaw_rad`` counts from the map's x axis; ``weave_m`` is how far the human weaves to the side.
    """
    stretches: list[_Stretch] = []
    place, yaw = np.array(start_m, dtype=np.float64), start_yaw_rad
    for manoeuvre in plan:
        for stretch in _plan_stretches(world, manoeuvre, place, yaw, robot=robot, weave_m=weave_m, rng=rng):
            stretches.append(stretch)
            place, yaw = stretch.uv_m[-1], float(stretch.yaw_map_rad[-1])
    if not stretches:
        raise UsageError("simulated drive: the plan is empty; give it at least one manoeuvre")
    joined = _Stretch(
        *(np.concatenate([getattr(stretch, name) for stretch in stretches]) for name in _Stretch.__dataclass_fields__)
    )
    return _make_truth(world, joined, robot, start_ns, rng)


def _plan_stretches(
    world: World,
    manoeuvre: Manoeuvre,
    place: Float,
    yaw: float,
    *,
    robot: SimulatedRobot,
    weave_m: float,
    rng: np.random.Generator,
) -> list[_Stretch]:
    match manoeuvre:
        case Pause(duration_s):
            return [_make_halt(place, yaw, duration_s)]
        case Stuck(duration_s):
            return [
                _make_halt(
                    place, yaw, duration_s, wheel_mps=0.6 * robot.max_velocity_mps, command_mps=robot.max_velocity_mps
                )
            ]
        case Turn(angle_rad):
            return [_turn(place, yaw, angle_rad, robot)]
        case Reverse(distance_m, command):
            path = make_straight_path(place, yaw + np.pi, distance_m)
            return [_drive_path(world, path, command, robot, backwards=True)]
        case Leg():
            weave = (rng.uniform(5.0, 12.0, 3), rng.uniform(0.0, 2.0 * np.pi, 3), np.full(3, 1.0 / 3.0))
            path = make_leg_path(place, manoeuvre, weave=weave, weave_m=weave_m)
            wanted = float(path.at(np.zeros(1))[1][0])
            turn = (wanted - yaw + np.pi) % (2.0 * np.pi) - np.pi
            first = (
                [_turn(place, yaw, turn, robot), _make_halt(place, yaw + turn, 0.5)]
                if abs(turn) > _SMALL_TURN_RAD
                else []
            )
            return [*first, _drive_path(world, path, manoeuvre.command, robot, backwards=False)]


def _make_halt(
    place: Float, yaw: float, duration_s: float, *, wheel_mps: float = 0.0, command_mps: float = 0.0
) -> _Stretch:
    count = max(round(duration_s / _DT_S), 1)
    t = np.arange(count) * _DT_S
    wheel = wheel_mps * np.clip(np.minimum(t, t[-1] - t) / 0.4, 0.0, 1.0)
    slip, zero = np.full(count, 1.0 if wheel_mps else 0.0), np.zeros(count)
    return _Stretch(np.tile(place, (count, 1)), np.full(count, yaw), wheel, slip, np.full(count, command_mps), zero)


def _turn(place: Float, yaw: float, angle_rad: float, robot: SimulatedRobot) -> _Stretch:
    """Turn with a trapezoid of yaw rate that ends exactly at the angle."""
    rate, rise_s = robot.max_yaw_rate_radps, 0.35
    size = abs(angle_rad)
    hold_s = max(size / rate - rise_s, 0.0)
    t = np.arange(0.0, hold_s + 2.0 * rise_s + _DT_S, _DT_S)
    shape = np.clip(np.minimum(t, hold_s + 2.0 * rise_s - t) / rise_s, 0.0, 1.0)
    swept = np.concatenate([[0.0], np.cumsum(shape[1:] + shape[:-1])])
    zero = np.zeros(t.size)
    command = np.where(t < hold_s + rise_s, np.sign(angle_rad) * min(rate, size / rise_s), 0.0)
    return _Stretch(np.tile(place, (t.size, 1)), yaw + angle_rad * swept / swept[-1], zero, zero, zero, command)


def _drive_path(world: World, path: Path, command: float, robot: SimulatedRobot, *, backwards: bool) -> _Stretch:
    """Drive a path from rest to rest."""
    grid = np.arange(0.0, path.length_m, PATH_GRID_M)
    uv, direction = path.at(grid)
    x, y = uv[:, 0] + world.site.west_m, uv[:, 1] + world.site.south_m
    scale, _ = world.site.ground_from_map(x, y, world.height_m(x, y) + world.site.geoid_m)
    gx, gy = world.gradient(x, y)
    slope = np.arctan((gx * np.cos(direction) + gy * np.sin(direction)) / scale)
    ground = robot.ground_table()[world.terrain_class(x, y)]
    speed_factor = robot.speed_factor(compute_moving_average(ground[:, 0], robot.wheelbase_m), np.sin(slope))
    if robot.wheels is not None:
        usual = compute_moving_average(ground[:, 2], robot.wheelbase_m)
        excess = compute_rolling_resistance(world, robot, x, y, direction) - usual
        speed_factor = speed_factor * (1.0 - robot.wheels.slowdown * excess)
    slip = robot.slip(compute_moving_average(ground[:, 1], robot.wheelbase_m), np.sin(slope))
    command_mps = command * robot.max_velocity_mps
    brake_at_m = max(path.stop_m - _BRAKE_BEFORE_M * command, 0.1)
    s, wheel, steps = drive_along(
        PATH_GRID_M, speed_factor, slip, np.cos(slope) / scale, command_mps, brake_at_m,
        robot.speed_time_constant_s, robot.max_acceleration_mps2, _DT_S, int(path.length_m / (0.2 * command_mps * _DT_S)),
    )  # fmt: skip
    if wheel[-1] > 0.0 or s[-1] > grid[-1]:
        raise UsageError(
            f"simulated drive: the robot does not stop on a leg of {path.length_m:.1f} m ({steps} steps); make it longer"
        )
    uv, direction = path.at(s)
    sign = -1.0 if backwards else 1.0
    yaw = np.unwrap(direction) + (np.pi if backwards else 0.0)
    braking = s >= brake_at_m
    commanded = np.where(braking, 0.0, sign * command_mps)
    commanded_rate = np.where(braking, 0.0, np.gradient(yaw, _DT_S)) if s.size > 1 else np.zeros(1)
    return _Stretch(uv, yaw, sign * wheel, np.interp(s, grid, slip), commanded, commanded_rate)


def _make_truth(
    world: World, driven: _Stretch, robot: SimulatedRobot, start_ns: int, rng: np.random.Generator
) -> Truth:
    site = world.site
    x, y = driven.uv_m[:, 0] + site.west_m, driven.uv_m[:, 1] + site.south_m
    alt = world.height_m(x, y) + site.geoid_m
    lon, lat = site.lonlat_deg(x, y)
    enu = site.enu_m(lon, lat, alt)
    scale, rotation = site.ground_from_map(x, y, alt)
    gx, gy = world.gradient(x, y)
    rise_east = (gx * np.cos(rotation) - gy * np.sin(rotation)) / scale
    rise_north = (gx * np.sin(rotation) + gy * np.cos(rotation)) / scale
    quat = _compute_tangent_pose(driven.yaw_map_rad + rotation, rise_east, rise_north)
    yaw = driven.yaw_map_rad + rotation
    slope = np.arctan(rise_east * np.cos(yaw) + rise_north * np.sin(yaw))
    stamp_ns = start_ns + np.arange(x.size, dtype=np.int64) * STEP_NS
    terrain = world.terrain_class(x, y)
    rolling = compute_rolling_resistance(world, robot, x, y, driven.yaw_map_rad)
    voltage, current, right_share = _compute_power(robot, driven, slope, rolling, rng)
    step = np.diff(enu, axis=0)
    energy_step = 0.5 * (voltage[1:] * current[1:] + voltage[:-1] * current[:-1]) * _DT_S
    return Truth(
        stamp_ns=stamp_ns, x_map_m=x, y_map_m=y, lon_deg=lon, lat_deg=lat, alt_m=alt, enu_m=enu, quat_xyzw=quat,
        velocity_enu_mps=np.gradient(enu, _DT_S, axis=0),
        angular_velocity_radps=_compute_angular_velocity(quat),
        forward_velocity_mps=driven.wheel_mps * (1.0 - driven.slip),
        wheel_velocity_mps=driven.wheel_mps, slip=driven.slip, slope_rad=slope, terrain_class=terrain,
        command_velocity_mps=driven.command_mps, command_yaw_rate_radps=driven.command_radps,
        voltage_volt=voltage, current_amp=current, right_share=right_share, power_watt=voltage * current,
        energy_joule=np.concatenate([[0.0], np.cumsum(energy_step)]),
        distance_m=np.concatenate([[0.0], np.cumsum(np.hypot(step[:, 0], step[:, 1]))]),
    )  # fmt: skip


def _compute_tangent_pose(yaw_rad: Float, rise_east: Float, rise_north: Float) -> Float:
    """Return enu_from_base_link: x looks along the yaw on the surface, z along its normal."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    forward = np.stack([c, s, rise_east * c + rise_north * s], axis=-1)
    up = np.stack([-rise_east, -rise_north, np.ones_like(c)], axis=-1)
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    return quat_from_matrix(np.stack([forward, np.cross(up, forward), up], axis=-1))


def _compute_angular_velocity(quat_xyzw: Float) -> Float:
    """Return the body rates [rad/s] by central differences on the rotation group."""
    before = np.concatenate([quat_xyzw[:1], quat_xyzw[:-1]])
    after = np.concatenate([quat_xyzw[1:], quat_xyzw[-1:]])
    span_s = np.full(quat_xyzw.shape[0], 2.0 * _DT_S)
    span_s[[0, -1]] = _DT_S
    return np.asarray(rotation_vector_from_quat(multiply(invert(before), after)) / span_s[:, None])


def _compute_power(
    robot: SimulatedRobot, driven: _Stretch, slope: Float, rolling: Float, rng: np.random.Generator
) -> tuple[Float, Float, Float]:
    """Return voltage, propulsion current, and the right driver's share of it."""
    rolling = np.where(driven.slip == 1.0, _DIGGING_RESISTANCE, rolling)
    noise = make_correlated_noise(rng.standard_normal(slope.size), float(np.exp(-_DT_S / robot.resistance_noise_s)))
    yaw_rate = np.gradient(np.unwrap(driven.yaw_map_rad), _DT_S)
    wheel_power = robot.wheel_power_watt(
        wheel_velocity_mps=driven.wheel_mps,
        acceleration_mps2=np.gradient(driven.wheel_mps, _DT_S),
        yaw_rate_radps=yaw_rate,
        slope_rad=slope,
        rolling_resistance=rolling * (1.0 + robot.resistance_noise * noise),
    )
    voltage, current = robot.battery(robot.propulsion_watt(wheel_power, driven.wheel_mps), dt_s=_DT_S)
    return voltage, current, 0.5 + 0.15 * np.tanh(yaw_rate)
