"""A file of a log that lies in object storage, read by range: pieces are fetched when they are asked for, and some of them are held.

What cannot be read by its index alone is fetched as a whole, to the file's stand-in on this machine.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Protocol

_BLOCK_BYTES = 1 << 13
"""What is fetched begins and ends at multiples of this."""
_HELD_BLOCKS = (1 << 26) // _BLOCK_BYTES
"""So much is held: more than a group of chunks that is planned at once."""
_GAP_BLOCKS = 4
"""Blocks no further apart are fetched as one piece: a request costs as much as some."""


class StoredBytes(Protocol):
    """What lies in object storage: `tcpipe.formats.object_storage.StoredObject`."""

    @property
    def size_bytes(self) -> int:
        """How long it is."""

    def ranges(self, spans: Sequence[tuple[int, int]]) -> list[memoryview]:
        """Return what lies from each start to its stop; `LogError` where it cannot be had, or has changed."""

    def copy(self, to: Path) -> None:
        """Write all of it to a file."""


class FetchedFile:
    """A file in object storage with its stand-in on this machine; safe to use by several threads."""

    def __init__(self, stored: StoredBytes, stand_in: Path) -> None:
        self._stored, self._stand_in = stored, stand_in
        self._held: OrderedDict[int, memoryview] = OrderedDict()
        self._lock = threading.Lock()
        self.is_whole = False
        """Whether the stand-in holds all of the file by now."""
        self.fetched_bytes = 0
        """How much was fetched so far."""

    def read(self, offset: int, size: int) -> bytes:
        """Return ``size`` bytes at ``offset``, fewer where the file ends before."""
        stop = min(offset + size, self._stored.size_bytes)
        if offset >= stop:
            return b""
        blocks = range(offset // _BLOCK_BYTES, -(-stop // _BLOCK_BYTES))
        found = self._blocks(blocks)
        first = offset - blocks.start * _BLOCK_BYTES
        return b"".join(found[number] for number in blocks)[first : first + stop - offset]

    def expect(self, pieces: Iterable[tuple[int, int]]) -> None:
        """Fetch pieces (offset, size) that are read soon, side by side."""
        most = -(-self._stored.size_bytes // _BLOCK_BYTES)
        wanted = {
            number
            for offset, size in pieces
            for number in range(offset // _BLOCK_BYTES, min(-(-(offset + size) // _BLOCK_BYTES), most))
        }
        self._blocks(wanted)

    def whole(self) -> None:
        """Fetch all of the file to its stand-in, which holds nothing before."""
        if not self.is_whole:
            self._stored.copy(self._stand_in)
            self.fetched_bytes += self._stored.size_bytes
            self.is_whole = True
            self._held.clear()

    def _blocks(self, numbers: Collection[int]) -> dict[int, memoryview]:
        """Return blocks by number; those that are not held are fetched."""
        with self._lock:
            found = {number: self._held[number] for number in numbers if number in self._held}
            for number in found:
                self._held.move_to_end(number)
        runs = _find_runs(sorted(set(numbers) - found.keys()))
        size = self._stored.size_bytes
        spans = [(run.start * _BLOCK_BYTES, min(run.stop * _BLOCK_BYTES, size)) for run in runs]
        for run, data in zip(runs, self._stored.ranges(spans) if spans else (), strict=True):
            found |= {
                number: data[(number - run.start) * _BLOCK_BYTES : (number + 1 - run.start) * _BLOCK_BYTES]
                for number in run
            }
        with self._lock:
            self.fetched_bytes += sum(stop - start for start, stop in spans)
            self._held.update(found)
            while len(self._held) > _HELD_BLOCKS:
                self._held.popitem(last=False)
        return found


def _find_runs(numbers: Sequence[int]) -> list[range]:
    """Return rising numbers as runs, short gaps filled."""
    runs: list[range] = []
    for number in numbers:
        if runs and number - runs[-1].stop <= _GAP_BLOCKS:
            runs[-1] = range(runs[-1].start, number + 1)
        else:
            runs.append(range(number, number + 1))
    return runs
