"""The analytic world against finite differences and hand-computed points."""

from dataclasses import replace

import numpy as np
import pytest
from pyproj import Proj

from tcpipe.simulation.scenarios import make_small_world
from tcpipe.simulation.world import GRASS, MUD, PAVED, Band, Ellipse, Hill, Site, World

SITE = Site()


def places(count=400, seed=0):
    rng = np.random.default_rng(seed)
    return (
        SITE.west_m + rng.uniform(0, SITE.width_m, count),
        SITE.south_m + rng.uniform(0, SITE.height_m, count),
    )


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
    world = make_small_world()
    x, y = SITE.west_m + np.arange(0.5, 120.0, 7.0), SITE.south_m + np.arange(0.5, 80.0, 7.0)
    flat_x, flat_y = (values.ravel() for values in np.meshgrid(x, y))
    for function in (world.height_m, world.terrain_class, world.mapped, world.resistance_factor):
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
