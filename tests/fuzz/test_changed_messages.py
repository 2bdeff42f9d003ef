"""Messages and definitions with changed bytes: what rosbags reads of them is read the same, and everything else is refused."""

import json
import struct

import numpy as np
import pytest
from random_messages import ROS1, ROS2, plain_row, random_messages
from rosbags.serde import SerdeError

from tcpipe.formats.logs.arrow_columns import TopicTable
from tcpipe.formats.logs.log_part import MessageBlock
from tcpipe.formats.logs.ros_types import DefinitionError, TypeLibrary

TYPES = (
    "std_msgs/msg/ColorRGBA",
    "diagnostic_msgs/msg/DiagnosticArray",
    "sensor_msgs/msg/JointState",
    "std_msgs/msg/UInt8MultiArray",
    "nav_msgs/msg/Path",
    "sensor_msgs/msg/BatteryState",
)
ALIKE = 8
"""Number of valid messages before the changed ones: enough to learn a layout."""
CHANGES = 24
"""Changed copies of each message or definition."""
STORES = {"cdr": ROS2, "ros1": ROS1}
ODD_DEFINITIONS = {
    "ros2msg": "uint8 A=1\nstring<=5 text 'x'\nint32[<=3] some\nMade[2] again\nwstring wide\nfloat64[36] matrix\n",
    "ros2idl": "module made_msgs { module msg { typedef double double__36[36]; struct Made {"
    ' @unit(value="m") double x; sequence<long, 4> some; double__36 matrix; wstring wide; }; }; };',
}


def changed(data, rng):
    """Flip, overwrite, cut, double or insert some bytes."""
    found = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at, size = int(rng.integers(len(found) + 1)), int(rng.integers(1, 9))
        kind = rng.integers(5)
        if kind == 0 and at < len(found):
            found[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            found[at : at + size] = rng.choice([b"\0", b"\xff", b"\x7f"]) * size
        elif kind == 2:
            del found[at : at + size]
        elif kind == 3:
            found[at:at] = found[at : at + 40 * size]
        else:
            found[at : at + size] = rng.bytes(size)
    return bytes(found)


def define(name, encoding):
    return STORES[encoding].generate_msgdef(name, ros_version=1 if encoding == "ros1" else 2)[0]


def decode(message_type, encoding, payloads):
    """Return the table of messages, whose log times are their numbers, and how many could not be decoded."""
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    order = np.arange(len(payloads))
    table = TopicTable(message_type, encoding)
    table.add(
        MessageBlock(0, memoryview(b"".join(payloads)), np.cumsum(lengths) - lengths, lengths, order, order, order)
    )
    found = table.take()
    found.validate(full=True)
    return found, table.undecodable


@pytest.mark.parametrize("encoding", STORES)
@pytest.mark.parametrize("name", TYPES)
def test_changed_messages_are_what_rosbags_reads_row_by_row(name, encoding):
    rng, schema = np.random.default_rng(3), f"ros{1 if encoding == 'ros1' else 2}msg"
    message_type = TypeLibrary(None).find_type(
        name, definition=define(name, encoding), schema_encoding=schema, ros1=encoding == "ros1"
    )
    store = STORES[encoding]
    deserialize = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    messages = random_messages(2, count=3, types=(name,), ragged=True, store=STORES[encoding])
    for valid in (1, ALIKE):
        payloads = [messages[0].payload] * valid
        payloads += [changed(message.payload, rng) for message in messages for _ in range(CHANGES // len(messages))]
        found, undecodable = decode(message_type, encoding, payloads)
        assert found.num_rows + undecodable == len(payloads)
        for row in found.drop_columns(["publish_time_ns"]).to_pylist():
            try:
                value = deserialize(payloads[row.pop("log_time_ns")], name)
            except (SerdeError, ValueError, IndexError, OverflowError, AssertionError, struct.error):
                continue
            expected = plain_row(value, name, store)
            assert json.dumps(row) == json.dumps(expected, default=lambda value: value.tolist())


@pytest.mark.parametrize("schema", ["ros2msg", "ros1msg", "ros2idl"])
def test_changed_definitions_are_read_or_refused(schema):
    rng, ros1 = np.random.default_rng(3), schema == "ros1msg"
    encoding = "ros1" if ros1 else "cdr"
    texts = [] if schema == "ros2idl" else [define(name, encoding) for name in TYPES]
    for text in (*texts, *filter(None, [ODD_DEFINITIONS.get(schema)])):
        for data in (text.encode(), *(changed(text.encode(), rng) for _ in range(CHANGES))):
            found = TypeLibrary(None).find_type(
                "made_msgs/msg/Made",
                definition=data.decode(errors="backslashreplace"),
                schema_encoding=schema,
                ros1=ros1,
            )
            if not isinstance(found, DefinitionError):
                decode(found, encoding, [b"\x00\x01\x00\x00" + bytes(60)] * ALIKE)
