"""Pages read without SQLite, against SQLite: every page size, rows of every size, deletions, and what is left to SQLite."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest

from tcpipe.formats.logs.sqlite_file import SqlitePart
from tcpipe.formats.logs.sqlite_pages import PageReader, UnusualError

SCHEMA = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL)",
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL)",
)
STAMPS = (0, 1, -1, 127, 128, -129, 1 << 15, 1 << 23, -(1 << 31), 1 << 40, 1_700_000_000_000_000_000, -(1 << 63))


def database(path, *, page_bytes=4096, count=300, sizes=None, seed=0, table=SCHEMA[1]):
    """A file of two topics; payloads from nothing to many pages."""
    rng = np.random.default_rng(seed)
    connection = sqlite3.connect(path)
    connection.execute(f"PRAGMA page_size={page_bytes}")
    connection.execute(SCHEMA[0])
    connection.execute(table)
    connection.executemany("INSERT INTO topics VALUES (?, ?, 'a/msg/A', 'cdr')", [(1, "/one"), (300, "/two")])
    choices = sizes or (0, 1, 60, 200, page_bytes - 40, page_bytes, 5 * page_bytes + 3)
    number = 0
    for index in range(count):
        number += int(rng.choice([1, 1, 1, 200, 70_000]))
        size = int(rng.choice(choices))
        row = (number, int(rng.choice([1, 300])), STAMPS[index % len(STAMPS)], rng.bytes(size))
        connection.execute("INSERT INTO messages VALUES (?, ?, ?, ?)", row)
    connection.commit()
    return connection


def rows_by_part(path, *, threads=1):
    part = SqlitePart(path, path.name)
    used = part._table is not None
    found = [
        (ordinal, block.channel, log, bytes(block.buffer[at : at + length]))
        for block in part.blocks(frozenset({1, 300}), threads=threads)
        for ordinal, at, length, log in zip(
            block.ordinal.tolist(),
            block.offsets.tolist(),
            block.lengths.tolist(),
            block.log_time_ns.tolist(),
            strict=True,
        )
    ]
    channels = {number: (c.message_count, c.start_ns, c.end_ns) for number, c in part.channels.items()}
    part.close()
    assert not part.damage
    return sorted(found), channels, used


def rows_by_sqlite(connection):
    return connection.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id").fetchall()


@pytest.mark.parametrize("page_bytes", [512, 1024, 4096, 65536])
@pytest.mark.parametrize("threads", [1, 3])
def test_every_row_of_every_size_is_what_sqlite_reads(tmp_path, page_bytes, threads):
    path = tmp_path / "a.db3"
    with closing(database(path, page_bytes=page_bytes)) as connection, connection:
        expected = rows_by_sqlite(connection)
    found, channels, used = rows_by_part(path, threads=threads)
    assert used
    assert found == expected
    for number in (1, 300):
        stamps = [stamp for _, topic, stamp, _ in expected if topic == number]
        assert channels[number] == (len(stamps), min(stamps), max(stamps))


def test_rows_that_were_deleted_are_gone(tmp_path):
    path = tmp_path / "a.db3"
    with closing(database(path, count=600)) as connection, connection:
        connection.execute("DELETE FROM messages WHERE id % 3 = 0")
        connection.execute("INSERT INTO messages VALUES (1000000000000, 1, 5, x'00')")
        connection.commit()
        expected = rows_by_sqlite(connection)
    found, _, used = rows_by_part(path)
    assert used
    assert found == expected


def test_a_file_of_no_messages(tmp_path):
    path = tmp_path / "a.db3"
    database(path, count=0).close()
    assert rows_by_part(path) == ([], {1: (0, None, None), 300: (0, None, None)}, True)


@pytest.mark.parametrize(
    "table",
    [
        SCHEMA[1] + " WITHOUT ROWID",
        SCHEMA[1].replace("id INTEGER PRIMARY KEY", "id INT PRIMARY KEY"),
        SCHEMA[1].replace("data BLOB NOT NULL", "data BLOB NOT NULL, note TEXT"),
        SCHEMA[1].replace(
            "id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL", "topic_id INTEGER NOT NULL, id INTEGER PRIMARY KEY"
        ),
    ],
)
def test_what_is_not_as_ros_2_makes_it_is_left_to_sqlite(tmp_path, table):
    path = tmp_path / "a.db3"
    connection = sqlite3.connect(path)
    connection.execute(SCHEMA[0])
    connection.execute(table)
    connection.executemany("INSERT INTO topics VALUES (?, ?, 'a/msg/A', 'cdr')", [(1, "/one"), (300, "/two")])
    connection.executemany(
        "INSERT INTO messages(id, topic_id, timestamp, data) VALUES (?, ?, ?, ?)",
        [(n, 1 if n % 2 else 300, n * 10, bytes([n % 256]) * n) for n in range(1, 200)],
    )
    connection.commit()
    expected = rows_by_sqlite(connection)
    connection.close()
    found, _, used = rows_by_part(path)
    assert not used
    assert found == expected


def test_rows_of_unusual_types_are_left_to_sqlite_from_there_on(tmp_path):
    path = tmp_path / "a.db3"
    with closing(database(path, count=50)) as connection, connection:
        last = connection.execute("SELECT MAX(id) FROM messages").fetchone()[0]
        connection.execute("INSERT INTO messages VALUES (?, 1, 2.5, x'0102')", (last + 1,))
        connection.execute("INSERT INTO messages VALUES (?, 1, 7, x'0102')", (last + 2,))
        connection.commit()
        expected = [row for row in rows_by_sqlite(connection) if isinstance(row[2], int)]
    with closing(SqlitePart(path, path.name)) as part:
        found = sorted(number for block in part.blocks(frozenset({1, 300})) for number in block.ordinal.tolist())
    assert found == [row[0] for row in expected]
    assert [damage.messages_lost for damage in part.damage] == [1]


def test_headers_that_cannot_be_trusted_are_unusual(tmp_path):
    path = tmp_path / "a.db3"
    database(path).close()
    clean = path.read_bytes()
    PageReader(memoryview(clean))
    for at, value in ((0, 0), (16, 3), (24, clean[24] + 1), (31, clean[31] + 1)):
        broken = bytearray(clean)
        broken[at] = value % 256
        with pytest.raises(UnusualError):
            PageReader(memoryview(broken))


def every_row(data, root):
    reader = PageReader(data)
    return [reader.rows(leaves, 4, (1, 2)) for leaves in reader.leaves(root)]


def test_pages_that_point_nowhere_or_to_themselves_end(tmp_path):
    path = tmp_path / "a.db3"
    connection = database(path, page_bytes=512)
    root = connection.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'messages'").fetchone()[0]
    connection.close()
    clean = path.read_bytes()
    for child in (root, 0, 1 << 31, 1):
        broken = bytearray(clean)
        broken[(root - 1) * 512 + 8 : (root - 1) * 512 + 12] = child.to_bytes(4, "big")
        with pytest.raises(UnusualError):
            every_row(memoryview(broken), root)


def varint(data, at):
    """A big-endian number of 7 bits a byte (8 in the ninth), and where it ends: section 1.6 of the format."""
    value = 0
    for byte in data[at : at + 8]:
        value, at = value << 7 | byte & 0x7F, at + 1
        if byte < 0x80:
            return value, at
    return value << 8 | data[at], at + 1


def ids_of_whole_rows(data, page_bytes, columns=4):
    """Row ids of the table of so many columns, of rows that lie whole in a file's whole pages, walked page by page by hand."""
    pages, least = len(data) // page_bytes, (page_bytes - 12) * 32 // 255 - 23
    found = []
    for start in range(page_bytes, pages * page_bytes, page_bytes):
        cells = int.from_bytes(data[start + 3 : start + 5], "big") if data[start] == 13 else 0
        for pointer in range(start + 8, start + 8 + 2 * cells, 2):
            size, at = varint(data, start + int.from_bytes(data[pointer : pointer + 2], "big"))
            number, at = varint(data, at)
            head_bytes, column = varint(data, at)
            kinds = []
            while column < at + head_bytes:
                kind, column = varint(data, column)
                kinds.append(kind)
            fitting = least + (size - least) % (page_bytes - 4)
            local = size if size <= page_bytes - 35 else fitting if fitting <= page_bytes - 35 else least
            left, page = size - local, int.from_bytes(data[at + local : at + local + 4], "big")
            while left > 0 and page <= pages:
                left, page = left - page_bytes + 4, int.from_bytes(data[(page - 1) * page_bytes :][:4], "big")
            if len(kinds) == columns and kinds[-1] % 2 == 0 and left <= 0:
                found.append(number)
    return sorted(found)


def rows_of_cut(path, data):
    """The ids that are read of a cut file, and what is said of it."""
    path.write_bytes(data)
    with closing(SqlitePart(path, path.name)) as part:
        blocks = list(part.blocks(frozenset({1, 300})))
        found = {
            number: bytes(block.buffer[at : at + length])
            for block in blocks
            for number, at, length in zip(
                block.ordinal.tolist(), block.offsets.tolist(), block.lengths.tolist(), strict=True
            )
        }
        assert sum(len(block.ordinal) for block in blocks) == len(found)
        return found, [damage.what for damage in part.damage]


@pytest.mark.parametrize(("page_bytes", "sizes"), [(512, None), (512, (3, 60, 90)), (4096, (60, 330, 9000))])
def test_of_a_cut_file_every_row_that_lies_whole_in_it_is_read(tmp_path, page_bytes, sizes):
    path = tmp_path / "a.db3"
    with closing(database(path, page_bytes=page_bytes, count=1500, sizes=sizes)) as connection, connection:
        expected = {number: data for number, _, _, data in rows_by_sqlite(connection)}
    data = path.read_bytes()
    assert ids_of_whole_rows(data, page_bytes) == sorted(expected)
    counts = []
    for share in (0.03, 0.1, 0.3, 0.45, 0.62, 0.8, 0.97):
        cut = data[: int(share * len(data))]
        found, damage = rows_of_cut(path, cut)
        assert sorted(found) == ids_of_whole_rows(cut, page_bytes)
        assert all(expected[number] == payload for number, payload in found.items())
        assert damage[0] == f"the file ends at byte {len(cut)} of {len(data)}"
        counts.append(len(found))
    assert 0 < counts[0] < counts[-1] < len(expected)
    assert counts == sorted(counts)


@pytest.mark.parametrize(
    "change", ["DELETE FROM messages WHERE id % 3 = 0 OR id < 50000", "UPDATE messages SET id = -id"]
)
def test_of_a_cut_file_no_row_comes_back_that_was_taken_out(tmp_path, change):
    path = tmp_path / "a.db3"
    with closing(database(path, page_bytes=512, count=800)) as connection, connection:
        connection.execute(change)
        connection.commit()
        expected = {number: data for number, _, _, data in rows_by_sqlite(connection)}
    data = path.read_bytes()
    found, damage = rows_of_cut(path, data[: int(0.7 * len(data))])
    assert all(expected[number] == payload for number, payload in found.items())
    assert any("cannot be read" in line for line in damage)
