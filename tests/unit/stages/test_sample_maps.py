"""Each sample on exactly one of several maps: by priority where they overlap, on the next where one has a hole."""

import numpy as np
import pytest
from map_worlds import ArrayMap, random_map, segments_from

from tcpipe.errors import MapError
from tcpipe.recipe import SampleConfig
from tcpipe.stages.sample import sample_on_maps, sample_segments, sum_losses
from tcpipe.tables.bits import Loss
from tcpipe.terrain.layers import PAPER_CLASSES, ClassTable
from tcpipe.terrain.target_grid import MapGrid

CRS = "EPSG:32633"
NORTH = 5_200_000.0


def map_at(x_min_m, name, seed):
    """13 m wide, 15 m high, from a western edge on."""
    plain = random_map(seed)
    return ArrayMap(MapGrid(CRS, x_min_m, NORTH, 0.05, 300, 260), plain.arrays, name=name)


def lane(x_m, y_m):
    """Metres driven east from each x [m from 500 km] at y [m south of the maps' northern edge]."""
    starts = np.stack([500_000.0 + np.asarray(x_m, float), np.full(len(x_m), NORTH - y_m)], 1)
    return segments_from(CRS, starts, np.full(len(starts), 90.0), gnss_crs="EPSG:4326")


def sample(segments, *maps, **config):
    return sample_on_maps(segments, maps, SampleConfig(**config), gnss_crs="EPSG:4326")


def by_map(sampled):
    """Rows and pixels of what each of two maps has."""
    here = [sampled.map_index == number for number in (0, 1)]
    pixels = [{name: layer[mine] for name, layer in sampled.patches.pixels.items()} for mine in here]
    return [sampled.kept[mine] for mine in here], pixels


def test_the_first_map_that_has_data_is_taken():
    west, east = map_at(500_000.0, "west", 1), map_at(500_006.0, "east", 2)
    segments = lane(np.arange(0.5, 24.0, 0.5), 6.0)
    both = sample(segments, west, east)
    alone = [sample_segments(segments, each, SampleConfig(), gnss_crs="EPSG:4326") for each in (west, east)]
    rows, pixels = by_map(both)
    np.testing.assert_array_equal(rows[0], alone[0].kept)
    np.testing.assert_array_equal(rows[1], np.setdiff1d(alone[1].kept, alone[0].kept))
    np.testing.assert_array_equal(pixels[0]["height"], alone[0].patches.pixels["height"])
    rest = np.isin(alone[1].kept, rows[1])
    np.testing.assert_array_equal(pixels[1]["ortho"], alone[1].patches.pixels["ortho"][rest])
    assert len(rows[0]) > 20
    assert len(rows[1]) > 10
    turned = sample(segments, east, west)
    np.testing.assert_array_equal(by_map(turned)[0][0], alone[1].kept)
    everywhere = [np.sort(each.kept).tolist() for each in (both, turned)]
    assert everywhere[0] == everywhere[1] == np.flatnonzero(both.lost_by == 0).tolist()
    lost_m = sum_losses(segments.column("arc_length_m").to_numpy(), both.lost_by)
    assert sum(lost_m.values()) == pytest.approx(1.004 * (segments.num_rows - len(both.kept)))


def test_a_hole_in_one_map_is_filled_by_the_next_and_named_if_it_is_not():
    first, second = map_at(500_000.0, "first", 1), map_at(500_006.0, "second", 2)
    first.arrays["height"][:, 60:220] = np.nan  # from 3 m to 11 m
    segments = lane([1.0, 5.0, 8.0, 15.0, 30.0], 6.0)
    got = sample(segments, first, second)
    assert [rows.tolist() for rows in by_map(got)[0]] == [[0], [2, 3]]
    assert got.lost_by.tolist() == [0, Loss.NODATA, 0, 0, Loss.OUTSIDE_MAP]


def test_what_the_first_map_shows_not_traversable_stays_so():
    first, second = map_at(500_000.0, "first", 1), map_at(500_000.0, "second", 2)
    first.arrays["terrain"][:] = 1
    got = sample(lane([2.0], 6.0), first, second)
    assert got.lost_by.tolist() == [Loss.NOT_TRAVERSABLE]
    assert got.kept.size == 0


def test_maps_that_are_not_alike_are_refused():
    one, two, three = (map_at(500_000.0, name, 1) for name in ("one", "two", "three"))
    bare = ArrayMap(two.grid, {"height": two.arrays["height"]}, name="two")
    other = ArrayMap(three.grid, three.arrays, name="three", classes=ClassTable(PAPER_CLASSES.classes[:6]))
    with pytest.raises(MapError) as caught:
        sample(lane([2.0], 6.0), one, bare, other)
    first, second = caught.value.problems
    assert first.startswith("map two: has height, but map one has height, ortho, terrain")
    assert "map three: its classes differ from those of map one: id 7 is nothing, but paved road" in second
