"""Read the chunks of a log of any format, by their index where the chunks agree with it, else record by record.

In a log with cameras, most bytes of a chunk are not requested. The requested bytes of several chunks are concatenated
and parsed together, which costs less than a pass for each chunk.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np

from tcpipe.arrays import Ints, Mask
from tcpipe.errors import LogError
from tcpipe.formats.logs.log_part import (
    Bounds,
    ByteSource,
    DamageError,
    FetchedFile,
    LogPart,
    MessageBlock,
    split_by_channel,
)
from tcpipe.logs.topics import Topic

GROUP_BYTES = 1 << 23
"""Total size of chunks that are planned together [byte]."""
_GAP_BYTES = 1 << 13  # messages no further apart are copied, or read from the disk, in one piece
_PLACE_BITS = 40
MAX_PLANNED_BYTES = (1 << _PLACE_BITS) - 1
"""A larger chunk is read on its own."""

Piece = tuple[int, int, int]
"""Start and stop of a part of a chunk, and its position in the concatenation."""


@dataclass(frozen=True, slots=True)
class Entries:
    """Index entries of messages: chunk number in the group, channel, offset and log time, shape (N,) each.

    They are sorted by chunk and offset. ``end`` is the offset of the next message in the chunk, or of the chunk's end.
    """

    chunk: Ints
    channel: Ints
    offset: Ints
    end: Ints
    log_time_ns: Ints

    def at(self, chosen: slice | Ints | Mask) -> Entries:
        """Return the entries of some rows."""
        columns = (self.chunk, self.channel, self.offset, self.end, self.log_time_ns)
        return Entries(*(values[chosen] for values in columns))


@dataclass(frozen=True, slots=True)
class Excerpt:
    """Concatenated pieces of chunks; ``offset`` is the position in ``data`` of the message of each entry, shape (N,)."""

    data: memoryview
    offset: Ints
    entries: Entries


@dataclass(frozen=True, slots=True)
class Messages:
    """Messages in ``data``: offsets of their records and payloads, payload lengths, and times, shape (N,) each."""

    data: memoryview
    channel: Ints
    offset: Ints
    payload: Ints
    length: Ints
    log_time_ns: Ints
    publish_time_ns: Ints

    def at(self, chosen: Ints | Mask) -> Messages:
        """Return the messages of some rows."""
        columns = (self.channel, self.offset, self.payload, self.length, self.log_time_ns, self.publish_time_ns)
        return Messages(self.data, *(values[chosen] for values in columns))


class PlacedChunk(Protocol):
    """A chunk: its offset in the file, and the size of its records, if stated [byte]."""

    @property
    def offset(self) -> int:
        """Offset of its start."""

    @property
    def size(self) -> int:
        """Bytes of its records."""


AnyChunk = TypeVar("AnyChunk", bound=PlacedChunk)


class ChunkedPart(LogPart, Generic[AnyChunk]):
    """A file of chunks, open for reading. Methods raise `DamageError` if a chunk is lost."""

    least_bytes: int
    """Smallest size of a message's record [byte]."""

    def __init__(self, path: Path, name: str, fetched: FetchedFile | None = None) -> None:
        super().__init__(name)
        self._bytes = ByteSource(path, fetched)
        self._bounds = Bounds(path, self._bytes.size)
        try:
            self.channels = self._open()
        except LogError:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._bytes.close()

    @abstractmethod
    def _open(self) -> dict[int, Topic]:
        """Read the index, or the whole file if the index is unusable; return every channel."""

    @abstractmethod
    def chunks_with(self, wanted: frozenset[int]) -> list[tuple[int, AnyChunk]]:
        """Return the chunks that may contain requested channels, each with an upper bound of the bytes before it."""

    @abstractmethod
    def read_indexes(self, chunks: list[AnyChunk]) -> tuple[tuple[Ints, ...], Sequence[int]]:
        """Return the messages that the indexes of chunks list, and the numbers of chunks without a valid index.

        The arrays are the messages' chunk numbers in the list, channels, offsets in the chunk and log times, shape (N,)
        each.
        """

    @abstractmethod
    def load(self, chunk: AnyChunk) -> memoryview:
        """Return all records of a chunk; for a truncated chunk, the remaining ones."""

    @abstractmethod
    def find_plain_data(self, chunk: AnyChunk) -> int | None:
        """Return the file offset of a chunk's records if pieces of them can be read; None if all must be loaded."""

    @abstractmethod
    def read_indexed(self, found: Excerpt) -> tuple[Messages, Mask]:
        """Return the messages of an excerpt, and which of them agree with the chunk's index."""

    @abstractmethod
    def read_walked(self, chunk: AnyChunk, data: memoryview, wanted: frozenset[int]) -> Messages:
        """Return the requested messages of a chunk from its records; missing ones are added to ``damage``."""

    @abstractmethod
    def is_proved(self, chunk: AnyChunk) -> bool:
        """Return whether a checksum covers the chunk's records, so that the index is wrong if they differ."""

    @abstractmethod
    def needs_index(self, chunk: AnyChunk) -> bool:
        """Return whether a broken index of this chunk counts as damage of the log."""

    @abstractmethod
    def note_lost(self, chunk: AnyChunk, error: DamageError) -> None:
        """Record the loss of a whole chunk, with the number of messages in its index."""

    def blocks(self, wanted: frozenset[int]) -> Iterator[MessageBlock]:
        """Yield the messages of the requested channels by chunk, or by several chunks if few messages are wanted."""
        chunks = self.chunks_with(wanted)
        for group in group_chunks(chunk.size for _, chunk in chunks):
            members = chunks[group.start : group.stop]
            sizes = np.array([min(chunk.size, MAX_PLANNED_BYTES) for _, chunk in members], np.int64)
            (chunk, channel, offset, at_ns), unsound = self.read_indexes([chunk for _, chunk in members])
            entries, sound = sort_by_place(chunk, channel, offset, at_ns, sizes, least_bytes=self.least_bytes)
            sound[unsound] = False
            entries = entries.at(np.isin(entries.channel, sorted(wanted)))
            yield from self._read_group(entries, sound, members, wanted)

    def _read_group(
        self, entries: Entries, sound: Mask, members: list[tuple[int, AnyChunk]], wanted: frozenset[int]
    ) -> Iterator[MessageBlock]:
        """Yield the requested messages of chunks; losses and contradictions are added to ``damage``."""
        excerpt = self.read_excerpt(entries, [chunk for _, chunk in members])
        messages, agrees = self.read_indexed(excerpt)
        ordinal = np.array([base for base, _ in members], np.int64)[excerpt.entries.chunk] + excerpt.entries.offset
        doubtful = np.unique(excerpt.entries.chunk[~agrees])
        if len(doubtful):
            trusted = ~np.isin(excerpt.entries.chunk, doubtful)
            messages, ordinal = messages.at(trusted), ordinal[trusted]
        yield from self._split_in_time(messages, ordinal)
        for number in np.union1d(doubtful, np.flatnonzero(~sound)).tolist():
            base, chunk = members[number]
            try:
                data = self.load(chunk)
            except DamageError as error:
                self.note_lost(chunk, error)
                continue
            messages = self.read_walked(chunk, data, wanted)
            indexed = entries.at(entries.chunk == number) if sound[number] else None
            self._note_index_disagreement(chunk, messages, indexed)
            yield from self._split_in_time(messages, base + messages.offset)

    def read_excerpt(self, entries: Entries, chunks: Sequence[AnyChunk]) -> Excerpt:
        """Return the messages of readable chunks, with the bytes that contain them."""
        pieces, offset, size = lay_out_pieces(entries)
        data, lost = np.empty(size, np.uint8).data, []
        for number, of_chunk in pieces.items():
            try:
                self._copy(chunks[number], of_chunk, data)
            except DamageError as error:
                lost.append(number)
                self.note_lost(chunks[number], error)
        is_readable = ~np.isin(entries.chunk, lost)
        return Excerpt(data, offset[is_readable], entries.at(is_readable)) if lost else Excerpt(data, offset, entries)

    def _copy(self, chunk: AnyChunk, pieces: list[Piece], to: memoryview) -> None:
        """Copy pieces of a chunk to their positions in ``to``; load the chunk if it is compressed or has a checksum."""
        start = self.find_plain_data(chunk)
        if start is not None:
            self._bytes.read_pieces([(start + a, to[at : at + b - a]) for a, b, at in pieces])
            return
        data = self.load(chunk)
        for a, b, at in pieces:
            to[at : at + b - a] = data[a:b]

    def _split_in_time(self, messages: Messages, ordinal: Ints) -> list[MessageBlock]:
        """Return messages as one block a channel; exclude and record times of more than 63 bits."""
        valid = (messages.log_time_ns >= 0) & (messages.publish_time_ns >= 0)
        if not valid.all():
            self._note("time-invalid", messages_lost=int((~valid).sum()))
            messages, ordinal = messages.at(valid), ordinal[valid]
        times = messages.log_time_ns, messages.publish_time_ns
        return split_by_channel(messages.data, messages.channel, messages.payload, messages.length, *times, ordinal)

    def _note_index_disagreement(self, chunk: AnyChunk, messages: Messages, entries: Entries | None) -> None:
        """Record that a chunk's index is damaged, or differs from its records."""
        lost = 0
        if entries is None and (chunk.size > MAX_PLANNED_BYTES or not self.needs_index(chunk)):
            return
        if entries is not None:
            by_offset = messages.at(np.argsort(messages.offset, kind="stable"))
            from_records = np.stack([by_offset.offset, by_offset.channel, by_offset.log_time_ns])
            if np.array_equal(from_records, np.stack([entries.offset, entries.channel, entries.log_time_ns])):
                return
            lost = max(len(entries.offset) - len(by_offset.offset), 0)
        self._note("chunk-index-damaged", chunk.offset, messages_lost=0 if self.is_proved(chunk) else lost or None)


def group_chunks(sizes: Iterable[int]) -> Iterator[range]:
    """Yield ranges of successive chunks, of given sizes [byte], that are planned together."""
    first = last = group_bytes = 0
    for size in sizes:
        last += 1
        group_bytes += size
        if group_bytes >= GROUP_BYTES:
            yield range(first, last)
            first, group_bytes = last, 0
    if first < last:
        yield range(first, last)


def sort_by_place(
    chunk: Ints, channel: Ints, offset: Ints, log_time_ns: Ints, sizes: Ints, *, least_bytes: int
) -> tuple[Entries, Mask]:
    """Return index entries sorted by chunk and offset, shape (N,) each, and which chunks have a valid index.

    An index is invalid if a message begins outside its chunk of ``sizes`` bytes, or has less than ``least_bytes``
    before the next message.
    """
    outside = (offset < 0) | (offset >= sizes[chunk])
    sound = np.ones(len(sizes), bool)
    sound[chunk[outside]] = False
    order = np.argsort((chunk << _PLACE_BITS) + np.where(outside, 0, offset), kind="stable")
    chunk, channel, offset, log_time_ns = chunk[order], channel[order], offset[order], log_time_ns[order]
    end = sizes[chunk]
    follows = chunk[1:] == chunk[:-1]
    end[:-1][follows] = offset[1:][follows]
    sound[chunk[end - offset < least_bytes]] = False
    entries = Entries(chunk, channel, offset, end, log_time_ns)
    return (entries if sound.all() else entries.at(sound[chunk])), sound


def lay_out_pieces(entries: Entries) -> tuple[dict[int, list[Piece]], Ints, int]:
    """Plan the concatenation of the parts of chunks that contain messages.

    Return the pieces of each chunk by its number, the position of each message in the concatenation, shape (N,), and
    the total size [byte].
    """
    begins = np.ones(len(entries.offset), bool)
    far = entries.offset[1:] - entries.end[:-1] > _GAP_BYTES
    begins[1:] = far | (entries.chunk[1:] != entries.chunk[:-1])
    first = np.flatnonzero(begins)
    start, stop = entries.offset[first], entries.end[np.append(first[1:], len(begins)) - 1] if len(first) else first
    target = np.cumsum(stop - start) - (stop - start)
    offset = entries.offset + (target - start)[np.cumsum(begins) - 1] if len(first) else entries.offset
    pieces: dict[int, list[Piece]] = {}
    for chunk, *piece in zip(*(values.tolist() for values in (entries.chunk[first], start, stop, target)), strict=True):
        pieces.setdefault(chunk, []).append((piece[0], piece[1], piece[2]))
    return pieces, offset, int((stop - start).sum())
