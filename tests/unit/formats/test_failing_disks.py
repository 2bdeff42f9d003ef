"""Disks that fail while a log is read, and files that are cut then: what is not given is damage, and nothing else is lost."""

import errno
import os
import resource
import sqlite3
import subprocess
import sys
from collections import Counter
from contextlib import closing, suppress
from pathlib import Path

import pytest
import zstandard
from mcap.writer import CompressionType
from random_messages import ROS1, random_messages, write_bag, write_mcap
from rosbags.rosbag1 import Writer as BagWriter

from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.sqlite_file import SqlitePart

TYPES = ("sensor_msgs/msg/Imu", "std_msgs/msg/ColorRGBA")
MESSAGES = random_messages(1, count=400, types=TYPES)
ROS1_MESSAGES = random_messages(1, count=400, types=TYPES, store=ROS1)
LOGS = {
    "zstd.mcap": lambda path: write_mcap(path, MESSAGES, chunk_bytes=4096),
    "plain.mcap": lambda path: write_mcap(path, MESSAGES, chunk_bytes=4096, compression=CompressionType.NONE),
    "lz4.bag": lambda path: write_bag(path, ROS1_MESSAGES, BagWriter.CompressionFormat.LZ4, chunk_bytes=4096),
    "plain.bag": lambda path: write_bag(path, ROS1_MESSAGES, chunk_bytes=4096),
}


def fail(path):
    """Have every further read of an open file fail, as on a dying disk: memory that is not mapped takes its place."""
    memory = os.open("/proc/self/mem", os.O_RDONLY)
    for number in list(Path("/proc/self/fd").iterdir()):
        with suppress(OSError):
            if number.readlink() == path:
                os.dup2(memory, int(number.name), inheritable=False)
    os.close(memory)


@pytest.fixture
def bad_sector(monkeypatch):
    """A function that has reads of some bytes of any file fail, and others end there, as a disk with a bad sector does."""

    def spoil(first, end):
        pread, preadv = os.pread, os.preadv

        def left(offset, size):
            if first <= offset < end:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            return min(size, first - offset) if offset < first else size

        def some_pread(file, size, offset):
            return pread(file, left(offset, size), offset)

        def some_preadv(file, views, offset):
            (view,) = views
            return preadv(file, [view[: left(offset, len(view))]], offset)

        monkeypatch.setattr(os, "pread", some_pread)
        monkeypatch.setattr(os, "preadv", some_preadv)

    return spoil


@pytest.mark.parametrize("name", LOGS)
def test_a_disk_that_dies_leaves_damage(tmp_path, name):
    path = LOGS[name](tmp_path / name)
    with open_log(path) as log:
        fail(path)
        tables = log.tables(log.topics)
        held = sum(topic.message_count for topic in log.topics.values())
        (lost,) = [finding for finding in log.findings if finding.names.get("reason") == "Input/output error"]
    assert [table.num_rows for table in tables.values()] == [0, 0]
    assert lost.code == "data-unreadable"
    assert lost.numbers.get("lost_messages_count", 0) >= held or lost.numbers["lost_bytes"]


@pytest.mark.parametrize("name", LOGS)
@pytest.mark.parametrize("indexed", [True, False])
def test_a_bad_sector_costs_what_lies_on_it(tmp_path, name, indexed, bad_sector):
    path = LOGS[name](tmp_path / name)
    data = bytearray(path.read_bytes())
    if not indexed and name.endswith(".mcap"):
        del data[-8:]
    elif not indexed:  # as a recorder that died leaves it
        index_at = data.find(b"index_pos=") + 10
        data[index_at : index_at + 8] = bytes(8)
    path.write_bytes(data)
    middle = len(data) // 2 // 512 * 512
    bad_sector(middle, middle + 512)
    with open_log(path) as log:
        tables = log.tables(log.topics)
        (lost,) = [finding for finding in log.findings if finding.code == "data-unreadable"]
    found = sorted(stamp for table in tables.values() for stamp in table["log_time_ns"].to_pylist())
    stamps = [message.log_time_ns for message in (MESSAGES if name.endswith(".mcap") else ROS1_MESSAGES)]
    assert 0.8 * len(stamps) < len(found) < len(stamps)
    assert not Counter(found) - Counter(stamps)
    assert (found[0], found[-1]) == (stamps[0], stamps[-1])
    assert lost.numbers["first_offset"] < middle + 512


def write_db3(path, *, count=300, bytes_each=3000):
    """A file of two topics: small messages on one, on the other such as take several pages."""
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.executemany("INSERT INTO topics VALUES (?, ?, 'a/msg/A', 'cdr')", [(1, "/one"), (2, "/two")])
        rows = [(n, 1 + n % 2, n, bytes([n % 256]) * (bytes_each * (n % 2 * 4) + 20)) for n in range(1, count + 1)]
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    return {number: data for number, _, _, data in rows}


def rows_of(part):
    """Id and data of every message that a part gives."""
    return [
        (number, bytes(block.buffer[at : at + length]))
        for block in part.blocks(frozenset({1, 2}))
        for number, at, length in zip(
            block.ordinal.tolist(), block.offsets.tolist(), block.lengths.tolist(), strict=True
        )
    ]


def test_a_db3_on_a_disk_that_dies_leaves_damage(tmp_path):
    path = tmp_path / "a.db3"
    written = write_db3(path, count=2000, bytes_each=3000)  # more than SQLite keeps in its cache
    with closing(SqlitePart(path, "a.db3")) as part:
        fail(path)
        found = rows_of(part)
        damage = [place.cause for place in part.damage]
    assert len(found) < len(written)
    assert found == [(number, written[number]) for number, _ in found]
    assert "database-damaged" in damage


CUT_WHILE_OPEN = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_failing_disks import SqlitePart, rows_of
path = Path(sys.argv[1])
part = SqlitePart(path, "a.db3")
os.truncate(path, path.stat().st_size // 2)
found = rows_of(part)
print(len(found), *(place.cause for place in part.damage), sep="|")
"""


def test_a_db3_that_is_cut_while_it_is_read_leaves_damage(tmp_path):
    path = tmp_path / "a.db3"
    write_db3(path, count=2000, bytes_each=3000)
    command = [sys.executable, "-c", CUT_WHILE_OPEN, path, Path(__file__).parent]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr  # a process that looks at what is not there is ended by SIGBUS
    count, *damage = done.stdout.strip().split("|")
    assert int(count) < 2000
    assert "database-damaged" in damage


def test_a_log_whose_end_the_disk_does_not_give_has_no_hash(tmp_path):
    with open_log(LOGS["zstd.mcap"](tmp_path / "a.mcap")) as log:
        log.files = (Path("/proc/self/mem"),)
        with pytest.raises(
            LogError, match=r"/proc/self/mem: it cannot be read to its end \(Input/output error\); rescue"
        ):
            log.sha256()


def zstd_file(directory):
    whole = write_mcap(directory / "a.mcap", MESSAGES, compression=CompressionType.NONE)
    path = directory / "a.mcap.zstd"
    path.write_bytes(zstandard.compress(whole.read_bytes()))
    return path


def cut_db3(directory):
    path = directory / "a.db3"
    write_db3(path)
    os.truncate(path, 8 * 4096 + 100)
    return path


@pytest.mark.parametrize("make", [zstd_file, cut_db3])
def test_no_room_for_a_copy_is_told_and_is_no_damage(tmp_path, make):
    path = make(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, before[1]))
    try:
        with pytest.raises(LogError, match=f"{path.name}: it cannot be .* \\(no room for a copy here; TMPDIR names"):
            open_log(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
