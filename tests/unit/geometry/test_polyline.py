"""The Hermite path against curves whose lengths and chords are known in closed form."""

import numpy as np
import pytest
from made_tracks import stamps
from scipy.interpolate import CubicHermiteSpline

from tcpipe.geometry.polyline import fit_polyline


def test_positions_are_those_of_scipys_hermite_spline():
    rng = np.random.default_rng(1)
    stamp_ns = np.cumsum(rng.integers(30_000_000, 70_000_000, 30)) + 1_700_000_000_000_000_000
    position, velocity = rng.normal(0, 3, (30, 3)), rng.normal(0, 1, (30, 3))
    path = fit_polyline(stamp_ns, position, velocity)
    at_ns = np.sort(rng.integers(stamp_ns[0], stamp_ns[-1], 500))
    spline = CubicHermiteSpline((stamp_ns - stamp_ns[0]) * 1e-9, position, velocity)
    np.testing.assert_allclose(path.position_at(at_ns), spline((at_ns - stamp_ns[0]) * 1e-9), atol=1e-12)
    assert np.array_equal(path.position_at(stamp_ns), position)


def test_touching_the_circle_is_no_crossing_and_leaving_it_is():
    # Out along x to a turning point at exactly 1 m, back, and out again further: the parabola x = 1 - (t - 1)² touches 1 m at t = 1 s.
    t = np.arange(0, 5, 0.05)
    x = np.where(t < 2, 1 - (t - 1) ** 2, 2 * (t - 2))
    vx = np.where(t < 2, -2 * (t - 1), 2.0)
    zero = 0 * t
    path = fit_polyline(stamps(len(t)), np.column_stack((x, zero, zero)), np.column_stack((vx, zero, zero)))
    end = path.first_crossing_ns(int(path.stamp_ns[0]), radius_m=1.0 + 1e-9)
    assert (end - path.stamp_ns[0]) * 1e-9 == pytest.approx(2.5, abs=1e-6)
