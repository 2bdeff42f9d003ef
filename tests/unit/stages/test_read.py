"""Logs made by hand become streams: every role, one clock, placed sensors, and everything that is missing said."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pyarrow as pa
import pyproj
import pytest
from made_tracks import with_columns
from scipy.spatial.transform import Rotation

from tcpipe.errors import RecipeError, RoleError
from tcpipe.formats.recipe_toml import load_shipped_profiles, parse_recipe, parse_toml
from tcpipe.logs.topics import Topic
from tcpipe.recipe import Extrinsics, ReadConfig
from tcpipe.recipe.suggestions import RecipeFragment
from tcpipe.stages.read import read_run
from tcpipe.tables.findings import select_findings
from tcpipe.tables.levels import Streams

S = 1_000_000_000
START = 1_700_000_000 * S


class MemoryLog:
    """A log of tables made by hand; it remembers what was read."""

    def __init__(self, topics: Mapping[str, tuple[str, pa.Table]], undecodable: Iterable[str] = ()) -> None:
        self._tables = {name: table for name, (_, table) in topics.items() if name not in undecodable}
        self.read: list[str] = []
        self.topics = {
            name: Topic(name, kind, table.num_rows, START, START + 10 * S, "cdr", "")
            for name, (kind, table) in topics.items()
        }

    def tables(self, topics: Iterable[str]) -> dict[str, pa.Table]:
        wanted = list(topics)
        self.read += wanted
        return {name: self._tables[name] for name in wanted if name in self._tables}

    def batches(self, topics: Iterable[str]) -> Iterator[dict[str, pa.Table]]:
        yield self.tables(topics)


def message_table(
    rows: int, rate_hz: float, *, frame: str | None = "base_link", delay_ns: int = 2_000_000, **columns
) -> pa.Table:
    stamps = START + np.round(np.arange(rows) / rate_hz * S).astype(np.int64)
    fields = {"log_time_ns": stamps + delay_ns, "publish_time_ns": stamps + delay_ns}
    if frame is not None:
        fields |= {
            "header.stamp.sec": pa.array(stamps // S, pa.int32()),
            "header.stamp.nanosec": pa.array(stamps % S, pa.uint32()),
            "header.frame_id": [frame] * rows,
        }
    return pa.table(fields | columns)


def full(rows: int, value: float) -> np.ndarray:
    return np.full(rows, value)


def cov(rows: int, size: int, value: float) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array((np.eye(size) * value).ravel().tolist() * rows), size * size)


def xyz(prefix: str, rows: int, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, np.ndarray]:
    return {f"{prefix}.{axis}": full(rows, value) for axis, value in zip("xyz", (x, y, z), strict=True)}


def fix(rows: int = 50, frame: str = "gps") -> tuple[str, pa.Table]:
    columns = {
        "status.status": pa.array(full(rows, 2), pa.int8()),
        "latitude": 47.0 + np.arange(rows) * 1e-6,
        "longitude": full(rows, 15.0),
        "altitude": full(rows, 400.0),
        "position_covariance": cov(rows, 3, 0.0004),
        "position_covariance_type": pa.array(full(rows, 2), pa.uint8()),
    }
    return "sensor_msgs/msg/NavSatFix", message_table(rows, 5.0, frame=frame, **columns)


def imu(rows: int = 500, frame: str = "imu_link") -> tuple[str, pa.Table]:
    rng = np.random.default_rng(3)
    quat = Rotation.from_rotvec(rng.normal(size=(rows, 3)) * 0.01).as_quat()
    columns = {
        **{f"orientation.{c}": quat[:, i] for i, c in enumerate("xyzw")},
        **xyz("angular_velocity", rows, z=0.1),
        **xyz("linear_acceleration", rows, z=9.8),
        **{
            f"{name}_covariance": cov(rows, 3, 0.01)
            for name in ("orientation", "angular_velocity", "linear_acceleration")
        },
    }
    return "sensor_msgs/msg/Imu", message_table(rows, 50.0, frame=frame, **columns)


def odometry(rows: int = 500, speed_mps: float = 0.5, child: str = "base_link") -> tuple[str, pa.Table]:
    columns = {
        "child_frame_id": [child] * rows,
        **xyz("pose.pose.position", rows),
        "pose.pose.position.x": np.arange(rows) * 0.01,
        **xyz("pose.pose.orientation", rows),
        "pose.pose.orientation.w": full(rows, 1.0),
        "pose.covariance": cov(rows, 6, 0.0),
        **xyz("twist.twist.linear", rows, x=speed_mps),
        **xyz("twist.twist.angular", rows),
        "twist.covariance": cov(rows, 6, 0.01),
    }
    return "nav_msgs/msg/Odometry", message_table(rows, 50.0, frame="odom", **columns)


def battery(amp: float, rows: int = 200) -> tuple[str, pa.Table]:
    current = pa.array(amp + 0.1 * np.sin(np.arange(rows)), pa.float32())
    columns = {
        "voltage": pa.array(48.0 + 0.25 * (np.arange(rows) % 4), pa.float32()),
        "current": current,
        "percentage": full(rows, np.nan),
    }
    return "sensor_msgs/msg/BatteryState", message_table(
        rows, 20.0, **columns, cell_voltage=pa.array([[]] * rows, pa.list_(pa.float32()))
    )


def twist(rows: int = 100) -> tuple[str, pa.Table]:
    table = message_table(rows, 10.0, frame=None, **xyz("linear", rows, x=1.0), **xyz("angular", rows))
    return "geometry_msgs/msg/Twist", table


def transforms(*edges: tuple[str, str, tuple[float, float, float], Rotation]) -> tuple[str, pa.Table]:
    values = [
        {
            "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": parent},
            "child_frame_id": child,
            "transform": {
                "translation": dict(zip("xyz", position, strict=True)),
                "rotation": dict(zip("xyzw", rotation.as_quat().tolist(), strict=True)),
            },
        }
        for parent, child, position, rotation in edges
    ]
    table = pa.table({"log_time_ns": [START], "publish_time_ns": [START], "transforms": [values]})
    return "tf2_msgs/msg/TFMessage", table


def husky(**more: tuple[str, pa.Table]) -> dict[str, tuple[str, pa.Table]]:
    return {
        "/fix": fix(),
        "/imu/data": imu(),
        "/husky_velocity_controller/odom": odometry(),
        "/left/battery": battery(3.0),
        "/right/battery": battery(4.0),
        "/husky_velocity_controller/cmd_vel": twist(),
        "/tf_static": transforms(
            ("base_link", "gps", (0.1, 0.0, 0.9), Rotation.identity()),
            ("base_link", "plate", (0.0, 0.0, 0.3), Rotation.identity()),
            ("plate", "imu_link", (0.2, -0.3, 0.0), Rotation.from_euler("xz", [np.pi / 2, -np.pi / 2])),
        ),
        **more,
    }


def read(topics: Mapping[str, tuple[str, pa.Table]] | MemoryLog, /, **config) -> Streams:
    log = topics if isinstance(topics, MemoryLog) else MemoryLog(topics)
    return read_run(log, ReadConfig(**config), robot=None, known=load_shipped_profiles())


def codes(found) -> set[str]:
    return {of.code for of in found.report.findings}


def test_a_whole_husky() -> None:
    found = read(husky())
    assert found.robot == "husky"
    assert {role: table.num_rows for role, table in found.tables.items()} == {
        "gnss": 50,
        "imu": 500,
        "wheel_odometry": 500,
        "power": 400,
        "command": 100,
    }
    assert set(found.sensors) == set(found.tables)
    gnss, sensor = found.tables["gnss"], found.sensors["imu"]
    assert gnss["stamp_ns"].to_pylist()[:2] == [START, START + S // 5]
    assert gnss["log_time_ns"][0].as_py() == START + 2_000_000
    assert gnss["east_var_m2"][0].as_py() == 0.0004
    assert found.sensors["gnss"].xyz_m == (0.1, 0.0, 0.9)
    assert found.sensors["gnss"].placed_by == "tf_static"
    assert sensor.xyz_m == (0.2, -0.3, 0.3)
    np.testing.assert_allclose(
        Rotation.from_quat(sensor.quat_xyzw).as_matrix(),
        Rotation.from_euler("xz", [np.pi / 2, -np.pi / 2]).as_matrix(),
        atol=1e-12,
    )
    assert found.sensors["wheel_odometry"].placed_by == "same frame"
    assert found.sensors["command"].time_source == "log"
    assert found.tables["wheel_odometry"]["velocity_var_x_m2ps2"][0].as_py() == 0.01
    assert codes(found) == {"current-sign-assumed"}
    facts = found.report.facts
    assert facts.epochs == 1
    assert facts.roles["imu"]["/imu/data"].rows == 500
    assert abs(facts.roles["imu"]["/imu/data"].rate_hz - 50.0) < 1e-6
    assert facts.roles["gnss"]["/fix"].time.offset_s == -0.002


def test_the_rails_keep_their_names_and_their_sum_is_the_robots_current() -> None:
    power = read(husky()).tables["power"]
    assert set(power["rail"].to_pylist()) == {"/left/battery", "/right/battery"}
    first = power.slice(0, 2).to_pydict()
    assert first["stamp_ns"] == [START, START]
    np.testing.assert_allclose(sum(first["current_amp"]), 7.0, atol=1e-6)


def test_only_the_topics_of_roles_are_read_and_tf_only_where_it_is_needed() -> None:
    moving = transforms(("odom", "base_link", (1.0, 0.0, 0.0), Rotation.identity()))
    log = MemoryLog(husky(**{"/tf": moving, "/image": ("sensor_msgs/msg/Image", message_table(1, 1.0))}))
    read(log)
    assert "/image" not in log.read
    assert "/tf" not in log.read
    assert len(log.read) == len(set(log.read))


def test_a_latched_tf_places_what_tf_static_does_not() -> None:
    topics = husky(**{"/tf": transforms(("base_link", "gps", (0.0, 0.0, 2.0), Rotation.identity()))})
    del topics["/tf_static"]
    found = read(topics)
    assert found.sensors["gnss"].xyz_m == (0.0, 0.0, 2.0)
    assert found.sensors["imu"].placed_by == "assumed"
    (unplaced,) = select_findings(found.report.findings, "sensor-not-placed")
    assert (unplaced.subject.name, unplaced.names["frame"]) == ("imu", "imu_link")
    line = RecipeFragment(unplaced.remedies[0].recipe, is_checked=True).toml()
    assert "xyz_m = [?, ?, ?]" in line
    with pytest.raises(ValueError, match=r"line 2.*; measure it and write the value in place of \?"):
        parse_toml(line)
    assert parse_recipe(parse_toml(line.replace("?", "0.1")), where="measured").read.extrinsics["imu"].xyz_m == (
        0.1,
        0.1,
        0.1,
    )


def test_the_recipe_places_over_tf() -> None:
    found = read(husky(), extrinsics={"gnss": Extrinsics((1.0, 2.0, 3.0), (0.0, 0.0, np.pi / 2))})
    assert found.sensors["gnss"].xyz_m == (1.0, 2.0, 3.0)
    assert found.sensors["gnss"].placed_by == "recipe"
    np.testing.assert_allclose(found.sensors["gnss"].quat_xyzw, [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)


def renamed(at: int, *, until: int, child: str = "base_link") -> MemoryLog:
    """Return the log of a husky whose odometry has another name from row ``at`` on; the first ends at row ``until``."""
    topics = husky()
    (kind, whole), (_, other) = topics.pop("/husky_velocity_controller/odom"), odometry(child=child)
    topics |= {"/odom": (kind, whole.slice(0, until)), "/platform/odom": (kind, other.slice(at))}
    log = MemoryLog(topics)
    for name in ("/odom", "/platform/odom"):
        stamp_ns = topics[name][1]["log_time_ns"].to_numpy()
        log.topics[name] = replace(log.topics[name], start_ns=int(stamp_ns[0]), end_ns=int(stamp_ns[-1]))
    return log


def test_an_odometry_that_is_renamed_during_the_log_is_one_stream() -> None:
    found, whole = read(renamed(200, until=200)), read(husky())
    assert found.tables["wheel_odometry"].equals(whole.tables["wheel_odometry"])
    assert set(found.sensors["wheel_odometry"].topic.split(" + ")) == {"/odom", "/platform/odom"}
    assert found.sensors["wheel_odometry"].xyz_m == whole.sensors["wheel_odometry"].xyz_m


@pytest.mark.parametrize("names", [["/odom", "/platform/odom"], ["/platform/odom", "/odom"]])
def test_of_two_topics_named_for_one_role_the_first_is_used_where_both_have_messages(names: list[str]) -> None:
    log = renamed(200, until=250)
    found = read(log, topics={"wheel_odometry": names})
    assert found.tables["wheel_odometry"].num_rows == 500
    (unused,) = select_findings(found.report.findings, "topic-overlaps")
    assert (unused.subject.name, unused.names["used"], unused.numbers["overlapping_count"]) == (names[1], names[0], 50)
    (remedy,) = unused.remedies
    other = read(log, topics=remedy.recipe["read.topics"])
    assert other.sensors["wheel_odometry"].topic == names[1]
    assert not select_findings(other.report.findings, "topic-overlaps")


def test_topics_without_messages_play_no_part_even_where_the_index_cannot_tell() -> None:
    log = MemoryLog(
        {name: (kind, table.slice(0, 0)) for name, (kind, table) in husky().items()} | {"/odom": odometry()}
    )
    log.topics = {name: replace(topic, message_count=None) for name, topic in log.topics.items()}
    assert set(read(log, topics={"wheel_odometry": ["/odom"]}).tables) == {"wheel_odometry"}


FIXED_NS = START + np.arange(20) * S
CLOCK = [datetime.fromtimestamp(stamp // S, UTC).strftime("%H%M%S") for stamp in FIXED_NS.tolist()]


def read_sentences(others: list[str]) -> Streams:
    """Read a log of NMEA sentences: a place each second, and another after each."""
    fixed = [f"$GPGGA,{time},4700.{i:04d},N,01500.0000,E,4,20,0.6,355.0,M,45.0,M,," for i, time in enumerate(CLOCK)]
    sentences = [sentence for pair in zip(fixed, others, strict=True) for sentence in pair]
    table = message_table(40, 2.0, delay_ns=60_000_000, frame="gps", sentence=sentences)
    return read({"/nmea_sentence": ("nmea_msgs/msg/Sentence", table), "/odom": odometry()})


def test_nmea_sentences_play_gnss_on_their_own_time() -> None:
    found = read_sentences([f"$GPGSV,{i}" for i in range(20)])
    gnss = found.tables["gnss"]
    assert gnss["stamp_ns"].to_pylist() == FIXED_NS.tolist()
    assert set(gnss["alt_m"].to_pylist()) == {400.0}
    assert found.report.facts.roles["gnss"]["/nmea_sentence"].dropped == {"not_gga": 20}
    assert "messages-unused" not in codes(found)


def test_one_topic_of_sentences_plays_two_roles_each_on_its_own_time() -> None:
    found = read_sentences([f"$GPRMC,{time}.50,A,,,,,1.944,090.0,,,,R" for time in CLOCK])
    velocity = found.tables["gnss_velocity"]
    assert velocity["stamp_ns"].to_pylist() == (FIXED_NS + S // 2).tolist()
    assert found.tables["gnss"]["stamp_ns"].to_pylist() == FIXED_NS.tolist()
    assert velocity["east_velocity_mps"].to_pylist() == pytest.approx([1.00008] * 20)
    assert velocity["north_velocity_mps"].to_pylist() == pytest.approx([0.0] * 20, abs=1e-9)
    assert velocity["up_velocity_mps"].null_count == velocity["east_var_m2ps2"].null_count == 20
    assert set(velocity["fix_status"].to_pylist()) == {2}
    assert found.sensors["gnss_velocity"].placed_by == "not needed"
    assert not any("gnss_velocity" in (of.subject.name, *of.names.values()) for of in found.report.findings)


@pytest.mark.parametrize(("frame", "rows"), [("gps", 50), ("base_link", 0), ("robot/base_footprint", 0)])
def test_a_receivers_twist_in_the_bodys_frame_stays_out_unless_the_recipe_names_it(frame: str, rows: int) -> None:
    columns = {
        **xyz("twist.twist.linear", 50, x=0.4, y=-0.3),
        **xyz("twist.twist.angular", 50),
        "twist.covariance": cov(50, 6, 0.01),
    }
    twist = message_table(50, 5.0, frame=frame, **columns)
    topics = {"/gps/fix": fix(), "/gps/vel": ("geometry_msgs/msg/TwistWithCovarianceStamped", twist)}
    found = read(topics)
    assert (found.tables["gnss_velocity"].num_rows if rows else len(set(found.tables) - {"gnss"})) == rows
    assert ("velocity-not-over-ground" in codes(found)) == (not rows)
    told = read(topics, topics={"gnss_velocity": ["/gps/vel"]})
    assert told.tables["gnss_velocity"].num_rows == 50


def test_a_topic_that_cannot_be_decoded_plays_no_part() -> None:
    found = read(MemoryLog(husky(), undecodable=["/fix", "/left/battery"]))
    assert "gnss" not in found.tables
    assert "power" not in found.tables  # one side alone is not the robot's power
    lost = [of.subject.name for of in select_findings(found.report.findings, "topic-not-decoded")]
    assert lost == ["/fix", "/left/battery"]
    assert {"power-rejected", "no-gnss"} <= codes(found)


def test_a_log_whose_only_motion_is_unusable_fails_and_says_why() -> None:
    kind, table = fix()
    lost = with_columns(table, **{"status.status": [-1] * 50})
    with pytest.raises(RoleError) as error:
        read({"/fix": (kind, lost), "/imu/data": imu()})
    assert error.value.problems[0].startswith("no motion in the log")
    (unused,) = select_findings(error.value.findings, "messages-unused")
    assert unused.numbers["no_fix_count"] == 50


def test_settings_of_the_recipe_reach_their_role() -> None:
    found = read(
        husky(),
        time_source={"imu": "log"},
        time_offset_s={"gnss": 0.25},
        odometry_scale={"wheel_odometry": 0.5},
        current_sign="drawn_negative",
        power_averaged="yes",
        gnss_crs="EPSG:7844",
    )
    assert found.sensors["imu"].time_source == "log"
    assert found.tables["imu"]["stamp_ns"][0].as_py() == START + 2_000_000
    assert found.tables["gnss"]["stamp_ns"][0].as_py() == START + S // 4
    assert found.tables["power"]["current_amp"][0].as_py() < 0
    plain, scaled = (of.tables["wheel_odometry"] for of in (read(husky()), found))
    for column, factor in (
        ("velocity_x_mps", 0.5),
        ("x_m", 0.5),
        ("velocity_var_x_m2ps2", 0.25),
        ("angular_velocity_z_radps", 1.0),
    ):
        expected = factor * plain[column].to_numpy(zero_copy_only=False)
        np.testing.assert_array_equal(scaled[column].to_numpy(zero_copy_only=False), expected)
    assert found.report.facts.odometry_scale == {"wheel_odometry": 0.5}
    assert found.power_averaged
    assert found.gnss_crs == "EPSG:7844"


def with_step(table: pa.Table) -> pa.Table:
    """Return the table with header stamps that leap by 7 s after 5 s."""
    if "header.stamp.sec" not in table.column_names:
        return table
    seconds = table["header.stamp.sec"].to_numpy().copy()
    seconds[seconds >= START // S + 5] += 7
    return with_columns(table, **{"header.stamp.sec": seconds})


def test_a_step_of_all_clocks_divides_every_table() -> None:
    topics = {name: (kind, with_step(table)) for name, (kind, table) in husky().items()}
    found = read(topics)
    assert found.report.facts.epochs == 2
    for role, table in found.tables.items():
        clock_epoch = table["clock_epoch"].to_numpy()
        np.testing.assert_array_equal(clock_epoch == 1, table["log_time_ns"].to_numpy() >= START + 5 * S, err_msg=role)
    (step,) = select_findings(found.report.findings, "clock-step")
    assert step.numbers["step_s"] == 7.0
    assert step.span_s == pytest.approx((5.0, 5.0), abs=0.1)


@pytest.mark.parametrize(("setting", "averaged", "severities"), [("auto", False, ["warning"]), ("yes", True, [])])
def test_averaging_that_nobody_knows_and_no_motion_tells_is_asked(
    *, setting: str, averaged: bool, severities: list[str]
) -> None:
    slow = message_table(11, 1.0, frame=None, power_v=full(11, 28.0), power_a=6.0 + np.cos(np.arange(11)))
    topics = {**husky(), "/lowstate": ("unitree_go/msg/LowState", slow)}
    del topics["/left/battery"], topics["/right/battery"]
    found = read(topics, power_averaged=setting)
    assert found.power_averaged == averaged
    assumed = select_findings(found.report.findings, "power-averaging-assumed")
    assert [of.severity for of in assumed] == severities


def test_a_gnss_message_of_ones_own_is_read_by_the_fields_the_recipe_names():
    _, table = fix()
    lat, lon = (np.round(table[name].to_numpy() * 1e7).astype(np.int64) for name in ("latitude", "longitude"))
    columns = {"pvt.lat": lat, "pvt.lon": lon, "pvt.height_mm": full(50, 400_000.0), "acc": full(50, 0.02)}
    topics = husky()
    topics["/rtk/pvt"] = "my_msgs/msg/Pvt", message_table(50, 5.0, frame="gps", **columns)
    fields = {"latitude": "pvt.lat * 1e-7", "longitude": "pvt.lon * 1e-7", "altitude": "pvt.height_mm * 0.001"}
    fields |= {f"{axis}_std": "acc" for axis in ("east", "north", "up")}
    found = read(topics, topics={"gnss": ["/rtk/pvt"]}, fields={"gnss": fields})
    wanted = read(husky())
    assert found.sensors["gnss"].type_name == "my_msgs/msg/Pvt"
    assert found.sensors["gnss"].xyz_m == wanted.sensors["gnss"].xyz_m
    for name in ("stamp_ns", "lat_deg", "lon_deg", "alt_m", "east_var_m2", "fix_status"):
        given = wanted.tables["gnss"][name].to_numpy() if name != "fix_status" else np.zeros(50)
        np.testing.assert_allclose(found.tables["gnss"][name].to_numpy(), given, rtol=1e-12)
    with pytest.raises(RoleError) as caught:
        read(topics, topics={"gnss": ["/rtk/pvt"]}, fields={"gnss": {"latitude": "lat", "longitude": "pvt.lon"}})
    assert "there is no column lat; there are" in caught.value.problems[0]


def pose(lon: np.ndarray, lat: np.ndarray) -> tuple[str, pa.Table]:
    east, north = pyproj.Transformer.from_crs(4617, 2949, always_xy=True).transform(lon, lat)
    columns = {
        "pose.pose.position.x": east,
        "pose.pose.position.y": north,
        "pose.pose.position.z": full(len(lon), 640.0),
        **xyz("pose.pose.orientation", len(lon)),
        "pose.pose.orientation.w": full(len(lon), 1.0),
    }
    covariance = cov(len(lon), 6, 0.0004)
    return "geometry_msgs/msg/PoseWithCovarianceStamped", message_table(
        len(lon), 10.0, **columns, **{"pose.covariance": covariance}
    )


def test_a_pose_is_placed_by_its_crs_and_stands_in_for_the_fixes():
    lon, lat = -71.15 + np.arange(100) * 1e-6, 47.32 + np.arange(100) * 1e-6
    topics = husky(**{"/slam/pose": pose(lon, lat)})
    placed = read(topics, topics={"pose": ["/slam/pose"]}, pose_crs="EPSG:2949")
    assert "gnss" not in placed.tables
    assert placed.gnss_crs == "EPSG:4617"
    np.testing.assert_allclose(placed.tables["pose"]["lon_deg"].to_numpy(), lon, atol=1e-11)
    np.testing.assert_allclose(placed.tables["pose"]["lat_deg"].to_numpy(), lat, atol=1e-11)
    assert placed.tables["pose"]["alt_m"].to_pylist() == [640.0] * 100
    assert placed.tables["pose"]["east_var_m2"].to_pylist() == pytest.approx([0.0004] * 100)
    assert "pose-used-as-gnss" in codes(placed)
    assert "pose-not-georeferenced" not in codes(placed)
    east, north = (topics["/slam/pose"][1][f"pose.pose.position.{axis}"].to_numpy() for axis in "xy")
    shifted = "+proj=tmerc +lon_0=-70.5 +k=0.9999 +x_0=304800 +ellps=clrk66 +towgs84=-10,158,187"
    placed = read(topics, topics={"pose": ["/slam/pose"]}, pose_crs=shifted)
    expected = pyproj.Transformer.from_crs(shifted, "EPSG:4326", always_xy=True).transform(east, north)
    assert placed.gnss_crs == "EPSG:4326"
    np.testing.assert_allclose(placed.tables["pose"]["lon_deg"].to_numpy(), expected[0], atol=1e-11)
    np.testing.assert_allclose(placed.tables["pose"]["lat_deg"].to_numpy(), expected[1], atol=1e-11)
    local = read(topics, topics={"pose": ["/slam/pose"]})
    assert local.tables["pose"]["lon_deg"].null_count == 100
    assert "pose-not-georeferenced" in codes(local)
    for crs, said in (("EPSG:4326", "not projected"), ("MTM 7", "not a CRS")):
        with pytest.raises(RecipeError, match=said):
            read(topics, topics={"pose": ["/slam/pose"]}, pose_crs=crs)


@pytest.mark.parametrize("sign", ["drawn_positive", "drawn_negative"])
def test_the_zero_of_a_current_is_subtracted_as_drawn(sign: str) -> None:
    right, found = (read(husky(), current_sign=sign, current_offset_amp=zero) for zero in (0.0, -1.5))
    for name, change in (("voltage_volt", 0.0), ("current_amp", 1.5)):
        before, after = (of.tables["power"][name].to_numpy() for of in (right, found))
        np.testing.assert_allclose(after - before, change, atol=1e-12)
    assert found.report.facts.power.zero_amp == -1.5
