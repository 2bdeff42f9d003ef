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

from tcpipe.errors import LogError
from tcpipe.formats.logs.chunk_runs import (
    MAX_PLANNED_BYTES,
    Entries,
    Run,
    by_place,
    copy_pieces,
    excerpt,
    groups,
    runs,
)
from tcpipe.formats.logs.log_part import (
    MAX_CHUNK_BYTES,
    Bounds,
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
    listed,
)
from tcpipe.logs.topics import Damage, normalized_type_name

MAGIC = b"#ROSBAG V2.0\n"

_OP_MESSAGE, _OP_HEADER, _OP_INDEX, _OP_CHUNK, _OP_CHUNK_INFO, _OP_CONNECTION = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
_MAX_HEADER_BYTES = 1 << 16
_CHUNK_MARK = b"\x04\0\0\0op=\x05"
_MAX_CHUNK_HEADER = 128
_NS = 1_000_000_000
_TIME = struct.Struct("<II")
_INDEX_ENTRY_BYTES = 12
_INDEX_HEAD_BYTES = 64
"""As much as an index record's header takes as a rule, and the length behind it."""
_LEAST_RECORD_BYTES = 8

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


@dataclass(frozen=True, slots=True)
class _PlacedChunk:
    """A chunk to read, the number of the bytes before it, its record (None where that is broken), and how much it holds [byte]."""

    chunk: _Chunk
    base: int
    record: _Record | None
    size: int


class _ChunkRun:
    """A run of chunks to read: its plan, and the chunks of its group."""

    def __init__(self, plan: Run, members: list[_PlacedChunk]) -> None:
        self.plan, self.members = plan, members
        self.bases = np.array([member.base for member in members], np.int64)


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
        self._bounds = Bounds(path, self._bytes.size)
        try:
            self._read_index_or_walk()
        except LogError:
            self.close()
            raise
        self.channels = {number: _channel(self._connections[number]) for number in sorted(self._connections)}

    def _read_index_or_walk(self) -> None:
        try:
            self._read_index()
        except DamageError as error:
            self._note(self._bytes.size, f"{error}; it is read record by record")
            self._connections, self._chunks = {}, []
            self._walk()
        self._bounds.claim(self._chunk_record(chunk)[1] for chunk in self._chunks)

    def close(self) -> None:
        """Close the file."""
        self._bytes.close()

    @property
    def unchecked(self) -> str:
        """What was read that no checksum covers."""
        return "chunks of a .bag carry no checksum, unless they are bz2" if self._without_checksum else ""

    def blocks(self, wanted: frozenset[int], *, threads: int = 1) -> Iterator[MessageBlock]:
        """Yield the messages of the wanted connections, chunk by chunk, or some chunks at once where little of them is wanted."""
        if any(chunk.counts is not None and wanted.isdisjoint(chunk.counts) for chunk in self._chunks):
            self._bytes.skips()

        def read(run: _ChunkRun) -> tuple[list[MessageBlock], list[Damage]]:
            noted: list[Damage] = []
            return list(self._run_blocks(run, wanted, noted)), noted

        for blocks, noted in in_order(read, self._runs(wanted), threads=threads):
            self.damage.update(dict.fromkeys(noted))
            yield from blocks

    def _runs(self, wanted: frozenset[int]) -> Iterator[_ChunkRun]:
        """Yield what to read at once; the indexes of some chunks are read ahead."""
        chunks = [
            _PlacedChunk(chunk, index * MAX_CHUNK_BYTES, record, size)
            for index, chunk in enumerate(self._chunks)
            for record, size in [self._chunk_record(chunk)]
            if chunk.counts is None or not wanted.isdisjoint(chunk.counts) or self._is_doubtful(chunk, record)
        ]
        for group in groups(chunk.size for chunk in chunks):
            members = chunks[group.start : group.stop]
            sizes = np.array([min(chunk.size, MAX_PLANNED_BYTES) for chunk in members], np.int64)
            entries, sound = self._entries(members, sizes)
            for run in runs(entries, sizes, sound, sorted(wanted)):
                yield _ChunkRun(run, members)

    def _is_doubtful(self, chunk: _Chunk, record: _Record | None) -> bool:
        """Return whether the index behind a chunk that should hold nothing wanted is another than the summary says."""
        try:
            self._index_of(_PlacedChunk(chunk, 0, record, 0))
        except DamageError:
            return True
        return False

    def _chunk_record(self, chunk: _Chunk) -> tuple[_Record | None, int]:
        """Return a chunk's record and how many bytes its records take; None and 0 where it is broken."""
        try:
            record = self._record(chunk.offset)
            return record, record.data_bytes if _codec(record) == "none" else record.number(b"size")
        except DamageError:
            return None, 0

    def _run_blocks(self, run: _ChunkRun, wanted: frozenset[int], noted: list[Damage]) -> Iterator[MessageBlock]:
        """Yield the wanted messages of a run; what is lost or contradicts itself is added to ``noted``."""
        doubtful = list(run.plan.chunks)
        if run.plan.entries is not None:
            found = excerpt(
                run.plan,
                run.plan.entries,
                load=lambda number: self._load(run.members[number].chunk, run.members[number].record),
                copy=lambda number, places, to: self._copy(run.members[number], places, to),
            )
            noted += [self._lost(run.members[number].chunk, str(error)) for number, error in found.lost]
            true = _borne_out(found.data, found.offset, found.entries)
            doubtful = np.unique(found.entries.chunk[~true]).tolist()
            if doubtful:
                found = found.without(doubtful)
            of = found.entries
            yield from _blocks(found.data, of.channel, found.offset, of.log_time_ns, run.bases[of.chunk] + of.offset)
        for number in doubtful:
            member = run.members[number]
            try:
                data = self._load(member.chunk, member.record)
            except DamageError as error:
                noted.append(self._lost(member.chunk, str(error)))
            else:
                walked = self._walked(member.chunk, data)
                by_connection = {number: walked.messages(number) for number in wanted & walked.offsets.keys()}
                connections, offsets, stamps = _joined(by_connection)
                noted += self._contradictions(member.chunk, walked, len(data))
                entries = None if run.plan.entries is None else run.plan.entries.of_chunk(number)
                noted += self._disagreement(member, (offsets, connections, stamps), entries)
                yield from _blocks(data, connections, offsets, stamps, member.base + offsets)

    def _walked(self, chunk: _Chunk, data: memoryview) -> _ChunkRecords:
        """Step through the records of a chunk."""
        walked = _walk_chunk(data, self._bounds.most_records)
        self._bounds.walk(chunk.offset, walked.count)
        return walked

    def _contradictions(self, chunk: _Chunk, walked: _ChunkRecords, size: int) -> list[Damage]:
        """Return what is wrong with a chunk of ``size`` bytes of which each record was looked at."""
        found, where = [], f"{self.name}, byte {chunk.offset}"
        if walked.end < size and not chunk.cut:
            found.append(Damage(where, "the records of a chunk end before it does", bytes_lost=size - walked.end))
        if unknown := sorted(walked.offsets.keys() - self._connections.keys()):
            lost = sum(len(walked.offsets[number]) for number in unknown)
            what = f"messages of {listed('connection', unknown)}, which nothing declares"
            found.append(Damage(where, what, messages_lost=lost))
        counts = {number: len(offsets) for number, offsets in walked.offsets.items()}
        if chunk.counts is not None and counts != chunk.counts:
            lost = max(sum(chunk.counts.values()) - sum(counts.values()), 0)
            what = "the bag's index counts other messages than a chunk holds, which are read"
            found.append(Damage(where, what, messages_lost=lost or None))
        return found

    def _disagreement(self, member: _PlacedChunk, messages: _Messages, entries: Entries | None) -> list[Damage]:
        """Return what to say where the index behind a chunk is broken, or names other messages; bz2 proves that the chunk is right."""
        chunk = member.chunk
        if entries is None and (chunk.counts is None or chunk.cut or member.size > MAX_PLANNED_BYTES):
            return []
        what, lost = "the index of a chunk is broken; its messages are read without it", 0
        if entries is not None:
            offsets, connections, stamps = messages
            order = np.argsort(offsets)
            mine = np.stack([offsets[order], connections[order], stamps[order]])
            if np.array_equal(mine, np.stack([entries.offset, entries.channel, entries.log_time_ns])):
                return []
            what = "the index of a chunk names other messages than the chunk holds, which are read"
            lost = max(len(entries.offset) - len(offsets), 0)
        right = member.record is not None and _codec(member.record) == "bz2"
        return [Damage(f"{self.name}, byte {chunk.offset}", what, messages_lost=0 if right else lost or None)]

    def _entries(self, members: list[_PlacedChunk], sizes: Int64Array) -> tuple[Entries, NDArray[np.bool_]]:
        """Return the messages of several chunks by the index records behind them, and of which chunks these are sound."""
        held: list[bytes] = []
        places: list[tuple[int, int, int]] = []
        unsound = []
        for number, member in enumerate(members):
            try:
                found = self._index_of(member)
            except DamageError:
                unsound.append(number)
                continue
            held += [entries for _, entries in found]
            places += [(number, connection, len(entries) // _INDEX_ENTRY_BYTES) for connection, entries in found]
        of, connections, counts = np.array(places, np.int64).reshape(-1, 3).T
        words = np.frombuffer(b"".join(held), "<u4").reshape(-1, 3).astype(np.int64)
        entries, sound = by_place(
            np.repeat(of, counts),
            np.repeat(connections, counts),
            words[:, 2],
            words[:, 0] * _NS + words[:, 1],
            sizes,
            least_bytes=_LEAST_RECORD_BYTES,
        )
        sound[unsound] = False
        return entries, sound

    def _index_of(self, member: _PlacedChunk) -> list[tuple[int, bytes]]:
        """Return each connection's entries in the index behind a chunk; `DamageError` where it has none, or a broken one."""
        counts = member.chunk.counts
        if counts is None or member.chunk.cut or member.record is None or member.size > MAX_PLANNED_BYTES:
            raise DamageError("only the chunk's records tell what it holds")
        found, position = [], member.record.end
        for _ in counts:
            connection, start, size = self._index_record(position)
            found.append((connection, self._bytes.peek(start, size)))
            position = start + size
        if {connection: len(entries) // _INDEX_ENTRY_BYTES for connection, entries in found} != counts:
            raise DamageError("a chunk's index does not hold what the summary counts")
        return found

    def _index_record(self, position: int) -> tuple[int, int, int]:
        """Return the connection of an index record, and offset and size of its entries.

        Their headers differ in connection and count only, so that most need no parsing.
        """
        head = self._bytes.peek(position, _INDEX_HEAD_BYTES)
        length = int.from_bytes(head[:4], "little")
        if length in self._index_heads and length + 8 <= len(head):
            connection_at, low, high, rest = self._index_heads[length]
            header = head[4 : length + 8]
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

    def _copy(self, member: _PlacedChunk, places: list[tuple[int, int, int]], to: memoryview) -> None:
        """Copy pieces (start, stop, place) of a chunk; of a plain one nothing else is read."""
        record = member.record
        if record is None or record.opcode != _OP_CHUNK or _codec(record) != "none":
            copy_pieces(self._load(member.chunk, record), places, to)
            return
        self._without_checksum = True
        self._bytes.read_pieces(
            [(record.data_offset + start, to[at : at + stop - start]) for start, stop, at in places]
        )

    def _load(self, chunk: _Chunk, record: _Record | None = None) -> memoryview:
        """Return the records of a chunk; of one that the file's end cuts, what can still be had."""
        record = record or self._record(chunk.offset)
        codec = _codec(record)
        if codec != "bz2":
            self._without_checksum = True
        size = record.number(b"size")
        if record.opcode != _OP_CHUNK:
            raise DamageError("no chunk is where the index says")
        if chunk.cut:
            data = self._bytes.read(record.data_offset, self._bytes.size - record.data_offset)
            kept = data if codec == "none" else decompressed_prefix(codec, data, size)
            what = f"the file ends inside a chunk; {len(kept)} bytes of it are read, unchecked"
            self._note(chunk.offset, what, bytes_lost=size - len(kept))
            return kept
        if record.end > self._bytes.size:
            raise DamageError("it runs past the file's end")
        if codec == "none":
            return self._bytes.read(record.data_offset, record.data_bytes)
        return decompressed(codec, self._bytes.read_once(record.data_offset, record.data_bytes), size)

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
        if len({chunk.offset for chunk in self._chunks}) < len(self._chunks):
            raise DamageError("the bag's index names a chunk twice")
        self._chunks.sort(key=lambda chunk: chunk.offset)

    def _take_chunk_info(self, record: _Record) -> None:
        data = self._bytes.read(record.data_offset, record.data_bytes)
        counts = dict(struct.iter_unpack("<II", data[: len(data) // 8 * 8]))
        if len(data) != 8 * len(counts) or len(counts) != record.number(b"count"):
            raise DamageError("the bag's index contradicts itself")
        chunk = _Chunk(
            record.number(b"chunk_pos"),
            _stamp(record.fields, b"start_time"),
            _stamp(record.fields, b"end_time"),
            counts,
        )
        if chunk.offset >= self._bytes.size or not counts.keys() <= self._connections.keys():
            raise DamageError("the bag's index points outside the file")
        self._chunks.append(chunk)
        self._bounds.count(len(self._chunks), 0)
        for connection, count in counts.items():
            self._tally(connection, count, chunk.start_ns, chunk.end_ns)

    def _take_connection(self, record: _Record, data: memoryview | bytes) -> None:
        described = _header_fields(data)
        topic = record.fields.get(b"topic", described.get(b"topic", b""))
        self._bounds.count(len(self._chunks), len(self._connections))
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
            data = self._load(chunk)
        except DamageError as error:
            self.damage[self._lost(chunk, str(error))] = None
            return
        found = self._walked(chunk, data)
        for connection in found.connections:
            self._take_connection(connection, data[connection.data_offset : connection.end])
        self._chunks.append(chunk)
        self._bounds.count(len(self._chunks), 0)
        self.damage.update(dict.fromkeys(self._contradictions(chunk, found, len(data))))
        for number in found.offsets.keys() & self._connections.keys():
            _, stamps = found.messages(number)
            self._tally(number, len(stamps), int(stamps.min()), int(stamps.max()))

    def _next_chunk(self, start: int) -> int:
        """Return where the next chunk's record begins: the mark of one, inside a header that parses."""
        for block_start, _, piece in self._bytes.windows(start, self._bytes.size, _MAX_CHUNK_HEADER):
            block = bytes(piece)
            mark = block.find(_CHUNK_MARK)
            while mark >= 0:
                found = self._chunk_of_mark(block_start + mark, start)
                if found is not None:
                    return found
                mark = block.find(_CHUNK_MARK, mark + 1)
        return self._bytes.size

    def _chunk_of_mark(self, mark: int, start: int) -> int | None:
        """Return where, at ``start`` or behind, the chunk's record begins whose header has the mark at byte ``mark``."""
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
        try:
            length = int.from_bytes(self._bytes.peek(position, 4), "little")
            if not 0 < length <= _MAX_CHUNK_HEADER:
                return False
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

    def _lost(self, chunk: _Chunk, what: str) -> Damage:
        return Damage(
            f"{self.name}, byte {chunk.offset}",
            f"a chunk is lost: {what}",
            messages_lost=sum(chunk.counts.values()) if chunk.counts else None,
            start_ns=chunk.start_ns or None,
            end_ns=chunk.end_ns or None,
        )


@dataclass(slots=True)
class _ChunkRecords:
    """What a walk through a chunk met: connections, each connection's messages, where the records end, and how many there are."""

    connections: list[_Record] = field(default_factory=list)
    offsets: dict[int, list[int]] = field(default_factory=dict)
    stamps: dict[int, list[int]] = field(default_factory=dict)
    end: int = 0
    count: int = 0

    def messages(self, connection: int) -> tuple[Int64Array, Int64Array]:
        """Return a connection's message offsets and log times."""
        return np.array(self.offsets[connection], np.int64), np.array(self.stamps[connection], np.int64)


def _walk_chunk(data: memoryview, most: int) -> _ChunkRecords:
    """Step through the records of a chunk; one that does not fit, or is one too many, ends the walk.

    A message's header differs from the one before it in connection and time only, so that most need no parsing.
    """
    found, position, size = _ChunkRecords(), 0, len(data)
    length_at = struct.Struct("<I").unpack_from
    known: dict[bytes, int] = {}
    time_at = 0
    while position + 8 <= size and found.count <= most:
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
        found.end = position = end
        found.count += 1
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


def _joined(by_connection: Mapping[int, tuple[Int64Array, Int64Array]]) -> _Messages:
    """Return messages of several connections, one connection after the other."""
    found = sorted(by_connection.items())
    none = np.zeros(0, np.int64)
    connections = np.repeat(np.array([number for number, _ in found], np.int64), [len(of) for _, (of, _) in found])
    offsets, stamps = (np.concatenate([none, *(of[kind] for _, of in found)]) for kind in (0, 1))
    return connections, offsets, stamps


def _blocks(
    data: memoryview, connections: Int64Array, offsets: Int64Array, stamps: Int64Array, ordinals: Int64Array
) -> list[MessageBlock]:
    """Return messages whose records begin at ``offsets`` as one block a connection; arrays have shape (N,)."""
    if not len(offsets):
        return []
    if (connections[1:] < connections[:-1]).any():
        order = np.argsort(connections, kind="stable")
        connections, offsets, stamps, ordinals = connections[order], offsets[order], stamps[order], ordinals[order]
    payloads = offsets + 8 + gathered(data, offsets, "u4")
    lengths = gathered(data, payloads - 4, "u4")
    return blocks_by_channel(
        data, connections, payloads, lengths, log_time_ns=stamps, publish_time_ns=stamps, ordinals=ordinals
    )


def _borne_out(data: memoryview, offsets: Int64Array, entries: Entries) -> NDArray[np.bool_]:
    """Return at which index entries there is a message of that connection and log time that ends before the next, shape (N,).

    Headers of messages agree but for connection and time, so the first is parsed and the others compared to it.
    """
    none = np.zeros(len(offsets), np.bool_)
    if not len(offsets):
        return none
    room = entries.end - entries.offset
    length = int(gathered(data, offsets[:1], "u4")[0])
    fits = room >= length + 8
    if not fits[0] or length > _MAX_HEADER_BYTES:
        return none
    windows: NDArray[np.uint8] = np.ndarray((len(data) - length - 7, length + 8), np.uint8, data, 0, (1, 1))
    heads = windows[np.where(fits, offsets, offsets[0])]
    header = heads[0, 4 : length + 4].tobytes()
    try:
        fields = _header_fields(header)
    except DamageError:
        return none
    sizes = len(fields.get(b"conn", b"")), len(fields.get(b"time", b""))
    if fields.get(b"op") != bytes([_OP_MESSAGE]) or sizes != (4, 8):
        return none
    varies = np.zeros(length + 8, np.bool_)
    conn_at, time_at = 4 + header.find(b"conn=") + 5, 4 + header.find(b"time=") + 5
    varies[conn_at : conn_at + 4] = varies[time_at : time_at + 8] = varies[length + 4 :] = True
    numbers = heads[:, conn_at : conn_at + 4].copy().view("<u4")[:, 0]
    times = heads[:, time_at : time_at + 8].copy().view("<u4").astype(np.int64)
    payload_bytes = heads[:, length + 4 :].copy().view("<u4")[:, 0]
    found: NDArray[np.bool_] = (
        fits
        & (numbers == entries.channel)
        & (times[:, 0] * _NS + times[:, 1] == entries.log_time_ns)
        & (length + 8 + payload_bytes.astype(np.int64) <= room)
        & ((heads == heads[0]) | varies).all(axis=1)
    )
    return found


def _codec(record: _Record) -> str:
    return record.fields.get(b"compression", b"").decode(errors="replace")
