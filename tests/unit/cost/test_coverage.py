"""The share of labels inside their intervals, and its own interval, against scipy's binomial and simulated runs."""

import numpy as np
import pytest
from scipy.stats import binomtest

from tcpipe.cost.coverage import find_miscalibration, measure_coverage
from tcpipe.tables.findings import Subject


def test_the_coverage_of_single_samples_is_clopper_and_pearsons():
    """Against scipy's own binomial interval: 45 of 50 drives, each a run of its own."""
    found = measure_coverage(np.arange(50) < 45, np.arange(50))
    exact = binomtest(45, 50).proportion_ci(method="exact")
    assert (found.fraction, found.low, found.high) == pytest.approx((0.9, exact.low, exact.high))


def test_runs_that_err_alike_make_the_coverage_less_sure():
    rng = np.random.default_rng(1)
    runs = np.repeat(np.arange(10), 100)
    is_inside = rng.random(1000) < np.repeat(rng.beta(9.0, 1.0, 10), 100)
    clustered, alone = (measure_coverage(is_inside, of) for of in (runs, np.arange(1000)))
    assert clustered.high - clustered.low > 2.0 * (alone.high - alone.low)
    assert measure_coverage(is_inside, runs // 3).low is None  # four runs


def test_how_often_the_coverages_interval_holds_the_truth():
    """Twelve runs whose own coverage differs (Beta, mean 90 %): at least 93 of 100 intervals hold it, less three deviations."""
    held, sets = 0, 300
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        runs = np.repeat(np.arange(12), 60)
        found = measure_coverage(rng.random(720) < rng.beta(18.0, 2.0, 12)[runs], runs)
        held += found.low <= 0.9 <= found.high
    assert held / sets >= 0.89


@pytest.mark.parametrize(
    ("inside", "runs", "codes"),
    [
        (70, 2, []),  # two drives decide nothing
        (70, 20, ["time-overconfident"]),
        (88, 20, []),
        (99, 20, ["underconfident"]),
    ],
)
def test_a_verdict_on_coverage_needs_runs(inside, runs, codes):
    is_inside = np.tile(np.arange(100) < inside, 20)
    found = measure_coverage(is_inside, np.arange(2000) // (2000 // runs))
    assert [of.code for of in find_miscalibration(found, "time", Subject("split", "unseen"))] == codes
