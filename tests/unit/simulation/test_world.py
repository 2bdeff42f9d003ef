"""The analytic world against finite differences and hand-computed points."""

from dataclasses import replace

import numpy as np
import pytest
from pyproj import Proj

from tcpipe.simulation.robot import compute_rolling_resistance
from tcpipe.simulation.scenarios import make_paper_site, make_paper_surface, make_small_world
from tcpipe.simulation.world import (
    GRASS,
    MUD,
    PAVED,
    Band,
    Ellipse,
    Site,
    SurfaceEffect,
    Wave,
    World,
)

SITE = Site()


def places(count=400, seed=0):
    rng = np.random.default_rng(seed)
    return (SITE.west_m + rng.uniform(0, SITE.width_m, count), SITE.south_m + rng.uniform(0, SITE.height_m, count))


def test_gradient_is_the_slope_of_the_height():
    world = make_small_world()
    x, y = places()
    step = 1e-4
    gx, gy = world.gradient(x, y)
    np.testing.assert_allclose(gx, (world.height_m(x + step, y) - world.height_m(x - step, y)) / (2 * step), atol=2e-6)
    np.testing.assert_allclose(gy, (world.height_m(x, y + step) - world.height_m(x, y - step)) / (2 * step), atol=2e-6)


def test_classes_by_hand_and_later_regions_win():
    road = Band(PAVED, 0.0, 40.0, 0.0, 4.0)
    mud = Ellipse(MUD, 60.0, 40.0, 6.0, 3.0, np.pi / 2)
    world = World(SITE, 600.0, regions=(road, mud))
    u = np.array([10.0, 10.0, 10.0, 60.0, 60.0, 64.0])
    v = np.array([41.9, 42.1, 38.1, 45.9, 46.1, 40.0])
    classes = world.terrain_class(SITE.west_m + u, SITE.south_m + v)
    assert classes.tolist() == [PAVED, GRASS, PAVED, MUD, GRASS, PAVED]


def test_grid_north_and_scale_are_the_projections():
    x, y = np.array([SITE.west_m + 60.0]), np.array([SITE.south_m + 40.0])
    scale, rotation = SITE.ground_from_map(x, y, np.zeros(1))
    lon, lat = SITE.lonlat_deg(x, y)
    factors = Proj(f"EPSG:{SITE.epsg}").get_factors(lon[0], lat[0])
    assert 1.5 < factors.meridian_convergence < 2.2
    assert np.degrees(rotation[0]) == pytest.approx(-factors.meridian_convergence, abs=1e-4)
    assert scale[0] == pytest.approx(1.0 / factors.meridional_scale, abs=1e-8)
    higher, _ = SITE.ground_from_map(x, y, np.array([6371.0]))
    assert higher[0] / scale[0] == pytest.approx(1.001, abs=5e-6)


ROBOT = make_paper_site().robot
X, Y = SITE.west_m + np.linspace(20.0, 60.0, 4001), np.full(4001, SITE.south_m + 40.0)


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
