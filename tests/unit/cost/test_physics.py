"""The physics baseline gives back the robot that was put in, bends to no minority, and says when it cannot tell."""

import numpy as np
import pytest

from tcpipe.cost.physics import fit_physics

NEWTON, ROLLING, RECOVERED, STANDING_WATT = 953.4, 0.16, 0.40, 14.0


def made(seed=0, count=400, noise_watt=0.0, steepest=0.35):
    """Power of metres driven at 0.7 to 1 m/s over slopes, computed from force times speed."""
    rng = np.random.default_rng(seed)
    rise, speed = rng.uniform(-steepest, steepest, count), rng.uniform(0.7, 1.0, count)
    work = NEWTON * (ROLLING * np.cos(np.arctan(rise)) + np.sin(np.arctan(rise))) * speed / np.cos(np.arctan(rise))
    power = STANDING_WATT + np.where(work > 0, work, RECOVERED * work) + noise_watt * rng.standard_normal(count)
    return {"power_watt": power, "velocity_mps": speed, "rise": rise}


def test_an_exact_robot_is_found_exactly():
    found = fit_physics(**made(), standing_watt=STANDING_WATT)
    assert found.drive_newton == pytest.approx(NEWTON, rel=1e-6)
    assert found.rolling_resistance == pytest.approx(ROLLING, rel=1e-6)
    assert found.recovered == pytest.approx(RECOVERED, rel=1e-6)
    labels = made()
    predicted = found.power_watt(velocity_mps=labels["velocity_mps"], rise=labels["rise"])
    np.testing.assert_allclose(predicted, labels["power_watt"], atol=1e-4)


def test_noise_averages_out_and_its_size_is_told():
    found = fit_physics(**made(3, 2000, noise_watt=20.0), standing_watt=STANDING_WATT)
    assert found.drive_newton == pytest.approx(NEWTON, rel=0.02)
    assert found.rolling_resistance == pytest.approx(ROLLING, rel=0.03)
    assert found.recovered == pytest.approx(RECOVERED, abs=0.05)
    assert found.residual_watt == pytest.approx(20.0, rel=0.06)


def test_odd_metres_bend_nothing_and_are_found():
    labels = made(5, 400, noise_watt=5.0)
    labels["power_watt"][::20] += 400.0
    found = fit_physics(**labels, standing_watt=STANDING_WATT)
    assert found.drive_newton == pytest.approx(NEWTON, rel=0.02)
    residual = labels["power_watt"] - found.power_watt(velocity_mps=labels["velocity_mps"], rise=labels["rise"])
    np.testing.assert_array_equal(np.flatnonzero(found.is_outlier(residual)), np.arange(0, 400, 20))


def test_on_the_flat_grade_is_not_known_but_the_level_is():
    found = fit_physics(**made(1, steepest=0.01), standing_watt=STANDING_WATT)
    assert found.rolling_resistance is None
    assert found.rolling_newton == pytest.approx(NEWTON * ROLLING, rel=0.01)


def test_without_steep_descents_nothing_is_said_of_what_comes_back():
    labels = made(2)
    uphill = labels["rise"] > -0.1
    found = fit_physics(**{name: values[uphill] for name, values in labels.items()}, standing_watt=STANDING_WATT)
    assert found.recovered == 0.0
    assert found.rolling_resistance == pytest.approx(ROLLING, rel=1e-6)


def test_too_few_metres_and_no_robot_give_no_fit():
    few = {name: values[:19] for name, values in made().items()}
    assert fit_physics(**few, standing_watt=0.0) is None
    unknown = {**made(), "power_watt": np.full(400, np.nan)}
    assert fit_physics(**unknown, standing_watt=0.0) is None
    downhill_costs = {**made(), "rise": -made()["rise"]}
    assert fit_physics(**downhill_costs, standing_watt=0.0) is None
