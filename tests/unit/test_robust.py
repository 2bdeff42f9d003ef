"""Scatter by medians, against scipy's."""

import numpy as np
import pytest
from scipy.stats import median_abs_deviation

from tcpipe.robust import MEDIAN_OF_SQUARES, estimate_robust_std, estimate_shorth


def test_the_standard_deviation_is_that_of_scipy_about_zero_and_outliers_do_not_move_it():
    values = np.random.default_rng(1).normal(0.0, 2.0, 10_001)
    assert estimate_robust_std(values) == pytest.approx(
        median_abs_deviation(values, center=lambda *_, **__: 0.0, scale="normal")
    )
    values[:1000] = 1e6
    assert estimate_robust_std(values) == pytest.approx(2.0, rel=0.2)
    assert estimate_robust_std(values) ** 2 == pytest.approx(np.median(values**2) / MEDIAN_OF_SQUARES)


def test_the_shortest_half_gives_centre_and_standard_deviation_with_nearly_half_of_the_values_wrong():
    values = np.random.default_rng(2).normal(3.0, 2.0, 10_001)
    values[::9] = np.nan
    assert estimate_shorth(values) == pytest.approx((3.0, 2.0), abs=0.3)
    values[:4000] = 40.0 + np.arange(4000.0)
    centre, std = estimate_shorth(values)
    assert centre == pytest.approx(3.0, abs=1.0)
    assert std < 5.0
    assert estimate_shorth(values[:0]) == (0.0, 0.0)
