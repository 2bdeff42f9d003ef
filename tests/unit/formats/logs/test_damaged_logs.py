"""Generated logs, broken in known places: what is intact before and after comes back, the rest is counted."""

import itertools
import sqlite3
import struct
from contextlib import closing
from dataclasses import replace

import pytest
from mcap.writer import CompressionType, IndexType
from random_messages import (
    ROS1,
    assert_same,
    expected_columns,
    random_messages,
    write_bag,
    write_mcap,
    write_rosbag2,
)
from rosbags.rosbag1 import Writer as BagWriter

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.mcap_records import OP_CHUNK, RECORD_HEAD, record_offsets

TYPES = ("sensor_msgs/msg/Imu", "std_msgs/msg/ColorRGBA")
COMPRESSIONS = (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE)


def chunks_of(path):
    """Byte range of every chunk of an intact .mcap."""
    data = path.read_bytes()
    offsets = record_offsets(data[8:], len(data))[0] + 8
    lengths = [struct.unpack_from("<Q", data, offset + 1)[0] for offset in offsets.tolist()]
    return [
        (offset, offset + RECORD_HEAD + length)
        for offset, length in zip(offsets.tolist(), lengths, strict=True)
        if data[offset] == OP_CHUNK
    ]


def flip(path, offset, bits=0x10):
    data = bytearray(path.read_bytes())
    data[offset] ^= bits
    path.write_bytes(data)


def read(path):
    with open_log(path) as log:
        tables = log.tables(log.topics)
        return tables, log.findings


def count_lost(findings):
    """Messages lost by the code of each finding that is no note."""
    return {of.code: of.numbers.get("lost_messages_count") for of in findings if of.severity != "note"}


def stamps(tables, topic):
    return tables[topic]["log_time_ns"].to_pylist()


def without(messages, lost):
    return [message for message in messages if message.log_time_ns not in lost]


@pytest.fixture
def messages():
    return random_messages(1, count=200, types=TYPES)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_flipped_bit_costs_its_chunk_and_no_more(tmp_path, messages, compression):
    path = write_mcap(tmp_path / "run.mcap", messages, compression=compression)
    clean, _ = read(path)
    start, end = chunks_of(path)[2]
    flip(path, (start + end) // 2 + 30)
    tables, damage = read(path)
    (finding,) = damage
    assert (finding.code, finding.subject.name) == ("chunk-damaged", "run.mcap")
    read_stamps = {stamp for topic in tables for stamp in stamps(tables, topic)}
    kept = [m for m in messages if m.log_time_ns in read_stamps]
    assert finding.numbers["lost_messages_count"] == len(messages) - len(kept) > 0
    assert finding.numbers["first_offset"] == start
    for topic in clean:
        assert_same(tables[topic], expected_columns(kept, topic))


FLIPS = {
    "first bytes": (lambda _: 3, "record-damaged", "note"),
    "index of a chunk": (lambda path: chunks_of(path)[1][1] + RECORD_HEAD + 6 + 8, "chunk-index-damaged", "note"),
    "summary": (lambda path: path.stat().st_size - 200, "index-damaged", "warning"),
}
"""Bytes beside the messages, of the index of a chunk the first offset; what is said of them."""


@pytest.mark.parametrize("where", FLIPS)
def test_a_flip_beside_the_messages_costs_nothing_and_is_said(tmp_path, messages, where):
    path = write_mcap(tmp_path / "run.mcap", messages)
    find_offset, code, severity = FLIPS[where]
    flip(path, find_offset(path))
    tables, damage = read(path)
    assert [(finding.code, finding.severity) for finding in damage] == [(code, severity)]
    for topic in ("/Imu", "/ColorRGBA"):
        assert_same(tables[topic], expected_columns(messages, topic))


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("what", ["opcode", "length"])
def test_a_destroyed_chunk_head_without_summary_costs_its_chunk(tmp_path, messages, compression, what):
    path = write_mcap(tmp_path / "run.mcap", messages, compression=compression)
    chunks = chunks_of(path)
    start, _ = chunks[2]
    path.write_bytes(path.read_bytes()[: chunks[-1][1]])  # no summary
    clean, _ = read(path)
    flip(path, start + (0 if what == "opcode" else 3), 0x40)
    tables, damage = read(path)
    lost = set(stamps(clean, "/Imu")) - set(stamps(tables, "/Imu"))
    chunk_messages = len(stamps(clean, "/Imu")) // len(chunks)
    assert 0 < len(lost) < 2.5 * chunk_messages
    assert max(stamps(tables, "/Imu")) == max(stamps(clean, "/Imu"))
    assert any(finding.numbers.get("lost_bytes") for finding in damage)
    assert_same(tables["/Imu"], expected_columns(without(messages, lost), "/Imu"))


@pytest.mark.parametrize("options", [{}, {"index_types": IndexType.CHUNK}, {"use_chunking": False}])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_a_cut_mcap_gives_everything_before_the_cut(tmp_path, messages, options, share):
    path = write_mcap(tmp_path / "run.mcap", messages, compression=CompressionType.NONE, **options)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    tables, damage = read(path)
    found = sorted(stamp for topic in tables for stamp in stamps(tables, topic))
    assert found == [message.log_time_ns for message in messages[: len(found)]]
    assert len(found) >= int(len(messages) * share * 0.9) - 12
    assert damage
    for topic in tables:
        assert_same(tables[topic], expected_columns(messages[: len(found)], topic))


@pytest.mark.parametrize("compression", [None, BagWriter.CompressionFormat.BZ2, BagWriter.CompressionFormat.LZ4])
def test_a_cut_bag_gives_every_whole_chunk(tmp_path, compression):
    messages = random_messages(2, count=400, types=TYPES, store=ROS1)
    path = write_bag(tmp_path / "run.bag", messages, compression, chunk_bytes=20_000)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * 0.8)])
    tables, damage = read(path)
    found = {topic: stamps(tables, topic) for topic in tables}
    for topic, log_times in found.items():
        assert log_times == [m.log_time_ns for m in messages if m.topic == topic][: len(log_times)]
        assert len(log_times) > 100
    assert "index-missing" in {finding.code for finding in damage}


def test_a_bag_with_a_destroyed_chunk_head_goes_on_behind_it(tmp_path):
    messages = random_messages(3, count=600, types=TYPES, store=ROS1)
    path = write_bag(tmp_path / "run.bag", messages, BagWriter.CompressionFormat.LZ4, chunk_bytes=20_000)
    clean, _ = read(path)
    data = bytearray(path.read_bytes())
    first = data.find(b"op=\x05")
    second = data.find(b"op=\x05", first + 4)
    index_at = data.find(b"index_pos=") + 10
    data[index_at : index_at + 8] = bytes(8)  # as a recorder that died leaves it
    data[second] = 0
    path.write_bytes(data)
    tables, damage = read(path)
    assert 0 < len(stamps(tables, "/Imu")) < len(stamps(clean, "/Imu"))
    assert stamps(tables, "/Imu")[-1] == stamps(clean, "/Imu")[-1]
    assert any(finding.numbers.get("lost_bytes") for finding in damage)


def test_texts_that_are_not_utf8_are_replaced_and_counted(tmp_path):
    messages = random_messages(7, count=10, types=("std_msgs/msg/String",))
    payload = b"\x00\x01\x00\x00\x03\x00\x00\x00a\xff\x00"
    odd = [replace(message, payload=payload) for message in messages]
    tables, damage = read(write_mcap(tmp_path / "run.mcap", odd))
    assert tables["/String"]["data"].to_pylist() == ["a\ufffd"] * 10
    assert [(finding.code, finding.subject.name) for finding in damage] == [("text-not-utf8", "/String")]
    assert damage[0].numbers["places_count"] == 10


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\0garbage: [", b"rosbag2_bagfile_information:\n", b"a: &a [*a]\n"])
def test_a_broken_metadata_file_costs_nothing(tmp_path, content):
    messages = random_messages(4, count=20, types=TYPES)
    bag = write_rosbag2(tmp_path / "run", messages)
    (bag / "metadata.yaml").write_bytes(content)
    tables, damage = read(bag)
    assert [(of.code, of.severity) for of in damage] == [("file-unlisted", "note"), ("no-checksum", "note")]
    for topic in tables:
        assert_same(tables[topic], expected_columns(messages, topic))


WRONG_VALUES = ("NULL", "'text'", "x'00'", "2.5", "NULL, topic_id = 'x'", "NULL, data = NULL")


@pytest.mark.parametrize(
    ("column", "value"),
    sorted({*itertools.product(("topic_id", "timestamp", "data"), WRONG_VALUES)} - {("data", "x'00'")}),
)
@pytest.mark.parametrize("journal", [False, True])
def test_every_row_of_a_db3_is_a_message_or_counted_as_lost(tmp_path, column, value, journal):
    """Rows read and rows lost add up to the rows written, for any wrong value, with and without a journal."""
    path = tmp_path / "a.db3"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB)")
        database.execute("INSERT INTO topics VALUES (1, '/ColorRGBA', 'std_msgs/msg/ColorRGBA', 'cdr')")
        for number, message in enumerate(random_messages(5, count=20, types=TYPES[1:])):
            row = (number, message.log_time_ns, message.payload)
            database.execute("INSERT INTO messages VALUES (?, 1, ?, ?)", row)
        database.execute(f"UPDATE messages SET {column} = {value} WHERE id IN (7, 12, 19)")  # noqa: S608
    if journal:
        path.with_name("a.db3-wal").write_bytes(b"not a journal")
    for wanted in (["/ColorRGBA"], []):
        with open_log(path) as log:
            assert [table.num_rows for table in log.tables(wanted).values()] == [17] * len(wanted)
            assert count_lost(log.findings) == {"record-damaged": 3}


def test_a_message_that_moves_to_another_topic_is_missed_by_metadata(tmp_path, messages):
    bag = write_rosbag2(tmp_path / "run", messages)
    with closing(sqlite3.connect(next(bag.glob("*.db3")))) as database, database:
        database.execute("UPDATE messages SET topic_id = 3 - topic_id WHERE id IN (7, 8, 9)")
        moved = database.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id").fetchall()
    assert {count for _, count in moved} != {200}
    _, damage = read(bag)
    assert "messages-miscounted" in {finding.code for finding in damage}


def test_messages_of_times_that_no_clock_shows_are_counted(tmp_path, messages):
    late = [replace(message, log_time_ns=1 << 63) for message in messages[:3]]
    with open_log(write_mcap(tmp_path / "a.mcap", [*messages, *late])) as log:
        assert sum(table.num_rows for table in log.tables(log.topics).values()) == len(messages)
        assert count_lost(log.findings) == {"time-invalid": 3}


@pytest.mark.parametrize("closed", [True, False])
def test_messages_of_channels_that_nothing_declares_are_counted(tmp_path, messages, closed):
    path = write_mcap(tmp_path / "a.mcap", messages, compression=CompressionType.NONE, enable_crcs=False)
    data = bytearray(path.read_bytes())
    start, _ = chunks_of(path)[1]
    at = data.index(b"\x05", start + RECORD_HEAD + 40)  # the chunk's first message, of which the channel becomes 77
    struct.pack_into("<H", data, at + RECORD_HEAD, 77)
    path.write_bytes(data if closed else data[:-8])
    with open_log(path) as log:
        assert sum(table.num_rows for table in log.tables(log.topics).values()) == len(messages) - 1
        assert count_lost(log.findings)["channel-undeclared"] == 1


@pytest.mark.parametrize("number", [0, 1, 77])
@pytest.mark.parametrize("wanted", [("/Imu",), ("/ColorRGBA",), ("/Imu", "/ColorRGBA")])
def test_a_bag_whose_index_contradicts_it_says_so(tmp_path, number, wanted):
    """The summary says that a chunk's messages are another connection's: none is lost, whatever is read."""
    messages = random_messages(1, count=30, types=TYPES, store=ROS1)
    path = write_bag(tmp_path / "a.bag", messages, chunk_bytes=2000)
    clean, _ = read(path)
    data = bytearray(path.read_bytes())
    info = data.rindex(b"op=\x06")
    entries = data.index(struct.pack("<I", 16), info) + 4
    struct.pack_into("<I", data, entries, number)
    path.write_bytes(data)
    with open_log(path) as log:
        tables = log.tables(wanted)
        assert all(stamps(tables, topic) == stamps(clean, topic) for topic in wanted)
        assert number == 0 or log.damage
