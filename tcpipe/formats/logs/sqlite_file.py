"""The .db3 files of ROS 2: SQLite tables of topics and messages, all schema versions; a cut file gives what can still be had.

SQLite has no checksums: a byte flipped inside a message is not noticed here. But every row of the table of messages either becomes a
message or is counted as damage, and a file whose pages contradict one another is said to be broken.
"""

from __future__ import annotations

import itertools
import mmap
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import LogError
from tcpipe.formats.atomic import scratch_directory
from tcpipe.formats.logs.log_part import (
    MAX_CHANNELS,
    Bounds,
    Channel,
    DamageError,
    Int64Array,
    MessageBlock,
    grouped,
    in_order,
    listed,
    load_only,
    no_room,
)
from tcpipe.formats.logs.sqlite_pages import MAGIC, MAX_COLUMNS, Leaves, PageReader, Rows, UnusualError
from tcpipe.logs.topics import Damage, normalized_type_name

__all__ = ["MAGIC", "SqlitePart"]

_ROWS = 1024
_PAGES_AT_ONCE = 4096
_MAPPED_BYTES = 1 << 26
_KEPT_ROWS = 1 << 18
"""Where the rows of a file lie is found once, and kept for its reading, if they are no more than these (56 bytes each)."""
_SPILLED_BYTES = 1 << 24
"""Messages larger than a page are copied together up to about this size."""
_FILL = b"\xd5\x7e\xc3\x99"
"""Pages that a cut file lacks are filled with this: as a page it is invalid, so SQLite stops there; as the end of a long message it
is recognised."""
_FILLED_BYTES, _MAX_BYTES = 1 << 28, 1 << 42
"""Behind so many such bytes a cut file is made as long as it says it was by a hole; one that says more than the second is refused."""
_BELOW, _ABOVE = -(2**63), 2**63 - 1
_BEFORE_ALL, _BEHIND_ALL = -1e19, 1e19
"""Row ids lie between these: numbers of 64 bits do."""
_LONGEST_BYTES, _ROW_BYTES = 1 << 28, 1 << 10
"""SQLite refuses a row that claims to be longer, or longer than its file: a chain of pages may lead back to itself."""
_TABLES = ("topics", "messages", "message_definitions")
_NOTHING = "rows that are no messages: a number, a time or the data is missing or of another kind"
_CUT_ROWS = "messages whose end is lost"
_BROKEN = (sqlite3.Error, UnicodeDecodeError, MemoryError)
"""What a broken database raises; the second where even the name in its complaint is broken, the third where a row claims to be endless."""
_Row = tuple[int, int, int, int, bytes]
"""Row id, topic, log time, publish time, data."""


class SqlitePart:
    """One .db3 file, open for reading."""

    def __init__(self, path: Path, name: str) -> None:
        self.name = name
        self.damage: dict[Damage, None] = {}
        self.outline = ""
        self._scratch: ExitStack | None = None
        self._table: _MessageTable | None = None
        self._broken = ""
        self._cut = False
        try:
            self._database = self._open(path)
            self._database.text_factory = lambda text: text.decode(errors="backslashreplace")
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(path.stat().st_size + _ROW_BYTES, _LONGEST_BYTES))
            self._refuse_odd_tables(path)
            self._table = (
                _message_table(path, self._database, cut=self._cut) if self._cut or not self._scratch else None
            )
            self.channels = self._channels(path)
        except LogError:
            self.close()
            raise
        except OSError as error:
            self.close()
            why = no_room(error) or error.strerror
            raise LogError(
                f"{path}: it cannot be read, or copied to be read ({why}); nothing can be had from it"
            ) from None
        except _BROKEN as error:
            self.close()
            raise LogError(
                f"{path}: its table of topics cannot be read ({_why(error)}); nothing can be had from it"
            ) from None

    def close(self) -> None:
        """Close the file, and remove its copy where one was needed."""
        if hasattr(self, "_database"):
            self._database.close()
        if self._table:
            self._table.close()
        if self._scratch:
            self._scratch.close()

    @property
    def unchecked(self) -> str:
        """What was read that no checksum covers."""
        return "a .db3 carries no checksum"

    def blocks(self, wanted: frozenset[int], *, threads: int = 1) -> Iterator[MessageBlock]:
        """Yield the messages of the wanted topics, some thousand rows at a time: page by page, or by SQLite where that cannot be."""
        topics = sorted(wanted & self.channels.keys())
        if not topics:
            return
        read_until: int | None = None
        lost = 0
        if self._table:
            try:
                for last, found, broken in self._table.blocks(topics, threads=threads):
                    yield from found
                    read_until, lost = last, lost + broken
            except UnusualError:
                self._table = None
            if lost:
                self._note(_CUT_ROWS if self._cut else "messages go on on pages that are broken", messages_lost=lost)
            if self._table:
                return
        for rows in self._rows(topics, read_until):
            yield from _blocks(rows)

    def _open(self, path: Path) -> sqlite3.Connection:
        """Open without locking; a cut file, or one with an unmerged journal, through a copy."""
        with path.open("rb") as file:
            head = file.read(100)
        page_bytes = int.from_bytes(head[16:18], "big")
        page_bytes = 65536 if page_bytes == 1 else page_bytes
        size, wanted = path.stat().st_size, page_bytes * int.from_bytes(head[28:32], "big")
        if wanted > _MAX_BYTES:
            raise LogError(f"{path}: it has {size} bytes and claims to have {wanted}; nothing can be had from it")
        journal = path.with_name(path.name + "-wal")
        if size >= wanted and not (journal.exists() and journal.stat().st_size):
            return sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)
        self._scratch = ExitStack()
        copy = self._scratch.enter_context(scratch_directory()) / path.name
        shutil.copyfile(path, copy)
        if size >= wanted:
            shutil.copyfile(journal, copy.with_name(journal.name))
        else:
            self._cut = True
            self._note(f"the file ends at byte {size} of {wanted}", bytes_lost=wanted - size)
            with copy.open("r+b") as file:
                file.seek(size // page_bytes * page_bytes)
                for _ in range(file.tell(), min(wanted, size + _FILLED_BYTES), page_bytes):
                    file.write(_FILL * (page_bytes // len(_FILL)))
                file.truncate(wanted)
        return sqlite3.connect(copy)

    def _refuse_odd_tables(self, path: Path) -> None:
        """Refuse a file whose topics or messages are no plain tables: what else there is may compute without end."""
        query = "SELECT lower(name), type, rootpage FROM sqlite_schema WHERE lower(name) IN (?, ?, ?)"
        for name, kind, root in self._database.execute(query, _TABLES):
            computed = any(hidden for *_, hidden in self._database.execute(f"PRAGMA table_xinfo({name})"))
            if kind != "table" or not root or computed:
                raise LogError(f"{path}: its {name!r} is no plain table; nothing can be had from it")

    def _channels(self, path: Path) -> dict[int, Channel]:
        rows = self._database.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id LIMIT ?", (MAX_CHANNELS + 1,)
        ).fetchall()
        Bounds(path, path.stat().st_size).count(0, len(rows))
        definitions = self._definitions()
        spans = self._spans()
        channels = {}
        for number, topic, type_name, encoding in rows:
            if not isinstance(number, int):
                self._note(f"topic {topic} has no number")
                continue
            schema_encoding, definition = definitions.get(type_name, ("", ""))
            count, start_ns, end_ns = spans.get(number, (0, None, None))
            channels[number] = Channel(
                str(topic),
                normalized_type_name(str(type_name)),
                str(encoding),
                schema_encoding,
                definition,
                count,
                start_ns,
                end_ns,
            )
        if unknown := sorted(spans.keys() - channels.keys()):
            lost = sum(spans[number][0] for number in unknown)
            self._note(f"messages of {listed('topic', unknown)}, which nothing declares", messages_lost=lost)
        return channels

    def _definitions(self) -> dict[str, tuple[str, str]]:
        """Return encoding and text of each type's definition; files older than ROS 2 Iron hold none."""
        try:
            rows = self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT ?",
                (MAX_CHANNELS,),
            )
            return {name: (str(encoding), str(text or "")) for name, encoding, text in rows}
        except _BROKEN:
            return {}

    def _spans(self) -> dict[int, tuple[int, int, int]]:
        """Return count, first and last log time by topic, and count the rows that are no messages; in a broken file, of what is reached."""
        if self._table:
            try:
                spans, lost = self._table.spans()
            except UnusualError:
                self._table = None
            else:
                self._note_lost_rows(lost)
                return spans
        self._note_contradictions()
        is_message = " AND ".join(f"typeof({column}) = '{kind}'" for column, kind in self._kinds().items())
        query = f"SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages WHERE {is_message} GROUP BY topic_id"  # noqa: S608
        try:
            spans = {topic: (count, start, end) for topic, count, start, end in self._database.execute(query)}
            every = self._database.execute("SELECT COUNT(*) FROM messages NOT INDEXED").fetchone()[0]
        except _BROKEN:
            return self._reachable_spans(is_message)
        self._note_lost_rows(every - sum(count for count, _, _ in spans.values()))
        return spans

    def _reachable_spans(self, is_message: str) -> dict[int, tuple[int, int, int]]:
        spans: dict[int, tuple[int, int, int]] = {}
        lost = 0
        for rows in self._reachable(f"SELECT id, topic_id, timestamp, {is_message} FROM messages WHERE TRUE"):  # noqa: S608
            for _, topic, stamp, right in rows:
                lost += not right
                if right:
                    count, start, end = spans.get(topic, (0, stamp, stamp))
                    spans[topic] = (count + 1, min(start, stamp), max(end, stamp))
        self._note_lost_rows(lost)
        return spans

    def _kinds(self) -> dict[str, str]:
        """Return SQLite's kind of value in each column of a message: row id, topic, log time, publish time, data."""
        columns = {row[1] for row in self._database.execute("PRAGMA table_info(messages)")}
        publish = "send_timestamp" if "send_timestamp" in columns else "timestamp"
        return {"id": "integer", "topic_id": "integer", "timestamp": "integer", publish: "integer", "data": "blob"}

    def _rows(self, topics: list[int], above: int | None) -> Iterator[list[_Row]]:
        """Yield the topics' messages in the order they were written, those with ids above ``above``."""
        kinds = self._kinds()
        publish = "send_timestamp" if "send_timestamp" in kinds else "timestamp"
        is_message = " AND ".join(f"typeof({column}) = '{kind}'" for column, kind in kinds.items())
        of_topics = f"{is_message} AND topic_id IN ({','.join(map(str, topics))})"
        query = f"SELECT id, topic_id, timestamp, {publish}, data FROM messages WHERE {of_topics}"  # noqa: S608
        lost = 0
        for rows in self._reachable(query, _BEFORE_ALL if above is None else above):
            whole = [row for row in rows if _FILL not in row[4][-7:]] if self._cut else rows
            lost += len(rows) - len(whole)
            if whole:
                yield whole
        if lost:
            self._note(_CUT_ROWS, messages_lost=lost)

    def _reachable(self, query: str, low: float = _BEFORE_ALL) -> Iterator[list[Any]]:
        """Yield a query's rows by ascending id, their first column; past a broken page, upward to it and downward to it."""
        high = _BEHIND_ALL
        between = f"{query} AND id > ? AND id < ? ORDER BY id"
        for rows in self._until_broken(f"{between} ASC", low, high):
            low = rows[-1][0]
            yield rows
        if not self._broken:
            return
        broken, above = self._broken, []
        for rows in self._until_broken(
            f"{between} ASC LIMIT 1", low, high
        ):  # with an error sqlite3 drops the row before it
            low = rows[-1][0]
            yield rows
        for limit in ("", " LIMIT 1"):
            for rows in self._until_broken(f"{between} DESC{limit}", low, high):
                high = rows[-1][0]
                above.append(rows[::-1])
        start = "the beginning" if low == _BEFORE_ALL else f"message {low}"
        span = f"between {start} and {'the end' if high == _BEHIND_ALL else f'message {high}'}"
        self._note(f"messages {span} cannot be read ({broken})")
        yield from above[::-1]

    def _until_broken(self, query: str, low: float, high: float) -> Iterator[list[Any]]:
        """Yield a query's rows in blocks until its end, or until the database breaks (then ``_broken`` says how)."""
        self._broken = ""
        try:
            cursor = self._database.execute(query, (low, high))
        except _BROKEN as error:
            self._broken = _why(error)
            return
        while not self._broken:
            rows: list[Any] = []
            try:
                rows.extend(itertools.islice(cursor, _ROWS))  # what came before an error stays
            except _BROKEN as error:
                self._broken = _why(error)
            if rows:
                yield rows
            if len(rows) < _ROWS:
                break

    def _note_contradictions(self) -> None:
        """Note where the pages of a file contradict one another: SQLite reads on over much of that, and says nothing."""
        if self._cut:  # which is noted already
            return
        try:
            self._database.execute("PRAGMA ignore_check_constraints = ON")
            found = self._database.execute("PRAGMA quick_check(1)").fetchone()[0]
        except _BROKEN as error:
            found = _why(error)
        if found != "ok" and " value in " not in found:  # a value that is none is the row's own trouble, and counted
            self._note(f"its pages contradict one another ({found.splitlines()[-1]}); rows may be missing or wrong")

    def _note_lost_rows(self, lost: int) -> None:
        if lost:
            self._note(_NOTHING, messages_lost=lost)

    def _note(self, what: str, *, messages_lost: int | None = None, bytes_lost: int | None = None) -> None:
        self.damage[Damage(self.name, what, messages_lost=messages_lost, bytes_lost=bytes_lost)] = None


class _MessageTable:
    """The table of messages of a clean file, read page by page; of a cut one, whose other tables begin at ``others``, what is there."""

    def __init__(self, path: Path, root: int, columns: list[str], others: list[int] | None) -> None:
        with path.open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            self._map.madvise(mmap.MADV_RANDOM)
            self._data = memoryview(self._map)
            self._pages = PageReader(self._data, _loading(self._map), cut=others is not None)
            if others is None:
                self._leaves = self._pages.leaves(root)
            else:
                self._leaves = self._pages.leaves_here(_kinds_of_pages(file, self._pages.page_bytes), others)
        self._columns = len(columns)
        self._kept: list[Rows] | None = None
        publish = "send_timestamp" if "send_timestamp" in columns else "timestamp"
        self._integers = (columns.index("topic_id"), columns.index("timestamp"), columns.index(publish))

    def rows(self, *, threads: int = 1) -> Iterator[Rows]:
        """Yield all rows, some thousand at a time; `UnusualError` ends it."""
        if self._kept is not None:
            for leaves, rows in zip(self._leaves, self._kept, strict=True):
                self._pages.load(leaves.pages)
                yield rows
            return
        last, touched = _BELOW, 0
        for rows in in_order(self._rows, self._leaves, threads=threads):
            if len(rows.ids):
                if rows.ids[0] <= last:
                    raise UnusualError
                last = int(rows.ids[-1])
            yield rows
            touched += int(rows.lengths.sum())
            if touched > _MAPPED_BYTES:  # every page that was ever read counts as this process's memory
                self._map.madvise(mmap.MADV_DONTNEED)
                touched = 0

    def _rows(self, leaves: Leaves) -> Rows:
        self._pages.load(leaves.pages)  # and not what lies between them: messages larger than a page
        return self._pages.rows(leaves, self._columns, self._integers)

    def spans(self) -> tuple[dict[int, tuple[int, int, int]], int]:
        """Return count, first and last log time by topic, and how many rows are no messages."""
        spans: dict[int, tuple[int, int, int]] = {}
        found: list[Rows] = []
        count_all = lost = 0
        for rows in self.rows():
            lost += rows.lost
            count_all += len(rows.ids)
            if count_all <= _KEPT_ROWS:
                found.append(rows)
            topic, log_time_ns, _ = rows.integers
            for number, of in grouped(topic):
                stamps = log_time_ns[of]
                count, start, end = spans.get(number, (0, _ABOVE, _BELOW))
                spans[number] = count + len(stamps), min(start, int(stamps.min())), max(end, int(stamps.max()))
        self._kept = found if count_all <= _KEPT_ROWS else None
        return spans, lost

    def blocks(self, topics: list[int], *, threads: int = 1) -> Iterator[tuple[int, list[MessageBlock], int]]:
        """Yield the messages of the topics, some rows at a time, up to which id these go, and how many of them are broken.

        `UnusualError` ends it.
        """
        self._pages.begin()
        for rows in self.rows(threads=threads):
            copied = np.where((rows.overflow > 0) & np.isin(rows.integers[0], topics), rows.lengths, 0)
            bounds = np.flatnonzero(np.diff(np.cumsum(copied) // _SPILLED_BYTES)) + 1
            for first, end in itertools.pairwise([0, *bounds.tolist(), len(copied)]):
                if first < end:
                    some = rows.chosen(np.arange(first, end)) if len(bounds) else rows
                    yield int(some.ids[-1]), *self._blocks(some, topics)

    def _blocks(self, rows: Rows, topics: list[int]) -> tuple[list[MessageBlock], int]:
        """Return the messages of the topics, where they lie whole in the file, from there, else copied together; and the lost."""
        found, lost = [], 0
        wanted = np.flatnonzero(np.isin(rows.integers[0], topics))
        for _, of in grouped(rows.integers[0][wanted]):
            here = wanted[of]
            lies_whole = rows.overflow[here] == 0
            whole = here[lies_whole]
            if len(whole):
                found.append(self._block(rows.chosen(whole), self._data, rows.offsets[whole]))
            spilled = rows.chosen(here[~lies_whole])
            intact, buffer, offsets = self._copied(spilled)
            lost += len(spilled.ids) - len(intact.ids)
            if len(intact.ids):
                found.append(self._block(intact, buffer, offsets))
        return found, lost

    def _copied(self, rows: Rows) -> tuple[Rows, memoryview, Int64Array]:
        """Return the rows whose messages can be had, and what `PageReader.blobs` gives of these; where one cannot, each is tried."""
        with suppress(UnusualError):
            return rows, *self._pages.blobs(rows)
        intact = []
        for number in range(len(rows.ids)):
            with suppress(UnusualError):
                self._pages.blobs(rows.chosen(np.array([number])))
                intact.append(number)
        rows = rows.chosen(np.array(intact, np.int64))
        return rows, *self._pages.blobs(rows, again=True)

    def close(self) -> None:
        """Leave the file; views that are still held keep it mapped."""
        del self._pages, self._data

    @staticmethod
    def _block(rows: Rows, buffer: memoryview, offsets: Int64Array) -> MessageBlock:
        topic, log_time_ns, publish_time_ns = rows.integers
        return MessageBlock(int(topic[0]), buffer, offsets, rows.lengths, log_time_ns, publish_time_ns, rows.ids, None)


def _loading(window: mmap.mmap) -> Callable[[Int64Array, Int64Array], None]:
    """Return what loads pieces of a mapped file; where the disk does not give them, SQLite may say what is lost."""

    def load(starts: Int64Array, ends: Int64Array) -> None:
        try:
            load_only(window, starts, ends)
        except DamageError:
            raise UnusualError from None

    return load


def _kinds_of_pages(file: BinaryIO, page_bytes: int) -> NDArray[np.uint8]:
    """Return the first byte of each whole page."""
    pieces = iter(lambda: file.read(_PAGES_AT_ONCE * page_bytes), b"")
    return np.concatenate(
        [np.frombuffer(of, np.uint8, len(of) // page_bytes * page_bytes)[::page_bytes] for of in pieces]
    )


def _message_table(path: Path, database: sqlite3.Connection, *, cut: bool) -> _MessageTable | None:
    """Return the table of messages for reading by page; None where it is not as ROS 2 makes it."""
    tables = database.execute("SELECT name, rootpage, sql FROM sqlite_schema WHERE type = 'table'").fetchall()
    found = [(root, sql) for name, root, sql in tables if name == "messages"]
    columns = database.execute("PRAGMA table_xinfo(messages)").fetchall()
    if len(found) != 1 or not columns or "WITHOUT" in str(found[0][1]).upper():
        return None
    names = [str(name) for _, name, *_ in columns]
    keys = [(name, str(kind).upper()) for _, name, kind, _, _, key, _ in columns if key]
    plain = all(not hidden for *_, hidden in columns) and {"topic_id", "timestamp", "data"} <= set(names)
    if not plain or len(names) > MAX_COLUMNS or keys != [("id", "INTEGER")] or (names[0], names[-1]) != ("id", "data"):
        return None
    try:
        others = [int(root) for name, root, _ in tables if name != "messages" and root]
        return _MessageTable(path, int(found[0][0]), names, others if cut else None)
    except UnusualError:
        return None


def _why(error: Exception) -> str:
    return str(error) or "a row claims more than memory holds"


def _blocks(rows: list[_Row]) -> Iterator[MessageBlock]:
    """Yield rows from SQLite as one block a topic."""
    numbers, channels, log_ns, publish_ns, payloads = zip(*rows, strict=True)
    lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
    offsets = np.cumsum(lengths) - lengths
    buffer = memoryview(b"".join(payloads))
    ordinal, channel = np.array(numbers, np.int64), np.array(channels, np.int64)
    log, publish = np.array(log_ns, np.int64), np.array(publish_ns, np.int64)
    for topic, of in grouped(channel):
        yield MessageBlock(topic, buffer, offsets[of], lengths[of], log[of], publish[of], ordinal[of], None)
