"""What changed while sensors contradicted each other: on a drive whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from unit.fusion import drive
from unit.fusion.test_error_state import fuse, truth

from tcpipe.fusion.hypotheses import find_turn_jump
from tcpipe.fusion.measurements import GNSS, IMU


def jump(measurements, change_radps, at_s=75.0):
    """Return measurements whose gyroscope's vertical bias jumps."""
    imu = measurements.imu
    later = imu.stamp_ns > drive.ns(at_s)
    rate = imu.angular_velocity_radps + later[:, None] * np.array([0.0, 0.0, change_radps])
    return replace(measurements, imu=replace(imu, angular_velocity_radps=rate))


def move_fixes(measurements, off_m):
    """Return measurements whose fixes err by metres east, as a function of the time [s]."""
    gnss = measurements.gnss
    east = off_m((gnss.stamp_ns - drive.ZERO_NS) * 1e-9)
    moved = gnss.position_enu_m + east[:, None] * np.array([1.0, 0.0, 0.0])
    return replace(measurements, gnss=replace(gnss, position_enu_m=moved))


@pytest.mark.parametrize("change_radps", [0.02, -0.03])
def test_turns_of_the_wheels_show_when_the_bias_of_a_gyroscope_jumped(change_radps):
    found = find_turn_jump(jump(drive.measure(truth(), 1, visual=False), change_radps))
    assert found is not None
    assert (found.at_ns - drive.ZERO_NS) * 1e-9 == pytest.approx(75.0, abs=1.5)
    assert found.change == pytest.approx(change_radps, rel=0.15)


def test_no_jump_is_found_where_there_is_none():
    assert find_turn_jump(drive.measure(truth(), 1)) is None


def test_a_jump_within_an_outage_bends_no_track():
    measured = jump(drive.measure(truth(), 1, visual=False, gnss_outages=((55.0, 105.0),)), 0.03)
    found = fuse(measured)
    assert [(change.kind, change.role) for change in found.facts.changes] == [("gyroscope", IMU)]
    at = (found.stamp_ns - drive.ZERO_NS) * 1e-9
    away = np.hypot(*(found.position_enu_m - truth().at(truth().position, at))[:, :2].T)
    gap = (at > 56.0) & (at < 104.0)
    assert away.max() < 1.5
    assert np.mean(away[gap] < 1.73 * np.hypot(*found.position_std_m[gap, :2].T)) > 0.9


def test_fixes_that_are_off_and_return_are_named_with_their_span_and_size():
    off = move_fixes(drive.measure(truth(), 1, visual=False), lambda at: np.where((at > 60.0) & (at < 100.0), 0.5, 0.0))
    found = fuse(off)
    (change,) = found.facts.changes
    assert (change.kind, change.role) == ("offset", GNSS)
    span_s = [(each - drive.ZERO_NS) * 1e-9 for each in (change.start_ns, change.end_ns)]
    assert span_s == pytest.approx([60.0, 100.0], abs=0.3)
    assert change.size == pytest.approx(0.5, abs=0.15)
    assert drive.errors(truth(), found)["xy"] < 0.03


def test_fixes_that_drift_away_and_jump_back_are_distrusted_around_the_jump():
    ramp = move_fixes(drive.measure(truth(), 1), lambda at: np.interp(at, [50.0, 75.0, 75.01], [0.0, 0.3, 0.0]))
    found = fuse(ramp)
    assert {change.kind for change in found.facts.changes} == {"wander"}
    at = (found.stamp_ns - drive.ZERO_NS) * 1e-9
    away = np.hypot(*(found.position_enu_m - truth().at(truth().position, at))[:, :2].T)
    assert np.mean(away < 1.73 * np.hypot(*found.position_std_m[:, :2].T)) > 0.9
    assert away[at > 120.0].max() < 0.05


def test_fixes_that_two_odometries_contradict_smoothly_are_an_excursion():
    bump = move_fixes(
        drive.measure(truth(), 1, slip=0.02),
        lambda at: 0.4 * np.sin(np.pi * np.clip((at - 55.0) / 40.0, 0.0, 1.0)) ** 2,
    )
    found = fuse(bump)
    assert {(change.kind, change.role) for change in found.facts.changes} == {("wander", GNSS)}
    assert drive.errors(truth(), found)["max_xy"] < 0.2


def test_no_sensor_changes_on_a_drive_with_the_usual_faults():
    assert not fuse(drive.measure(truth(), 1)).facts.changes
