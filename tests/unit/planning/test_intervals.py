"""Intervals of sums: against drives whose errors are drawn."""

import numpy as np
import pytest
from physics_model import made_residuals

from tcpipe.planning.intervals import COVERAGE, errors_of

_GRASS = np.uint8(4)


def _width(errors, count):
    low, high = errors.of_sum(np.full(count, 100.0), np.full(count, _GRASS))
    return (high - low) / (100.0 * count)


def test_one_piece_has_the_quantiles_of_the_held_out_errors():
    found = errors_of(made_residuals(4000, sigma=0.1))["energy"]
    low, high = found.of_pieces(np.array([200.0]), np.array([_GRASS]))
    assert low[0] == pytest.approx(200.0 * (1.0 - 1.645 * 0.1), rel=0.01)
    assert high[0] == pytest.approx(200.0 * (1.0 + 1.645 * 0.1), rel=0.01)


def test_independent_errors_shrink_with_the_root_of_the_length_and_shared_ones_do_not():
    alone = errors_of(made_residuals(4000, shared=0.0))["energy"]
    together = errors_of(made_residuals(4000, shared=1.0, runs=40))["energy"]
    assert _width(alone, 400) < 0.3 * _width(alone, 1)
    assert _width(together, 400) > 0.95 * _width(together, 1)


@pytest.mark.parametrize("shared", [0.0, 0.3])
def test_intervals_hold_the_share_of_drives_that_they_promise(shared):
    """Train's held-out errors give the interval; as many new drives of 80 m show how often it holds."""
    errors = errors_of(made_residuals(8000, sigma=0.15, shared=shared, runs=80))["energy"]
    rng = np.random.default_rng(5)
    drives, metres = 2000, 80
    error = 0.15 * (
        np.sqrt(shared) * rng.normal(size=(drives, 1)) + np.sqrt(1.0 - shared) * rng.normal(size=(drives, metres))
    )
    low, high = errors.of_sum(np.full(metres, 100.0), np.full(metres, _GRASS))
    held = np.mean(((100.0 * (1.0 + error)).sum(axis=1) >= low) & ((100.0 * (1.0 + error)).sum(axis=1) <= high))
    assert COVERAGE - 0.05 < held < COVERAGE + 0.09  # the correlation is never taken for less than was seen


def test_a_model_that_is_off_on_average_has_an_interval_beside_its_prediction():
    residuals = made_residuals(1000, sigma=0.01)
    residuals["power_watt"] = residuals["power_watt"] * 1.2
    low, high = errors_of(residuals)["energy"].of_sum(np.full(50, 100.0), np.full(50, _GRASS))
    assert low < 50 * 120.0 < high
    assert low > 50 * 110.0


def test_a_class_with_enough_held_out_samples_has_errors_of_its_own():
    residuals = made_residuals(400, sigma=0.01)
    residuals["terrain_class"] = np.where(np.arange(400) < 200, 4, 5)
    residuals["power_watt"] = np.where(
        residuals["terrain_class"] == 5, 150.0 + 6.0 * (residuals["power_watt"] - 150.0), residuals["power_watt"]
    )
    errors = errors_of(residuals)["energy"]
    ends = [errors.of_pieces(np.array([100.0]), np.array([number], np.uint8)) for number in (4, 5, 7)]
    grass, mud, other = ((high - low)[0] for low, high in ends)
    assert grass < other < mud


def test_pieces_without_a_cost_add_nothing():
    errors = errors_of(made_residuals(1000))["energy"]
    some = errors.of_sum(np.array([100.0, np.nan, 100.0]), np.full(3, _GRASS))
    assert np.isfinite(some).all()
    assert some[0] < 200.0 < some[1]


def test_too_few_held_out_samples_say_nothing():
    assert errors_of(made_residuals(19)) is None
