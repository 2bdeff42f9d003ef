"""Files of SQLite: every page size, rows of every size, deletions, tables of another form, and files that are cut or damaged."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest

from tcpipe.formats.logs.sqlite_file import SqlitePart
from tcpipe.logs.topics import Damage

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
        connection.execute("INSERT INTO messages(id, topic_id, timestamp, data) VALUES (?, ?, ?, ?)", row)
    connection.commit()
    return connection


def list_rows(part):
    return [
        (ordinal, block.channel, log, bytes(block.buffer[at : at + length]))
        for block in part.blocks(frozenset({1, 300}))
        for ordinal, at, length, log in zip(
            block.ordinal.tolist(),
            block.offsets.tolist(),
            block.lengths.tolist(),
            block.log_time_ns.tolist(),
            strict=True,
        )
    ]


def rows_by_part(path):
    with closing(SqlitePart(path, path.name)) as part:
        channels = {number: (c.message_count, c.start_ns, c.end_ns) for number, c in part.channels.items()}
        found = sorted(list_rows(part))
        assert not part.damage
        return found, channels


def rows_by_sqlite(connection):
    return connection.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id").fetchall()


@pytest.mark.parametrize(
    ("page_bytes", "table"),
    [
        *((page_bytes, SCHEMA[1]) for page_bytes in (512, 1024, 4096, 65536)),
        (512, SCHEMA[1] + " WITHOUT ROWID"),
        (1024, SCHEMA[1].replace("id INTEGER PRIMARY KEY", "id INT PRIMARY KEY")),
        (4096, SCHEMA[1].replace("data BLOB NOT NULL", "data BLOB NOT NULL, note TEXT")),
        (512, "CREATE TABLE messages(topic_id INTEGER, id INTEGER PRIMARY KEY, timestamp INTEGER, data BLOB)"),
    ],
)
def test_every_row_of_every_size_and_table_is_what_was_written(tmp_path, page_bytes, table):
    path = tmp_path / "a.db3"
    with closing(database(path, page_bytes=page_bytes, table=table)) as connection, connection:
        expected = rows_by_sqlite(connection)
    found, channels = rows_by_part(path)
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
    found, _ = rows_by_part(path)
    assert found == expected


def test_a_file_of_no_messages(tmp_path):
    path = tmp_path / "a.db3"
    database(path, count=0).close()
    assert rows_by_part(path) == ([], {1: (0, None, None), 300: (0, None, None)})


def rows_of(path, data):
    """The rows that are read of a damaged file, and what is said of it."""
    path.write_bytes(data)
    return rows_of_part(path)


def rows_of_part(path):
    with closing(SqlitePart(path, path.name)) as part:
        rows = list_rows(part)
        found = {number: payload for number, _, _, payload in rows}
        assert len(rows) == len(found)
        return found, part.damage


@pytest.mark.parametrize(("page_bytes", "sizes"), [(512, None), (4096, (60, 330, 9000))])
def test_of_a_cut_file_the_rows_that_are_left_are_read(tmp_path, page_bytes, sizes):
    path = tmp_path / "a.db3"
    with closing(database(path, page_bytes=page_bytes, count=1500, sizes=sizes)) as connection, connection:
        expected = {number: data for number, _, _, data in rows_by_sqlite(connection)}
    data = path.read_bytes()
    for share in (0.62, 0.8, 0.97):
        cut = data[: int(share * len(data))]
        found, damage = rows_of(path, cut)
        assert all(expected[number] == payload for number, payload in found.items())
        assert damage[0] == Damage("file-cut", "a.db3", len(cut), bytes_lost=len(data) - len(cut))
        assert (share - 0.05) * len(expected) < len(found) < len(expected)


def test_rows_between_damaged_pages_are_read(tmp_path):
    path = tmp_path / "a.db3"
    with closing(database(path, count=3000, sizes=(60, 330))) as connection, connection:
        expected = {number: data for number, _, _, data in rows_by_sqlite(connection)}
    data = bytearray(path.read_bytes())
    leaves = [at for at in range(4096, len(data), 4096) if data[at] == 0x0D]
    for at in leaves[10::20]:
        data[at : at + 4096] = bytes(4096)
    found, damage = rows_of(path, bytes(data))
    assert 0.9 * len(expected) < len(found) < 0.97 * len(expected)
    assert all(expected[number] == payload for number, payload in found.items())
    assert len({place for place in damage if place.reason.startswith("after message")}) == len(leaves[10::20])


@pytest.mark.parametrize("share", [1, 0.7])
def test_nothing_is_written_beside_the_log(tmp_path, share):
    path = tmp_path / "a.db3"
    with closing(database(path)) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("UPDATE messages SET topic_id = 1")
        connection.commit()
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    path.chmod(0o444)
    found, _ = rows_of_part(path)
    assert found
    assert [file.name for file in tmp_path.iterdir()] == ["a.db3"]


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
    found, damage = rows_of(path, data[: int(0.7 * len(data))])
    assert all(expected[number] == payload for number, payload in found.items())
    assert any(place.cause == "database-damaged" for place in damage)
