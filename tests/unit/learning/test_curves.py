"""Curves by class: against means, scipy's splines and lines drawn by hand; few samples lean on all others."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

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
    curves = fit_curves("linear", slope, class_id, power[:, None])
    assert curves.own.shape == (2, 4, 1)
    at = np.array([-0.2, 0.2, 0.4])
    assert curves.predict(at, np.full(3, 4))[:, 0] == pytest.approx(100.0 + 300.0 * at, rel=5e-3)
    bent = 150.0 + 200.0 * at + 500.0 * np.maximum(at - bend, 0.0)
    assert curves.predict(at, np.full(3, 6))[:, 0] == pytest.approx(bent, rel=1e-2)


def test_the_spline_is_scipys_natural_one():
    """Between its knots a natural spline of those values is reproduced; beyond them it is straight."""
    slope, class_id = ground(classes=(4,))
    knots = np.unique(np.quantile(slope, (0.05, 0.23, 0.41, 0.59, 0.77, 0.95)))
    drawn = CubicSpline(knots, [3.0, 1.0, 2.0, 5.0, 4.0, 7.0], bc_type="natural")
    inner = (slope >= knots[0]) & (slope <= knots[-1])
    ends = drawn(knots[[0, -1]]), drawn(knots[[0, -1]], 1)
    beyond = np.where(
        slope < knots[0], ends[0][0] + ends[1][0] * (slope - knots[0]), ends[0][1] + ends[1][1] * (slope - knots[-1])
    )
    curves = fit_curves("spline", slope, class_id, np.where(inner, drawn(slope), beyond)[:, None])
    at = np.linspace(knots[0], knots[-1], 50)
    assert curves.predict(at, np.full(50, 4))[:, 0] == pytest.approx(drawn(at), abs=1e-6)
    far = curves.predict(np.array([0.4, 0.5, 0.6]), np.full(3, 4))[:, 0]
    assert np.diff(far, 2) == pytest.approx(0.0, abs=1e-6)


def test_three_samples_of_a_class_shift_its_curve_and_do_not_bend_it():
    rng = np.random.default_rng(1)
    slope, class_id = ground()
    power = 100.0 + 300.0 * slope + rng.normal(0.0, 5.0, MANY)
    few = np.array([0.0, 0.01, 0.02])
    curves = fit_curves(
        "spline", np.append(slope, few), np.append(class_id, [5, 5, 5]), np.append(power, 130.0 + 300.0 * few)[:, None]
    )
    at = np.array([-0.25, 0.0, 0.25])
    said = curves.predict(at, np.full(3, 5))[:, 0] - (100.0 + 300.0 * at)
    assert 2.0 < said[1] < 30.0
    assert np.abs(said).max() < 40.0


@pytest.mark.parametrize("form", ["mean", "linear", "spline"])
def test_flat_ground_and_equal_labels_are_their_value(form):
    curves = fit_curves(form, np.zeros(40), np.full(40, 4), np.full((40, 2), 7.0))
    assert curves.predict(np.array([0.0, 0.1]), np.array([4, 9])) == pytest.approx(np.full((2, 2), 7.0))


def test_a_single_sample():
    curves = fit_curves("spline", np.array([0.1]), np.array([4]), np.array([[120.0]]))
    assert curves.predict(np.array([0.1, -0.2]), np.array([4, 4]))[:, 0] == pytest.approx(120.0)
