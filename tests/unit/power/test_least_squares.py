"""Non-negative least squares against scipy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from tcpipe.power import noise as energy_noise
from tcpipe.power.least_squares import solve_non_negative


@given(st.integers(0, 2**32), st.integers(1, 10), st.floats(0.0, 1.0), st.booleans())
def test_as_scipy_of_what_a_signal_is_made_of(seed, spacings, noise, averaged):
    draw = np.random.default_rng(seed)
    period_s = draw.choice([0.02, 0.1, 1.0])
    spacing = np.array(energy_noise._SPACINGS[:spacings])
    taus = [*((tau, False) for tau in energy_noise._ROUGH_TAU), *((tau, True) for tau in energy_noise._SMOOTH_TAU)]
    made = np.stack(
        [
            energy_noise._predict_second_differences(spacing, period_s, tau * period_s, smooth=s, averaged=averaged)
            for tau, s in taus
        ]
    )
    size = np.where(draw.random(len(taus)) < 0.3, draw.exponential(size=len(taus)), 0.0)
    seen = np.abs(size @ made * (1.0 + noise * draw.normal(size=spacings))) + 1e-6
    weight = np.sqrt(draw.integers(20, 5000, spacings)) / seen
    matrix, wanted = (made * weight).T, seen * weight
    theirs, residual = nnls(matrix, wanted)
    ours = solve_non_negative(matrix, wanted)
    assert ours.min() >= 0.0
    assert np.linalg.norm(matrix @ ours - wanted) == pytest.approx(residual, rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-8 * theirs.max(initial=1.0))


@given(st.integers(0, 2**32), st.integers(1, 12), st.integers(1, 8))
def test_as_near_as_scipy_of_anything(seed, rows, columns):
    draw = np.random.default_rng(seed)
    made, seen = draw.normal(size=(rows, columns)), draw.normal(size=rows)
    found = solve_non_negative(made, seen)
    assert found.min() >= 0.0
    assert np.linalg.norm(made @ found - seen) == pytest.approx(nnls(made, seen)[1], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("made", "seen", "size"),
    [
        ([[1, 0], [1, 0], [0, 1]], [2, 1, 1], [1.5, 1]),
        ([[1, 0], [1, 0], [0, 1]], [-1, -1, -1], [0, 0]),
        ([[1, 1], [1, 1]], [1, 1], [1, 0]),  # two that are the same: the first
        ([[0, 0], [0, 0]], [1, 1], [0, 0]),
    ],
)
def test_by_hand(made, seen, size):
    np.testing.assert_allclose(solve_non_negative(np.array(made, float), np.array(seen, float)), size, atol=1e-12)
