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
    UNPAVED,
    Band,
    Ellipse,
    Hill,
    Site,
    SurfaceEffect,
    Wave,
    World,
    draw_waves,
    state,
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


def test_one_hill_by_hand():
    world = World(SITE, 600.0, hills=(Hill(50.0, 30.0, 5.0, 8.0, 10.0),))
    height = world.height_m(np.array(SITE.west_m + 58.0), np.array(SITE.south_m + 20.0))
    assert height == pytest.approx(600.0 + 5.0 * np.exp(-1.0), abs=1e-9)


def test_rows_and_columns_give_the_same_as_points():
    world = make_paper_site().world
    x, y = world.site.west_m + np.arange(0.5, 120.0, 7.0), world.site.south_m + np.arange(0.5, 80.0, 7.0)
    flat_x, flat_y = (values.ravel() for values in np.meshgrid(x, y))
    for function in (world.height_m, world.mapped_height_m, world.terrain_class, world.mapped, world.resistance_factor):
        grid = function(x[None, :], y[:, None])
        np.testing.assert_allclose(grid.ravel(), function(flat_x, flat_y), atol=1e-9)
    np.testing.assert_allclose(
        world.ortho(x[None, :], y[:, None]).reshape(-1, 3), world.ortho(flat_x, flat_y), atol=1e-9
    )


def test_classes_by_hand_and_later_regions_win():
    road = Band(PAVED, 0.0, 40.0, 0.0, 4.0)
    mud = Ellipse(MUD, 60.0, 40.0, 6.0, 3.0, np.pi / 2)
    world = World(SITE, 600.0, regions=(road, mud))
    u = np.array([10.0, 10.0, 10.0, 60.0, 60.0, 64.0])
    v = np.array([41.9, 42.1, 38.1, 45.9, 46.1, 40.0])
    classes = world.terrain_class(SITE.west_m + u, SITE.south_m + v)
    assert classes.tolist() == [PAVED, GRASS, PAVED, MUD, GRASS, PAVED]


def test_the_sun_shades_by_the_angle_that_it_falls_in():
    """Against the normal by differences of the height; level ground keeps its colour."""
    sun = np.array([0.48, -0.36, 0.8])
    lit, (x, y) = replace(make_small_world(), sun=tuple(sun.tolist())), places(200, seed=4)
    east = (lit.height_m(x + 0.01, y) - lit.height_m(x - 0.01, y)) / 0.02
    north = (lit.height_m(x, y + 0.01) - lit.height_m(x, y - 0.01)) / 0.02
    normal = np.column_stack([-east, -north, np.ones(200)]) / np.sqrt(1 + east**2 + north**2)[:, None]
    ratio = lit.ortho(x, y) / make_small_world().ortho(x, y)
    np.testing.assert_allclose(ratio, np.repeat((normal @ sun / sun[2])[:, None], 3, axis=1), atol=1e-6)
    assert ratio.min() < 0.9
    assert ratio.max() > 1.1


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


def test_local_plane_is_metric_and_returns():
    lon, lat = SITE.lonlat_deg(np.array([SITE.west_m, SITE.west_m + 100.0]), np.array([SITE.south_m, SITE.south_m]))
    enu = SITE.enu_m(lon, lat, np.full(2, SITE.datum[2]))
    scale, rotation = SITE.ground_from_map(
        np.array([SITE.west_m + 50.0]), np.array([SITE.south_m]), np.full(1, SITE.datum[2])
    )
    along = enu[1] - enu[0]
    assert np.hypot(along[0], along[1]) == pytest.approx(100.0 * scale[0], abs=1e-4)
    assert np.arctan2(along[1], along[0]) == pytest.approx(rotation[0], abs=2e-5)
    back = SITE.lonlatalt(enu)
    np.testing.assert_allclose(back[0], lon, atol=1e-12)
    np.testing.assert_allclose(back[2], SITE.datum[2], atol=1e-7)


def test_a_state_is_spread_evenly_between_its_ends():
    made = draw_waves(6, count=40, total=1.0, wavelength_m=(1.0, 5.0))
    rng = np.random.default_rng(0)
    values = state(made, rng.uniform(0, 2000, 20000), rng.uniform(0, 2000, 20000))
    quantiles = np.quantile(values, [0.1, 0.25, 0.5, 0.75, 0.9])
    assert quantiles == pytest.approx([-0.8, -0.5, 0.0, 0.5, 0.8], abs=0.06)


RNG = np.random.default_rng(3)
U, V = RNG.uniform(0, 500, 20000), RNG.uniform(0, 300, 20000)


def on(class_id):
    return np.full(U.size, class_id, np.uint8)


def test_wet_ground_is_darker_and_resists_where_its_class_says_so():
    surface = make_paper_surface()
    wet = state(surface.wetness, U, V)
    assert np.corrcoef(wet, surface.shade(on(MUD), U, V))[0, 1] < -0.8
    assert np.corrcoef(wet, surface.resistance(on(MUD), U, V))[0, 1] > 0.99
    assert abs(np.corrcoef(wet, surface.resistance(on(PAVED), U, V))[0, 1]) < 0.05  # dark, and costs nothing


def test_resistance_keeps_within_its_sources_range():
    """Carvill's gravel, 0.01 to 0.04, and wetness: never beyond their sum."""
    found = make_paper_surface().resistance(on(UNPAVED), U, V)
    assert np.abs(found).max() <= 0.7
    assert found.std() == pytest.approx(np.hypot(0.6, 0.1) / np.sqrt(3.0), rel=0.1)


def test_relief_is_as_rough_as_its_class():
    surface = make_paper_surface()
    swings = np.sqrt(1.0 + surface.swing**2 / 3.0)
    wanted = np.hypot(surface.looks[GRASS].bump_m, surface.looks[GRASS].ridge_m) * swings
    assert surface.relief_m(on(GRASS), U, V).std() == pytest.approx(wanted, rel=0.1)
    assert surface.map_noise_m(U, V).std() == pytest.approx(surface.map_noise_std_m, rel=0.1)


def test_the_pose_does_not_feel_what_the_raster_shows():
    world = make_paper_site().world
    x, y = world.site.west_m + U, world.site.south_m + V
    more = world.mapped_height_m(x, y) - world.height_m(x, y)
    assert 0.004 < more.std() < 0.03


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
