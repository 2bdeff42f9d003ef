"""The .db3 files of ROS 2: SQLite tables of topics and messages, all schema versions, read without writing.

SQLite has no checksums: a byte flipped inside a message is not noticed here. But every row of the table of messages
either becomes a message or is counted as damage, and a file whose pages contradict each other is reported as damaged.
In a damaged file, the reader skips the ranges of ids that SQLite cannot read.
"""

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from tcpipe.errors import LogError
from tcpipe.formats.atomic import describe_full_disk, make_scratch_directory
from tcpipe.formats.logs.log_part import MAX_CHANNELS, Bounds, LogPart, MessageBlock, split_by_channel
from tcpipe.logs.topics import Topic, normalize_type_name

MAGIC = b"SQLite format 3\0"

_HEADER_BYTES = 100
_BLOCK_ROWS, _BLOCK_BYTES = 4096, 1 << 23  # most rows of a block, and its size after which no row is added [byte]
_BEFORE_ALL, _LAST_ID = -1e19, 2**63 - 1
_MOST_HOLES = 1000  # most damaged ranges after which reading of a file ends: the end of each is searched
# SQLite refuses a row that claims to be longer, or longer than its file: a chain of pages may lead back to itself.
_LONGEST_BYTES, _ROW_BYTES = 1 << 28, 1 << 10
_TABLES = ("topics", "messages", "message_definitions")
# Errors of a damaged database; the second if its message has a damaged name, the third if a row is endless.
_BROKEN = (sqlite3.Error, UnicodeDecodeError, MemoryError)
_Row = tuple[int, int, int, int, bytes]  # row id, topic, log time, publish time, data


class SqlitePart(LogPart):
    """One .db3 file, open for reading."""

    container = "rosbag2"
    is_unchecked = True

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(name)
        self._opened = ExitStack()
        self._is_cut = False
        try:
            self._database = self._open(path)
            self._database.text_factory = lambda text: text.decode(errors="backslashreplace")
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(path.stat().st_size + _ROW_BYTES, _LONGEST_BYTES))
            # Without this, SQLite refuses a file that lacks its last pages.
            self._database.execute("PRAGMA writable_schema = ON")
            self._refuse_odd_tables(path)
            self.channels = self._channels(path)
        except LogError:
            self.close()
            raise
        except OSError as error:
            self.close()
            why = describe_full_disk(error) or error.strerror
            raise LogError(
                f"{path}: it cannot be read, or copied to be read ({why}); tcpipe does not read it"
            ) from None
        except _BROKEN as error:
            self.close()
            raise LogError(
                f"{path}: its table of topics cannot be read ({_describe_error(error)}); tcpipe does not read it"
            ) from None

    def close(self) -> None:
        """Close the file, and remove its copy where one was needed."""
        self._opened.close()

    def blocks(self, wanted: frozenset[int]) -> Iterator[MessageBlock]:
        """Yield the messages of the requested topics in the order of their ids, some thousand rows at a time."""
        topics = sorted(wanted & self.channels.keys())
        if not topics:
            return
        self._note_contradictions()
        rows, gathered_bytes = list[_Row](), 0
        columns, is_message = self._message_columns()
        of_topics = f"{is_message} AND topic_id IN ({','.join(map(str, topics))})"
        for row in self._reachable(f"SELECT {columns} FROM messages WHERE {of_topics}"):  # noqa: S608
            rows.append(row)
            gathered_bytes += len(row[-1])
            if gathered_bytes > _BLOCK_BYTES or len(rows) == _BLOCK_ROWS:
                yield from _read_blocks(rows)
                rows, gathered_bytes = [], 0
        if rows:
            yield from _read_blocks(rows)

    def _open(self, path: Path) -> sqlite3.Connection:
        """Open the file read-only and without locks, or a copy if it has an unmerged journal or a partial last page."""
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
        page_bytes = int.from_bytes(head[16:18], "big")
        page_bytes = 65536 if page_bytes == 1 else max(page_bytes, 1)
        size = path.stat().st_size
        pages = int.from_bytes(head[28:32], "big") if head[24:28] == head[92:96] else 0  # else the count is outdated
        expected_bytes = page_bytes * (pages or -(-size // page_bytes))
        journal = path.with_name(path.name + "-wal")
        has_journal = size >= expected_bytes and journal.exists() and journal.stat().st_size > 0
        if size < expected_bytes:
            self._is_cut = True
            self._note("file-cut", size, bytes_lost=expected_bytes - size)
        if has_journal or (self._is_cut and size % page_bytes):
            copy = self._opened.enter_context(make_scratch_directory()) / path.name
            shutil.copyfile(path, copy)
            if has_journal:
                shutil.copyfile(journal, copy.with_name(journal.name))
            else:
                with copy.open("r+b") as file:
                    file.truncate(size - size % page_bytes)
            path = copy
        options = "" if has_journal else "?mode=ro&immutable=1"
        database = sqlite3.connect(f"file:{quote(str(path.absolute()))}{options}", uri=True)
        self._opened.callback(database.close)
        return database

    def _refuse_odd_tables(self, path: Path) -> None:
        """Reject a file whose topics or messages are not plain tables: views may compute for an unlimited time."""
        query = "SELECT lower(name), type, rootpage FROM sqlite_schema WHERE lower(name) IN (?, ?, ?)"
        for name, kind, root in self._database.execute(query, _TABLES):
            computed = any(hidden for *_, hidden in self._database.execute(f"PRAGMA table_xinfo({name})"))
            if kind != "table" or not root or computed:
                raise LogError(f"{path}: its {name!r} is no plain table; tcpipe does not read it")

    def _channels(self, path: Path) -> dict[int, Topic]:
        """Return the topics of the file by number; record messages of other topics as damage."""
        rows = self._database.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id LIMIT ?", (MAX_CHANNELS + 1,)
        ).fetchall()
        Bounds(path, path.stat().st_size).count(0, len(rows))
        definitions = self._definitions()
        spans = self._spans()
        channels = {}
        for number, topic, type_name, encoding in rows:
            if not isinstance(number, int):
                self._note("record-damaged")
                continue
            schema_encoding, definition = definitions.get(type_name, ("", ""))
            count, first, last = spans.get(number, (0, None, None))
            channels[number] = Topic(
                str(topic),
                normalize_type_name(str(type_name)),
                count,
                first,
                last,
                str(encoding),
                definition,
                schema_encoding=schema_encoding,
            )
        if unknown := spans.keys() - channels.keys():
            self._note("channel-undeclared", messages_lost=sum(spans[number][0] for number in unknown))
        return channels

    def _definitions(self) -> dict[str, tuple[str, str]]:
        """Return encoding and text of each type's definition; files older than ROS 2 Iron contain none."""
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT ?"
        try:
            rows = self._database.execute(query, (MAX_CHANNELS,))
            return {name: (str(encoding), str(text or "")) for name, encoding, text in rows}
        except _BROKEN:
            return {}

    def _spans(self) -> dict[int, tuple[int, int, int]]:
        """Return count, first and last log time by topic; invalid or unreadable rows are recorded as damage."""
        _, is_message = self._message_columns()
        by_topic = "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages NOT INDEXED"
        try:
            spans = {
                topic: (count, first, last)
                for topic, count, first, last in self._database.execute(
                    f"{by_topic} WHERE {is_message} GROUP BY topic_id"
                )
            }
            row_count = self._database.execute("SELECT COUNT(*) FROM messages NOT INDEXED").fetchone()[0]
            lost = row_count - sum(count for count, _, _ in spans.values())
        except _BROKEN:
            spans, lost = {}, 0
            all_rows = f"SELECT id, topic_id, timestamp, {is_message} FROM messages WHERE TRUE"  # noqa: S608
            for _, topic, stamp, right in self._reachable(all_rows):
                lost += not right
                if right:
                    count, first, last = spans.get(topic, (0, stamp, stamp))
                    spans[topic] = count + 1, min(first, stamp), max(last, stamp)
        if lost:
            self._note("record-damaged", messages_lost=lost)
        return spans

    def _message_columns(self) -> tuple[str, str]:
        """Return the columns of a message (row id, topic, log time, publish time, data), and the test of a row."""
        columns = {row[1] for row in self._database.execute("PRAGMA table_info(messages)")}
        publish = "send_timestamp" if "send_timestamp" in columns else "timestamp"
        kinds = {"id": "integer", "topic_id": "integer", "timestamp": "integer", publish: "integer", "data": "blob"}
        is_message = " AND ".join(f"typeof({column}) = '{kind}'" for column, kind in kinds.items())
        return f"id, topic_id, timestamp, {publish}, data", is_message

    def _reachable(self, query: str) -> Iterator[Any]:
        """Yield a query's rows by rising id, their first column; of a damaged table, without unreadable rows."""
        before, low, row = _BEFORE_ALL, _BEFORE_ALL, None
        for _ in range(_MOST_HOLES):
            broken = ""
            for limit in ("", " LIMIT 1"):  # on an error, sqlite3 also drops the previous row
                try:
                    for row in self._database.execute(f"{query} AND id > ? ORDER BY id{limit}", (low,)):
                        if row[0] > low:
                            before, low = low, row[0]
                            yield row
                        elif before < row[0] != low:  # the id of the previous row was wrong
                            low = row[0]
                            yield row
                    break
                except _BROKEN as error:
                    broken = _describe_error(error)
            if not broken:
                return
            self._note("database-damaged", reason=broken if row is None else f"after message {low}: {broken}")
            row = self._first_behind(query, max(int(low), 0))
            if row is None:
                return
            if row[0] > low:
                before, low = low, row[0]
                yield row

    def _first_behind(self, query: str, low: int) -> Any:
        """Return the row of the first readable id above ``low``, found in steps that double; None without such a row."""
        step = 1
        while low + step <= _LAST_ID and self._first_from(query, low + step) is None:
            step *= 2
        if low + step > _LAST_ID:
            return None
        unreadable, readable = low + step // 2, low + step
        while readable - unreadable > 1:
            middle = (unreadable + readable) // 2
            if self._first_from(query, middle) is None:
                unreadable = middle
            else:
                readable = middle
        return self._first_from(query, readable)

    def _first_from(self, query: str, number: int) -> Any:
        """Return the first row with this id or a larger one; None without one, or if SQLite cannot read it."""
        try:
            return self._database.execute(f"{query} AND id >= ? ORDER BY id LIMIT 1", (number,)).fetchone()
        except _BROKEN:
            return None

    def _note_contradictions(self) -> None:
        """Record contradictions between the pages of a file; SQLite itself reads past many of them without an error."""
        if self._is_cut:  # which is noted already
            return
        try:
            self._database.execute("PRAGMA ignore_check_constraints = ON")
            problem = self._database.execute("PRAGMA quick_check(1)").fetchone()[0]
        except _BROKEN as error:
            problem = _describe_error(error)
        if problem != "ok" and " value in " not in problem:  # rows with wrong values are counted elsewhere
            self._note("database-damaged", reason=problem.splitlines()[-1])


def _describe_error(error: Exception) -> str:
    return str(error) or "a row claims more than memory holds"


def _read_blocks(rows: list[_Row]) -> list[MessageBlock]:
    """Return rows as one block a topic."""
    numbers, channels, log_ns, publish_ns, payloads = zip(*rows, strict=True)
    lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
    ordinal, channel, *times = np.array([numbers, channels, log_ns, publish_ns], np.int64)
    buffer, offsets = memoryview(b"".join(payloads)), np.cumsum(lengths) - lengths
    return split_by_channel(buffer, channel, offsets, lengths, *times, ordinal)
