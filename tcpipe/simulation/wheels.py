"""What four wheels meet: the ground under each of them, its bumps, and the slope across."""

from __future__ import annotations

import numpy as np

from tcpipe.simulation.robot import SimulatedRobot, Wheels
from tcpipe.simulation.site import Float
from tcpipe.simulation.world import World

Heading = tuple[Float, Float]
"""Cosine and sine of the direction from the map's x axis."""


def compute_rolling_resistance(world: World, robot: SimulatedRobot, x: Float, y: Float, yaw_map_rad: Float) -> Float:
    """Return the traction force over the normal force at poses in the map, any shapes that broadcast.

    Without `Wheels` it is the mean along the wheelbase, under the middle; with them the mean of four contacts.
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
    mean = np.mean(found, axis=0)
    return np.asarray(
        mean if robot.wheels is None else mean + _compute_side_drag(world, robot.wheels, x, y, (cos, sin))
    )


def _evaluate_at_contact(world: World, robot: SimulatedRobot, x: Float, y: Float, heading: Heading) -> Float:
    cos, sin = heading
    classes = world.terrain_class(x, y)
    usual = robot.ground_table()[:, 2][classes] * world.resistance_factor(x, y)
    if robot.wheels is None or world.surface is None:
        return np.asarray(usual)
    half = robot.wheels.contact_m / 2.0
    u, v = x - world.site.west_m, y - world.site.south_m
    higher, lower = (world.surface.relief_m(classes, u + at * cos, v + at * sin) for at in (half, -half))
    return np.asarray(usual + 0.5 * robot.wheels.bump_loss * np.abs(higher - lower) / robot.wheels.contact_m)


def _compute_side_drag(world: World, wheels: Wheels, x: Float, y: Float, heading: Heading) -> Float:
    """Return the drag of running sidelong: of a side force sin(slope across) at the slip angle that gives it."""
    rise_x, rise_y = world.gradient(x, y)
    across = rise_y * heading[0] - rise_x * heading[1]
    return np.asarray(across**2 / (1.0 + across**2) / wheels.cornering_per_rad)
