"""A log cut or flipped at any byte: the reader neither crashes nor, where there are checksums, tells of what was never said."""

import json
from collections import Counter

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from random_messages import ROS1, random_messages, write_bag, write_mcap, write_rosbag2
from rosbags.rosbag1 import Writer as BagWriter

from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import open_log

TYPES = ("std_msgs/msg/ColorRGBA", "diagnostic_msgs/msg/DiagnosticArray")
MESSAGES = random_messages(1, count=25, types=TYPES)
ROS1_MESSAGES = random_messages(1, count=25, types=TYPES, store=ROS1)
WRITERS = {
    "mcap zstd": lambda path: write_mcap(path / "a.mcap", MESSAGES, chunk_bytes=1024),
    "mcap lz4": lambda path: write_mcap(path / "a.mcap", MESSAGES, chunk_bytes=1024, compression=CompressionType.LZ4),
    "mcap plain": lambda path: write_mcap(
        path / "a.mcap", MESSAGES, chunk_bytes=1024, compression=CompressionType.NONE
    ),
    "mcap unchunked": lambda path: write_mcap(path / "a.mcap", MESSAGES, use_chunking=False),
    "bag bz2": lambda path: write_bag(path / "a.bag", ROS1_MESSAGES, BagWriter.CompressionFormat.BZ2),
    "bag plain": lambda path: write_bag(path / "a.bag", ROS1_MESSAGES),
    "db3": lambda path: next(write_rosbag2(path / "a", MESSAGES).glob("*.db3")),
}
CHECKED = {"mcap zstd", "mcap lz4", "mcap plain"}


def rows(path, wanted=None):
    with open_log(path) as log:
        tables = log.tables(name for name in log.topics if wanted in (None, name))
        damaged = bool(log.damage)
    return Counter((name, json.dumps(row)) for name, table in tables.items() for row in table.to_pylist()), damaged


@pytest.fixture(scope="module", params=WRITERS)
def log_bytes(request, tmp_path_factory):
    path = WRITERS[request.param](tmp_path_factory.mktemp("log"))
    return request.param, path.read_bytes(), rows(path)[0]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_log_cut_or_flipped_anywhere(log_bytes, tmp_path, data):
    kind, clean, messages = log_bytes
    at = data.draw(st.integers(0, len(clean) - 1), label="byte")
    bit = data.draw(st.none() | st.integers(0, 7), label="bit, or a cut")
    wanted = data.draw(st.sampled_from((None, "/ColorRGBA")), label="topic")
    broken = clean[:at] if bit is None else clean[:at] + bytes([clean[at] ^ (1 << bit)]) + clean[at + 1 :]
    path = tmp_path / "broken"
    path.write_bytes(broken)
    try:
        found, damaged = rows(path, wanted)
    except LogError:  # refused in a plain line: damage to the magic, or to a table of topics
        return
    if kind in CHECKED:
        assert found - messages == Counter()
        expected = {row: count for row, count in messages.items() if wanted in (None, row[0])}
        assert damaged or found == expected
