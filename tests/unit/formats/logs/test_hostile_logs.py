"""Logs made to take all memory or time: each is read or refused by name, in bounded time and memory, and costs no other topic."""

import bz2
import json
import os
import sqlite3
import struct
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from autopilot_files import DataFlash, Ulog
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from random_messages import (
    ROS1,
    Message,
    random_messages,
    write_bag,
    write_mcap,
    write_rosbag2,
)
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionMode

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.log_part import DamageError, decompress

START_NS = 1_700_000_000_000_000_000
MOST_SECONDS, MOST_BYTES = 10, 1 << 30
COLOR = "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n"

TYPES = ("std_msgs/msg/ColorRGBA",)

READ = """
import json, re, sys, time
from click.testing import CliRunner
from tcpipe.cli import cli
from tcpipe.errors import TcpipeError

def most_bytes():  # getrusage's would hold what the parent had before this program was begun
    with open("/proc/self/status") as status:
        return int(re.search(r"VmHWM:\\s+(\\d+)", status.read())[1]) * 1024

for path in sys.argv[1:]:
    for command, *options in (("inspect", "--full"), ("ingest", "--store", path + "-store")):
        start = time.process_time()
        done = CliRunner().invoke(cli, [command, path, *options], standalone_mode=False)
        error = done.exception
        raw = "" if error is None or isinstance(error, TcpipeError) else f"raw: {type(error).__name__}: "
        said = f"{done.output}{raw}{error}"
        print(json.dumps([path, command, said, time.process_time() - start, most_bytes()]), flush=True)
        if error is not None:
            break  # `ingest` opens it in the same way
"""


def record(opcode, content):
    return bytes([opcode]) + struct.pack("<Q", len(content)) + content


def text(value):
    return struct.pack("<I", len(value)) + value


def schema(number, definition, name=b"acme_msgs/msg/Thing"):
    return record(3, struct.pack("<H", number) + text(name) + text(b"ros2msg") + text(definition.encode()))


def channel(number, of, topic):
    return record(4, struct.pack("<HH", number, of) + text(topic.encode()) + text(b"cdr") + struct.pack("<I", 0))


def message(number, payload=b""):
    return record(5, struct.pack("<HIQQ", number, 0, START_NS, START_NS) + payload)


def chunk(codec, size, data):
    head = struct.pack("<QQQI", START_NS, START_NS, size, 0) + text(codec.encode())
    return record(6, head + struct.pack("<Q", len(data)) + data)


def squeezed(data):
    return chunk("zstd", len(data), zstandard.compress(data))


GOOD = schema(1, COLOR, b"std_msgs/msg/ColorRGBA") + channel(1, 1, "/good")


def mcap(*records):
    return lambda path: path.write_bytes(b"\x89MCAP0\r\n" + GOOD + b"".join(records))


def one_topic(definition, payload):
    return mcap(schema(2, definition), channel(2, 2, "/evil"), message(2, payload))


def db3(*statements):
    def write(path):
        with closing(sqlite3.connect(path)) as database, database:
            database.execute(
                "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
            )
            database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB)")
            for statement in statements:
                database.execute(statement)

    return write


def counted(values, table, most):
    numbers = f"WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < {most})"  # noqa: S608
    return f"{numbers} INSERT INTO {table} SELECT {values} FROM n"  # noqa: S608


def bag_record(opcode, data, **fields):
    held = [b"op=" + bytes([opcode]), *(name.encode() + b"=" + value for name, value in fields.items())]
    head = b"".join(text(field) for field in held)
    return text(head) + text(data)


def bag(*records):
    head = bag_record(3, bytes(4000), index_pos=bytes(8), conn_count=bytes(4), chunk_count=bytes(4))
    return lambda path: path.write_bytes(b"#ROSBAG V2.0\n" + head + b"".join(records))


def bag_chunk(data, codec=b"none", size=None):
    return bag_record(5, data, compression=codec, size=struct.pack("<I", len(data) if size is None else size))


def directory(metadata, files=1):
    def write(path):
        path.mkdir()
        mcap()(path / "evil_0.mcap")
        for number in range(1, files):
            (path / f"evil_{number}.mcap").symlink_to(path / "evil_0.mcap")
        if metadata:
            (path / "metadata.yaml").write_text(metadata)

    return write


def linked(path):
    path.mkdir()
    mcap(message(1))(path / "a.mcap")
    for number in range(4):
        (path / f"again{number}").symlink_to(path)
    at = os.open(path, os.O_RDONLY)
    for _ in range(1500):  # deeper than Python calls functions
        os.mkdir("d", dir_fd=at)
        below = os.open("d", os.O_RDONLY, dir_fd=at)
        os.close(at)
        at = below
    os.close(at)


def ulog(*formats, data=b"", names=None):
    """Write formats, a subscription to each of the names, and data."""
    log = Ulog()
    for text in formats:
        log.message("F", text.encode())
    for number, name in enumerate(names or [text.partition(":")[0] for text in formats]):
        log.subscribe(name, number % 65_536)
    return lambda path: path.write_bytes(log.bytes() + data)


def ulog_data(number):
    return struct.pack("<HBHQ", 10, 68, number, 1)


def dataflash(data):
    log = DataFlash()
    log.format("ABC", "QB", "TimeUS,I")
    return lambda path: path.write_bytes(log.bytes() + data)


MANY = [f"a{number}:uint64_t timestamp;" for number in range(11_000)]
WIDE = "".join(f"int8 f{number}\n" for number in range(9000))
COMPUTED = "id INTEGER PRIMARY KEY, topic_id, timestamp, data GENERATED ALWAYS AS (zeroblob(900000000))"
TOPIC = "INSERT INTO topics VALUES (0, '/t', 'a/msg/A', 'cdr')"
BOMB = "as a decompression bomb"
SEPARATOR = "=" * 80 + "\n"
LEVELS = "L0 part\n" + "".join(f"{SEPARATOR}MSG: acme_msgs/L{n}\nL{n + 1} part\n" for n in range(3000))
CHUNK_HEAD = b"\x06" + struct.pack("<QQQQIIQ", 40, 0, 0, 1 << 61, 0, 0, 0) + b"\xff"
LAUGHS = "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12))
LAUGHS += "rosbag2_bagfile_information:\n  relative_file_paths: [*a11, *a11]\n"
HOSTILE = {
    "empty records, compressed": (lambda: mcap(squeezed(record(0x0D, b"") * 1_200_000)), BOMB),
    "messages of nothing, compressed": (lambda: mcap(squeezed(message(1) * 150_000)), "are not decoded"),
    "a chunk of 1 GB": (lambda: mcap(chunk("lz4", 1 << 30, lz4.frame.compress(bytes(1 << 28)))), "a length, type or field is impossible"),
    "many chunks of 64 MB": (lambda: mcap(chunk("zstd", 1 << 26, zstandard.compress(bytes(1 << 26))) * 40), BOMB),
    "channels": (lambda: mcap(*(channel(n, 1, f"/t{n}") + message(n) for n in range(2, 10_100))), "more than 10000 topics"),
    "columns": (lambda: mcap(*(schema(n, WIDE) + channel(n, n, f"/t{n}") for n in range(2, 40))), "200000 columns"),
    "a definition of 6 MB": (lambda: one_topic("int8 x\n" * 900_000, b""), "bytes, more than"),
    "topics.db3": (lambda: db3(counted("i, 't' || i, 'a/msg/A', 'cdr'", "topics", 1_000_000)), BOMB),
    "unknown ids.db3": (lambda: db3(TOPIC, counted("i, i, i, x'00'", "messages", 100_000)), "that no record declares"),
    "computed.db3": (lambda: db3("DROP TABLE messages", f"CREATE TABLE messages({COMPUTED})"), "no plain table"),
    "records.bag": (lambda: bag(bag_chunk(bz2.compress(bytes(12_000_000)), b"bz2", 12_000_000)), BOMB),
    "claims.bag": (lambda: bag(bag_chunk(lz4.frame.compress(bytes(1 << 28)), b"lz4", 1 << 31)), "a length, type or field is impossible"),
    "files": (lambda: directory("a: 1", 4200), "bags of up to 4096 are read"),
    "names of files": (lambda: directory("rosbag2_bagfile_information:\n  relative_file_paths:\n" + "  - a\n" * 5000), "names 5000 files"),
    "links": (lambda: linked, ""),
    "lists.ulg": (lambda: ulog("a:b[60000] b;", "b:c[60000] c;", "c:double[60000] d;"), "longer than any can be"),
    "itself.ulg": (lambda: ulog("a:uint64_t timestamp;a[2] a;"), "formats inside formats"),
    "topics.ulg": (lambda: ulog(*MANY, data=b"".join(map(ulog_data, range(11_000)))), "more than 10000 topics"),
    "heads.ulg": (lambda: ulog("a:uint64_t timestamp;", data=b"D" * 10_000_000), "the file ends inside"),
    "heads.bin": (lambda: dataflash(b"\xa3\x95\x81" * 3_000_000), "no valid time"),
    "an array of 4e9": (lambda: one_topic("float64[4000000000] values\n", b""), "of 4000000000 elements is longer than any message"),
    "an array of 2e8": (lambda: one_topic("float64[200000000] values\n", b""), "1 message"),
    "1e9 texts": (lambda: one_topic("string[1000000000] texts\n", b""), "1 message"),
    "3000 levels": (lambda: one_topic(LEVELS, b""), "nests more than 64 messages"),
    "heads of chunks": (lambda: lambda path: path.write_bytes(b"\x89MCAP0\r\n" + CHUNK_HEAD * 20_000), ""),
    "bomb.db3.zstd": (lambda: lambda path: path.write_bytes(zstandard.compress(bytes(1 << 29))), BOMB),
    "metadata that unfolds": (lambda: directory(LAUGHS), "metadata.yaml is missing, unusable or without this file"),
}  # fmt: skip


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    place = tmp_path_factory.mktemp("hostile")
    for name, (make, _) in HOSTILE.items():
        make()(place / name)
    paths = [str(place / name) for name in HOSTILE]
    done = subprocess.run([sys.executable, "-c", READ, *paths], capture_output=True, text=True, check=False)
    subprocess.run(["rm", "-rf", place], check=True)  # Python, which pytest clears up with, cannot go so deep
    assert done.returncode == 0, done.stderr[-3000:]
    found = {}
    for line in done.stdout.splitlines():
        path, what, said, seconds, most_bytes = json.loads(line)
        found.setdefault(Path(path).name, []).append((what, said, seconds, most_bytes))
    return found


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_log_is_read_or_refused_in_bounded_time_and_memory(outcomes, name):
    _, wanted = HOSTILE[name]
    for what, said, seconds, most_bytes in outcomes[name]:
        assert seconds < MOST_SECONDS, what
        assert most_bytes < MOST_BYTES, what
        assert "raw: " not in said, (what, said)
        assert "internal error" not in said, (what, said)
    assert wanted in " ".join(said for _, said, *_ in outcomes[name])


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


@pytest.mark.parametrize(
    ("codec", "compress"), [("zstd", zstandard.compress), ("lz4", lz4.frame.compress)], ids=["zstd", "lz4"]
)
def test_a_bomb_of_a_chunk_is_refused_by_what_it_claims_and_by_what_it_holds(codec, compress):
    piece = bytes(1 << 24)
    bomb = compress(piece)
    with pytest.raises(DamageError):
        decompress(codec, memoryview(bomb), 1000)  # it claims little and holds much
    if codec == "zstd":
        with pytest.raises(DamageError, match="record-damaged"):
            decompress(codec, memoryview(bomb), 1 << 29)
    assert len(decompress(codec, memoryview(bomb), len(piece))) == len(piece)


def test_a_bomb_of_a_message_costs_itself(tmp_path):
    messages = random_messages(3, count=20, types=TYPES)
    bag = write_rosbag2(tmp_path / "run", messages, compression=CompressionMode.MESSAGE)
    database = next(bag.glob("*.db3"))
    compressor = zstandard.ZstdCompressor().compressobj()
    bomb = b"".join([*(compressor.compress(bytes(1 << 20)) for _ in range(512)), compressor.flush()])
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("UPDATE messages SET data = ? WHERE id = 7", (bomb,))
    connection.close()
    tables, damage = read(bag)
    assert tables["/ColorRGBA"].num_rows == 19
    assert [finding.numbers["lost_messages_count"] for finding in damage if finding.severity != "note"] == [1]


@pytest.mark.parametrize("nothing", ["", "float64[0] none\n"])
def test_arrays_whose_elements_take_no_bytes_are_refused(tmp_path, nothing):
    definition = "Nothing[] many\n" + "=" * 80 + f"\nMSG: acme_msgs/Nothing\n{nothing}"
    topics = [("/evil", "acme_msgs/Thing", definition, [(1, b"\xff\xff\xff\xff")])]
    path = write_topics(tmp_path / "a.mcap", topics, version=1)
    tables, damage = read(path)
    assert [table.num_rows for table in tables.values()] == [0]
    assert ["contradict its size" in finding.names["reason"] for finding in damage] == [True]


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
