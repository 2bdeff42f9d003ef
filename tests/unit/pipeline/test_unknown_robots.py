"""Two robots that no profile knows are not pooled unasked."""

import numpy as np
import pytest
from synthetic_store import add_run, lanes, open_world, segments, tag_run

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.dataset.runs import find_other_sensors
from tcpipe.tables.levels import Sensor


def sensor(topic, kind="sensor_msgs/msg/Imu", frame="imu_link"):
    return Sensor(topic, kind, frame, "the only one")


ROVER = {"imu": sensor("/imu/data"), "gnss": sensor("/fix", "sensor_msgs/msg/NavSatFix", "gps")}


@pytest.mark.parametrize(
    ("other", "is_same"),
    [
        (ROVER, True),
        ({"imu": ROVER["imu"]}, True),  # the GNSS receiver was off
        ({"imu": sensor("/imu/raw", frame="/imu_link")}, True),
        ({"imu": sensor("/imu/data", frame="base_imu"), "gnss": ROVER["gnss"]}, False),
        ({**ROVER, "gnss": sensor("/fix", "nmea_msgs/msg/Sentence", "gps")}, False),
        ({"imu": sensor("/two/imu/data"), "gnss": sensor("/two/fix", "sensor_msgs/msg/NavSatFix", "gps")}, False),
        ({"imu": sensor("/two/imu/data")}, False),
        ({"wheel_odometry": sensor("/odom", "nav_msgs/msg/Odometry", "odom")}, False),  # nothing tells
        ({}, False),
    ],
)
def test_what_is_one_robot(other, is_same):
    found = find_other_sensors({"a": ROVER, "b": other, "c": ROVER})
    assert (not found) == is_same
    assert all(line.startswith("b: ") for line in found)


@pytest.fixture
def store(tmp_path):
    store = open_world(tmp_path)
    sensors = {"a": ROVER, "b": {"imu": sensor("/imu/data", frame="base_imu")}, "c": ROVER}
    for number, (run_id, of) in enumerate(sensors.items()):
        table = segments(run_id, *lanes(np.array([3.0 * number]), -10.0, 10.0), robot="generic")
        add_run(store, run_id, table, sensors=of)
    tag_run(store, "b", {"robot": "other"})
    return store


def test_what_differs_is_refused_and_what_settles_it_does(store, tmp_path):
    with pytest.raises(DatasetError) as caught:
        build_dataset(tmp_path / "out", store=store.root)
    head, *groups = caught.value.problems
    assert "not all of one robot: their sensors differ" in head
    assert "--tag robot=NAME, or pool them with --robot generic" in head
    assert groups == [
        "b: imu /imu/data (sensor_msgs/msg/Imu, frame base_imu) instead of imu /imu/data (sensor_msgs/msg/Imu, frame imu_link)"
    ]
    build_dataset(tmp_path / "one", store=store.root, tag={"robot": "other"})
    build_dataset(tmp_path / "all", store=store.root, robot="generic")
    assert [len(open_dataset(tmp_path / name).card.runs) for name in ("one", "all")] == [1, 3]
