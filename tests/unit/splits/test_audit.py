import numpy as np
import pytest
from scipy.spatial import cKDTree
from splits_squares import squares

from tcpipe.splits.audit import (
    Footprints,
    audit_leakage,
    compute_nearest_m,
    compute_shared_fraction,
    find_near_pairs,
)


def audit(split, centres, run=None, start=None, **keywords):
    n = len(split)
    run = np.unique(run or ["r"] * n, return_inverse=True)[1]
    start = np.arange(n) if start is None else np.array(start)
    train, *held = (np.array(split) == name for name in ("train", "test", "unseen"))
    held = dict(zip(("test", "unseen"), held, strict=True))
    return audit_leakage(train, held, run, start, squares(centres, **keywords), chord_m=1.0)


def ground(corners):
    return Footprints(corners, np.arange(len(corners)))


def test_nothing_trains():
    test, _ = audit(["test", "test"], [(0, 0), (1, 0)])
    assert (test.samples, test.nearest_train_min_m, test.nearest_train_median_m) == (2, None, None)


def test_a_chord_and_a_half_is_still_a_neighbour_and_another_run_is_none():
    test, _ = audit(["train", "test"], [(0, 0), (1.5, 0)])
    assert test.same_track_pairs == 1
    test, _ = audit(["train", "test"], [(0, 0), (1.6, 0)])
    assert test.same_track_pairs == 0
    test, _ = audit(["train", "test"], [(0, 0), (1, 0)], run=["a", "b"])
    assert test.same_track_pairs == 0


def test_neighbours_are_those_in_time_whatever_the_rows_order():
    test, _ = audit(["train", "test", "train"], [(0, 0), (2, 0), (1, 0)], start=[0, 2, 1])
    assert test.same_track_pairs == 1


@pytest.mark.parametrize(("apart_m", "pairs"), [(0.9995, 0), (0.998, 1)])
def test_to_touch_is_not_to_share(apart_m, pairs):
    test, _ = audit(["train", "test"], [(0, 0), (apart_m, 0)], run=["a", "b"])
    assert (test.overlapping_pairs, test.overlapping_samples, test.repeated_place_samples) == (pairs, pairs, pairs)


@pytest.mark.parametrize("count", [7, 8, 9, 31, 33, 200])
def test_the_nearest_square_is_found_though_many_centres_are_nearer(count):
    """All but the last stand with an edge towards ours, a little nearer by their centres; the last reaches nearer with a corner."""
    centres = np.column_stack((np.full(count, 3.0), np.linspace(-0.2, 0.2, count)))
    centres[-1] = 3.1, 0.0
    course = np.append(np.zeros(count - 1), np.pi / 4)
    ours = squares([(0.0, 0.0)])
    assert compute_nearest_m(ours, ground(squares(centres, course))) == pytest.approx([3.1 - np.sqrt(0.5) - 0.5])
    assert compute_nearest_m(ours, ground(squares(centres[:-1]))) == pytest.approx([2.0])


def test_each_footprint_is_held_against_its_nearest_however_many_there_are():
    ours, theirs = squares([(0, 0), (50, 0)]), squares([(3 + i, 0) for i in range(40)])
    assert compute_nearest_m(ours, ground(theirs)) == pytest.approx([2.0, 7.0])
    assert compute_nearest_m(ours, Footprints(theirs, np.arange(10, 40))) == pytest.approx([12.0, 7.0])
    assert compute_nearest_m(ours, ground(theirs[:0])).size == 0
    assert compute_nearest_m(ours[:0], ground(theirs)).size == 0


def test_pairs_are_all_within_reach_and_in_order():
    ours, theirs = np.array([[0.0, 0.0], [9.0, 0.0], [3.0, 0.0]]), np.array([[1.0, 0.0], [0.0, 2.0], [50.0, 0.0]])
    i, j = find_near_pairs(ours, cKDTree(theirs), within_m=2.0)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 0), (0, 1), (2, 0)]


def test_a_share_is_of_our_own_ground():
    ours, theirs = squares([(0, 0)], side_m=2.0), squares([(0, 0)])
    index = np.zeros(1, np.int64)
    assert compute_shared_fraction(ours, theirs, index, index) == pytest.approx([0.25])
    assert compute_shared_fraction(theirs, ours, index, index) == pytest.approx([1.0])
