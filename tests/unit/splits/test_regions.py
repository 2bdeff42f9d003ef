import numpy as np
import pytest
import shapely
from splits_squares import squares

from tcpipe.splits.regions import Regions, Side, classify_footprints, project_regions

FIELD = Regions(shapely.box(0, 0, 20, 10))


def side(x, y, *, buffer_m):
    return Side(int(classify_footprints(squares([(x, y)]), FIELD, buffer_m=buffer_m)[0]))


@pytest.mark.parametrize(("gap_m", "inside"), [(1.4141, False), (1.4143, True)])
def test_nearer_than_the_buffer_is_no_split_on_either_side(gap_m, inside):
    buffer_m = np.sqrt(2.0)
    assert side(0.5 + gap_m, 5, buffer_m=buffer_m) is (Side.INSIDE if inside else Side.BUFFER)
    assert side(-0.5 - gap_m, 5, buffer_m=buffer_m) is (Side.UNSEEN if inside else Side.BUFFER)


def test_projected_edges_follow_the_straight_line_in_lon_lat():
    # on this plane a parallel bends; a vertex-only projection would cut across the bend
    def project(lonlat):
        lon, lat = lonlat[:, 0], lonlat[:, 1]
        return 1e5 * np.column_stack([lon, lat + lon**2])

    lonlat = Regions(shapely.box(-0.1, 0.0, 0.1, 0.05))
    plane = project_regions(lonlat, project, window_deg=(-1, -1, 1, 1))
    middle = shapely.Point(0.0, 0.0)
    assert plane.train_test.boundary.distance(middle) < 0.05


def test_a_region_around_the_world_is_cut_to_the_window_before_it_is_projected():
    seen = []

    def project(lonlat):
        seen.append(np.abs(lonlat[:, 0]).max(initial=0))
        return 1e5 * lonlat

    project_regions(Regions(shapely.box(-180, -90, 180, 90)), project, window_deg=(15, 46, 16, 47))
    assert 15 < max(seen) <= 16


def test_a_region_of_very_many_vertices_is_one_of_few_edges_near_each_footprint():
    """A circle of 300,000 vertices, as traced from an image; every footprint lies near its border."""
    turns = np.linspace(0.0, 2.0 * np.pi, 300_000, endpoint=False)
    circle = Regions(shapely.Polygon(1000.0 * np.stack([np.cos(turns), np.sin(turns)], axis=1)))
    at = turns[::100]
    radius_m = np.where(np.arange(at.size) % 2 == 0, 990.0, 1010.0)
    middle = radius_m[:, None] * np.stack([np.cos(at), np.sin(at)], axis=1)
    found = classify_footprints(middle[:, None] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), circle, buffer_m=5.0)
    np.testing.assert_array_equal(found, np.where(radius_m < 1000.0, Side.INSIDE, Side.UNSEEN))
    found = classify_footprints(middle[:, None] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), circle, buffer_m=20.0)
    assert (found == Side.BUFFER).all()
