"""The audit held against a drive whose truth is known: the truth is never astray, a track that has lost the robot is, where it has."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.fusion.checks.audit import Audit, audit_trajectory, is_astray
from tcpipe.fusion.measurements import (
    DISPLACEMENT_LAGS_S,
    BodyVelocities,
    Measurements,
    Positions,
    Rejections,
    Trajectory,
)
from tcpipe.geometry.rotation import quat_from_rpy
from tcpipe.tables.facts import StretchFacts


def seconds(track, stamp_ns):
    return (stamp_ns - track.stamp_ns[0]) * 1e-9


def drifting(track, from_s, to_s):
    """Return the track that runs east at 2 m/s for a time."""
    at_s = np.clip(seconds(track, track.stamp_ns), from_s, to_s) - from_s
    return replace(track, position_enu_m=track.position_enu_m + np.outer(at_s, [2.0, 0.0, 0.0]))


def test_the_truth_is_nowhere_astray(track, sensors):
    same, found = audit_trajectory(track, sensors)
    assert (found.disagreements, found.astray) == ((), 0)
    assert found.windows > 40
    assert same is track


def test_where_no_sensor_follows_the_track_its_deviations_are_inflated_and_only_there(track, sensors):
    raised, found = audit_trajectory(drifting(track, 50.0, 70.0), sensors)
    (lost,) = found.disagreements
    assert lost.size == pytest.approx(10.0, rel=0.2)
    assert 45.0 <= seconds(track, lost.start_ns) <= 51.0
    assert 69.0 <= seconds(track, lost.end_ns) <= 75.0
    at_s = seconds(track, track.stamp_ns)
    inside = (at_s > 55.0) & (at_s < 65.0)
    assert raised.forward_velocity_std_mps[inside] == pytest.approx(2.0, rel=0.2)
    assert raised.displacement_std_m[inside, 1] == pytest.approx(2.0, rel=0.2)
    outside = (at_s < 45.0) | (at_s > 75.0)
    assert (raised.displacement_std_m[outside] == track.displacement_std_m[outside]).all()


@pytest.mark.parametrize("right", ["gnss", "wheels", "visual"])
def test_one_sensor_that_the_track_follows_is_enough(track, sensors, right):
    rest = {name: None for name in ("gnss", "wheels", "visual") if name != right}
    wrong = drifting(track, 50.0, 70.0)
    assert audit_trajectory(wrong, replace(sensors, **rest))[1].astray > 0
    ahead = sensors.gnss.position_enu_m + np.outer(
        np.clip(seconds(track, sensors.gnss.stamp_ns), 50.0, 70.0) - 50.0, [2.0, 0.0, 0.0]
    )
    follows = replace(sensors, gnss=replace(sensors.gnss, position_enu_m=ahead))
    assert audit_trajectory(wrong, follows)[1].astray == 0


def test_single_wild_fixes_and_a_constant_scale_are_not_astray(track, sensors):
    wild = sensors.gnss.position_enu_m.copy()
    wild[::20] += 5.0
    fixes = replace(sensors, gnss=replace(sensors.gnss, position_enu_m=wild), wheels=None, visual=None)
    assert audit_trajectory(track, fixes)[1].astray == 0
    faster = replace(sensors.wheels, velocity_mps=1.7 * sensors.wheels.velocity_mps)
    assert audit_trajectory(track, replace(fixes, gnss=sensors.gnss, wheels=faster))[1].astray == 0


def test_what_is_silent_or_shorter_than_a_window_says_nothing(track, sensors):
    at_s = seconds(track, sensors.wheels.stamp_ns)
    heard = (at_s < 40.0) | (at_s > 60.0)
    rows = ("stamp_ns", "velocity_mps", "variance_m2ps2", "yaw_rate_radps", "yaw_rate_var")
    silent = replace(sensors.wheels, **{name: getattr(sensors.wheels, name)[heard] for name in rows})
    alone = replace(sensors, gnss=None, visual=None)
    _, whole = audit_trajectory(track, alone)
    _, found = audit_trajectory(track, replace(alone, wheels=silent))
    assert 7 <= whole.windows - found.windows <= 11
    few = {
        name: getattr(track, name)[:40] for name in Trajectory.__slots__ if isinstance(getattr(track, name), np.ndarray)
    }
    assert audit_trajectory(replace(track, **few), sensors)[1] == Audit()


def test_wheels_that_turn_while_the_robot_stands_are_stuck_not_wrong(track, sensors):
    here = replace(track, position_enu_m=np.tile(track.position_enu_m[:1], (track.stamp_ns.size, 1)))
    stuck = replace(sensors, visual=None, gnss=None)
    standing = replace(stuck, wheels=replace(sensors.wheels, velocity_mps=0.0 * sensors.wheels.velocity_mps))
    assert audit_trajectory(here, stuck)[1].windows < 5
    _, found = audit_trajectory(here, standing)
    assert (found.windows > 40, found.astray) == (True, 0)


def test_a_track_that_has_lost_the_robot_is_astray_whatever_it_claims_and_rejects(track, sensors):
    few = replace(sensors, wheels=None, visual=None)
    late = few.gnss.stamp_ns[seconds(track, few.gnss.stamp_ns) > 60.0]
    refused = Rejections(
        late, np.full(late.size, "gnss"), np.full(late.size, "gate"), np.ones(late.size), np.ones(late.size)
    )
    lost = replace(
        drifting(track, 60.0, 120.0), position_std_m=np.full_like(track.position_std_m, 1e3), rejections=refused
    )
    raised, found = audit_trajectory(lost, few)
    assert 0.4 < found.astray / found.windows < 0.6
    assert is_astray(found.windows, found.astray)
    assert (raised.forward_velocity_std_mps[seconds(track, track.stamp_ns) > 65.0] > 1.0).all()


def spin(arm_m):
    """Return the true track of a robot that turns in place at 0.5 rad/s, and a camera and an antenna at ``arm_m`` [m] of it."""
    t = np.arange(0.0, 60.0, 0.05)
    stamp_ns = (t * 1e9).astype(np.int64)
    zero, ahead = np.zeros((t.size, 3)), np.column_stack((np.cos(0.5 * t), np.sin(0.5 * t), 0.0 * t))
    aside = np.column_stack((-ahead[:, 1], ahead[:, 0], 0.0 * t))
    still = Trajectory(
        stamp_ns=stamp_ns,
        position_enu_m=zero,
        quat_xyzw=quat_from_rpy(0.0 * t, 0.0 * t, 0.5 * t),
        velocity_enu_mps=zero,
        angular_velocity_radps=zero + np.array([0.0, 0.0, 0.5]),
        position_std_m=zero + 0.01,
        yaw_std_rad=zero[:, 0] + 0.01,
        forward_velocity_std_mps=zero[:, 0] + 0.01,
        rejections=Rejections(np.empty(0, np.int64), *np.empty((2, 0), np.str_), *np.empty((2, 0))),
        displacement_std_m=np.full((t.size, len(DISPLACEMENT_LAGS_S)), 0.01),
        facts=StretchFacts({}, {}, {}),
    )
    swept_mps = np.array([-0.5 * arm_m[1], 0.5 * arm_m[0], 0.0])  # angular velocity times radius, at right angles to it
    camera = BodyVelocities(stamp_ns, zero + swept_mps, zero + 1e-4, zero[:, 2] + 0.5, zero[:, 2] + 1e-4, arm_m)
    antenna = Positions(stamp_ns, ahead * arm_m[0] + aside * arm_m[1], zero + 1e-4, arm_m)
    return still, camera, antenna


@pytest.mark.parametrize("role", ["visual", "gnss"])
def test_a_robot_that_turns_in_place_sweeps_its_sensors_around(role):
    track, *sensors = spin((1.2, -0.9, 0.0))
    seen = dict(zip(("visual", "gnss"), sensors, strict=True))[role]
    _, found = audit_trajectory(track, Measurements(**{role: seen}))
    assert (found.windows > 10, found.astray) == (True, 0)
    elsewhere = replace(seen, lever_arm_m=(-1.2, 0.9, 0.0))
    _, found = audit_trajectory(track, Measurements(**{role: elsewhere}))
    assert found.astray == found.windows
