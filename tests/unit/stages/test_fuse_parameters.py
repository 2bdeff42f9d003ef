"""Which parameters that the run shows are findings, and the lines that state them in the recipe."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from suggested_recipes import proposed

from tcpipe.stages.fuse_findings import find_parameter_findings, make_fuse_facts
from tcpipe.stages.fuse_inputs import Section
from tcpipe.tables.facts import ChangeFacts, ParameterFacts, SectionFacts
from tcpipe.tables.levels import Sensor, Streams

ARM_M = (0.1, 0.0, 0.9)


def streams(placed_by="tf_static"):
    gnss = Sensor("/fix", "x/msg/Y", "gps", "why", ARM_M, placed_by=placed_by)
    imu = Sensor("/imu", "x/msg/Y", "imu", "why", (0.0, 0.1, 0.2), (0.0, 0.0, 1.0, 0.0), placed_by="tf_static")
    return Streams({}, {"gnss": gnss, "imu": imu}, "husky")


def make_findings(log, changes=(), **parameters):
    """Return what is found of a run with sections that show nothing, and parameters, by name with spaces as underscores."""
    shown = {name.replace("_", " "): ParameterFacts(*of) for name, of in parameters.items()}
    long = SectionFacts({}, {}, {}, start_ns=0, end_ns=100, parameters=shown)
    sections = [SectionFacts({}, {}, {}, end_ns=9, changes=changes), long]
    facts = make_fuse_facts([Section(0)], sections, rows=0, skipped_s=0.0)
    return tuple(find_parameter_findings([Section(0)], facts, log))


def antenna(std_m):
    return {"antenna": ((0.3, -0.2, 0.0), (std_m,) * 3, (0.5,) * 3)}


def test_an_antenna_that_nobody_placed_is_a_finding_with_its_place():
    told = make_findings(streams("assumed"), **antenna(0.05))
    (finding,) = told
    assert (finding.code, finding.subject.name) == ("lever-arm-unknown", "gnss")
    assert [finding.numbers[f"{axis}_m"] for axis in ("forward", "left", "up")] == pytest.approx([0.4, -0.2, 0.9])
    assert finding.numbers["up_std_m"] == pytest.approx(0.05)
    assert proposed(finding)["read"]["extrinsics"]["gnss"]["xyz_m"] == pytest.approx([0.4, -0.2, 0.9])


def test_a_stated_antenna_is_one_only_where_it_is_surely_elsewhere():
    assert make_findings(streams(), **antenna(0.08)) == ()
    assert make_findings(streams(), antenna=((0.09, 0.0, 0.0), (0.005,) * 3, (0.02,) * 3)) == ()
    (finding,) = make_findings(streams(), **antenna(0.05))
    assert (finding.code, finding.names) == ("lever-arm-contradicted", {"placed_by": "tf_static"})


def test_the_line_for_a_tilted_imu_turns_its_measurements_into_the_robots_axes():
    value = np.array([0.05, -0.08, 0.0])
    told = make_findings(streams(), mounting_of_the_IMU=(tuple(value), (0.005,) * 3, (0.0175,) * 3))
    (finding,) = told
    assert finding.code == "imu-tilted"
    entry = proposed(finding)["read"]["extrinsics"]["imu"]
    assert entry["xyz_m"] == [0, 0.1, 0.2]
    # What the IMU measures of a vector of the robot: its stated rotation undone, and the error that was found.
    stated, robot = Rotation.from_quat((0.0, 0.0, 1.0, 0.0)), np.array([0.3, -0.5, 9.8])
    raw = stated.inv().apply(Rotation.from_rotvec(value).apply(robot))
    assert Rotation.from_euler("xyz", entry["rpy_rad"]).apply(raw) == pytest.approx(robot, abs=0.03)
    small = make_findings(streams(), mounting_of_the_IMU=((0.016, 0.0, 0.0), (0.001,) * 3, (0.0175,) * 3))
    assert small == ()


def test_a_scale_that_is_surely_not_one_is_stated_beside_what_is_stated_already():
    log = streams()
    given = replace(log.report, facts=replace(log.report.facts, odometry_scale={"wheel_odometry": 0.5}))
    told = make_findings(replace(log, report=given), wheel_scale=((0.3,), (0.02,), (0.12,)))
    (finding,) = told
    assert (finding.code, finding.numbers["scale"]) == ("odometry-scale", pytest.approx(1.3))
    assert proposed(finding)["read"]["odometry_scale"] == {"wheel_odometry": pytest.approx(0.5 / 1.3, rel=1e-3)}
    assert make_findings(log, camera_scale=((0.06,), (0.02,), (0.05,))) == ()
    assert make_findings(log, camera_scale=((0.02,), (0.001,), (0.05,))) == ()


def test_a_camera_whose_scale_varies_is_named_and_wheels_which_always_slip_only_where_it_explains_the_run():
    def vary(std):
        return (0.0,), (0.01,), (0.05,), (std,)

    (finding,) = make_findings(streams(), camera_scale=vary(0.02))
    assert (finding.code, finding.subject.name) == ("odometry-scale-varies", "visual_odometry")
    assert finding.numbers["variation_fraction"] == pytest.approx(0.02)
    assert make_findings(streams(), camera_scale=vary(0.002), wheel_scale=vary(0.02)) == ()
    changes = [ChangeFacts("varies", role, 1, 9, 0.08) for role in ("visual_odometry", "wheel_odometry")]
    findings = make_findings(streams(), changes, camera_scale=vary(0.02))
    assert [(each.subject.name, each.numbers["variation_fraction"]) for each in findings] == [
        ("visual_odometry", 0.08),
        ("wheel_odometry", 0.08),
    ]
