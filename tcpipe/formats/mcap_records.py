"""The records of an MCAP file, as bytes: https://mcap.dev/spec. Every record is an opcode, a length (uint64), and its content."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.log_part import DamageError, Int64Array, MessageBlock, blocks_by_channel, gathered

MAGIC = b"\x89MCAP0\r\n"
CHUNK_CRC = slice(33, 37)
"""Where in a chunk's record its CRC lies."""
RECORD_HEAD = 9
"""Bytes of opcode and length."""
MESSAGE_HEAD = 22
"""Bytes of a message's content before its payload: channel, sequence, log time, publish time."""
CHUNK_HEAD = 40
"""Bytes of a chunk's content before its data, without the name of its compression."""
_INDEX_HEAD = struct.Struct("<BQHI")
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
    """Where a chunk lies and what it holds; a run of messages outside chunks is one without a head (``crc`` 0, no compression).

    ``index`` gives the byte of each channel's message index (None where the chunk has none), ``index_bytes`` how long they are together.
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
    def end(self) -> int:
        """Byte after the chunk's record."""
        return self.data_offset + self.data_bytes


@dataclass(frozen=True, slots=True)
class Statistics:
    """Counts of the whole file."""

    chunks: int
    start_ns: int
    end_ns: int
    messages_by_channel: dict[int, int]


class Fields:
    """Reads the fields of one record in order; raises `DamageError` where they do not fit."""

    def __init__(self, content: bytes | memoryview) -> None:
        self._content = content
        self._position = 0

    def take(self, form: str) -> tuple[int, ...]:
        """Return fixed-size fields, as struct names them."""
        try:
            values = struct.unpack_from("<" + form, self._content, self._position)
        except struct.error:
            raise DamageError("a record ends before its fields do") from None
        self._position += struct.calcsize("<" + form)
        return values

    def blob(self) -> bytes:
        """Return a length-prefixed run of bytes."""
        (size,) = self.take("I")
        if self._position + size > len(self._content):
            raise DamageError("a text runs past its record")
        self._position += size
        return bytes(self._content[self._position - size : self._position])

    def pairs(self, size: int) -> dict[int, int]:
        """Return a map of ``size`` bytes from channel to number."""
        found = {}
        for _ in range(size // 10):
            channel, value = self.take("HQ")
            found[channel] = value
        return found

    def text(self) -> str:
        """Return a text; bytes that are no UTF-8 are kept visible, so that different names stay different."""
        return self.blob().decode(errors="backslashreplace")


def parse_schema(content: bytes | memoryview) -> tuple[int, Schema]:
    """Return a schema and its number."""
    fields = Fields(content)
    (number,) = fields.take("H")
    return number, Schema(fields.text(), fields.text(), fields.text())


def parse_channel(content: bytes | memoryview) -> tuple[int, ChannelRecord]:
    """Return a channel and its number."""
    fields = Fields(content)
    number, schema = fields.take("HH")
    return number, ChannelRecord(fields.text(), schema, fields.text())


def parse_chunk_head(content: bytes | memoryview, offset: int) -> Chunk:
    """Return the chunk whose record begins at ``offset``."""
    fields = Fields(content)
    start_ns, end_ns, uncompressed, _ = fields.take("QQQI")
    compression = fields.text()
    (size,) = fields.take("Q")
    data_offset = offset + RECORD_HEAD + CHUNK_HEAD + len(compression.encode())
    return Chunk(offset, data_offset, size, compression, uncompressed, start_ns, end_ns)


def parse_chunk_index(content: bytes | memoryview) -> Chunk:
    """Return a chunk as the summary describes it."""
    fields = Fields(content)
    start_ns, end_ns, offset, length, map_bytes = fields.take("QQQQI")
    index = fields.pairs(map_bytes)
    (index_bytes,) = fields.take("Q")
    compression = fields.text()
    size, uncompressed = fields.take("QQ")
    data_offset = offset + RECORD_HEAD + CHUNK_HEAD + len(compression.encode())
    if data_offset + size != offset + length:
        raise DamageError("a chunk index contradicts itself")
    return Chunk(offset, data_offset, size, compression, uncompressed, start_ns, end_ns, index or None, index_bytes)


def parse_statistics(content: bytes | memoryview) -> Statistics:
    """Return the counts of the file."""
    fields = Fields(content)
    _, _, _, _, _, chunks, start_ns, end_ns, map_bytes = fields.take("QHIIIIQQI")
    return Statistics(chunks, start_ns, end_ns, fields.pairs(map_bytes))


def index_entries(record: bytes | memoryview, channel: int) -> Int64Array:
    """Return a channel's message index as (log time, offset), shape (N, 2)."""
    if len(record) < _INDEX_HEAD.size:
        raise DamageError("a message index is not where it should be")
    opcode, _, named, size = _INDEX_HEAD.unpack_from(record)
    if opcode != OP_MESSAGE_INDEX or len(record) < _INDEX_HEAD.size + size:
        raise DamageError("a message index is not where it should be")
    if size % 16 or named != channel:
        raise DamageError("a message index contradicts itself")
    return np.frombuffer(record, "<i8", size // 8, RECORD_HEAD + 6).reshape(-1, 2)


class Messages:
    """Messages inside a chunk's records, by channel: ``channels`` and ``offsets`` have shape (N,)."""

    def __init__(self, data: memoryview, channels: Int64Array, offsets: Int64Array) -> None:
        count = max(len(data) - _MESSAGE.itemsize + 1, 0)
        windows: NDArray[np.void] = np.ndarray((count,), f"V{_MESSAGE.itemsize}", data if count else b"", 0, (1,))
        self._channels, self._offsets, self._bytes = channels, offsets, len(data)
        self._heads: NDArray[np.void] = windows[offsets].view(_MESSAGE)

    def are(self, channels: Int64Array, log_time_ns: Int64Array) -> bool:
        """Return whether there really are messages of these channels and log times, whole."""
        heads, left = self._heads, self._bytes - self._offsets - RECORD_HEAD
        lengths = heads["length"]
        return bool(
            (
                (heads["opcode"] == OP_MESSAGE)
                & (heads["channel"] == channels)
                & (heads["log_time_ns"] == log_time_ns)
                & (lengths >= MESSAGE_HEAD)
                & (lengths <= left)
            ).all()
        )

    def sorted(self) -> Messages:
        """Return them with each channel's in one piece, by rising offset."""
        channels, offsets = self._channels, self._offsets
        again = channels[1:] == channels[:-1]
        if not ((channels[1:] > channels[:-1]) | (again & (offsets[1:] > offsets[:-1]))).all():
            order = np.lexsort((offsets, channels))
            self._channels, self._offsets, self._heads = channels[order], offsets[order], self._heads[order]
        return self

    def blocks(self, data: memoryview, base: int) -> list[MessageBlock]:
        """Return one block a channel; they must be sorted. ``base`` is the number of bytes before these records."""
        heads = self._heads
        return blocks_by_channel(
            data,
            self._channels,
            self._offsets + (RECORD_HEAD + MESSAGE_HEAD),
            heads["length"] - MESSAGE_HEAD,
            log_time_ns=heads["log_time_ns"].astype(np.int64),
            publish_time_ns=heads["publish_time_ns"].astype(np.int64),
            ordinals=self._offsets + base,
        )


def record_offsets(data: bytes | memoryview) -> Int64Array:
    """Walk the records in ``data`` and return where each begins; a record that does not fit ends the walk."""
    size, position, found = len(data), 0, []
    length_at = struct.Struct("<Q").unpack_from
    while position + RECORD_HEAD <= size:
        end = position + RECORD_HEAD + length_at(data, position + 1)[0]
        if end > size:
            break
        found.append(position)
        position = end
    return np.array(found, np.int64)


def message_offsets(data: memoryview, records: Int64Array) -> Int64Array:
    """Return those of the records that are whole messages."""
    if not len(records):
        return records
    messages: Int64Array = records[np.frombuffer(data, np.uint8)[records] == OP_MESSAGE]
    return messages[gathered(data, messages + 1, "i8") >= MESSAGE_HEAD] if len(messages) else messages
