"""Coverage-guided fuzzing of what logs contain: any bytes are decoded, or refused by name. Containers: ``mutated_logs.py``.

By hand: ``python tests/fuzz/fuzz_log_reading.py TARGET [--seconds 600] [--corpus DIR]``; TARGET is ``plans`` (decoding plans, against
rosbags' row by row) or ``definitions`` (message definitions).
What breaks is written to the working directory as ``crash-…``: add it to ``test_fuzz_log_reading.py``. Needs atheris.
"""

import argparse
import json
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

if __name__ == "__main__":
    import atheris

    sys.path.insert(0, str(Path(__file__).parents[1]))
    with atheris.instrument_imports(include=["tcpipe.formats", "tcpipe.logs"]):
        import tcpipe.formats.logs.log_file  # noqa: F401

import numpy as np
from random_messages import ROS1, ROS2, random_messages

from tcpipe.formats.logs.arrow_columns import TopicTable
from tcpipe.formats.logs.log_part import MessageBlock
from tcpipe.formats.logs.ros_types import DefinitionError, MessageType, RowError, TypeLibrary

TYPES = (
    "std_msgs/msg/ColorRGBA",
    "diagnostic_msgs/msg/DiagnosticArray",
    "sensor_msgs/msg/JointState",
    "std_msgs/msg/UInt8MultiArray",
    "nav_msgs/msg/Path",
    "sensor_msgs/msg/BatteryState",
)
_MOST_BYTES = 1 << 16
_ALIKE = 8
"""Number of valid messages before the fuzzed ones: enough to learn a layout."""


@dataclass(frozen=True)
class Target:
    """One thing to fuzz: reads bytes (an uncaught exception is a finding), and the inputs to begin with."""

    read: Callable[[bytes], None]
    corpus: Callable[[], Iterator[bytes]]


# ---------------------------------------------------------------- decoding plans
def read_messages(data: bytes) -> None:
    """Decode messages as columns; what rosbags reads of them, row by row, is the same.

    The first bytes choose type and serialisation; then come messages, each behind its length (uint16).
    """
    if len(data) < 2:
        return
    encoding = ("cdr", "ros1")[data[1] % 2]
    message_type, decode, example = _EXAMPLES[TYPES[data[0] % len(TYPES)], encoding]
    payloads, position = [example] * (_ALIKE if data[1] & 2 else 1), 2
    while position + 2 <= len(data) and len(payloads) < 4 * _ALIKE:
        (length,) = struct.unpack_from("<H", data, position)
        payloads.append(data[position + 2 : position + 2 + length])
        position += 2 + length
    table = TopicTable(message_type, encoding)
    table.add(_block(payloads))
    found = table.take()
    found.validate(full=True)
    assert found.num_rows + table.undecodable == len(payloads)
    rows = found.drop_columns(["publish_time_ns"]).to_pylist()
    for row in rows:
        try:
            expected = decode(payloads[row.pop("log_time_ns")])
        except RowError:
            continue
        assert _text(row) == _text(expected)


def _text(row: dict[str, object]) -> str:
    return json.dumps(row, default=lambda value: value.tolist())


def _block(payloads: list[bytes]) -> MessageBlock:
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    order = np.arange(len(payloads))
    starts = np.cumsum(lengths) - lengths
    return MessageBlock(0, memoryview(b"".join(payloads)), starts, lengths, order, order, order)


def _definition(type_name: str, encoding: str) -> str:
    store, version = (ROS1, 1) if encoding == "ros1" else (ROS2, 2)
    return store.generate_msgdef(type_name, ros_version=version)[0]


def _message_type(type_name: str, text: str, encoding: str) -> MessageType:
    schema = "ros1msg" if encoding == "ros1" else "ros2msg"
    found = TypeLibrary(None).find_type(type_name, definition=text, schema_encoding=schema, ros1=encoding == "ros1")
    assert isinstance(found, MessageType), found
    return found


def _messages_of(type_name: str, encoding: str, count: int) -> list[bytes]:
    store = ROS1 if encoding == "ros1" else ROS2
    return [one.payload for one in random_messages(2, count=count, types=(type_name,), ragged=True, store=store)]


_EXAMPLES = {
    (name, encoding): (
        (found := _message_type(name, _definition(name, encoding), encoding)),
        found.row_decoder(encoding),
        _messages_of(name, encoding, 1)[0],
    )
    for name in TYPES
    for encoding in ("cdr", "ros1")
}


def plans() -> Iterator[bytes]:
    """Yield a few valid messages of each type."""
    for kind, (name, encoding) in enumerate(_EXAMPLES):
        messages = [*_messages_of(name, encoding, 3), _EXAMPLES[name, encoding][2]]
        for alike in (0, 2):
            head = bytes([kind // 2, alike | (encoding == "ros1")])
            yield head + b"".join(struct.pack("<H", len(message)) + message for message in messages)


# ---------------------------------------------------------------- definitions
_SCHEMAS = ("ros2msg", "ros1msg", "ros2idl")


def read_definition(data: bytes) -> None:
    """Parse a message definition; its first byte chooses the language."""
    if not data:
        return
    schema = _SCHEMAS[data[0] % len(_SCHEMAS)]
    text = data[1:].decode(errors="backslashreplace")
    found = TypeLibrary(None).find_type(
        "made_msgs/msg/Made", definition=text, schema_encoding=schema, ros1=schema == "ros1msg"
    )
    if isinstance(found, DefinitionError):
        return
    table = TopicTable(found, "ros1" if schema == "ros1msg" else "cdr")
    table.add(_block([b"\x00\x01\x00\x00" + bytes(60)] * _ALIKE))
    table.take().validate(full=True)


def definitions() -> Iterator[bytes]:
    """Yield definitions in each language."""
    for name in TYPES:
        yield b"\0" + _definition(name, "cdr").encode()
        yield b"\1" + _definition(name, "ros1").encode()
    yield b"\0uint8 A=1\nstring<=5 text 'x'\nint32[<=3] some\nMade[2] again\nwstring wide\nfloat64[36] matrix\n"
    yield (
        b"\2module made_msgs { module msg { typedef double double__36[36]; struct Made {"
        b' @unit(value="m") double x; sequence<long, 4> some; double__36 matrix; wstring wide; }; }; };'
    )


TARGETS = {
    "plans": Target(read_messages, plans),
    "definitions": Target(read_definition, definitions),
}


def main() -> None:
    """Fuzz one target with atheris."""
    parser = argparse.ArgumentParser()
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--runs", type=int, default=-1, help="stop after so many inputs")
    parser.add_argument("--seed", type=int, default=0, help="0: another each time")
    parser.add_argument("--corpus", type=Path, help="a directory to keep what was found interesting")
    given = parser.parse_args()
    target = TARGETS[given.target]
    with tempfile.TemporaryDirectory() as scratch:
        corpus = given.corpus or Path(scratch, "corpus")
        corpus.mkdir(parents=True, exist_ok=True)
        for number, data in enumerate(target.corpus()):
            (corpus / f"made-{number}").write_bytes(data)
        limits = [f"-max_len={_MOST_BYTES}", "-rss_limit_mb=3072", "-timeout=30", "-print_final_stats=1"]
        often = [f"-max_total_time={given.seconds}", f"-runs={given.runs}", f"-seed={given.seed}"]
        atheris.Setup([sys.argv[0], *limits, *often, str(corpus)], target.read)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
