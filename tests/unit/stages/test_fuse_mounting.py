"""When a mounting is mended, when it is left as somebody stated it, and the lines that a person can put into the recipe."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from suggested_recipes import proposed

from tcpipe.fusion.checks.mounting import Arm, ArmEvidence, Tilt, TiltEvidence
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.stages import fuse
from tcpipe.stages.fuse_findings import make_mounting_findings
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_sections import Fused
from tcpipe.tables.levels import Sensor, Streams

ARM_M = (0.1, 0.0, 0.9)
TRUE = np.array([0.3, -0.2, 0.0, 0.0])


def streams(placed_by):
    gnss = Sensor("/fix", "x/msg/Y", "gps", "why", ARM_M, placed_by=placed_by)
    imu = Sensor("/imu", "x/msg/Y", "imu", "why", (0.0, 0.1, 0.2), placed_by="tf_static")
    return Streams({}, {"gnss": gnss, "imu": imu}, "husky")


def inputs(arm_m=ARM_M):
    stamp_ns = np.arange(5, dtype=np.int64)
    gnss = Positions(stamp_ns, np.zeros((5, 3)), np.ones((5, 3)), arm_m)
    imu = InertialMeasurements(
        stamp_ns, np.zeros((5, 3)), np.tile([0.0, 0.0, 9.8], (5, 1)), np.full((5, 4), np.nan), 0.01, 0.1
    )
    return FusionInputs((15.0, 47.0, 400.0), {0: Measurements(gnss=gnss, imu=imu)})


def turns_that_show(arm, *, moved_m=(0.0, 0.0, 0.0), std_m=0.05, windows=9):
    """Windows that all tell the same error of the arm, less what was moved already."""
    matrix = np.diag([1.0, 1.0, 1.0, 1.0]) / std_m**2
    left = arm - np.append(moved_m, 0.0)
    return ArmEvidence(np.tile(matrix, (windows, 1, 1)), np.tile(matrix @ left, (windows, 1)), 0.0)


def slope_that_shows(roll_rad, pitch_rad):
    ones = np.ones(30)
    return TiltEvidence(ones, roll_rad * ones, ones, -pitch_rad * ones)


def test_an_antenna_that_nobody_placed_is_put_where_the_turns_show_it_and_then_left():
    log, taken = streams("assumed"), inputs()
    first = fuse._correct_mounting(taken, Fused(arms=[turns_that_show(TRUE)]), log)
    assert first.measurements[0].gnss.lever_arm_m == pytest.approx((0.4, -0.2, 0.9), abs=1e-3)
    moved_m = np.asarray(first.measurements[0].gnss.lever_arm_m) - ARM_M
    assert fuse._correct_mounting(first, Fused(arms=[turns_that_show(TRUE, moved_m=moved_m)]), log) is None
    told = make_mounting_findings(first, log)
    assert told.facts.antenna_moved_m == pytest.approx(moved_m)
    (finding,) = told.findings
    assert (finding.code, finding.subject.name) == ("lever-arm-unknown", "gnss")
    assert finding.numbers["forward_m"] == pytest.approx(0.4, abs=0.01)
    entry = proposed(finding)["read"]["placement"]["gnss"]
    assert entry["xyz_m"] == pytest.approx([0.4, -0.2, 0.9], abs=0.01)


def test_an_antenna_that_nobody_placed_and_nothing_shows_is_unknown_by_a_robots_size():
    found = fuse._correct_mounting(inputs(), Fused(), streams("assumed"))
    assert found.measurements[0].gnss.lever_arm_m == pytest.approx(ARM_M)
    assert np.sqrt(np.diag(found.arm.covariance))[:3] == pytest.approx([0.5, 0.5, 0.5])


def test_a_stated_antenna_is_moved_only_where_the_turns_surely_contradict():
    log = streams("tf_static")
    for agrees in (turns_that_show(0.05 * TRUE), turns_that_show(TRUE, std_m=0.5)):
        assert fuse._correct_mounting(inputs(), Fused(arms=[agrees]), log) is None
    found = fuse._correct_mounting(inputs(), Fused(arms=[turns_that_show(TRUE)]), log)
    (finding,) = make_mounting_findings(found, log).findings
    assert (finding.code, finding.subject.name) == ("lever-arm-contradicted", "gnss")
    assert finding.names == {"placed_by": "tf_static"}


def test_while_the_imu_is_being_turned_a_stated_antenna_is_not_judged():
    evidence = Fused(arms=[turns_that_show(TRUE)], tilts=[slope_that_shows(0.0, 0.08)])
    found = fuse._correct_mounting(inputs(), evidence, streams("tf_static"))
    assert found.measurements[0].gnss.lever_arm_m == pytest.approx(ARM_M)
    assert found.imu_tilt.rad == pytest.approx([0.0, 0.08])


def test_a_tilted_imu_is_turned_and_what_is_left_added_until_nothing_is():
    log = streams("tf_static")
    assert fuse._correct_mounting(inputs(), Fused(tilts=[slope_that_shows(0.01, 0.01)]), log) is None
    first = fuse._correct_mounting(inputs(), Fused(tilts=[slope_that_shows(0.0, 0.07)]), log)
    second = fuse._correct_mounting(first, Fused(tilts=[slope_that_shows(0.01, 0.01)]), log)
    assert second.imu_tilt.rad == pytest.approx([0.0, 0.08])
    assert fuse._correct_mounting(second, Fused(tilts=[slope_that_shows(0.01, 0.002)]), log) is None
    turned = Rotation.from_euler("xyz", [0.0, 0.08, 0.0])
    felt = second.measurements[0].imu.specific_force_mps2
    assert felt == pytest.approx(np.tile(turned.apply([0.0, 0.0, 9.8]), (5, 1)), abs=0.01)
    told = make_mounting_findings(second, log)
    assert told.facts.imu_tilt_rad == pytest.approx((0.0, 0.08))
    (finding,) = told.findings
    assert finding.code == "imu-tilted"
    assert finding.numbers == {"roll_rad": pytest.approx(0.0), "pitch_rad": pytest.approx(0.08)}
    entry = proposed(finding)["read"]["placement"]["imu"]
    assert entry == {"xyz_m": [0, 0.1, 0.2], "rpy_rad": pytest.approx([0.0, 0.08, 0.0], abs=1e-4)}


def test_nothing_mended_is_nothing_said():
    told = make_mounting_findings(inputs(), streams("tf_static"))
    assert (told.findings, told.facts) == ((), None)


def test_both_are_said_where_both_were_mended():
    taken = inputs((0.2, 0.0, 0.9))
    taken.arm, taken.imu_tilt = Arm(np.array([0.1, 0, 0, 0]), np.eye(4)), Tilt(np.array([0.05, 0.0]), np.zeros(2))
    told = make_mounting_findings(taken, streams("recipe"))
    assert [of.subject.name for of in told.findings] == ["gnss", "imu"]


def test_a_scale_that_is_off_throughout_is_taken_out_and_the_recipe_line_states_it_beside_what_it_states_already():
    stamp_ns = np.arange(5, dtype=np.int64)
    wheels = BodyVelocities(stamp_ns, np.full((5, 3), 1.3), np.ones((5, 3)), np.zeros(5), np.ones(5))
    log = streams("tf_static")
    given = replace(log.report, facts=replace(log.report.facts, odometry_scale={"wheel_odometry": 0.5}))
    evidence = Fused(ratios=[{"wheel_odometry": np.linspace(1.29, 1.31, 21)}])
    found = fuse._correct_mounting(FusionInputs(None, {0: Measurements(wheels=wheels)}), evidence, log)
    assert found.measurements[0].wheels.velocity_mps == pytest.approx(np.ones((5, 3)))
    told = make_mounting_findings(found, replace(log, report=given))
    assert told.facts.odometry_scale == {"wheel_odometry": pytest.approx(1.3)}
    (finding,) = told.findings
    assert (finding.code, finding.numbers["scale"]) == ("odometry-scale", pytest.approx(1.3))
    entry = proposed(finding)["read"]["odometry_scale"]
    assert entry == {"wheel_odometry": pytest.approx(0.5 / 1.3, rel=1e-3)}
