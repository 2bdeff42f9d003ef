"""The physics gives back the robot that was put in, bends to no minority, and says when it cannot tell."""

from dataclasses import replace

import numpy as np
import pytest
from skid_steered import NEWTON, RECOVERED, RESISTANCE, STANDING_WATT, TURNING, made

from tcpipe.cost.physics import ALL, fit_and_validate_physics, fit_physics, score_energies


def pooled(metres):
    return replace(metres, terrain=np.full(len(metres.rise), ALL))


def test_an_exact_robot_is_found_exactly():
    metres = made()
    found = fit_physics(metres, idle_watt=STANDING_WATT)
    for name, resistance in RESISTANCE.items():
        assert found.rolling_resistance(name)[0] == pytest.approx(resistance, rel=1e-5)
        assert found.of("turning", name)[0] == pytest.approx(TURNING[name], rel=1e-5)
    assert found.of("grade")[0] == pytest.approx(NEWTON, rel=1e-5)
    assert found.of("idle")[0] == pytest.approx(STANDING_WATT, rel=1e-4)
    assert found.recovered == pytest.approx(RECOVERED, rel=1e-4)
    np.testing.assert_allclose(found.power_watt(metres), metres.power_watt, atol=1e-2)
    np.testing.assert_allclose(found.parts_watt(metres).sum(axis=1), found.power_watt(metres), atol=1e-9)


def test_where_nobody_saw_it_stand_the_speeds_tell():
    found = fit_physics(made(), idle_watt=None)
    assert found.of("idle")[0] == pytest.approx(STANDING_WATT, rel=1e-4)
    steady = fit_physics(made(speeds=(0.8, 0.81)), idle_watt=None)
    assert steady.of("idle") is None
    assert steady.is_plausible()


@pytest.mark.parametrize("speeds", [(0.6, 1.0), (0.8, 0.81)])
@pytest.mark.parametrize("idle_watt", [STANDING_WATT, None])
def test_what_motors_take_on_any_grade_is_no_rolling(speeds, idle_watt):
    """14 W at halts, 80 N of motors and gears: where the slope begins to drive the robot tells them from rolling."""
    metres = made(1, drivetrain_newton=80.0, speeds=speeds)
    found = fit_physics(metres, idle_watt=idle_watt)
    unseen = 0.0 if found.of("idle") else STANDING_WATT / np.mean(speeds)  # at one speed a force as any other
    assert found.of("drivetrain")[0] == pytest.approx(80.0 + unseen, rel=0.01)
    near = 0.02 if unseen else 0.01  # as a force along the surface it is 14 W at one slope alone
    assert [found.rolling_resistance(name)[0] for name in RESISTANCE] == pytest.approx([*RESISTANCE.values()], rel=near)
    assert found.recovered == pytest.approx(RECOVERED, rel=near)
    np.testing.assert_allclose(found.power_watt(metres), metres.power_watt, atol=1.5 if unseen else 0.5)


def test_slopes_that_vary_within_a_metre_round_the_bend_and_move_nothing():
    """Means over pieces of each metre, 3 degrees rms apart: near the bend they lie above what the mean slope takes."""
    pieces = [made(3, 800, drivetrain_newton=80.0, steeper=by) for by in (-0.08, -0.05, -0.02, 0.0, 0.02, 0.05, 0.08)]
    power, rise = (np.mean([getattr(of, name) for of in pieces], axis=0) for name in ("power_watt", "rise"))
    found = fit_physics(replace(pieces[0], power_watt=power, rise=rise), idle_watt=STANDING_WATT)
    assert found.of("drivetrain")[0] == pytest.approx(80.0, rel=0.03)
    assert [found.rolling_resistance(name)[0] for name in RESISTANCE] == pytest.approx([*RESISTANCE.values()], rel=0.02)


def test_where_the_slope_never_drives_the_robot_rolling_holds_all_that_is_paid_always():
    metres = made(2, drivetrain_newton=80.0)
    found = fit_physics(metres.take(metres.rise > -0.1), idle_watt=STANDING_WATT)
    assert found.of("drivetrain") is None
    assert found.of("rolling", "grass")[0] == pytest.approx(80.0 + NEWTON * RESISTANCE["grass"], rel=1e-4)


@pytest.mark.parametrize("drivetrain_newton", [0.0, 80.0])
def test_standard_deviations_hold_what_noise_does(drivetrain_newton):
    """Over many drawings: of z = (found - true) / deviation about two thirds lie within one, and nearly all within three."""
    z = []
    for seed in range(40):
        metres = made(seed, 400, noise_watt=20.0, drivetrain_newton=drivetrain_newton)
        found = fit_physics(metres, idle_watt=STANDING_WATT)
        for name, resistance in RESISTANCE.items():
            turning, rolling = found.of("turning", name), found.rolling_resistance(name)
            z += [(turning[0] - TURNING[name]) / turning[1], (rolling[0] - resistance) / rolling[1]]
    assert 0.55 < np.mean(np.abs(z) < 1.0) < 0.8
    assert np.mean(np.abs(z) < 3.0) > 0.97


def test_odd_metres_bend_nothing():
    metres = made(5, 400, noise_watt=5.0)
    metres.power_watt[::20] += 400.0
    found = fit_physics(metres, idle_watt=STANDING_WATT)
    assert found.of("grade")[0] == pytest.approx(NEWTON, rel=0.02)
    expected = 400.0 * (np.arange(400) % 20 == 0)
    np.testing.assert_allclose(metres.power_watt - found.power_watt(metres), expected, atol=30.0)


def test_on_the_flat_grade_is_not_known_but_the_level_is():
    found = fit_physics(pooled(made(1, steepest=0.01, classes=("grass",))), idle_watt=STANDING_WATT)
    assert found.rolling_resistance() is None
    assert found.of("rolling")[0] == pytest.approx(NEWTON * RESISTANCE["grass"], rel=0.01)


def test_a_class_of_few_metres_has_the_coefficients_of_all_the_rest():
    metres = made(2)
    metres.terrain[:10] = "mud"
    found = fit_physics(metres, idle_watt=STANDING_WATT)
    assert ("rolling", "mud") not in found.terms
    assert found.of("rolling", "mud") == found.of("rolling", ALL)
    assert np.isfinite(found.power_watt(metres)).all()


def test_a_class_driven_straight_says_nothing_of_what_turning_on_it_takes():
    """Forty metres of mud that hardly turn, whose resistance changes half-way: their hair of a turn would explain the change."""
    metres = made(2)
    metres.terrain[:40] = "mud"
    metres.mean_abs_yaw_rate_radps[:40] = np.linspace(0.0, 0.02, 40)
    metres.power_watt[20:40] += 60.0
    found = fit_physics(metres, idle_watt=STANDING_WATT)
    assert {name for term, name in found.terms if term == "turning"} == {"grass", "paved"}
    turned = replace(metres.take(np.arange(40)), mean_abs_yaw_rate_radps=np.full(40, 0.3))
    assert np.abs(found.power_watt(turned) - turned.power_watt).max() < 250.0


def test_without_steep_descents_nothing_is_said_of_what_comes_back():
    metres = made(2)
    found = fit_physics(metres.take(metres.rise > -0.1), idle_watt=STANDING_WATT)
    assert found.recovered == 0.0
    assert found.rolling_resistance("grass")[0] == pytest.approx(RESISTANCE["grass"], rel=1e-4)


def test_without_turn_rates_there_is_no_term_of_turning():
    metres = replace(made(), mean_abs_yaw_rate_radps=np.full(400, np.nan))
    assert {term for term, _ in fit_physics(metres, idle_watt=STANDING_WATT).terms} == {"idle", "rolling", "grade"}


def test_too_few_metres_give_no_fit_and_no_robot_no_plausible_one():
    metres = made()
    assert fit_physics(metres.take(np.arange(19)), idle_watt=STANDING_WATT) is None
    assert fit_physics(replace(metres, power_watt=np.full(400, np.nan)), idle_watt=STANDING_WATT) is None
    assert not fit_physics(pooled(replace(metres, rise=-metres.rise)), idle_watt=STANDING_WATT).is_plausible()


def test_shares_and_scores_of_an_exact_robot():
    metres = made(7, 500)
    fit = fit_and_validate_physics(metres, idle_watt=STANDING_WATT)
    assert sum(fit.energy_share.values()) == pytest.approx(1.0, abs=1e-4)
    energy = metres.power_watt / metres.velocity_mps
    assert fit.energy_share["idle"] == pytest.approx((14.0 / metres.velocity_mps).sum() / energy.sum(), rel=1e-3)
    assert fit.held_out.r2 == pytest.approx(1.0, abs=1e-6)
    assert fit.held_out.mape < 1e-2
    assert fit.mean_turn_radpm == pytest.approx((metres.mean_abs_yaw_rate_radps / metres.velocity_mps).mean())


def test_a_metre_that_takes_nearly_nothing_is_in_no_percentage():
    true = np.array([100.0, 200.0, 0.01, -0.5])
    assert score_energies(true, true + np.array([10.0, -10.0, 50.0, 50.0])).mape == pytest.approx(0.075)
    assert score_energies(true[2:], true[2:] + np.array([0.01, 0.5])).mape == pytest.approx(1.0), "all there is"
