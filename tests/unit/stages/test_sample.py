"""Which segments get a patch, why the others do not, and what is said about it."""

import numpy as np
import pyproj
import pytest
from made_tracks import with_columns
from map_worlds import ArrayMap, random_map, segment_table, segments_from

from tcpipe.errors import TableError
from tcpipe.recipe import SampleConfig
from tcpipe.stages.sample import sample_segments, sum_losses
from tcpipe.tables.bits import Loss
from tcpipe.tables.findings import Subject
from tcpipe.terrain.target_grid import MapGrid

CRS = "EPSG:32633"


def drive(starts, azimuth_deg=90.0, **options):
    starts = np.array(starts, float)
    return segments_from(CRS, starts, np.full(len(starts), azimuth_deg), gnss_crs="EPSG:4326", **options)


def sample(segments, source, gnss_crs="EPSG:4326", **config):
    return sample_segments(segments, source, SampleConfig(**config), gnss_crs=gnss_crs)


def test_every_loss_has_its_reason_and_its_metres():
    source = random_map()  # x from 500000 to 500013, y from 5199985 to 5200000
    source.arrays["terrain"][:, 100:130] = 2
    source.arrays["height"][250:, :] = np.nan
    starts = [(500_001.0, 5_199_995.0), (500_012.5, 5_199_995.0), (499_000.0, 5_199_995.0), (500_001.0, 5_199_987.0)]
    starts += [(500_005.2, 5_199_995.0), (500_001.0, 5_199_992.0)]
    segments = drive(starts)
    segments = with_columns(segments, position_std_m=[*[0.02] * 5, 0.2])
    got = sample(segments, source)
    wanted = [0, Loss.OUTSIDE_MAP, Loss.OUTSIDE_MAP, Loss.NODATA, Loss.NOT_TRAVERSABLE, Loss.POSITION_UNCERTAIN]
    assert got.lost_by.tolist() == wanted
    assert got.kept.tolist() == [0]
    assert got.patches.pixels["height"].shape == (1, 40, 40)
    assert got.footprint_lonlat_deg.shape == (1, 4, 2)
    metres = dict.fromkeys((Loss.NODATA, Loss.NOT_TRAVERSABLE, Loss.POSITION_UNCERTAIN), 1.004)
    metres |= {Loss.OUTSIDE_MAP: 2.008}
    assert sum_losses(segments.column("arc_length_m").to_numpy(), got.lost_by) == pytest.approx(metres)


def test_a_recipe_may_allow_some_invalid_pixels():
    source = random_map()
    source.arrays["ortho"][100, 30] = 0
    segments = drive([(500_001.0, 5_199_995.0), (499_999.8, 5_199_991.0), (499_998.5, 5_199_991.0)])
    assert sample(segments, source).lost_by.tolist() == [Loss.NODATA, Loss.OUTSIDE_MAP, Loss.OUTSIDE_MAP]
    got = sample(segments, source, min_valid_fraction=0.7)
    assert got.lost_by.tolist() == [0, 0, Loss.OUTSIDE_MAP]
    assert got.patches.valid_fraction[0] == 1.0 - 16.0 / 1600.0  # 4 x 4 patch pixels have a tap there
    assert 0.7 < got.patches.valid_fraction[1] < 0.8
    got = sample(segments, source, min_valid_fraction=0.9)
    assert got.lost_by.tolist() == [0, Loss.OUTSIDE_MAP, Loss.OUTSIDE_MAP]


def test_segments_of_a_run_without_gnss_are_outside_every_map():
    nowhere = np.full((2, 2), np.nan)
    got = sample(segment_table(nowhere, nowhere, [0.0, 0.0]), random_map())
    assert got.lost_by.tolist() == [Loss.OUTSIDE_MAP] * 2


def test_chords_that_contradict_their_ends_are_refused():
    start = np.array([(500_001.0, 5_199_995.0)])
    to_lonlat = pyproj.Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)
    lonlat = np.stack(to_lonlat.transform(start[:, 0], start[:, 1]), 1)
    with pytest.raises(TableError, match="1 chords contradict their end positions"):
        sample(segment_table(lonlat, lonlat, [0.0]), random_map())


def test_footprints_come_back_as_lon_lat_around_the_chord():
    segments = drive([(500_002.0, 5_199_990.0)], azimuth_deg=37.0)
    got = sample(segments, random_map())
    geod = pyproj.Geod(ellps="WGS84")
    area_m2, perimeter_m = geod.polygon_area_perimeter(*got.footprint_lonlat_deg[0].T)
    assert area_m2 == pytest.approx(1.0, rel=1e-4)  # positive: counter-clockwise
    assert perimeter_m == pytest.approx(4.0, rel=1e-4)
    assert got.footprint_lonlat_deg[0, :, 0].mean() == pytest.approx(
        (segments["start_lon_deg"][0].as_py() + segments["end_lon_deg"][0].as_py()) / 2.0, abs=1e-9
    )


def test_a_wider_patch_is_centred_on_the_chord():
    segments = drive([(500_004.0, 5_199_993.0)])
    one, two = (sample(segments, random_map(), patch_m=m, patch_px=px) for m, px in ((1.0, 40), (2.0, 80)))
    np.testing.assert_allclose(two.footprint_xy_m.mean(axis=1), one.footprint_xy_m.mean(axis=1), atol=1e-6)
    np.testing.assert_array_equal(two.patches.pixels["terrain"][0, 20:60, 20:60], one.patches.pixels["terrain"][0])


def test_pitches_that_do_not_fit_the_map_are_said():
    segments = drive([(500_002.0, 5_199_990.0)])
    source = random_map()
    (finer,) = sample(segments, source).findings
    assert (finer.code, finer.subject) == ("patch-pixels-unlike-map", Subject("map", source.name))
    assert finer.numbers == {"patch_pixel_m": 0.025, "map_pixel_m": 0.05}
    assert finer.remedies[0].recipe == {"sample": {"patch_px": 20}}
    assert sample(segments, source, patch_px=20).findings == ()
    assert sample(segments, source, patch_px=10).findings == ()
    (coarser,) = sample(segments, source, patch_px=8).findings
    assert coarser.numbers["patch_pixel_m"] > 2.0 * coarser.numbers["map_pixel_m"]


@pytest.mark.parametrize(
    ("gnss_crs", "map_crs", "doubtful"),
    [
        ("EPSG:4326", "EPSG:32755", False),
        ("EPSG:7844", "EPSG:7855", False),
        ("EPSG:7844", "EPSG:28355", False),
        ("EPSG:4326", "EPSG:28355", True),
        ("EPSG:4326", "EPSG:7855", True),
        ("EPSG:7844", "EPSG:32755", True),
    ],
)
def test_a_datum_shift_known_only_roughly_is_said(gnss_crs, map_crs, doubtful):
    grid = MapGrid(map_crs, 600_000.0, 6_100_000.0, 0.05, 200, 200)
    source = ArrayMap(grid, {"height": np.zeros((200, 200), np.float32)})
    segments = segments_from(map_crs, np.array([(600_004.0, 6_099_995.0)]), np.array([90.0]), gnss_crs=gnss_crs)
    got = sample(segments, source, gnss_crs, patch_px=20)
    assert bool({"datum-shift-rough", "datum-shift-unknown"} & {of.code for of in got.findings}) == doubtful
    assert got.kept.tolist() == [0]


def test_gda94_and_gda2020_are_told_apart():
    """A GDA2020 position lies 1.8 m from where the same numbers would be in GDA94."""
    grid = MapGrid("EPSG:28355", 600_000.0, 6_100_000.0, 0.05, 200, 200)
    source = ArrayMap(grid, {"height": np.zeros((200, 200), np.float32)})
    lonlat = pyproj.Transformer.from_crs("EPSG:28355", "EPSG:4283", always_xy=True).transform(600_005.0, 6_099_995.0)
    start = np.array([lonlat])
    lon, lat, _ = pyproj.Geod(ellps="GRS80").fwd(*lonlat, 90.0, 1.0)
    segments = segment_table(start, np.array([(lon, lat)]), [90.0])
    here, there = (sample(segments, source, crs).footprint_xy_m.mean(axis=(0, 1)) for crs in ("EPSG:4283", "EPSG:7844"))
    assert 1.5 < np.linalg.norm(here - there) < 2.0
