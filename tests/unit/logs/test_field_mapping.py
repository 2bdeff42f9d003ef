"""Stamps told by their size, units, GPS time, and fields of messages of one's own."""

import numpy as np
import pytest

from tcpipe.logs.field_mapping import (
    MAPPED,
    MAPPED_TYPES,
    convert_units,
    find_mapping_problems,
    find_topic,
    make_mapped_message,
    make_message_fields,
    parse_stamps_ns,
    utc_from_gps_ns,
)
from tcpipe.logs.messages import list_needed_fields, read_messages

PLACE = {"x": 1.0, "y": 2.0, "z": 3.0, "x_std": 0.1, "y_std": 0.2, "z_std": 0.3}
NOW_S = 1_760_456_485


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        (np.array([NOW_S, NOW_S + 1]), "s"),
        (np.array([NOW_S + 0.25, NOW_S + 1.25]) - 0.25, "s"),
        (np.array([NOW_S, NOW_S + 1]) * 10**3, "ms"),
        (np.array([NOW_S, NOW_S + 1]) * 10**6, "us"),
        (np.array([NOW_S, NOW_S + 1]) * 10**9, "ns"),
    ],
)
def test_stamps_since_1970_tell_their_unit(values, unit):
    wanted = [NOW_S * 10**9, (NOW_S + 1) * 10**9]
    assert parse_stamps_ns(values, "auto").tolist() == wanted
    assert parse_stamps_ns(values, unit).tolist() == wanted


def test_stamps_from_a_start_of_their_own_are_asked_for():
    assert "do not count from 1970" in parse_stamps_ns(np.array([0.0, 0.02, 0.04]), "auto")
    assert parse_stamps_ns(np.array([0.0, 0.02]), "s").tolist() == [0, 20_000_000]


def test_gps_time_is_18_s_ahead_since_2017_and_17_before():
    at = [1_483_228_800 + 18, 1_483_228_800 + 17, NOW_S]  # 2017-01-01T00:00:00 UTC is 00:00:18 GPS
    assert (utc_from_gps_ns(np.array(at) * 10**9) // 10**9).tolist() == [1_483_228_800, 1_483_228_800, NOW_S - 18]


def test_units_are_those_of_the_fields():
    one = np.ones(1)
    assert convert_units(
        "imu",
        {"angular_velocity_x": 180 * one, "linear_acceleration_z": one},
        {"angular_velocity_x": "deg/s", "linear_acceleration_z": "g"},
    ) == {"angular_velocity_x": pytest.approx([np.pi]), "linear_acceleration_z": pytest.approx([9.80665])}
    assert convert_units("gnss", {"latitude": np.array([471234567.0])}, {"latitude": "1e-7 deg"})[
        "latitude"
    ] == pytest.approx([47.1234567])
    assert convert_units("command", {"linear_x": np.array([3.6])}, {"linear_x": "km/h"})["linear_x"] == pytest.approx(
        [1.0]
    )


def test_every_problem_of_a_mapping_is_said():
    said = list(
        find_mapping_problems(
            "recipe tables.imu", "imu", {"angular_velocity_x": "wx", "yaw": "y"}, {"yaw": "deg", "roll": "deg"}
        )
    )
    assert len(said) == 3
    assert "has no yaw" in said[0]
    assert "needs angular_velocity_y, angular_velocity_z, linear_acceleration_x" in said[1]
    assert "roll is not in columns" in said[2]
    assert "expected one of m/s" in next(
        find_mapping_problems("r", "command", {"linear_x": "v"}, {"linear_x": "furlongs"})
    )
    assert "expected one of gnss" in next(find_mapping_problems("r", "voltage_left", {}, {}))


@pytest.mark.parametrize("role", [role for role in MAPPED if role != "power"])
def test_what_is_needed_makes_a_message_that_can_be_read(role):
    values = {name: np.linspace(1.0, 2.0, 30) for name, field in MAPPED[role].items() if field.needed}
    columns = make_message_fields(role, values, 30) | {
        "log_time_ns": np.arange(30),
        "header.stamp.sec": np.arange(30),
        "header.stamp.nanosec": np.zeros(30, np.int64),
    }
    assert set(list_needed_fields(MAPPED_TYPES[role])) <= set(columns)
    found = read_messages(columns, role, MAPPED_TYPES[role])
    assert (len(found.row), found.dropped) == (30, {})


def test_deviations_are_the_diagonal_of_a_covariance():
    values = {name: np.full(3, value) for name, value in PLACE.items()}
    values["z"] = values["z"] + np.array([0.0, 0.1, 0.2])
    columns = make_message_fields("pose", values, 3) | {"log_time_ns": np.arange(3)}
    found = read_messages(columns, "pose", MAPPED_TYPES["pose"]).columns
    assert [found[f"{axis}_var_m2"][0] for axis in ("east", "north", "up")] == pytest.approx([0.01, 0.04, 0.09])
    assert [found[f"{axis}_m"][0] for axis in "xyz"] == [1.0, 2.0, 3.0]


def test_voltage_and_current_apart_are_bare_numbers_called_so():
    assert find_topic("left_voltage", "power", {"voltage": "value"}) == ("/left_voltage", "std_msgs/msg/Float64")
    assert find_topic("left", "power", {"current": "value"}) == ("/left/current", "std_msgs/msg/Float64")
    assert find_topic("pack", "power", {"voltage": "v", "current": "i"}) == ("/pack", "sensor_msgs/msg/BatteryState")


def test_a_message_of_ones_own_is_mapped_field_by_field_and_all_that_is_wrong_is_said():
    columns = {
        "log_time_ns": np.arange(2),
        "pvt.lat": np.array([471234567, 471234568]),
        "pvt.lon": np.array([-711234567, -711234567]),
        "acc": np.array([[0.01], [0.02]]),
        "name": np.array(["a", "b"]),
    }
    made = make_mapped_message(
        "gnss", columns, {"latitude": "pvt.lat * 1e-7", "longitude": "pvt.lon*1e-7", "east_std": "acc[0]"}
    )
    assert made["latitude"] == pytest.approx([47.1234567, 47.1234568])
    assert made["position_covariance"][:, 0] == pytest.approx([1e-4, 4e-4])
    assert made["header.stamp.sec"].tolist() == [0, 0]
    names = {"latitude": "pvt.height", "longitude": "name", "altitude": "acc[3]", "up_std": "a + b", "x": "acc"}
    wrong = make_mapped_message("gnss", columns, names)
    assert isinstance(wrong, list)
    assert len(wrong) == 6
    assert "which its messages do not have; they have pvt.lat, pvt.lon, acc, name" in wrong[1]
