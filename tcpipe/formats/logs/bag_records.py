"""The records of a ROS 1 bag, as bytes: http://wiki.ros.org/Bags/Format/2.0. Every record is a header and data, each after its length."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.logs.chunk_reading import Excerpt, Messages
from tcpipe.formats.logs.log_part import DamageError, gather_integers

MAGIC = b"#ROSBAG V2.0\n"

OP_MESSAGE, OP_HEADER, OP_INDEX, OP_CHUNK, OP_CHUNK_INFO, OP_CONNECTION = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
MAX_HEADER_BYTES = 1 << 16
"""A record's header is shorter."""
NS = 1_000_000_000
"""Nanoseconds in a second."""
_TIME = struct.Struct("<II")


@dataclass(frozen=True, slots=True)
class BagRecord:
    """A record: its header fields, and where its data lies."""

    fields: dict[bytes, bytes]
    data_offset: int
    data_bytes: int

    @property
    def opcode(self) -> int:
        """What kind of record it is."""
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
        """Return a little-endian integer field; `DamageError` where it is missing."""
        if name not in self.fields:
            raise DamageError("record-damaged")
        return int.from_bytes(self.fields[name], "little")


@dataclass(slots=True)
class ChunkRecords:
    """What a walk through a chunk met: connections, each connection's messages, where the records end, and how many there are."""

    connections: list[BagRecord] = field(default_factory=list)
    offsets: dict[int, list[int]] = field(default_factory=dict)
    stamps: dict[int, list[int]] = field(default_factory=dict)
    end: int = 0
    count: int = 0

    def messages(self, data: memoryview, wanted: frozenset[int]) -> Messages:
        """Return the messages of the wanted connections, one connection after the other."""
        numbers = sorted(wanted & self.offsets.keys())
        channel = np.repeat(np.array(numbers, np.int64), [len(self.offsets[number]) for number in numbers])
        offset = np.array([at for number in numbers for at in self.offsets[number]], np.int64)
        stamp_ns = np.array([at for number in numbers for at in self.stamps[number]], np.int64)
        if not len(offset):
            return Messages(data, channel, offset, offset, offset, stamp_ns, stamp_ns)
        payload = offset + 8 + gather_integers(data, offset, "u4")
        return Messages(data, channel, offset, payload, gather_integers(data, payload - 4, "u4"), stamp_ns, stamp_ns)


def walk_chunk(data: memoryview, most: int) -> ChunkRecords:
    """Step through the records of a chunk; one that does not fit, or is one too many, ends the walk.

    A message's header differs from the one before it in connection and time only, so that most need no parsing.
    """
    found, position, size = ChunkRecords(), 0, len(data)
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
                record = BagRecord(parse_header_fields(header), header_end + 4, end - header_end - 4)
                if record.opcode == OP_CONNECTION:
                    found.connections.append(record)
                elif record.opcode == OP_MESSAGE:
                    connection = record.number(b"conn")
                    stamp_ns(record.fields, b"time")
                    time_at = header.find(b"time=") + 5
                    known[header[:time_at] + header[time_at + 8 :]] = connection
            except DamageError:
                break
        if connection is not None:
            seconds, nanoseconds = _TIME.unpack_from(header, time_at)
            found.offsets.setdefault(connection, []).append(position)
            found.stamps.setdefault(connection, []).append(seconds * NS + nanoseconds)
        found.end = position = end
        found.count += 1
    return found


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


def read_indexed_messages(found: Excerpt) -> tuple[Messages, NDArray[np.bool_]]:
    """Return the messages of an excerpt, and at which of its entries there is one of that connection and time that ends before the next.

    Headers of messages agree but for connection and time, so the first is parsed and the others compared to it.
    """
    data, offset, entries = found.data, found.offset, found.entries
    none = Messages(data, entries.channel, offset, offset, offset, entries.log_time_ns, entries.log_time_ns)
    if not len(offset):
        return none, np.zeros(0, np.bool_)
    room = entries.end - entries.offset
    length = int(gather_integers(data, offset[:1], "u4")[0])
    fits = room >= length + 8
    if not fits[0] or length > MAX_HEADER_BYTES:
        return none, np.zeros(len(offset), np.bool_)
    windows: NDArray[np.uint8] = np.ndarray((len(data) - length - 7, length + 8), np.uint8, data, 0, (1, 1))
    heads = windows[np.where(fits, offset, offset[0])]
    conn_at, time_at = _find_message_fields(heads[0, 4 : length + 4].tobytes())
    if not conn_at or not time_at:
        return none, np.zeros(len(offset), np.bool_)
    varies = np.zeros(length + 8, np.bool_)
    varies[conn_at : conn_at + 4] = varies[time_at : time_at + 8] = varies[length + 4 :] = True
    channel = heads[:, conn_at : conn_at + 4].copy().view("<u4")[:, 0].astype(np.int64)
    times = heads[:, time_at : time_at + 8].copy().view("<u4").astype(np.int64)
    stamp_ns = times[:, 0] * NS + times[:, 1]
    payload_bytes = heads[:, length + 4 :].copy().view("<u4")[:, 0].astype(np.int64)
    true: NDArray[np.bool_] = (
        fits
        & (channel == entries.channel)
        & (stamp_ns == entries.log_time_ns)
        & (length + 8 + payload_bytes <= room)
        & ((heads == heads[0]) | varies).all(axis=1)
    )
    return Messages(data, channel, offset, offset + (length + 8), payload_bytes, stamp_ns, stamp_ns), true


def _find_message_fields(header: bytes) -> tuple[int, int]:
    """Return where in a message's record its connection and its time stand; zeros where the header is none of a message."""
    try:
        fields = parse_header_fields(header)
    except DamageError:
        return 0, 0
    sizes = len(fields.get(b"conn", b"")), len(fields.get(b"time", b""))
    if fields.get(b"op") != bytes([OP_MESSAGE]) or sizes != (4, 8):
        return 0, 0
    return 4 + header.find(b"conn=") + 5, 4 + header.find(b"time=") + 5
