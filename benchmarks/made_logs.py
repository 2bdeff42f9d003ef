"""Logs for benchmarks: a drive of five navigation topics, with or without a camera, in every container.

IMU 200 Hz, two odometries 50 Hz, power 20 Hz, GNSS 10 Hz, and raw images of 154 kB at 10 Hz: as in a real log, most
bytes are the camera's.
"""

import heapq
import itertools
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from tcpipe.formats.logs.writing import MessageStream, _make_typestore, _serialize_messages

RATES_HZ = (
    ("/imu/data", "sensor_msgs/msg/Imu", 200, "angular_velocity.z"),
    ("/odom/wheel", "nav_msgs/msg/Odometry", 50, "twist.twist.linear.x"),
    ("/odom/visual", "nav_msgs/msg/Odometry", 50, "twist.twist.linear.x"),
    ("/battery", "sensor_msgs/msg/BatteryState", 20, "voltage"),
    ("/gnss/fix", "sensor_msgs/msg/NavSatFix", 10, "latitude"),
)
NAVIGATION = [topic for topic, *_ in RATES_HZ]
CAMERA, CAMERA_HZ = "/camera/image_raw", 10
RAGGED = "/diagnostics"
START_NS = 1_700_000_000_000_000_000
STORES = {"cdr": _make_typestore("cdr"), "ros1": _make_typestore("ros1")}
CHUNK_BYTES = 1 << 20

Message = tuple[int, str, bytes]
"""Log time, topic, payload."""


def navigation(minutes: float, encoding: str = "cdr") -> Iterator[Message]:
    """Yield the messages of the five topics by rising log time."""
    rng = np.random.default_rng(0)
    topics = []
    for topic, type_name, rate_hz, field in RATES_HZ:
        count = int(minutes * 60 * rate_hz)
        stamp = START_NS + np.arange(count) * (10**9 // rate_hz)
        columns = {
            "header.stamp.sec": (stamp // 10**9).astype(np.int32),
            "header.stamp.nanosec": (stamp % 10**9).astype(np.uint32),
            field: rng.normal(size=count),
        }
        payloads = _serialize_messages(
            MessageStream(topic, type_name, stamp, columns, {"header.frame_id": "base_link"}), encoding
        )
        rows = map(bytes, payloads)
        topics.append(zip(stamp.tolist(), itertools.repeat(topic), rows, strict=False))
    return heapq.merge(*topics, key=lambda message: message[0])


def camera(minutes: float, encoding: str = "cdr") -> Iterator[Message]:
    """Yield raw images of a textured scene, each pixel noisy as a sensor's are: zstd takes a tenth off them."""
    rng = np.random.default_rng(1)
    scene = np.kron(rng.integers(0, 200, (30, 64, 1), dtype=np.uint8), np.ones((8, 5, 2), np.uint8)).ravel()
    pictures = [scene + rng.integers(0, 6, scene.size, dtype=np.uint8) for _ in range(8)]
    for index in range(int(minutes * 60 * CAMERA_HZ)):
        yield image(START_NS + index * (10**9 // CAMERA_HZ) + 1, np.roll(pictures[index % 8], index), encoding)


def image(stamp: int, pixels: NDArray[np.uint8], encoding: str = "cdr") -> Message:
    """Return an image of 320 pixels by as many rows as there are."""
    store = STORES[encoding]
    types = store.types
    stamp_type, header_type = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    header = {"stamp": stamp_type(stamp // 10**9, stamp % 10**9), "frame_id": "camera"}
    header |= {"seq": 0} if encoding == "ros1" else {}
    said = types["sensor_msgs/msg/Image"](header_type(**header), pixels.size // 640, 320, "yuv422", 0, 640, pixels)
    serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    return stamp, CAMERA, bytes(serialize(said, "sensor_msgs/msg/Image"))


def ragged(messages: int) -> Iterator[Message]:
    """Yield diagnostics of which no two are alike in any length: the worst case of a reader by shape."""
    rng, types = np.random.default_rng(2), STORES["cdr"].types
    letters = np.array(list("abcdefghijklmnopqrstuvwxyz /_"))

    def text() -> str:
        return "".join(rng.choice(letters, rng.integers(0, 24)))

    header = types["std_msgs/msg/Header"]
    status, value = types["diagnostic_msgs/msg/DiagnosticStatus"], types["diagnostic_msgs/msg/KeyValue"]
    for index in range(messages):
        stamp = START_NS + index * 10**7
        found = [
            status(
                int(rng.integers(3)), text(), text(), text(), [value(text(), text()) for _ in range(rng.integers(9))]
            )
            for _ in range(rng.integers(7))
        ]
        time = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        array = types["diagnostic_msgs/msg/DiagnosticArray"](header(time, text()), found)
        yield stamp, RAGGED, bytes(STORES["cdr"].serialize_cdr(array, "diagnostic_msgs/msg/DiagnosticArray"))


TYPES = {topic: type_name for topic, type_name, *_ in RATES_HZ} | {
    CAMERA: "sensor_msgs/msg/Image",
    RAGGED: "diagnostic_msgs/msg/DiagnosticArray",
}


def by_time(*streams: Iterator[Message]) -> Iterator[Message]:
    """Merge streams by log time."""
    return heapq.merge(*streams, key=lambda message: message[0])


def repeated(messages: Iterator[Message], seconds: float, times: int) -> Iterator[Message]:
    """Yield the messages of so many seconds again and again, each time later; what they hold stays as it is."""
    held = list(messages)
    for turn in range(times):
        later_ns = turn * round(seconds * 1e9)
        yield from ((log_time_ns + later_ns, topic, payload) for log_time_ns, topic, payload in held)


def write_mcap(
    path: Any, messages: Iterator[Message], *, compression: str, crcs: bool = True, camera_apart: bool = False
) -> Any:
    """Write an .mcap, to a path or an open file; with ``camera_apart`` images fill chunks of their own."""
    with path.open("wb") if isinstance(path, Path) else nullcontext(path) as file:
        writer = McapWriter(
            file,
            chunk_size=CHUNK_BYTES,
            compression={"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}[
                compression
            ],
            enable_crcs=crcs,
        )
        writer.start(profile="ros2", library="benchmark")
        channels: dict[str, int] = {}
        images: list[Message] = []

        def add(message: Message) -> None:
            log_time_ns, topic, payload = message
            if topic not in channels:
                text = STORES["cdr"].generate_msgdef(TYPES[topic], ros_version=2)[0]
                schema = writer.register_schema(TYPES[topic], "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], log_time_ns, payload, log_time_ns)

        def add_images() -> None:
            writer.flush()
            for image in images:
                add(image)
            writer.flush()
            images.clear()

        gathered_bytes = 0
        for message in messages:
            if camera_apart and message[1] == CAMERA:
                images.append(message)
            else:
                add(message)
                gathered_bytes += len(message[2])
            if camera_apart and gathered_bytes > CHUNK_BYTES:
                add_images()
                gathered_bytes = 0
        add_images()
        writer.finish()
    return path


def write_bag(path: Path, messages: Iterator[Message], *, compression: str) -> Path:
    """Write a .bag of ROS 1 messages."""
    writer = BagWriter(path)
    formats = {"lz4": BagWriter.CompressionFormat.LZ4, "bz2": BagWriter.CompressionFormat.BZ2}
    if compression in formats:
        writer.set_compression(formats[compression])
    with writer:
        _write(writer, messages, "ros1")
    return path


def write_db3(path: Path, messages: Iterator[Message]) -> Path:
    """Write a ROS 2 bag directory with a .db3."""
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        _write(writer, messages, "cdr")
    return path


def _write(writer: BagWriter | Rosbag2Writer, messages: Iterator[Message], encoding: str) -> None:
    connections = {}
    for log_time_ns, topic, payload in messages:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, TYPES[topic], typestore=STORES[encoding])
        writer.write(connections[topic], log_time_ns, payload)
