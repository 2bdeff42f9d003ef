"""ROS 1 bags, version 2.0 (http://wiki.ros.org/Bags/Format/2.0), read by their index or, without one, by records.

A record is a header (fields ``name=value``) and data, each after its length (uint32). Chunks hold connections and
messages; after a chunk there is an index record for each of its connections; the file ends with all connections and a
summary of every chunk. Of the chunks, only those in bz2 have a checksum.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tcpipe.arrays import Bytes, Ints, Mask
from tcpipe.formats.logs.chunk_reading import ChunkedPart, Excerpt, Messages
from tcpipe.formats.logs.log_part import (
    MAX_CHUNK_BYTES,
    DamageError,
    decompress,
    decompress_prefix,
    gather_integers,
    outline_of,
)
from tcpipe.logs.topics import Topic, compute_dropouts_ns, normalize_type_name

MAGIC = b"#ROSBAG V2.0\n"

OP_MESSAGE, OP_HEADER, OP_INDEX, OP_CHUNK, OP_CHUNK_INFO, OP_CONNECTION = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
MAX_HEADER_BYTES = 1 << 16
"""A record's header is shorter."""
NS = 1_000_000_000
"""Nanoseconds in a second."""
_TIME = struct.Struct("<II")


@dataclass(frozen=True, slots=True)
class BagRecord:
    """A record: its header fields, and the position of its data."""

    fields: dict[bytes, bytes]
    data_offset: int
    data_bytes: int

    @property
    def opcode(self) -> int:
        """Number of the kind of the record."""
        return self.fields.get(b"op", b"\0")[0]

    @property
    def codec(self) -> str:
        """How a chunk is compressed: none, lz4, bz2."""
        return self.fields.get(b"compression", b"").decode(errors="replace")

    @property
    def end(self) -> int:
        """Byte after its data."""
        return self.data_offset + self.data_bytes

    def number(self, name: bytes) -> int:
        """Return a little-endian integer field; `DamageError` if it is missing."""
        if name not in self.fields:
            raise DamageError("record-damaged")
        return int.from_bytes(self.fields[name], "little")


@dataclass(slots=True)
class ChunkRecords:
    """Records of a chunk: connections, offsets and stamps of messages by connection, end and number of all records."""

    connections: list[BagRecord] = field(default_factory=list)
    offsets: dict[int, list[int]] = field(default_factory=dict)
    stamps: dict[int, list[int]] = field(default_factory=dict)
    end: int = 0
    count: int = 0

    def messages(self, data: memoryview, wanted: frozenset[int]) -> Messages:
        """Return the messages of the requested connections, one connection after the other."""
        numbers = sorted(wanted & self.offsets.keys())
        channel = np.repeat(np.array(numbers, np.int64), [len(self.offsets[number]) for number in numbers])
        offset = np.array([at for number in numbers for at in self.offsets[number]], np.int64)
        stamp_ns = np.array([at for number in numbers for at in self.stamps[number]], np.int64)
        if not len(offset):
            return Messages(data, channel, offset, offset, offset, stamp_ns, stamp_ns)
        payload = offset + 8 + gather_integers(data, offset, "u4")
        return Messages(data, channel, offset, payload, gather_integers(data, payload - 4, "u4"), stamp_ns, stamp_ns)


def walk_chunk(data: memoryview, most: int) -> ChunkRecords:
    """Read the records of a chunk until one is invalid, exceeds the chunk, or there are more than ``most``.

    Headers of messages of one connection differ only in time, so that most headers need no parsing.
    """
    records, position, size = ChunkRecords(), 0, len(data)
    length_at = struct.Struct("<I").unpack_from
    connection_by_header: dict[bytes, int] = {}
    time_at = 0
    while position + 8 <= size and records.count <= most:
        header_end = position + 4 + length_at(data, position)[0]
        if header_end + 4 > size:
            break
        end = header_end + 4 + length_at(data, header_end)[0]
        if end > size:
            break
        header = bytes(data[position + 4 : header_end])
        connection = connection_by_header.get(header[:time_at] + header[time_at + 8 :])
        if connection is None:
            try:
                record = BagRecord(parse_header_fields(header), header_end + 4, end - header_end - 4)
                if record.opcode == OP_CONNECTION:
                    records.connections.append(record)
                elif record.opcode == OP_MESSAGE:
                    connection = record.number(b"conn")
                    stamp_ns(record.fields, b"time")
                    time_at = header.find(b"time=") + 5
                    connection_by_header[header[:time_at] + header[time_at + 8 :]] = connection
            except DamageError:
                break
        if connection is not None:
            seconds, nanoseconds = _TIME.unpack_from(header, time_at)
            records.offsets.setdefault(connection, []).append(position)
            records.stamps.setdefault(connection, []).append(seconds * NS + nanoseconds)
        records.end = position = end
        records.count += 1
    return records


def parse_header_fields(header: bytes | memoryview) -> dict[bytes, bytes]:
    """Return the fields of a record's header."""
    header = bytes(header)
    fields, position = {}, 0
    while position < len(header):
        end = position + 4 + int.from_bytes(header[position : position + 4], "little")
        name, equals, value = header[position + 4 : end].partition(b"=")
        if end > len(header) or not equals:
            raise DamageError("record-damaged")
        fields[name] = value
        position = end
    return fields


def stamp_ns(fields: dict[bytes, bytes], name: bytes) -> int:
    """Return a time field in nanoseconds."""
    value = fields.get(name, b"")
    if len(value) != 8:
        raise DamageError("record-damaged")
    seconds, nanoseconds = _TIME.unpack(value)
    return seconds * NS + nanoseconds  # type: ignore[no-any-return]


def _find_message_fields(header: bytes) -> tuple[int, int]:
    """Return the offsets of connection and time in a message record; zeros if its header is not that of a message."""
    try:
        fields = parse_header_fields(header)
    except DamageError:
        return 0, 0
    sizes = len(fields.get(b"conn", b"")), len(fields.get(b"time", b""))
    if fields.get(b"op") != bytes([OP_MESSAGE]) or sizes != (4, 8):
        return 0, 0
    return 4 + header.find(b"conn=") + 5, 4 + header.find(b"time=") + 5


_CHUNK_MARK = b"\x04\0\0\0op=\x05"
_MAX_CHUNK_HEADER = 128
_INDEX_ENTRY_BYTES = 12
_INDEX_HEAD_BYTES = 64  # usual size of an index record's header and of the length after it
_PLACED_AT_ONCE = 1024  # number of chunks whose headers are read together
_EXPECTED_BYTES = 1 << 24  # an index is seldom longer; a damaged header may claim any size


@dataclass(frozen=True, slots=True)
class _Chunk:
    """A chunk and its number of messages by connection; ``counts`` is None if the bag has no index.

    ``record`` is the chunk's own record (None before it is read, or if it is damaged); ``size`` is the size of the
    records in it [byte].
    """

    offset: int
    start_ns: int = 0
    end_ns: int = 0
    counts: dict[int, int] | None = None
    cut: bool = False
    record: BagRecord | None = None
    size: int = 0


@dataclass(slots=True)
class _Connection:
    topic: str
    type_name: str
    definition: str
    count: int = 0
    starts: list[int] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)


class BagPart(ChunkedPart[_Chunk]):
    """One .bag file, open for reading."""

    container = "bag"
    least_bytes = 8

    def _open(self) -> dict[int, Topic]:
        """Read the index, or every record if the index cannot be used; return the topic of each connection."""
        self._connections: dict[int, _Connection] = {}
        self._chunks: list[_Chunk] = []
        try:
            self._read_index()
        except DamageError as error:
            self._note(error.cause, self._bytes.size, reason=error.reason)
            self._bytes.whole()
            self._connections, self._chunks = {}, []
            self._walk()
        return {number: _make_topic(self._connections[number]) for number in sorted(self._connections)}

    def chunks_with(self, wanted: frozenset[int]) -> list[tuple[int, _Chunk]]:
        """Return the chunks that may contain requested connections, each with an upper bound of the bytes before it."""
        selected, sizes = [], []
        for first in range(0, len(self._chunks), _PLACED_AT_ONCE):
            chunks = self._chunks[first : first + _PLACED_AT_ONCE]
            self._bytes.expect([(chunk.offset, _MAX_CHUNK_HEADER) for chunk in chunks])
            chunks = [self._placed(chunk) for chunk in chunks]
            self._bytes.expect([(chunk.record.end, _INDEX_HEAD_BYTES) for chunk in chunks if chunk.record])
            sizes += [chunk.size for chunk in chunks]
            selected += [
                (number * MAX_CHUNK_BYTES, chunk)
                for number, chunk in enumerate(chunks, start=first)
                if chunk.counts is None or not wanted.isdisjoint(chunk.counts) or self._is_doubtful(chunk)
            ]
        self._bounds.claim(sizes)
        if len(selected) < len(self._chunks):
            self._bytes.skips()
        return selected

    def _is_doubtful(self, chunk: _Chunk) -> bool:
        """Return whether the index after a chunk is damaged or contradicts the summary of the chunk."""
        try:
            self._index_of(chunk)
        except DamageError:
            return True
        return False

    def _placed(self, chunk: _Chunk) -> _Chunk:
        """Return a chunk with its record and the size of its records; no record and size 0 if it is damaged."""
        try:
            record = self._record(chunk.offset)
            size = record.data_bytes if record.codec == "none" else record.number(b"size")
        except DamageError:
            return chunk
        return replace(chunk, record=record, size=size)

    def read_indexed(self, found: Excerpt) -> tuple[Messages, Mask]:
        """Return the messages of an excerpt, and which of them agree with the chunk's index.

        Headers of messages differ only in connection and time: the first one is parsed, and the others are compared
        with it.
        """
        data, offset, entries = found.data, found.offset, found.entries
        unread = Messages(data, entries.channel, offset, offset, offset, entries.log_time_ns, entries.log_time_ns)
        if not len(offset):
            return unread, np.zeros(0, bool)
        available_bytes = entries.end - entries.offset
        length = int(gather_integers(data, offset[:1], "u4")[0])
        fits = available_bytes >= length + 8
        if not fits[0] or length > MAX_HEADER_BYTES:
            return unread, np.zeros(len(offset), bool)
        windows: Bytes = np.ndarray((len(data) - length - 7, length + 8), np.uint8, data, 0, (1, 1))
        heads = windows[np.where(fits, offset, offset[0])]
        conn_at, time_at = _find_message_fields(heads[0, 4 : length + 4].tobytes())
        if not conn_at or not time_at:
            return unread, np.zeros(len(offset), bool)
        varies = np.zeros(length + 8, bool)
        varies[conn_at : conn_at + 4] = varies[time_at : time_at + 8] = varies[length + 4 :] = True
        channel = heads[:, conn_at : conn_at + 4].copy().view("<u4")[:, 0].astype(np.int64)
        times = heads[:, time_at : time_at + 8].copy().view("<u4").astype(np.int64)
        stamp_ns = times[:, 0] * NS + times[:, 1]
        payload_bytes = heads[:, length + 4 :].copy().view("<u4")[:, 0].astype(np.int64)
        agrees: Mask = (
            fits
            & (channel == entries.channel)
            & (stamp_ns == entries.log_time_ns)
            & (length + 8 + payload_bytes <= available_bytes)
            & ((heads == heads[0]) | varies).all(axis=1)
        )
        return Messages(data, channel, offset, offset + (length + 8), payload_bytes, stamp_ns, stamp_ns), agrees

    def read_walked(self, chunk: _Chunk, data: memoryview, wanted: frozenset[int]) -> Messages:
        """Return the requested messages of a chunk from its records; missing ones are added to ``damage``."""
        return self._step_through(chunk, data).messages(data, wanted)

    def is_proved(self, chunk: _Chunk) -> bool:
        """Return whether the chunk has a checksum: only bz2 has one."""
        return chunk.record is not None and chunk.record.codec == "bz2"

    def needs_index(self, chunk: _Chunk) -> bool:
        """Return whether a damaged index counts as damage: every chunk should have an index."""
        return chunk.counts is not None and not chunk.cut

    def _step_through(self, chunk: _Chunk, data: memoryview) -> ChunkRecords:
        """Return the records of a chunk; record their damage and differences from the index."""
        walked = walk_chunk(data, self._bounds.most_records)
        self._bounds.walk(chunk.offset, walked.count)
        for connection in walked.connections if chunk.counts is None else ():
            self._take_connection(connection, data[connection.data_offset : connection.end])
        if walked.end < len(data) and not chunk.cut:
            self._note("record-damaged", chunk.offset, bytes_lost=len(data) - walked.end)
        if unknown := walked.offsets.keys() - self._connections.keys():
            lost = sum(len(walked.offsets[number]) for number in unknown)
            self._note("channel-undeclared", chunk.offset, messages_lost=lost)
        counts = {number: len(offsets) for number, offsets in walked.offsets.items()}
        if chunk.counts is not None and counts != chunk.counts:
            lost = max(sum(chunk.counts.values()) - sum(counts.values()), 0)
            self._note("chunk-index-damaged", chunk.offset, messages_lost=lost or None)
        return walked

    def read_indexes(self, chunks: list[_Chunk]) -> tuple[tuple[Ints, ...], Sequence[int]]:
        """Return the messages that index records after chunks list, and the numbers of chunks without a valid index."""
        entry_bytes: list[bytes] = []
        groups: list[tuple[int, int, int]] = []
        invalid = []
        records = [(chunk.offset, chunk.record) for chunk in chunks if chunk.record]
        starts = [(r.end if r.codec == "none" else offset, r.end) for offset, r in records]  # plain: indexes only
        self._bytes.expect([(start, end + _INDEX_HEAD_BYTES - start) for start, end in starts])
        for number, chunk in enumerate(chunks):
            try:
                index = self._index_of(chunk)
            except DamageError:
                invalid.append(number)
                continue
            entry_bytes += [entries for _, entries in index]
            groups += [(number, connection, len(entries) // _INDEX_ENTRY_BYTES) for connection, entries in index]
        chunk_number, connections, counts = np.array(groups, np.int64).reshape(-1, 3).T
        words = np.frombuffer(b"".join(entry_bytes), "<u4").reshape(-1, 3).astype(np.int64)
        stamps_ns = words[:, 0] * NS + words[:, 1]
        return (np.repeat(chunk_number, counts), np.repeat(connections, counts), words[:, 2], stamps_ns), invalid

    def _index_of(self, chunk: _Chunk) -> list[tuple[int, bytes]]:
        """Return each connection's entries in the index behind a chunk; `DamageError` if it is missing or damaged."""
        counts = chunk.counts
        if counts is None or chunk.cut or chunk.record is None:
            raise DamageError("chunk-index-damaged")
        index, position = [], chunk.record.end
        for _ in counts:
            record = self._record(position)
            if record.opcode != OP_INDEX or record.data_bytes % _INDEX_ENTRY_BYTES:
                raise DamageError("chunk-index-damaged")
            connection, start, size = (record.number(b"conn"), record.data_offset, record.data_bytes)
            index.append((connection, self._bytes.peek(start, size)))
            position = start + size
        if {connection: len(entries) // _INDEX_ENTRY_BYTES for connection, entries in index} != counts:
            raise DamageError("chunk-index-damaged")
        return index

    def find_plain_data(self, chunk: _Chunk) -> int | None:
        """Return the file offset of the records of an uncompressed chunk; None for a compressed one."""
        record = chunk.record
        if record is None or record.opcode != OP_CHUNK or record.codec != "none":
            return None
        self.is_unchecked = True
        return record.data_offset

    def load(self, chunk: _Chunk) -> memoryview:
        """Return the records of a chunk."""
        record = chunk.record or self._record(chunk.offset)
        codec = record.codec
        if codec != "bz2":
            self.is_unchecked = True
        size = record.number(b"size")
        if record.opcode != OP_CHUNK:
            raise DamageError("record-damaged")
        if chunk.cut:
            data = self._bytes.read(record.data_offset, self._bytes.size - record.data_offset)
            readable = data if codec == "none" else decompress_prefix(codec, data, size)
            self._note("file-cut", chunk.offset, bytes_lost=size - len(readable))
            return readable
        if record.end > self._bytes.size:
            raise DamageError("file-cut")
        data = self._bytes.read(record.data_offset, record.data_bytes)
        return data if codec == "none" else decompress(codec, data, size)

    def _read_index(self) -> None:
        """Read the connections and chunk summaries at the file's end; `DamageError` when they cannot be used."""
        header = self._record(len(MAGIC))
        if header.opcode != OP_HEADER:
            raise DamageError("index-damaged")
        position = header.number(b"index_pos")
        if not position or position > self._bytes.size:
            raise DamageError("index-missing")
        start, index_bytes = position, self._bytes.size - position
        self._bytes.expect([(start, min(index_bytes, _EXPECTED_BYTES))])
        while position < self._bytes.size:
            record = self._record(position)
            if record.opcode == OP_CONNECTION:
                self._take_connection(record, self._bytes.read(record.data_offset, record.data_bytes))
            elif record.opcode == OP_CHUNK_INFO:
                self._take_chunk_info(record)
            else:
                raise DamageError("index-damaged")
            position = record.end
        if (len(self._connections), len(self._chunks)) != (header.number(b"conn_count"), header.number(b"chunk_count")):
            raise DamageError("index-damaged")
        if len({chunk.offset for chunk in self._chunks}) < len(self._chunks):
            raise DamageError("index-damaged")
        self._chunks.sort(key=lambda chunk: chunk.offset)
        self.outline = outline_of(self._bytes.size, self._bytes.read(start, index_bytes)) if self._chunks else ""

    def _take_chunk_info(self, record: BagRecord) -> None:
        """Add a chunk by its summary record, and its messages to the counts of their connections."""
        data = self._bytes.read(record.data_offset, record.data_bytes)
        counts = dict(struct.iter_unpack("<II", data[: len(data) // 8 * 8]))
        if len(data) != 8 * len(counts) or len(counts) != record.number(b"count"):
            raise DamageError("index-damaged")
        chunk = _Chunk(
            record.number(b"chunk_pos"),
            stamp_ns(record.fields, b"start_time"),
            stamp_ns(record.fields, b"end_time"),
            counts,
        )
        if chunk.offset >= self._bytes.size or not counts.keys() <= self._connections.keys():
            raise DamageError("index-damaged")
        self._chunks.append(chunk)
        self._bounds.count(len(self._chunks), 0)
        for connection, count in counts.items():
            self._tally(connection, count, chunk.start_ns, chunk.end_ns)

    def _take_connection(self, record: BagRecord, data: memoryview | bytes) -> None:
        described = parse_header_fields(data)
        topic = record.fields.get(b"topic", described.get(b"topic", b""))
        self._bounds.count(len(self._chunks), len(self._connections))
        self._connections.setdefault(
            record.number(b"conn"),
            _Connection(
                topic.decode(errors="backslashreplace"),
                normalize_type_name(described.get(b"type", b"").decode(errors="backslashreplace")),
                described.get(b"message_definition", b"").decode(errors="replace"),
            ),
        )

    def _walk(self) -> None:
        """Read record after record; after an invalid one, continue at the next chunk."""
        position = len(MAGIC)
        while position + 8 <= self._bytes.size:
            try:
                position = self._take_record(position)
            except DamageError as error:
                after = self._next_chunk(position + 1)
                self._note(error.cause, position, bytes_lost=after - position, reason=error.reason)
                position = after

    def _take_record(self, position: int) -> int:
        """Read the record at ``position``; return the position of the next one."""
        record = self._record(position)
        if record.opcode == OP_CHUNK:
            self._walk_chunk(position, record)
        elif record.end > self._bytes.size:
            raise DamageError("file-cut")
        elif record.opcode == OP_CONNECTION:
            self._take_connection(record, self._bytes.read(record.data_offset, record.data_bytes))
        elif record.opcode not in (OP_HEADER, OP_INDEX, OP_CHUNK_INFO):
            raise DamageError("record-damaged")
        return record.end

    def _walk_chunk(self, position: int, record: BagRecord) -> None:
        """Read the connections and message counts of a chunk."""
        cut = record.end > self._bytes.size
        if cut and self._next_chunk(position + 1) < self._bytes.size:
            raise DamageError("record-damaged")
        chunk = _Chunk(position, cut=cut)
        try:
            data = self.load(chunk)
        except DamageError as error:
            self.note_lost(chunk, error)
            return
        found = self._step_through(chunk, data)
        self._chunks.append(chunk)
        self._bounds.count(len(self._chunks), 0)
        for number in found.offsets.keys() & self._connections.keys():
            stamps_ns = found.stamps[number]
            self._tally(number, len(stamps_ns), min(stamps_ns), max(stamps_ns))

    def _next_chunk(self, start: int) -> int:
        """Return the offset of the next chunk's record, found by the mark in its header; the file's size without one."""
        for block_start, _, piece in self._bytes.windows(start, self._bytes.size, _MAX_CHUNK_HEADER):
            block = bytes(piece)
            mark = block.find(_CHUNK_MARK)
            while mark >= 0:
                chunk_offset = self._chunk_of_mark(block_start + mark, start)
                if chunk_offset is not None:
                    return chunk_offset
                mark = block.find(_CHUNK_MARK, mark + 1)
        return self._bytes.size

    def _chunk_of_mark(self, mark: int, start: int) -> int | None:
        """Return the offset, from ``start`` on, of the chunk whose header has the mark at ``mark``; None without one."""
        first = max(mark - _MAX_CHUNK_HEADER, start)
        try:
            before = bytes(self._bytes.read(first, mark - first))
        except DamageError:
            return None
        high = before.find(bytes(3), 1)  # a header's length is one byte and three zeros
        while high > 0:
            length, distance = before[high - 1], len(before) - high + 1
            if distance <= length + 4 - len(_CHUNK_MARK) and self._is_chunk(first + high - 1):
                return first + high - 1
            high = before.find(bytes(3), high + 1)
        return None

    def _is_chunk(self, position: int) -> bool:
        """Return whether a valid record of a chunk begins at a position."""
        try:
            length = int.from_bytes(self._bytes.peek(position, 4), "little")
            if not 0 < length <= _MAX_CHUNK_HEADER:
                return False
            record = self._record(position)
            return record.opcode == OP_CHUNK and b"compression" in record.fields and record.number(b"size") > 0
        except DamageError:
            return False

    def _record(self, position: int) -> BagRecord:
        """Read the header of the record at a position; `DamageError` if it is invalid or truncated."""
        head = self._bytes.peek(position, 4)
        length = int.from_bytes(head, "little")
        if len(head) < 4 or length > MAX_HEADER_BYTES:
            raise DamageError("record-damaged")
        header = self._bytes.peek(position + 4, length + 4)
        if len(header) < length + 4:
            raise DamageError("file-cut")
        return BagRecord(
            parse_header_fields(header[:length]), position + 8 + length, int.from_bytes(header[length:], "little")
        )

    def _tally(self, connection: int, count: int, start_ns: int, end_ns: int) -> None:
        tally = self._connections[connection]
        tally.count += count
        tally.starts.append(start_ns)
        tally.ends.append(end_ns)

    def note_lost(self, chunk: _Chunk, error: DamageError) -> None:
        """Record the loss of a whole chunk, with the number of messages in the bag's index."""
        lost = sum(chunk.counts.values()) if chunk.counts else None
        self._note(error.cause, chunk.offset, messages_lost=lost, reason=error.reason)


def _make_topic(connection: _Connection) -> Topic:
    return Topic(
        connection.topic,
        connection.type_name,
        connection.count,
        min(connection.starts, default=None),
        max(connection.ends, default=None),
        "ros1",
        connection.definition,
        silent_ns=compute_dropouts_ns(list(zip(connection.starts, connection.ends, strict=True)), connection.count),
        schema_encoding="ros1msg",
    )
