"""Where the fields of irregular messages lie: all messages are walked side by side, one cursor each, field after field.

`tcpipe.logs.wire_layout` serves messages of which many have one shape. Where nearly every message has a shape of its own (diagnostics,
lists of texts) each step here reads one field of all messages at once: the cursors read the length where they stand and move on, each by
its own distance. The n-th elements of all lists are one step too. What comes out says where each value lies; nothing is copied here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.logs.wire_layout import Dialect, RaggedError
from tcpipe.logs.wire_types import Array, Record, Scalar, Text, WireType

Int64Array = NDArray[np.int64]

_MAX_STEPS = 20_000
"""A walk of more steps is given up: a few endless lists among short ones are cheaper to read one by one."""


@dataclass(frozen=True, slots=True)
class Scalars:
    """Scalars at ``offsets``, shape (M,)."""

    offsets: Int64Array
    dtype: np.dtype[np.generic]


@dataclass(frozen=True, slots=True)
class Runs:
    """``lengths`` bytes each at ``offsets``, shape (M,), rising: scalars side by side (numpy's type), or a text (Python's encoding)."""

    offsets: Int64Array
    lengths: Int64Array
    kind: np.dtype[np.generic] | str


@dataclass(frozen=True, slots=True)
class Fields:
    """The fields of ``count`` records."""

    count: int
    fields: tuple[Values, ...]


@dataclass(frozen=True, slots=True)
class Lists:
    """M lists of ``counts`` elements each; ``elements`` are those of all lists, one list after the other."""

    counts: Int64Array
    elements: Values


Values = Scalars | Runs | Fields | Lists


@dataclass(frozen=True, slots=True)
class WalkResult:
    """What a walk found; ``fits`` (N,) says which messages fit their definition: the values are those of these only."""

    root: Fields | None
    fits: NDArray[np.bool_]


def walk(
    message: Record, data: NDArray[np.uint8], starts: Int64Array, ends: Int64Array, dialect: Dialect
) -> WalkResult:
    """Find every field of every message; `RaggedError` where they are so unlike that they are cheaper to read one by one.

    Parameters
    ----------
    data : bytes that hold all messages. In CDR the byte behind each message's header lies at a multiple of 8.
    starts, ends : where each message begins and ends, shape (N,), rising.
    """
    fits = np.ones(len(starts), np.bool_)
    while fits.any():
        cursors = _Cursors(data, starts[fits], ends[fits], dialect)
        root = cursors.record(message, np.arange(int(fits.sum())))
        left = cursors.ends - cursors.positions
        good = cursors.good & (left >= 0) & (left <= dialect.padding)
        if good.all():
            return WalkResult(root, fits)
        fits[fits] = good
    return WalkResult(None, fits)


class _Cursors:
    """One position in each message; a message that does not fit is marked, and stands still."""

    def __init__(self, data: NDArray[np.uint8], starts: Int64Array, ends: Int64Array, dialect: Dialect) -> None:
        self.positions, self.ends = starts + dialect.origin, ends
        self.good = self.positions <= ends
        self._data, self._dialect, self._steps = data, dialect, 0
        self._counts: NDArray[np.void] = np.ndarray(
            (max(len(data) - 3, 0),), "V4", data if len(data) > 3 else b"", 0, (1,)
        )

    def values(self, of: WireType, rows: Int64Array) -> Values:
        """Step over one value in each of the ``rows``."""
        self._steps += 1
        if self._steps > _MAX_STEPS:
            raise RaggedError(f"more than {_MAX_STEPS} steps")
        match of:
            case Scalar():
                dtype = np.dtype(self._dialect.byte_order + of.code)
                return Scalars(self.take(rows, dtype.itemsize, dtype.itemsize), dtype)
            case Text():
                lengths = self.count(rows)
                if of.wide:
                    lengths *= of.wide.step
                    return Runs(self.take(rows, lengths, 1), lengths, of.wide.codec(self._dialect.byte_order))
                offsets = self.take(rows, lengths, 1)
                return Runs(offsets, np.maximum(lengths - self._dialect.terminator, 0), "utf-8")
            case Record():
                return self.record(of, rows)
            case Array():
                return self.array(of, rows)

    def record(self, of: Record, rows: Int64Array) -> Fields:
        if not of.fields:
            self.take(rows, self._dialect.empty_record_bytes, 1)
        return Fields(len(rows), tuple(self.values(field, rows) for _, field in of.fields))

    def array(self, of: Array, rows: Int64Array) -> Values:
        counts = self.count(rows) if of.length is None else np.full(len(rows), of.length, np.int64)
        endless = counts > self.ends[rows] - self.positions[rows]  # an element takes a byte at least
        if endless.any():
            self.good[rows[endless]] = False
            counts = np.where(endless, 0, counts)
        if isinstance(of.element, Scalar):
            dtype = np.dtype(self._dialect.byte_order + of.element.code)
            sizes = counts * dtype.itemsize
            return Runs(self.take(rows, sizes, np.where(counts > 0, dtype.itemsize, 1)), sizes, dtype)
        return Lists(counts, self.regular(of.element, rows, counts) or self.elements(of.element, rows, counts))

    def elements(self, of: Text | Record, rows: Int64Array, counts: Int64Array) -> Values:
        """Step over the first elements of all lists, then over the second ones, and so on."""
        if not counts.any():
            return self.values(of, rows[:0])
        pieces, places = [], []
        starts = np.cumsum(counts) - counts
        for index in range(int(counts.max())):
            longer = np.flatnonzero(counts > index)
            pieces.append(self.values(of, rows[longer]))
            places.append(starts[longer] + index)
        order = np.empty(int(counts.sum()), np.int64)
        order[np.concatenate(places)] = np.arange(len(order))
        return _join_values(pieces, order)

    def regular(self, of: Text | Record, rows: Int64Array, counts: Int64Array) -> Values | None:
        """Step over all elements at once where each takes the same room wherever it stands; None where they do not."""
        size, alignment = _find_regular_size(of, self._dialect.max_alignment)
        if not size or counts.max(initial=0) < 2:
            return None
        first = self.take(rows, counts * size, np.where(counts > 0, alignment, 1))
        owners = np.repeat(np.arange(len(rows)), counts)
        offsets = first[owners] + size * (np.arange(len(owners)) - (np.cumsum(counts) - counts)[owners])
        inside = _Cursors(self._data, offsets - self._dialect.origin, offsets + size, self._dialect)
        return inside.values(of, np.arange(len(owners)))

    def count(self, rows: Int64Array) -> Int64Array:
        offsets = self.take(rows, 4, 4)
        good = self.good[rows]
        if good.all():
            return self._counts[offsets].view(self._dialect.byte_order + "u4").astype(np.int64)
        found = np.zeros(len(rows), np.int64)
        found[good] = self._counts[offsets[good]].view(self._dialect.byte_order + "u4")
        return found

    def take(self, rows: Int64Array, sizes: int | Int64Array, alignment: int | Int64Array) -> Int64Array:
        """Move over ``sizes`` bytes after alignment; return where they begin."""
        mask = np.minimum(alignment, self._dialect.max_alignment) - 1
        offsets: Int64Array = (self.positions[rows] + mask) & ~mask
        after = offsets + sizes
        past = after > self.ends[rows]
        if past.any():
            self.good[rows[past]] = False
            after = np.where(past, self.positions[rows], after)
        self.positions[rows] = after
        return offsets


def _join_values(pieces: Sequence[Values], order: Int64Array) -> Values:
    """Concatenate values and put them in order: the n-th is number ``order[n]`` of the concatenation."""
    match pieces[0]:
        case Scalars(dtype=dtype):
            return Scalars(np.concatenate([p.offsets for p in pieces if isinstance(p, Scalars)])[order], dtype)
        case Runs(kind=kind):
            runs = [p for p in pieces if isinstance(p, Runs)]
            offsets, lengths = (
                np.concatenate(of)[order] for of in zip(*((r.offsets, r.lengths) for r in runs), strict=True)
            )
            return Runs(offsets, lengths, kind)
        case Fields():
            columns = zip(*(p.fields for p in pieces if isinstance(p, Fields)), strict=True)
            return Fields(len(order), tuple(_join_values(column, order) for column in columns))
        case Lists():
            lists = [p for p in pieces if isinstance(p, Lists)]
            counts = np.concatenate([p.counts for p in lists])
            starts, chosen = np.cumsum(counts) - counts, counts[order]
            within = np.arange(int(chosen.sum())) - np.repeat(np.cumsum(chosen) - chosen, chosen)
            return Lists(chosen, _join_values([p.elements for p in lists], np.repeat(starts[order], chosen) + within))


def _find_regular_size(of: WireType, max_alignment: int) -> tuple[int, int]:
    """Return size and alignment of a type whose values follow one another without padding between them; (0, 1) for others."""
    match of:
        case Scalar():
            size = np.dtype(of.code).itemsize
            return size, min(size, max_alignment)
        case Record() if of.fields:
            parts = [_find_regular_size(field, max_alignment) for _, field in of.fields]
            alignment = parts[0][1]
            position = 0
            for size, own in parts:
                if not size or own > alignment or position % own:
                    return 0, 1
                position += size
            return (position, alignment) if position % alignment == 0 else (0, 1)
        case Array() if of.length:
            size, alignment = _find_regular_size(of.element, max_alignment)
            return size * of.length, alignment
        case _:
            return 0, 1
