"""The records of an MCAP file and its summary: https://mcap.dev/spec. A record: opcode, length (uint64), content."""

import itertools
import struct
from array import array
from dataclasses import dataclass, field

import numpy as np
from isal.isal_zlib import crc32

from tcpipe.arrays import Ints, Mask, gather_values, number_within
from tcpipe.formats.logs.chunk_reading import Messages
from tcpipe.formats.logs.log_part import ByteSource, DamageError, gather_integers, outline_of

MAGIC = b"\x89MCAP0\r\n"
CHUNK_CRC = 33
"""Where in a chunk's record its CRC begins (uint32)."""
RECORD_HEAD = 9
"""Bytes of opcode and length."""
MESSAGE_HEAD = 22
"""Bytes of a message's content before its payload: channel, sequence, log time, publish time."""
CHUNK_HEAD = 40
"""Bytes of a chunk's content before its data, without the name of its compression."""
_CHUNK_INDEX_HEAD, _CHUNK_INDEX_MIDDLE, _CHUNK_INDEX_TAIL = (
    struct.Struct(f"<{form}") for form in ("QQQQI", "QI", "QQ")
)
_INDEX_HEAD = struct.Struct("<BQHI")
_CHANNEL_OFFSET = struct.Struct("<HQ")
_STATISTICS = struct.Struct("<QHIIIIQQI")
FOOTER = 20
"""Bytes of a footer's content."""

_MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time_ns", "<i8"),
        ("publish_time_ns", "<i8"),
    ]
)
"""A message's record up to its payload; a length that claims the sign bit reads as negative, and is refused."""

OP_FOOTER, OP_SCHEMA, OP_CHANNEL, OP_MESSAGE, OP_CHUNK, OP_MESSAGE_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
OP_CHUNK_INDEX, OP_STATISTICS, OP_DATA_END, OP_LAST = 0x08, 0x0B, 0x0F, 0x0F


@dataclass(frozen=True, slots=True)
class Schema:
    """A message definition."""

    name: str
    encoding: str
    definition: str


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    """A topic, the number of its schema and the encoding of its messages."""

    topic: str
    schema: int
    encoding: str


@dataclass(frozen=True, slots=True)
class Chunk:
    """Position and content of a chunk; successive messages outside chunks are a chunk without a head.

    ``index`` maps a channel to the file offset of its message index (None without any); ``index_bytes`` is the size of
    all indexes together.
    """

    offset: int
    data_offset: int
    data_bytes: int
    compression: str
    uncompressed_bytes: int
    start_ns: int
    end_ns: int
    index: dict[int, int] | None = None
    index_bytes: int = 0
    cut: bool = False
    headless: bool = False

    @property
    def size(self) -> int:
        """Bytes of the chunk's records; of compressed records, the size that the chunk claims."""
        return self.uncompressed_bytes if self.compression else self.data_bytes

    @property
    def end(self) -> int:
        """Byte after the chunk's record."""
        return self.data_offset + self.data_bytes


@dataclass(frozen=True, slots=True)
class Statistics:
    """Counts of the whole file."""

    messages: int
    chunks: int
    messages_by_channel: dict[int, int]


class FieldReader:
    """Reads the fields of one record in order; raises `DamageError` if they do not fit."""

    def __init__(self, content: bytes | memoryview) -> None:
        self._content = content
        self._position = 0

    def take(self, form: str) -> tuple[int, ...]:
        """Return fixed-size fields, as struct names them."""
        try:
            values = struct.unpack_from("<" + form, self._content, self._position)
        except struct.error:
            raise DamageError("record-damaged") from None
        self._position += struct.calcsize("<" + form)
        return values

    def blob(self) -> bytes:
        """Return a length-prefixed run of bytes."""
        (size,) = self.take("I")
        if self._position + size > len(self._content):
            raise DamageError("record-damaged")
        self._position += size
        return bytes(self._content[self._position - size : self._position])

    def text(self) -> str:
        """Return a text; bytes that are no UTF-8 are kept visible, so that different names stay different."""
        return self.blob().decode(errors="backslashreplace")


def parse_chunk_head(content: bytes | memoryview, offset: int) -> Chunk:
    """Return the chunk whose record begins at ``offset``."""
    fields = FieldReader(content)
    start_ns, end_ns, uncompressed, _ = fields.take("QQQI")
    compression = fields.text()
    (size,) = fields.take("Q")
    data_offset = offset + RECORD_HEAD + CHUNK_HEAD + len(compression.encode())
    return Chunk(offset, data_offset, size, compression, uncompressed, start_ns, end_ns)


def parse_chunk_index(content: bytes | memoryview) -> Chunk:
    """Return a chunk as the summary describes it."""
    try:
        start_ns, end_ns, offset, length, map_bytes = _CHUNK_INDEX_HEAD.unpack_from(content)
        at = _CHUNK_INDEX_HEAD.size + map_bytes
        index = dict(_CHANNEL_OFFSET.iter_unpack(content[_CHUNK_INDEX_HEAD.size : at]))
        index_bytes, name_bytes = _CHUNK_INDEX_MIDDLE.unpack_from(content, at)
        at += _CHUNK_INDEX_MIDDLE.size + name_bytes
        compression = bytes(content[at - name_bytes : at]).decode(errors="backslashreplace")
        size, uncompressed = _CHUNK_INDEX_TAIL.unpack_from(content, at)
    except struct.error:
        raise DamageError("record-damaged") from None
    data_offset = offset + RECORD_HEAD + CHUNK_HEAD + name_bytes
    if data_offset + size != offset + length:
        raise DamageError("index-damaged")
    return Chunk(offset, data_offset, size, compression, uncompressed, start_ns, end_ns, index or None, index_bytes)


def parse_statistics(content: bytes | memoryview) -> Statistics:
    """Return the counts of the file."""
    try:
        messages, _, _, _, _, chunks, _, _, map_bytes = _STATISTICS.unpack_from(content)
        counts = dict(_CHANNEL_OFFSET.iter_unpack(content[_STATISTICS.size : _STATISTICS.size + map_bytes]))
    except struct.error:
        raise DamageError("record-damaged") from None
    return Statistics(messages, chunks, counts)


def index_entries(record: bytes | memoryview, channel: int) -> Ints:
    """Return a channel's message index as (log time, offset), shape (N, 2)."""
    if len(record) < _INDEX_HEAD.size:
        raise DamageError("chunk-index-damaged")
    opcode, _, named, size = _INDEX_HEAD.unpack_from(record)
    if opcode != OP_MESSAGE_INDEX or len(record) < _INDEX_HEAD.size + size or size % 16 or named != channel:
        raise DamageError("chunk-index-damaged")
    return np.frombuffer(record, "<i8", size // 8, RECORD_HEAD + 6).reshape(-1, 2)


def index_messages(data: bytes, records: Ints, ends: Ints, channels: Ints) -> tuple[Mask, Ints, Ints, Ints]:
    """Read several message indexes in one pass.

    ``records`` are the offsets of the indexes in ``data``, ``ends`` their upper limits and ``channels`` their expected
    channels, shape (R,). Return whether each index is valid, shape (R,), and for each message of the valid ones, shape
    (N,), the number of its index, its log time [ns] and its offset in the chunk.
    """
    complete = np.flatnonzero(records + RECORD_HEAD + 6 <= ends)
    is_valid, size = np.zeros(len(records), bool), np.zeros(len(records), np.int64)
    if len(complete):
        at = records[complete]
        size[complete] = gather_integers(data, at + RECORD_HEAD + 2, "u4")
        is_valid[complete] = (
            (np.frombuffer(data, np.uint8)[at] == OP_MESSAGE_INDEX)
            & (gather_integers(data, at + 1, "i8") == size[complete] + 6)  # rejects padding, which looks like damage
            & (gather_integers(data, at + RECORD_HEAD, "u2") == channels[complete])
            & (size[complete] % 16 == 0)
            & (at + RECORD_HEAD + 6 + size[complete] <= ends[complete])
        )
    counts = np.where(is_valid, size // 16, 0)
    record = np.repeat(np.arange(len(records)), counts)
    positions = records[record] + (RECORD_HEAD + 6) + 16 * number_within(counts)
    if not len(positions):
        return is_valid, record, positions, positions
    return is_valid, record, gather_integers(data, positions, "i8"), gather_integers(data, positions + 8, "i8")


def read_messages_at(data: memoryview, offsets: Ints) -> tuple[Messages, Mask]:
    """Return the messages at ``offsets`` in the data, and which of them have the opcode and length of messages."""
    heads = gather_values(data, offsets, _MESSAGE)
    messages = Messages(
        data,
        heads["channel"].astype(np.int64),
        offsets,
        offsets + (RECORD_HEAD + MESSAGE_HEAD),
        heads["length"] - MESSAGE_HEAD,
        heads["log_time_ns"].astype(np.int64),
        heads["publish_time_ns"].astype(np.int64),
    )
    return messages, (heads["opcode"] == OP_MESSAGE) & (heads["length"] >= MESSAGE_HEAD)


def record_offsets(data: bytes | memoryview, most: int) -> tuple[Ints, int]:
    """Return the offsets of the records in ``data`` and their end; stop at an incomplete record or after ``most``."""
    size, position, offsets = len(data), 0, array("q")
    length_at = struct.Struct("<Q").unpack_from
    while position + RECORD_HEAD <= size and len(offsets) <= most:
        end = position + RECORD_HEAD + length_at(data, position + 1)[0]
        if end > size:
            break
        offsets.append(position)
        position = end
    return np.array(offsets, np.int64), position


def find_message_offsets(data: memoryview, records: Ints) -> Ints:
    """Return the offsets of the records that are complete messages, shape (M,)."""
    if not len(records):
        return records
    messages: Ints = records[np.frombuffer(data, np.uint8)[records] == OP_MESSAGE]
    return messages[gather_integers(data, messages + 1, "i8") >= MESSAGE_HEAD] if len(messages) else messages


_DATA_END = RECORD_HEAD + 4  # bytes of the record that ends the data, right before the summary
_SUMMARY_BYTES = 1 << 16  # A summary is seldom longer


@dataclass(slots=True)
class Contents:
    """Facts of a file that were read so far."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    chunks: list[Chunk] = field(default_factory=list)
    statistics: Statistics | None = None
    outline: str = ""
    """Hash (hex) of the summary; "" if the summary lists no chunk."""

    def note(self, opcode: int, content: bytes | memoryview) -> None:
        """Add a schema or channel; the first of each number is used, later ones are ignored."""
        number, fields = int.from_bytes(content[:2], "little"), FieldReader(content)
        if opcode == OP_SCHEMA and number not in self.schemas:
            fields.take("H")
            self.schemas[number] = Schema(fields.text(), fields.text(), fields.text())
        elif opcode == OP_CHANNEL and number not in self.channels:
            _, schema = fields.take("HH")
            self.channels[number] = ChannelRecord(fields.text(), schema, fields.text())


def read_summary(source: ByteSource) -> Contents:
    """Read the summary section; `DamageError` if it cannot be used, without a cause if the writer wrote none."""
    tail_bytes = RECORD_HEAD + FOOTER + len(MAGIC)
    source.expect([(0, len(MAGIC)), (max(source.size - _SUMMARY_BYTES, 0), _SUMMARY_BYTES)])
    tail = bytes(source.read(max(source.size - tail_bytes, 0), min(tail_bytes, source.size)))
    if not tail.endswith(MAGIC) or tail[0] != OP_FOOTER or int.from_bytes(tail[1:9], "little") != FOOTER:
        raise DamageError("index-missing")
    start, crc = int.from_bytes(tail[9:17], "little"), int.from_bytes(tail[25:29], "little")
    if not start:
        raise DamageError
    end = source.size - tail_bytes
    data_end = bytes([OP_DATA_END, _DATA_END - RECORD_HEAD, *bytes(7)])
    if not len(MAGIC) <= start <= end or source.peek(start - _DATA_END, RECORD_HEAD) != data_end:
        raise DamageError("index-damaged")
    section = source.read(start, end - start + RECORD_HEAD + 16)
    if crc and crc32(section) != crc:
        raise DamageError("index-damaged")
    contents = _parsed(section[: end - start])
    _check(contents, source.size)
    if contents.chunks:
        contents.outline = outline_of(source.size, section)
    return contents


def _check(contents: Contents, file_bytes: int) -> None:
    """Raise `DamageError` if the summary is incomplete; of cause ``index-damaged`` if chunks overlap or exceed the file."""
    indexed = {channel for chunk in contents.chunks for channel in chunk.index or ()}
    counted = contents.statistics.messages_by_channel if contents.statistics else {}
    if (
        not contents.channels
        or not (indexed | counted.keys()) <= contents.channels.keys()
        or any(channel.schema and channel.schema not in contents.schemas for channel in contents.channels.values())
        or contents.statistics is None
        or contents.statistics.chunks != len(contents.chunks)
        or contents.statistics.messages != sum(counted.values())  # a writer need not count them by channel
    ):
        raise DamageError
    if any(chunk.end > file_bytes or chunk.offset < len(MAGIC) for chunk in contents.chunks) or any(
        later.offset < chunk.end for chunk, later in itertools.pairwise(contents.chunks)
    ):
        raise DamageError("index-damaged")


def _parsed(section: memoryview) -> Contents:
    """Return the contents of a summary section."""
    contents = Contents()
    records, end = record_offsets(section, len(section))
    if end < len(section):
        raise DamageError("index-damaged")
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
