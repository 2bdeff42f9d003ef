"""Arrow columns as numpy arrays and back, over Arrow's buffers: pyarrow's own conversions import pandas wherever it is installed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray


def to_numbers(column: pa.Array | pa.ChunkedArray) -> NDArray[Any]:
    """Return a column of numbers or truth values, shape (N,), perhaps read-only; whole numbers with nulls as float64, null as NaN."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if pa.types.is_boolean(array.type) and not array.null_count:
        return np.from_dlpack(array.cast(pa.uint8())).view(np.bool_)
    if array.null_count:
        known, kind = to_numbers(array.is_valid()), array.type if pa.types.is_floating(array.type) else pa.float64()
        array = array.cast(kind)
        bare = pa.Array.from_buffers(kind, len(array), [None, array.buffers()[1]], offset=array.offset)
        return np.where(known, np.from_dlpack(bare), np.array(np.nan, kind.to_pandas_dtype()))
    return np.from_dlpack(array)


def to_texts(column: pa.Array | pa.ChunkedArray) -> NDArray[np.str_]:
    """Return a column of texts, shape (N,)."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    encoded = array.dictionary_encode(null_encoding="encode")
    found: NDArray[np.str_] = np.array(encoded.dictionary.to_pylist(), np.str_)[to_numbers(encoded.indices)]
    return found


def number_column(values: NDArray[Any], *, nan_is_null: bool = False) -> pa.Array:
    """Return an Arrow array over numbers or truth values, shape (N,)."""
    if values.dtype == np.bool_:
        packed = np.packbits(values.view(np.uint8) != 0, bitorder="little")
        return pa.Array.from_buffers(pa.bool_(), values.size, [None, pa.py_buffer(packed)])
    values = np.ascontiguousarray(values, values.dtype.newbyteorder("="))
    known = ~np.isnan(values) if nan_is_null else np.ones(1, np.bool_)
    valid = None if known.all() else pa.py_buffer(np.packbits(known, bitorder="little"))
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), values.size, [valid, pa.py_buffer(values)])


def make_text_column(values: Iterable[str]) -> pa.Array:
    """Return an Arrow array of texts; `pyarrow.ArrowInvalid` beyond 2 GB."""
    raw = [value.encode() for value in values]
    ends = np.cumsum([0, *map(len, raw)], dtype=np.int64)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(raw))]
    return pa.Array.from_buffers(pa.large_string(), len(raw), buffers).cast(pa.string())


def select_rows(table: pa.Table, name: str, value: str | int) -> pa.Table:
    """Return the rows whose column ``name`` holds ``value``; the table itself where all do."""
    column = table.column(name)
    chosen = (to_texts(column) if isinstance(value, str) else to_numbers(column)) == value
    return table if chosen.all() else table.filter(number_column(chosen))


def encode_rows(table: pa.Table, names: Sequence[str]) -> list[bytes]:
    """Return the values of 64-bit columns row by row, to be compared bit by bit."""
    columns = [to_numbers(table.column(name)).view(np.int64) for name in names]
    return [row.tobytes() for row in np.column_stack(columns)]


_POINT, _LINE_STRING = 1, 2
_LITTLE_ENDIAN = 1


def make_lines(start_deg: NDArray[np.float64], end_deg: NDArray[np.float64]) -> pa.Array:
    """Return the straight lines between points x, y, shape (N, 2) each, as LineStrings; null where an end is not known (NaN)."""
    ends = np.unwrap(np.stack([start_deg, end_deg], axis=1), axis=1, period=360.0)  # short on the date line too
    rows = np.zeros(len(ends), [("order", "u1"), ("kind", "<u4"), ("points", "<u4"), ("xy", "<f8", (2, 2))])
    rows["order"], rows["kind"], rows["points"], rows["xy"] = _LITTLE_ENDIAN, _LINE_STRING, 2, ends
    return _make_column(rows)


def make_points(xy_deg: NDArray[np.float64]) -> pa.Array:
    """Return points x, y, shape (N, 2), as Points; null where one is not known (NaN)."""
    rows = np.zeros(len(xy_deg), [("order", "u1"), ("kind", "<u4"), ("xy", "<f8", (2,))])
    rows["order"], rows["kind"], rows["xy"] = _LITTLE_ENDIAN, _POINT, xy_deg
    return _make_column(rows)


def _make_column(rows: NDArray[np.void]) -> pa.Array:
    """Return records of one size as a binary column."""
    known = np.isfinite(rows["xy"]).all(axis=tuple(range(1, rows["xy"].ndim)))
    ends = np.concatenate([[0], np.cumsum(known * rows.itemsize)]).astype(np.int32)
    valid = pa.py_buffer(np.packbits(known, bitorder="little"))
    return pa.Array.from_buffers(
        pa.binary(), len(rows), [valid, pa.py_buffer(ends), pa.py_buffer(rows[known].tobytes())]
    )
