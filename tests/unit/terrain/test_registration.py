"""Shifts of a map against the driven heights: simulated shifts are found, and none on flat ground."""

import numpy as np
import pytest
from map_worlds import ArrayMap, LeveledMap

from tcpipe.terrain.registration import register_track
from tcpipe.terrain.target_grid import MapGrid

SIDE, PITCH_M = 500, 0.2


def rolling(x, y):
    return 0.03 * x + 0.4 * np.sin(x / 4.0) * np.cos(y / 5.0) + 0.15 * np.sin(x / 1.7 + y / 2.3)


def site(ground=rolling, noise_m=0.01, factors=(1,), seed=0):
    grid = MapGrid("EPSG:32633", 0.0, 100.0, PITCH_M, SIDE, SIDE)
    j, i = np.meshgrid(np.arange(SIDE, dtype=float), np.arange(SIDE, dtype=float))
    x, y = np.moveaxis(grid.xy_from_px(np.stack([j, i], -1)), -1, 0)
    height = ground(x, y) + np.random.default_rng(seed).normal(0.0, noise_m, x.shape)
    return LeveledMap(
        grid, {"height": height.astype(np.float32)}, tile_px=256, height_reference_m=600.0, factors=factors
    )


def drive(count=6000, seed=1):
    """A winding drive of 240 m at 20 Hz."""
    s = np.linspace(0.0, 1.0, count)
    return np.stack([50.0 + 38.0 * np.sin(2 * np.pi * s), 50.0 + 36.0 * np.sin(4 * np.pi * s + 0.3)], 1)


def drift(count, std_m, over, seed):
    """Noise that is alike over ``over`` samples, as a GNSS height's is."""
    rng = np.random.default_rng(seed)
    smooth = np.convolve(rng.normal(0.0, 1.0, count + over), np.ones(over) / np.sqrt(over), "valid")[:count]
    return std_m * smooth


@pytest.mark.parametrize("shift_m", [(0.0, 0.0), (1.37, -0.81), (-2.4, 2.2), (0.0, 0.6)])
def test_a_shift_is_found_to_a_few_centimetres_whatever_the_datum(shift_m):
    source, xy = site(factors=(1, 2)), drive()
    height = 600.0 + rolling(*(xy + shift_m).T) + 46.2 + drift(len(xy), 0.02, 100, 5)
    found = register_track(source, xy, height)
    assert np.hypot(*np.subtract(found.shift_xy_m, shift_m)) < 0.05
    assert found.shift_std_m < 0.1
    assert found.height_offset_m == pytest.approx(46.2, abs=0.02)
    assert found.significant == (found.shift_m > 0.1)
    assert found.shifted_misfit_m < 0.05
    assert not found.at_reach


def test_a_shift_beyond_the_window_is_said_to_be_at_its_edge():
    source, xy = site(ground=lambda x, y: 5.0 * np.sin(x / 15.0) * np.cos(y / 13.0)), drive()
    height = 600.0 + 5.0 * np.sin((xy[:, 0] + 5.0) / 15.0) * np.cos(xy[:, 1] / 13.0)
    found = register_track(source, xy, height)
    assert found.at_reach
    assert found.significant
    assert found.shift_xy_m[0] > 2.5


def test_even_ground_tells_nothing():
    seed = 0
    for ground in (lambda x, y: 0.0 * x * y, lambda x, y: 0.12 * x - 0.05 * y):
        source, xy = site(ground, noise_m=0.02, seed=seed), drive()
        height = 600.0 + ground(*xy.T) + drift(len(xy), 0.05, 300, seed)
        found = register_track(source, xy, height)
        assert not found.significant
        short = register_track(source, xy[:1000], height[:1000])
        assert short is None or not short.significant


def test_holes_edges_and_short_or_missing_tracks():
    source, xy = site(), drive()
    height = 600.0 + rolling(*np.add(xy, (1.0, -1.0)).T)
    whole = register_track(source, xy, height)
    source.arrays["height"][:150] = np.nan
    height[::7] = np.nan
    found = register_track(source, xy, height)
    assert found.shift_xy_m == pytest.approx((1.0, -1.0), abs=0.05)
    assert found.points < 0.95 * whole.points
    assert register_track(source, xy[:300], height[:300]) is None
    assert register_track(source, xy + 500.0, height) is None
    assert register_track(source, xy[:0], height[:0]) is None
    assert register_track(source, np.full_like(xy, np.nan), height) is None


@pytest.mark.parametrize(("per_metre", "unit"), [(10.0, "dm"), (1000.0, "mm"), (0.3048, "m"), (2.5, "")])
def test_any_unit_of_heights_is_found_and_a_metre_is_none(per_metre, unit):
    """GNSS heights that drift leave the scale of metres uncertain, but not that of another unit."""
    xy = drive()
    height = 600.0 + rolling(*np.add(xy, (0.6, -0.4)).T) + drift(len(xy), 0.08, 100, 2)
    other = register_track(site(lambda x, y: per_metre * rolling(x, y), noise_m=0.01 * per_metre), xy, height).scale
    assert (other.is_wrong(), other.find_unit()) == (True, unit)
    assert not register_track(site(), xy, height).scale.is_wrong()


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_feet_are_told_on_a_tilted_map_and_a_tilt_is_no_scale(slope):
    """The tilt of the map stays in the misfit, so that other heights are still named."""

    def ground(x, y):
        return rolling(x, y) + slope * y

    xy = drive()
    height = 600.0 + ground(*xy.T) + drift(len(xy), 0.02, 100, 3)
    feet = register_track(site(tilted(lambda x, y: ground(x, y) / 0.3048, 0.02, 2)), xy, height).scale
    assert (feet.is_wrong(), feet.find_unit()) == (True, "ft")
    found = register_track(site(tilted(ground, 0.02, 2)), xy, height)
    assert not found.scale.is_off()
    assert found.shape_misfit_m < 0.05
    assert found.shifted_misfit_m > 0.3


def test_trees_and_even_ground_say_nothing_of_the_unit():
    """A surface model with a metre of canopy on rolling ground explains little, even ground nothing."""
    xy = drive()
    height = 600.0 + rolling(*xy.T) + drift(len(xy), 0.03, 100, 2)
    trees = register_track(site(noise_m=1.0), xy, height).scale
    assert trees.value < 0.8
    assert not trees.is_known
    assert not trees.is_wrong()
    even = register_track(site(ground=lambda x, y: 0.0 * (x + y)), xy, height).scale
    assert not even.is_known
    assert not even.is_wrong()


def random_ground(seed, scale_m=3.0, height_m=0.2):
    """Return a function of x and y: a sum of waves in all directions, some three and some fifteen metres long over two pi."""
    rng = np.random.default_rng(seed)
    k = rng.normal(0.0, 1.0, (40, 2)) / np.repeat([scale_m, 5.0 * scale_m], 20)[:, None]
    amplitude, phase = np.repeat([height_m, 6.0 * height_m], 20) / np.sqrt(10.0), rng.uniform(0.0, 2.0 * np.pi, 40)
    return lambda x, y: sum(a * np.sin(u * x + v * y + p) for (u, v), a, p in zip(k, amplitude, phase, strict=True))


def tilted(ground, tilt, seed):
    east, north = tilt * np.array([np.cos(seed), np.sin(seed)])
    return lambda x, y: ground(x, y) + east * (x - 50.0) + north * (y - 50.0)


def register_tilted(seed, *, shift_m, tilt=0.0, noise_m=0.03, **ground):
    """Return the registration of a drive whose height drifts, on a noisy map of 0.5 m, and the shift that was put in."""
    grid, truth = MapGrid("EPSG:32633", 0.0, 100.0, 0.5, 200, 200), random_ground(seed, **ground)
    x, y = np.moveaxis(grid.xy_from_px(np.stack(np.meshgrid(np.arange(200.0), np.arange(200.0)), -1)), -1, 0)
    height = tilted(truth, tilt, seed)(x, y) + np.random.default_rng(seed).normal(0.0, noise_m, x.shape)
    source = ArrayMap(grid, {"height": height.astype(np.float32)}, tile_px=256, height_reference_m=600.0)
    xy, shift = drive(), shift_m * np.array([np.cos(7.0 * seed), np.sin(7.0 * seed)])
    height = 646.2 + truth(*(xy + shift).T) + drift(len(xy), 0.02, 400, seed)
    return register_track(source, xy, height), shift


@pytest.mark.parametrize(("shift_m", "tilt"), [(0.0, 0.02), (3.0, 0.02)])
def test_a_shift_is_inside_two_sigma_on_tilted_and_noisy_maps(shift_m, tilt):
    """Eight worlds for each shift: errors of both axes over their deviations, and no error that is large in metres."""
    found, truth = zip(*(register_tilted(seed, shift_m=shift_m, tilt=tilt) for seed in range(8)), strict=True)
    assert not any(of.at_reach for of in found)
    error_m = np.array([of.shift_xy_m for of in found]) - truth
    scaled = error_m / np.array([np.sqrt(np.diag(of.covariance)) for of in found])
    assert (np.abs(scaled) < 2.0).mean() >= 0.9
    assert 0.4 < np.sqrt(np.mean(scaled**2)) < 1.4
    assert np.linalg.norm(error_m, axis=1).max() < 0.2
    assert np.median([of.position_std_m for of in found]) < 0.1
    assert [of.height_offset_m for of in found] == pytest.approx([46.2] * 8, abs=0.2)


def test_a_tilt_alone_is_no_shift():
    """On a hill without other relief a tilt is a shift, and on even ground everything is."""
    seed = 1
    for ground in (lambda x, y: 0.002 * (x**2 + y**2), lambda x, y: 0.0 * x * y, lambda x, y: 0.1 * x - 0.03 * y):
        source, xy = site(tilted(ground, 0.015, seed), noise_m=0.02, seed=seed), drive()
        found = register_track(source, xy, 600.0 + ground(*xy.T) + drift(len(xy), 0.02, 400, seed))
        assert np.isnan(found.position_std_m) or found.shift_m < 2.0 * found.position_std_m
        assert not found.position_std_m < 0.1


def test_heights_of_other_ground_do_not_move_a_tilted_map():
    """A bridge, a tree, and a map in which heights are a tenth larger."""
    source, xy = site(tilted(lambda x, y: 1.1 * rolling(x, y), 0.02, 1)), drive()
    height = 600.0 + rolling(*np.add(xy, (1.2, 0.5)).T)
    height[1000:1600] += 4.0
    source.arrays["height"][100:140, 50:450] += 6.0
    found = register_track(source, xy, height)
    assert found.shift_xy_m == pytest.approx((1.2, 0.5), abs=max(0.1, 2.0 * found.position_std_m))
    assert found.position_std_m < 0.1


def test_a_map_that_repeats_itself_determines_no_shift():
    """Ridges 2.5 m apart fit a shift of 0.5 m as well as one of -2 m."""

    def ridges(x, y):
        return 0.2 * np.sin(2.0 * np.pi * x / 2.5) + 0.2 * np.sin(2.0 * np.pi * y / 2.5)

    source, xy = site(ridges), drive()
    found = register_track(source, xy, 600.0 + ridges(*np.add(xy, (0.5, 0.0)).T))
    assert np.isnan(found.position_std_m)
