"""Distance and shared ground of squares, against shapely and where they only just touch."""

import numpy as np
import pytest
from splits_squares import squares

from tcpipe.splits.neighbours import (
    compute_nearest_m,
    compute_shared_fraction,
    iterate_near_pairs,
    pair_distances,
    pair_overlaps,
)


def both(a, b):
    one, zero, distance, area = np.zeros(1, np.int64), np.zeros(1, np.int64), np.empty(1), np.empty(1)
    pair_distances(a, b, one, zero, distance)
    pair_overlaps(a, b, one, zero, area)
    return float(distance[0]), float(area[0])


@pytest.mark.parametrize(
    ("centre", "distance", "area"),
    [
        ((0, 0), 0, 1),
        ((1, 0), 0, 0),  # they share an edge
        ((1, 1), 0, 0),  # and a corner
        ((0.5, 0.5), 0, 0.25),
        ((0, -0.75), 0, 0.25),
        ((3, 0), 2, 0),
        ((0, 3), 2, 0),
        ((4, 5), 5, 0),
    ],
)
def test_squares_along_the_axes(centre, distance, area):
    assert both(squares([(0, 0)]), squares([centre])) == pytest.approx((distance, area), abs=1e-12)
    assert both(squares([centre]), squares([(0, 0)])) == pytest.approx((distance, area), abs=1e-12)


def test_each_footprint_is_held_against_its_nearest_however_many_there_are():
    ours, theirs = squares([(0, 0), (50, 0)]), squares([(3 + i, 0) for i in range(40)])
    assert compute_nearest_m(ours, theirs) == pytest.approx([2.0, 7.0])
    assert compute_nearest_m(ours, theirs[:0]).size == 0
    assert compute_nearest_m(ours[:0], theirs).size == 0


def test_pairs_are_all_within_reach_and_in_order():
    ours, theirs = np.array([[0.0, 0.0], [9.0, 0.0], [3.0, 0.0]]), np.array([[1.0, 0.0], [0.0, 2.0], [50.0, 0.0]])
    ((i, j),) = iterate_near_pairs(ours, theirs, within_m=2.0)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 0), (0, 1), (2, 0)]
    assert list(iterate_near_pairs(ours[:0], theirs, within_m=2.0)) == []
    assert list(iterate_near_pairs(ours, theirs[:0], within_m=2.0)) == []


def test_a_share_is_of_our_own_ground():
    ours, theirs = squares([(0, 0)], side_m=2.0), squares([(0, 0)])
    index = np.zeros(1, np.int64)
    assert compute_shared_fraction(ours, theirs, index, index) == pytest.approx([0.25])
    assert compute_shared_fraction(theirs, ours, index, index) == pytest.approx([1.0])
