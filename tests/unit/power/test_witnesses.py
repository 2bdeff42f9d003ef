"""Witnesses of electric power on synthetic segments and messages whose scale is known."""

import numpy as np
import pytest

from tcpipe.power.witnesses import (
    compare_batteries,
    compare_charge,
    compare_meters,
    compute_side_share,
    compute_weight_ratio,
    estimate_climb,
)
from tcpipe.tables.findings import Subject, make_finding

MASS_KG = 70.0
GRAVITY_MPS2 = 9.80665


def drive_over_hills(count=200, *, scale=1.0, efficiency=0.6, height_noise_m=0.0, seed=1):
    """Return segments of a robot that climbs at an efficiency, as arguments of `estimate_climb`."""
    rng = np.random.default_rng(seed)
    rise = 0.12 * np.sin(np.arange(count + 1) / 7.0)
    speed = 0.9 - 0.5 * np.abs(rise[:-1]) + 0.01 * rng.standard_normal(count)
    turn = np.abs(0.05 * rng.standard_normal(count))
    slope = rise[:-1] / np.hypot(1.0, rise[:-1])
    watt = 14.0 + 110.0 * speed + MASS_KG * GRAVITY_MPS2 * slope * speed / efficiency + 40.0 * turn
    noise = height_noise_m * rng.standard_normal(count + 1)
    return {
        "power_watt": scale * (watt + 4.0 * rng.standard_normal(count)),
        "velocity_mps": speed,
        "rise": rise[:-1] + np.diff(noise),
        "mean_abs_yaw_rate_radps": turn,
        "piece": np.zeros(count, np.int64),
        "mass_kg": MASS_KG,
    }


def judge(climb):
    if not climb.is_certain():
        return "unconfirmed"
    return "confirmed" if 0.4 < climb.factor < 5.6 else "contradicted"


@pytest.mark.parametrize("seed", range(4))
def test_climbing_shows_the_efficiency(seed):
    climb = estimate_climb(**drive_over_hills(seed=seed))
    assert abs(climb.factor - 1.0 / 0.6) < 3.0 * climb.std
    assert judge(climb) == "confirmed"


@pytest.mark.parametrize("scale", [0.01, 0.1, 10.0, 100.0])
def test_a_wrong_unit_is_contradicted_by_slopes(scale):
    assert judge(estimate_climb(**drive_over_hills(scale=scale))) == "contradicted"


def test_noise_of_heights_does_not_reduce_the_factor():
    """Plain least squares would: noise of 4 cm at both ends of a metre halves its coefficient."""
    noisy = drive_over_hills(800, height_noise_m=0.04)
    climb = estimate_climb(**noisy)
    assert abs(climb.factor - 1.0 / 0.6) < 3.0 * climb.std
    design = np.column_stack([np.ones(800), noisy["velocity_mps"], noisy["rise"] * noisy["velocity_mps"]])
    plain = np.linalg.lstsq(design, noisy["power_watt"], rcond=None)[0][2] / (MASS_KG * GRAVITY_MPS2)
    assert plain < 0.8 / 0.6


def test_level_ground_shows_nothing():
    flat = drive_over_hills()
    flat["rise"] = 0.005 * np.random.default_rng(3).standard_normal(200)
    assert judge(estimate_climb(**flat)) == "unconfirmed"
    flat["rise"] = np.zeros(200)
    assert estimate_climb(**flat) is None
    assert estimate_climb(**drive_over_hills(15)) is None


def test_the_instrument_stays_in_its_piece():
    """A slope before a gap is no instrument behind it: pieces of two segments have none."""
    cut = drive_over_hills(60)
    cut["piece"] = np.arange(60) // 2
    assert estimate_climb(**cut) is None


def test_energy_of_level_ground_over_the_weight():
    net_jpm = np.concatenate((np.full(30, 150.0), np.full(30, 900.0)))
    rise = np.concatenate((np.zeros(30), np.full(30, 0.2)))
    assert compute_weight_ratio(net_jpm, rise, 50.0) == pytest.approx(150.0 / (50.0 * GRAVITY_MPS2))
    assert compute_weight_ratio(net_jpm[:10], rise[:10], 50.0) is None


def test_charge_that_falls_by_the_integral_of_the_current():
    time_s = np.arange(0.0, 3600.0)
    current_amp, charge_ah = np.full(3600, 2.0), 20.0 - 2.0 * time_s / 3600.0
    assert compare_charge(time_s, current_amp, charge_ah) == pytest.approx(1.0, rel=1e-3)
    assert compare_charge(time_s, 10.0 * current_amp, charge_ah) == pytest.approx(10.0, rel=1e-3)
    assert compare_charge(time_s, current_amp, np.full(3600, 20.0)) is None  # nothing fell
    assert compare_charge(time_s, current_amp, np.full(3600, np.nan)) is None


def test_a_second_meter_with_a_constant_load():
    drive_watt = 100.0 + 50.0 * np.sin(np.arange(200) / 5.0)
    slope, correlation = compare_meters(drive_watt, 1.1 * drive_watt + 60.0)
    assert (slope, correlation) == (pytest.approx(1.1), pytest.approx(1.0))
    assert compare_meters(drive_watt, np.full(200, 60.0)) is None


def test_share_of_a_side_in_straight_driving():
    straight = np.arange(100) % 2 == 0
    left, right = np.where(straight, 3.0, -20.0), np.where(straight, 5.0, 40.0)
    assert compute_side_share(left, right, straight) == pytest.approx(0.375)
    assert compute_side_share(np.zeros(100), right, straight) == 0.0
    assert compute_side_share(left[:20], right[:20], straight[:20]) is None


def run(run_id, ohm, robot="husky"):
    names = {"witnesses": "nothing"}
    return run_id, robot, [make_finding("label-witnesses", Subject("label", "energy"), names=names, battery_ohm=ohm)]


def test_runs_of_one_robot_whose_battery_differs():
    assert list(compare_batteries([run("a", 0.040), run("b", 0.045), run("c", 0.052)])) == []
    (found,) = compare_batteries([run("a", 0.040), run("b", 0.0042), run("c", 0.045), run("d", 0.3, "warthog")])
    assert (found.subject.name, found.severity) == ("b", "error")
    both = list(compare_batteries([run("a", 0.040), run("b", 0.012)]))
    assert [(each.subject.name, each.severity) for each in both] == [("a", "warning"), ("b", "warning")]
