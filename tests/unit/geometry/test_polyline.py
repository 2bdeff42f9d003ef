"""The Hermite path against curves whose lengths and chords are known in closed form."""

import numpy as np
import pytest
from made_tracks import stamps
from scipy.interpolate import CubicHermiteSpline

from tcpipe.geometry.polyline import fit_polyline


def circle(radius_m, speed_mps, count):
    t = np.arange(count) * 0.05
    angle = speed_mps * t / radius_m
    position = np.column_stack((radius_m * np.cos(angle), radius_m * np.sin(angle), 0 * t))
    velocity = speed_mps * np.column_stack((-np.sin(angle), np.cos(angle), 0 * t))
    return fit_polyline(stamps(count), position, velocity)


def hill(slope_rad, speed_mps, count):
    along = speed_mps * 0.05 * np.arange(count)
    direction = np.array([0.6 * np.cos(slope_rad), 0.8 * np.cos(slope_rad), np.sin(slope_rad)])
    return fit_polyline(stamps(count), along[:, None] * direction, np.tile(speed_mps * direction, (count, 1)))


def test_positions_are_those_of_scipys_hermite_spline():
    rng = np.random.default_rng(1)
    stamp_ns = np.cumsum(rng.integers(30_000_000, 70_000_000, 30)) + 1_700_000_000_000_000_000
    position, velocity = rng.normal(0, 3, (30, 3)), rng.normal(0, 1, (30, 3))
    path = fit_polyline(stamp_ns, position, velocity)
    at_ns = np.sort(rng.integers(stamp_ns[0], stamp_ns[-1], 500))
    spline = CubicHermiteSpline((stamp_ns - stamp_ns[0]) * 1e-9, position, velocity)
    np.testing.assert_allclose(path.position_at(at_ns), spline((at_ns - stamp_ns[0]) * 1e-9), atol=1e-12)
    assert np.array_equal(path.position_at(stamp_ns), position)


def test_first_crossing_on_a_hill_is_a_horizontal_chord():
    path = hill(np.radians(22.5), 0.8, 200)
    start = int(path.stamp_ns[3])
    end = path.first_crossing_ns(start, radius_m=1.0)
    assert (end - start) * 1e-9 == pytest.approx(1.0 / (0.8 * np.cos(np.radians(22.5))), abs=2e-9)
    ends = path.position_at(np.array([start, end]))
    assert np.hypot(*(ends[1] - ends[0])[:2]) == pytest.approx(1.0, abs=1e-6)
    assert ends[1, 2] - ends[0, 2] == pytest.approx(np.tan(np.radians(22.5)), abs=1e-6)


def test_touching_the_circle_is_no_crossing_and_leaving_it_is():
    # Out along x to a turning point at exactly 1 m, back, and out again further: the parabola x = 1 - (t - 1)² touches 1 m at t = 1 s.
    t = np.arange(0, 5, 0.05)
    x = np.where(t < 2, 1 - (t - 1) ** 2, 2 * (t - 2))
    vx = np.where(t < 2, -2 * (t - 1), 2.0)
    zero = 0 * t
    path = fit_polyline(stamps(len(t)), np.column_stack((x, zero, zero)), np.column_stack((vx, zero, zero)))
    end = path.first_crossing_ns(int(path.stamp_ns[0]), radius_m=1.0 + 1e-9)
    assert (end - path.stamp_ns[0]) * 1e-9 == pytest.approx(2.5, abs=1e-6)


def test_a_loop_between_two_samples_is_found():
    # In one interval the cubic leaves the 1 m circle and comes back: no sample is outside.
    stamp_ns = stamps(3, step_ns=1_000_000_000)
    position = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.6, 0, 0]])
    velocity = np.array([[6.0, 0, 0], [-6.0, 0, 0], [0.1, 0, 0]])
    path = fit_polyline(stamp_ns, position, velocity)
    end = path.first_crossing_ns(int(stamp_ns[0]), radius_m=1.0)
    assert stamp_ns[0] < end < stamp_ns[1]
    assert path.position_at(np.array([end]))[0, 0] == pytest.approx(1.0, abs=1e-7)
