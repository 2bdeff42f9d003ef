"""Layout of messages by their definition, as a tree of scalars, texts, arrays and records; parser of definitions.

Both ROS 1 serialisation and CDR write these types field after field.

A .msg definition (http://wiki.ros.org/msg, and ROS 2's bounds and defaults) in a log contains the message first, then
every message it is made of, each below a line of ``=`` and ``MSG: package/Name``. Constants, defaults and comments do
not matter for reading.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from tcpipe.arrays import Bytes, GenericArray, Ints, Mask, gather_values, number_within
from tcpipe.logs.topics import normalize_type_name

MAX_COLUMNS = 20_000
"""Most leaves of an unfolded definition [1]; a larger one is refused (nested arrays grow exponentially)."""


@dataclass(frozen=True, slots=True)
class Scalar:
    """A number or a truth value; ``code`` is numpy's, without byte order (``u1``, ``f8``, ``?``)."""

    code: str


@dataclass(frozen=True, slots=True)
class Text:
    """A length-prefixed string in UTF-8."""


@dataclass(frozen=True, slots=True)
class Record:
    """A message: named fields in wire order, and their total number of columns."""

    name: str
    fields: tuple[tuple[str, WireType], ...]
    leaves: int


@dataclass(frozen=True, slots=True)
class Array:
    """``length`` elements; if it is None, a count precedes them."""

    element: Scalar | Text | Record
    length: int | None


WireType = Scalar | Text | Record | Array


def count_leaves(wire_type: WireType) -> int:
    """Return the number of columns of the type; an array counts its element once."""
    match wire_type:
        case Record():
            return wire_type.leaves
        case Array():
            return count_leaves(wire_type.element)
        case _:
            return 1


def make_record(name: str, fields: tuple[tuple[str, WireType], ...]) -> Record:
    """Make a record; how wide it unfolds follows from its fields."""
    return Record(name, fields, sum(count_leaves(field_type) for _, field_type in fields))


def iterate_flat_fields(record: Record, prefix: str = "") -> Iterator[tuple[str, WireType]]:
    """Yield the columns of a message: nested messages unfold into dotted names, arrays stay whole."""
    for name, wire_type in record.fields:
        if isinstance(wire_type, Record):
            yield from iterate_flat_fields(wire_type, f"{prefix}{name}.")
        else:
            yield prefix + name, wire_type


BASE_TYPES = frozenset(
    [
        *("bool", "byte", "char", "string", "wstring", "float32", "float64"),
        *("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"),
    ]
)
_KNOWN_AS = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
_SECTION = re.compile(r"(?<!=)={40,}+[ \t]*+\nMSG:[ \t]*+([\w/]++)[ \t]*+\n")
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=(?P<limit>\d+))?(?P<array>\[(?P<most><=)?(?P<size>\d*)\])?[ \t]+(?P<name>[A-Za-z]\w*)[ \t]*(?P<rest>.*)"
)


class MsgTextError(ValueError):
    """A line is no field, constant or comment."""


@dataclass(frozen=True, slots=True)
class FieldType:
    """A field's type: a base type, or the full name of a message.

    ``text_limit`` is the most characters of a text (0: any number); ``length`` is None for one value, else the number
    of elements: the exact number if ``fixed``, otherwise the largest number (0: any number).
    """

    name: str
    text_limit: int = 0
    length: int | None = None
    fixed: bool = False


FieldTypes = tuple[tuple[str, FieldType], ...]


def parse_msg(text: str, type_name: str) -> dict[str, FieldTypes]:
    """Return the fields of each message in a definition by full name; `MsgTextError` if a line is no field."""
    pieces = _SECTION.split(text.replace("\r\n", "\n") + "\n")
    names = [type_name, *map(normalize_type_name, pieces[1::2])]
    return {
        name: _parse_fields(lines, name) for name, lines in zip(reversed(names), reversed(pieces[0::2]), strict=True)
    }


def _parse_fields(lines: str, owner: str) -> FieldTypes:
    fields = []
    for line in lines.splitlines():
        line = line.strip()  # noqa: PLW2901
        if not line or line.startswith(("#", "@")):
            continue
        found = _FIELD.fullmatch(line)
        if found is None:
            raise MsgTextError(f"{owner}: {line[:60]!r} is no field")
        if not found["rest"].startswith("="):
            fields.append((found["name"], _parse_field_type(found, owner)))
    return tuple(fields)


def _parse_field_type(found: re.Match[str], owner: str) -> FieldType:
    name = found["type"]
    if name not in BASE_TYPES:
        name = _KNOWN_AS.get(name, name)
        name = f"{owner.rsplit('/', 1)[0]}/{name}" if "/" not in name else normalize_type_name(name)
    if found["limit"] and name not in ("string", "wstring"):
        raise MsgTextError(f"{owner}: only strings have a length bound, not {name}")
    limit = int(found["limit"] or 0)
    if not found["array"]:
        return FieldType(name, limit)
    if found["most"] and not found["size"]:
        raise MsgTextError(f"{owner}: {found['name']} has an empty length bound")
    fixed = bool(found["size"]) and not found["most"]
    return FieldType(name, limit, int(found["size"] or 0), fixed)


_MAX_ELEMENTS = 20_000  # most texts or irregular messages of a list: they are found one after the other [1]


class LayoutError(ValueError):
    """Messages do not fit their definition: a length runs past their end, or bytes are left over."""


@dataclass(frozen=True, slots=True)
class Dialect:
    """How messages are serialised, in little-endian byte order.

    Fields begin ``origin`` bytes into a message, are aligned from there to at most ``max_alignment``; texts end in
    ``terminator`` bytes that are no text; a message without fields takes ``empty_record_bytes``; up to ``padding``
    bytes may follow the last field.
    """

    origin: int
    max_alignment: int
    terminator: int
    empty_record_bytes: int
    padding: int


ROS1 = Dialect(0, 1, 0, 0, 0)
CDR = Dialect(4, 8, 1, 1, 3)
"""Plain CDR, version 1, the format of ROS 2 middlewares."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Offsets at equal distances: the first, and the number and distance along each axis."""

    first: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def view(self, data: Bytes, dtype: np.dtype[np.generic], count: int = 1) -> GenericArray:
        """Return a copy of ``count`` successive values from each offset, in the order of `list_offsets`."""
        together = dtype if count == 1 else np.dtype(f"V{count * dtype.itemsize}")  # one large copy is faster
        if not count:
            return np.zeros(0, dtype)
        found: GenericArray = np.ndarray(self.shape, together, data, self.first, self.strides)
        return found.copy().reshape(-1).view(dtype)

    def list_offsets(self) -> Ints:
        """Return all offsets, the last axis first."""
        offsets = np.full(1, self.first, np.int64)
        for count, stride in zip(self.shape, self.strides, strict=True):
            offsets = (offsets[:, None] + stride * np.arange(count)).ravel()
        return offsets


Places = Ints | Grid
"""Offsets of the M values of a field, as an array (M,) or a grid."""


@dataclass(frozen=True, slots=True)
class Scalars:
    """Scalars at their places."""

    places: Places
    dtype: np.dtype[np.generic]


@dataclass(frozen=True, slots=True)
class Runs:
    """``lengths`` bytes each, shape (M,), equal in a grid: scalars side by side, or a text (``dtype`` None)."""

    places: Places
    lengths: Ints
    dtype: np.dtype[np.generic] | None


@dataclass(frozen=True, slots=True)
class Fields:
    """The fields of ``count`` records."""

    count: int
    fields: tuple[Values, ...]


@dataclass(frozen=True, slots=True)
class Lists:
    """M lists of ``counts`` elements each; ``elements`` are those of all lists, one list after the other."""

    counts: Ints
    elements: Values


Values = Scalars | Runs | Fields | Lists


@dataclass(frozen=True, slots=True)
class WalkResult:
    """Values of the messages that fit their definition; ``fits``, (N,), marks these messages."""

    root: Fields | None
    fits: Mask


def walk(message: Record, data: Bytes, starts: Ints, ends: Ints, dialect: Dialect) -> WalkResult:
    """Find every field of every message.

    Each begins and ends in ``data`` at ``starts`` and ``ends``, shape (N,), rising.
    """
    fits = np.ones(len(starts), bool)
    while fits.any():
        bases, sizes = starts[fits] + dialect.origin, ends[fits] - starts[fits] - dialect.origin
        steps = np.diff(bases)
        places: Places = bases
        if (sizes == sizes[0]).all() and (steps == steps[:1]).all():  # at equal distances
            places = Grid(int(bases[0]), (len(bases),), (int(steps[0]) if len(steps) else 1,))
        cursors = _Cursors(data, places, sizes, dialect)
        try:
            root = cursors.record(message, np.arange(len(sizes)))
        except LayoutError:  # it represents all of them
            break
        good = cursors.find_finished()
        if good.all():
            return WalkResult(root, fits)
        fits[fits] = good
    return WalkResult(None, np.zeros(len(starts), bool))


class _Cursors:
    """A position in each message, from the begin of its fields; a message that does not fit is marked and skipped.

    While ``_bases`` is a grid, messages have one size, ``_at`` is the position in all of them, and one that does not
    fit is an error.
    """

    def __init__(self, data: Bytes, bases: Places, sizes: Ints, dialect: Dialect) -> None:
        self._data, self._bases, self._sizes, self._dialect = data, bases, sizes, dialect
        self._at = 0
        self._positions, self._good = np.zeros(len(sizes), np.int64), sizes >= 0

    def find_finished(self) -> Mask:
        """Return which messages fit, and have no more bytes left than may follow the last field."""
        left = self._sizes - (self._at if isinstance(self._bases, Grid) else self._positions)
        return self._good & (left >= 0) & (left <= self._dialect.padding)

    def values(self, wire_type: WireType, rows: Ints) -> Values:
        """Step over one value in each of the ``rows``: all messages, none, or some of those without a grid."""
        match wire_type:
            case Scalar():
                dtype = np.dtype("<" + wire_type.code)
                return Scalars(self.take(rows, dtype.itemsize, dtype.itemsize), dtype)
            case Text():
                lengths = self.count(rows)
                kept = np.maximum(lengths - self._dialect.terminator, 0)
                return Runs(self.take(rows, lengths, 1), np.broadcast_to(kept, len(rows)), None)
            case Record():
                return self.record(wire_type, rows)
            case Array():
                return self.array(wire_type, rows)

    def record(self, record: Record, rows: Ints) -> Fields:
        if not record.fields:  # CDR has no empty structures: rosidl puts one byte there
            self.take(rows, self._dialect.empty_record_bytes, 1)
        return Fields(len(rows), tuple(self.values(field, rows) for _, field in record.fields))

    def array(self, array: Array, rows: Ints) -> Values:
        counts = self.count(rows) if array.length is None else array.length
        is_regular = _find_regular_size(array.element, self._dialect.max_alignment)[0] > 0
        most = np.inf if is_regular else _MAX_ELEMENTS
        if isinstance(self._bases, Grid) and len(rows):
            if counts > min(self._sizes[0] - self._at, most):  # an element takes a byte at least
                raise LayoutError(f"{counts} elements")
        else:
            endless = counts > np.minimum(self._sizes[rows] - self._positions[rows], most)
            self._good[rows[endless]] = False
            counts = np.where(endless, 0, counts)
        if isinstance(array.element, Scalar):
            dtype = np.dtype("<" + array.element.code)
            sizes = counts * dtype.itemsize
            places = self.take(rows, sizes, np.where(counts > 0, dtype.itemsize, 1))
            return Runs(places, np.broadcast_to(sizes, len(rows)), dtype)
        each = np.broadcast_to(counts, len(rows))
        return Lists(each, self.regular(array.element, rows, each) or self.elements(array.element, rows, each))

    def elements(self, element: Text | Record, rows: Ints, counts: Ints) -> Values:
        """Step over the first elements of all lists, then over the second ones, and so on."""
        if not counts.any():
            return self.values(element, rows[:0])
        pieces, places = [], []
        starts = np.cumsum(counts) - counts
        for index in range(int(counts.max())):
            longer = np.flatnonzero(counts > index)
            pieces.append(self.values(element, rows[longer]))
            places.append(starts[longer] + index)
        order = np.empty(int(counts.sum()), np.int64)
        order[np.concatenate(places)] = np.arange(len(order))
        return _join_values(pieces, order)

    def regular(self, element: Text | Record, rows: Ints, counts: Ints) -> Values | None:
        """Skip all elements in one step if they have equal sizes at any alignment; None otherwise."""
        size, stride, alignment = _find_regular_size(element, self._dialect.max_alignment)
        if not size or counts.max(initial=0) < 2:
            return None
        sizes = np.where(counts > 0, stride * (counts - 1) + size, 0)
        is_grid = isinstance(self._bases, Grid)
        begin = self.take(
            rows, int(sizes[0]) if is_grid else sizes, alignment if is_grid else np.where(counts > 0, alignment, 1)
        )
        places: Places
        if isinstance(begin, Grid):
            places = Grid(begin.first, (*begin.shape, int(counts[0])), (*begin.strides, stride))
        else:
            owners = np.repeat(np.arange(len(rows)), counts)
            places = begin[owners] + stride * number_within(counts)
        total = int(counts.sum())
        return _Cursors(self._data, places, np.full(total, size), self._dialect).values(element, np.arange(total))

    def count(self, rows: Ints) -> int | Ints:
        """Step over a length in each row; return them, as one number where all messages have the same."""
        places, dtype = self.take(rows, 4, 4), np.dtype("<u4")
        if isinstance(places, Grid):
            counts = places.view(self._data, dtype).astype(np.int64)
            if (counts == counts[0]).all():
                return int(counts[0])
            self._positions[:] = self._at  # from here on each has its own
            self._bases = _list_offsets(self._bases)
            return counts
        good = self._good[rows]
        found = np.zeros(len(rows), np.int64)
        found[good] = gather_values(self._data, places[good], dtype)
        return found

    def take(self, rows: Ints, sizes: int | Ints, alignment: int | Ints) -> Places:
        """Skip ``sizes`` bytes after alignment; return the offset of their start."""
        if not len(rows):
            return rows
        mask = np.minimum(alignment, self._dialect.max_alignment) - 1
        if isinstance(self._bases, Grid):
            begin = int((self._at + mask) & ~mask)
            if begin + sizes > self._sizes[0]:
                raise LayoutError(f"byte {begin + sizes}")
            self._at = int(begin + sizes)
            return Grid(self._bases.first + begin, self._bases.shape, self._bases.strides)
        offsets: Ints = (self._positions[rows] + mask) & ~mask
        after = offsets + sizes
        past = after > self._sizes[rows]
        if past.any():
            self._good[rows[past]] = False
            after = np.where(past, self._positions[rows], after)
        self._positions[rows] = after
        return offsets + self._bases[rows]


def _list_offsets(places: Places) -> Ints:
    return places.list_offsets() if isinstance(places, Grid) else places


def _join_values(pieces: Sequence[Values], order: Ints) -> Values:
    """Concatenate values and put them in order: the n-th is number ``order[n]`` of the concatenation."""
    match pieces[0]:
        case Scalars(dtype=dtype):
            scalars = [_list_offsets(p.places) for p in pieces if isinstance(p, Scalars)]
            return Scalars(np.concatenate(scalars)[order], dtype)
        case Runs(dtype=dtype):
            runs = [(_list_offsets(p.places), p.lengths) for p in pieces if isinstance(p, Runs)]
            offsets, lengths = (np.concatenate(parts)[order] for parts in zip(*runs, strict=True))
            return Runs(offsets, lengths, dtype)
        case Fields():
            columns = zip(*(p.fields for p in pieces if isinstance(p, Fields)), strict=True)
            return Fields(len(order), tuple(_join_values(column, order) for column in columns))
        case Lists():
            lists = [p for p in pieces if isinstance(p, Lists)]
            counts = np.concatenate([p.counts for p in lists])
            starts, chosen = np.cumsum(counts) - counts, counts[order]
            rows = np.repeat(starts[order], chosen) + number_within(chosen)
            return Lists(chosen, _join_values([p.elements for p in lists], rows))


@cache
def _find_regular_size(wire_type: WireType, max_alignment: int) -> tuple[int, int, int]:
    """Return size, distance and alignment of consecutive values if they are the same everywhere; else (0, 0, 1).

    They are where the first field has the largest alignment.
    """
    match wire_type:
        case Scalar():
            size = np.dtype(wire_type.code).itemsize
            return size, size, min(size, max_alignment)
        case Record() if wire_type.fields:
            parts = [_find_regular_size(field, max_alignment) for _, field in wire_type.fields]
            alignment = parts[0][2]
            position = 0
            for size, _, own in parts:
                if not size or own > alignment:
                    return 0, 0, 1
                position += -position % own + size
            return position, position + -position % alignment, alignment
        case Array() if wire_type.length:
            size, stride, alignment = _find_regular_size(wire_type.element, max_alignment)
            return (stride * (wire_type.length - 1) + size if size else 0), 0, alignment
        case _:
            return 0, 0, 1
