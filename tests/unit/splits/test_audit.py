import numpy as np
import pytest
from splits_squares import squares

from tcpipe.splits.audit import (
    Footprints,
    audit_leakage,
    compute_nearest_m,
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


@pytest.mark.parametrize("count", [7, 8, 9, 31, 33, 200])
def test_the_nearest_square_is_found_though_many_centres_are_nearer(count):
    """All but the last stand with an edge towards ours, a little nearer by their centres; the last reaches nearer with a corner."""
    centres = np.column_stack((np.full(count, 3.0), np.linspace(-0.2, 0.2, count)))
    centres[-1] = 3.1, 0.0
    course = np.append(np.zeros(count - 1), np.pi / 4)
    ours = squares([(0.0, 0.0)])
    assert compute_nearest_m(ours, ground(squares(centres, course))) == pytest.approx([3.1 - np.sqrt(0.5) - 0.5])
    assert compute_nearest_m(ours, ground(squares(centres[:-1]))) == pytest.approx([2.0])
