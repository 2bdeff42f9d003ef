"""Turns of the course over ground, on circles."""

import numpy as np
import pytest

from tcpipe.fusion.course import compute_course_rate
from tcpipe.fusion.measurements import Positions


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
