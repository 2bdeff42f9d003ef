"""Arrow arrays from bytes: the building blocks of `tcpipe.formats.logs.arrow_columns`, and the columns of messages."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.logs.wire_cursors import Fields, Grid, Int64Array, Lists, Runs, Scalars, Values
from tcpipe.logs.wire_types import Array, Record, Scalar, Text, WireType
from tcpipe.tables.arrays import number_column


def find_arrow_type(of: WireType) -> pa.DataType:
    """Return the Arrow type: arrays become lists (fixed-size ones where the definition fixes it), messages structs."""
    match of:
        case Scalar():
            return pa.bool_() if of.code == "?" else pa.from_numpy_dtype(np.dtype(of.code))
        case Text():
            return pa.string()
        case Record():
            return pa.struct([pa.field(name, find_arrow_type(field)) for name, field in of.fields])
        case Array():
            return pa.list_(find_arrow_type(of.element), of.length or -1)


def make_texts(count: int, offsets: pa.Buffer, raw: pa.Buffer) -> tuple[pa.StringArray, int]:
    """Return texts from Arrow's offsets and their bytes, and how many are no UTF-8: what is no character is replaced."""
    found = pa.StringArray.from_buffers(count, offsets, raw)
    if not (np.frombuffer(raw, np.uint8) & 0x80).any():
        return found, 0
    try:
        found.validate(full=True)
    except pa.ArrowInvalid:
        pieces = found.cast(pa.binary()).to_pylist()
        decoded = [piece.decode(errors="replace") for piece in pieces]
        replaced = sum(text.encode() != piece for text, piece in zip(decoded, pieces, strict=True))
        return pa.array(decoded, pa.string()), replaced
    return found, 0


def make_lists(values: pa.Array, counts: Int64Array, length: int | None) -> pa.Array:
    """Return ``values`` as lists of ``counts`` elements; ``length`` is given where the definition fixes it."""
    if length:
        return pa.FixedSizeListArray.from_arrays(values, length)
    offsets = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=offsets[1:])
    return pa.Array.from_buffers(pa.list_(values.type), len(counts), [None, pa.py_buffer(offsets)], children=[values])


class WalkedColumns:
    """Builds the columns of messages that `tcpipe.logs.wire_cursors` has walked; ``data`` is what it walked over."""

    def __init__(self, data: NDArray[np.uint8]) -> None:
        self.replaced_texts = 0
        self._data = data

    def columns(self, root: Fields, of: Record) -> Iterator[pa.Array]:
        """Yield the columns in the order of the definition; nested messages unfold, arrays stay whole."""
        for values, (_, field) in zip(root.fields, of.fields, strict=True):
            if isinstance(values, Fields) and isinstance(field, Record):
                yield from self.columns(values, field)
            else:
                yield self._array(values, field)

    def _array(self, values: Values, of: WireType) -> pa.Array:
        match values, of:
            case Fields(), Record():
                children = [
                    self._array(child, field) for child, (_, field) in zip(values.fields, of.fields, strict=True)
                ]
                return pa.Array.from_buffers(find_arrow_type(of), values.count, [None], children=children)
            case Lists(), Array():
                return make_lists(self._array(values.elements, of.element), values.counts, of.length)
            case Runs(dtype=np.dtype() as dtype), Array():
                elements = number_column(np.frombuffer(self._compact(values)[1], dtype))
                return make_lists(elements, values.lengths // dtype.itemsize, of.length)
            case Runs(), Text():
                found, replaced = make_texts(len(values.lengths), *self._compact(values))
                self.replaced_texts += replaced
                return found
            case Scalars(places=Grid() as grid, dtype=dtype), Scalar():
                return number_column(grid.view(self._data, dtype))
            case Scalars(places=np.ndarray() as offsets, dtype=dtype), Scalar():
                shape = (max(len(self._data) - dtype.itemsize + 1, 0),)
                windows: NDArray[np.void] = np.ndarray(
                    shape, f"V{dtype.itemsize}", self._data if shape[0] else b"", 0, (1,)
                )
                return number_column(windows[offsets].view(dtype))
        raise TypeError(f"{type(values).__name__} are no values of {of}")

    def _compact(self, runs: Runs) -> tuple[pa.Buffer, pa.Buffer]:
        """Copy runs together; return Arrow's offsets and the bytes.

        As runs rise, their bounds are those of an Arrow array in which every other element is a gap: `take` leaves the gaps out.
        """
        count = len(runs.lengths)
        if isinstance(runs.places, Grid):
            length = int(runs.lengths[0])
            copied = runs.places.view(self._data, np.dtype(np.uint8), length)
            return pa.py_buffer((np.arange(count + 1) * length).astype(np.int32)), pa.py_buffer(copied)
        bounds = np.empty(2 * count, np.int32)
        bounds[0::2], bounds[1::2] = runs.places, runs.places + runs.lengths
        if not count:
            return pa.py_buffer(np.zeros(1, np.int32)), pa.py_buffer(b"")
        buffers = [None, pa.py_buffer(bounds), pa.py_buffer(self._data)]
        everything = pa.Array.from_buffers(pa.binary(), 2 * count - 1, buffers)
        _, offsets, raw = everything.take(number_column(np.arange(0, 2 * count, 2))).buffers()
        return offsets, raw
