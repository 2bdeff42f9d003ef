import numpy as np
import pytest
import shapely
from splits_squares import squares

from tcpipe.splits.regions import Regions, Side, project_regions, sides_of

FIELD = Regions(shapely.box(0, 0, 20, 10))


def side(x, y, regions=FIELD, *, buffer_m=0.0, course_rad=0.0):
    return Side(int(sides_of(squares([(x, y)], course_rad), regions, buffer_m=buffer_m)[0]))


def test_the_whole_rotated_footprint_must_be_inside():
    assert side(0.6, 5) is Side.INSIDE
    assert side(0.6, 5, course_rad=np.pi / 4) is Side.BUFFER  # its corner reaches 0.707 m
    assert side(-0.6, 5) is Side.UNSEEN
    assert side(-0.6, 5, course_rad=np.pi / 4) is Side.BUFFER
    assert side(0, 5) is Side.BUFFER


def test_a_footprint_that_only_touches_the_border_has_not_crossed_it():
    assert side(0.5, 5) is Side.INSIDE
    assert side(-0.5, 5) is Side.UNSEEN


@pytest.mark.parametrize(("gap_m", "inside"), [(1.4141, False), (1.4143, True)])
def test_nearer_than_the_buffer_is_no_split_on_either_side(gap_m, inside):
    buffer_m = np.sqrt(2.0)
    assert side(0.5 + gap_m, 5, buffer_m=buffer_m) is (Side.INSIDE if inside else Side.BUFFER)
    assert side(-0.5 - gap_m, 5, buffer_m=buffer_m) is (Side.UNSEEN if inside else Side.BUFFER)


def test_a_region_smaller_than_a_footprint_holds_nothing():
    assert side(5, 5, Regions(shapely.box(4.9, 4.9, 5.1, 5.1))) is Side.BUFFER


def test_a_hole_is_outside():
    holed = Regions(shapely.box(0, 0, 20, 10) - shapely.box(5, 3, 9, 7))
    assert side(7, 5, holed) is Side.UNSEEN
    assert side(5, 5, holed) is Side.BUFFER


def test_adjoining_polygons_have_no_border_between_them():
    joined = Regions(shapely.union_all([shapely.box(0, 0, 10, 10), shapely.box(10, 0, 20, 10)]))
    assert side(10, 5, joined, buffer_m=1.4) is Side.INSIDE


def test_exclude_carves_out_of_train_test_and_its_border_counts():
    carved = Regions(shapely.box(0, 0, 20, 10), exclude=shapely.box(8, 0, 12, 10))
    assert side(10, 5, carved, buffer_m=1.4) is Side.EXCLUDED
    assert side(8, 5, carved, buffer_m=1.4) is Side.BUFFER
    assert side(7, 5, carved, buffer_m=1.4) is Side.BUFFER
    assert side(5, 5, carved, buffer_m=1.4) is Side.INSIDE


def test_an_unseen_region_has_a_border_too():
    both = Regions(shapely.box(0, 0, 20, 10), unseen=shapely.box(30, 0, 40, 10))
    assert side(35, 5, both, buffer_m=1.4) is Side.UNSEEN
    assert side(30, 5, both, buffer_m=1.4) is Side.BUFFER
    assert side(25, 5, both, buffer_m=1.4) is Side.UNSEEN


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
