"""Patches against closed-form worlds, at the patch's own pixel centres, computed here from the segment's ends alone."""

import numpy as np
import pyproj
import pytest
from map_worlds import World, segments_from, write_tif
from rasterio import Affine

from tcpipe.formats.maps.building import build_map
from tcpipe.formats.maps.map_files import open_map
from tcpipe.recipe import SampleConfig
from tcpipe.stages.sample import sample_segments

SITES = {
    "utm north": (World("EPSG:32633", 560_000.0, 5_215_000.0), "EPSG:4326"),
    "utm south, zone edge": (World("EPSG:32755", 238_000.0, 6_100_000.0), "EPSG:4326"),
    "national, own datum": (World("EPSG:31256", -68_000.0, 215_000.0), "EPSG:4312"),
    "national south": (World("EPSG:2193", 1_250_000.0, 4_900_000.0), "EPSG:4167"),
}
CONFIG = SampleConfig()


def pixel_centres(segments, crs, gnss_crs, px=40):
    """Map points of every patch pixel, (N, px, px): start + (c + ½)/px of the chord, and ½ - (r + ½)/px of it to the left."""
    project = pyproj.Transformer.from_crs(gnss_crs, crs, always_xy=True)
    lonlat = {name: segments[f"{name}_deg"].to_numpy() for name in ("start_lon", "start_lat", "end_lon", "end_lat")}
    x0, y0 = project.transform(lonlat["start_lon"], lonlat["start_lat"])
    x1, y1 = project.transform(lonlat["end_lon"], lonlat["end_lat"])
    along = (np.arange(px) + 0.5) / px
    left = 0.5 - (np.arange(px) + 0.5) / px
    dx, dy = (x1 - x0)[:, None, None], (y1 - y0)[:, None, None]
    x = x0[:, None, None] + along[None, None, :] * dx - left[None, :, None] * dy
    y = y0[:, None, None] + along[None, None, :] * dy + left[None, :, None] * dx
    return x, y


@pytest.fixture(scope="module", params=SITES, ids=lambda name: name.replace(" ", "_"))
def site(request, tmp_path_factory):
    world, gnss_crs = SITES[request.param]
    directory = tmp_path_factory.mktemp("site")
    build_map(directory / "m.zarr", name="m", **world.write(directory))
    return world, gnss_crs, open_map(directory / "m.zarr")


def courses(world, gnss_crs, seed=3, count=400):
    rng = np.random.default_rng(seed)
    xy = np.array([world.x_m, world.y_m]) + rng.uniform(-28.0, 28.0, (count, 2))
    return segments_from(world.crs, xy, 45.0 * (np.arange(count) % 8) + 3.0, gnss_crs=gnss_crs)


def test_patches_equal_the_world(site):
    world, gnss_crs, source = site
    segments = courses(world, gnss_crs)
    sampled = sample_segments(segments, source, CONFIG, gnss_crs=gnss_crs)
    assert sampled.kept.tolist() == list(range(400))
    x, y = pixel_centres(segments, world.crs, gnss_crs)
    patches = sampled.patches

    height = patches.height_min_m[:, None, None] + 0.0005 * patches.pixels["height"]
    bound = 0.001 + world.bilinear_bound_m(source.grid.pixel_size_m)
    assert np.abs(height - world.height(x, y)).max() < bound
    assert (patches.pixels["terrain"] == world.terrain(x, y)).mean() > 0.995
    assert np.abs(patches.pixels["ortho"] - world.grey(x, y)).max() < 1.1
    assert patches.valid_fraction.min() == 1.0


def test_slopes_and_class_under_the_chord_equal_the_world(site):
    world, gnss_crs, source = site
    segments = courses(world, gnss_crs, seed=5)
    sampled = sample_segments(segments, source, CONFIG, gnss_crs=gnss_crs)
    x, y = pixel_centres(segments, world.crs, gnss_crs)
    across, along = np.meshgrid(0.4875 - np.arange(40) * 0.025, -0.4875 + np.arange(40) * 0.025, indexing="ij")
    design = np.stack([along.ravel(), across.ravel(), np.ones(1600)], 1)
    plane = np.linalg.lstsq(design, world.height(x, y).reshape(-1, 1600).T, rcond=None)[0]
    np.testing.assert_allclose(sampled.patches.slope_rad, np.arctan(plane[0]), atol=2e-4)
    np.testing.assert_allclose(sampled.patches.cross_slope_rad, np.arctan(plane[1]), atol=2e-4)

    under = world.terrain(x[:, 19:21].mean(axis=1), y[:, 19:21].mean(axis=1))
    share = np.array([[np.mean(row == k) for k in range(8)] for row in under])
    sure = share.max(axis=1) > 0.55
    assert sure.sum() > 350
    np.testing.assert_array_equal(sampled.patches.terrain_class[sure], share.argmax(axis=1)[sure])
    np.testing.assert_allclose(sampled.patches.terrain_purity[sure], share.max(axis=1)[sure], atol=0.08)


def test_footprints_are_true_squares_on_the_ellipsoid(site):
    """Grid north is not true north: the left edge's middle lies half a metre at a true right angle from the chord."""
    world, gnss_crs, source = site
    segments = courses(world, gnss_crs, count=16)
    sampled = sample_segments(segments, source, CONFIG, gnss_crs=gnss_crs)
    geod = pyproj.CRS(gnss_crs).get_geod()
    azimuth = 90.0 - np.degrees(segments["course_rad"].to_numpy())
    lon, lat, _ = geod.fwd(segments["start_lon_deg"], segments["start_lat_deg"], azimuth, np.full(16, 0.5))
    left_lon, left_lat, _ = geod.fwd(lon, lat, azimuth - 90.0, np.full(16, 0.5))
    project = pyproj.Transformer.from_crs(gnss_crs, world.crs, always_xy=True)
    wanted = np.stack(project.transform(left_lon, left_lat), 1)
    got = (sampled.footprint_xy_m[:, 2] + sampled.footprint_xy_m[:, 3]) / 2.0
    np.testing.assert_allclose(got, wanted, atol=2e-4)


def test_layers_of_three_resolutions_and_crss_show_one_world(tmp_path):
    """Height in coarse UTM 34N pixels, grey fine, classes between: the map's double interpolation stays within the coarse bound."""
    world = World("EPSG:32633", 560_000.0, 5_215_000.0)
    to_34 = pyproj.Transformer.from_crs(world.crs, "EPSG:32634", always_xy=True)
    x34, y34 = to_34.transform(world.x_m, world.y_m)
    count = 360
    offset = (np.arange(count) + 0.5) * 0.2 - 36.0
    u, v = np.meshgrid(x34 + offset, y34 - offset)
    x, y = to_34.transform(u, v, direction="INVERSE")
    affine = Affine(0.2, 0.0, x34 - 36.0, 0.0, -0.2, y34 + 36.0)
    height = write_tif(tmp_path / "coarse.tif", world.height(x, y).astype(np.float32)[None], "EPSG:32634", affine)
    (tmp_path / "a").mkdir()
    fine = world.write(tmp_path, 0.05)
    middle = world.write(tmp_path / "a", 0.1)
    build_map(
        tmp_path / "m.zarr", name="m", height=height, ortho=fine["ortho"], terrain=middle["terrain"], crs=world.crs
    )
    source = open_map(tmp_path / "m.zarr")
    assert source.grid.pixel_size_m == 0.05
    segments = courses(world, "EPSG:4326")
    sampled = sample_segments(segments, source, CONFIG, gnss_crs="EPSG:4326")
    assert sampled.kept.size == 400
    x, y = pixel_centres(segments, world.crs, "EPSG:4326")
    got = sampled.patches.height_min_m[:, None, None] + 0.0005 * sampled.patches.pixels["height"]
    assert np.abs(got - world.height(x, y)).max() < 0.001 + 2.0 * world.bilinear_bound_m(0.2)
    assert np.abs(sampled.patches.pixels["ortho"] - world.grey(x, y)).max() < 1.1
    assert (sampled.patches.pixels["terrain"] == world.terrain(x, y)).mean() > 0.99
