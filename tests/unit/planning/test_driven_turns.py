"""Paths that a simulated robot drove: what they took, against what a path of those waypoints is said to cost with and without its turns."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tcpipe.planning.path_cost import cut_path
from tcpipe.planning.turning import turning_of, turns_between
from tcpipe.simulation.drive import drive
from tcpipe.simulation.robot import SimulatedRobot
from tcpipe.simulation.route import Leg
from tcpipe.simulation.site import Site
from tcpipe.simulation.world import World
from tcpipe.tables.facts import PhysicsFit, PhysicsTerm
from tcpipe.terrain.classes import PAPER_CLASSES

FLAT = World(site=Site(), base_m=598.0)
ROBOT = replace(SimulatedRobot(), scrub_half_radius_m=math.inf, resistance_noise=0.0)
START = (10.0, 20.0)


def driven(*waypoints):
    """Energy [J] and way [m] of a leg through waypoints, without what its start and end take, and the course that it begins on."""
    yaw = math.atan2(waypoints[0][1] - START[1], waypoints[0][0] - START[0])
    leg, rng = Leg(waypoints, radius_m=1.3), np.random.default_rng(0)
    truth = drive(FLAT, [leg], start_m=START, start_yaw_rad=yaw, robot=ROBOT, weave_m=0.0, rng=rng)
    return float(truth.energy_joule[-1]), float(truth.distance_m[-1])


@pytest.mark.parametrize("angle_deg", [30.0, 60.0, 90.0])
def test_a_driven_zigzag_took_what_its_turns_are_said_to_cost(angle_deg):
    half = math.radians(angle_deg) / 2.0
    steps = [(6.0 * math.cos(half), 6.0 * math.sin(half) * (-1) ** number) for number in range(10)]
    zigzag = [tuple(point) for point in np.array(START) + np.cumsum(steps, axis=0)]
    measured, way_m = driven(*zigzag)
    straight_joule, straight_m = driven((START[0] + 60.0, START[1]))
    a_metre = straight_joule / straight_m
    pieces = cut_path(np.array([START, *zigzag]), chord_m=1.0, scale=1.0)
    fit = PhysicsFit(
        segments=1000,
        terms=(PhysicsTerm("turning", "grass", ROBOT.scrub_torque_nm / ROBOT.drive_efficiency, 5.0, "W s/rad"),),
        rolling_resistance={},
        recovered_downhill=0.4,
        residual_watt=8.0,
        energy_share={},
        held_out=None,
        without_turning=None,
        usual_turn_radpm=0.0,
        gain_of_turning=None,
    )
    turns = turns_between(pieces.start_xy_m, pieces.end_xy_m)
    turning = turning_of(fit, PAPER_CLASSES)
    joule = turning.energy_joule(turns, pieces.arc_m, np.full(len(turns), 4)).sum()
    assert turns.sum() == pytest.approx(9.0 * 2.0 * half, rel=0.02)
    without = a_metre * way_m  # of the way as it was driven: it cuts corners
    assert without + joule == pytest.approx(measured, rel=0.03)
    assert without < measured * (1.0 - 0.07 * angle_deg / 30.0)  # far too little
