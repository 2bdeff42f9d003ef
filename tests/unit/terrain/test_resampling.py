"""Coarser levels against plain numpy and scipy, and which of them a patch takes."""

import numpy as np
import pytest
from map_worlds import LeveledMap

from tcpipe.terrain.layers import PAPER_LAYERS
from tcpipe.terrain.resampling import choose_factor, iterate_levels, list_factors, make_overview_grid
from tcpipe.terrain.sampling import make_patch_frames, sample_patches
from tcpipe.terrain.target_grid import MapGrid


def grid_of(rows, cols, pixel_size_m=0.05):
    return MapGrid("EPSG:32633", 500_000.0, 5_200_000.0, pixel_size_m, rows, cols)


def blocks(values, factor):
    """Whole blocks of factor x factor pixels, flattened: (R // f, C // f, f²)."""
    rows, cols = values.shape[0] // factor, values.shape[1] // factor
    cut = values[: rows * factor, : cols * factor].reshape(rows, factor, cols, factor)
    return cut.swapaxes(1, 2).reshape(rows, cols, factor * factor)


@pytest.mark.parametrize(
    ("rows", "cols", "pixel_size_m", "wanted"),
    [
        (6100, 11920, 0.05, (1, 2, 4, 8, 16)),
        (1000, 1000, 0.01, (1, 2, 4, 8, 16, 32, 64)),
        (400, 400, 0.25, (1, 2, 4)),
        (7, 900, 0.01, (1, 2)),
        (3, 3, 0.05, (1,)),
        (50, 50, 30.0, (1,)),
    ],
)
def test_levels_end_at_a_metre_or_where_nothing_is_left(rows, cols, pixel_size_m, wanted):
    assert list_factors(grid_of(rows, cols, pixel_size_m)) == wanted


def test_a_levels_pixel_centres_are_the_means_of_its_pixels_centres():
    grid = grid_of(21, 34)
    level = make_overview_grid(grid, 4)
    assert (level.rows, level.cols, level.pixel_size_m) == (5, 8, 0.2)
    j, i = np.meshgrid(np.arange(34.0), np.arange(21.0))
    fine = grid.xy_from_px(np.stack([j, i], -1))
    mean = np.stack([blocks(fine[..., k], 4).mean(-1) for k in (0, 1)], -1)
    j, i = np.meshgrid(np.arange(8.0), np.arange(5.0))
    np.testing.assert_allclose(level.xy_from_px(np.stack([j, i], -1)), mean, atol=1e-9)


def test_heights_and_grey_are_means_and_missing_where_a_part_is_missing():
    rng = np.random.default_rng(0)
    height = rng.normal(0.0, 1.0, (37, 50))
    height[rng.random(height.shape) < 0.01] = np.nan
    for factor, level in iterate_levels(PAPER_LAYERS["height"], height, (1, 2, 4, 8)):
        np.testing.assert_allclose(level, blocks(height, factor).mean(-1), atol=1e-12)
    grey = rng.integers(1, 256, (37, 50)).astype(np.uint8)
    grey[5, 9] = 0
    found = dict(iterate_levels(PAPER_LAYERS["ortho"], grey, (1, 2, 4)))
    assert sorted(found) == [2, 4]
    for factor, level in found.items():
        wanted = blocks(grey.astype(float), factor).mean(-1)
        missing = (blocks(grey, factor) == 0).any(-1)
        assert missing.sum() == 1
        assert (level[missing] == 0).all()
        assert np.abs(level.astype(float) - wanted)[~missing].max() <= 0.5


def test_classes_are_the_commonest_of_all_pixels_not_of_halves():
    rng = np.random.default_rng(1)
    ids = rng.integers(0, 4, (43, 66)).astype(np.uint8)
    for factor, level in iterate_levels(PAPER_LAYERS["terrain"], ids, (1, 2, 4, 8)):
        votes = np.stack([(blocks(ids, factor) == k).sum(-1) for k in range(4)], -1)
        np.testing.assert_array_equal(level, votes.argmax(-1))  # ties go to the lower id
    halves = np.kron(np.array([[1, 2], [3, 3]]), np.array([[1, 1], [1, 1]])).astype(np.uint8)
    halves[0, 0] = halves[0, 2] = halves[1, 1] = 3
    assert dict(iterate_levels(PAPER_LAYERS["terrain"], halves, (1, 2, 4)))[4].tolist() == [[3]]


@pytest.mark.parametrize(
    ("pixel_size_m", "wanted"),
    [(0.005, 1), (0.02, 1), (0.039, 1), (0.0398, 2), (0.04, 2), (0.079, 2), (0.08, 4), (0.16, 8), (5.0, 8)],
)
def test_the_level_nearest_below_the_patchs_pitch_is_taken(pixel_size_m, wanted):
    assert choose_factor((1, 2, 4, 8), 0.02, pixel_size_m) == wanted


def test_a_patch_coarser_than_the_map_shows_means_not_every_nth_pixel():
    """A furrow every 5 cm, 20 cm deep, on a plane of 10 %: pixels of 10 cm cannot show it and must not beat with it."""
    grid = grid_of(800, 800, 0.0125)
    j, i = np.meshgrid(np.arange(800.0), np.arange(800.0))
    x, y = np.moveaxis(grid.xy_from_px(np.stack([j, i], -1)), -1, 0)
    plane = 0.1 * (x - 500_000.0) + 0.05 * (y - 5_200_000.0)
    arrays = {
        "height": (plane + 0.1 * np.sin(2.0 * np.pi * x / 0.05)).astype(np.float32),
        "ortho": np.where(np.sin(2.0 * np.pi * y / 0.05) > 0.0, 40, 200).astype(np.uint8),
        "terrain": np.where(j % 8 < 5, 4, 5).astype(np.uint8),
    }
    rng = np.random.default_rng(2)
    start = np.array([500_005.0, 5_199_995.0]) + rng.uniform(-2.0, 2.0, (60, 2))
    angle = rng.uniform(-np.pi, np.pi, 60)
    end = start + 2.0 * np.stack([np.cos(angle), np.sin(angle)], 1)
    frames, chord_m = make_patch_frames(start, end, np.full(60, 2.0)), np.full(60, 2.0)

    def errors(factors):
        got = sample_patches(LeveledMap(grid, arrays, factors=factors), frames, chord_m, patch_m=2.0, patch_px=20)
        offset = (np.arange(20) + 0.5) / 20
        along, left = np.meshgrid(offset, 0.5 - offset)
        step = (end - start)[:, None, None]
        px = start[:, None, None, 0] + along * step[..., 0] - left * step[..., 1]
        py = start[:, None, None, 1] + along * step[..., 1] + left * step[..., 0]
        wanted = 0.1 * (px - 500_000.0) + 0.05 * (py - 5_200_000.0)
        height = got.height_min_m[:, None, None] + 0.0005 * got.pixels["height"]
        return (
            np.abs(height - wanted).max(),
            np.abs(got.pixels["ortho"] - 120.0).max(),
            (got.pixels["terrain"] == 4).mean(),
            np.abs(got.slope_rad - np.arctan(0.1 * np.cos(angle) + 0.05 * np.sin(angle))).max(),
        )

    height_m, grey, grass, slope_rad = errors((1, 2, 4, 8))
    assert height_m < 0.001
    assert grey < 1.0
    assert grass == 1.0
    assert slope_rad < 1e-4
    height_m, grey, grass, _ = errors((1,))
    assert height_m > 0.05  # what would happen without
    assert grey > 50.0
    assert 0.5 < grass < 0.75
