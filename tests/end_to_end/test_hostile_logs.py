"""Logs made to take all memory or time: whatever reads them ends soon, in bounded memory, with plain lines. One process reads them all."""

import bz2
import json
import os
import sqlite3
import struct
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from autopilot_files import DataFlash, Ulog

START_NS = 1_700_000_000_000_000_000
MOST_SECONDS, MOST_BYTES = 10, 1 << 30
COLOR = "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n"

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


def dataflash_format(number):
    return b"\xa3\x95\x80" + struct.pack("<BB84s", number % 256, 2 + number % 3, b"a" * 84)


def dataflash(data):
    log = DataFlash()
    log.format("ABC", "QB", "TimeUS,I")
    return lambda path: path.write_bytes(log.bytes() + data)


LISTS = "A[] a\n" + "=" * 80 + "\nMSG: acme_msgs/A\nuint8[] b\n"
MANY = [f"a{number}:uint64_t timestamp;" for number in range(11_000)]
WIDE = "".join(f"int8 f{number}\n" for number in range(9000))
COMPUTED = "id INTEGER PRIMARY KEY, topic_id, timestamp, data GENERATED ALWAYS AS (zeroblob(900000000))"
TOPIC = "INSERT INTO topics VALUES (0, '/t', 'a/msg/A', 'cdr')"
BOMB = "taken for a bomb"
HOSTILE = {
    "empty records, compressed": (mcap(squeezed(record(0x0D, b"") * 1_200_000)), BOMB),
    "messages of nothing, compressed": (mcap(squeezed(message(1) * 150_000)), "are not decoded"),
    "schemas, compressed": (mcap(squeezed(schema(9, "", b"") * 300_000)), ""),
    "a chunk of 1 GB": (mcap(chunk("lz4", 1 << 30, lz4.frame.compress(bytes(1 << 28)))), "a length, type or field is impossible"),
    "many chunks of 64 MB": (mcap(chunk("zstd", 1 << 26, zstandard.compress(bytes(1 << 26))) * 40), BOMB),
    "indexes of every channel": (mcap(chunk("", 0, b""), *(record(7, struct.pack("<HI", n, 0)) for n in range(1 << 16))), ""),
    "channels": (mcap(*(channel(n, 1, f"/t{n}") + message(n) for n in range(2, 10_100))), "more than 10000 topics"),
    "columns": (mcap(*(schema(n, WIDE) + channel(n, n, f"/t{n}") for n in range(2, 40))), "200000 columns"),
    "a definition of 6 MB": (one_topic("int8 x\n" * 900_000, b""), "bytes, more than"),
    "lists of lists": (one_topic(LISTS, b"\0\1\0\0" + struct.pack("<I", 100_000) + bytes(400_000)), ""),
    "topics.db3": (db3(counted("i, 't' || i, 'a/msg/A', 'cdr'", "topics", 1_000_000)), BOMB),
    "unknown ids.db3": (db3(TOPIC, counted("i, i, i, x'00'", "messages", 100_000)), "that no record declares"),
    "computed.db3": (db3("DROP TABLE messages", f"CREATE TABLE messages({COMPUTED})"), "no plain table"),
    "records.bag": (bag(bag_chunk(bz2.compress(bytes(12_000_000)), b"bz2", 12_000_000)), BOMB),
    "claims.bag": (bag(bag_chunk(lz4.frame.compress(bytes(1 << 28)), b"lz4", 1 << 31)), "a length, type or field is impossible"),
    "connections.bag": (bag(bag_chunk(b"".join(bag_record(7, b"", conn=struct.pack("<I", n), topic=b"/t") for n in range(70_000)))), BOMB),
    "long metadata": (directory("x: [1, 2]\n" * 300_000), "metadata.yaml is missing, unusable or without this file"),
    "files": (directory("a: 1", 4200), "bags of up to 4096 are read"),
    "names of files": (directory("rosbag2_bagfile_information:\n  relative_file_paths:\n" + "  - a\n" * 5000), "names 5000 files"),
    "links": (linked, ""),
    "lists.ulg": (ulog("a:b[60000] b;", "b:c[60000] c;", "c:double[60000] d;"), "longer than any can be"),
    "itself.ulg": (ulog("a:uint64_t timestamp;a[2] a;"), "formats inside formats"),
    "formats.ulg": (ulog(*(f"a{n}:uint64_t timestamp;b b;" for n in range(3000)), "b:" + "int8_t[9] " + "x;"), ""),
    "columns.ulg": (ulog(*(f"a{n}:" + "".join(f"int8_t x{i};" for i in range(5000)) for n in range(60))), "200000 columns"),
    "topics.ulg": (ulog(*MANY, data=b"".join(map(ulog_data, range(11_000)))), "more than 10000 topics"),
    "pieces.ulg": (ulog("a:uint64_t timestamp;", data=(ulog_data(0) + b"D") * 100_000), "a record is damaged"),
    "heads.ulg": (ulog("a:uint64_t timestamp;", data=b"D" * 10_000_000), "the file ends inside"),
    "unknown.ulg": (ulog(*(["a:uint64_t timestamp;"] * 2), names=[f"b{n}" for n in range(30_000)]), "is damaged"),
    "heads.bin": (dataflash(b"\xa3\x95\x81" * 3_000_000), "no valid time"),
    "pieces.bin": (dataflash((b"\xa3\x95\x81" + bytes(9) + b"\xa3\x95\x81" + bytes(9) + b"x") * 50_000), "a record is damaged"),
    "formats.bin": (dataflash(b"".join(map(dataflash_format, range(10_000)))), ""),
}  # fmt: skip


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    place = tmp_path_factory.mktemp("hostile")
    for name, (write, _) in HOSTILE.items():
        write(place / name)
    paths = [str(place / name) for name in HOSTILE]
    done = subprocess.run([sys.executable, "-c", READ, *paths], capture_output=True, text=True, check=False)
    subprocess.run(
        ["rm", "-rf", place], check=True
    )  # pytest's own way to clear up is Python's, which cannot go so deep
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
