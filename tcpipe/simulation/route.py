"""Plans of simulated drives, and the truth of driving them over a world.

A plan is a list of manoeuvres. A `Leg` starts at the robot's pose, after a turn in place if necessary; its corners
become arcs, its curvature is smoothed over 0.5 m, and sideways weaving of a human driver is added.

Time runs at 200 Hz. Along a leg only position on the path and wheel speed are integrated (`robot.drive_along`); pose,
ground distance and power follow exactly from the surface, the projection and the robot model.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from tcpipe.arrays import Bytes, Floats, Mask, accumulate
from tcpipe.errors import UsageError
from tcpipe.geometry.rotation import invert, multiply, quat_from_matrix, rotation_vector_from_quat
from tcpipe.simulation.robot import SimulatedRobot, compute_rolling_resistance, drive_along, make_correlated_noise
from tcpipe.simulation.truth import Truth
from tcpipe.simulation.world import GRASS, Band, World

PATH_GRID_M = 0.01
_SMOOTH_M = 0.5
_RUN_OUT_M = 3.0


@dataclass(frozen=True, slots=True)
class Leg:
    """Drive through waypoints without a stop, from rest to rest."""

    waypoints_m: tuple[tuple[float, float], ...]
    """Positions from the site's south-west corner, without the robot's own position."""
    radius_m: float = 2.5  # radius of the curves
    command: float = 1.0  # commanded speed as a fraction of the robot's maximum


@dataclass(frozen=True, slots=True)
class Reverse:
    """Drive straight back, from rest to rest."""

    distance_m: float
    command: float = 1.0


@dataclass(frozen=True, slots=True)
class Pause:
    """Stay stationary for a time."""

    duration_s: float


@dataclass(frozen=True, slots=True)
class Turn:
    """Turn in place by an angle, counter-clockwise."""

    angle_rad: float


@dataclass(frozen=True, slots=True)
class Stuck:
    """The wheels turn, the robot is stationary."""

    duration_s: float


Manoeuvre = Leg | Reverse | Pause | Turn | Stuck


@dataclass(frozen=True, slots=True)
class Path:
    """A smooth curve in the map plane, by its arc length in map metres; the robot should stop near ``stop_m``."""

    curve: CubicSpline
    length_m: float
    stop_m: float

    def at(self, s_m: Floats) -> tuple[Floats, Floats]:
        """Return positions, shape (N, 2), and tangent directions from the map's x axis [rad]."""
        tangent = self.curve(s_m, 1)
        return self.curve(s_m), np.arctan2(tangent[:, 1], tangent[:, 0])


def make_leg_path(start_m: Floats, leg: Leg, *, weave: tuple[Floats, Floats, Floats], weave_m: float) -> Path:
    """Return the curve of ``leg`` from ``start_m``, shape (2,), in the coordinates of its waypoints.

    ``weave`` contains wavelengths [m], phases [rad] and weights of the sideways weaving, of total amplitude
    ``weave_m``.
    """
    corners = np.vstack([start_m, np.asarray(leg.waypoints_m, dtype=float)])
    curvature, straight_m = _compute_curvature(corners, leg.radius_m)
    first = corners[1] - corners[0]
    yaw = np.arctan2(first[1], first[0]) + _integrate(curvature)
    s = np.arange(yaw.size) * PATH_GRID_M
    wavelengths, phases, weights = weave
    window = np.clip(np.minimum(s, straight_m - s) / 3.0, 0.0, 1.0)
    sway = np.sin(2.0 * np.pi * s[:, None] / wavelengths + phases) @ weights
    offset = weave_m * (window * window * (3.0 - 2.0 * window)) * sway
    middle = np.column_stack([_integrate(np.cos(yaw)), _integrate(np.sin(yaw))]) + corners[0]
    points = middle + offset[:, None] * np.column_stack([-np.sin(yaw), np.cos(yaw)])
    arc = accumulate(np.hypot(*np.diff(points, axis=0).T))
    stop_m, arc = float(np.interp(straight_m, s, arc)), arc[::10]
    return Path(CubicSpline(arc, points[::10]), float(arc[-1]), stop_m)


def make_straight_path(start_m: Floats, direction_rad: float, distance_m: float) -> Path:
    """Return a straight path on which the robot should stop after ``distance_m``."""
    s = np.linspace(0.0, distance_m + _RUN_OUT_M, 8)
    points = start_m + s[:, None] * np.array([np.cos(direction_rad), np.sin(direction_rad)])
    return Path(CubicSpline(s, points), float(s[-1]), distance_m)


def _integrate(values: Floats) -> Floats:
    return accumulate(values[:-1] + values[1:]) * PATH_GRID_M / 2


def _compute_curvature(corners: Floats, radius_m: float) -> tuple[Floats, float]:
    """Return the smoothed curvature every PATH_GRID_M, run-out included, and the length up to the last corner."""
    steps = np.diff(corners, axis=0)
    lengths = np.hypot(*steps.T)
    turns = (np.diff(np.arctan2(steps[:, 1], steps[:, 0])) + np.pi) % (2.0 * np.pi) - np.pi
    cuts = np.zeros(lengths.size + 1)
    for i, turn in enumerate(turns):
        cuts[i + 1] = min(radius_m * np.tan(abs(turn) / 2.0), 0.45 * min(lengths[i], lengths[i + 1]))
    pieces = []
    for i, length in enumerate(lengths):
        pieces.append(np.zeros(max(round((length - cuts[i] - cuts[i + 1]) / PATH_GRID_M), 1)))
        if i < turns.size and abs(turns[i]) > 1e-6:
            arc_m = cuts[i + 1] / np.tan(abs(turns[i]) / 2.0) * abs(turns[i])
            count = max(round(arc_m / PATH_GRID_M), 1)
            pieces.append(np.full(count, turns[i] / (count * PATH_GRID_M)))
    straight_m = sum(piece.size for piece in pieces) * PATH_GRID_M
    pieces.append(np.zeros(round(_RUN_OUT_M / PATH_GRID_M)))
    return compute_moving_average(compute_moving_average(np.concatenate(pieces), _SMOOTH_M), _SMOOTH_M), straight_m


def compute_moving_average(values: Floats, window_m: float) -> Floats:
    """Return the centred mean over ``window_m`` of values given every PATH_GRID_M; ends are held."""
    half = max(round(window_m / PATH_GRID_M / 2), 1)
    padded = np.concatenate([np.full(half, values[0]), values, np.full(half, values[-1])])
    sums = accumulate(padded)
    return np.asarray((sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1))


@dataclass(frozen=True, slots=True)
class AlongRoad:
    """Drives back and forth on a road, each time along another line."""

    road: Band
    from_m: float  # along the road's axis, from its (x, y)
    to_m: float
    length_m: float  # about how far to drive

    _STEP_M = 9.0
    _LEG_STEPS = 6
    _VERGE_M = 1.3

    @property
    def start_m(self) -> tuple[float, float]:
        """Start, from the site's south-west corner."""
        return self._place(self.from_m, 0.0)

    def plan(self, world: World, rng: np.random.Generator) -> list[Manoeuvre]:  # noqa: ARG002  as other tours
        """Return the manoeuvres; the same generator state gives the same plan."""
        plan: list[Manoeuvre] = [Pause(3.0)]
        reach = max(self.road.width_m / 2.0 - self._VERGE_M, 0.0)
        marks = np.arange(self.from_m, self.to_m, self._STEP_M)
        driven, back = 0.0, False
        while driven < self.length_m:
            aside = float(rng.uniform(-reach, reach))
            line = [self._place(float(at), aside) for at in (marks[::-1] if back else marks)]
            for first in range(1, len(line), self._LEG_STEPS):
                plan.append(Leg(tuple(line[first : first + self._LEG_STEPS])))
                plan.append(Pause(float(rng.uniform(0.6, 2.5))))
                driven += self._STEP_M * len(line[first : first + self._LEG_STEPS])
                if driven >= self.length_m:
                    break
            back = not back
        return plan

    def _place(self, along_m: float, aside_m: float) -> tuple[float, float]:
        road = self.road
        across = aside_m + road.amplitude_m * np.sin(2.0 * np.pi / road.wavelength_m * along_m + road.phase_rad)
        c, s = np.cos(road.direction_rad), np.sin(road.direction_rad)
        return float(road.x_m + c * along_m - s * across), float(road.y_m + s * along_m + c * across)


@dataclass(frozen=True, slots=True)
class Wander:
    """A random tour that stays on traversable ground and steers towards wanted shares of terrain classes."""

    length_m: float  # about how far to drive
    start_m: tuple[float, float]  # from the site's south-west corner
    shares: tuple[tuple[int, float], ...] = ((4, 0.51), (5, 0.09), (6, 0.20), (7, 0.20))
    """Wanted share of the distance by class id (the paper's by default)."""
    x_range_m: tuple[float, float] | None = None
    """Limits of the tour, from the site's west border; None: the whole site."""
    margin_m: float = 5.0  # kept from the site's border
    max_slope_deg: float = 22.5  # steeper ground is avoided
    climbing: float = 0.3  # how much steep ground draws it, against wanted classes
    odd_manoeuvres: bool = True  # now and then reverse, drive slowly, or get stuck

    def plan(self, world: World, rng: np.random.Generator) -> list[Manoeuvre]:
        """Return the manoeuvres; the same generator state gives the same plan."""
        here, driven = np.array(self.start_m), 0.0
        plan, done, legs = list[Manoeuvre]([Pause(3.0)]), np.zeros(256), 0
        while driven < self.length_m:
            odd = legs % 6 if self.odd_manoeuvres else -1
            waypoints, direction = list[tuple[float, float]](), None
            for _ in range(1 if odd == 5 else int(rng.integers(2, 6))):
                step = self._next(world, rng, here, direction, done)
                if step is None or driven >= self.length_m:
                    break
                direction = float(np.arctan2(step[1] - here[1], step[0] - here[0]))
                driven += float(np.hypot(*(step - here)))
                waypoints.append((float(step[0]), float(step[1])))
                here = step
            if not waypoints:
                here = here + rng.uniform(-1.0, 1.0, 2)
                continue
            legs += 1
            plan.append(Leg(tuple(waypoints), radius_m=float(rng.uniform(1.2, 4.0)), command=0.5 if odd == 5 else 1.0))
            plan.append(Pause(float(rng.uniform(0.6, 2.5))))
            if odd == 1:
                plan += [Reverse(2.5), Pause(1.0)]
            if odd == 3:
                plan += [Stuck(2.0), Pause(0.8)]
        return plan

    def _next(
        self, world: World, rng: np.random.Generator, here: Floats, direction: float | None, done: Floats
    ) -> Floats | None:
        """Return the best of many random waypoints, with its classes counted in ``done``; None if none is allowed."""
        count, points = 192, 40
        turn = rng.normal(0.0, 0.6, count) if direction is not None else rng.uniform(-np.pi, np.pi, count)
        turn = np.clip(turn, -1.9, 1.9) if direction is not None else turn
        heading = turn + (direction or 0.0)
        length = rng.uniform(6.0, 24.0, count)
        taste = rng.random(count)
        along = np.linspace(0.0, 1.0, points)
        u = here[0] + np.outer(length * np.cos(heading), along)
        v = here[1] + np.outer(length * np.sin(heading), along)
        allowed, classes, steepness = self._allowed(world, u, v)
        if not allowed.any():
            return None
        wanted = np.zeros(256)
        wanted[[class_id for class_id, _ in self.shares]] = [share for _, share in self.shares]
        deficit = wanted - done / max(done.sum(), 1.0)
        relative = deficit / np.maximum(wanted, 0.05)
        score = np.where(allowed, relative[classes].mean(axis=1) + self.climbing * steepness + 0.25 * taste, -np.inf)
        best = int(np.argmax(score))
        done += length[best] * np.bincount(classes[best], minlength=256) / points
        return np.array([u[best, -1], v[best, -1]])

    def _allowed(self, world: World, u: Floats, v: Floats) -> tuple[Mask, Bytes, Floats]:
        """Return which lines may be driven, their classes, and their overall steepness (1: the steepest allowed)."""
        site, margin = world.site, self.margin_m
        west, east = self.x_range_m or (margin, site.width_m - margin)
        inside = (u > west) & (u < east) & (v > margin) & (v < site.height_m - margin)
        x, y = u + site.west_m, v + site.south_m
        steepness = np.hypot(*world.gradient(x, y)) / np.tan(np.radians(self.max_slope_deg))
        classes = world.terrain_class(x, y)
        near = [world.terrain_class(x + dx, y + dy) for dx, dy in ((1.5, 0), (-1.5, 0), (0, 1.5), (0, -1.5))]
        free = np.minimum.reduce([classes, *near]) >= GRASS
        return (inside & (steepness <= 1.0) & free).all(axis=1), classes, steepness.mean(axis=1)


STEP_NS = 5_000_000
_DT_S = STEP_NS * 1e-9
_BRAKE_BEFORE_M = 0.5
_SMALL_TURN_RAD = 1e-6
_DIGGING_RESISTANCE = 0.3  # rolling resistance of wheels that turn while the robot is stuck [1]


@dataclass(frozen=True, slots=True)
class _DrivePart:
    """One manoeuvre, sampled: position from the map corner and direction in the map, wheel speed, slip, commands."""

    uv_m: Floats
    yaw_map_rad: Floats
    wheel_mps: Floats
    slip: Floats
    command_mps: Floats
    command_radps: Floats


def simulate_drive(
    world: World, plan: Sequence[Manoeuvre], *, start_m: tuple[float, float],
    start_ns: int = 0, robot: SimulatedRobot, weave_m: float = 0.04, rng: np.random.Generator,
) -> Truth:  # fmt: skip
    """Drive ``plan`` from ``start_m`` (from the site's south-west corner) and return the truth.

    The robot begins along the map's x axis; ``weave_m`` is how far the human weaves to the side.
    """
    parts: list[_DrivePart] = []
    place, yaw = np.array(start_m, dtype=float), 0.0
    for manoeuvre in plan:
        for part in _plan_parts(world, manoeuvre, place, yaw, robot=robot, weave_m=weave_m, rng=rng):
            parts.append(part)
            place, yaw = part.uv_m[-1], float(part.yaw_map_rad[-1])
    if not parts:
        raise UsageError("simulated drive: the plan is empty; give it at least one manoeuvre")
    joined = _DrivePart(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in _DrivePart.__dataclass_fields__)
    )
    return _make_truth(world, joined, robot, start_ns, rng)


def _plan_parts(
    world: World, manoeuvre: Manoeuvre, place: Floats, yaw: float, *,
    robot: SimulatedRobot, weave_m: float, rng: np.random.Generator,
) -> list[_DrivePart]:  # fmt: skip
    """Return the driven sections of a manoeuvre that begins at a position and yaw."""
    match manoeuvre:
        case Pause(duration_s):
            return [_make_halt(place, yaw, duration_s)]
        case Stuck(duration_s):
            fastest_mps = robot.max_velocity_mps
            return [_make_halt(place, yaw, duration_s, wheel_mps=0.6 * fastest_mps, command_mps=fastest_mps)]
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
            drive = _drive_path(world, path, manoeuvre.command, robot, backwards=False)
            if abs(turn) <= _SMALL_TURN_RAD:
                return [drive]
            return [_turn(place, yaw, turn, robot), _make_halt(place, yaw + turn, 0.5), drive]


def _make_halt(
    place: Floats, yaw: float, duration_s: float, *, wheel_mps: float = 0.0, command_mps: float = 0.0
) -> _DrivePart:
    count = max(round(duration_s / _DT_S), 1)
    t = np.arange(count) * _DT_S
    wheel = wheel_mps * np.clip(np.minimum(t, t[-1] - t) / 0.4, 0.0, 1.0)
    slip, zero = np.full(count, 1.0 if wheel_mps else 0.0), np.zeros(count)
    return _DrivePart(np.tile(place, (count, 1)), np.full(count, yaw), wheel, slip, np.full(count, command_mps), zero)


def _turn(place: Floats, yaw: float, angle_rad: float, robot: SimulatedRobot) -> _DrivePart:
    """Turn with a trapezoid of yaw rate that ends exactly at the angle."""
    rate, rise_s = robot.max_yaw_rate_radps, 0.35
    size = abs(angle_rad)
    hold_s = max(size / rate - rise_s, 0.0)
    t = np.arange(0.0, hold_s + 2.0 * rise_s + _DT_S, _DT_S)
    shape = np.clip(np.minimum(t, hold_s + 2.0 * rise_s - t) / rise_s, 0.0, 1.0)
    swept = accumulate(shape[1:] + shape[:-1])
    zero = np.zeros(t.size)
    command = np.where(t < hold_s + rise_s, np.sign(angle_rad) * min(rate, size / rise_s), 0.0)
    return _DrivePart(np.tile(place, (t.size, 1)), yaw + angle_rad * swept / swept[-1], zero, zero, zero, command)


def _drive_path(world: World, path: Path, command: float, robot: SimulatedRobot, *, backwards: bool) -> _DrivePart:
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
        robot.speed_time_constant_s, robot.max_acceleration_mps2, _DT_S,
        int(path.length_m / (0.2 * command_mps * _DT_S)),
    )  # fmt: skip
    if wheel[-1] > 0.0 or s[-1] > grid[-1]:
        raise UsageError(
            f"simulated drive: the robot does not stop on a leg of {path.length_m:.1f} m ({steps} steps); make it "
            "longer"
        )
    uv, direction = path.at(s)
    sign = -1.0 if backwards else 1.0
    yaw = np.unwrap(direction) + (np.pi if backwards else 0.0)
    braking = s >= brake_at_m
    commanded = np.where(braking, 0.0, sign * command_mps)
    commanded_rate = np.where(braking, 0.0, np.gradient(yaw, _DT_S)) if s.size > 1 else np.zeros(1)
    return _DrivePart(uv, yaw, sign * wheel, np.interp(s, grid, slip), commanded, commanded_rate)


def _make_truth(
    world: World, driven: _DrivePart, robot: SimulatedRobot, start_ns: int, rng: np.random.Generator
) -> Truth:
    """Return the truth of driven sections: poses, velocities, power and slip."""
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
        energy_joule=accumulate(energy_step),
        distance_m=accumulate(np.hypot(*step.T)),
    )  # fmt: skip


def _compute_tangent_pose(yaw_rad: Floats, rise_east: Floats, rise_north: Floats) -> Floats:
    """Return enu_from_base_link: x looks along the yaw on the surface, z along its normal."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    forward = np.stack([c, s, rise_east * c + rise_north * s], axis=-1)
    up = np.stack([-rise_east, -rise_north, np.ones_like(c)], axis=-1)
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    return quat_from_matrix(np.stack([forward, np.cross(up, forward), up], axis=-1))


def _compute_angular_velocity(quat_xyzw: Floats) -> Floats:
    """Return the body rates [rad/s] by central differences on the rotation group."""
    before = np.concatenate([quat_xyzw[:1], quat_xyzw[:-1]])
    after = np.concatenate([quat_xyzw[1:], quat_xyzw[-1:]])
    span_s = np.full(quat_xyzw.shape[0], 2.0 * _DT_S)
    span_s[[0, -1]] = _DT_S
    return np.asarray(rotation_vector_from_quat(multiply(invert(before), after)) / span_s[:, None])


def _compute_power(
    robot: SimulatedRobot, driven: _DrivePart, slope: Floats, rolling: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
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
