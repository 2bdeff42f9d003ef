"""Fields of waves: one sum whichever way it is computed, and states that are spread evenly."""

import numpy as np
import pytest

from tcpipe.simulation.world import draw_waves, evaluate_field, state, sum_waves


def test_rows_and_columns_are_a_product_of_matrices_with_the_same_values():
    made = draw_waves(5, count=7, total=0.3, wavelength_m=(0.5, 9.0))
    u, v = np.arange(0.0, 20.0, 0.7)[None, :], np.arange(0.0, 9.0, 0.9)[:, None]
    points = (values.ravel() for values in np.broadcast_arrays(u, v))
    grid = evaluate_field(made, u, v)
    np.testing.assert_allclose(grid, sum_waves(made, u, v), atol=1e-12)
    np.testing.assert_allclose(grid.ravel(), evaluate_field(made, *points), atol=1e-12)


def test_a_state_is_spread_evenly_between_its_ends():
    made = draw_waves(6, count=40, total=1.0, wavelength_m=(1.0, 5.0))
    rng = np.random.default_rng(0)
    values = state(made, rng.uniform(0, 2000, 20000), rng.uniform(0, 2000, 20000))
    quantiles = np.quantile(values, [0.1, 0.25, 0.5, 0.75, 0.9])
    assert quantiles == pytest.approx([-0.8, -0.5, 0.0, 0.5, 0.8], abs=0.06)
