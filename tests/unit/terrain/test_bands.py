"""Patches of layers with several bands, on a grid of their own: against interpolation point by point."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from map_worlds import random_map

from tcpipe.errors import MapError
from tcpipe.recipe import SampleConfig
from tcpipe.stages.sample import check_same_layers
from tcpipe.terrain.layers import Layer, join_layers, make_banded_layer
from tcpipe.terrain.sampling import make_patch_frames, sample_patches
from tcpipe.terrain.target_grid import MapGrid

RNG = np.random.default_rng(3)


@dataclass(frozen=True)
class ArrayBands:
    """A layer of several bands in memory."""

    layer: Layer
    grid: MapGrid
    values: np.ndarray
    tile_px: int = 16

    def read(self, row0, row1, col0, col1):
        assert min(row0, col0) >= 0
        return self.values[:, row0:row1, col0:col1]


def bands_on(source, pixel_size_m, dtype="float32", count=3):
    """Random bands over a map and a pixel beyond its edges."""
    grid = source.grid
    rows, cols = (int(np.ceil(n * grid.pixel_size_m / pixel_size_m)) + 2 for n in (grid.rows, grid.cols))
    own = MapGrid(grid.crs, grid.x_min_m - pixel_size_m, grid.y_max_m + pixel_size_m, pixel_size_m, rows, cols)
    layer = make_banded_layer("e", "1", [(-9.0, 9.0)] * count, dtype, pixel_size_m)
    return ArrayBands(layer, own, RNG.normal(size=(count, rows, cols)).astype(dtype))


def frames(source, count=40):
    west, south, east, north = source.grid.bounds_m
    middle = RNG.uniform((west + 1.0, south + 1.0), (east - 1.0, north - 1.0), (count, 2))
    angle = RNG.uniform(0, 2 * np.pi, count)
    half = 0.5 * np.column_stack([np.cos(angle), np.sin(angle)])
    return make_patch_frames(middle - half, middle + half, np.ones(count))


def interpolate(bands, x, y):
    col, row = bands.grid.px_from_xy(np.array([x, y]))
    j, i, u, v = int(np.floor(col)), int(np.floor(row)), col % 1, row % 1
    corners = bands.values[:, i : i + 2, j : j + 2].astype(float)
    return (
        corners[:, 0, 0] * (1 - u) * (1 - v)
        + corners[:, 0, 1] * u * (1 - v)
        + corners[:, 1, 0] * (1 - u) * v
        + corners[:, 1, 1] * u * v
    )


@pytest.mark.parametrize(
    ("pixel_size_m", "patch_px", "own_px"), [(0.5, 40, 2), (3.0, 40, 1), (0.07, 40, 20), (0.1, 4, 4), (0.3, 40, 4)]
)
def test_pixels_are_what_points_of_the_layer_are(pixel_size_m, patch_px, own_px):
    source = random_map()
    bands = bands_on(source, pixel_size_m)
    source.banded["e"] = bands
    where = frames(source)
    found = sample_patches(source, where, np.ones(40), patch_m=1.0, patch_px=patch_px)
    assert found.pixels["e"].shape == (40, 3, own_px, own_px)
    assert (found.valid_fraction == 1.0).all()
    parts = int(np.ceil(0.95 / own_px / pixel_size_m))
    side = own_px * parts
    for n in range(0, 40, 7):
        fine = np.empty((3, side, side))
        for r in range(side):
            for c in range(side):
                ahead, left = (c + 0.5) / side - 0.5, 0.5 - (r + 0.5) / side
                fine[:, r, c] = interpolate(
                    bands, *(where.centre_xy_m[n] + ahead * where.along_xy[n] + left * where.left_xy[n])
                )
        wanted = fine.reshape(3, own_px, parts, own_px, parts).mean(axis=(2, 4))
        np.testing.assert_allclose(found.pixels["e"][n], wanted, atol=1e-5)


def test_a_patch_without_data_in_one_band_is_not_valid():
    source = random_map()
    bands = bands_on(source, 0.5, "float16")
    source.banded["e"] = bands
    where = frames(source)
    bands.values[1, :, : bands.grid.cols // 2] = np.nan
    found = sample_patches(source, where, np.ones(40), patch_m=1.0, patch_px=40)
    assert found.pixels["e"].dtype == np.float16
    holes = np.isnan(found.pixels["e"])
    assert not holes[:, [0, 2]].any()
    np.testing.assert_allclose(found.valid_fraction, 1.0 - holes.mean(axis=(1, 2, 3)))
    middle = bands.grid.x_min_m + bands.grid.cols // 2 * 0.5
    assert (holes.any(axis=(1, 2, 3)) == (where.centre_xy_m[:, 0] < middle + 1.0))[
        np.abs(where.centre_xy_m[:, 0] - middle) > 1.3
    ].all()


def test_patches_far_off_the_map_have_no_data():
    source = random_map()
    source.banded["e"] = bands_on(source, 0.5)
    near = frames(source)
    away = replace(near, centre_xy_m=near.centre_xy_m + np.where(np.arange(40) % 2, 0.0, 3e7)[:, None])
    found = sample_patches(source, away, np.ones(40), patch_m=1.0, patch_px=40).pixels["e"]
    assert np.isnan(found[::2]).all()
    np.testing.assert_array_equal(
        found[1::2], sample_patches(source, near, np.ones(40), patch_m=1.0, patch_px=40).pixels["e"][1::2]
    )


def test_maps_together_have_the_range_of_both_in_each_band():
    one = make_banded_layer("e", "1", [(0.0, 1.0), (-3.0, 2.0)], "float16", 1.0)
    two = make_banded_layer("e", "1", [(-1.0, 0.5), (0.0, 4.0)], "float16", 1.0)
    assert join_layers([{"e": one}, {"e": two}])["e"].bands == ((-1.0, 1.0), (-3.0, 4.0))


def test_maps_whose_bands_make_other_patches_are_refused():
    one, same, other, fewer = (random_map() for _ in range(4))
    for source, pixel_size_m, count in ((one, 0.5, 3), (same, 0.4996, 3), (other, 1.0, 3), (fewer, 0.5, 2)):
        source.banded["e"] = bands_on(source, pixel_size_m, count=count)
    check_same_layers([one, same], SampleConfig())
    with pytest.raises(MapError) as error:
        check_same_layers([one, other, fewer, random_map()], SampleConfig())
    assert error.value.problems == (
        "map m: e is continuous [1], 3 bands, 1 px a patch, float32, but continuous [1], 3 bands, 2 px a patch, float32 in map m",
        "map m: e is continuous [1], 2 bands, 2 px a patch, float32, but continuous [1], 3 bands, 2 px a patch, float32 in map m",
        "map m: has height, ortho, terrain, but map m has height, ortho, terrain, e; maps of one dataset have the same layers",
    )
