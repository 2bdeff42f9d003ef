"""MCAP files: by their summary where it can be trusted, record by record where not, and past what is broken.

A chunk is decompressed only when it holds a wanted channel, its CRC is checked, and the message index beside it (which no checksum
covers) is believed only as far as the chunk's own records bear it out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from isal.isal_zlib import crc32

from tcpipe.formats.log_part import (
    MAX_CHUNK_BYTES,
    ByteSource,
    Channel,
    DamageError,
    Int64Array,
    MessageBlock,
    decompressed,
    decompressed_prefix,
    gathered,
    in_order,
    search_windows,
)
from tcpipe.formats.mcap_records import (
    CHUNK_CRC,
    CHUNK_HEAD,
    FOOTER,
    MAGIC,
    MESSAGE_HEAD,
    OP_CHANNEL,
    OP_CHUNK,
    OP_CHUNK_INDEX,
    OP_DATA_END,
    OP_FOOTER,
    OP_LAST,
    OP_MESSAGE,
    OP_MESSAGE_INDEX,
    OP_SCHEMA,
    OP_STATISTICS,
    RECORD_HEAD,
    ChannelRecord,
    Chunk,
    Messages,
    Schema,
    Statistics,
    index_entries,
    message_offsets,
    parse_channel,
    parse_chunk_head,
    parse_chunk_index,
    parse_schema,
    parse_statistics,
    record_offsets,
)
from tcpipe.logs.topics import Damage, normalized_type_name

_RUN_BYTES = 1 << 22
"""Messages outside chunks are read in runs of about this size."""


@dataclass(slots=True)
class _Contents:
    """What is known of a file so far."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    chunks: list[Chunk] = field(default_factory=list)
    statistics: Statistics | None = None

    def note(self, opcode: int, content: bytes | memoryview) -> None:
        """Remember a schema or channel; the first of a number holds."""
        if opcode == OP_SCHEMA:
            number, schema = parse_schema(content)
            self.schemas.setdefault(number, schema)
        elif opcode == OP_CHANNEL:
            number, channel = parse_channel(content)
            self.channels.setdefault(number, channel)


@dataclass(slots=True)
class _Tally:
    """Messages of a channel met on a walk."""

    count: int = 0
    start_ns: int | None = None
    end_ns: int | None = None


class McapPart:
    """One .mcap file, open for reading."""

    def __init__(self, path: Path, name: str) -> None:
        self.name = name
        self.damage: dict[Damage, None] = {}
        self._bytes = ByteSource(path)
        self._tallies: dict[int, _Tally] = {}
        self._complete = False
        self._read_chunks: set[int] = set()
        self._without_crc: set[int] = set()
        if self._bytes.peek(0, len(MAGIC)) != MAGIC:
            self._note(0, "the file's first bytes are not those of an MCAP file", messages_lost=0)
        try:
            self._contents = self._summary()
        except DamageError as error:
            if str(error):
                self._note(self._bytes.size, f"{error}; it is read record by record")
            self._contents = _Contents()
            if not self._walk(self._contents, len(MAGIC), self._bytes.size):
                self._distrust_last_index(self._contents)
            self._complete = True
            self._count_messages()
        self.channels = {number: self._channel(number) for number in sorted(self._contents.channels)}

    def close(self) -> None:
        """Close the file."""
        self._bytes.close()

    @property
    def unchecked(self) -> str:
        """What was read that no checksum covers."""
        if not self._without_crc:
            return ""
        return f"{len(self._without_crc)} of {len(self._read_chunks)} chunks read carry no CRC"

    def blocks(self, wanted: frozenset[int], *, threads: int = 1) -> Iterator[MessageBlock]:
        """Yield the messages of the wanted channels, chunk by chunk."""
        if not self._complete:
            self._fill_gaps()

        if any(chunk.index is not None and wanted.isdisjoint(chunk.index) for chunk in self._contents.chunks):
            self._bytes.skips()

        def read(piece: tuple[int, Chunk]) -> tuple[Chunk, list[MessageBlock], DamageError | None]:
            base, chunk = piece
            try:
                return chunk, self._chunk_blocks(chunk, wanted, base), None
            except DamageError as error:
                return chunk, [], error

        for chunk, blocks, error in in_order(read, self._wanted_chunks(wanted), threads=threads):
            self._read_chunks.add(chunk.offset)
            if error:
                self._note_lost(chunk, str(error))
            yield from blocks

    def _wanted_chunks(self, wanted: frozenset[int]) -> Iterator[tuple[int, Chunk]]:
        """Yield the chunks that may hold wanted channels, each with the number of bytes in all chunks before it."""
        base = 0
        for chunk in self._contents.chunks:
            if chunk.index is None or not wanted.isdisjoint(chunk.index):
                yield base, chunk
            base += chunk.uncompressed_bytes

    def _chunk_blocks(self, chunk: Chunk, wanted: frozenset[int], base: int) -> list[MessageBlock]:
        head = b"" if chunk.headless else self._bytes.read(chunk.offset, chunk.data_offset - chunk.offset)
        if chunk.headless or not any(head[CHUNK_CRC]):
            self._without_crc.add(chunk.offset)
        skipping = not chunk.headless and self._may_skip(chunk, head)
        index = self._indexes(chunk, None if skipping else wanted)
        data = self._load(chunk, head, _pieces(chunk, index, wanted) if skipping else None)
        messages = _indexed(data, index, wanted)
        return (_walked(data, wanted) if messages is None else messages).blocks(data, base)

    @staticmethod
    def _may_skip(chunk: Chunk, head: bytes | memoryview) -> bool:
        """Return whether nothing compels to read all of a chunk: it is neither compressed nor does a CRC want checking."""
        return not (chunk.compression or chunk.cut or any(head[CHUNK_CRC]))

    def _load(
        self, chunk: Chunk, head: bytes | memoryview, pieces: tuple[Int64Array, Int64Array] | None = None
    ) -> memoryview:
        """Return the chunk's records, its CRC checked; of a chunk that the file's end cuts, what can still be had.

        Where not all of it must be read, hardly more than ``pieces`` (starts, ends) is read from the disk.
        """
        if chunk.headless:
            return self._bytes.read(chunk.data_offset, chunk.data_bytes)
        if chunk.cut:
            return self._load_cut(chunk, self._bytes.read(chunk.data_offset, chunk.data_bytes))
        if self._may_skip(chunk, head):
            return self._bytes.mapped(chunk.data_offset, chunk.data_bytes, pieces)
        if chunk.compression:
            data = self._bytes.read_once(chunk.data_offset, chunk.data_bytes)
            data = decompressed(chunk.compression, data, chunk.uncompressed_bytes)
        else:
            data = self._bytes.read(chunk.data_offset, chunk.data_bytes)
        crc = int.from_bytes(head[CHUNK_CRC], "little")
        if crc and crc32(data) != crc:
            raise DamageError("its CRC does not match")
        return data

    def _load_cut(self, chunk: Chunk, data: memoryview) -> memoryview:
        kept = decompressed_prefix(chunk.compression, data, chunk.uncompressed_bytes) if chunk.compression else data
        lost = chunk.uncompressed_bytes - len(kept)
        self._note(
            chunk.offset, f"the file ends inside a chunk; {len(kept)} bytes of it are read, unchecked", bytes_lost=lost
        )
        return kept

    def _indexes(self, chunk: Chunk, wanted: frozenset[int] | None) -> dict[int, Int64Array] | None:
        """Return the message indexes of a chunk's wanted channels (None: of all), None where one is missing or broken.

        They lie together, right behind the chunk.
        """
        if chunk.index is None or chunk.cut:
            return None
        index = {at: channel for channel, at in sorted(chunk.index.items()) if wanted is None or channel in wanted}
        found = {}
        try:
            held = self._bytes.read(chunk.end, chunk.index_bytes)
            for at, channel in index.items():
                start = at - chunk.end
                if 0 <= start <= len(held) - RECORD_HEAD:
                    length = int.from_bytes(held[start + 1 : start + RECORD_HEAD], "little")
                    record = held[start : start + RECORD_HEAD + length]
                else:
                    record = self._index_record(at)
                found[channel] = index_entries(record, channel)
                if len(record) != RECORD_HEAD + 6 + found[channel].nbytes:
                    return None  # padding is allowed, but so would a broken count look
        except DamageError:
            return None
        return found

    def _index_entries(self, offset: int, channel: int) -> Int64Array:
        """Return a message index as (log time, offset), shape (N, 2)."""
        return index_entries(self._index_record(offset), channel)

    def _index_record(self, offset: int) -> memoryview:
        length = int.from_bytes(self._bytes.peek(offset, RECORD_HEAD)[1:], "little")
        if offset + RECORD_HEAD + length > self._bytes.size:
            raise DamageError("a message index runs past the file's end")
        return self._bytes.read(offset, RECORD_HEAD + length)

    def _summary(self) -> _Contents:
        """Read the summary section; `DamageError` (without text where there simply is none) when it cannot be used."""
        tail_bytes = RECORD_HEAD + FOOTER + len(MAGIC)
        tail = bytes(self._bytes.read(max(self._bytes.size - tail_bytes, 0), min(tail_bytes, self._bytes.size)))
        if not tail.endswith(MAGIC) or tail[0] != OP_FOOTER or int.from_bytes(tail[1:9], "little") != FOOTER:
            raise DamageError("the file is not closed (no footer)")
        start, crc = int.from_bytes(tail[9:17], "little"), int.from_bytes(tail[25:29], "little")
        if not start:
            raise DamageError
        end = self._bytes.size - tail_bytes
        if not len(MAGIC) <= start <= end:
            raise DamageError("the footer points outside the file")
        section = self._bytes.read(start, end - start + RECORD_HEAD + 16)
        if crc and crc32(section) != crc:
            raise DamageError("the summary's CRC does not match")
        contents = _parse_summary(section[: end - start])
        self._check_summary(contents)
        return contents

    def _check_summary(self, contents: _Contents) -> None:
        """Raise `DamageError` when the summary does not name what a reader needs."""
        indexed = {channel for chunk in contents.chunks for channel in chunk.index or ()}
        counted = contents.statistics.messages_by_channel if contents.statistics else {}
        if not (indexed | counted.keys()) <= contents.channels.keys() or not contents.channels:
            raise DamageError
        if any(channel.schema and channel.schema not in contents.schemas for channel in contents.channels.values()):
            raise DamageError
        if contents.statistics is None or contents.statistics.chunks != len(contents.chunks):
            raise DamageError
        if any(chunk.end > self._bytes.size or chunk.offset < len(MAGIC) for chunk in contents.chunks):
            raise DamageError("the summary points outside the file")

    def _fill_gaps(self) -> None:
        """Walk what lies between the chunks that the summary names: message indexes, and messages outside chunks."""
        self._complete = True
        listed, self._contents.chunks = self._contents.chunks, []
        position = len(MAGIC)
        for chunk in listed:
            self._walk(self._contents, position, chunk.offset)
            self._contents.chunks.append(chunk)
            position = chunk.end + chunk.index_bytes
        self._walk(self._contents, position, self._bytes.size)

    def _walk(self, contents: _Contents, start: int, end: int) -> bool:
        """Step from record to record; after one that cannot be, search for the next chunk. Return whether the data's end was met."""
        position = start
        run = _Run()
        closed = False
        while position + RECORD_HEAD <= end:
            head = self._bytes.peek(position, RECORD_HEAD + CHUNK_HEAD + 4)
            opcode, length = head[0], int.from_bytes(head[1:9], "little")
            after = position + RECORD_HEAD + length
            if opcode in (OP_FOOTER, OP_DATA_END) and length <= FOOTER:
                closed = True
                break
            if opcode == OP_MESSAGE and after <= end and length >= MESSAGE_HEAD:
                stamp = int.from_bytes(head[15:23], "little")
                self._tally(int.from_bytes(head[9:11], "little"), 1, stamp, stamp)
                run.extend(position, after, contents.chunks)
                position = after
                continue
            run.finish(contents.chunks)
            try:
                self._take_record(contents, opcode, position, after, end)
            except DamageError as error:
                after = self._next_chunk(position + 1, end)
                self._note(position, str(error), bytes_lost=after - position)
                self._distrust_last_index(contents)
            position = after
        run.finish(contents.chunks)
        return closed

    def _take_record(self, contents: _Contents, opcode: int, position: int, after: int, end: int) -> None:
        if opcode == OP_CHUNK:
            contents.chunks.append(self._walked_chunk(position, after))
        elif not 1 <= opcode <= OP_LAST:
            raise DamageError(f"no record begins with opcode {opcode}")
        elif after > end:
            raise DamageError(f"a record (opcode {opcode}) of {after - position} bytes runs past the end")
        elif opcode in (OP_SCHEMA, OP_CHANNEL):
            contents.note(opcode, self._bytes.read(position + RECORD_HEAD, after - position - RECORD_HEAD))
        elif opcode == OP_MESSAGE_INDEX and contents.chunks and not contents.chunks[-1].headless:
            self._take_message_index(contents, position, after)

    def _walked_chunk(self, position: int, after: int) -> Chunk:
        chunk = parse_chunk_head(self._bytes.peek(position + RECORD_HEAD, CHUNK_HEAD + 4), position)
        if chunk.compression not in ("", "lz4", "zstd") or chunk.end != after:
            raise DamageError("the head of a chunk contradicts itself")
        if chunk.uncompressed_bytes > MAX_CHUNK_BYTES:
            raise DamageError(f"a chunk claims to hold {chunk.uncompressed_bytes} bytes")
        if after > self._bytes.size:
            if self._next_chunk(position + 1, self._bytes.size) < self._bytes.size:
                raise DamageError("the head of a chunk contradicts what follows")
            return replace(chunk, data_bytes=self._bytes.size - chunk.data_offset, cut=True)
        return chunk

    def _take_message_index(self, contents: _Contents, position: int, after: int) -> None:
        if after - position < RECORD_HEAD + 6:
            raise DamageError("a message index contradicts itself")
        channel = int.from_bytes(self._bytes.peek(position + RECORD_HEAD, 2), "little")
        self._index_entries(position, channel)
        chunk = contents.chunks[-1]
        contents.chunks[-1] = replace(chunk, index={**(chunk.index or {}), channel: position})

    def _distrust_last_index(self, contents: _Contents) -> None:
        """Forget the index of the last chunk: where the file breaks off behind it, some of it may be missing."""
        if contents.chunks:
            contents.chunks[-1] = replace(contents.chunks[-1], index=None)

    def _next_chunk(self, start: int, end: int) -> int:
        """Return where the next plausible chunk begins: its lengths agree with one another and with the file's."""
        for block_start, size, read_bytes in search_windows(start, end, RECORD_HEAD + CHUNK_HEAD + 4):
            block = self._bytes.read(block_start, read_bytes)
            for candidate in _possible_chunks(block, size):
                length = int.from_bytes(block[candidate + 1 : candidate + RECORD_HEAD], "little")
                try:
                    chunk = parse_chunk_head(block[candidate + RECORD_HEAD :], block_start + candidate)
                except DamageError:
                    continue
                whole = chunk.end == chunk.offset + RECORD_HEAD + length <= end
                plausible = chunk.start_ns <= chunk.end_ns and chunk.uncompressed_bytes <= MAX_CHUNK_BYTES
                if whole and plausible and chunk.compression in ("", "lz4", "zstd"):
                    return chunk.offset
        return end

    def _count_messages(self) -> None:
        """Count the messages of a walked file by its message indexes; load what has none, or what may declare unknown channels."""
        contents = self._contents
        for chunk in contents.chunks:
            if chunk.headless:
                continue
            if chunk.index is None or not chunk.index.keys() <= contents.channels.keys():
                self._declare_and_count(chunk)
            for channel, offset in (chunk.index or {}).items():
                entries = self._index_entries(offset, channel)
                if len(entries):
                    self._tally(channel, len(entries), int(entries[:, 0].min()), int(entries[:, 0].max()))
        for channel in sorted(self._tallies.keys() - contents.channels.keys()):
            lost = self._tallies[channel].count
            self._note(0, f"messages of channel {channel}, which nothing declares", messages_lost=lost)

    def _declare_and_count(self, chunk: Chunk) -> None:
        try:
            head = self._bytes.read(chunk.offset, chunk.data_offset - chunk.offset)
            data = self._load(chunk, head)
        except DamageError as error:
            self._note_lost(chunk, str(error))
            return
        records = record_offsets(data)
        self._declare(data, records)
        if chunk.index is None:
            self._tally_messages(data, message_offsets(data, records))

    def _declare(self, data: memoryview, records: Int64Array) -> None:
        for offset in records.tolist():
            if data[offset] in (OP_SCHEMA, OP_CHANNEL):
                length = int.from_bytes(data[offset + 1 : offset + RECORD_HEAD], "little")
                self._contents.note(data[offset], data[offset + RECORD_HEAD : offset + RECORD_HEAD + length])

    def _channel(self, number: int) -> Channel:
        channel = self._contents.channels[number]
        schema = self._contents.schemas.get(channel.schema, Schema("", "", ""))
        statistics = self._contents.statistics
        if statistics:
            count, (start_ns, end_ns) = statistics.messages_by_channel.get(number, 0), self._times(number)
        else:
            tally = self._tallies.get(number, _Tally())
            count, start_ns, end_ns = tally.count, tally.start_ns, tally.end_ns
        return Channel(
            channel.topic,
            normalized_type_name(schema.name),
            channel.encoding,
            schema.encoding,
            schema.definition,
            count,
            start_ns,
            end_ns,
        )

    def _times(self, channel: int) -> tuple[int | None, int | None]:
        """Return the channel's first and last log time, from the message indexes of the chunks at both ends."""
        holding = [chunk for chunk in self._contents.chunks if chunk.index and channel in chunk.index]
        if not holding:
            return None, None
        first, last = min(holding, key=lambda c: c.start_ns), max(holding, key=lambda c: c.end_ns)
        try:
            begin = self._index_entries((first.index or {})[channel], channel)
            end = self._index_entries((last.index or {})[channel], channel)
        except DamageError:
            return None, None
        return (int(begin[:, 0].min()), int(end[:, 0].max())) if len(begin) and len(end) else (None, None)

    def _tally(self, channel: int, count: int, start_ns: int, end_ns: int) -> None:
        tally = self._tallies.setdefault(channel, _Tally())
        tally.count += count
        tally.start_ns = start_ns if tally.start_ns is None else min(start_ns, tally.start_ns)
        tally.end_ns = end_ns if tally.end_ns is None else max(end_ns, tally.end_ns)

    def _tally_messages(self, data: memoryview, messages: Int64Array) -> None:
        channels = gathered(data, messages + RECORD_HEAD, "u2") if len(messages) else np.zeros(0, np.uint16)
        for channel in np.unique(channels).tolist():
            stamps = gathered(data, messages[channels == channel] + RECORD_HEAD + 6, "i8")
            self._tally(channel, len(stamps), int(stamps.min()), int(stamps.max()))

    def _note(self, offset: int, what: str, *, messages_lost: int | None = None, bytes_lost: int | None = None) -> None:
        where = f"{self.name}, byte {offset}"
        self.damage[Damage(where, what, messages_lost=messages_lost, bytes_lost=bytes_lost)] = None

    def _note_lost(self, chunk: Chunk, what: str) -> None:
        """Note a chunk that is lost as a whole, counted by the message index beside it."""
        try:
            lost = sum(len(self._index_entries(at, channel)) for channel, at in (chunk.index or {}).items())
        except DamageError:
            lost = 0
        self.damage[
            Damage(
                f"{self.name}, byte {chunk.offset}",
                f"a chunk is lost: {what}",
                messages_lost=lost or None,
                bytes_lost=chunk.uncompressed_bytes,
                start_ns=chunk.start_ns,
                end_ns=chunk.end_ns,
            )
        ] = None


class _Run:
    """Messages outside chunks that follow one another: read together, as if they were a chunk."""

    def __init__(self) -> None:
        self._start = self._end = 0

    def extend(self, start: int, end: int, chunks: list[Chunk]) -> None:
        """Add one message."""
        if self._end - self._start > _RUN_BYTES:
            self.finish(chunks)
        if self._end == self._start:
            self._start = start
        self._end = end

    def finish(self, chunks: list[Chunk]) -> None:
        """Append the run to the chunks."""
        size = self._end - self._start
        if size:
            chunks.append(Chunk(self._start, self._start, size, "", size, 0, 0, headless=True))
        self._start = self._end = 0


def _indexed(data: memoryview, index: dict[int, Int64Array] | None, wanted: frozenset[int]) -> Messages | None:
    """Return the wanted messages by a chunk's index; None where that is missing or contradicts the records."""
    if index is None:
        return None
    index = {channel: entries for channel, entries in index.items() if channel in wanted}
    channels = np.repeat(np.array(list(index), np.int64), [len(of) for of in index.values()])
    entries = np.concatenate([np.empty((0, 2), np.int64), *index.values()])
    offsets = entries[:, 1]
    if len(offsets) and not 0 <= offsets.min() <= offsets.max() <= len(data) - RECORD_HEAD - MESSAGE_HEAD:
        return None
    messages = Messages(data, channels, offsets)
    return messages.sorted() if messages.are(channels, entries[:, 0]) else None


def _walked(data: memoryview, wanted: frozenset[int]) -> Messages:
    """Return the wanted messages by walking the records."""
    offsets = message_offsets(data, record_offsets(data))
    channels = gathered(data, offsets + RECORD_HEAD, "u2") if len(offsets) else offsets
    chosen = np.isin(channels, sorted(wanted))
    return Messages(data, channels[chosen], offsets[chosen]).sorted()


def _pieces(
    chunk: Chunk, index: dict[int, Int64Array] | None, wanted: frozenset[int]
) -> tuple[Int64Array, Int64Array] | None:
    """Return where in a chunk the wanted messages begin and end; None where they are all of it, or that is not known."""
    if not index or index.keys() <= wanted:
        return None
    offsets = np.concatenate([entries[:, 1] for entries in index.values()])
    chosen = np.repeat([channel in wanted for channel in index], [len(entries) for entries in index.values()])
    order = np.argsort(offsets)
    offsets, chosen = np.clip(offsets[order], 0, chunk.data_bytes), chosen[order]
    return offsets[chosen], np.append(offsets[1:], chunk.data_bytes)[chosen]


def _parse_summary(section: memoryview) -> _Contents:
    contents = _Contents()
    for offset in record_offsets(section).tolist():
        length = int.from_bytes(section[offset + 1 : offset + RECORD_HEAD], "little")
        content = section[offset + RECORD_HEAD : offset + RECORD_HEAD + length]
        if section[offset] == OP_CHUNK_INDEX:
            contents.chunks.append(parse_chunk_index(content))
        elif section[offset] == OP_STATISTICS:
            contents.statistics = parse_statistics(content)
        else:
            contents.note(section[offset], content)
    contents.chunks.sort(key=lambda chunk: chunk.offset)
    return contents


def _possible_chunks(block: memoryview, size: int) -> list[int]:
    """Return where in ``size`` bytes a chunk's opcode is followed, at the right distance, by the length of a compression's name."""
    opcodes = np.frombuffer(block, np.uint8)[: max(min(size, len(block) - RECORD_HEAD - CHUNK_HEAD), 0)]
    candidates = np.flatnonzero(opcodes == OP_CHUNK)
    if not len(candidates):
        return []
    name_bytes = gathered(block, candidates + RECORD_HEAD + 28, "u4")
    found: list[int] = candidates[np.isin(name_bytes, (0, 3, 4))].tolist()
    return found
