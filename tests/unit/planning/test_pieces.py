"""Paths cut into metres."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tcpipe.planning.pieces import cut_path

_POINT = st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0))


def test_a_metre_is_a_metre_of_ground_where_the_map_is_out_of_scale():
    pieces = cut_path(np.array([[0.0, 0.0], [10.0, 0.0]]), chord_m=1.0, scale=0.9996)
    np.testing.assert_allclose(np.diff(pieces.start_xy_m[:, 0]), 1.0 / 0.9996)
    assert pieces.arc_m.sum() == pytest.approx(9.996)


def test_round_a_corner_the_chord_is_a_metre_and_the_arc_is_longer():
    pieces = cut_path(np.array([[0.0, 0.0], [1.5, 0.0], [1.5, 5.0]]), chord_m=1.0, scale=1.0)
    np.testing.assert_allclose(pieces.end_xy_m[1], [1.5, np.sqrt(0.75)])
    assert pieces.arc_m[1] == pytest.approx(0.5 + np.sqrt(0.75))
    assert pieces.arc_m.sum() == pytest.approx(6.5)


def test_the_patch_of_a_short_rest_ends_with_it_and_is_a_metre_long():
    frames = cut_path(np.array([[0.0, 0.0], [1.4, 0.0]]), chord_m=1.0, scale=1.0).frames(1.0)
    np.testing.assert_allclose(frames.centre_xy_m[:, 0], [0.5, 0.9])
    np.testing.assert_allclose(frames.along_xy, [[1.0, 0.0], [1.0, 0.0]])


@given(st.lists(_POINT, min_size=2, max_size=12, unique=True))
def test_pieces_join_up_and_add_up_to_the_path(points):
    xy = np.array(points)
    pieces = cut_path(xy, chord_m=1.0, scale=1.0)
    length = np.linalg.norm(np.diff(xy, axis=0), axis=1).sum()
    np.testing.assert_array_equal(pieces.start_xy_m[1:], pieces.end_xy_m[:-1])
    np.testing.assert_allclose(pieces.chord_m[:-1], 1.0, atol=1e-9)
    assert (pieces.arc_m >= pieces.chord_m - 1e-9).all()
    assert pieces.arc_m.sum() <= length + 1e-9
    if len(pieces.chord_m):
        assert (
            pieces.arc_m.sum() == pytest.approx(length, abs=2e-3)
            or np.linalg.norm(xy[-1] - pieces.end_xy_m[-1]) <= 1e-3
        )


def test_points_that_repeat_change_nothing():
    path = np.array([[0.0, 0.0], [0.7, 0.0], [0.7, 0.0], [2.5, 0.3]])
    once, twice = (cut_path(points, chord_m=1.0, scale=1.0) for points in (path[[0, 1, 3]], path))
    np.testing.assert_array_equal(once.end_xy_m, twice.end_xy_m)
