"""Units of stamps by their size, GPS time, and fields of custom messages."""

import numpy as np
import pytest

from tcpipe.logs.field_mapping import (
    MAPPED,
    MAPPED_TYPES,
    find_mapping_problems,
    make_mapped_message,
    make_message_fields,
    parse_stamps_ns,
    read_fields,
    utc_from_gps_ns,
)
from tcpipe.logs.messages import read_messages

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


@pytest.mark.parametrize(
    ("role", "field", "column", "stated", "one"),
    [
        ("imu", "angular_velocity_x", "wx", "deg/s", np.pi / 180),
        ("imu", "angular_velocity_x", "gyro x [dps]", None, np.pi / 180),
        ("imu", "linear_acceleration_z", "acc_z (m/s²)", None, 1.0),
        ("imu", "linear_acceleration_z", "acc_z_mg", None, 9.80665e-3),
        ("gnss", "latitude", "lat", "1e-7 deg", 1e-7),
        ("gnss", "latitude", "lat (rad)", None, 180 / np.pi),
        ("gnss", "latitude", "latitude (deg)", None, 1.0),
        ("command", "linear_x", "speed_kmh", None, 1 / 3.6),
        ("command", "linear_x", "Speed (knots)", None, 1852 / 3600),
        ("command", "linear_x", "speed_kmh", "m/s", 1.0),  # the recipe knows better
        ("command", "linear_x", "wheel_v", None, 1.0),  # v is no volt here
        ("power", "power", "Power (w)", None, 1.0),
        ("power", "energy", "used_Wh", None, 3600.0),
        ("power", "current", "motor current [mA]", None, 1e-3),
        ("pose", "x", "x", "ft", 0.3048),
    ],
)
def test_the_unit_of_a_column_is_stated_or_stands_in_its_name(role, field, column, stated, one):
    units = {field: stated} if stated else {}
    (source,) = read_fields("r", role, {field: column}, units, [column]).values()
    assert source.evaluate(lambda name, _: {column: np.ones(2)}[name], 2).tolist() == pytest.approx(
        [one] * 2, rel=1e-12
    )


def test_a_unit_that_is_another_quantity_s_or_not_known_is_asked_for():
    for column in ("gyro_x_deg", "gyro (deg)", "gyro (filtered)"):
        (said,) = read_fields("r", "imu", {"angular_velocity_x": column}, {}, [column])
        assert "state its unit under units: rad/s" in said
        assert isinstance(
            read_fields("r", "imu", {"angular_velocity_x": column}, {"angular_velocity_x": "rad/s"}, [column]), dict
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
    found = read_messages(columns, role, MAPPED_TYPES[role])
    assert (len(found.row), found.dropped) == (30, {})


def test_deviations_are_the_diagonal_of_a_covariance():
    values = {name: np.full(3, value) for name, value in PLACE.items()}
    values["z"] = values["z"] + np.array([0.0, 0.1, 0.2])
    columns = make_message_fields("pose", values, 3) | {"log_time_ns": np.arange(3)}
    found = read_messages(columns, "pose", MAPPED_TYPES["pose"]).columns
    assert [found[f"{axis}_var_m2"][0] for axis in ("east", "north", "up")] == pytest.approx([0.01, 0.04, 0.09])
    assert [found[f"{axis}_m"][0] for axis in "xyz"] == [1.0, 2.0, 3.0]


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
    assert [word in " ".join(wrong) for word in ("no column pvt.height", "no column a, b", "has no x")] == [True] * 3
    names = {"latitude": "pvt.lat", "longitude": "name", "altitude": "acc[3]", "up_std": "acc"}
    wrong = make_mapped_message("gnss", columns, names)
    assert [word in " ".join(wrong) for word in ("name is text", "a list of 1 elements", "as acc[0]")] == [True] * 3
