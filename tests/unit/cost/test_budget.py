"""The error budget: shares add in square, and several runs pool as one."""

from dataclasses import asdict

import numpy as np
import pytest

from tcpipe.cost.labels import CAUSES, estimate_energy_budget, find_noise, format_budget, pool_budgets
from tcpipe.tables.findings import Subject


def made(rng, count):
    energy = rng.uniform(100, 300, count)
    causes = {cause: rng.uniform(0, 9, count) for cause in CAUSES}
    return energy, {**causes, "at_20_hz": causes["position"] + 1.0}


def test_shares_of_hand_made_variances():
    energy = np.array([90.0, np.nan, 110.0])
    variance = dict(zip(CAUSES, np.array([[4.0], [9.0], [2.0], [1.0]]) * np.ones(3), strict=True))
    got = estimate_energy_budget(energy, {**variance, "at_20_hz": np.full(3, 5.0)})
    assert got.segments == 2
    assert (got.position, got.rate, got.total) == pytest.approx((0.02, 0.03, 0.04))
    text = format_budget(got)
    assert text.startswith(
        "Noise floor of E 4.0 % of a segment's mean 100 J: power rate 3.0, position 2.0, current noise 1.4, voltage 1.0"
    )
    assert text.endswith("power at 20 Hz would leave 2.2 %.")


@pytest.mark.parametrize(("watt_factor", "noisy"), [(1.0, False), (1.6, True)])
def test_a_high_noise_floor_is_a_finding_with_its_causes(watt_factor, noisy):
    variance = dict(zip(CAUSES, watt_factor * np.array([[4.0], [9.0], [2.0], [1.0]]) * np.ones(2), strict=True))
    budget = estimate_energy_budget(np.array([90.0, 110.0]), {**variance, "at_20_hz": np.full(2, 5.0)})
    found = find_noise(budget, Subject("role", "power"))
    assert [of.code for of in found] == ["energy-noise"] * noisy
    assert all(of.numbers["rate_fraction"] == budget.rate for of in found)
    assert find_noise(None, Subject("role", "power")) == ()


def test_runs_pool_as_one():
    rng = np.random.default_rng(0)
    one, two = made(rng, 40), made(rng, 7)
    together = estimate_energy_budget(
        np.concatenate((one[0], two[0])), {name: np.concatenate((one[1][name], two[1][name])) for name in one[1]}
    )
    got = pool_budgets([estimate_energy_budget(*one), estimate_energy_budget(*two)])
    assert asdict(got) == pytest.approx(asdict(together))


def test_without_energy_there_is_no_budget():
    assert estimate_energy_budget(np.full(3, np.nan), {cause: np.ones(3) for cause in CAUSES}) is None
    assert pool_budgets([]) is None
