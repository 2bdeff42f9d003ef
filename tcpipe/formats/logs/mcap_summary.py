"""What an MCAP file says of itself: at its end, in the summary, or gathered on a walk through it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

from isal.isal_zlib import crc32

from tcpipe.formats.logs.log_part import ByteSource, DamageError, outline_of
from tcpipe.formats.logs.mcap_records import (
    FOOTER,
    MAGIC,
    OP_CHANNEL,
    OP_CHUNK_INDEX,
    OP_DATA_END,
    OP_FOOTER,
    OP_SCHEMA,
    OP_STATISTICS,
    RECORD_HEAD,
    ChannelRecord,
    Chunk,
    Schema,
    Statistics,
    parse_channel,
    parse_chunk_index,
    parse_schema,
    parse_statistics,
    record_offsets,
)

_DATA_END = RECORD_HEAD + 4
"""Bytes of the record that ends the data, right before the summary."""
_SUMMARY_BYTES = 1 << 16
"""A summary is seldom longer."""


@dataclass(slots=True)
class Contents:
    """What is known of a file so far."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    chunks: list[Chunk] = field(default_factory=list)
    statistics: Statistics | None = None
    outline: str = ""
    """A hash of the summary, where that names every chunk of a file that has some."""

    def note(self, opcode: int, content: bytes | memoryview) -> None:
        """Remember a schema or channel; the first of a number holds, and others are not looked at, however many there are."""
        number = int.from_bytes(content[:2], "little")
        if opcode == OP_SCHEMA and number not in self.schemas:
            self.schemas.setdefault(*parse_schema(content))
        elif opcode == OP_CHANNEL and number not in self.channels:
            self.channels.setdefault(*parse_channel(content))


def read_summary(source: ByteSource) -> Contents:
    """Read the summary section; `DamageError` (without text where there simply is none) when it cannot be used."""
    tail_bytes = RECORD_HEAD + FOOTER + len(MAGIC)
    source.expect([(0, len(MAGIC)), (max(source.size - _SUMMARY_BYTES, 0), _SUMMARY_BYTES)])
    tail = bytes(source.read(max(source.size - tail_bytes, 0), min(tail_bytes, source.size)))
    if not tail.endswith(MAGIC) or tail[0] != OP_FOOTER or int.from_bytes(tail[1:9], "little") != FOOTER:
        raise DamageError("the file is not closed (no footer)")
    start, crc = int.from_bytes(tail[9:17], "little"), int.from_bytes(tail[25:29], "little")
    if not start:
        raise DamageError
    end = source.size - tail_bytes
    if not len(MAGIC) <= start <= end:
        raise DamageError("the footer points outside the file")
    if source.peek(start - _DATA_END, RECORD_HEAD) != bytes([OP_DATA_END, _DATA_END - RECORD_HEAD, *bytes(7)]):
        raise DamageError("the footer does not point behind the data")
    section = source.read(start, end - start + RECORD_HEAD + 16)
    if crc and crc32(section) != crc:
        raise DamageError("the summary's CRC does not match")
    contents = _parsed(section[: end - start])
    _check(contents, source.size)
    if contents.chunks:
        contents.outline = outline_of(source.size, section)
    return contents


def _check(contents: Contents, file_bytes: int) -> None:
    """Raise `DamageError` when the summary does not name what a reader needs."""
    indexed = {channel for chunk in contents.chunks for channel in chunk.index or ()}
    counted = contents.statistics.messages_by_channel if contents.statistics else {}
    if not (indexed | counted.keys()) <= contents.channels.keys() or not contents.channels:
        raise DamageError
    if any(channel.schema and channel.schema not in contents.schemas for channel in contents.channels.values()):
        raise DamageError
    if contents.statistics is None or contents.statistics.chunks != len(contents.chunks):
        raise DamageError
    if contents.statistics.messages != sum(counted.values()):  # a writer need not count them by channel
        raise DamageError
    if any(chunk.end > file_bytes or chunk.offset < len(MAGIC) for chunk in contents.chunks):
        raise DamageError("the summary points outside the file")
    if any(later.offset < chunk.end for chunk, later in itertools.pairwise(contents.chunks)):
        raise DamageError("the summary names a chunk twice")


def _parsed(section: memoryview) -> Contents:
    contents = Contents()
    records, end = record_offsets(section, len(section))
    if end < len(section):
        raise DamageError("the summary contradicts itself")
    for offset in records.tolist():
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
