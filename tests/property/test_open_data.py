"""Ground around tracks, and which surveys of it are taken, for any track and any surveys."""

import numpy as np
import pyproj
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from tcpipe.formats.maps.open_data import Item, choose_newest, make_area


@given(lat=st.floats(-65, 65), margin_m=st.floats(5, 500), seed=st.integers(0, 99))
def test_the_margin_is_right_to_two_per_cent(lat, margin_m, seed):
    walk = np.cumsum(np.random.default_rng(seed).normal(size=(30, 2)), axis=0) * 1e-5
    track = np.array([7.4, lat]) + walk
    area = make_area([track], margin_m)
    line, geod = shapely.linestrings(track), pyproj.Geod(ellps="WGS84")
    for x, y in shapely.get_coordinates(area.exterior)[:-1:7]:
        points = shapely.get_coordinates(shapely.segmentize(line, 1e-6))
        distance_m = geod.inv(*np.broadcast_arrays(x, y, *points.T))[2].min()
        assert distance_m == pytest.approx(margin_m, abs=0.02 * margin_m + 0.6)  # 0.5 m: the track is simplified


boxes = st.tuples(st.integers(0, 8), st.integers(0, 8), st.integers(1, 6), st.integers(1, 6), st.integers(2015, 2026))


@given(st.lists(boxes, min_size=1, max_size=8))
def test_the_newest_survey_of_each_place_is_taken_and_no_place_is_lost(surveys):
    area = shapely.box(0, 0, 10, 10)
    items = [
        Item(str(n), "", str(year), None, None, shapely.box(x, y, x + width, y + height))
        for n, (x, y, width, height, year) in enumerate(surveys)
    ]
    chosen, covered = choose_newest(items, area)
    everything = shapely.union_all([of.footprint for of in items]).intersection(area)
    assert covered == pytest.approx(everything.area / area.area, abs=0.01)
    assert [of.date for of in chosen] == sorted(of.date for of in chosen)  # the newest on top
    for item in items:  # what is left out adds nothing to what is newer
        if item not in chosen:
            newer = [of.footprint for of in items if (of.date, of.id) > (item.date, item.id)]
            assert shapely.difference(item.footprint, shapely.union_all(newer)).intersection(area).area < 0.2
