"""A scale that is off throughout against slip that comes and goes, on a drive whose truth is known; and wheels against the command."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.fusion.checks.odometry_scale import (
    Scale,
    compute_command_ratio,
    compute_distance_ratios,
    rescale_odometry,
    solve_scales,
)
from tcpipe.fusion.measurements import BodyVelocities


def times(source, factor):
    return replace(source, velocity_mps=source.velocity_mps * np.asarray(factor))


def test_sensors_as_they_are_have_no_scale_to_mend(track, sensors):
    ratios = compute_distance_ratios(track, sensors)
    assert np.median(ratios["visual_odometry"]) == pytest.approx(1.0, abs=0.005)
    assert np.median(ratios["wheel_odometry"]) == pytest.approx(1.02, abs=0.02)
    assert solve_scales([ratios]) == {}


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_scale_that_is_off_throughout_is_found_and_taken_out(track, sensors, factor):
    off = replace(sensors, visual=times(sensors.visual, factor), wheels=times(sensors.wheels, factor))
    found = solve_scales([compute_distance_ratios(track, off)])
    assert found["visual_odometry"].factor == pytest.approx(factor, rel=0.01)
    assert found["wheel_odometry"].factor == pytest.approx(1.02 * factor, rel=0.02)
    mended = rescale_odometry(off.visual, found["visual_odometry"].factor)
    assert mended.velocity_mps == pytest.approx(sensors.visual.velocity_mps, abs=0.03)
    assert (mended.variance_m2ps2 >= off.visual.variance_m2ps2).all()
    again = compute_distance_ratios(
        track, replace(off, visual=mended, wheels=rescale_odometry(off.wheels, found["wheel_odometry"].factor))
    )
    assert solve_scales([again]) == {}


def test_slip_of_a_minute_is_no_scale(track, sensors):
    at_s = (sensors.wheels.stamp_ns - sensors.wheels.stamp_ns[0]) * 1e-9
    slips = np.where((at_s > 30) & (at_s < 80), 1.5, 1.0)[:, None]
    assert solve_scales([compute_distance_ratios(track, replace(sensors, wheels=times(sensors.wheels, slips)))]) == {}


def test_without_fix_and_camera_nothing_tells_a_scale(track, sensors):
    assert compute_distance_ratios(track, replace(sensors, gnss=None, visual=None)) == {}
    assert set(compute_distance_ratios(track, replace(sensors, gnss=None))) == {"wheel_odometry"}


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


def test_a_scale_that_is_found_after_another_was_taken_out_counts_with_it():
    first = Scale(0.4, 0.02, driven_m=40.0)
    both = Scale(1.1, 0.01).after(first)
    assert (both.factor, both.std, both.driven_m) == (pytest.approx(0.44), pytest.approx(0.004), 40.0)
    assert first.after(None) is first
