"""RMSE and MAPE, alone and combined, against hand calculations and against the samples pooled."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import quad
from scipy.stats import norm

from tcpipe.learning.metrics import (
    ALL,
    FEWEST_GROUPS,
    LEAST,
    Spread,
    compare_errors,
    compute_errors,
    compute_errors_by_class,
    compute_label_floor,
)

_VALUES = st.floats(20.0, 500.0)


def test_a_label_near_nothing_is_in_the_rmse_alone():
    found = compute_errors(np.array([110.0, 5.0]), np.array([100.0, -3.0]), LEAST["w"])
    assert (found.count, found.mape_count) == (2, 1)
    assert found.mape_percent == pytest.approx(10.0)
    assert found.rmse == pytest.approx(np.sqrt((100.0 + 64.0) / 2.0))


@given(
    st.integers(1, 40).flatmap(
        lambda n: st.tuples(
            *(arrays(float, n, elements=_VALUES) for _ in range(2)), arrays(int, n, elements=st.integers(4, 7))
        )
    )
)
def test_all_is_the_samples_pooled(drawn):
    predicted, measured, class_ids = drawn
    names = {4: "grass", 5: "mud", 6: "unpaved road", 7: "paved road"}
    by_class = compute_errors_by_class({"E": predicted}, {"E": measured}, class_ids, names)["E"]
    pooled = compute_errors(predicted, measured, LEAST["E"])
    assert by_class[ALL].count == len(predicted)
    assert by_class[ALL].rmse == pytest.approx(pooled.rmse, rel=1e-9, abs=1e-9)
    assert by_class[ALL].mape_percent == pytest.approx(pooled.mape_percent, rel=1e-9, abs=1e-9)
    assert set(by_class) - {ALL} == {names[number] for number in class_ids}


def test_the_labels_floor_is_what_a_perfect_prediction_would_show():
    rng = np.random.default_rng(5)
    truth, sigma = rng.uniform(100.0, 300.0, 200_000), rng.uniform(2.0, 9.0, 200_000)
    labels, ids = truth + sigma * rng.standard_normal(truth.size), np.full(truth.size, 4)
    told = compute_label_floor({"w": sigma}, {"w": labels}, ids, {4: "grass"})["w"][ALL]
    seen = compute_errors(truth, labels, LEAST["w"])
    assert told.rmse == pytest.approx(seen.rmse, rel=0.01)
    assert told.mape_percent == pytest.approx(seen.mape_percent, rel=0.01)


def _spread(predicted, std):
    return Spread(std, predicted - 1.645 * std, predicted + 1.645 * std)


def test_scores_are_those_of_their_definitions():
    """CRPS is the integral of the squared difference of the predicted and the measured distribution, NLL that of the density."""
    predicted, measured, std = np.array([100.0, 60.0]), np.array([104.0, 40.0]), np.array([5.0, 8.0])
    found = compute_errors(predicted, measured, 0.0, _spread(predicted, std))
    crps = []
    for m, y, s in zip(predicted, measured, std, strict=True):
        below = quad(lambda x, m=m, s=s: norm.cdf(x, m, s) ** 2, m - 60.0, y)[0]
        crps.append(below + quad(lambda x, m=m, s=s: (norm.cdf(x, m, s) - 1.0) ** 2, y, m + 60.0)[0])
    assert found.crps == pytest.approx(np.mean(crps), rel=1e-6)
    assert found.nll == pytest.approx(-np.mean(norm.logpdf(measured, predicted, std)))
    assert found.coverage_percent == 50.0


def test_a_ratio_by_hand():
    ours, theirs = np.array([1.0, 4.0, 4.0]), np.array([16.0, 16.0, 4.0])
    rmse = compare_errors(ours, theirs, np.array(["a", "a", "b"]), seed=0)
    assert rmse.value == pytest.approx(np.sqrt(9.0 / 36.0))
    assert (rmse.low, rmse.high) == (None, None)  # of two groups nothing is said


@pytest.mark.parametrize(("groups", "is_enough"), [(5, False), (9, False), (10, True)])
def test_five_blocks_are_too_few_for_an_interval(groups, is_enough):
    losses = np.random.default_rng(0).exponential(size=(2, 200))
    found = compare_errors(*losses, np.arange(200) % groups, seed=0)
    assert found.value is not None
    assert (found.low is not None) == is_enough


@pytest.mark.parametrize("count", [FEWEST_GROUPS, 30])
def test_how_often_an_interval_holds_the_truth(count):
    """Groups of 20 in which both sides err alike; 200 such data sets, 92 to 95 of 100 hold it, less three deviations of that share."""
    held, sets, groups = 0, 200, np.repeat(np.arange(count), 20)
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        easy, worse = np.exp(rng.normal(0.0, 0.3, count))[groups], np.exp(rng.normal(0.0, 0.2, count))[groups]
        ours = (easy * worse * rng.normal(size=groups.size)) ** 2
        found = compare_errors(ours, (easy * rng.normal(size=groups.size)) ** 2, groups, seed=seed)
        held += found.low <= np.exp(0.2**2) <= found.high
    assert 0.87 <= held / sets <= 0.98
