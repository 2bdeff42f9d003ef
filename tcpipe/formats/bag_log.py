"""ROS 1 bags, version 2.0 (http://wiki.ros.org/Bags/Format/2.0): by their index, or record by record where it is missing or broken.

A record is a header (fields ``name=value``) and data, each after its length (uint32). Chunks hold connections and messages; after a
chunk stands an index record for each of its connections; the file ends with all connections and a summary of every chunk.
A bag carries no checksum of its own: bz2 has one, lz4 and plain chunks have none.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.log_part import (
    MAX_CHUNK_BYTES,
    ByteSource,
    Channel,
    DamageError,
    Int64Array,
    MessageBlock,
    blocks_by_channel,
    decompressed,
    decompressed_prefix,
    gathered,
    in_order,
    search_windows,
)
from tcpipe.logs.topics import Damage, normalized_type_name

MAGIC = b"#ROSBAG V2.0\n"

_OP_MESSAGE, _OP_HEADER, _OP_INDEX, _OP_CHUNK, _OP_CHUNK_INFO, _OP_CONNECTION = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
_MAX_HEADER_BYTES = 1 << 16
_CHUNK_MARK = b"\x04\0\0\0op=\x05"
_MAX_CHUNK_HEADER = 128
_NS = 1_000_000_000
_TIME = struct.Struct("<II")

_Messages = tuple[Int64Array, Int64Array, Int64Array]
"""Connection, offset and log time of messages, shape (N,) each; each connection's lie in one piece."""


@dataclass(frozen=True, slots=True)
class _Record:
    """A record: its header fields, and where its data lies."""

    fields: dict[bytes, bytes]
    data_offset: int
    data_bytes: int

    @property
    def opcode(self) -> int:
        return self.fields.get(b"op", b"\0")[0]

    @property
    def end(self) -> int:
        return self.data_offset + self.data_bytes

    def number(self, name: bytes) -> int:
        """Return a little-endian integer field; `DamageError` where it is missing."""
        if name not in self.fields:
            raise DamageError(f"a record lacks the field {name.decode()!r}")
        return int.from_bytes(self.fields[name], "little")


@dataclass(slots=True)
class _Chunk:
    """A chunk, and how many messages of each connection it holds; ``counts`` is None where only its records can tell."""

    offset: int
    start_ns: int = 0
    end_ns: int = 0
    counts: dict[int, int] | None = None
    cut: bool = False


@dataclass(slots=True)
class _Connection:
    topic: str
    type_name: str
    definition: str
    count: int = 0
    starts: list[int] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)


class BagPart:
    """One .bag file, open for reading."""

    def __init__(self, path: Path, name: str) -> None:
        self.name = name
        self.damage: dict[Damage, None] = {}
        self._bytes = ByteSource(path)
        self._connections: dict[int, _Connection] = {}
        self._chunks: list[_Chunk] = []
        self._without_checksum = False
        self._index_heads: dict[int, tuple[int, int, int, bytes]] = {}
        try:
            self._read_index()
        except DamageError as error:
            self._note(self._bytes.size, f"{error}; it is read record by record")
            self._connections, self._chunks = {}, []
            self._walk()
        self.channels = {number: _channel(self._connections[number]) for number in sorted(self._connections)}

    def close(self) -> None:
        """Close the file."""
        self._bytes.close()

    @property
    def unchecked(self) -> str:
        """What was read that no checksum covers."""
        return "chunks of a .bag carry no checksum, unless they are bz2" if self._without_checksum else ""

    def blocks(self, wanted: frozenset[int], *, threads: int = 1) -> Iterator[MessageBlock]:
        """Yield the messages of the wanted connections, chunk by chunk."""
        if any(chunk.counts is not None and wanted.isdisjoint(chunk.counts) for chunk in self._chunks):
            self._bytes.skips()

        def read(piece: tuple[int, _Chunk]) -> tuple[_Chunk, list[MessageBlock], DamageError | None]:
            index, chunk = piece
            try:
                return chunk, self._chunk_blocks(chunk, wanted, index * MAX_CHUNK_BYTES), None
            except DamageError as error:
                return chunk, [], error

        pieces = (
            (index, chunk)
            for index, chunk in enumerate(self._chunks)
            if chunk.counts is None or not wanted.isdisjoint(chunk.counts)
        )
        for chunk, blocks, error in in_order(read, pieces, threads=threads):
            if error:
                self._note_lost(chunk, str(error))
            yield from blocks

    def _chunk_blocks(self, chunk: _Chunk, wanted: frozenset[int], base: int) -> list[MessageBlock]:
        record = self._record(chunk.offset)
        if record.fields.get(b"compression") != b"bz2":
            self._without_checksum = True
        index = self._index_of(chunk, record)
        data = self._load(chunk, record, _pieces(record, index, wanted))
        connections, offsets, stamps = _messages(data, chunk, index, wanted)
        if not len(offsets):
            return []
        payloads = offsets + 8 + gathered(data, offsets, "u4")
        lengths = gathered(data, payloads - 4, "u4")
        return blocks_by_channel(
            data,
            connections,
            payloads,
            lengths,
            log_time_ns=stamps,
            publish_time_ns=stamps,
            ordinals=base + offsets,
        )

    def _index_of(self, chunk: _Chunk, record: _Record) -> dict[int, tuple[Int64Array, Int64Array]]:
        """Return offset and log time of each connection's messages by the index records behind a chunk; nothing where they are broken."""
        found: dict[int, tuple[Int64Array, Int64Array]] = {}
        if chunk.counts is None or chunk.cut:
            return found
        position = record.end
        try:
            for _ in chunk.counts:
                connection, start, size = self._index_record(position)
                entries = np.frombuffer(self._bytes.peek(start, size), "<u4").reshape(-1, 3)
                stamps = entries[:, 0].astype(np.int64) * _NS + entries[:, 1]
                offsets = entries[:, 2].astype(np.int64)
                if (offsets[1:] < offsets[:-1]).any():
                    order = np.argsort(offsets, kind="stable")
                    offsets, stamps = offsets[order], stamps[order]
                found[connection] = offsets, stamps
                position = start + size
        except DamageError:
            return {}
        return found

    def _index_record(self, position: int) -> tuple[int, int, int]:
        """Return the connection of an index record, and offset and size of its entries.

        Their headers differ in connection and count only, so that most need no parsing.
        """
        length = int.from_bytes(self._bytes.peek(position, 4), "little")
        if length in self._index_heads:
            connection_at, low, high, rest = self._index_heads[length]
            header = self._bytes.peek(position + 4, length + 4)
            size = int.from_bytes(header[length:], "little")
            if header[:low] + header[low + 4 : high] + header[high + 4 : length] == rest and size % 12 == 0:
                connection = int.from_bytes(header[connection_at : connection_at + 4], "little")
                return connection, position + 8 + length, size
        record = self._record(position)
        if record.opcode != _OP_INDEX or record.data_bytes % 12:
            raise DamageError("an index record is not where it should be")
        if len(record.fields.get(b"conn", b"")) == len(record.fields.get(b"count", b"")) == 4:
            header = self._bytes.peek(position + 4, length)
            low, high = sorted(places := (header.find(b"conn=") + 5, header.find(b"count=") + 6))
            self._index_heads[length] = places[0], low, high, header[:low] + header[low + 4 : high] + header[high + 4 :]
        return record.number(b"conn"), record.data_offset, record.data_bytes

    def _load(self, chunk: _Chunk, record: _Record, pieces: tuple[Int64Array, Int64Array] | None = None) -> memoryview:
        """Return the records of a chunk; of one that the file's end cuts, what can still be had.

        Of a plain one hardly more than ``pieces`` (starts, ends) is read from the disk.
        """
        codec = record.fields.get(b"compression", b"").decode(errors="replace")
        size = record.number(b"size")
        if record.opcode != _OP_CHUNK:
            raise DamageError("no chunk is where the index says")
        if chunk.cut:
            data = self._bytes.read(record.data_offset, self._bytes.size - record.data_offset)
            kept = data if codec == "none" else decompressed_prefix(codec, data, size)
            what = f"the file ends inside a chunk; {len(kept)} bytes of it are read, unchecked"
            self._note(chunk.offset, what, bytes_lost=size - len(kept))
            return kept
        if codec == "none":
            size = self._bytes_within(record)
            return self._bytes.mapped(record.data_offset, size, pieces)
        return decompressed(codec, self._bytes.read_once(record.data_offset, record.data_bytes), size)

    def _bytes_within(self, record: _Record) -> int:
        if record.end > self._bytes.size:
            raise DamageError("it runs past the file's end")
        return record.data_bytes

    def _read_index(self) -> None:
        """Read the connections and chunk summaries at the file's end; `DamageError` when they cannot be used."""
        header = self._record(len(MAGIC))
        if header.opcode != _OP_HEADER:
            raise DamageError("the bag's header record is missing")
        position = header.number(b"index_pos")
        if not position:
            raise DamageError("the bag has no index (it was not closed)")
        if position > self._bytes.size:
            raise DamageError("the bag's index is missing (the file is cut)")
        while position < self._bytes.size:
            record = self._record(position)
            if record.opcode == _OP_CONNECTION:
                self._take_connection(record, self._bytes.read(record.data_offset, record.data_bytes))
            elif record.opcode == _OP_CHUNK_INFO:
                self._take_chunk_info(record)
            else:
                raise DamageError(f"the bag's index holds a record of opcode {record.opcode}")
            position = record.end
        if (len(self._connections), len(self._chunks)) != (header.number(b"conn_count"), header.number(b"chunk_count")):
            raise DamageError("the bag's index does not hold what its header counts")
        self._chunks.sort(key=lambda chunk: chunk.offset)

    def _take_chunk_info(self, record: _Record) -> None:
        data = self._bytes.read(record.data_offset, record.data_bytes)
        counts = dict(struct.iter_unpack("<II", data[: len(data) // 8 * 8]))
        chunk = _Chunk(
            record.number(b"chunk_pos"),
            _stamp(record.fields, b"start_time"),
            _stamp(record.fields, b"end_time"),
            counts,
        )
        if chunk.offset >= self._bytes.size or not counts.keys() <= self._connections.keys():
            raise DamageError("the bag's index points outside the file")
        self._chunks.append(chunk)
        for connection, count in counts.items():
            self._tally(connection, count, chunk.start_ns, chunk.end_ns)

    def _take_connection(self, record: _Record, data: memoryview | bytes) -> None:
        described = _header_fields(data)
        topic = record.fields.get(b"topic", described.get(b"topic", b""))
        self._connections.setdefault(
            record.number(b"conn"),
            _Connection(
                topic.decode(errors="backslashreplace"),
                normalized_type_name(described.get(b"type", b"").decode(errors="backslashreplace")),
                described.get(b"message_definition", b"").decode(errors="replace"),
            ),
        )

    def _walk(self) -> None:
        """Step from record to record; after one that cannot be, search for the next chunk."""
        position = len(MAGIC)
        while position + 8 <= self._bytes.size:
            try:
                position = self._take_record(position)
            except DamageError as error:
                after = self._next_chunk(position + 1)
                self._note(position, str(error), bytes_lost=after - position)
                position = after

    def _take_record(self, position: int) -> int:
        """Note what the record at ``position`` holds; return where the next begins."""
        record = self._record(position)
        if record.opcode == _OP_CHUNK:
            self._walk_chunk(position, record)
        elif record.end > self._bytes.size:
            raise DamageError("the file ends inside a record")
        elif record.opcode == _OP_CONNECTION:
            self._take_connection(record, self._bytes.read(record.data_offset, record.data_bytes))
        elif record.opcode not in (_OP_HEADER, _OP_INDEX, _OP_CHUNK_INFO):
            raise DamageError(f"no record begins with opcode {record.opcode}")
        return record.end

    def _walk_chunk(self, position: int, record: _Record) -> None:
        """Load a chunk for its connections and counts."""
        cut = record.end > self._bytes.size
        if cut and self._next_chunk(position + 1) < self._bytes.size:
            raise DamageError("the head of a chunk contradicts what follows")
        chunk = _Chunk(position, cut=cut)
        try:
            data = self._load(chunk, record)
        except DamageError as error:
            self._note_lost(chunk, str(error))
            return
        found = _walk_chunk(data)
        for connection in found.connections:
            self._take_connection(connection, data[connection.data_offset : connection.end])
        self._chunks.append(chunk)
        for number in found.offsets:
            if number in self._connections:
                _, stamps = found.messages(number)
                self._tally(number, len(stamps), int(stamps.min()), int(stamps.max()))
            else:
                lost = len(found.offsets[number])
                self._note(position, f"messages of connection {number}, which nothing declares", messages_lost=lost)

    def _next_chunk(self, start: int) -> int:
        """Return where the next chunk's record begins: the mark of one, inside a header that parses."""
        for block_start, _, read_bytes in search_windows(start, self._bytes.size, _MAX_CHUNK_HEADER):
            block = bytes(self._bytes.read(block_start, read_bytes))
            mark = block.find(_CHUNK_MARK)
            while mark >= 0:
                first = max(block_start + mark - _MAX_CHUNK_HEADER, start)
                before = bytes(self._bytes.read(first, block_start + mark - first))
                high = before.find(bytes(3), 1)  # a header's length is one byte and three zeros
                while high > 0:
                    length, distance = before[high - 1], len(before) - high + 1
                    if distance <= length + 4 - len(_CHUNK_MARK) and self._is_chunk(first + high - 1):
                        return first + high - 1
                    high = before.find(bytes(3), high + 1)
                mark = block.find(_CHUNK_MARK, mark + 1)
        return self._bytes.size

    def _is_chunk(self, position: int) -> bool:
        length = int.from_bytes(self._bytes.peek(position, 4), "little")
        if not 0 < length <= _MAX_CHUNK_HEADER:
            return False
        try:
            record = self._record(position)
            return record.opcode == _OP_CHUNK and b"compression" in record.fields and record.number(b"size") > 0
        except DamageError:
            return False

    def _record(self, position: int) -> _Record:
        head = self._bytes.peek(position, 4)
        length = int.from_bytes(head, "little")
        if len(head) < 4 or length > _MAX_HEADER_BYTES:
            raise DamageError("no record begins here")
        header = self._bytes.peek(position + 4, length + 4)
        if len(header) < length + 4:
            raise DamageError("the file ends inside a record")
        return _Record(
            _header_fields(header[:length]), position + 8 + length, int.from_bytes(header[length:], "little")
        )

    def _tally(self, connection: int, count: int, start_ns: int, end_ns: int) -> None:
        tally = self._connections[connection]
        tally.count += count
        tally.starts.append(start_ns)
        tally.ends.append(end_ns)

    def _note(self, offset: int, what: str, *, messages_lost: int | None = None, bytes_lost: int | None = None) -> None:
        where = f"{self.name}, byte {offset}"
        self.damage[Damage(where, what, messages_lost=messages_lost, bytes_lost=bytes_lost)] = None

    def _note_lost(self, chunk: _Chunk, what: str) -> None:
        self.damage[
            Damage(
                f"{self.name}, byte {chunk.offset}",
                f"a chunk is lost: {what}",
                messages_lost=sum(chunk.counts.values()) if chunk.counts else None,
                start_ns=chunk.start_ns or None,
                end_ns=chunk.end_ns or None,
            )
        ] = None


@dataclass(slots=True)
class _ChunkRecords:
    """What a walk through a chunk met: connections, and each connection's messages."""

    connections: list[_Record] = field(default_factory=list)
    offsets: dict[int, list[int]] = field(default_factory=dict)
    stamps: dict[int, list[int]] = field(default_factory=dict)

    def messages(self, connection: int) -> tuple[Int64Array, Int64Array]:
        """Return a connection's message offsets and log times."""
        return np.array(self.offsets[connection], np.int64), np.array(self.stamps[connection], np.int64)


def _walk_chunk(data: memoryview) -> _ChunkRecords:
    """Step through the records of a chunk; one that does not fit ends the walk.

    A message's header differs from the one before it in connection and time only, so that most need no parsing.
    """
    found, position, size = _ChunkRecords(), 0, len(data)
    length_at = struct.Struct("<I").unpack_from
    known: dict[bytes, int] = {}
    time_at = 0
    while position + 8 <= size:
        header_end = position + 4 + length_at(data, position)[0]
        if header_end + 4 > size:
            break
        end = header_end + 4 + length_at(data, header_end)[0]
        if end > size:
            break
        header = bytes(data[position + 4 : header_end])
        connection = known.get(header[:time_at] + header[time_at + 8 :])
        if connection is None:
            try:
                record = _Record(_header_fields(header), header_end + 4, end - header_end - 4)
                if record.opcode == _OP_CONNECTION:
                    found.connections.append(record)
                elif record.opcode == _OP_MESSAGE:
                    connection = record.number(b"conn")
                    _stamp(record.fields, b"time")
                    time_at = header.find(b"time=") + 5
                    known[header[:time_at] + header[time_at + 8 :]] = connection
            except DamageError:
                break
        if connection is not None:
            seconds, nanoseconds = _TIME.unpack_from(header, time_at)
            found.offsets.setdefault(connection, []).append(position)
            found.stamps.setdefault(connection, []).append(seconds * _NS + nanoseconds)
        position = end
    return found


def _header_fields(header: bytes | memoryview) -> dict[bytes, bytes]:
    header = bytes(header)
    fields, position = {}, 0
    while position < len(header):
        end = position + 4 + int.from_bytes(header[position : position + 4], "little")
        name, equals, value = header[position + 4 : end].partition(b"=")
        if end > len(header) or not equals:
            raise DamageError("a record's header is broken")
        fields[name] = value
        position = end
    return fields


def _stamp(fields: dict[bytes, bytes], name: bytes) -> int:
    """Return a time field in nanoseconds."""
    value = fields.get(name, b"")
    if len(value) != 8:
        raise DamageError(f"a record lacks the time {name.decode()!r}")
    seconds, nanoseconds = _TIME.unpack(value)
    return seconds * _NS + nanoseconds  # type: ignore[no-any-return]


def _channel(connection: _Connection) -> Channel:
    return Channel(
        connection.topic,
        connection.type_name,
        "ros1",
        "ros1msg",
        connection.definition,
        connection.count,
        min(connection.starts, default=None),
        max(connection.ends, default=None),
    )


def _messages(
    data: memoryview, chunk: _Chunk, index: dict[int, tuple[Int64Array, Int64Array]], wanted: frozenset[int]
) -> _Messages:
    """Return the wanted messages by connection, by the index where the chunk's records bear it out."""
    counts = {connection: count for connection, count in (chunk.counts or {}).items() if connection in wanted}
    indexed = {connection: entries for connection, entries in index.items() if connection in wanted}
    if index and counts == {connection: len(offsets) for connection, (offsets, _) in indexed.items()}:
        messages = _joined(indexed)
        if _borne_out(data, *messages):
            return messages
    found = _walk_chunk(data)
    return _joined({connection: found.messages(connection) for connection in wanted & found.offsets.keys()})


def _pieces(
    record: _Record, index: dict[int, tuple[Int64Array, Int64Array]], wanted: frozenset[int]
) -> tuple[Int64Array, Int64Array] | None:
    """Return where in a chunk the wanted messages begin and end; None where they are all of it, or that is not known."""
    if not index or index.keys() <= wanted or record.fields.get(b"compression") != b"none":
        return None
    connections, offsets, _ = _joined(index)
    order = np.argsort(offsets)
    offsets, chosen = np.clip(offsets[order], 0, record.data_bytes), np.isin(connections[order], sorted(wanted))
    return offsets[chosen], np.append(offsets[1:], record.data_bytes)[chosen]


def _joined(by_connection: Mapping[int, tuple[Int64Array, Int64Array]]) -> _Messages:
    """Return messages of several connections, one connection after the other."""
    found = sorted(by_connection.items())
    none = np.zeros(0, np.int64)
    connections = np.repeat(np.array([number for number, _ in found], np.int64), [len(of) for _, (of, _) in found])
    offsets, stamps = (np.concatenate([none, *(of[kind] for _, of in found)]) for kind in (0, 1))
    return connections, offsets, stamps


def _borne_out(data: memoryview, connections: Int64Array, offsets: Int64Array, stamps: Int64Array) -> bool:
    """Return whether a message of the connection with that log time lies at each offset, whole.

    Headers of messages agree but for connection and time, so the first is parsed and the others compared to it.
    """
    size = len(data)
    if not len(offsets):
        return True
    if offsets.min() < 0 or offsets.max() > size - 8:
        return False
    length = int(gathered(data, offsets[:1], "u4")[0])
    if length > _MAX_HEADER_BYTES or offsets.max() + length + 8 > size:
        return False
    windows: NDArray[np.uint8] = np.ndarray((size - length - 7, length + 8), np.uint8, data, 0, (1, 1))
    heads = windows[offsets]
    header = heads[0, 4 : length + 4].tobytes()
    try:
        fields = _header_fields(header)
    except DamageError:
        return False
    if fields.get(b"op") != bytes([_OP_MESSAGE]) or (len(fields.get(b"conn", b"")), len(fields.get(b"time", b""))) != (
        4,
        8,
    ):
        return False
    varies = np.zeros(length + 8, np.bool_)
    conn_at, time_at = 4 + header.find(b"conn=") + 5, 4 + header.find(b"time=") + 5
    varies[conn_at : conn_at + 4] = varies[time_at : time_at + 8] = varies[length + 4 :] = True
    numbers = heads[:, conn_at : conn_at + 4].copy().view("<u4")[:, 0]
    times = heads[:, time_at : time_at + 8].copy().view("<u4").astype(np.int64)
    payload_bytes = heads[:, length + 4 :].copy().view("<u4")[:, 0]
    return bool(
        (numbers == connections).all()
        and (times[:, 0] * _NS + times[:, 1] == stamps).all()
        and (offsets + length + 8 + payload_bytes <= size).all()
        and ((heads == heads[0]) | varies).all()
    )
