"""A pose of a SLAM that drifts slowly, of a sensor that is turned and off base_link: from a log to labels, against the truth."""

from functools import cache

import numpy as np
import pytest
from changed_drives import Drive, make
from scipy.spatial.transform import Rotation
from suggested_recipes import proposed

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.writing import MessageStream, write_mcap
from tcpipe.formats.recipe_toml import load_shipped_profiles, parse_recipe
from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.simulation import compute_true_cost
from tcpipe.simulation.robot import make_correlated_noise
from tcpipe.stages.read import read_run
from tcpipe.tables.bits import Quality
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.findings import select_findings

TOPIC = "/slam/pose"
ARM_M, TURN_RAD = (0.3, -0.1, 0.6), 0.5
FRAME = Rotation.from_euler("z", 0.7)
"""The frame of the SLAM against ENU."""
STEP = 10


@cache
def drive():
    return make()


def make_drift(rng, count, std):
    """Return errors that last for two minutes, shape (count, 3)."""
    stays = float(np.exp(-STEP * 0.01 / 120.0))
    return std * np.stack([make_correlated_noise(rng.standard_normal(count), stays) for _ in range(3)], -1)


def pose_of(truth, *, attitude=True):
    """Return the messages of a pose at 10 Hz without covariance: centimetres and tenths of a degree of noise, and drift."""
    rng, at = np.random.default_rng(3), truth.at(truth.stamp_ns[:: round(1e8 / np.diff(truth.stamp_ns[:2])[0])])
    robot, count = Rotation.from_quat(at.quat_xyzw), at.stamp_ns.size
    place = at.enu_m + robot.apply(ARM_M) + make_drift(rng, count, 0.02) + rng.normal(0.0, 0.01, (count, 3))
    drift = Rotation.from_rotvec(make_drift(rng, count, 0.005))
    noise = Rotation.from_rotvec(rng.normal(0.0, 0.004, (count, 3)))
    turned = FRAME * drift * robot * Rotation.from_euler("z", TURN_RAD) * noise
    quat = turned.as_quat() if attitude else np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    columns = {f"pose.position.{axis}": FRAME.apply(place)[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"pose.orientation.{part}": quat[:, i] for i, part in enumerate("xyzw")}
    columns |= {"header.stamp.sec": at.stamp_ns // 10**9, "header.stamp.nanosec": at.stamp_ns % 10**9}
    return MessageStream(TOPIC, "geometry_msgs/msg/PoseStamped", at.stamp_ns, columns)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return track and labels of the drive with a pose in the place of GNSS, without some sensors."""

    @cache
    def run(*without, attitude=True, placed=None):
        whole = drive().without("gnss", *without)
        log = tmp_path_factory.mktemp("pose") / "run.mcap"
        write_mcap(log, Drive(whole.truth, (*whole.messages, pose_of(whole.truth, attitude=attitude))).messages)
        read = {"topics": {"pose": [TOPIC]}}
        if placed is not None:
            read["extrinsics"] = {"pose": {"xyz_m": list(ARM_M), "rpy_rad": [0.0, 0.0, placed]}}
        recipe = parse_recipe({"read": read}, where="test")
        with open_log(log) as opened:
            streams = read_run(opened, recipe.read, robot=None, known=load_shipped_profiles())
        track, _, labelled = run_stages(streams, recipe.ingest, run_id="run")[:3]
        return track, labelled

    return run


def yaw_errors(track):
    at = drive().truth.at(to_integers(track.table, "stamp_ns"))
    yaw = Rotation.from_quat(at.quat_xyzw).as_euler("ZYX")[:, 0] + 0.7
    error = np.angle(np.exp(1j * (to_floats(track.table, "yaw_rad") - yaw)))
    return error, to_floats(track.table, "yaw_std_rad")


def inside(labelled):
    """Return the share of durations within two standard deviations of the truth."""
    true = compute_true_cost(drive().truth, to_integers(labelled.table, "start_ns"))
    error = to_floats(labelled.table, "duration_s") - true.duration_s
    return np.mean(np.abs(error) < 2.0 * to_floats(labelled.table, "duration_std_s"))


@pytest.mark.parametrize("without", [(), ("imu", "visual")], ids=["all", "wheels"])
def test_labels_hold_and_yaw_is_better_than_without_attitude(run, without):
    track, labelled = run(*without)
    error, std = yaw_errors(track)
    plain = yaw_errors(run(*without, attitude=False)[0])[0]
    assert labelled.table.num_rows > 30
    assert inside(labelled) >= 0.92
    assert np.mean(np.abs(error) < 2.0 * std) >= 0.9
    assert np.sqrt(np.mean(error**2)) < 0.98 * np.sqrt(np.mean(plain**2))


def test_a_pose_that_nothing_places_shows_its_arm_and_turn_and_is_not_weak(run):
    labelled = run("imu", "visual")[1]
    weak = to_integers(labelled.table, "quality") & int(Quality.WEAK_GNSS)
    assert not weak.any()
    (finding,) = select_findings(labelled.info.report.findings, "lever-arm-unknown")
    stated = proposed(finding)["read"]["extrinsics"]["pose"]
    assert stated["xyz_m"][:2] == pytest.approx(ARM_M[:2], abs=0.05)
    assert stated["rpy_rad"] == pytest.approx([0.0, 0.0, TURN_RAD], abs=0.06)


def test_a_wrong_mounting_is_found_and_following_the_finding_ends_it(run):
    (finding,) = select_findings(run("visual", placed=0.0)[1].info.report.findings, "pose-rotated")
    assert finding.numbers["off_rad"] == pytest.approx(TURN_RAD, abs=0.15)
    right = run("visual", placed=TURN_RAD)[1]
    assert not select_findings(right.info.report.findings, "pose-rotated")
    assert inside(right) >= 0.92
