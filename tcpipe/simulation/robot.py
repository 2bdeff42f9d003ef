"""Abilities and costs of the simulated robot: speed limits, slip, rolling resistance, grade, battery, wheel bumps.

The plant is simple, but contains every effect that a label should contain: the terrain slows a robot that is commanded
at full speed, rolling depends on the class (and on hidden properties), turning scrubs, the battery sags.
"""

from dataclasses import astuple, dataclass, field

import numpy as np

from tcpipe.arrays import Floats, accumulate
from tcpipe.compiled import compile_kernel
from tcpipe.simulation.world import GRASS, MUD, PAVED, UNPAVED, World
from tcpipe.tables.findings import omit

GRAVITY_MPS2 = 9.80665
_STEEPEST_SIN = float(np.sin(np.radians(22.5)))


@dataclass(frozen=True, slots=True)
class GroundModel:
    """How one terrain class treats the robot on the flat."""

    speed: float  # wheel speed reached under full command, as a fraction of it
    slip: float  # 1 - ground speed / wheel speed
    rolling_resistance: float  # traction force over normal force


_GROUND = {
    GRASS: GroundModel(speed=0.90, slip=0.03, rolling_resistance=0.170),
    MUD: GroundModel(speed=0.84, slip=0.07, rolling_resistance=0.220),
    UNPAVED: GroundModel(speed=0.94, slip=0.02, rolling_resistance=0.135),
    PAVED: GroundModel(speed=0.97, slip=0.01, rolling_resistance=0.115),
}


@dataclass(frozen=True, slots=True)
class Wheels:
    """Four wheels without suspension, and their losses on uneven and side-sloping ground."""

    track_m: float  # from left to right
    contact_m: float  # length of a wheel's contact, over which bumps are averaged
    bump_loss: float  # share of the height climbed at bumps that is not given back
    cornering_per_rad: float
    """Side force per slip angle, over the normal force: on a side slope the wheels slip until the force balances it."""
    slowdown: float  # speed lost by a rolling resistance beyond the class's, as a fraction of speed over one of weight


@dataclass(frozen=True, slots=True)
class SimulatedRobot:
    """A Husky with some payload."""

    mass_kg: float = 70.0
    max_velocity_mps: float = 1.0
    speed_time_constant_s: float = 0.25
    max_acceleration_mps2: float = 1.0
    max_yaw_rate_radps: float = 0.7
    uphill_slowdown: float = 0.25  # wheel speed lost on 22.5° uphill, as a fraction
    slope_slip: float = 0.05  # slip added on 22.5° uphill, taken away downhill
    wheelbase_m: float = 0.5  # ground properties are averaged over it
    scrub_torque_nm: float = 190.0  # turning in place
    scrub_half_radius_m: float = 0.4
    """Radius of the turn at which the torque is half of that; infinite: the torque is the same on every curve."""
    drive_efficiency: float = 0.72
    regeneration_efficiency: float = 0.55
    drivetrain_loss_newton: float = 0.0
    """Friction of motors and gears, as a force on the ground: paid at any grade, never given back."""
    idle_watt: float = 14.0  # both motor drivers at rest; part of the propulsion current
    electronics_watt: float = 38.0
    """Computer and user ports: never part of the propulsion current, but the battery sags with it."""
    open_circuit_volt: float = 26.4
    discharge_volt_per_megajoule: float = 0.9
    internal_resistance_ohm: float = 0.045
    resistance_noise: float = 0.10  # fluctuation of the rolling resistance in time, relative, standard deviation
    resistance_noise_s: float = 0.15  # its correlation time
    ground: dict[int, GroundModel] = field(default_factory=lambda: dict(_GROUND))
    """Ground by class id; other classes are grass."""
    wheels: Wheels | None = omit()
    """None: the ground under the robot's middle counts, and bumps and side slopes cost nothing."""

    def ground_table(self) -> Floats:
        """Return speed, slip and rolling resistance by class id, shape (256, 3)."""
        table = np.tile(astuple(self.ground[GRASS]), (256, 1))
        table[list(self.ground)] = [astuple(ground) for ground in self.ground.values()]
        return table

    def speed_factor(self, flat_speed: Floats, sin_slope: Floats) -> Floats:
        """Return wheel speed over commanded speed, from the class's flat value and the slope's sine along travel."""
        return flat_speed * (1.0 - self.uphill_slowdown * np.maximum(sin_slope, 0.0) / _STEEPEST_SIN)

    def slip(self, flat_slip: Floats, sin_slope: Floats) -> Floats:
        """Return 1 - ground speed / wheel speed; gravity pulls the robot back uphill and on downhill."""
        return flat_slip + self.slope_slip * sin_slope / _STEEPEST_SIN

    def wheel_power_watt(
        self, *, wheel_velocity_mps: Floats, acceleration_mps2: Floats, yaw_rate_radps: Floats, slope_rad: Floats,
        rolling_resistance: Floats,
    ) -> Floats:  # fmt: skip
        """Return mechanical power at the wheels [W]; negative where the slope drives them."""
        direction = np.sign(wheel_velocity_mps)
        weight = self.mass_kg * GRAVITY_MPS2
        force = weight * (rolling_resistance * direction * np.cos(slope_rad) + np.sin(slope_rad))
        force = force + self.mass_kg * acceleration_mps2
        radius_m = np.abs(wheel_velocity_mps) / np.maximum(np.abs(yaw_rate_radps), 1e-6)
        scrub = self.scrub_torque_nm * np.abs(yaw_rate_radps) / (1.0 + radius_m / self.scrub_half_radius_m)
        return force * wheel_velocity_mps + scrub

    def propulsion_watt(self, wheel_power_watt: Floats, wheel_velocity_mps: Floats) -> Floats:
        """Return the electrical power of both motor drivers [W], negative when they give back."""
        friction = self.drivetrain_loss_newton * np.abs(wheel_velocity_mps) / self.drive_efficiency
        gain = np.where(wheel_power_watt > 0.0, 1.0 / self.drive_efficiency, self.regeneration_efficiency)
        return self.idle_watt + friction + wheel_power_watt * gain

    def battery(self, propulsion_watt: Floats, *, dt_s: float) -> tuple[Floats, Floats]:
        """Return terminal voltage [V] and propulsion current [A] whose product is ``propulsion_watt``.

        Solves U² - U0·U + R·P = 0 for the total power P; U0 falls with the energy drawn so far.
        """
        total = propulsion_watt + self.electronics_watt
        drawn_joule = accumulate(total[:-1]) * dt_s
        open_circuit = self.open_circuit_volt - self.discharge_volt_per_megajoule * 1e-6 * drawn_joule
        voltage = 0.5 * (open_circuit + np.sqrt(open_circuit**2 - 4.0 * self.internal_resistance_ohm * total))
        return voltage, propulsion_watt / voltage


@compile_kernel
def drive_along(  # noqa: PLR0917 - numba takes positional arguments
    grid_m: float, speed_factor: Floats, slip: Floats, map_per_surface: Floats, command_mps: float, brake_at_m: float,
    time_constant_s: float, max_acceleration_mps2: float, dt_s: float, max_steps: int,
) -> tuple[Floats, Floats, int]:  # fmt: skip
    """Drive a path from rest to rest; return path position [m] and wheel speed [m/s] by step, and the step count.

    The arrays describe the ground along the path every ``grid_m`` map metres. Wheel speed follows command times
    ``speed_factor`` with a first-order lag and a limited acceleration; past ``brake_at_m`` the command is zero. Ends
    when the wheels stop, or past the path if it was too short to stop (the caller checks).
    """
    position, wheel = np.empty(max_steps), np.empty(max_steps)
    s, w, last = 0.0, 0.0, speed_factor.size - 1
    for step in range(max_steps):
        position[step], wheel[step] = s, w
        at = min(s / grid_m, last - 1e-9)
        i = int(at)
        part = at - i
        factor = speed_factor[i] + part * (speed_factor[i + 1] - speed_factor[i])
        braking = s >= brake_at_m
        if braking and w < 1e-3:
            wheel[step] = 0.0
            return position[: step + 1], wheel[: step + 1], step + 1
        target = 0.0 if braking else command_mps * factor
        change = (target - w) / time_constant_s
        w_next = w + dt_s * min(max(change, -max_acceleration_mps2), max_acceleration_mps2)
        loss = slip[i] + part * (slip[i + 1] - slip[i])
        scale = map_per_surface[i] + part * (map_per_surface[i + 1] - map_per_surface[i])
        s += 0.5 * (w + w_next) * (1.0 - loss) * scale * dt_s
        w = w_next
    return position, wheel, max_steps


@compile_kernel
def make_correlated_noise(white: Floats, correlation: float) -> Floats:
    """Return a first-order Gauss-Markov series of unit variance; ``correlation``: of neighbours; ``white``: noise."""
    out, gain = white.copy(), np.sqrt(1.0 - correlation * correlation)
    for i in range(1, white.size):
        out[i] = correlation * out[i - 1] + gain * white[i]
    return out


Heading = tuple[Floats, Floats]
"""Cosine and sine of the direction from the map's x axis."""


def compute_rolling_resistance(
    world: World, robot: SimulatedRobot, x: Floats, y: Floats, yaw_map_rad: Floats
) -> Floats:
    """Return rolling resistance (traction force over normal force) at poses in the map; arrays broadcast.

    It is the mean at four wheel contacts; without `Wheels`, at five points of the centre line of the wheelbase.
    """
    ahead = robot.wheelbase_m / 2.0
    if robot.wheels is None:
        places = [(at, 0.0) for at in np.linspace(-ahead, ahead, 5)]
    else:
        aside = robot.wheels.track_m / 2.0
        places = [(at, side) for at in (-ahead, ahead) for side in (-aside, aside)]
    cos, sin = np.cos(yaw_map_rad), np.sin(yaw_map_rad)
    found = [
        _evaluate_at_contact(world, robot, x + at * cos - side * sin, y + at * sin + side * cos, (cos, sin))
        for at, side in places
    ]
    drag = _compute_side_drag(world, robot.wheels, x, y, (cos, sin)) if robot.wheels is not None else 0.0
    return np.asarray(np.mean(found, axis=0) + drag)


def _evaluate_at_contact(world: World, robot: SimulatedRobot, x: Floats, y: Floats, heading: Heading) -> Floats:
    cos, sin = heading
    classes = world.terrain_class(x, y)
    usual = robot.ground_table()[:, 2][classes] * world.resistance_factor(x, y)
    if robot.wheels is None or world.surface is None:
        return usual
    half = robot.wheels.contact_m / 2.0
    u, v = world.site.uv_m(x, y)
    higher, lower = (world.surface.relief_m(classes, u + at * cos, v + at * sin) for at in (half, -half))
    return usual + 0.5 * robot.wheels.bump_loss * np.abs(higher - lower) / robot.wheels.contact_m


def _compute_side_drag(world: World, wheels: Wheels, x: Floats, y: Floats, heading: Heading) -> Floats:
    """Return the drag of running sidelong: of a side force sin(slope across) at the slip angle that gives it."""
    rise_x, rise_y = world.gradient(x, y)
    across = rise_y * heading[0] - rise_x * heading[1]
    return across**2 / (1.0 + across**2) / wheels.cornering_per_rad
