"""The files of a simulated site, read back by rasterio, rosbags, mcap and json, never by our own readers."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tcpipe.errors import UsageError
from tcpipe.simulation import Faults, make_tiny, simulate, simulate_readings
from tcpipe.simulation.scenarios import HUSKY_ROS1, HUSKY_ROS2, RasterSpec, make_small_world


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("site"), scenario=make_tiny(Faults.every(), seconds=20.0), seed=3)


def make_coarse(*how, **more):
    """Return a scenario whose rasters take no time."""
    return replace(make_tiny(*how, **more), rasters=RasterSpec(1.0, 1.0, 1.0))


def ros1_in_mcap(path: Path):
    store = get_typestore(Stores.ROS1_NOETIC)
    found = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros1msg", "ros1")
            name = schema.name.replace("/", "/msg/")
            if name not in store.types:
                store.register(get_types_from_msg(schema.data.decode(), name))
            row = message.log_time, store.deserialize_ros1(message.data, name)
            found.setdefault(channel.topic, []).append(row)
    return found


def messages(path: Path):
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        found = {}
        for connection, log_time, raw in reader.messages():
            found.setdefault(connection.topic, []).append((log_time, reader.deserialize(raw, connection.msgtype)))
    return found


def stamps(rows):
    return np.array([row.header.stamp.sec * 1_000_000_000 + row.header.stamp.nanosec for _, row in rows])


def test_rasters_equal_the_world_at_their_pixel_centres(site):
    world, grids = make_small_world(), set()
    for name in ("height", "ortho", "terrain"):
        with rasterio.open(site.rasters[name]) as raster:
            grids.add((raster.transform, raster.shape))
            assert raster.crs.to_epsg() == 32633
            rng = np.random.default_rng(0)
            rows, cols = rng.integers(0, raster.height, 4000), rng.integers(0, raster.width, 4000)
            x, y = (np.array(values) for values in raster.xy(rows, cols))
            mapped = world.mapped(x, y)
            assert 0 < (~mapped).sum() < 1000
            values = raster.read()[:, rows, cols]
            if name == "height":
                assert raster.dtypes == ("float32",)
                np.testing.assert_allclose(values[0][mapped], world.height_m(x, y)[mapped], atol=1e-4)
                assert (values[0][~mapped] == raster.nodata).all()
            elif name == "ortho":
                np.testing.assert_allclose(values[:3].T[mapped], np.clip(world.ortho(x, y)[mapped], 0, 255), atol=0.51)
                np.testing.assert_array_equal(values[3], np.where(mapped, 255, 0))
            else:
                np.testing.assert_array_equal(values[0][mapped], 10 * world.terrain_class(x, y)[mapped])
                assert (values[0][~mapped] == raster.nodata).all()
                assert raster.colormap(1)[40] == (150, 200, 90, 255)
    assert len(grids) == 3, "no two share a grid"


def test_mcap_holds_the_readings(site):
    _, readings = simulate_readings(make_tiny(Faults.every(), seconds=20.0), seed=3)
    found = messages(site.logs[0])
    imu = found["/a200_0000/sensors/imu_0/data"]
    order = np.argsort(readings["imu"].log_time_ns, kind="stable")
    np.testing.assert_array_equal(stamps(imu), readings["imu"].stamp_ns[order])
    np.testing.assert_array_equal([t for t, _ in imu], readings["imu"].log_time_ns[order])
    said = np.array([[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z] for _, m in imu])
    np.testing.assert_array_equal(said, readings["imu"].values["specific_force_mps2"][order])
    quat = np.array([[m.orientation.x, m.orientation.y, m.orientation.z, m.orientation.w] for _, m in imu])
    np.testing.assert_array_equal(quat, readings["imu"].values["orientation_xyzw"][order])
    power = found["/a200_0000/platform/mcu/status/power"]
    order = np.argsort(readings["power"].log_time_ns, kind="stable")
    drawn = np.array([m.measured_currents for _, m in power])
    np.testing.assert_array_equal(drawn[:, 1], readings["power"].values["left_amp"][order].astype(np.float32))
    frames = {t.child_frame_id: t.transform.translation for _, m in found["/a200_0000/tf_static"] for t in m.transforms}
    off_m = np.hypot(frames["gps_link"].x - 0.1, frames["gps_link"].z - 0.9)
    assert 0.0 < off_m <= 0.05, "the log states the antenna some centimetres off"
    assert all(m.header.frame_id == "gps_link" for _, m in found["/a200_0000/sensors/gps_0/fix"])


@pytest.mark.parametrize(
    ("container", "dialect"), [("bag", "ros1"), ("mcap", "ros1"), ("rosbag2", "ros2"), ("rosbag2_mcap", "ros2")]
)
def test_other_containers_hold_the_same_numbers(site, tmp_path, container, dialect):
    recorder = replace(HUSKY_ROS1, dialect=dialect)
    drive = make_coarse(Faults.every(), container=container, recorder=recorder, seconds=20.0)
    other = simulate(tmp_path, scenario=drive, seed=3)
    found = (ros1_in_mcap if (container, dialect) == ("mcap", "ros1") else messages)(other.logs[0])
    plain = messages(site.logs[0])
    topic = "/husky_velocity_controller/odom" if dialect == "ros1" else "/a200_0000/platform/odom"
    wheels = plain["/a200_0000/platform/odom"]
    np.testing.assert_array_equal(stamps(found[topic]), stamps(wheels))
    assert [m.twist.twist.linear.x for _, m in found[topic]] == [m.twist.twist.linear.x for _, m in wheels]
    status = found["/status" if dialect == "ros1" else "/a200_0000/platform/mcu/status/power"]
    assert status[0][1].__msgtype__ == "husky_msgs/msg/HuskyStatus"
    assert 24.0 < status[5][1].battery_voltage < 28.0
    said = simulate_readings(drive, seed=3)[1]["power"].values["left_amp"]
    np.testing.assert_allclose([m.left_driver_current for _, m in status], said, rtol=1e-6)


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    def digests(directory):
        return {
            path.relative_to(directory): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(directory.rglob("*"))
            if path.is_file()
        }

    def bag(container):
        recorder = HUSKY_ROS1 if container == "bag" else HUSKY_ROS2
        return make_coarse(Faults.every(), container=container, recorder=recorder, seconds=17.0)

    for container in ("mcap", "bag", "rosbag2"):
        for place in "ab":
            simulate(tmp_path / place / container, scenario=bag(container), seed=5)
    assert digests(tmp_path / "a") == digests(tmp_path / "b")
    simulate(tmp_path / "c", scenario=bag("mcap"), seed=6)
    assert digests(tmp_path / "c")[Path("logs/tiny.mcap")] != digests(tmp_path / "a" / "mcap")[Path("logs/tiny.mcap")]


def test_a_second_call_does_nothing_and_what_is_something_else_stays(tmp_path):
    out = tmp_path / "site"
    tiny = make_coarse(seconds=17.0)
    assert not simulate(out, scenario=tiny).unchanged
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    assert simulate(out, scenario=tiny).unchanged
    for place, seed in ((out, 2), (tmp_path, 1)):
        with pytest.raises(UsageError, match="is no site of scenario"):
            simulate(place, scenario=tiny, seed=seed)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before
    assert list(tmp_path.iterdir()) == [out]


def test_an_unknown_scenario_lists_those_there_are(tmp_path):
    with pytest.raises(UsageError, match="demo, hills12"):
        simulate(tmp_path, scenario="moon")
    assert not list(tmp_path.iterdir())
