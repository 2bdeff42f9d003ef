"""Scatter by medians, against scipy's."""

import numpy as np
import pytest
from scipy.stats import median_abs_deviation

from tcpipe.robust import MEDIAN_OF_SQUARES, estimate_robust_std


def test_the_standard_deviation_is_that_of_scipy_about_zero_and_outliers_do_not_move_it():
    values = np.random.default_rng(1).normal(0.0, 2.0, 10_001)
    assert estimate_robust_std(values) == pytest.approx(
        median_abs_deviation(values, center=lambda *_, **__: 0.0, scale="normal")
    )
    values[:1000] = 1e6
    assert estimate_robust_std(values) == pytest.approx(2.0, rel=0.2)
    assert estimate_robust_std(values) ** 2 == pytest.approx(np.median(values**2) / MEDIAN_OF_SQUARES)
