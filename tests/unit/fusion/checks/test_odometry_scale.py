"""Odometry in other units, and wheels against the command."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.fusion.checks.odometry_scale import compute_command_ratio, rescale_odometry
from tcpipe.fusion.measurements import BodyVelocities


def times(source, factor):
    return replace(source, velocity_mps=source.velocity_mps * np.asarray(factor))


def test_a_scale_is_taken_out_and_the_claim_does_not_become_better(sensors):
    for factor in (0.25, 3.6):
        mended = rescale_odometry(times(sensors.visual, factor), factor)
        assert mended.velocity_mps == pytest.approx(sensors.visual.velocity_mps)
        assert (mended.variance_m2ps2 >= sensors.visual.variance_m2ps2).all()


COMMAND_NS = np.arange(0, 120 * 10**9, 10**8, dtype=np.int64)


def driven(over, *, commanded):
    """Wheels that are ``over`` times as fast as commanded, half a second later, with the scatter that the ground makes."""
    stamp_ns = np.arange(0, 120 * 10**9, 2 * 10**7, dtype=np.int64)
    told = commanded[np.clip(np.searchsorted(COMMAND_NS, stamp_ns - 5 * 10**8, "right") - 1, 0, None)]
    speed = told * (over + 0.05 * np.sin(stamp_ns * 1e-9))
    velocity = np.column_stack((speed, np.full((stamp_ns.size, 2), np.nan)))
    nothing = np.full(stamp_ns.size, np.nan)
    return BodyVelocities(stamp_ns, velocity, velocity * 0 + 1e-4, nothing, nothing)


@pytest.mark.parametrize(("over", "found"), [(0.9, None), (1.0, None), (1.2, 1.2)])
def test_a_robot_that_is_faster_than_its_command_has_other_wheels(over, found):
    jitter = np.random.default_rng(1).normal(0, 0.01, COMMAND_NS.size)
    commanded = np.where(COMMAND_NS % (30 * 10**9) < 24 * 10**9, 1.0 + jitter, 0.0)
    told = compute_command_ratio(driven(over, commanded=commanded), COMMAND_NS, commanded)
    assert told == (None if found is None else pytest.approx(found, abs=0.02))


def test_a_command_that_is_not_what_drives_tells_nothing():
    moving = driven(1.2, commanded=np.ones(COMMAND_NS.size))
    assert compute_command_ratio(moving, COMMAND_NS, np.zeros(COMMAND_NS.size)) is None
    assert compute_command_ratio(moving, COMMAND_NS[:0], np.zeros(0)) is None
