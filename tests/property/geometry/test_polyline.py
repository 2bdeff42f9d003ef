"""First crossings and lengths of random paths against brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_tracks import stamps

from tcpipe.geometry.polyline import fit_polyline


@st.composite
def paths(draw, wildness=(0.02, 0.3, 2.0)):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(2, 60))
    wild = draw(st.sampled_from(wildness))
    velocity = np.array([0.8, 0.3, 0.0]) + rng.normal(0, wild, (count, 3))
    position = np.cumsum(velocity, axis=0) * 0.05 + rng.normal(0, 0.05 * wild, (count, 3))
    return fit_polyline(stamps(count), position, velocity)


@settings(max_examples=60, deadline=None)
@given(paths(), st.floats(0.0, 0.99), st.floats(0.05, 1.5))
def test_first_crossing_is_the_first_of_a_dense_scan(path, share, radius_m):
    start = int(path.stamp_ns[0] + share * (path.stamp_ns[-1] - path.stamp_ns[0]))
    end = path.first_crossing_ns(start, radius_m=radius_m)
    dense = np.arange(start, path.stamp_ns[-1] + 1, 250_000)
    away = np.hypot(*(path.position_at(dense) - path.position_at(dense[:1]))[:, :2].T)
    outside = dense[away > radius_m + 1e-9]
    if end is None:
        assert not len(outside)
        return
    residual = np.hypot(*(path.position_at(np.array([end])) - path.position_at(dense[:1]))[0, :2]) - radius_m
    assert abs(residual) < 1e-6
    assert not len(outside) or end <= outside[0] + 1


@settings(max_examples=60, deadline=None)
@given(paths(), st.lists(st.floats(0.0, 1.0), max_size=6))
def test_lengths_grow_and_pieces_add_up(path, shares):
    span = path.stamp_ns[-1] - path.stamp_ns[0]
    cuts = np.sort(np.array([0.0, *shares, 1.0]))
    at_ns = path.stamp_ns[0] + (cuts * span).astype(np.int64)
    length = path.length_at(at_ns)
    assert (np.diff(length) >= -1e-4).all()  # the quadrature is not exact where a path turns round inside one interval
    assert abs(np.diff(length).sum() - path.length_m[-1]) < 1e-12 * max(1.0, path.length_m[-1])
    chord = np.hypot(*(path.position_at(at_ns[-1:]) - path.position_at(at_ns[:1]))[0, :2])
    assert path.length_m[-1] >= chord * (1 - 1e-6)


@pytest.mark.parametrize(("wildness", "quadrature"), [(0.02, 1e-9), (0.1, 1e-4)])
@settings(max_examples=40, deadline=None)
@given(st.data())
def test_length_is_that_of_a_fine_polygon(wildness, quadrature, data):
    # A polygon is shorter than its curve, by a share that falls with the square of its step. Of 3,000 paths of the wilder kind
    # the worst, which nearly turns round inside one interval, is 4e-5 short: eight nodes do not resolve a cusp.
    path = data.draw(paths(wildness=(wildness,)))
    dense = np.linspace(0, path.stamp_ns[-1] - path.stamp_ns[0], 200 * len(path.stamp_ns)).astype(np.int64)
    step = np.diff(path.position_at(path.stamp_ns[0] + dense), axis=0)
    polygon = np.hypot(step[:, 0], step[:, 1]).sum()
    assert polygon * (1 - quadrature) <= path.length_m[-1] <= polygon * (1 + 1e-4)
