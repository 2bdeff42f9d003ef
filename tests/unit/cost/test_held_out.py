"""What is held out is predicted by the rest; turning is worth what a drive without it lacks."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from skid_steered import STANDING_WATT, made

from tcpipe.cost.physics import _HeldOut, _score, fit_and_validate_physics


def test_shares_and_scores_of_an_exact_robot():
    metres = made(7, 500)
    fit = fit_and_validate_physics(metres, standing_watt=STANDING_WATT)
    assert sum(fit.energy_share.values()) == pytest.approx(1.0, abs=1e-4)
    energy = metres.power_watt / metres.velocity_mps
    assert fit.energy_share["standing"] == pytest.approx((14.0 / metres.velocity_mps).sum() / energy.sum(), rel=1e-3)
    assert fit.held_out.r2 == pytest.approx(1.0, abs=1e-6)
    assert fit.held_out.mape < 1e-2
    assert fit.without_turning.r2 < 0.99
    assert fit.usual_turn_radpm == pytest.approx((metres.turn_rate_radps / metres.velocity_mps).mean())
    low, high = fit.gain_of_turning
    assert low < 1.0 - fit.without_turning.r2 < high


def test_where_turning_costs_nothing_it_is_worth_nothing():
    metres = made(8, 500, noise_watt=15.0)
    fit = fit_and_validate_physics(
        replace(metres, turn_rate_radps=np.random.default_rng(1).uniform(0, 0.4, 500)), standing_watt=STANDING_WATT
    )
    low, high = fit.gain_of_turning
    assert low < 0.01
    assert abs(high) < 0.05


def test_a_metre_that_takes_nearly_nothing_is_in_no_percentage():
    true = np.array([100.0, 200.0, 0.01, -0.5])
    assert _score(_HeldOut(true, true + np.array([10.0, -10.0, 50.0, 50.0]))).mape == pytest.approx(0.075)
    assert _score(_HeldOut(true[2:], true[2:] + np.array([0.01, 0.5]))).mape == pytest.approx(1.0), "all there is"


def test_no_metres_no_fit():
    metres = made(9, 19)
    assert fit_and_validate_physics(metres, standing_watt=STANDING_WATT) is None
    assert fit_and_validate_physics(metres.take(np.arange(0)), standing_watt=STANDING_WATT) is None


def test_many_metres_are_not_drawn_all_at_once():
    metres = made(10, 2000)
    tracemalloc.start()
    fit_and_validate_physics(metres, standing_watt=STANDING_WATT)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 2000 * 2000, "3.2 kB a metre are 6 GB of two million"
