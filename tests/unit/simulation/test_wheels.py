"""What wheels meet, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.simulation.paper_site import make_paper_site, make_paper_surface
from tcpipe.simulation.robot import compute_rolling_resistance
from tcpipe.simulation.world import GRASS, PAVED, Band, Site, SurfaceEffect, Wave, World

SITE = Site()
ROBOT = make_paper_site().robot
X, Y = SITE.west_m + np.linspace(20.0, 60.0, 4001), np.full(4001, SITE.south_m + 40.0)


def test_even_ground_costs_its_class():
    assert compute_rolling_resistance(World(SITE, 600.0), ROBOT, X, Y, np.zeros(1)) == pytest.approx(
        ROBOT.ground[GRASS].rolling_resistance
    )


def test_a_wheel_on_the_road_and_one_beside_it():
    """The road's border runs under the robot's middle: two contacts of four on each."""
    world = World(SITE, 600.0, regions=(Band(PAVED, 0.0, 42.0, 0.0, 4.0),))
    wanted = (ROBOT.ground[GRASS].rolling_resistance + ROBOT.ground[PAVED].rolling_resistance) / 2.0
    assert compute_rolling_resistance(world, ROBOT, X, Y, np.zeros(1)) == pytest.approx(wanted)


@pytest.mark.parametrize(("yaw_rad", "share"), [(0.0, 1.0), (np.pi / 2, 0.0)])
def test_ridges_cost_those_who_cross_them(yaw_rad, share):
    """z = a sin(k x): over contacts of length c it climbs 4 a sin(k c / 2) / wavelength / (k c / 2) a metre; half of that is uphill."""
    height_m, wavelength_m = 0.02, 0.6
    ridges = (Wave(1.0, wavelength_m, 0.0, 0.0),)
    surface = replace(make_paper_surface(), looks={GRASS: SurfaceEffect(ridge_m=height_m)}, ridges=ridges, swing=0.0)
    half = np.pi * ROBOT.wheels.contact_m / wavelength_m
    climbed = 0.5 * 4.0 * height_m / wavelength_m * np.sin(half) / half
    found = compute_rolling_resistance(World(SITE, 600.0, surface=surface), ROBOT, X, Y, np.array([yaw_rad]))
    more = np.mean(found) - ROBOT.ground[GRASS].rolling_resistance
    assert more == pytest.approx(share * ROBOT.wheels.bump_loss * climbed, rel=0.01, abs=1e-9)


@pytest.mark.parametrize(("yaw_rad", "share"), [(0.0, 1.0), (np.pi / 2, 0.0)])
def test_a_slope_across_drags_by_its_square(yaw_rad, share):
    tilt = (Wave(0.3 * 40000.0 / (2 * np.pi), 40000.0, np.pi / 2, 0.0),)  # rises to the north by 0.3
    found = compute_rolling_resistance(World(SITE, 600.0, waves=tilt), ROBOT, X, Y, np.array([yaw_rad]))
    wanted = np.sin(np.arctan(0.3)) ** 2 / ROBOT.wheels.cornering_per_rad
    assert found - ROBOT.ground[GRASS].rolling_resistance == pytest.approx(share * wanted, rel=1e-3, abs=1e-9)
