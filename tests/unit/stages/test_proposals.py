"""Roles proposed for custom messages, by names and values."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.logs.topics import Topic
from tcpipe.recipe import ReadConfig
from tcpipe.stages.proposals import find_proposals
from tcpipe.stages.read import decide_roles

RTK = """std_msgs/Header header
float64 latitude
float64 longitude   # deg
float64 altitude
float64 utm_easting
uint8 zone
string letter
"""
IMU_INSIDE = f"""Header header
sensor_msgs/Imu imu
string raw
{"=" * 80}
MSG: sensor_msgs/Imu
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
{"=" * 80}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
FIX = {"latitude": 47.06, "longitude": 15.45, "altitude": 430.0}
INERTIAL = {
    **{f"imu.angular_velocity.{axis}": 0.1 for axis in "xyz"},
    **{f"imu.linear_acceleration.{axis}": value for axis, value in zip("xyz", (0.2, 0.1, 9.7), strict=True)},
}


class Log:
    """A log whose topics have these values in every message."""

    def __init__(self, *topics, values):
        self.topics, self._values = {of.name: of for of in topics}, values

    def tables(self, topics):
        stamps = pa.array(np.arange(9, dtype=np.int64))
        columns = {name: pa.array(np.full(9, value)) for name, value in self._values.items()}
        return {name: pa.table({"log_time_ns": stamps, "publish_time_ns": stamps, **columns}) for name in topics}


def topic(name, definition, kind="driver/msg/Own", problem=None, count=9):
    return Topic(name, kind, count, 0, 10**9, "ros1", definition, problem)


def proposals(*topics, values=FIX, config=ReadConfig()):  # noqa: B008  it is frozen
    known = load_shipped_profiles()
    assigned = decide_roles(config, topics, None, known=known)
    return find_proposals(Log(*topics, values=values), assigned, config, known)


def test_a_receiver_s_own_message_is_proposed_with_the_lines_of_the_recipe():
    (found,) = proposals(topic("/rtk", RTK))
    assert (found.code, found.subject.name, found.names["role"]) == ("role-proposed", "/rtk", "gnss")
    fields = {name: name for name in FIX}
    expected = {"read.topics": {"gnss": ["/rtk"]}, "read.fields": {"gnss": fields}}
    assert [of.recipe for of in found.remedies] == [expected]
    assert "doubt" not in found.names
    beside = proposals(topic("/rtk", RTK), topic("/odom", "", "nav_msgs/msg/Odometry"))
    assert beside == (found,)


def test_accuracies_of_a_receiver_in_millimetres_are_metres():
    values = {"latitude": 470_600_000.0, "longitude": 154_500_000.0, "altitude": 430_000.0, "hAcc": 14.0, "vAcc": 20.0}
    (found,) = proposals(topic("/rtk", f"{RTK}uint32 hAcc\nuint32 vAcc\n"), values=values)
    mapped = found.remedies[0].recipe["read.fields"]["gnss"]
    assert mapped["east_std"] == mapped["north_std"] == "hAcc * 0.001"
    assert mapped["up_std"] == "vAcc * 0.001"


@pytest.mark.parametrize(
    ("values", "fields", "doubt"),
    [
        ({"latitude": 470_600_000.0, "longitude": 154_500_000.0, "altitude": 430_000.0}, ("latitude * 1e-7", "altitude * 0.001"), ""),
        ({"latitude": 0.8213, "longitude": 0.2697, "altitude": 430.0}, ("latitude", "altitude"), "radians"),
        ({"latitude": 4703.6, "longitude": 1527.0, "altitude": 430.0}, ("latitude", "altitude"), "no degrees"),
        ({"latitude": 47.06, "longitude": 15.45, "altitude": 430_000.0}, ("latitude", None), ""),
    ],
)  # fmt: skip
def test_values_decide_what_a_number_is(values, fields, doubt):
    (found,) = proposals(topic("/rtk", RTK), values=values)
    mapped = found.remedies[0].recipe["read.fields"]["gnss"]
    assert (mapped["latitude"], mapped.get("altitude")) == fields
    assert doubt in found.names.get("doubt", "")
    assert bool(doubt) == ("doubt" in found.names)


def test_fields_are_looked_for_in_the_messages_inside_a_message():
    (found,) = proposals(topic("/vectornav", IMU_INSIDE), values=INERTIAL)
    fields = found.remedies[0].recipe["read.fields"]["imu"]
    assert fields["angular_velocity_z"] == "imu.angular_velocity.z"
    assert fields["linear_acceleration_x"] == "imu.linear_acceleration.x"


def test_an_acceleration_in_g_is_converted_and_one_without_gravity_is_doubted():
    in_g = {name: value / 9.80665 if "acceleration" in name else value for name, value in INERTIAL.items()}
    (found,) = proposals(topic("/vectornav", IMU_INSIDE), values=in_g)
    assert found.remedies[0].recipe["read.fields"]["imu"]["linear_acceleration_z"].endswith(" * 9.80665")
    (found,) = proposals(topic("/vectornav", IMU_INSIDE), values=dict.fromkeys(INERTIAL, 0.1))
    assert "9.81" in found.names["doubt"]


def test_nothing_is_proposed_for_what_is_played_or_cannot_be_read_or_lacks_a_field():
    fix = topic("/fix", "", "sensor_msgs/msg/NavSatFix")
    assert not proposals(topic("/rtk", RTK), fix)
    assert not proposals(topic("/rtk", RTK), config=ReadConfig(ignore_topics=["/rtk"]))
    assert not proposals(topic("/rtk", RTK), config=replace(ReadConfig(), topics={"gnss": []}))
    others = [
        topic("/empty", RTK, count=0),
        topic("/lost", RTK, problem="encoded as json"),
        topic("/text", RTK.replace("float64 latitude", "string latitude")),
        topic("/half", "float64 latitude"),
        topic("/broken", "float64 latitude\nfloat64 longitude\n???\n"),
        topic("/endless", f"Own inner\n{'=' * 80}\nMSG: driver/Own\nOwn inner\n"),
        topic("/tcpipe/track", RTK),
    ]
    assert not proposals(*others)


def test_a_current_without_a_voltage_asks_for_the_voltage_and_zeros_are_nothing():
    own = topic("/pdu", "float32 battery_current\n")
    (found,) = proposals(own, values={"battery_current": 3.0})
    (source,) = found.remedies[0].recipe["power_sources"]
    assert source["nominal_voltage_volt"] == 24.0
    assert "voltage" in found.names["doubt"]
    assert not proposals(own, values={"battery_current": 0.0})
