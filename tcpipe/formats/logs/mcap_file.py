"""Read MCAP files by their summary if it is valid, else record by record; damaged parts are skipped.

tcpipe decompresses only chunks with a requested channel, checks their CRC, and compares the message index, which no
checksum covers, with the records of the chunk.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from isal.isal_zlib import crc32

from tcpipe.arrays import Ints, Mask
from tcpipe.formats.logs.chunk_reading import MAX_PLANNED_BYTES, ChunkedPart, Excerpt, Messages
from tcpipe.formats.logs.log_part import (
    MAX_CHUNK_BYTES,
    DamageError,
    MessageBlock,
    decompress,
    decompress_prefix,
    gather_integers,
    group_by_key,
)
from tcpipe.formats.logs.mcap_records import (
    CHUNK_CRC,
    CHUNK_HEAD,
    FOOTER,
    MAGIC,
    MESSAGE_HEAD,
    OP_CHANNEL,
    OP_CHUNK,
    OP_DATA_END,
    OP_FOOTER,
    OP_LAST,
    OP_MESSAGE,
    OP_MESSAGE_INDEX,
    OP_SCHEMA,
    RECORD_HEAD,
    Chunk,
    Contents,
    Schema,
    find_message_offsets,
    index_entries,
    index_messages,
    parse_chunk_head,
    read_messages_at,
    read_summary,
    record_offsets,
)
from tcpipe.logs.topics import Topic, compute_dropouts_ns, normalize_type_name

_LOOSE_BYTES = 1 << 22  # messages outside chunks are read in runs of about this size


class McapPart(ChunkedPart[Chunk]):
    """One .mcap file, open for reading."""

    container = "mcap"
    least_bytes = RECORD_HEAD + MESSAGE_HEAD

    def _open(self) -> dict[int, Topic]:
        """Read the summary, or every record if the summary cannot be used; return the topic of each channel."""
        self._tallies: dict[int, tuple[int, int, int]] = {}
        """By channel: number of messages found by reading records, first and last log time."""
        self._untimed = 0
        self._complete = False
        try:
            if self._bytes.peek(0, len(MAGIC)) != MAGIC:
                self._note("record-damaged", 0, messages_lost=0)
            self._contents = read_summary(self._bytes)
            self.outline = self._contents.outline
            if not self._contents.chunks:
                self._bytes.whole()
            self._bounds.claim(chunk.size for chunk in self._contents.chunks)
        except DamageError as error:
            if error.cause:
                self._note(error.cause, self._bytes.size, reason=error.reason)
            self._bytes.whole()
            self._contents = Contents()
            if not self._walk(len(MAGIC), self._bytes.size):
                self._distrust_last_index()
            self._complete = True
            self._bounds.claim(chunk.size for chunk in self._contents.chunks)
            self._count_messages()
        self._bounds.count(len(self._contents.chunks), len(self._contents.channels))
        return {number: self._topic(number) for number in sorted(self._contents.channels)}

    def blocks(self, wanted: frozenset[int]) -> Iterator[MessageBlock]:
        """Yield the messages of the requested channels."""
        if not self._complete:
            self._fill_gaps()
        yield from super().blocks(wanted)

    def chunks_with(self, wanted: frozenset[int]) -> list[tuple[int, Chunk]]:
        """Return the chunks that may contain requested channels, each with the number of bytes before it."""
        base, selected = 0, []
        for chunk in self._contents.chunks:
            if chunk.index is None or not wanted.isdisjoint(chunk.index):
                selected.append((base, chunk))
            base += min(chunk.size, MAX_CHUNK_BYTES)
        if len(selected) < len(self._contents.chunks):
            self._bytes.skips()
        return selected

    def read_indexed(self, found: Excerpt) -> tuple[Messages, Mask]:
        """Return the messages of an excerpt, and which of them agree with the chunk's index."""
        messages, is_message = read_messages_at(found.data, found.offset)
        entries = found.entries
        available_bytes = entries.end - entries.offset - RECORD_HEAD - MESSAGE_HEAD
        agrees = (messages.channel == entries.channel) & (messages.log_time_ns == entries.log_time_ns)
        return messages, is_message & agrees & (messages.length <= available_bytes)

    def _step_through(self, chunk: Chunk, data: memoryview) -> tuple[Ints, int]:
        """Return the offsets of a chunk's records, shape (N,), and the end of the last one."""
        records, end = record_offsets(data, self._bounds.most_records)
        self._bounds.walk(chunk.offset, len(records))
        return records, end

    def read_walked(self, chunk: Chunk, data: memoryview, wanted: frozenset[int]) -> Messages:
        """Return the requested messages of a chunk from its records; record damage of invalid or missing records."""
        records, end = self._step_through(chunk, data)
        messages, _ = read_messages_at(data, find_message_offsets(data, records))
        message_count = int((np.frombuffer(data, np.uint8)[records] == OP_MESSAGE).sum()) if len(records) else 0
        if lost := message_count - len(messages.offset):
            self._note("time-invalid", chunk.offset, messages_lost=lost)
        if end < len(data) and not chunk.cut:
            self._note("record-damaged", chunk.offset, bytes_lost=len(data) - end)
        unknown = [n for n in np.unique(messages.channel).tolist() if n not in self._contents.channels]
        # These messages were counted when the file was opened.
        is_counted = chunk.headless or (chunk.index is None and not self._contents.statistics)
        if unknown and not is_counted:
            lost = int(np.isin(messages.channel, unknown).sum())
            self._note("channel-undeclared", chunk.offset, messages_lost=lost)
        return messages.at(np.isin(messages.channel, sorted(wanted)))

    def is_proved(self, chunk: Chunk) -> bool:
        """Return whether the chunk has a CRC."""
        return bool(self._crc(chunk))

    def needs_index(self, chunk: Chunk) -> bool:
        """Return whether a damaged index counts as damage: without a CRC only the index verifies the chunk."""
        return chunk.index is not None and not chunk.cut and not self._crc(chunk)

    def find_plain_data(self, chunk: Chunk) -> int | None:
        """Return the file offset of the records of a chunk that is not compressed and has no CRC, else None."""
        if chunk.compression or self._crc(chunk):
            return None
        self.is_unchecked = True
        return chunk.data_offset

    def _crc(self, chunk: Chunk) -> int:
        """Return the CRC of a chunk's records; 0 without one."""
        if chunk.headless:
            return 0
        return int.from_bytes(self._bytes.read(chunk.offset + CHUNK_CRC, 4), "little")

    def load(self, chunk: Chunk) -> memoryview:
        """Return the chunk's records after a check of their CRC."""
        crc = self._crc(chunk)
        self.is_unchecked |= not crc
        data, size = self._bytes.read(chunk.data_offset, chunk.data_bytes), chunk.uncompressed_bytes
        if chunk.cut:
            readable = decompress_prefix(chunk.compression, data, size) if chunk.compression else data
            self._note("file-cut", chunk.offset, bytes_lost=size - len(readable))
            return readable
        if chunk.compression:
            data = decompress(chunk.compression, data, size, checked=bool(crc))
        if crc and crc32(data) != crc:
            raise DamageError("chunk-damaged")
        return data

    def read_indexes(self, chunks: list[Chunk]) -> tuple[tuple[Ints, ...], Sequence[int]]:
        """Return the messages that message indexes list, and the numbers of chunks without a valid index."""
        regions: list[memoryview] = []
        indexes: list[tuple[int, int, int, int]] = []
        invalid, region_start = [], 0
        starts = [(c.offset if c.compression else c.end, c) for c in chunks if c.index is not None]  # plain: index only
        self._bytes.expect([(start, c.end + c.index_bytes - start) for start, c in starts])
        for number, chunk in enumerate(chunks):
            if chunk.index is None or chunk.cut or chunk.size > MAX_PLANNED_BYTES:
                invalid.append(number)
                continue
            try:
                region, records = self._index_region(chunk, chunk.index)
            except DamageError:
                invalid.append(number)
                continue
            end = region_start + len(region)
            indexes += [(number, channel, region_start + at, end) for channel, at in records]
            regions.append(region)
            region_start = end
        chunk_number, channels, at, ends = np.array(indexes, np.int64).reshape(-1, 4).T
        is_valid, record, stamps, offsets = index_messages(b"".join(regions), at, ends, channels)
        return (chunk_number[record], channels[record], offsets, stamps), [*invalid, *chunk_number[~is_valid].tolist()]

    def _index_region(self, chunk: Chunk, index: dict[int, int]) -> tuple[memoryview, list[tuple[int, int]]]:
        """Return the bytes of the message indexes after a chunk, and each channel with the offset of its index in them."""
        offsets = [(channel, at - chunk.end) for channel, at in index.items()]
        if not all(0 <= at <= chunk.index_bytes - RECORD_HEAD for _, at in offsets):
            raise DamageError("chunk-index-damaged")
        return self._bytes.read(chunk.end, chunk.index_bytes), offsets

    def _index_entries(self, offset: int, channel: int) -> Ints:
        """Return a message index as (log time, offset), shape (N, 2)."""
        length = int.from_bytes(self._bytes.peek(offset, RECORD_HEAD)[1:], "little")
        if offset + RECORD_HEAD + length > self._bytes.size:
            raise DamageError("chunk-index-damaged")
        return index_entries(self._bytes.read(offset, RECORD_HEAD + length), channel)

    def _fill_gaps(self) -> None:
        """Read the bytes between the chunks of the summary: message indexes, and messages outside chunks."""
        self._complete = True
        listed, self._contents.chunks = self._contents.chunks, []
        position = len(MAGIC)
        for chunk in listed:
            self._walk(position, chunk.offset)
            self._contents.chunks.append(chunk)
            position = chunk.end + chunk.index_bytes
        self._walk(position, self._bytes.size)
        self._note_odd_messages()

    def _check_data_section(self, end: int) -> None:
        """Compare the CRC of all data, if it exists and messages are outside chunks: no other CRC covers these."""
        crc = int.from_bytes(self._bytes.peek(end + RECORD_HEAD, 4), "little")
        if not crc or not any(chunk.headless for chunk in self._contents.chunks):
            return
        computed = 0
        for start in range(0, end, _LOOSE_BYTES):
            computed = crc32(self._bytes.read(start, min(_LOOSE_BYTES, end - start)), computed)
        if computed != crc:
            self._note("chunk-damaged", end)

    def _walk(self, start: int, end: int) -> bool:
        """Read record after record, also after damage; return whether the end of the data was reached."""
        position = start
        while position + RECORD_HEAD <= end:
            if (after := self._take_loose_messages(position, end)) > position:
                position = after
                continue
            try:
                head = self._bytes.peek(position, RECORD_HEAD + CHUNK_HEAD + 4)
                opcode, length = head[0], int.from_bytes(head[1:9], "little")
                if opcode in (OP_FOOTER, OP_DATA_END) and length <= FOOTER:
                    if opcode == OP_DATA_END:
                        self._check_data_section(position)
                    return True
                after = position + RECORD_HEAD + length
                self._take_record(opcode, position, after, end)
            except DamageError as error:
                after = self._next_chunk(position + 1, end)
                self._note(error.cause, position, bytes_lost=after - position, reason=error.reason)
                self._distrust_last_index()
            position = after
        return False

    def _take_loose_messages(self, position: int, end: int) -> int:
        """Treat consecutive messages outside chunks as a chunk; return the offset of their end."""
        after = position
        with suppress(DamageError):
            while after - position <= _LOOSE_BYTES and after + RECORD_HEAD <= end:
                head = self._bytes.peek(after, RECORD_HEAD + MESSAGE_HEAD)
                length = int.from_bytes(head[1:9], "little")
                if head[0] != OP_MESSAGE or length < MESSAGE_HEAD or after + RECORD_HEAD + length > end:
                    break
                stamp = int.from_bytes(head[15:23], "little")
                self._tally(int.from_bytes(head[9:11], "little"), 1, stamp, stamp)
                after += RECORD_HEAD + length
        size = after - position
        if size:
            self._contents.chunks.append(Chunk(position, position, size, "", size, 0, 0, headless=True))
        return after

    def _take_record(self, opcode: int, position: int, after: int, end: int) -> None:
        """Add a record to the contents; `DamageError` if it is invalid or truncated."""
        if opcode == OP_CHUNK:
            self._contents.chunks.append(self._parse_chunk(position, after))
            self._bounds.count(len(self._contents.chunks), 0)
        elif opcode == OP_MESSAGE and after <= end:
            self._untimed += 1
        elif not 1 <= opcode <= OP_LAST:
            raise DamageError("record-damaged")
        elif after > end:
            raise DamageError("file-cut")
        elif opcode in (OP_SCHEMA, OP_CHANNEL):
            self._contents.note(opcode, self._bytes.read(position + RECORD_HEAD, after - position - RECORD_HEAD))
        elif opcode == OP_MESSAGE_INDEX and self._contents.chunks and not self._contents.chunks[-1].headless:
            self._take_message_index(position, after)

    def _parse_chunk(self, position: int, after: int) -> Chunk:
        """Return the chunk at a position; `DamageError` if it is invalid; a truncated chunk ends with the file."""
        chunk = parse_chunk_head(self._bytes.peek(position + RECORD_HEAD, CHUNK_HEAD + 4), position)
        is_whole = chunk.end == after and chunk.uncompressed_bytes <= MAX_CHUNK_BYTES
        if not is_whole or chunk.compression not in ("", "lz4", "zstd"):
            raise DamageError("record-damaged")
        if after > self._bytes.size:
            if self._next_chunk(position + 1, self._bytes.size) < self._bytes.size:
                raise DamageError("record-damaged")
            return replace(chunk, data_bytes=self._bytes.size - chunk.data_offset, cut=True)
        return chunk

    def _take_message_index(self, position: int, after: int) -> None:
        """Add a message index to the chunk before it."""
        if after - position < RECORD_HEAD + 6:
            raise DamageError("chunk-index-damaged")
        channel = int.from_bytes(self._bytes.peek(position + RECORD_HEAD, 2), "little")
        self._index_entries(position, channel)
        chunk = self._contents.chunks[-1]
        index_bytes = after - chunk.end
        # The new chunk shares this dict: copies for each entry would take quadratic time.
        index = {} if chunk.index is None else chunk.index
        index[channel] = position
        self._contents.chunks[-1] = replace(chunk, index=index, index_bytes=index_bytes)

    def _distrust_last_index(self) -> None:
        """Discard the index of the last chunk: if the file is truncated after it, the index may be incomplete."""
        if self._contents.chunks:
            self._contents.chunks[-1] = replace(self._contents.chunks[-1], index=None)

    def _next_chunk(self, start: int, end: int) -> int:
        """Return the offset of the next chunk whose lengths are consistent; ``end`` without one."""
        for block_start, size, block in self._bytes.windows(start, end, RECORD_HEAD + CHUNK_HEAD + 4):
            for candidate in _find_possible_chunks(block, size):
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
        """Count the messages of a walked file by its indexes; load chunks without one or with undeclared channels."""
        contents = self._contents
        for chunk in contents.chunks:
            if chunk.headless:
                continue
            if chunk.index is None or not chunk.index.keys() <= contents.channels.keys():
                self._declare_and_count(chunk)
            for channel, offset in (chunk.index or {}).items():
                try:
                    entries = self._index_entries(offset, channel)
                except DamageError as error:
                    self._note(error.cause, offset, reason=error.reason)
                    continue
                if len(entries):
                    self._tally(channel, len(entries), int(entries[:, 0].min()), int(entries[:, 0].max()))
        self._note_odd_messages()

    def _note_odd_messages(self) -> None:
        """Record messages outside chunks, or in an index, that have no declared channel or no time."""
        if self._untimed:
            self._note("time-invalid", 0, messages_lost=self._untimed)
        if unknown := self._tallies.keys() - self._contents.channels.keys():
            self._note("channel-undeclared", 0, messages_lost=sum(self._tallies[channel][0] for channel in unknown))

    def _declare_and_count(self, chunk: Chunk) -> None:
        """Declare the channels in a chunk; count its messages if it has no index."""
        try:
            data = self.load(chunk)
        except DamageError as error:
            self.note_lost(chunk, error)
            return
        records, _ = self._step_through(chunk, data)
        self._declare(chunk, data, records)
        if chunk.index is None:
            messages = find_message_offsets(data, records)
            channels = gather_integers(data, messages + RECORD_HEAD, "u2") if len(messages) else np.zeros(0, np.int64)
            for channel, rows in group_by_key(channels):
                stamps = gather_integers(data, messages[rows] + RECORD_HEAD + 6, "i8")
                self._tally(channel, len(stamps), int(stamps.min()), int(stamps.max()))

    def _declare(self, chunk: Chunk, data: memoryview, records: Ints) -> None:
        """Add the schemas and channels among the records of a chunk."""
        for offset in records.tolist():
            if data[offset] in (OP_SCHEMA, OP_CHANNEL):
                length = int.from_bytes(data[offset + 1 : offset + RECORD_HEAD], "little")
                try:
                    self._contents.note(data[offset], data[offset + RECORD_HEAD : offset + RECORD_HEAD + length])
                except DamageError as error:
                    self._note(error.cause, chunk.offset)

    def _topic(self, number: int) -> Topic:
        """Return the topic of a channel, with counts and times from the statistics or from the records."""
        channel = self._contents.channels[number]
        schema = self._contents.schemas.get(channel.schema, Schema("", "", ""))
        statistics = self._contents.statistics
        if statistics:
            count, (start_ns, end_ns) = statistics.messages_by_channel.get(number, 0), self._times(number)
        else:
            count, start_ns, end_ns = self._tallies.get(number, (0, None, None))
        return Topic(
            channel.topic,
            normalize_type_name(schema.name),
            count,
            start_ns,
            end_ns,
            channel.encoding,
            schema.definition,
            silent_ns=compute_dropouts_ns([(chunk.start_ns, chunk.end_ns) for chunk in self._holding(number)], count),
            schema_encoding=schema.encoding,
        )

    def _holding(self, channel: int) -> list[Chunk]:
        """Return the chunks that contain messages of a channel, by the index."""
        return [chunk for chunk in self._contents.chunks if chunk.index and channel in chunk.index]

    def _times(self, channel: int) -> tuple[int | None, int | None]:
        """Return the channel's first and last log time, by the indexes of chunks that reach beyond the known times."""
        first: list[int] = []
        last: list[int] = []
        for found_ns, sign in ((first, 1), (last, -1)):
            reaches_ns = [(sign * (c.start_ns if sign > 0 else c.end_ns), c) for c in self._holding(channel)]
            for reach_ns, chunk in sorted(reaches_ns, key=lambda pair: pair[0]):
                if not found_ns or reach_ns < min(sign * stamp_ns for stamp_ns in found_ns):
                    try:
                        found_ns.extend(self._index_entries((chunk.index or {})[channel], channel)[:, 0].tolist())
                    except DamageError:
                        return None, None
        return min(first, default=None), max(last, default=None)

    def _tally(self, channel: int, count: int, start_ns: int, end_ns: int) -> None:
        known, first_ns, last_ns = self._tallies.get(channel, (0, start_ns, end_ns))
        self._tallies[channel] = known + count, min(start_ns, first_ns), max(end_ns, last_ns)

    def note_lost(self, chunk: Chunk, error: DamageError) -> None:
        """Record the loss of a whole chunk, with the number of messages in its message index."""
        try:
            lost = sum(len(self._index_entries(at, channel)) for channel, at in (chunk.index or {}).items())
        except DamageError:
            lost = 0
        size = chunk.uncompressed_bytes
        self._note(error.cause, chunk.offset, messages_lost=lost or None, bytes_lost=size, reason=error.reason)


def _find_possible_chunks(block: memoryview, size: int) -> list[int]:
    """Return the offsets in ``size`` bytes at which the opcode and the length of the compression name fit a chunk."""
    opcodes = np.frombuffer(block, np.uint8)[: max(min(size, len(block) - RECORD_HEAD - CHUNK_HEAD), 0)]
    candidates = np.flatnonzero(opcodes == OP_CHUNK)
    if not len(candidates):
        return []
    name_bytes = gather_integers(block, candidates + RECORD_HEAD + 28, "u4")
    found: list[int] = candidates[np.isin(name_bytes, (0, 3, 4))].tolist()
    return found
