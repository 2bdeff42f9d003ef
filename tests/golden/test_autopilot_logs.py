"""Autopilot logs against the tools of their makers, pyulog and pymavlink; and what roles get of them against numbers written by hand."""

import json
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from autopilot_files import AMP, ANTENNA_FRD, SPEED_MPS, VOLT, DataFlash, Drive, Ulog, write_dataflash, write_ulog
from installed_command import tcpipe as run_tcpipe
from shared_data import shared_data

import tcpipe
from tcpipe.formats.logs.autopilot_log import read_autopilot_records
from tcpipe.logs.topics import split_notes
from tcpipe.recipe import ReadConfig
from tcpipe.robots import Profiles
from tcpipe.stages.read import read_run

WRITERS = {"ulog": write_ulog, "dataflash": write_dataflash}
FIELDS = ("latitude", "longitude", "altitude", "status.status", "header.frame_id")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return the same short drive as logs of both autopilots."""
    folder = tmp_path_factory.mktemp("autopilots")
    return {kind: write(folder / f"drive.{kind}", Drive(40.0)) for kind, write in WRITERS.items()}


def read_by_pyulog(path):
    """Return pyulog's columns by topic."""
    pyulog = pytest.importorskip("pyulog", reason="pyulog is not installed")
    found = {}
    for of in pyulog.ULog(str(path)).data_list:
        order = np.argsort(of.data["timestamp"], kind="stable")
        name = f"{of.name}_{of.multi_id}" if of.multi_id else of.name
        found[name] = {field: values[order] for field, values in of.data.items()}
    return found


def read_by_pymavlink(path):
    """Return pymavlink's columns by name of message and instance."""
    reader = pytest.importorskip("pymavlink.DFReader", reason="pymavlink is not installed")
    log, rows = reader.DFReader_binary(str(path)), {}
    while (message := log.recv_msg()) is not None:
        instance = next(
            (getattr(message, of) for of in ("I", "Instance") if isinstance(getattr(message, of, None), int)), 0
        )
        name = f"{message.get_type()}_{instance}" if instance else message.get_type()
        rows.setdefault(name, []).append(message)
    log.close()
    return {
        name: {field: np.array([getattr(row, field) for row in found]) for field in found[0].get_fieldnames()}
        for name, found in rows.items()
    }


def assert_same_columns(path, kind, theirs):
    records = read_autopilot_records(path, kind)
    for name, of in records.messages.items():
        for field, values in of.read_columns(records.data).items():
            parts = {field: values} if values.ndim == 1 else {f"{field}[{i}]": v for i, v in enumerate(values.T)}
            for part, mine in parts.items():
                other = theirs[name].get(part)
                if other is None or mine.dtype.kind == "S":  # formats inside formats are called otherwise; texts
                    continue
                assert len(other) == len(mine), (name, part)
                same = (
                    np.asarray(other).astype(np.float64),
                    mine.view(np.int8 if other.dtype == np.int8 else mine.dtype),
                )
                np.testing.assert_allclose(*same, rtol=1e-12, err_msg=f"{name} {part}")
    return set(records.messages)


def test_columns_of_ulog_are_those_of_pyulog(logs):
    theirs = read_by_pyulog(logs["ulog"])
    assert assert_same_columns(logs["ulog"], "ulog", theirs) == set(theirs)


def test_columns_of_dataflash_are_those_of_pymavlink(logs):
    theirs = read_by_pymavlink(logs["dataflash"])
    assert assert_same_columns(logs["dataflash"], "dataflash", theirs) == set(theirs) - {"FMT"}


@pytest.mark.parametrize(
    "name", ["sample.ulg", "sample_log_small.ulg", "sample_px4_events.ulg", "sample_appended_multiple.ulg"]
)
def test_columns_of_public_ulogs_are_those_of_pyulog(name):
    path = shared_data(f"autopilots/pyulog/{name}")
    found, theirs = assert_same_columns(path, "ulog", read_by_pyulog(path)), read_by_pyulog(path)
    assert set(theirs) - found <= {"mission"}  # one message, stamped 20 minutes after the end


@pytest.mark.parametrize("name", ["rover_61.BIN", "copter_3.4.BIN", "copter_3.6.BIN", "plane_2014.BIN"])
def test_columns_of_public_dataflash_logs_are_those_of_pymavlink(name):
    path = shared_data(f"autopilots/ardupilot/{name}")
    assert {"IMU"} <= assert_same_columns(path, "dataflash", read_by_pymavlink(path))


# ---------------------------------------------------------------- meaning
def read_one(log, path, topic):
    """Return the first message of a topic of a log that is written now."""
    path.write_bytes(log.bytes())
    with tcpipe.read_log(path) as opened:
        assert not split_notes(opened.findings)[0]
        return opened.tables([topic])[topic].to_pylist()[0]


def test_axes_of_px4_become_forward_left_up(tmp_path):
    log = Ulog()
    log.format(
        "sensor_combined",
        "float[3] gyro_rad",
        "int32_t accelerometer_timestamp_relative",
        "float[3] accelerometer_m_s2",
    )
    log.subscribe("sensor_combined", 5)
    for us in range(10):
        log.data("sensor_combined", 5, us, 0.5, 0.25, -0.125, 0, 1.0, 2.0, -9.75)
    row = read_one(log, tmp_path / "a.ulg", "/sensor_combined/imu")
    assert [row[f"angular_velocity.{axis}"] for axis in "xyz"] == [0.5, -0.25, 0.125]  # a turn to the left
    assert [row[f"linear_acceleration.{axis}"] for axis in "xyz"] == [1.0, -2.0, 9.75]  # at rest up, as REP-145 has it
    assert (row["orientation_covariance"][0], row["header.frame_id"]) == (-1.0, "base_link")


def test_axes_of_ardupilot_become_forward_left_up_and_a_broken_sensor_is_not_used(tmp_path):
    log = DataFlash()
    log.format("IMU", "QBffffffBB", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,GH,AH")
    log.data("IMU", 1, 0, 0.5, 0.25, -0.125, 1.0, 2.0, -9.75, 1, 1)
    log.data("IMU", 2, 0, 0.5, 0.25, -0.125, 1.0, 2.0, -9.75, 0, 1)
    row = read_one(log, tmp_path / "a.bin", "/IMU/imu")
    assert [row[f"angular_velocity.{axis}"] for axis in "xyz"] == [0.5, -0.25, 0.125]
    assert [row[f"linear_acceleration.{axis}"] for axis in "xyz"] == [1.0, -2.0, 9.75]
    with tcpipe.read_log(tmp_path / "a.bin") as opened:
        assert np.isnan(opened.tables(["/IMU/imu"])["/IMU/imu"]["linear_acceleration.x"].to_pylist()[1])


GPS_OF_2021 = ("int32_t lat", "int32_t lon", "int32_t alt", "int32_t alt_ellipsoid", "uint64_t time_utc_usec",
    "int32_t timestamp_time_relative", "float s_variance_m_s", "float eph", "float epv", "float vel_n_m_s", "float vel_e_m_s",
    "float vel_d_m_s", "uint8_t fix_type", "bool vel_ned_valid")  # fmt: skip


def test_a_fix_of_px4_from_before_2023_is_in_degrees_metres_and_utc(tmp_path):
    log = Ulog()
    log.format("vehicle_gps_position", *GPS_OF_2021)
    log.subscribe("vehicle_gps_position", 5)
    for us in (2_000_000, 3_000_000):
        values = (
            473_977_418,
            -85_455_940,
            488_000,
            536_000,
            1_618_986_656_000_000 + us + 250,
            250,
            0.5,
            1.5,
            2.0,
            3.0,
            4.0,
            -0.5,
            5,
            True,
        )
        log.data("vehicle_gps_position", 5, us, *values)
    row = read_one(log, tmp_path / "a.ulg", "/vehicle_gps_position/fix")
    assert [row[name] for name in FIELDS] == pytest.approx([47.3977418, -8.545594, 536.0, 2, "gps"], abs=1e-9)
    assert row["position_covariance"] == pytest.approx([2.25, 0, 0, 0, 2.25, 0, 0, 0, 4.0])
    assert row["log_time_ns"] == 1_618_986_658_000_000_000  # of pyulog's own sample, which tells that time
    velocity = read_one(log, tmp_path / "a.ulg", "/vehicle_gps_position/velocity")
    assert [velocity[f"twist.twist.linear.{axis}"] for axis in "xyz"] == [4.0, 3.0, 0.5]
    assert velocity["twist.covariance"][0] == 0.25


@pytest.mark.parametrize(
    ("kind", "status"), [(0, -1), (1, -1), (2, 0), (3, 0), (4, 1), (5, 2), (6, 2), (8, -1), (255, -1)]
)
def test_types_of_fixes_of_both_autopilots(tmp_path, kind, status):
    px4, ardupilot = Ulog(), DataFlash()
    px4.format("vehicle_gps_position", *GPS_OF_2021)
    px4.subscribe("vehicle_gps_position", 5)
    px4.data("vehicle_gps_position", 5, 1, 1, 1, 1, 1, 1, 0, 0.5, 1.5, 2.0, 3.0, 4.0, -0.5, kind, True)
    ardupilot.format("GPS", "QBIHLLefff", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt,Spd,GCrs,VZ")
    ardupilot.data("GPS", 1, kind, 0, 0, 1, 1, 1, 0.0, 0.0, 0.0)
    fix = read_one(px4, tmp_path / "a.ulg", "/vehicle_gps_position/fix")
    assert fix["status.status"] == read_one(ardupilot, tmp_path / "a.bin", "/GPS/fix")["status.status"] == status
    assert np.isnan(fix["altitude"]) == (kind < 3)  # a fix in the plane has the height of an earlier one


@pytest.mark.parametrize(("day", "leap_s"), [("2014-03-01", 16), ("2016-12-31", 17), ("2024-05-05", 18)])
def test_weeks_of_gps_become_utc_with_its_leap_seconds(tmp_path, day, leap_s):
    utc = datetime.fromisoformat(f"{day}T11:22:33.5+00:00")
    gps_s = (utc - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds() + leap_s
    log = DataFlash()
    log.format("GPS", "QBIHLLefff", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt,Spd,GCrs,VZ")
    week, rest_s = divmod(gps_s, 7 * 86_400)
    log.data("GPS", 7_000_000, 3, int(rest_s * 1000), int(week), 1, 1, 1, 0.0, 0.0, 0.0)
    row = read_one(log, tmp_path / "a.bin", "/GPS/fix")
    assert row["log_time_ns"] == round(utc.timestamp() * 1e3) * 10**6
    assert row["position_covariance_type"] == 0  # no GPA tells the accuracy


def test_drawn_current_is_negative_and_what_is_unknown_is_no_number(tmp_path):
    log = Ulog()
    log.format("battery_status", "float voltage_v", "float current_a")
    log.subscribe("battery_status", 1)
    log.subscribe("battery_status", 2, 1)
    log.data("battery_status", 1, 1, 24.0, 5.0)
    log.data("battery_status", 2, 1, 0.0, -1.0)
    row = read_one(log, tmp_path / "a.ulg", "/battery_status/battery")
    assert (row["voltage"], row["current"]) == (24.0, -5.0)
    row = read_one(log, tmp_path / "a.ulg", "/battery_status_1/battery")
    assert np.isnan([row["voltage"], row["current"]]).all()


def test_wheels_of_ardupilot_give_speed_and_turn_in_the_middle_of_two_messages(tmp_path):
    log = DataFlash()
    log.format("PARM", "QNff", "TimeUS,Name,Value,Default")
    log.format("WENC", "Qfbfb", "TimeUS,Dist0,Qual0,Dist1,Qual1")
    for name, value in (("WENC_TYPE", 1), ("WENC2_TYPE", 1), ("WENC_POS_Y", -0.2), ("WENC2_POS_Y", 0.3)):
        log.data("PARM", 1, name.encode(), value, 0.0)
    for second in range(3):  # the left wheel is nearer to the middle: 1 - 0.2 ω and 1 + 0.3 ω with ω = 0.5 to the left
        log.data("WENC", second * 1_000_000, 0.9 * second, 100, 1.15 * second, 100)
    log_path = tmp_path / "a.bin"
    assert np.isnan(read_one(log, log_path, "/WENC/odometry")["twist.twist.linear.x"])
    with tcpipe.read_log(log_path) as opened:
        rows = opened.tables(["/WENC/odometry"])["/WENC/odometry"].to_pylist()
    assert rows[1]["twist.twist.linear.x"] == pytest.approx(1.0, abs=1e-6)
    assert rows[1]["twist.twist.angular.z"] == pytest.approx(0.5, abs=1e-6)
    assert [row["log_time_ns"] for row in rows] == [0, 500_000_000, 1_500_000_000]


def test_wheels_of_px4_need_a_radius(tmp_path):
    log = Ulog()
    log.format("wheel_encoders", "float[2] wheel_speed")
    log.subscribe("wheel_encoders", 1)
    log.data("wheel_encoders", 1, 1, 10.0, 20.0)
    (tmp_path / "a.ulg").write_bytes(log.bytes())
    with tcpipe.read_log(tmp_path / "a.ulg") as opened:
        assert list(opened.topics) == ["/wheel_encoders"]
        assert [of.names["fields"] for of in opened.findings if of.code == "fields-missing"] == [
            "a wheel radius (RDD_WHEEL_RADIUS)"
        ]
    log.parameter("RDD_WHEEL_RADIUS", 0.125)
    assert read_one(log, tmp_path / "a.ulg", "/wheel_encoders/odometry")["twist.twist.linear.x"] == 1.875


@pytest.mark.parametrize(
    ("name", "fields", "values", "expected"),
    [
        ("rover_speed_setpoint", ("speed_body_x",), (1.25,), (1.25, -0.5)),  # its turn is another message's
        ("rover_differential_setpoint", ("forward_speed_setpoint", "yaw_rate_setpoint"), (1.5, 0.25), (1.5, -0.25)),
        ("rover_ackermann_setpoint", ("forward_speed_setpoint",), (0.75,), (0.75, -0.5)),
        ("rover_mecanum_setpoint", ("forward_speed_setpoint", "yaw_rate_setpoint"), (2.0, -0.25), (2.0, 0.25)),
        ("differential_drive_setpoint", ("speed", "yaw_rate"), (1.75, 0.125), (1.75, -0.125)),
    ],
)
def test_commands_of_px4_of_every_version_are_a_speed_and_a_turn_to_the_left(tmp_path, name, fields, values, expected):
    log = Ulog()
    if len(fields) == 1:
        log.format("rover_rate_setpoint", "float yaw_rate_setpoint")
        log.subscribe("rover_rate_setpoint", 1)
        log.data("rover_rate_setpoint", 1, 1_000_000, 0.5)
    log.format(name, *(f"float {field}" for field in fields))
    log.subscribe(name, 2)
    log.data(name, 2, 1_500_000, *values)
    row = read_one(log, tmp_path / "a.ulg", f"/{name}/command")
    assert (row["twist.linear.x"], row["twist.angular.z"]) == expected


# ---------------------------------------------------------------- from the command to labels
@pytest.mark.parametrize("kind", WRITERS)
def test_a_drive_is_ingested_without_a_recipe(tmp_path, kind):
    path = WRITERS[kind](tmp_path / {"ulog": "drive.ulg", "dataflash": "00000012.BIN"}[kind], Drive(100.0))
    told = json.loads(run_tcpipe("inspect", path, "--json", cwd=tmp_path).stdout)
    played = {topic["role"] for topic in told["topics"] if topic["role"]}
    assert played == {"gnss", "gnss_velocity", "imu", "wheel_odometry", "power", "command", "transforms"}
    assert (told["container"], told["problems"], told["damage"]) == (kind, [], [])
    assert told["start_ns"] // 10**9 == 1_700_000_005 - 5 * (kind == "dataflash")  # its parameters are first
    done = run_tcpipe("ingest", path, "--store", "store", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    grades = re.findall(r"verdict: (\w+) .* · ([a-z ]+)", done.stdout)
    assert grades == [("position", "usable"), ("time", "usable"), ("energy", "usable with care")]  # the mass is unknown
    assert f"{path.stem}-" in done.stdout
    (segments,) = (tmp_path / "store").rglob("segments.parquet")
    table = pq.read_table(segments)
    energy, seconds = (np.array(table[name].to_pylist()) for name in ("energy_joule", "duration_s"))
    assert len(energy) > 90
    assert energy.mean() == pytest.approx(VOLT * AMP / SPEED_MPS, rel=0.01)
    assert seconds.mean() == pytest.approx(1.0 / SPEED_MPS, rel=0.01)


def test_the_antenna_lies_where_the_parameters_say(logs):
    for path in logs.values():
        with tcpipe.read_log(path) as log:
            streams = read_run(log, ReadConfig(), robot=None, known=Profiles({}, ()))
        assert streams.sensors["gnss"].xyz_m == pytest.approx((ANTENNA_FRD[0], -ANTENNA_FRD[1], -ANTENNA_FRD[2]))
        assert streams.sensors["gnss"].placed_by == "tf_static"


def test_a_bin_that_is_no_log_is_passed_over_in_a_folder(tmp_path):
    (tmp_path / "000000.bin").write_bytes(np.zeros(400, np.float32).tobytes())  # a scan of a laser
    write_dataflash(tmp_path / "1.BIN", Drive(10.0))
    told = json.loads(run_tcpipe("inspect", tmp_path, "--json", cwd=tmp_path).stdout)
    assert Path(told["path"]).name == "1.BIN"
    refused = run_tcpipe("inspect", "000000.bin", cwd=tmp_path)
    assert (refused.returncode != 0, "not a log" in refused.stderr) == (True, True)
