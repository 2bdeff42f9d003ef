"""Labels as the cost of the true metre, against drives whose true metre is known."""

import numpy as np
import pytest

from tcpipe.cost.labels import compute_labels, subtract_idle_power

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
    above = subtract_idle_power(got, standing_watt=90.0, standing_std_watt=2.0, **ends)
    beside = spent - (90 + other) * duration
    assert above["energy_above_standing_joule"][0] == pytest.approx(got.energy_joule[0] - 90 * end_s)
    assert above["energy_above_standing_std_joule"][0] == pytest.approx(beside.std(), rel=0.02)
    assert above["power_above_standing_std_watt"][0] == pytest.approx((beside / duration).std(), rel=0.02)
    assert above["energy_above_standing_joule"][0] == pytest.approx(
        above["power_above_standing_watt"][0] / got.velocity_mps[0]
    )


def test_without_energy_there_is_none_of_its_deviations():
    got = one(duration_s=1.0, energy_joule=np.nan, end_velocity_mps=1.0, end_power_watt=100.0, energy_noise_joule=1.0)
    assert np.isnan([got.power_watt[0], got.power_std_watt[0], got.energy_std_joule[0]]).all()
    assert got.duration_std_s[0] == pytest.approx(0.01)


@pytest.mark.parametrize(("standing_watt", "energy_joule"), [(np.nan, 200.0), (90.0, np.nan)])
def test_above_standing_is_not_known_where_either_is_not(standing_watt, energy_joule):
    ends = {"end_power_watt": np.array([150.0]), "energy_noise_joule": np.array([1.0])}
    cost = one(duration_s=1.2, energy_joule=energy_joule, end_velocity_mps=0.8, **ends)
    got = subtract_idle_power(cost, standing_watt=standing_watt, standing_std_watt=2.0, **ends)
    assert all(np.isnan(values[0]) for values in got.values())
