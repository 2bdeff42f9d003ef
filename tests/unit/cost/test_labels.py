"""Labels as the cost of the true metre, against drives whose true metre is known."""

from dataclasses import asdict

import numpy as np
import pytest

from tcpipe.cost.labels import (
    compute_labels,
    estimate_energy_budget,
    find_noise,
    has_low_power_rate,
    pool_budgets,
    subtract_idle_power,
    touches_voltage_outside,
)
from tcpipe.formats.finding_lines import format_budget
from tcpipe.power.rails import make_rail, make_samples
from tcpipe.tables.facts import CAUSES
from tcpipe.tables.findings import Subject

EXACT = {"chord_m": 1.0, "displacement_std_m": 0.01, "energy_noise_joule": 0.0}


def one(**values):
    return compute_labels(
        **{name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in (EXACT | values).items()}
    )


def test_identities():
    got = one(
        duration_s=1.25, energy_joule=200.0, end_velocity_mps=0.8, end_power_watt=170.0, displacement_std_m=0.0,
        energy_noise_joule=3.0,
    )  # fmt: skip
    assert got.velocity_mps[0] == 0.8
    assert got.power_watt[0] == 160.0
    assert got.duration_s[0] == pytest.approx(1.0 / got.velocity_mps[0])
    assert got.energy_joule[0] == pytest.approx(got.power_watt[0] / got.velocity_mps[0])
    assert (got.duration_std_s[0], got.velocity_std_mps[0]) == (0.0, 0.0)
    assert got.energy_std_joule[0] == 3.0
    assert got.power_std_watt[0] == pytest.approx(3.0 / 1.25)


def test_deviations_are_those_of_many_estimated_metres():
    # Speed and power change along the metre; the estimated end is off by e, so the segment covers 1 + e true metres, and
    # what standing takes is off by f.
    rng = np.random.default_rng(1)
    error, other = rng.normal(0, 0.01, 100_000), rng.normal(0, 2.0, 100_000)
    t = np.linspace(0, 2, 20_001)
    speed, power = 0.7 + 0.2 * t, 150 + 60 * t
    way, energy = (np.concatenate(([0], np.cumsum(0.5 * (x[1:] + x[:-1]) * t[1]))) for x in (speed, power))
    duration = np.interp(1 + error, way, t)
    spent = np.interp(duration, t, energy)
    end_s = np.interp(1.0, way, t)
    ends = {"end_power_watt": np.interp([end_s], t, power), "energy_noise_joule": np.array([0.0])}
    got = one(duration_s=end_s, energy_joule=np.interp(end_s, t, energy), end_velocity_mps=0.7 + 0.2 * end_s, **ends)
    assert got.duration_std_s[0] == pytest.approx(duration.std(), rel=0.01)
    assert got.velocity_std_mps[0] == pytest.approx((1 / duration).std(), rel=0.02)
    assert got.energy_std_joule[0] == pytest.approx(spent.std(), rel=0.01)
    assert got.power_std_watt[0] == pytest.approx((spent / duration).std(), rel=0.03)
    above = subtract_idle_power(got, idle_watt=90.0, idle_std_watt=2.0, **ends)
    beside = spent - (90 + other) * duration
    assert above["net_energy_joule"][0] == pytest.approx(got.energy_joule[0] - 90 * end_s)
    assert above["net_energy_std_joule"][0] == pytest.approx(beside.std(), rel=0.02)
    assert above["net_power_std_watt"][0] == pytest.approx((beside / duration).std(), rel=0.02)
    assert above["net_energy_joule"][0] == pytest.approx(above["net_power_watt"][0] / got.velocity_mps[0])


def test_without_energy_there_is_none_of_its_deviations():
    got = one(duration_s=1.0, energy_joule=np.nan, end_velocity_mps=1.0, end_power_watt=100.0, energy_noise_joule=1.0)
    assert np.isnan([got.power_watt[0], got.power_std_watt[0], got.energy_std_joule[0]]).all()
    assert got.duration_std_s[0] == pytest.approx(0.01)


@pytest.mark.parametrize(("idle_watt", "energy_joule"), [(np.nan, 200.0), (90.0, np.nan)])
def test_net_energy_is_not_known_where_either_is_not(idle_watt, energy_joule):
    ends = {"end_power_watt": np.array([150.0]), "energy_noise_joule": np.array([1.0])}
    cost = one(duration_s=1.2, energy_joule=energy_joule, end_velocity_mps=0.8, **ends)
    got = subtract_idle_power(cost, idle_watt=idle_watt, idle_std_watt=2.0, **ends)
    assert all(np.isnan(values[0]) for values in got.values())


def made(rng, count):
    energy = rng.uniform(100, 300, count)
    causes = {cause: rng.uniform(0, 9, count) for cause in CAUSES}
    return energy, {**causes, "at_20_hz": causes["position"] + 1.0, "common": causes["rate"]}


def test_shares_of_hand_made_variances():
    energy = np.array([90.0, np.nan, 110.0])
    variance = dict(zip(CAUSES, np.array([[4.0], [9.0], [2.0], [1.0]]) * np.ones(3), strict=True))
    got = estimate_energy_budget(energy, {**variance, "at_20_hz": np.full(3, 5.0), "common": np.zeros(3)})
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
    budget = estimate_energy_budget(
        np.array([90.0, 110.0]), {**variance, "at_20_hz": np.full(2, 5.0), "common": np.zeros(2)}
    )
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


@pytest.mark.parametrize(("volt", "outside"), [(19.9, True), (20.0, False), (30.0, False), (30.1, True)])
def test_a_voltage_below_or_above_the_range_is_outside_and_the_ends_are_not(volt, outside):
    at = 1_000_000_000 * np.arange(5)
    made = make_rail(
        "drive",
        make_samples(at, np.array([24.0, 24.0, volt, 24.0, 24.0])),
        make_samples(at, np.zeros(5)),
        averaged=False,
    )
    found = touches_voltage_outside([made], at[1:2] + 500_000_000, at[2:3] + 500_000_000, range_volt=(20.0, 30.0))
    assert found.tolist() == [outside]


@pytest.mark.parametrize(
    ("current_hz", "voltage_hz", "swing_volt", "slow"),
    [(20, 20, 2.0, False), (20, 1, 0.1, False), (20, 1, 1.0, True), (5, 20, 0.1, True), (5, 1, 0.1, True)],
)
def test_the_rate_is_that_of_the_current_and_of_a_voltage_that_varies(current_hz, voltage_hz, swing_volt, slow):
    def sampled(hz, values):
        return make_samples((np.arange(30 * hz) * (1_000_000_000 // hz)).astype(np.int64), values(np.arange(30 * hz)))

    voltage = sampled(voltage_hz, lambda i: 24.0 + swing_volt * (i % 2))
    made = make_rail("drive", voltage, sampled(current_hz, lambda i: 5.0 + i % 3), averaged=False)
    assert has_low_power_rate([made]) is slow
