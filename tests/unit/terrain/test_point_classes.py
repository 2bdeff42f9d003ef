"""Classes under points are those of the analytic world, across tiles, and nothing off the map."""

import numpy as np
import pytest
from map_worlds import World

from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.map_files import open_map
from tcpipe.terrain.sampling import OFF_THE_MAP, find_classes_at

WORLD = World("EPSG:32633", 533_000.0, 5_213_000.0, side_m=60.0)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    directory = tmp_path_factory.mktemp("map")
    rasters = WORLD.write(directory, pitch_m=0.1)
    build_map(directory / "site.zarr", name="site", height=rasters["height"], terrain=rasters["terrain"])
    return open_map(directory / "site.zarr")


def test_classes_are_those_of_the_pixels_under_the_points(source):
    rng = np.random.default_rng(2)
    grid = source.grid
    centre = rng.integers((0, 0), (grid.cols, grid.rows), (5000, 2))
    px = centre + rng.uniform(-0.499, 0.499, (5000, 2))  # pixel coordinates count centres
    xy = grid.xy_from_px(px)
    found = find_classes_at(source, xy)
    whole = source.read("terrain", 0, grid.rows, 0, grid.cols)
    np.testing.assert_array_equal(found, whole[tuple(centre.T[::-1])])
    assert (
        np.mean(found == WORLD.terrain(*xy.T)) > 0.995
    )  # pixel centres on a border of classes may fall on either side


def test_off_the_map_and_nowhere(source):
    x_min, y_min, x_max, y_max = source.grid.bounds_m
    points = np.array([(x_min - 1, y_min + 5), (x_max + 1, y_max), (np.nan, y_min), (x_min + 5, y_min + 5)])
    found = find_classes_at(source, points)
    np.testing.assert_array_equal(found[:3], OFF_THE_MAP)
    assert found[3] > 0
    assert find_classes_at(source, np.zeros((0, 2))).shape == (0,)
