"""Scatter by medians, and non-negative least squares, against scipy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls
from scipy.stats import median_abs_deviation

from tcpipe.robust import MEDIAN_OF_SQUARES, estimate_robust_std, estimate_shorth, solve_non_negative


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


@given(st.integers(0, 2**32), st.integers(1, 10), st.floats(0.0, 1.0))
def test_non_negative_least_squares_are_those_of_scipy_for_columns_that_are_nearly_alike(seed, count, noise):
    draw = np.random.default_rng(seed)
    spacing, tau = np.geomspace(1.0, 32.0, count), np.geomspace(0.1, 27.0, 9)[:, None]
    made = 1.0 - np.exp(-spacing / tau)
    size = np.where(draw.random(len(tau)) < 0.3, draw.exponential(size=len(tau)), 0.0)
    seen = np.abs(size @ made * (1.0 + noise * draw.normal(size=count))) + 1e-6
    weight = np.sqrt(draw.integers(20, 5000, count)) / seen
    columns, target = (made * weight).T, seen * weight
    theirs, residual = nnls(columns, target)
    ours = solve_non_negative(columns, target)
    assert ours.min() >= 0.0
    assert np.linalg.norm(columns @ ours - target) == pytest.approx(residual, rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-8 * theirs.max(initial=1.0))


@pytest.mark.parametrize(
    ("columns", "target", "factors"),
    [
        ([[1, 0], [1, 0], [0, 1]], [2, 1, 1], [1.5, 1]),
        ([[1, 0], [1, 0], [0, 1]], [-1, -1, -1], [0, 0]),
        ([[1, 1], [1, 1]], [1, 1], [1, 0]),  # two that are the same: the first
        ([[0, 0], [0, 0]], [1, 1], [0, 0]),
    ],
)
def test_non_negative_least_squares_by_hand(columns, target, factors):
    found = solve_non_negative(np.array(columns, float), np.array(target, float))
    np.testing.assert_allclose(found, factors, atol=1e-12)
