"""Streams of real recordings, against figures worked out from the same recordings by other means."""

from pathlib import Path

import numpy as np
from shared_data import shared_data

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.recipe import Extrinsics, ReadConfig
from tcpipe.stages.read import read_run
from tcpipe.tables.findings import select_findings
from tcpipe.tables.levels import Streams


def read(path: Path, robot: str | None = None, **config) -> Streams:
    with open_log(path) as log:
        return read_run(log, ReadConfig(**config), robot=robot, known=load_shipped_profiles())


def test_a_real_husky_without_power() -> None:
    found = read(
        shared_data("robot_localization/test1.bag"),
        extrinsics={"imu": Extrinsics((0.0, -0.3, 0.52), (np.pi / 2, 0.0, -np.pi / 2))},
    )
    assert found.robot == "husky"
    rows = {role: table.num_rows for role, table in found.tables.items()}
    assert rows == {"gnss": 989, "imu": 11865, "wheel_odometry": 3952}
    assert select_findings(found.report.findings, "no-power")
    assert [sensor.placed_by for sensor in found.sensors.values()] == ["assumed", "recipe", "same frame"]
    assert found.sensors["gnss"].frame_id == "gps"
    # Turned by its mounting, the IMU's specific force points up.
    force = np.stack([found.tables["imu"][f"linear_acceleration_{axis}_mps2"].to_numpy() for axis in "xyz"], -1).mean(0)
    x, y, z, w = found.sensors["imu"].quat_xyzw
    up = np.array([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)])  # third row of the rotation
    assert up @ force > 0.99 * np.linalg.norm(force)


def test_duplicates_and_backward_stamps_of_an_old_recording() -> None:
    path = shared_data("robot_localization/test1_2014.bag")
    found = read(path)
    assert {role: sensor.topic for role, sensor in found.sensors.items()} == {
        "imu": "/xsens/imu_data",
        "wheel_odometry": "/wheel_odometry",
        "visual_odometry": "/stereo_odometer/odometry",
    }
    assert found.report.facts.epochs == 1
    worse = read(path, topics={"imu": ["/my_odometry2imu/imu_data"]})
    facts = worse.report.facts.roles["imu"]["/my_odometry2imu/imu_data"]
    assert facts.messages == 13333
    assert sum(facts.dropped.values()) == 347
    assert facts.notes["sorted"] >= 31
    assert np.all(np.diff(worse.tables["imu"]["stamp_ns"].to_numpy()) > 0)


def test_a_battery_that_says_nothing_and_stamps_in_whole_seconds() -> None:
    found = read(shared_data("peers/ros_amr_interop/rosbag_demo.bag"))
    (rejected,) = select_findings(found.report.findings, "power-rejected")
    assert (rejected.subject.name, rejected.names["reason"]) == ("/battery", "voltage-zero")
    assert rejected.numbers == {"median_volt": 0.0, "median_amp": 0.0, "rows_count": 111.0}
    (by_log,) = select_findings(found.report.findings, "log-time-used")
    assert by_log.names == {"topic": "/velocity", "reason": "header-repeats"}
    assert found.tables["wheel_odometry"].num_rows == 5270
