"""Repeatability of labels, on fields whose noise is known."""

import numpy as np
import pytest

from tcpipe.cost.repeatability import (
    ALONG_RAD,
    NEAR,
    compute_slope_residuals,
    estimate_repeatability,
    find_repeated_pairs,
)


def test_class_and_slope_are_taken_out_of_a_label():
    rng = np.random.default_rng(6)
    kind, slope = rng.integers(4, 7, 600), rng.uniform(-0.4, 0.4, 600)
    noise = rng.normal(0.0, 1.0, 600)
    left = compute_slope_residuals(kind * 50.0 + kind * 300.0 * slope + 200.0 * slope**2 + noise, kind, slope)
    assert left.std() == pytest.approx(noise.std(), rel=0.02)
    few = compute_slope_residuals(np.array([1.0, 3.0]), np.array([1, 1]), np.array([0.0, 0.3]))
    assert few.tolist() == pytest.approx([-1.0, 1.0])


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


@pytest.mark.parametrize("seed", range(6))
def test_pairs_are_the_mutual_nearest_of_one_place_and_direction(seed):
    rng = np.random.default_rng(seed)
    xy, course = rng.uniform(0.0, 5.0, (250, 2)), rng.choice([0.0, 0.05, 0.5, np.pi], 250)
    kind = rng.integers(1, 3, 250)
    reach = NEAR / (2 * np.sin(ALONG_RAD / 2))
    apart = np.sqrt(
        ((xy[:, None] - xy[None]) ** 2).sum(axis=-1)
        + (2 * reach * np.sin(wrapped(course[:, None] - course[None]) / 2)) ** 2
    )
    np.fill_diagonal(apart, np.inf)
    nearest = apart.argmin(axis=1)
    expected = {
        (i, int(j))
        for i, j in enumerate(nearest)
        if i < j and nearest[j] == i and apart[i, j] <= NEAR and kind[i] == kind[j]
    }
    pairs = find_repeated_pairs(xy, course, kind, chord_m=1.0)
    assert {tuple(pair) for pair in pairs.tolist()} == expected
    assert expected
    assert len(np.unique(pairs)) == pairs.size


def test_opposite_passes_and_one_pass_alone_give_no_pair():
    xy = np.column_stack([np.arange(20.0), np.zeros(20)])
    assert len(find_repeated_pairs(xy, np.zeros(20), np.ones(20, int), chord_m=1.0)) == 0
    both, course = np.concatenate([xy, xy]), np.repeat([0.0, np.pi], 20)
    assert len(find_repeated_pairs(both, course, np.ones(40, int), chord_m=1.0)) == 0
    assert len(find_repeated_pairs(both, np.zeros(40), np.ones(40, int), chord_m=1.0)) == 20
    assert len(find_repeated_pairs(np.zeros((1, 2)), np.zeros(1), np.ones(1, int), chord_m=1.0)) == 0


def test_the_interval_holds_the_noise_that_was_put_in_as_often_as_it_says():
    """300 passes over one field, noise of 5 W that neighbours share in part."""
    rng, held = np.random.default_rng(0), 0
    xy = np.concatenate([np.column_stack([np.arange(200.0), np.zeros(200)])] * 2)
    ground = np.tile(rng.normal(0.0, 40.0, 200), 2)
    pairs = np.column_stack([np.arange(200), np.arange(200, 400)])
    for _ in range(300):
        white = rng.normal(0.0, 1.0, (2, 202))
        noise = 5.0 * (white[:, :-2] + white[:, 1:-1] + white[:, 2:]).reshape(-1) / np.sqrt(3.0)
        found = estimate_repeatability(ground + noise, ground + noise, pairs, xy, chord_m=1.0)
        held += found.std_low <= 5.0 <= found.std_high
    assert 0.90 <= held / 300 <= 0.99
    assert found.places == 20
    assert found.share_of_variance == pytest.approx(found.std**2 / (ground + noise).var())


def test_too_few_places_give_no_interval_and_no_pairs_nothing():
    xy = np.zeros((4, 2))
    found = estimate_repeatability(np.arange(4.0), np.arange(4.0), np.array([[0, 1], [2, 3]]), xy, chord_m=1.0)
    assert (found.pairs, found.places, found.std_low, found.std_high) == (2, 1, None, None)
    assert found.std == pytest.approx(np.sqrt(0.5))
    assert estimate_repeatability(np.arange(4.0), np.arange(4.0), np.empty((0, 2), int), xy, chord_m=1.0) is None
