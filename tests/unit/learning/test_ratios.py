"""Ratios of errors: by hand, their intervals by how often these hold the truth."""

import numpy as np
import pytest

from tcpipe.learning.metrics import compare_errors


def test_a_ratio_by_hand():
    ours, theirs = np.array([1.0, 4.0, 4.0]), np.array([16.0, 16.0, 4.0])
    rmse = compare_errors(ours, theirs, np.array(["a", "a", "b"]), power=0.5, seed=0)
    assert rmse.value == pytest.approx(np.sqrt(9.0 / 36.0))
    assert (rmse.low, rmse.high) == (None, None)  # of two groups nothing is said
    assert compare_errors(ours, theirs, np.zeros(3), power=1.0, seed=0).value == pytest.approx(0.25)


def test_the_same_errors_on_both_sides_are_surely_one():
    losses = np.random.default_rng(0).exponential(size=200)
    found = compare_errors(2.0 * losses, losses, np.arange(200) // 10, power=1.0, seed=0)
    assert (found.value, found.low, found.high) == pytest.approx((2.0, 2.0, 2.0))


@pytest.mark.parametrize("losses", [np.empty(0), np.zeros(30), np.full(30, np.nan)])
def test_nothing_to_divide_by_is_no_ratio(losses):
    found = compare_errors(np.ones(len(losses)), losses, np.arange(len(losses)), power=1.0, seed=0)
    assert found.value is found.low is found.high is None


def test_groups_that_err_alike_make_it_less_sure():
    rng = np.random.default_rng(3)
    shared = np.repeat(rng.lognormal(0.0, 0.5, 20), 50)
    ours, theirs = shared * rng.exponential(size=1000), rng.exponential(size=1000)
    together, alone = (
        compare_errors(ours, theirs, groups, power=1.0, seed=0) for groups in (np.arange(1000) // 50, np.arange(1000))
    )
    assert np.log(together.high / together.low) > 1.5 * np.log(alone.high / alone.low)


def test_how_often_an_interval_holds_the_truth():
    """30 groups of 20 in which both sides err alike; 200 such data sets, 92 to 95 of 100 hold it, less three deviations of that share."""
    held, sets, groups = 0, 200, np.repeat(np.arange(30), 20)
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        easy, worse = np.exp(rng.normal(0.0, 0.3, 30))[groups], np.exp(rng.normal(0.0, 0.2, 30))[groups]
        ours = (easy * worse * rng.normal(size=600)) ** 2
        found = compare_errors(ours, (easy * rng.normal(size=600)) ** 2, groups, power=0.5, seed=seed)
        held += found.low <= np.exp(0.2**2) <= found.high
    assert 0.87 <= held / sets <= 0.98
