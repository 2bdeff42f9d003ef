"""Two robots that no profile knows are not pooled unasked."""

import numpy as np
import pytest
from synthetic_store import add_run, lanes, open_world, segments, tag_run

from tcpipe.dataset import open_dataset
from tcpipe.errors import DatasetError
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.dataset.runs import group_similar_runs
from tcpipe.tables.levels import Sensor


def sensor(topic, kind="sensor_msgs/msg/Imu", frame="imu_link"):
    return Sensor(topic, kind, frame, "the only one")


ROVER = {"imu": sensor("/imu/data"), "gnss": sensor("/fix", "sensor_msgs/msg/NavSatFix", "gps")}


@pytest.mark.parametrize(
    ("other", "groups"),
    [
        (ROVER, 1),
        ({"imu": ROVER["imu"]}, 1),  # the GNSS receiver was off
        ({"imu": sensor("/imu/raw", frame="/imu_link")}, 1),
        ({"imu": sensor("/imu/data", frame="base_imu"), "gnss": ROVER["gnss"]}, 2),
        ({**ROVER, "gnss": sensor("/fix", "nmea_msgs/msg/Sentence", "gps")}, 2),
        ({"imu": sensor("/two/imu/data"), "gnss": sensor("/two/fix", "sensor_msgs/msg/NavSatFix", "gps")}, 2),
        ({"imu": sensor("/two/imu/data")}, 2),
        ({"wheel_odometry": sensor("/odom", "nav_msgs/msg/Odometry", "odom")}, 2),  # nothing tells
        ({}, 2),
    ],
)
def test_what_is_one_robot(other, groups):
    found = group_similar_runs({"a": ROVER, "b": other, "c": ROVER})
    assert len(found) == groups
    assert sorted(run for runs, _ in found for run in runs) == ["a", "b", "c"]


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
        "a, c: gnss /fix (sensor_msgs/msg/NavSatFix, frame gps), imu /imu/data (sensor_msgs/msg/Imu, frame imu_link)",
        "b: imu /imu/data (sensor_msgs/msg/Imu, frame base_imu)",
    ]
    build_dataset(tmp_path / "one", store=store.root, tag={"robot": "other"})
    build_dataset(tmp_path / "all", store=store.root, robot="generic")
    assert [len(open_dataset(tmp_path / name).card.runs) for name in ("one", "all")] == [1, 3]
