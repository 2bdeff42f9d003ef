"""Interface of every log container: channels, and blocks of serialised messages with their times.

A `LogPart` is one file of a log. `tcpipe.formats.logs.log_file` joins the parts of a log and turns their blocks into
tables.
"""

import hashlib
import os
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Ints, gather_values
from tcpipe.errors import LogError
from tcpipe.formats.object_storage import StoredObject
from tcpipe.logs.topics import Damage, Topic

MAX_CHUNK_BYTES = 1 << 29
"""Largest plausible content of a chunk, which is held as a whole [byte]; writers make chunks of some megabytes."""
# Limits of decompressed data: size [byte] and ratio to the compressed size. Data that claim to exceed both are
# damaged (a bomb). The limit of a chunk or message is lower than that of a file, because it is in memory as a
# whole, and more than once while it is decoded.
_PLAUSIBLE_BYTES, _PLAUSIBLE_RATIO, _PLAUSIBLE_CHUNK_RATIO = 1 << 26, 1000, 100
MAX_CHUNKS = 1 << 20
"""Most chunks of a file; with the usual chunks of a megabyte, this is a terabyte."""
MAX_CHANNELS = 1 << 16
"""Most channels or connections of a file: MCAP cannot number more."""
# Most records of a file, and fewest bytes per record: with more records, tcpipe rejects the file.
_FEW_RECORDS, _LEAST_RECORD_BYTES = 1 << 20, 4
_PLAUSIBLE_TOTAL = 1 << 30
_SEARCH_BYTES = 1 << 20

_PEEK_BYTES = 1 << 13

_BLOCK_BYTES = 1 << 13  # fetched ranges begin and end at multiples of this [byte]
# Size of the buffer of fetched ranges [byte]: larger than a group of chunks that is planned together.
_HELD_BLOCKS = (1 << 26) // _BLOCK_BYTES
_GAP_BLOCKS = 4  # blocks no further apart are fetched as one piece: a request costs as much as some


class DamageError(Exception):
    """A part of a file cannot be used; arguments as in `Damage`, with the cause "" if nothing is damaged."""

    def __init__(self, cause: str = "", reason: str = "") -> None:
        super().__init__(cause, reason)
        self.cause, self.reason = cause, reason


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """Messages of one channel inside one buffer; arrays have shape (N,). ``ordinal`` is their order within the file."""

    channel: int
    buffer: memoryview
    offsets: Ints
    lengths: Ints
    log_time_ns: Ints
    publish_time_ns: Ints
    ordinal: Ints


def group_by_key(keys: Ints) -> Iterator[tuple[int, Ints]]:
    """Yield each key, rising, and its positions, shape (M,) each, by one sort."""
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=keys[order[:1]] - 1))
    for start, end in zip(starts.tolist(), [*starts[1:].tolist(), len(order)], strict=False):
        yield int(keys[order[start]]), order[start:end]


def split_by_channel(buffer: memoryview, channel: Ints, *columns: Ints) -> list[MessageBlock]:
    """Return messages in one buffer as one block a channel; ``columns`` are the other fields of a block, in order."""
    return [MessageBlock(number, buffer, *(values[at] for values in columns)) for number, at in group_by_key(channel)]


class LogPart(ABC):
    """One file of a log, open for reading."""

    container: str
    """``mcap``, ``bag`` or ``rosbag2``."""
    channels: Mapping[int, Topic]
    """Every source of messages (a connection, channel or topic row) by its number."""
    outline = ""
    """A hash (hex) of the file's size and index, which distinguish it from any other log; "" without an index."""
    is_unchecked = False
    """Whether no checksum covers some of the bytes read."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.damage: list[Damage] = []
        """Damage that was found so far; it may have one place twice."""

    @abstractmethod
    def blocks(self, wanted: frozenset[int]) -> Iterator[MessageBlock]:
        """Yield the messages of the requested channels; damaged parts are recorded in ``damage`` and skipped."""

    @abstractmethod
    def close(self) -> None:
        """Close the file."""

    def _note(
        self,
        cause: str,
        offset: int | None = None,
        *,
        messages_lost: int | None = None,
        bytes_lost: int | None = None,
        reason: str = "",
    ) -> None:
        self.damage.append(Damage(cause, self.name, offset, None, messages_lost, bytes_lost, reason=reason))


class FetchedFile:
    """A file in object storage with its local placeholder."""

    def __init__(self, stored: StoredObject, stand_in: Path) -> None:
        self._stored, self._stand_in = stored, stand_in
        self._held: OrderedDict[int, memoryview] = OrderedDict()
        self.is_whole = False
        """Whether the placeholder contains the whole file by now."""

    def read(self, offset: int, size: int) -> bytes:
        """Return ``size`` bytes at ``offset``, fewer where the file ends before."""
        stop = min(offset + size, self._stored.size_bytes)
        if offset >= stop:
            return b""
        blocks = range(offset // _BLOCK_BYTES, -(-stop // _BLOCK_BYTES))
        block_by_number = self._blocks(blocks)
        first = offset - blocks.start * _BLOCK_BYTES
        return b"".join(block_by_number[number] for number in blocks)[first : first + stop - offset]

    def expect(self, pieces: Iterable[tuple[int, int]]) -> None:
        """Fetch pieces (offset, size) that will be read soon, in parallel."""
        most = -(-self._stored.size_bytes // _BLOCK_BYTES)
        wanted = {
            number
            for offset, size in pieces
            for number in range(offset // _BLOCK_BYTES, min(-(-(offset + size) // _BLOCK_BYTES), most))
        }
        self._blocks(wanted)

    def whole(self) -> None:
        """Fetch the whole file to its placeholder, which is empty before."""
        if not self.is_whole:
            self._stored.copy(self._stand_in)
            self.is_whole = True
            self._held.clear()

    def _blocks(self, numbers: Collection[int]) -> dict[int, memoryview]:
        """Return blocks by number; fetch missing ones."""
        blocks = {number: self._held[number] for number in numbers if number in self._held}
        for number in blocks:
            self._held.move_to_end(number)
        runs = _find_runs(sorted(set(numbers) - blocks.keys()))
        size = self._stored.size_bytes
        spans = [(run.start * _BLOCK_BYTES, min(run.stop * _BLOCK_BYTES, size)) for run in runs]
        for run, data in zip(runs, self._stored.ranges(spans) if spans else (), strict=True):
            blocks |= {
                number: data[(number - run.start) * _BLOCK_BYTES : (number + 1 - run.start) * _BLOCK_BYTES]
                for number in run
            }
        self._held.update(blocks)
        while len(self._held) > _HELD_BLOCKS:
            self._held.popitem(last=False)
        return blocks


def _find_runs(numbers: Sequence[int]) -> list[range]:
    """Return ranges that contain all of the sorted block numbers; ranges with a short gap between them are joined."""
    runs: list[range] = []
    for number in numbers:
        if runs and number - runs[-1].stop <= _GAP_BLOCKS:
            runs[-1] = range(runs[-1].start, number + 1)
        else:
            runs.append(range(number, number + 1))
    return runs


class ByteSource:
    """A file read by position; with ``fetched``, one in object storage, whose path is a placeholder until complete."""

    def __init__(self, path: Path, fetched: FetchedFile | None = None) -> None:
        self._file, self._fetched = path.open("rb"), fetched
        self.size = os.fstat(self._file.fileno()).st_size
        self._peeked = 0, b""

    def read(self, offset: int, size: int) -> memoryview:
        """Return ``size`` bytes at ``offset``; raise `DamageError` if the file ends before."""
        if size < 0 or offset + size > self.size:
            raise DamageError("file-cut")
        data = self._some(offset, size)
        while len(data) < size:
            more = self._some(offset + len(data), size - len(data))
            if not more:
                raise DamageError("file-cut")
            data += more
        return memoryview(data)

    def read_pieces(self, pieces: Sequence[tuple[int, memoryview]]) -> None:
        """Fill each view with the bytes at its offset; bytes between them are not read. `DamageError` as `read`."""
        self.skips()
        self.expect([(offset, len(view)) for offset, view in pieces])
        for offset, view in pieces:
            view[:] = self.read(offset, len(view))

    def peek(self, offset: int, size: int) -> bytes:
        """Return up to ``size`` bytes at ``offset`` (fewer at the end); fast for many small, mostly ascending reads."""
        at, held = self._peeked
        if offset < at or offset + size > at + len(held):
            at, held = self._peeked = offset, self._some(offset, max(size, _PEEK_BYTES))
            if len(held) < size and offset + len(held) < self.size:  # end of the readable part
                return bytes(self.read(offset, min(size, self.size - offset)))
        return held[offset - at : offset - at + size]

    def windows(self, start: int, end: int, overlap: int) -> Iterator[tuple[int, int, memoryview]]:
        """Yield (start, size, bytes) of windows to search; bytes reach ``overlap`` further; skip unreadable windows.

        Windows double in size from a small first one: an early match is cheap, also in a file that is made to need many
        searches.
        """
        size = 1 << 12
        while start < end:
            size = min(size, end - start)
            with suppress(DamageError):
                yield start, size, self.read(start, min(size + overlap, end - start))
            start, size = start + size, min(2 * size, _SEARCH_BYTES)

    def skips(self) -> None:
        """Tell the system that this file is read in parts: it should not read ahead."""
        os.posix_fadvise(self._file.fileno(), 0, 0, os.POSIX_FADV_RANDOM)

    def expect(self, pieces: Sequence[tuple[int, int]]) -> None:
        """Request pieces (offset, size) that will be read soon."""
        if self._fetched is not None and not self._fetched.is_whole:
            self._fetched.expect(pieces)
            return
        for offset, size in pieces:
            os.posix_fadvise(self._file.fileno(), offset, size, os.POSIX_FADV_WILLNEED)

    def whole(self) -> None:
        """Fetch the whole file, which is read from its beginning to its end."""
        if self._fetched is not None:
            self._fetched.whole()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _some(self, offset: int, size: int) -> bytes:
        """Return up to ``size`` bytes at ``offset``, at least one unless the file ends there."""
        if offset > self.size:  # also for offsets that no system call accepts
            return b""
        if self._fetched is not None and not self._fetched.is_whole:
            return self._fetched.read(offset, size)
        try:
            return os.pread(self._file.fileno(), size, offset)
        except OSError as error:
            raise DamageError("data-unreadable", str(error.strerror)) from None


def outline_of(size: int, index: bytes | memoryview) -> str:
    """Return a hash (hex) of a file's size [byte] and its index, which has the places and times of its chunks."""
    return hashlib.sha256(size.to_bytes(8, "little") + bytes(index)).hexdigest()


def join_hashes(hashes: Sequence[str]) -> str:
    """Return one hash (hex) of the hashes of several parts, in order; a single part's hash as it is."""
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()


def is_bomb(compressed_bytes: int, size: int, *, whole: bool = False) -> bool:
    """Return whether compressed bytes claim an implausible size; ``whole``: this size is needed in memory."""
    ratio = _PLAUSIBLE_CHUNK_RATIO if whole else _PLAUSIBLE_RATIO
    return size > _PLAUSIBLE_BYTES and size > ratio * compressed_bytes


class Bounds:
    """Limits of the content of a file of some size [byte]; `LogError` above them, before memory or time run out."""

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._size = path, size
        self.most_records = max(_FEW_RECORDS, size // _LEAST_RECORD_BYTES)
        self._seen: set[int] = set()
        self._records = 0

    def claim(self, chunk_sizes: Iterable[int]) -> None:
        """Check the total size that all chunks claim [byte]."""
        total = sum(min(size, MAX_CHUNK_BYTES) for size in chunk_sizes)
        if total > _PLAUSIBLE_TOTAL and is_bomb(self._size, total):
            raise self._bomb(f"its chunks claim to hold {total} bytes in {self._size}")

    def walk(self, chunk: int, records: int) -> None:
        """Add the number of records of a chunk, identified by its offset in the file, and check the total."""
        if chunk not in self._seen:
            self._seen.add(chunk)
            self._records += records
        if self._records > self.most_records:
            raise self._bomb(f"it contains more than {self.most_records} records in {self._size} bytes")

    def count(self, chunks: int, channels: int) -> None:
        """Check the number of chunks and channels."""
        for count, most, what in ((chunks, MAX_CHUNKS, "chunks"), (channels, MAX_CHANNELS, "topics or connections")):
            if count > most:
                raise self._bomb(f"it contains more than {most} {what}")

    def _bomb(self, why: str) -> LogError:
        return LogError(f"{self._path}: {why}; tcpipe rejects it as a decompression bomb")


def decompress(codec: str, data: memoryview, size: int, *, checked: bool = False) -> memoryview:
    """Decompress ``data`` to ``size`` bytes; `DamageError` if that fails, or gives another size.

    ``codec`` is ``lz4`` (frames), ``zstd`` or ``bz2``; ``checked``: a checksum of the result is compared afterwards.
    """
    if size > MAX_CHUNK_BYTES or is_bomb(len(data), size, whole=True):
        raise DamageError("record-damaged")
    _refuse_unknown(codec)
    try:
        # an LZ4 frame that is too short would leave old memory content, unless a checksum reveals that
        if codec == "zstd" or (codec == "lz4" and checked):
            return memoryview(pa.decompress(pa.py_buffer(data), size, codec=codec)).cast("B")
        with pa.CompressedInputStream(pa.BufferReader(pa.py_buffer(data)), codec) as stream:
            content = stream.read_buffer(size)
            more = stream.read(1)  # reads to the end, where checksums are compared
    except OSError:
        raise DamageError("chunk-damaged") from None
    if len(content) != size or more:
        raise DamageError("chunk-damaged")
    return memoryview(content).cast("B")


def _refuse_unknown(codec: str) -> None:
    if codec not in ("lz4", "zstd", "bz2"):
        raise DamageError("chunk-damaged")


def decompress_prefix(codec: str, data: memoryview, size: int) -> memoryview:
    """Return the first of ``size`` bytes, as far as the truncated ``data`` can be decompressed."""
    _refuse_unknown(codec)
    content = bytearray()
    try:
        with pa.CompressedInputStream(pa.BufferReader(pa.py_buffer(data)), codec) as stream:
            while len(content) < min(size, MAX_CHUNK_BYTES) and (piece := stream.read(4096)):
                content += piece
    except OSError:  # the cut is reached
        pass
    return memoryview(content)[:size]


def gather_integers(buffer: bytes | memoryview, offsets: Ints, code: str) -> Ints:
    """Return the little-endian integers (numpy's ``code``: ``u2``, ``u4``, ``i8``) at ``offsets``, of any alignment.

    The caller has checked the bounds. Unsigned 64-bit values are read as ``i8``: no length or time in a log reaches the
    sign bit, and one that claims to is negative, which every check refuses.
    """
    return gather_values(buffer, offsets, np.dtype("<" + code)).astype(np.int64)
