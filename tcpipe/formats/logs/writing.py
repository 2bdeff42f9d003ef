"""Writing logs: columns of numbers become messages in a .mcap, a ROS 1 .bag or a ROS 2 bag directory.

The home of mcap's writer and of rosbags on the writing side. All messages of a stream have the same
layout, because strings and sequences keep their lengths. rosbags serialises one message; the others are copies of its
bytes with the values of the columns. Two serialisations with different bytes of a field show the position of the field.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from tcpipe.arrays import Bytes, Ints, NamedArrays
from tcpipe.errors import UsageError
from tcpipe.formats.atomic import write_atomic_directory, write_atomic_file
from tcpipe.formats.logs.ros_types import load_shipped_definitions

Encoding = Literal["ros1", "cdr"]

_CHUNK_BYTES = 1 << 20
_BYTES = {"octet": "uint8", "char": "uint8"}
_MISSING_IN_ROSBAGS = {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"}


@dataclass(frozen=True, slots=True)
class MessageStream:
    """One topic, ready to be written.

    ``columns`` contain the fields that vary, by dotted name, one row per message: numbers, arrays of
    one length (second axis), or bytes of one length for strings. ``constants`` contain constant fields by dotted name
    (lists of dicts for lists of messages); all other fields are zero or empty.
    """

    topic: str
    type_name: str
    log_time_ns: Ints
    columns: NamedArrays = field(default_factory=dict)
    constants: Mapping[str, Any] = field(default_factory=dict)
    publish_time_ns: Ints | None = None
    latched: bool = False
    definition: str = ""
    """Definition of a type that is neither in rosbags nor in `load_shipped_definitions`."""


def write_mcap(path: Path, streams: Sequence[MessageStream], *, encoding: Encoding = "cdr") -> None:
    """Write a log in chunks with CRCs: ROS 2 (cdr), or ROS 1 in MCAP (ros1); streams of a topic share a channel."""
    version = 1 if encoding == "ros1" else 2
    with write_atomic_file(path) as temporary, temporary.open("wb") as out:
        writer = McapWriter(out, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile=f"ros{version}", library="tcpipe")
        channels: dict[str, int] = {}
        for stream in streams:
            if stream.topic in channels:
                continue
            text = _store_of(stream, encoding).generate_msgdef(stream.type_name, ros_version=version)[0]
            name = stream.type_name if version == 2 else stream.type_name.replace("/msg/", "/")
            schema = writer.register_schema(name, f"ros{version}msg", text.encode())
            channels[stream.topic] = writer.register_channel(stream.topic, encoding, schema)
        for index, row, payload, log_time, publish_time in _sort_messages(streams, encoding):
            writer.add_message(channels[streams[index].topic], log_time, payload, publish_time, row)
        writer.finish()  # type: ignore[no-untyped-call]


def write_bag(path: Path, streams: Sequence[MessageStream]) -> None:
    """Write a ROS 1 bag, version 2.0."""
    store = _make_typestore("ros1")
    with write_atomic_file(path) as temporary:
        temporary.unlink(missing_ok=True)  # rosbags insists on making it
        writer = BagWriter(temporary)
        writer.set_compression(BagWriter.CompressionFormat.LZ4)
        with writer:
            connections = [
                writer.add_connection(
                    s.topic, s.type_name, typestore=store, latching=int(s.latched), callerid="/simulation"
                )
                for s in streams
            ]
            for index, _, payload, log_time, _ in _sort_messages(streams, "ros1"):
                writer.write(connections[index], log_time, payload)


def write_rosbag2(
    path: Path, streams: Sequence[MessageStream], *, storage: Literal["sqlite3", "mcap"] = "sqlite3"
) -> None:
    """Write a ROS 2 bag directory (metadata.yaml beside one .db3 or .mcap)."""
    store, plugin = _make_typestore("cdr"), {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
    with write_atomic_directory(path) as directory:
        directory.rmdir()  # the writer wants to make it; the files inside are named after it
        with Rosbag2Writer(directory, version=9, storage_plugin=plugin[storage]) as writer:
            connections = [writer.add_connection(s.topic, s.type_name, typestore=store) for s in streams]
            for index, _, payload, log_time, _ in _sort_messages(streams, "cdr"):
                writer.write(connections[index], log_time, payload)


def _sort_messages(streams: Sequence[MessageStream], encoding: Encoding) -> list[tuple[int, int, bytes, int, int]]:
    """Return (stream, row, payload, log time, publish time) of all messages by rising log time."""
    payloads = [_serialize_messages(stream, encoding) for stream in streams]
    log_times = np.concatenate([stream.log_time_ns for stream in streams])
    publish = np.concatenate([s.log_time_ns if s.publish_time_ns is None else s.publish_time_ns for s in streams])
    index = np.repeat(np.arange(len(streams)), [stream.log_time_ns.size for stream in streams])
    row = np.concatenate([np.arange(stream.log_time_ns.size) for stream in streams])
    order = np.argsort(log_times, kind="stable")
    listed = (values[order].tolist() for values in (index, row, log_times, publish))
    return [(i, r, payloads[i][r].tobytes(), t, p) for i, r, t, p in zip(*listed, strict=True)]


def _serialize_messages(stream: MessageStream, encoding: Encoding) -> Bytes:
    """Return the serialised messages, shape (N, bytes)."""
    store = _store_of(stream, encoding)
    encode: Callable[[object, str], Any] = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    count = stream.log_time_ns.size
    if not count:
        return np.empty((0, 0), np.uint8)
    field_types = {name: _find_field(store, stream.type_name, name) for name in stream.columns}
    columns = {name: values for name, values in stream.columns.items() if field_types[name] is not None}
    _check_lengths(stream.topic, columns)
    first = {name: _to_rosbags_value(values[0]) for name, values in columns.items()}
    message = _make_message(store, stream.type_name, _nest_fields({**stream.constants, **first}))

    def serialize() -> Bytes:
        return np.frombuffer(bytes(encode(message, stream.type_name)), np.uint8)

    rows = np.tile(serialize(), (count, 1))
    for name, values in columns.items():
        kind, argument = field_types[name]
        base = str(argument[0] if kind == Nodetype.BASE else argument[0][1][0])  # of a number, or an array's numbers
        dtype = values.dtype if values.dtype.kind == "S" else np.dtype(_BYTES.get(base, base))
        start = _find_offset(message, name, dtype, serialize)
        packed = np.ascontiguousarray(values.reshape(count, -1), dtype=dtype).view(np.uint8)
        rows[:, start : start + packed.shape[1]] = packed
    return rows


def _check_lengths(topic: str, columns: NamedArrays) -> None:
    """Reject columns that have no fixed layout: strings of several lengths, and arrays of Python objects."""
    for name, values in columns.items():
        ragged = values.dtype.kind == "S" and (np.char.str_len(values) != values.dtype.itemsize).any()
        if ragged or values.dtype.kind not in "biufS":
            raise UsageError(f"{topic}: column {name} ({values.dtype}) expected numbers, or bytes of one length")


def _find_offset(message: Any, name: str, dtype: np.dtype[Any], serialize: Callable[[], Bytes]) -> int:
    """Return the offset of a field in the serialised message, which is serialised with two values of the field."""
    *parents, leaf = name.split(".")
    owner = functools.reduce(getattr, parents, message)
    original = getattr(owner, leaf)
    versions = []
    for byte in (b"\x00", b"\x01"):
        filler = np.frombuffer(byte * dtype.itemsize, dtype)[0]
        changed = byte.decode() * len(original) if isinstance(original, str) else filler.item()
        object.__setattr__(owner, leaf, np.full_like(original, filler) if isinstance(original, np.ndarray) else changed)
        versions.append(serialize())
    object.__setattr__(owner, leaf, original)
    if versions[0].size != versions[1].size or not (versions[0] != versions[1]).any():
        raise UsageError(f"message field {name} has a position that varies with the message, so it cannot be a column")
    return int(np.flatnonzero(versions[0] != versions[1])[0])


def _find_field(store: Typestore, type_name: str, name: str) -> Any:
    """Return kind and argument of a message's field; None if the dialect lacks it: ``header.seq`` is ROS 1 only."""
    *parents, leaf = name.split(".")
    for part in parents:
        type_name = str(dict(store.fielddefs[type_name][1])[part][1])
    return dict(store.fielddefs[type_name][1]).get(leaf)


def _nest_fields(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields by dotted name as nested dicts."""
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *parents, leaf = name.split(".")
        branch = tree
        for parent in parents:
            branch = branch.setdefault(parent, {})
        branch[leaf] = value
    return tree


def _to_rosbags_value(value: Any) -> Any:
    """Return a value of a column as rosbags expects it in a message."""
    if isinstance(value, np.bytes_):
        return value.decode()
    return value if isinstance(value, np.ndarray) else value.item()


def _make_message(store: Typestore, type_name: str, values: Mapping[str, Any]) -> Any:
    """Return a message with the given values; the rest is zero or empty."""
    field_values = {}
    fields: list[tuple[str, Any]] = store.fielddefs[type_name][1]
    for name, (kind, argument) in fields:
        value = values.get(name)
        if kind == Nodetype.NAME:
            field_values[name] = _make_message(store, argument, value or {})
        elif kind == Nodetype.BASE:
            field_values[name] = value if value is not None else {"string": "", "bool": False}.get(argument[0], 0)
        else:
            field_values[name] = _make_elements(store, argument, value)
    return store.types[type_name](**field_values)


def _make_elements(store: Typestore, argument: Any, value: Any) -> Any:
    """Return the value of an array field; zeros, or an empty list, if no value is given."""
    (kind, inner), length = argument
    if kind == Nodetype.NAME:
        return [_make_message(store, inner, element) for element in (value or [])]
    if inner[0] == "string":
        return list(value or [])
    dtype = _BYTES.get(inner[0], inner[0])
    return np.zeros(length, dtype) if value is None else np.asarray(value, dtype)


def _store_of(stream: MessageStream, encoding: Encoding) -> Typestore:
    """Return the types of an encoding, with the stream's own type."""
    store = _make_typestore(encoding)
    if stream.definition and stream.type_name not in store.types:
        store.register(get_types_from_msg(stream.definition, stream.type_name))
    return store


@functools.cache
def _make_typestore(encoding: Encoding) -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for name, text in {**_MISSING_IN_ROSBAGS, **load_shipped_definitions()}.items():
        store.register(get_types_from_msg(text, name))
    return store
