"""Paths by speeds and turns, and turns of the course over ground, on circles."""

import numpy as np
import pytest

from tcpipe.fusion.dead_reckoning import DeadReckoning, compute_course_rate
from tcpipe.fusion.measurements import Positions


def test_a_circle_closes_and_is_as_long_as_its_circumference():
    at_s, rate_radps = np.arange(0.0, 20.0, 0.02), 2.0 * np.pi / 20.0
    path = DeadReckoning(at_s, np.full(at_s.size, 0.5), at_s[::3], np.full(at_s[::3].size, rate_radps))
    wanted_s = np.array([0.0, 5.0, 10.0, 20.0])
    radius_m = 0.5 / rate_radps
    assert path.place(wanted_s) == pytest.approx(radius_m * np.array([0, 1 + 1j, 2j, 0]), abs=1e-4)
    assert path.yaw(wanted_s) == pytest.approx(rate_radps * wanted_s)
    assert path.length(20.0) == pytest.approx(2.0 * np.pi * radius_m)


def test_without_samples_the_path_stays_at_the_origin():
    nothing = np.empty(0)
    path = DeadReckoning(nothing, nothing, nothing, nothing)
    assert path.place(np.array([0.0, 3.0])).tolist() == [0.0, 0.0]


def _circling(hz, speed_mps=0.9, rate_radps=0.3):
    at_s = np.arange(0.0, 60.0, 1.0 / hz)
    radius_m = speed_mps / rate_radps
    place = radius_m * np.column_stack((np.cos(rate_radps * at_s), np.sin(rate_radps * at_s), 0.0 * at_s))
    return Positions((at_s * 1e9).astype(np.int64), place, np.full((at_s.size, 3), 0.015**2))


@pytest.mark.parametrize("hz", [1.0, 5.0])
def test_a_circle_turns_evenly(hz):
    stamp_s, rate = compute_course_rate(_circling(hz), None, 0)
    inside = (stamp_s > 2.0) & (stamp_s < 57.0)
    assert rate[inside] == pytest.approx(np.full(inside.sum(), 0.3), abs=0.04)


def test_a_wild_fix_does_not_turn_the_course():
    fixes = _circling(5.0)
    fixes.position_enu_m[150] += [0.7, -1.2, 0.0]
    stamp_s, rate = compute_course_rate(fixes, None, 0)
    inside = (stamp_s > 2.0) & (stamp_s < 57.0)
    assert rate[inside] == pytest.approx(np.full(inside.sum(), 0.3), abs=0.04)
