"""The sampling kernel against scipy, symmetry, missing data, tiles."""

import numpy as np
import pytest
from map_worlds import ArrayMap, World, random_map
from scipy.ndimage import map_coordinates

from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.map_files import open_map
from tcpipe.terrain.sampling import OFF_THE_MAP, find_classes_at, make_patch_frames, map_px_from_patch, sample_patches
from tcpipe.terrain.target_grid import MapGrid


def frames_at(grid, count, seed=1, margin_m=1.5, chord_m=1.0):
    rng = np.random.default_rng(seed)
    x_min, y_min, x_max, y_max = grid.bounds_m
    middle = rng.uniform((x_min + margin_m, y_min + margin_m), (x_max - margin_m, y_max - margin_m), (count, 2))
    angle = rng.uniform(-np.pi, np.pi, count)
    half = 0.5 * chord_m * np.stack([np.cos(angle), np.sin(angle)], 1)
    return make_patch_frames(middle - half, middle + half, np.full(count, chord_m))


def sample(source, frames, chord_m=1.0, patch_m=1.0, patch_px=40):
    chords = np.full(len(frames.centre_xy_m), chord_m)
    return sample_patches(source, frames, chords, patch_m=patch_m, patch_px=patch_px)


def values(patches, name):
    return patches.pixels[name] if name in patches.pixels else getattr(patches, name)


def positions(frames, grid, patch_m, patch_px):
    px = map_px_from_patch(frames, grid, patch_m=patch_m, patch_px=patch_px)
    c, r = np.meshgrid(np.arange(patch_px), np.arange(patch_px))
    x = px[:, 0, None, None] + px[:, 2, None, None] * c + px[:, 4, None, None] * r
    y = px[:, 1, None, None] + px[:, 3, None, None] * c + px[:, 5, None, None] * r
    return np.stack([y, x])


@pytest.mark.parametrize(("patch_m", "patch_px"), [(1.0, 40), (1.5, 40), (0.8, 31)])
def test_equals_map_coordinates(patch_m, patch_px):
    source = random_map()
    frames = frames_at(source.grid, 200)
    got = sample(source, frames, patch_m=patch_m, patch_px=patch_px)
    at = positions(frames, source.grid, patch_m, patch_px)
    height = map_coordinates(source.arrays["height"].astype(float), at, order=1)
    lowest = height.min(axis=(1, 2))
    np.testing.assert_allclose(got.height_min_m, lowest, atol=2e-5)
    np.testing.assert_allclose(got.pixels["height"] * 0.0005, height - lowest[:, None, None], atol=0.00025 + 5e-5)
    ortho = map_coordinates(source.arrays["ortho"].astype(float), at, order=1)
    np.testing.assert_allclose(got.pixels["ortho"], ortho, atol=0.51)
    nearest = source.arrays["terrain"][tuple(np.floor(at + 0.5).astype(int))]
    assert (got.pixels["terrain"] == nearest).mean() > 0.9999


def test_slopes_are_those_of_the_least_squares_plane():
    source = random_map()
    frames = frames_at(source.grid, 50)
    got = sample(source, frames)
    offset = (np.arange(40) - 19.5) * 0.025
    along, right = np.meshgrid(offset, offset)
    design = np.stack([along.ravel(), -right.ravel(), np.ones(1600)], 1)
    height = map_coordinates(source.arrays["height"].astype(float), positions(frames, source.grid, 1.0, 40), order=1)
    plane = np.linalg.lstsq(design, height.reshape(50, -1).T, rcond=None)[0]
    np.testing.assert_allclose(got.slope_rad, np.arctan(plane[0]), atol=1e-6)
    np.testing.assert_allclose(got.cross_slope_rad, np.arctan(plane[1]), atol=1e-6)


def test_a_height_of_a_mountain_keeps_a_tenth_of_a_millimetre():
    grid = MapGrid("EPSG:32633", 0.0, 10.0, 0.05, 200, 200)
    x, y = np.meshgrid(np.arange(200) * 0.05, np.arange(200) * 0.05)
    plane = (0.3 * x - 0.2 * y).astype(np.float32)
    low = ArrayMap(grid, {"height": plane})
    high = ArrayMap(grid, {"height": plane + np.float32(512.0)}, height_reference_m=2_500.0)
    frames = frames_at(grid, 40)
    a, b = sample(low, frames), sample(high, frames)
    np.testing.assert_allclose(b.height_min_m, a.height_min_m + 3_012.0, atol=1e-4)
    assert np.abs(a.pixels["height"].astype(int) - b.pixels["height"]).max() <= 1
    np.testing.assert_allclose(a.slope_rad, b.slope_rad, atol=1e-4)


@pytest.mark.parametrize("layer", ["height", "ortho", "terrain"])
def test_a_missing_map_pixel_is_missing_in_every_patch_that_touches_it(layer):
    source = random_map()
    source.arrays[layer][150, 130] = np.nan if layer == "height" else 0
    frames = frames_at(source.grid, 300, margin_m=5.0)
    got = sample(source, frames)
    y, x = positions(frames, source.grid, 1.0, 40)
    reach = 0.5 if layer == "terrain" else 1.0
    touched = (np.abs(y - 150) < reach) & (np.abs(x - 130) < reach)
    assert touched.any(axis=(1, 2)).sum() > 5
    np.testing.assert_allclose(got.valid_fraction, 1.0 - touched.mean(axis=(1, 2)), atol=1e-9)
    assert (got.pixels["height"][touched] == 65535).all()
    assert (got.pixels["terrain"][touched] == 0).all()
    assert (got.pixels["height"][~touched] < 65535).all()
    assert np.isfinite(got.height_min_m).all()


def test_a_plane_with_holes_keeps_its_slope():
    grid = MapGrid("EPSG:32633", 0.0, 10.0, 0.05, 200, 200)
    x, y = np.meshgrid((np.arange(200) + 0.5) * 0.05, 10.0 - (np.arange(200) + 0.5) * 0.05)
    height = (0.25 * x + 0.1 * y).astype(np.float32)
    height[np.random.default_rng(0).random(height.shape) < 0.02] = np.nan
    start = np.array([(4.0, 5.0)])
    got = sample(ArrayMap(grid, {"height": height}), make_patch_frames(start, start + np.array([1.0, 0.0]), np.ones(1)))
    assert 0.5 < got.valid_fraction[0] < 1.0
    np.testing.assert_allclose(np.tan([got.slope_rad[0], got.cross_slope_rad[0]]), [0.25, 0.1], atol=1e-4)


def test_patches_beyond_the_map_have_no_data_there():
    source = random_map()
    start = np.array([(500_000.0 - 0.5, 5_199_995.0), (500_000.0 - 2.0, 5_199_995.0)])
    got = sample(source, make_patch_frames(start, start + np.array([1.0, 0.0]), np.ones(2)))
    assert 0.45 < got.valid_fraction[0] < 0.5
    assert got.valid_fraction[1] == 0.0
    assert (got.pixels["height"][1] == 65535).all()


@pytest.mark.parametrize("tile_px", [16, 64, 512])
def test_patches_in_the_maps_corners_are_those_of_a_larger_map(tile_px):
    """The last pixel of the last tile is the end of the memory that may be read."""
    large = random_map(rows=200, cols=200)
    small = ArrayMap(
        MapGrid("EPSG:32633", 500_000.0, 5_200_000.0, 0.05, 71, 83),
        {name: np.ascontiguousarray(layer[:71, :83]) for name, layer in large.arrays.items()},
        tile_px,
    )
    frames = frames_at(small.grid, 400, margin_m=0.52)
    got, wanted = sample(small, frames), sample(large, frames)
    whole = got.valid_fraction == 1.0
    assert 20 < whole.sum() < 380
    for name in ("height", "ortho", "terrain", "height_min_m", "slope_rad", "terrain_class", "terrain_purity"):
        np.testing.assert_array_equal(values(got, name)[whole], values(wanted, name)[whole])
    inside = got.pixels["height"] < 65535
    assert not inside[~whole].all()
    assert (got.pixels["ortho"][inside] == wanted.pixels["ortho"][inside]).all()


@pytest.mark.parametrize(("rows", "cols", "most"), [(512, 512, 1.0), (3200, 320, 1.0), (320, 2560, 1.1)])
def test_each_tile_is_read_once_though_samples_come_in_any_order(rows, cols, most):
    """64 tiles fit the pool; 250 do not, and each is read once all the same; 40 in a row are two strips, whose borders are read twice."""

    class Counting(ArrayMap):
        def read(self, layer, row0, row1, col0, col1):
            seen.append((layer, row0, col0))
            return super().read(layer, row0, row1, col0, col1)

    seen = []
    plain = random_map(rows=rows, cols=cols)
    source = Counting(plain.grid, plain.arrays, tile_px=64)
    frames = frames_at(plain.grid, 12_000, margin_m=0.8)
    got = sample(source, frames)
    assert len(set(seen)) == 3 * (rows // 64) * (cols // 64)
    assert len(seen) <= most * len(set(seen))
    np.testing.assert_array_equal(got.pixels["height"], sample(plain, frames).pixels["height"])


WORLD = World("EPSG:32633", 533_000.0, 5_213_000.0, side_m=60.0)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    directory = tmp_path_factory.mktemp("map")
    rasters = WORLD.write(directory, pixel_size_m=0.1)
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
