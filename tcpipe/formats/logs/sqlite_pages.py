"""The pages of a clean SQLite file, cut or not, read without SQLite: https://www.sqlite.org/fileformat2.html, sections 1.5 to 2.1.

A table is a B-tree of pages; its leaves hold rows as cells: payload size and row id (varints), then the payload: a header of varints that
give each column's type, then the columns. What does not fit in a page goes on in a chain of overflow pages. All cells of many leaves are
parsed at once here, so that a message costs no step of its own. A page that contradicts itself or the tree above it (its cells do not
fill it, ids that the page above does not allow) raises `UnusualError`, and the caller leaves the file to SQLite; a row that contradicts
itself is counted.

What it is worth: so a .db3 is read 6 to 10 times as fast as by rosbags, by SQLite alone, a row at a time, 2.1 to 2.7 times
(``python benchmarks/read_logs.py --only other``). It goes when SQLite alone comes to 5 times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.logs.log_part import Int64Array, gathered

MAGIC = b"SQLite format 3\0"

_HEADER_BYTES = 100
_LEAF, _INTERIOR = 0x0D, 0x05
_LEAF_HEAD, _INTERIOR_HEAD = 8, 12
_MAX_DEPTH = 20
_LEAVES_AT_ONCE = 4096
_SMALL_BYTES = np.array([0, 1, 2, 3, 4, 6, 8, 8, 0, 0], np.int64)
"""Bytes of a column by its serial type: NULL, integers, a float, and the constants 0 and 1."""
_FLOAT, _LAST_INTEGER, _FIRST_BLOB = 7, 9, 12
_CELL_HEAD = 32
"""Bytes of a cell that hold all its varints, of a table of no more than `MAX_COLUMNS`."""
MAX_COLUMNS = 6
"""Payload size and row id take 9 bytes at most, header and data 5, what other columns there are 2 each: 32 bytes."""
_VARINT_BYTES = 9
_NO_BOUND = 2**63 - 1


class UnusualError(Exception):
    """The file is not of the plain kind that is read here."""


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of a table that are messages: row id and integer columns, and where the blob lies; ``lost`` counts those that are none.

    ``offsets`` is where the blob begins in the file, ``lengths`` its size, ``local`` how many bytes of it lie there; the rest is in the
    overflow chain that begins at page ``overflow`` (0 where there is none). All of shape (N,).
    """

    ids: Int64Array
    integers: tuple[Int64Array, ...]
    offsets: Int64Array
    lengths: Int64Array
    local: Int64Array
    overflow: Int64Array
    lost: int = 0

    def chosen(self, which: Int64Array | NDArray[np.bool_]) -> Rows:
        """Return the rows of these numbers."""
        integers = tuple(values[which] for values in self.integers)
        where = self.offsets[which], self.lengths[which], self.local[which], self.overflow[which]
        return Rows(self.ids[which], integers, *where)


@dataclass(frozen=True, slots=True)
class Leaves:
    """Leaf pages by number, and between which row ids (above the first, up to the second) theirs lie, shape (N,) each."""

    pages: Int64Array
    above: Int64Array
    until: Int64Array


def _grouped(leaves: Leaves) -> list[Leaves]:
    cuts = [slice(start, start + _LEAVES_AT_ONCE) for start in range(0, len(leaves.pages), _LEAVES_AT_ONCE)]
    return [Leaves(leaves.pages[cut], leaves.above[cut], leaves.until[cut]) for cut in cuts]


def _is_loaded(starts: Int64Array, ends: Int64Array) -> None:
    """Bytes in memory need not be loaded."""


class PageReader:
    """One file, as pages.

    Parameters
    ----------
    data
        The file.
    load
        Called before any of it is looked at, with where the pieces start, rising, and end in it, shape (N,); may raise `UnusualError`.
    cut
        Whether its last pages are missing: then of a table what lies in the others is found by `leaves_here`.
    """

    def __init__(
        self, data: memoryview, load: Callable[[Int64Array, Int64Array], None] = _is_loaded, *, cut: bool = False
    ) -> None:
        self._data = data
        self._load = load
        load(np.array([0]), np.array([_HEADER_BYTES]))
        head = bytes(data[:_HEADER_BYTES])
        page_bytes = int.from_bytes(head[16:18], "big")
        self.page_bytes = 65536 if page_bytes == 1 else page_bytes
        self._usable = self.page_bytes - (head[20] if len(head) > 20 else 0)
        claimed = int.from_bytes(head[28:32], "big")
        pages = min(claimed, len(data) // max(self.page_bytes, 1)) if cut else claimed
        plain = (
            head.startswith(MAGIC)
            and self.page_bytes >= 512
            and self.page_bytes.bit_count() == 1
            and self._usable >= 480
            and head[24:28] == head[92:96]  # else the page count is not to be trusted
            and (pages > 0 if cut else pages * self.page_bytes == len(data))
        )
        if not plain:
            raise UnusualError
        self._chained = np.zeros(pages + 1, np.bool_)
        self._octets: NDArray[np.uint8] = np.frombuffer(data, np.uint8, pages * self.page_bytes)
        # A page that no table uses keeps what it held; one of an overflow chain begins with the number of the next.
        self._is_told_by_kind = not any(head[36:40]) and claimed < _LEAF << 24
        self._pages = self._octets.reshape(pages, self.page_bytes)

    def leaves(self, root: int) -> list[Leaves]:
        """Return a table's leaf pages, given its root's number, by rising row id, in groups of some thousand.

        Raises
        ------
        UnusualError
            Something does not look as a plain table does.
        """
        level, until = np.array([root], np.int64), np.array([_NO_BOUND], np.int64)
        for _ in range(_MAX_DEPTH):
            self._check(level)
            if (level == 1).any():
                break
            self.load(level[:1])
            if self._pages[level[0] - 1, 0] == _LEAF:  # all leaves lie equally deep
                return _grouped(Leaves(level, np.append(-_NO_BOUND - 1, until[:-1]), until))
            self.load(level)
            level, until = self._children(level, until)
        raise UnusualError

    def leaves_here(self, kinds: NDArray[np.uint8], others: Iterable[int]) -> list[Leaves]:
        """Return the leaf pages of the one table that is not among ``others``, in the order of the file, in groups of some thousand.

        Of a cut file: a page above them may be missing. `rows` raises where ids do not rise in that order, as they do in a recording.

        Parameters
        ----------
        kinds
            The first byte of each page.
        others
            Roots of all other tables.

        Raises
        ------
        UnusualError
            Pages do not tell what they are of, or another table cannot be read.
        """
        self.load(np.array([1]))
        if (
            not self._is_told_by_kind or self._octets[_HEADER_BYTES] != _LEAF
        ):  # else leaves of the first page's tree are elsewhere
            raise UnusualError
        theirs = [np.zeros(0, np.int64), *(leaves.pages for root in others for leaves in self.leaves(root))]
        pages = np.setdiff1d(np.flatnonzero(kinds == _LEAF) + 1, np.concatenate(theirs))
        return _grouped(Leaves(pages, np.full(len(pages), -_NO_BOUND - 1), np.full(len(pages), _NO_BOUND)))

    def _children(self, level: Int64Array, until: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Return the pages below interior ones, and up to which row id each goes."""
        counts, cells = self._cells(level, _INTERIOR, _INTERIOR_HEAD)
        keys, ends = _varints(self._heads(cells + 4), 1)
        self._expect_filled(level, counts, cells, 4 + ends[0])
        children, bounds = np.empty((2, len(cells) + len(level)), np.int64)
        last = np.cumsum(counts + 1) - 1
        left = np.ones(len(children), np.bool_)
        left[last] = False
        children[left], bounds[left] = _big_endian(self._data, cells), keys[0]
        children[last], bounds[last] = _big_endian(self._data, (level - 1) * self.page_bytes + 8), until
        _expect(bounds[1:] > bounds[:-1])
        return children, bounds

    def load(self, pages: Int64Array) -> None:
        """Have pages loaded, by their numbers; `UnusualError` where one cannot be."""
        starts = np.sort(pages - 1) * self.page_bytes
        self._load(starts, starts + self.page_bytes)

    def rows(self, leaves: Leaves, columns: int, integers: tuple[int, ...]) -> Rows:
        """Return the rows on leaf pages, which are loaded.

        Parameters
        ----------
        leaves
            The pages.
        columns
            How many columns a row has, at most `MAX_COLUMNS`: the first is the row id, the last the blob.
        integers
            Columns that are integers.

        Raises
        ------
        UnusualError
            Something does not look as in a plain table.
        """
        counts, cells = self._cells(leaves.pages, _LEAF, _LEAF_HEAD)
        numbers, ends = _varints(self._heads(cells), 3 + columns)
        sizes, ids, header_bytes, *kinds = numbers
        payloads = cells + ends[1]
        _expect((ends[1] > 0) & (sizes >= 0) & (sizes <= len(self._octets)))
        local_ends = payloads + self._local_bytes(sizes)
        spilled = local_ends < payloads + sizes
        self._expect_filled(leaves.pages, counts, cells, np.maximum(local_ends + 4 * spilled - cells, 4))
        _expect(ids[1:] > ids[:-1])
        _expect((ids > np.repeat(leaves.above, counts)) & (ids <= np.repeat(leaves.until, counts)))
        positions = [payloads + header_bytes]
        for kind in kinds:
            positions.append(positions[-1] + _column_bytes(kind))
        blobs = positions[-2]
        right = (cells + ends[-1] == positions[0]) & (positions[-1] == payloads + sizes) & (blobs <= local_ends)
        right &= (kinds[-1] >= _FIRST_BLOB) & (kinds[-1] % 2 == 0) & (np.array(kinds) >= 0).all(axis=0)
        for column in integers:
            right &= (kinds[column] >= 1) & (kinds[column] <= _LAST_INTEGER) & (kinds[column] != _FLOAT)
        overflow = np.zeros(len(cells), np.int64)
        if spilled.any():
            overflow[spilled] = _big_endian(self._data, local_ends[spilled])
        found = {column: self._integers(positions[column + 1], kinds[column], right) for column in set(integers)}
        values = tuple(found[column] for column in integers)
        every = Rows(ids, values, blobs, payloads + sizes - blobs, local_ends - blobs, overflow)
        return every if right.all() else replace(every.chosen(right), lost=int((~right).sum()))

    def begin(self) -> None:
        """Begin to read blobs anew: from here on no overflow page may belong to two of them."""
        self._chained[:] = False

    def blobs(self, rows: Rows, *, again: bool = False) -> tuple[memoryview, Int64Array]:
        """Return the blobs of rows, overflow and all, in one buffer, and where each begins there.

        Raises
        ------
        UnusualError
            A chain leads nowhere, does not end where its blob does, or shares a page with another one; with ``again`` it may.
        """
        starts = np.cumsum(rows.lengths) - rows.lengths
        buffer = np.empty(int(rows.lengths.sum()), np.uint8)
        for start, offset, local in zip(starts.tolist(), rows.offsets.tolist(), rows.local.tolist(), strict=True):
            buffer[start : start + local] = self._octets[offset : offset + local]
        room = self._usable - 4
        windows: NDArray[np.void] = np.ndarray((max(len(buffer) - room + 1, 0),), f"V{room}", buffer, 0, (1,))
        going = rows.overflow > 0
        pages, left, to = rows.overflow[going], (rows.lengths - rows.local)[going], (starts + rows.local)[going]
        self._load_chains(pages, -(-left // room))
        expected = pages
        visited = []
        while len(pages):
            self._check(pages)
            visited.append(pages)
            if (pages != expected).any():
                self.load(pages[pages != expected])
            full = left >= room
            windows[to[full]] = np.ascontiguousarray(self._pages[pages[full] - 1, 4 : self._usable]).view(f"V{room}")[
                :, 0
            ]
            for page, size, at in zip(pages[~full].tolist(), left[~full].tolist(), to[~full].tolist(), strict=True):
                buffer[at : at + size] = self._pages[page - 1, 4 : 4 + size]
            going = left > room
            expected = pages[going] + 1
            following = _big_endian(self._data, (pages - 1) * self.page_bytes)
            _expect((following == 0) | going)
            pages, left, to = following[going], left[going] - room, to[going] + room
        every = np.concatenate([pages, *visited])
        if not again:
            _expect(np.append(~self._chained[every], len(np.unique(every)) == len(every)))
            self._chained[every] = True
        return buffer.data, starts

    def _load_chains(self, pages: Int64Array, counts: Int64Array) -> None:
        """Have the overflow pages loaded that begin chains, and those behind them, where the rest of a chain lies as a rule."""
        self._check(pages)
        order = np.argsort(pages)
        starts = (pages[order] - 1) * self.page_bytes
        self._load(starts, starts + counts[order] * self.page_bytes)

    def _cells(self, pages: Int64Array, kind: int, head_bytes: int) -> tuple[Int64Array, Int64Array]:
        """Return the number of cells of each page of a kind, and the file offset of each cell."""
        starts = (pages - 1) * self.page_bytes
        _expect(self._octets[starts] == kind)
        counts = _swapped(gathered(self._data, starts + 3, "u2"))
        _expect(head_bytes + 2 * counts <= self._usable)
        owners = np.repeat(starts, counts)
        within = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
        pointers = _swapped(gathered(self._data, owners + head_bytes + 2 * within, "u2"))
        _expect((pointers >= head_bytes) & (pointers <= self._usable - 4))
        return counts, owners + pointers

    def _expect_filled(self, pages: Int64Array, counts: Int64Array, cells: Int64Array, sizes: Int64Array) -> None:
        """Expect cells of ``sizes`` bytes to lie apart, and to fill their pages but for the room that these call free.

        A cell that is missing from its page's list is seen here.
        """
        starts = (pages - 1) * self.page_bytes
        owners = np.repeat(np.arange(len(pages)), counts)
        _expect(cells + sizes <= starts[owners] + self._usable)
        order = np.lexsort((cells, owners))
        together = owners[1:] == owners[:-1]
        _expect(((cells + sizes)[order][:-1] <= cells[order][1:]) | ~together)
        content = _swapped(gathered(self._data, starts + 5, "u2"))
        content[content == 0] = 1 << 16
        free = self._octets[starts + 7].astype(np.int64)
        blocks = _swapped(gathered(self._data, starts + 1, "u2"))
        for page in np.flatnonzero(blocks).tolist():
            free[page] += self._free_bytes(int(starts[page]), int(blocks[page]))
        filled = np.bincount(owners, sizes, len(pages)).astype(np.int64)
        _expect(filled + free == self._usable - content)

    def _free_bytes(self, start: int, block: int) -> int:
        """Return the size of a page's chain of free blocks (section 1.6 of the format)."""
        free = 0
        while block:
            if block > self._usable - 4:
                raise UnusualError
            following, size = (
                int.from_bytes(self._data[start + block + at : start + block + at + 2], "big") for at in (0, 2)
            )
            if size < 4 or block + size > self._usable or 0 < following < block + size:
                raise UnusualError
            free, block = free + size, following
        return free

    def _local_bytes(self, sizes: Int64Array) -> Int64Array:
        """Return how many bytes of each payload lie in the leaf (section 1.6 of the format)."""
        most, least = self._usable - 35, (self._usable - 12) * 32 // 255 - 23
        fitting = least + (sizes - least) % (self._usable - 4)
        return np.where(sizes <= most, sizes, np.where(fitting <= most, fitting, least))

    def _heads(self, cells: Int64Array) -> NDArray[np.uint8]:
        """Return the first bytes of each cell, shape (N, _CELL_HEAD); at the file's very end zeros follow."""
        last = len(self._octets) - _CELL_HEAD
        following = (cells + _CELL_HEAD - 1) // self.page_bytes
        crossing = (following > cells // self.page_bytes) & (cells <= last)
        if crossing.any():
            self.load(np.unique(following[crossing]) + 1)
        windows: NDArray[np.void] = np.ndarray((last + 1,), f"V{_CELL_HEAD}", self._data, 0, (1,))
        heads = windows[np.minimum(cells, last)].view(np.uint8).reshape(-1, _CELL_HEAD)
        for row in np.flatnonzero(cells > last).tolist():
            short = self._octets[cells[row] :]
            heads[row] = 0
            heads[row, : len(short)] = short
        return heads

    def _integers(self, ends: Int64Array, kinds: Int64Array, right: NDArray[np.bool_]) -> Int64Array:
        """Return integer columns that end at ``ends``: big-endian two's complement of 1 to 8 bytes, or a constant; 0 where not right."""
        ends, kinds = np.where(right, ends, 8), np.where(right, kinds, 8)
        constant = (kinds == 8) | (kinds == 9)
        unused_bits = 64 - 8 * _SMALL_BYTES[np.minimum(kinds, 6)]
        values = gathered(self._data, ends - 8, "i8").byteswap() << unused_bits >> unused_bits
        return np.where(constant, kinds - 8, values) if constant.any() else values

    def _check(self, pages: Int64Array) -> None:
        _expect((pages >= 1) & (pages <= len(self._pages)))


def _varints(heads: NDArray[np.uint8], count: int) -> tuple[Int64Array, Int64Array]:
    """Return the first ``count`` varints of each row of ``heads``, and where each ends, shapes (count, N).

    Those that do not end within their row are -1, and end at 0. Rows whose varints are equally long go together, so that a byte of all of
    them is one column.
    """
    numbers, ends = np.zeros((2, count, len(heads)), np.int64)
    alike: list[tuple[slice | Int64Array, int, int, int]] = [(slice(None), 0, 0, 0)] if len(heads) else []
    while alike:
        rows, number, start, at = alike.pop()
        if number == count:
            continue
        if at == heads.shape[1]:
            numbers[number:, rows], ends[number:, rows] = -1, 0
            continue
        octets = heads[rows, at]
        last = at - start == _VARINT_BYTES - 1  # of nine bytes, the last has eight bits
        numbers[number, rows] = numbers[number, rows] << (8 if last else 7) | octets & (0xFF if last else 0x7F)
        ends[number, rows] = at + 1
        going = octets >= 0x80
        if last or not going.any():
            alike.append((rows, number + 1, at + 1, at + 1))
        elif going.all():
            alike.append((rows, number, start, at + 1))
        else:
            every = np.arange(len(heads))[rows]
            alike += [(every[going], number, start, at + 1), (every[~going], number + 1, at + 1, at + 1)]
    return numbers, ends


def _expect(plain: NDArray[np.bool_]) -> None:
    if not plain.all():
        raise UnusualError


def _swapped(values: Int64Array) -> Int64Array:
    """Return 16-bit integers, read in the wrong byte order, in the right one."""
    return values >> 8 | (values & 0xFF) << 8


def _big_endian(data: memoryview, offsets: Int64Array) -> Int64Array:
    """Return the big-endian 32-bit integers at ``offsets``."""
    return gathered(data, offsets, "u4").astype(np.uint32).byteswap().astype(np.int64)


def _column_bytes(kinds: Int64Array) -> Int64Array:
    """Return the size of columns by their serial types; 10 and 11 are not used in files, and fit nowhere, as negative ones."""
    small = np.where((kinds < 0) | (kinds > _LAST_INTEGER), 1 << 40, _SMALL_BYTES[np.clip(kinds, 0, 9)])
    return np.where(kinds < _FIRST_BLOB, small, np.minimum(kinds - _FIRST_BLOB, 1 << 41) // 2)
