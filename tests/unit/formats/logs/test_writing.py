"""Patched messages against rosbags' own serialisation of each, and what cannot be patched."""

import numpy as np
import pytest
from rosbags.rosbag1 import Reader as BagReader
from rosbags.typesys import Stores, get_typestore

from tcpipe.errors import UsageError
from tcpipe.formats.logs.writing import MessageStream, write_bag, write_mcap

TIMES = np.array([5, 1, 3], dtype=np.int64) * 1_000_000_000


def battery(topic="/battery"):
    columns = {"header.stamp.sec": np.array([7, 8, 9]), "voltage": np.array([25.0, np.nan, -1.5])}
    columns |= {
        "cell_voltage": np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]),
        "present": np.array([True, False, True]),
    }
    columns |= {"serial_number": np.array([b"ab", b"cd", b"ef"])}
    constants = {"header.frame_id": "base_link", "location": "left"}
    return MessageStream(topic, "sensor_msgs/msg/BatteryState", TIMES, columns, constants)


def test_every_column_arrives_in_its_field_in_log_order(tmp_path):
    write_bag(tmp_path / "a.bag", [battery()])
    store = get_typestore(Stores.ROS1_NOETIC)
    with BagReader(tmp_path / "a.bag") as reader:
        rows = [(time, store.deserialize_ros1(raw, c.msgtype)) for c, time, raw in reader.messages()]
    assert [time for time, _ in rows] == sorted(TIMES.tolist())
    first, second, third = (row for _, row in rows)
    assert (first.header.stamp.sec, first.serial_number, first.present) == (8, "cd", False)
    assert np.isnan(first.voltage)
    assert third.voltage == 25.0
    assert second.cell_voltage.tolist() == [5.0, 6.0]
    assert {row.location for _, row in rows} == {"left"}
    assert {row.header.frame_id for _, row in rows} == {"base_link"}


@pytest.mark.parametrize(
    "values", [np.array([b"a", b"bc"]), np.array(["a", "b"]), np.array([[1], [2, 3]], dtype=object)]
)
def test_strings_of_changing_length_are_refused(tmp_path, values):
    with pytest.raises(UsageError, match=r"/text: column data .* bytes of one length"):
        write_mcap(tmp_path / "a.mcap", [MessageStream("/text", "std_msgs/msg/String", TIMES[:2], {"data": values})])
    assert not list(tmp_path.iterdir())
