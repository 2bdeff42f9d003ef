"""Curves by class: against means and bent lines; a class with few samples stays near all ground."""

import numpy as np
import pytest

from tcpipe.learning.physics_model import fit_curves

MANY = 3000


def ground(seed=0, count=MANY, classes=(4, 6)):
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.3, 0.3, count), rng.choice(classes, count)


def test_straight_thirds_find_a_bent_line_of_each_class():
    slope, class_id = ground()
    bend = np.quantile(slope, 1 / 3)
    power = np.where(
        class_id == 4, 100.0 + 300.0 * slope, 150.0 + 200.0 * slope + 500.0 * np.maximum(slope - bend, 0.0)
    )
    curves = fit_curves(slope, class_id, power[:, None])
    assert curves.own.shape == (2, 4, 1)
    at = np.array([-0.2, 0.2, 0.4])
    assert curves.predict(at, np.full(3, 4))[:, 0] == pytest.approx(100.0 + 300.0 * at, rel=5e-3)
    bent = 150.0 + 200.0 * at + 500.0 * np.maximum(at - bend, 0.0)
    assert curves.predict(at, np.full(3, 6))[:, 0] == pytest.approx(bent, rel=1e-2)


def test_three_samples_of_a_class_shift_its_curve_and_do_not_bend_it():
    rng = np.random.default_rng(1)
    slope, class_id = ground()
    power = 100.0 + 300.0 * slope + rng.normal(0.0, 5.0, MANY)
    few = np.array([0.0, 0.01, 0.02])
    curves = fit_curves(
        np.append(slope, few), np.append(class_id, [5, 5, 5]), np.append(power, 130.0 + 300.0 * few)[:, None]
    )
    at = np.array([-0.25, 0.0, 0.25])
    said = curves.predict(at, np.full(3, 5))[:, 0] - (100.0 + 300.0 * at)
    assert 2.0 < said[1] < 30.0
    assert np.abs(said).max() < 40.0
