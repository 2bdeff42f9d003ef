"""Correlation length and effective sample size, on fields whose covariance is known."""

import numpy as np
import pytest

from tcpipe.balance.correlation import (
    ALONG_RAD,
    NEAR,
    Correlation,
    compute_effective_size,
    compute_slope_residuals,
    estimate_repeatability,
    find_repeated_pairs,
    fit_correlation,
)


def track(n):
    """Centres of n consecutive samples on a winding path, 1 m apart."""
    course = np.cumsum(np.random.default_rng(5).normal(0.0, 0.15, n))
    return np.cumsum(np.column_stack([np.cos(course), np.sin(course)]), axis=0)


def correlation(field, xy):
    """Of a field along one run."""
    return fit_correlation(field, xy, np.zeros(len(xy), int), np.arange(len(xy)), chord_m=1.0)


def covariance(xy, length_m, share):
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=-1)
    return np.where(np.eye(len(xy), dtype=bool), 1.0, share * np.exp(-apart / length_m))


@pytest.mark.parametrize(("length_m", "share"), [(2.0, 0.9), (6.0, 0.6), (3.0, 1.0)])
def test_length_and_share_of_a_known_field_are_found(length_m, share):
    rng, found = np.random.default_rng(1), []
    xy = track(1200)
    root = np.linalg.cholesky(covariance(xy, length_m, share) + 1e-9 * np.eye(len(xy)))
    for _ in range(12):
        field = 20.0 * root @ rng.standard_normal(len(xy))
        found.append(correlation(field, xy))
    assert np.median([one.length_m for one in found]) == pytest.approx(length_m, rel=0.25)
    assert np.median([one.share for one in found]) == pytest.approx(share, abs=0.1)


def test_labels_without_any_likeness_are_worth_their_number():
    rng, xy = np.random.default_rng(2), track(2000)
    found = correlation(rng.standard_normal(2000), xy)
    assert found.share < 0.1 or found.length_m < 0.5
    assert compute_effective_size(xy, found) > 1000


@pytest.mark.parametrize("length_m", [1.0, 5.0, 50.0])
def test_the_effective_size_is_that_of_the_variance_of_the_mean(length_m):
    """Against the definition, and against means of fields that were really drawn."""
    rng, xy = np.random.default_rng(3), track(300)
    cov = covariance(xy, length_m, 0.8)
    found = compute_effective_size(xy, Correlation(length_m, 0.8, 0))
    assert found == pytest.approx(300**2 / cov.sum())
    means = (np.linalg.cholesky(cov + 1e-9 * np.eye(300)) @ rng.standard_normal((300, 4000))).mean(axis=0)
    assert found == pytest.approx(1.0 / means.var(), rel=0.1)


def test_long_drives_are_judged_by_stretches_of_them():
    xy = np.concatenate([track(2500), np.add(track(2500), (0.0, 5000.0))])
    rng = np.random.default_rng(8)
    field = np.empty(len(xy))
    for part in np.array_split(np.arange(len(xy)), 10):  # 500 samples at a time, else the matrix is too large
        root = np.linalg.cholesky(covariance(xy[part], 3.0, 0.9) + 1e-9 * np.eye(len(part)))
        field[part] = root @ rng.standard_normal(len(part))
    found = fit_correlation(field, xy, np.repeat([0, 1], 2500), np.arange(5000), chord_m=1.0)
    assert found.length_m == pytest.approx(3.0, rel=0.4)
    assert found.share == pytest.approx(0.9, abs=0.1)


def test_many_samples_are_judged_by_the_first_which_are_random():
    rng = np.random.default_rng(4)
    xy = rng.uniform(0.0, 50.0, (2000, 2))
    cov = covariance(xy, 3.0, 0.9)
    assert compute_effective_size(xy, Correlation(3.0, 0.9, 0)) == pytest.approx(2000**2 / cov.sum(), rel=0.1)


def test_one_sample_is_one_and_none_is_none():
    assert compute_effective_size(np.zeros((1, 2)), Correlation(1.0, 1.0, 0)) == 1.0
    assert compute_effective_size(np.zeros((0, 2)), Correlation(1.0, 1.0, 0)) == 0.0
    assert compute_effective_size(np.zeros((9, 2)), Correlation(1.0, 1.0, 0)) == pytest.approx(
        1.0
    )  # nine times the same place


def test_too_few_samples_or_labels_that_are_all_alike_say_nothing():
    for n, values in ((4, np.arange(4.0)), (500, np.zeros(500))):
        assert correlation(values, track(n)) is None


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
