"""Logs of random messages in every container, written by other people's writers, and what rosbags reads back from them."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import normalize_fieldname

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)

TYPES = (
    "sensor_msgs/msg/Imu",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/MultiDOFJointState",
    "diagnostic_msgs/msg/DiagnosticArray",
    "nav_msgs/msg/Path",
    "geometry_msgs/msg/PolygonStamped",
    "std_msgs/msg/ColorRGBA",
    "std_msgs/msg/UInt8MultiArray",
    "std_msgs/msg/Empty",
    "trajectory_msgs/msg/JointTrajectory",
)
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Message:
    """One serialised message, and the object it was made from."""

    topic: str
    type_name: str
    log_time_ns: int
    payload: bytes
    value: object


def random_messages(seed, *, count=60, ragged=False, types=TYPES, store=ROS2):
    """Random messages of several types, one topic each; ``ragged`` lets lengths differ from message to message."""
    rng = np.random.default_rng(seed)
    serialize = store.serialize_ros1 if store is ROS1 else store.serialize_cdr
    messages = []
    for type_name in types:
        shape_seed = int(rng.integers(1 << 30))
        for index in range(count):
            lengths = rng if ragged else np.random.default_rng(shape_seed)
            value = _random_value((Nodetype.NAME, type_name), rng, lengths, store)
            stamp = START_NS + index * 10_000_000 + int(rng.integers(0, 3_000_000))
            topic = "/" + type_name.rsplit("/", 1)[-1]
            messages.append(Message(topic, type_name, stamp, bytes(serialize(value, type_name)), value))
    return sorted(messages, key=lambda message: message.log_time_ns)


def write_mcap(path, messages, *, store=ROS2, compression=CompressionType.ZSTD, chunk_bytes=8192, **options):
    """Write messages with the mcap library, defined in the file unless ``define`` is false."""
    ros1 = store is ROS1
    define = options.pop("define", True)
    with path.open("wb") as file:
        writer = McapWriter(file, compression=compression, chunk_size=chunk_bytes, **options)
        writer.start(profile="ros1" if ros1 else "ros2", library="test")
        channels = {}
        for sequence, message in enumerate(messages):
            if message.topic not in channels:
                text, _ = store.generate_msgdef(message.type_name, ros_version=1 if ros1 else 2)
                schema = writer.register_schema(
                    message.type_name, "ros1msg" if ros1 else "ros2msg", text.encode() if define else b""
                )
                channels[message.topic] = writer.register_channel(message.topic, "ros1" if ros1 else "cdr", schema)
            writer.add_message(
                channels[message.topic], message.log_time_ns, message.payload, message.log_time_ns - 5, sequence
            )
        writer.finish()
    return path


def write_bag(path, messages, compression=None, *, chunk_bytes=1 << 20):
    """Write ROS 1 messages with rosbags."""
    writer = BagWriter(path)
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(compression)
    with writer:
        _write_rosbags(writer, messages, ROS1)
    return path


def write_rosbag2(path, messages, storage=StoragePlugin.SQLITE3, compression=None):
    """Write ROS 2 messages with rosbags."""
    writer = Rosbag2Writer(path, version=9, storage_plugin=storage)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        _write_rosbags(writer, messages, ROS2)
    return path


def expected_columns(messages: Iterable[Message], topic: str, store=ROS2) -> dict[str, list]:
    """Return what a topic's table must hold, by dotted field name, in the order of log time."""
    ours = [message for message in messages if message.topic == topic]
    rows = [plain_row(message.value, message.type_name, store) for message in ours]
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else {})}


def plain_row(value: object, type_name: str, store, prefix: str = "") -> dict[str, object]:
    """Return a rosbags object as plain values by dotted name, original field names kept."""
    row: dict[str, object] = {}
    for name, (kind, argument) in store.fielddefs[type_name][1]:
        if name == "structure_needs_at_least_one_member":
            continue
        field = getattr(value, normalize_fieldname(name))
        if kind == Nodetype.NAME:
            row |= plain_row(field, argument, store, f"{prefix}{name}.")
        else:
            row[prefix + name] = _plain(field, (kind, argument), store)
    return row


def assert_same(table: pa.Table, columns: dict[str, Sequence[object]]) -> None:
    """Compare exactly, column by column, NaN equal to NaN."""
    assert table.column_names[2:] == list(columns)
    for name, values in columns.items():
        assert json.dumps(table.column(name).to_pylist()) == json.dumps(values), name


def table_bytes(table: pa.Table) -> bytes:
    """Return a table as bytes, equal for equal content."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table.combine_chunks())
    return sink.getvalue().to_pybytes()


def _write_rosbags(writer, messages, store) -> None:
    connections = {}
    for message in messages:
        if message.topic not in connections:
            connections[message.topic] = writer.add_connection(message.topic, message.type_name, typestore=store)
        writer.write(connections[message.topic], message.log_time_ns, message.payload)


def _random_value(described, rng, lengths, store):
    kind, argument = described
    if kind == Nodetype.NAME:
        fields = {
            normalize_fieldname(name): _random_value(field, rng, lengths, store)
            for name, field in store.fielddefs[argument][1]
        }
        return store.types[argument](**fields)
    if kind == Nodetype.BASE:
        return _random_scalar(argument[0], rng, lengths)
    inner, length = argument
    count = length if kind == Nodetype.ARRAY else int(lengths.integers(0, 6))
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        dtype = {"bool": "?", "byte": "i1", "char": "u1"}.get(inner[1][0], inner[1][0])
        return np.array([_random_scalar(inner[1][0], rng, lengths) for _ in range(count)], dtype)
    return [_random_value(inner, rng, lengths, store) for _ in range(count)]


def _random_scalar(name, rng, lengths):
    if name == "string":
        return "".join(rng.choice(list("abcdefgh_/")) for _ in range(int(lengths.integers(0, 9))))
    if name == "bool":
        return bool(rng.integers(2))
    if name.startswith("float"):
        value = float(np.dtype(name).type(rng.normal() * 100))
        return float("nan") if rng.random() < 0.05 else value
    limits = np.iinfo({"byte": "i1", "char": "u1"}.get(name, name))
    return int(rng.integers(limits.min, limits.max, dtype=limits.dtype, endpoint=True))


def _plain(value, described, store):
    kind, argument = described
    if kind == Nodetype.NAME:
        return {
            name: _plain(getattr(value, normalize_fieldname(name)), field, store)
            for name, field in store.fielddefs[argument][1]
            if name != "structure_needs_at_least_one_member"
        }
    if kind == Nodetype.BASE:
        return value
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_plain(item, argument[0], store) for item in value]
