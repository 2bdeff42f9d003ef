"""The bundled definitions: all parse for ROS 1 and ROS 2, and bytes laid out by hand decode to what was put in."""

import struct

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tcpipe.formats.logs.ros_types import load_shipped_definitions


def store(kind: Stores):
    found = get_typestore(kind)
    for name, text in load_shipped_definitions().items():
        found.register(get_types_from_msg(text, name))
    return found


# The sums that the packages' own generated code states; they cover every field's name, type and order.
@pytest.mark.parametrize(
    ("name", "md5"),
    [
        ("husky_msgs/msg/HuskyStatus", "fd724379c53d89ec4629be3b235dc10d"),
        ("warthog_msgs/msg/Status", "0da9e8a166e293e1a5dc327e76c16322"),
        ("jackal_msgs/msg/Status", "c851ebcf9a6e20b196bc7894e285b4f6"),
        ("nmea_msgs/msg/Sentence", "9f221efc5f4b3bac7ce4af102b32308b"),
    ],
)
def test_md5_sums(name: str, md5: str) -> None:
    assert store(Stores.ROS1_NOETIC).generate_msgdef(name, ros_version=1)[1] == md5


def test_a_husky_status_laid_out_by_hand() -> None:
    header = struct.pack("<III", 7, 100, 200) + struct.pack("<I", 4) + b"base"
    body = struct.pack("<I10d", 1234, 10.0, 1.0, 2.0, 3.0, 26.0, 25.0, 24.0, 30.0, 31.0, 40.0)
    tail = struct.pack("<dHd6?", 41.0, 480, 0.9, True, False, True, False, True, False)
    message = store(Stores.ROS1_NOETIC).deserialize_ros1(header + body + tail, "husky_msgs/msg/HuskyStatus")
    assert message.header.frame_id == "base"
    assert (message.left_driver_current, message.right_driver_current, message.battery_voltage) == (2.0, 3.0, 26.0)
    assert (message.capacity_estimate, message.charge_estimate, message.current_limit) == (480, 0.9, False)


def test_a_clearpath_power_laid_out_by_hand() -> None:
    cdr = (
        b"\0\1\0\0" + struct.pack("<iI", 100, 200) + struct.pack("<I", 1) + b"\0" + struct.pack("<5b", -1, 1, -1, 0, -1)
    )
    cdr += (
        b"\0" * (-(len(cdr) - 4) % 4)
        + struct.pack("<I3f", 3, 26.0, 25.5, 25.25)
        + struct.pack("<I3f", 3, 1.0, 2.0, 3.0)
    )
    message = store(Stores.ROS2_HUMBLE).deserialize_cdr(cdr, "clearpath_platform_msgs/msg/Power")
    assert message.measured_voltages.tolist() == [26.0, 25.5, 25.25]
    assert message.measured_currents.tolist() == [1.0, 2.0, 3.0]
    assert (message.battery_connected, message.charger_connected) == (1, 0)
