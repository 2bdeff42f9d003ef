"""The audit held against a drive whose truth is known: the truth disagrees with nobody, what is made wrong is found where it is."""

from dataclasses import replace

import numpy as np
import pytest
from rough_drive import ANTENNA_M
from scipy.stats import chi2

from tcpipe.fusion.checks import audit
from tcpipe.fusion.checks.audit import Tally, audit_trajectory, find_undecided_sensors, is_astray
from tcpipe.fusion.measurements import GroundVelocities
from tcpipe.fusion.trajectory import Rejections, Trajectory


def seconds(track, stamp_ns):
    return (stamp_ns - track.stamp_ns[0]) * 1e-9


def moved(source, field, by, between_s):
    """Return a sensor of which one field is changed for some time."""
    at_s = (source.stamp_ns - source.stamp_ns[0]) * 1e-9
    inside = ((at_s >= between_s[0]) & (at_s < between_s[1]))[:, None]
    return replace(source, **{field: getattr(source, field) + inside * np.asarray(by)})


def test_the_truth_disagrees_with_nobody(track, sensors):
    same, found = audit_trajectory(track, sensors)
    assert found.disagreements == ()
    assert same is track
    assert {(t.sensor, t.what) for t in found.tallies} == {
        ("gnss", "position"),
        ("gnss", "displacement"),
        ("imu", "turn"),
        ("wheel_odometry", "displacement"),
        ("visual_odometry", "displacement"),
        ("visual_odometry", "turn"),
    }


def test_a_receivers_velocity_is_held_against_the_antennas_way(track, sensors, truth):
    """The true one disagrees nowhere; one that is zero for a while does there, and is alone against the odometries and the fixes."""
    at = np.arange(7, truth.stamp_ns.size, 20)
    velocity = np.gradient(truth.position + truth.rotation @ np.array(ANTENNA_M), 1 / 200, axis=0)[at]
    told = GroundVelocities(truth.stamp_ns[at], velocity, np.full(velocity.shape, 0.05**2))
    same, found = audit_trajectory(track, replace(sensors, doppler=told))
    assert same is track
    assert ("gnss_velocity", "displacement") in {(t.sensor, t.what) for t in found.tallies}
    at_s = seconds(track, told.stamp_ns)
    zero = np.where(((at_s > 40.0) & (at_s < 60.0))[:, None], 0.0, velocity)
    same, found = audit_trajectory(track, replace(sensors, doppler=replace(told, velocity_enu_mps=zero)))
    assert {(each.sensor, each.alone) for each in found.disagreements} == {("gnss_velocity", True)}
    assert same is track


def test_fixes_that_lie_elsewhere_for_a_time_raise_the_position_there_and_only_there(track, sensors):
    off = moved(sensors.gnss, "position_enu_m", [0.3, 0.4, 0.0], (40.0, 70.0))
    raised, found = audit_trajectory(track, replace(sensors, gnss=off))
    (place,) = [each for each in found.disagreements if each.what == "position"]
    assert (place.sensor, place.unit, place.alone) == ("gnss", "m", False)
    assert place.size == pytest.approx(0.5, abs=0.02)
    assert place.expected_std == pytest.approx(np.hypot(0.015, 0.01), rel=0.01)
    assert 35.0 < seconds(track, place.start_ns) <= 40.0
    assert 70.0 <= seconds(track, place.end_ns) < 76.0
    at_s = seconds(track, track.stamp_ns)
    assert raised.position_std_m[(at_s > 42.5) & (at_s < 67.5), 0].min() > 0.48
    elsewhere = (at_s < 35.0) | (at_s > 76.0)
    assert (raised.position_std_m[elsewhere] == track.position_std_m[elsewhere]).all()
    assert (raised.position_std_m[:, 2] == track.position_std_m[:, 2]).all()


def test_single_wild_fixes_are_the_gates_business(track, sensors):
    wild = sensors.gnss.position_enu_m.copy()
    wild[::20] += 5.0
    _, found = audit_trajectory(track, replace(sensors, gnss=replace(sensors.gnss, position_enu_m=wild)))
    assert found.disagreements == ()


def test_a_way_that_two_sensors_tell_otherwise_raises_displacement_and_velocity_there(track, sensors):
    """The track says 0.4 m/s more than fixes and wheels for ten seconds."""
    at_s = seconds(track, track.stamp_ns)
    ahead = 0.4 * np.clip(at_s - 50.0, 0.0, 10.0)
    wrong = replace(track, position_enu_m=track.position_enu_m + ahead[:, None] * [1.0, 0.0, 0.0])
    raised, found = audit_trajectory(wrong, replace(sensors, visual=None))
    ways = [each for each in found.disagreements if each.what == "displacement"]
    assert {each.sensor for each in ways} >= {"gnss"}
    (by_fixes,) = [each for each in ways if each.sensor == "gnss"]
    assert by_fixes.size == pytest.approx(0.4 * audit._WINDOW_S, rel=0.1)
    inside = (at_s > 52.0) & (at_s < 58.0)
    assert raised.forward_velocity_std_mps[inside] == pytest.approx(0.4, rel=0.15)
    assert raised.displacement_std_m[inside, 1] == pytest.approx(0.4, rel=0.15)
    assert (raised.displacement_std_m[at_s < 40.0] == track.displacement_std_m[at_s < 40.0]).all()


def test_one_against_two_is_alone_and_the_track_is_believed(track, sensors):
    slipping = replace(sensors.wheels, velocity_mps=sensors.wheels.velocity_mps.copy())
    inside = (seconds(track, slipping.stamp_ns) > 60.0) & (seconds(track, slipping.stamp_ns) < 80.0)
    slipping.velocity_mps[inside, 0] *= 3.0
    raised, found = audit_trajectory(track, replace(sensors, wheels=slipping))
    assert {(each.sensor, each.what, each.alone) for each in found.disagreements} == {
        ("wheel_odometry", "displacement", True)
    }
    assert (raised.displacement_std_m == track.displacement_std_m).all()


def test_what_is_constant_over_the_run_is_no_disagreement_where_others_tell_it(track, sensors):
    turned = sensors.imu.angular_velocity_radps + np.array([0.0, 0.0, 0.05])
    faster = replace(sensors.wheels, velocity_mps=1.7 * sensors.wheels.velocity_mps)
    changed = replace(sensors, imu=replace(sensors.imu, angular_velocity_radps=turned), wheels=faster)
    _, found = audit_trajectory(track, changed)
    assert found.disagreements == ()
    _, found = audit_trajectory(track, replace(changed, gnss=None, visual=None))  # nothing tells that scale
    assert find_undecided_sensors(found.tallies) == (("wheel_odometry", "displacement"),)


def test_a_gyroscope_whose_bias_jumps_is_found_where_it_turns_otherwise(track, sensors):
    by = [0.0, 0.0, 0.1]
    jumping = moved(sensors.imu, "angular_velocity_radps", by, (80.0, 100.0))
    raised, found = audit_trajectory(track, replace(sensors, imu=jumping, visual=None))
    (turn,) = found.disagreements
    assert (turn.sensor, turn.what, turn.unit) == ("imu", "turn", "rad")
    assert turn.size == pytest.approx(0.1 * audit._WINDOW_S, rel=0.05)
    at_s = seconds(track, track.stamp_ns)
    assert raised.yaw_std_rad[(at_s > 85.0) & (at_s < 95.0)].min() > 0.4


def test_a_sensor_that_two_others_contradict_is_decided_and_by_one_is_not(track, sensors):
    elsewhere = np.cumsum(np.random.default_rng(1).normal(0.0, 0.5, (sensors.gnss.stamp_ns.size, 3)), axis=0)
    lost = replace(sensors.gnss, position_enu_m=sensors.gnss.position_enu_m + elsewhere)
    _, found = audit_trajectory(track, replace(sensors, gnss=lost))
    assert find_undecided_sensors(found.tallies) == ()
    _, found = audit_trajectory(track, replace(sensors, gnss=lost, visual=None, imu=None))
    assert find_undecided_sensors(found.tallies) == (("gnss", "displacement"),)


def test_most_is_of_the_windows_of_all_stretches_together():
    parts = [Tally("gnss", "displacement", 6, 5, 0), Tally("gnss", "displacement", 6, 0, 0)]
    assert find_undecided_sensors(parts[:1]) == (("gnss", "displacement"),)
    assert find_undecided_sensors(parts) == ()
    assert find_undecided_sensors([Tally("gnss", "position", 9, 9, 0)]) == ()
    assert find_undecided_sensors([Tally("gnss", "displacement", 3, 3, 0)]) == ()


def test_a_sensor_in_a_gap_says_nothing_there(track, sensors):
    at_s = seconds(track, sensors.wheels.stamp_ns)
    heard = (at_s < 40.0) | (at_s > 60.0)
    rows = ("stamp_ns", "velocity_mps", "variance_m2ps2", "yaw_rate_radps", "yaw_rate_var")
    silent = replace(sensors.wheels, **{name: getattr(sensors.wheels, name)[heard] for name in rows})
    _, whole = audit_trajectory(track, sensors)
    _, found = audit_trajectory(track, replace(sensors, wheels=silent))
    assert found.disagreements == ()
    count = {(t.sensor, t.what): t.moving for t in found.tallies}
    before = {(t.sensor, t.what): t.moving for t in whole.tallies}
    assert 7 <= before["wheel_odometry", "displacement"] - count["wheel_odometry", "displacement"] <= 11


def test_a_track_shorter_than_a_window_has_nothing_to_audit(track, sensors):
    few = {
        name: getattr(track, name)[:40] for name in Trajectory.__slots__ if isinstance(getattr(track, name), np.ndarray)
    }
    same, found = audit_trajectory(replace(track, **few), sensors)
    assert found == audit.Audit((), ())
    assert same.stamp_ns.size == 40


def test_wheels_that_turn_while_the_robot_stands_are_stuck_not_wrong(track, sensors):
    here = replace(track, position_enu_m=np.tile(track.position_enu_m[:1], (track.stamp_ns.size, 1)))
    for dug_in, telling in (
        (sensors.wheels, 0),
        (replace(sensors.wheels, velocity_mps=0.0 * sensors.wheels.velocity_mps), 1),
    ):
        _, found = audit_trajectory(here, replace(sensors, wheels=dug_in, visual=None, gnss=None))
        assert [each for each in found.disagreements if each.sensor == "wheel_odometry"] == []
        compared = list(
            audit._iterate_comparisons(here, replace(sensors, wheels=dug_in), audit._find_windows(here.stamp_ns))
        )
        (way,) = [one for one in compared if one.sensor == "wheel_odometry"]
        assert way.told.mean() == pytest.approx(telling, abs=0.1)


def test_a_track_that_no_sensor_follows_is_astray_whatever_it_claims_and_refuses(track, sensors):
    """From 60 s on it drifts off at 2 m/s and refuses every fix; one sensor that holds with it is enough."""
    at_s = seconds(track, track.stamp_ns)
    east = track.position_enu_m + np.outer(np.maximum(at_s - 60.0, 0.0), [2.0, 0.0, 0.0])
    few = replace(sensors, wheels=None, visual=None)
    late = few.gnss.stamp_ns[seconds(track, few.gnss.stamp_ns) > 60.0]
    refused = Rejections(
        late, np.full(late.size, "gnss"), np.full(late.size, "gate"), np.ones(late.size), np.ones(late.size)
    )
    lost = replace(
        track, position_enu_m=east, position_std_m=np.full_like(track.position_std_m, 1e3), rejections=refused
    )
    raised, found = audit_trajectory(lost, few)
    assert 0.4 < found.astray / found.windows < 0.6
    assert is_astray(found.windows, found.astray)
    assert (raised.forward_velocity_std_mps[at_s > 65.0] > 1.0).all()
    _, right = audit_trajectory(track, few)
    assert right.astray == 0
    ahead = few.gnss.position_enu_m + np.outer(np.maximum(seconds(track, few.gnss.stamp_ns) - 60.0, 0.0), [2.0, 0, 0])
    _, held = audit_trajectory(
        track, replace(sensors, gnss=replace(few.gnss, position_enu_m=ahead))
    )  # wheels follow the track
    assert held.astray == 0


def test_the_bound_is_that_of_chi_square_over_all_windows():
    told = audit.Comparison("gnss", "position", np.zeros((40, 2)), np.ones(40), np.ones(40))
    assert told._bound**2 == pytest.approx(chi2.isf(0.01 / 40, 2), rel=1e-9)
