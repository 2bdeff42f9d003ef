"""Correlation length and effective sample size, on fields whose covariance is known."""

import numpy as np
import pytest

from tcpipe.balance.correlation import (
    Correlation,
    compute_effective_size,
    compute_slope_residuals,
    estimate_correlations,
)


def track(n):
    """Centres of n consecutive samples on a winding path, 1 m apart."""
    course = np.cumsum(np.random.default_rng(5).normal(0.0, 0.15, n))
    return np.cumsum(np.column_stack([np.cos(course), np.sin(course)]), axis=0)


def correlation(field, xy):
    """Of a field along one run."""
    return estimate_correlations({"w": field}, xy, np.zeros(len(xy), int), np.arange(len(xy)), chord_m=1.0)["w"]


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
    found = estimate_correlations({"w": field}, xy, np.repeat([0, 1], 2500), np.arange(5000), chord_m=1.0)["w"]
    assert found.length_m == pytest.approx(3.0, rel=0.4)
    assert found.share == pytest.approx(0.9, abs=0.1)


def test_many_samples_are_judged_by_the_first_which_are_random():
    rng = np.random.default_rng(4)
    xy = rng.uniform(0.0, 50.0, (4000, 2))
    cov = covariance(xy, 3.0, 0.9)
    assert compute_effective_size(xy, Correlation(3.0, 0.9, 0)) == pytest.approx(4000**2 / cov.sum(), rel=0.1)


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
