"""Logs made to hurt: each is refused or set aside by name, in bounded time and memory, and costs nothing else."""

import sqlite3
import struct
import time
import tracemalloc
from contextlib import closing
from dataclasses import replace

import lz4.frame
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from random_messages import (
    ROS1,
    ROS2,
    START_NS,
    Message,
    assert_same,
    expected_columns,
    random_messages,
    write_bag,
    write_mcap,
    write_rosbag2,
)
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionMode

from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.log_part import DamageError, decompress, is_bomb
from tcpipe.formats.logs.mcap_records import OP_CHUNK, RECORD_HEAD, record_offsets

TYPES = ("std_msgs/msg/ColorRGBA",)
BOMB_BYTES = 1 << 29
MOST_SECONDS = 20
MOST_BYTES = 100 << 20


@pytest.fixture
def bounded():
    """The test takes neither long nor much memory."""
    tracemalloc.start()
    start = time.process_time()
    yield
    seconds, peak = time.process_time() - start, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert seconds < MOST_SECONDS
    assert peak < MOST_BYTES


def read(path):
    with open_log(path) as log:
        return log.tables(log.topics), log.findings


def write_topics(path, topics, version=2):
    """Write messages of topics, given as topic, type, definition, and time and payload of each."""
    with path.open("wb") as file:
        writer = McapWriter(file, compression=CompressionType.NONE)
        writer.start(profile=f"ros{version}", library="test")
        for topic, kind, definition, messages in topics:
            schema = writer.register_schema(kind, f"ros{version}msg", definition.encode())
            channel = writer.register_channel(topic, "cdr" if version == 2 else "ros1", schema)
            for log_time_ns, payload in messages:
                writer.add_message(channel, log_time_ns, payload, log_time_ns)
        writer.finish()
    return path


def write_evil(path, definition):
    """Write a log of one good topic, and one with this definition."""
    messages = [(of.log_time_ns, of.payload) for of in random_messages(1, count=5, types=TYPES)]
    good, _ = ROS2.generate_msgdef(TYPES[0], ros_version=2)
    topics = [("/good", TYPES[0], good, messages), ("/evil", "acme_msgs/msg/Thing", definition, messages)]
    return write_topics(path, topics)


@pytest.mark.parametrize(
    ("definition", "said"),
    [
        ("Other other\n" + "=" * 80 + "\nMSG: acme_msgs/Other\nThing thing\n", "contains itself"),
        ("float64[4000000000] values\n", "an array of 4000000000 elements is longer than any message"),
        ("string[99999999999999999999] texts\n", "longer than any message"),
        (
            "L0 part\n" + "".join(f"{'=' * 80}\nMSG: acme_msgs/L{n}\nL{n + 1} part\n" for n in range(3000)),
            "nests more than 64 messages",
        ),
        ("string[1000000000] texts\n", "contains 1000000000 texts or messages in arrays of fixed length"),
        (
            "Part[1000] parts\n" + "=" * 80 + "\nMSG: acme_msgs/Part\nstring[1000] texts\n",
            "contains 1000000 texts or messages in arrays of fixed length",
        ),
        ("float64 { x\n", "cannot be parsed"),
        ("", "is unknown"),
    ],
)
def test_a_hostile_definition_costs_its_topic_only(tmp_path, bounded, definition, said):
    tables, damage = read(write_evil(tmp_path / "a.mcap", definition))
    assert set(tables) == {"/good"}
    assert tables["/good"].num_rows == 5
    (finding,) = damage
    assert (finding.subject.name, finding.numbers["lost_messages_count"]) == ("/evil", 5)
    assert said in finding.names["reason"]


def test_a_fixed_array_that_no_message_can_hold_is_counted(tmp_path, bounded):
    tables, damage = read(write_evil(tmp_path / "a.mcap", "float64[200000000] values\n"))
    assert tables["/evil"].num_rows == 0
    assert sum(finding.numbers["lost_messages_count"] for finding in damage) == 5


@pytest.mark.parametrize("with_summary", [True, False])
def test_a_chunk_that_claims_2_to_the_60_bytes(tmp_path, bounded, with_summary):
    messages = random_messages(2, count=200, types=TYPES)
    path = write_mcap(tmp_path / "a.mcap", messages, chunk_bytes=512)
    data = bytearray(path.read_bytes())
    chunks = [
        offset + 8 for offset in record_offsets(bytes(data[8:]), len(data))[0].tolist() if data[offset + 8] == OP_CHUNK
    ]
    if not with_summary:
        del data[chunks[-1] :]
    struct.pack_into("<Q", data, chunks[1] + RECORD_HEAD + 16, 1 << 60)
    path.write_bytes(data)
    tables, damage = read(path)
    assert 150 < tables["/ColorRGBA"].num_rows <= 200
    assert with_summary or "record-damaged" in {finding.code for finding in damage}


@pytest.mark.parametrize(
    ("codec", "compress"), [("zstd", zstandard.compress), ("lz4", lz4.frame.compress)], ids=["zstd", "lz4"]
)
def test_a_bomb_of_a_chunk_is_refused_by_what_it_claims_and_by_what_it_holds(bounded, codec, compress):
    piece = bytes(1 << 24)
    bomb = compress(piece)
    with pytest.raises(DamageError):
        decompress(codec, memoryview(bomb), 1000)  # it claims little and holds much
    if codec == "zstd":
        with pytest.raises(DamageError, match="record-damaged"):
            decompress(codec, memoryview(bomb), BOMB_BYTES)
    assert len(decompress(codec, memoryview(bomb), len(piece))) == len(piece)


def test_less_is_believed_of_what_is_held_as_a_whole():
    assert is_bomb(1 << 20, 200 << 20, whole=True)
    assert not is_bomb(1 << 20, 200 << 20)
    assert not is_bomb(1 << 10, 1 << 26, whole=True)
    assert not is_bomb(4 << 20, 200 << 20, whole=True)


def test_bombs_of_messages_and_of_files(tmp_path, bounded):
    messages = random_messages(3, count=20, types=TYPES)
    bag = write_rosbag2(tmp_path / "run", messages, compression=CompressionMode.MESSAGE)
    database = next(bag.glob("*.db3"))
    compressor = zstandard.ZstdCompressor().compressobj()
    bomb = b"".join([*(compressor.compress(bytes(1 << 20)) for _ in range(BOMB_BYTES >> 20)), compressor.flush()])
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("UPDATE messages SET data = ? WHERE id = 7", (bomb,))
    connection.close()
    tables, damage = read(bag)
    assert tables["/ColorRGBA"].num_rows == 19
    assert [finding.numbers["lost_messages_count"] for finding in damage if finding.severity != "note"] == [1]
    whole = tmp_path / "bomb.db3.zstd"
    whole.write_bytes(bomb)
    with pytest.raises(LogError, match="taken for a bomb"):
        open_log(whole)


def test_metadata_that_unfolds_without_bound(tmp_path, bounded):
    bag = write_rosbag2(tmp_path / "run", random_messages(4, count=5, types=TYPES))
    laughs = "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12))
    (bag / "metadata.yaml").write_text(laughs + "rosbag2_bagfile_information:\n  relative_file_paths: [*a11, *a11]\n")
    tables, damage = read(bag)
    assert tables["/ColorRGBA"].num_rows == 5
    assert {finding.severity for finding in damage} == {"note"}


def test_a_view_in_place_of_a_table_is_refused(tmp_path, bounded):
    path = tmp_path / "a.db3"
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
        )
        connection.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n"
        )
    connection.close()
    with pytest.raises(LogError, match="'messages' is no plain table"):
        open_log(path)


def test_a_database_that_claims_to_be_endless_is_read_as_far_as_it_goes(tmp_path, bounded):
    path = next(write_rosbag2(tmp_path / "run", random_messages(5, count=5, types=TYPES)).glob("*.db3"))
    data = bytearray(path.read_bytes())
    data[28:32] = b"\xff\xff\xff\xff"
    path.write_bytes(data)
    with open_log(path) as log:
        assert sum(table.num_rows for table in log.tables(log.topics).values()) == 5
        assert any("the file ends" in line for line in log.damage)


def test_a_file_full_of_what_looks_like_chunks_is_searched_in_linear_time(tmp_path, bounded):
    head = bytes([OP_CHUNK]) + struct.pack("<QQQQIIQ", 40, 0, 0, 1 << 61, 0, 0, 0)
    mcap = tmp_path / "a.mcap"
    mcap.write_bytes(b"\x89MCAP0\r\n" + (head + b"\xff") * 20_000)
    with open_log(mcap) as log:
        assert log.topics == {}
        assert log.damage
    bag = tmp_path / "a.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n" + b"\x04\0\0\0op=\x05" * 60_000)
    with open_log(bag) as log:
        assert log.topics == {}
        assert log.damage


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_lengths_and_counts_of_2_to_the_32(tmp_path, bounded, encoding):
    store, write, suffix = (ROS2, write_mcap, "mcap") if encoding == "cdr" else (ROS1, write_bag, "bag")
    messages = random_messages(6, count=60, ragged=True, types=("sensor_msgs/msg/JointState",), store=store)
    evil, kept = [], []
    for index, message in enumerate(messages):
        payload = bytearray(message.payload)
        if index % 3 == 0:
            struct.pack_into("<I", payload, 12, 0xFFFFFFFF)  # length of header.frame_id
        else:
            kept.append(message)
        evil.append(replace(message, payload=bytes(payload)))
    tables, damage = read(write(tmp_path / f"a.{suffix}", evil))
    assert_same(tables["/JointState"], expected_columns(kept, "/JointState", store))
    assert sum(finding.numbers["lost_messages_count"] for finding in damage) == 20


@pytest.mark.parametrize("nothing", ["", "float64[0] none\n"])
def test_arrays_whose_elements_take_no_bytes_are_refused(tmp_path, bounded, nothing):
    definition = "Nothing[] many\n" + "=" * 80 + f"\nMSG: acme_msgs/Nothing\n{nothing}"
    topics = [("/evil", "acme_msgs/Thing", definition, [(1, b"\xff\xff\xff\xff")])]
    path = write_topics(tmp_path / "a.mcap", topics, version=1)
    tables, damage = read(path)
    assert tables == {}
    assert ["take no bytes" in finding.names["reason"] for finding in damage] == [True]


def test_reasons_that_differ_in_numbers_only_are_one_finding(tmp_path):
    kind = "std_msgs/msg/String"
    odd = [Message("/text", kind, START_NS + n, b"\0\1\0\0" + struct.pack("<I", 1000 + n), None) for n in range(300)]
    tables, damage = read(write_mcap(tmp_path / "a.mcap", odd))
    assert tables["/text"].num_rows == 0
    assert [finding.numbers["lost_messages_count"] for finding in damage] == [300]


def test_topics_that_differ_by_a_leading_slash_stay_two(tmp_path):
    messages = random_messages(7, count=10, types=TYPES)
    twins = [replace(m, topic=topic) for m in messages for topic in ("/colour", "colour")]
    tables, damage = read(write_mcap(tmp_path / "a.mcap", twins))
    assert {name: table.num_rows for name, table in tables.items()} == {"/colour": 10, "colour": 10}
    assert damage == []


def test_names_that_are_not_utf8_stay_different(tmp_path):
    messages = random_messages(8, count=10, types=TYPES)
    twins = [replace(m, topic=topic) for m in messages for topic in ("/AAA", "/BBB")]
    path = write_mcap(tmp_path / "a.mcap", twins, compression=CompressionType.NONE, enable_crcs=False)
    path.write_bytes(path.read_bytes().replace(b"/AAA", b"/\xff\xfeA").replace(b"/BBB", b"/\xff\xfdA"))
    tables, _ = read(path)
    assert {name: table.num_rows for name, table in tables.items()} == {r"/\xff\xfeA": 10, r"/\xff\xfdA": 10}


def test_what_no_checksum_covers_is_said(tmp_path):
    messages = random_messages(9, count=20, types=TYPES)
    ros1 = random_messages(9, count=20, types=TYPES, store=ROS1)
    logs = {
        write_mcap(tmp_path / "checked.mcap", messages): [],
        write_bag(tmp_path / "bz2.bag", ros1, BagWriter.CompressionFormat.BZ2): [],
        write_mcap(tmp_path / "crc0.mcap", messages, enable_crcs=False): ["no-checksum"],
        write_bag(tmp_path / "plain.bag", ros1): ["no-checksum"],
        next(write_rosbag2(tmp_path / "run", messages).glob("*.db3")): ["no-checksum"],
    }
    for path, codes in logs.items():
        with open_log(path) as log:
            log.tables(log.topics)
            assert [finding.code for finding in log.findings] == codes
            assert log.damage == []


@pytest.mark.parametrize("count", [3, 40])
def test_a_field_called_like_a_time_keeps_its_values(tmp_path, count):
    text = "int64 log_time_ns\nint64 publish_time_ns\nstring log_time_ns_\n"
    names = ["a" * (1 + number % 2) for number in range(count)]
    payloads = [
        b"\0\1\0\0" + struct.pack("<qqI", number, -number, len(name) + 1) + name.encode() + b"\0"
        for number, name in enumerate(names)
    ]
    messages = [(START_NS + number, payload) for number, payload in enumerate(payloads)]
    tables, damage = read(write_topics(tmp_path / "a.mcap", [("/thing", "acme_msgs/msg/Thing", text, messages)]))
    assert damage == []
    found = tables["/thing"]
    assert found.column_names == ["log_time_ns", "publish_time_ns", "log_time_ns_", "publish_time_ns_", "log_time_ns__"]
    assert found["log_time_ns"].to_pylist() == [START_NS + number for number in range(count)]
    assert found["log_time_ns_"].to_pylist() == list(range(count))
    assert found["publish_time_ns_"].to_pylist() == [-number for number in range(count)]
    assert found["log_time_ns__"].to_pylist() == names


def test_a_broken_schema_in_a_chunk_costs_its_topics_only(tmp_path):
    messages = random_messages(1, count=5, types=(*TYPES, "sensor_msgs/msg/Imu"))
    options = {"compression": CompressionType.NONE, "index_types": IndexType.NONE, "enable_crcs": False}
    path = write_mcap(tmp_path / "run.mcap", messages, use_statistics=False, use_summary_offsets=False, **options)
    data = bytearray(path.read_bytes())
    at = data.index(b"sensor_msgs/msg/Imu") - 4  # the length of the schema's name
    data[at : at + 4] = struct.pack("<I", 1 << 30)
    end = data.rindex(b"sensor_msgs/msg/Imu", at)
    path.write_bytes(data[: end if end > at + 4 else len(data)])
    tables, damage = read(path)
    assert_same(tables["/ColorRGBA"], expected_columns(messages, "/ColorRGBA"))
    assert "record-damaged" in {finding.code for finding in damage}
