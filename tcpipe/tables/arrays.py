"""Arrow columns as numpy arrays and back, over Arrow's buffers: pyarrow's own conversions import pandas wherever it is installed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray


def numbers(column: pa.Array | pa.ChunkedArray) -> NDArray[Any]:
    """Return a column of numbers or truth values, shape (N,), perhaps read-only; whole numbers with nulls as float64, null as NaN."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if pa.types.is_boolean(array.type) and not array.null_count:
        return np.from_dlpack(array.cast(pa.uint8())).view(np.bool_)
    if array.null_count:
        known, kind = numbers(array.is_valid()), array.type if pa.types.is_floating(array.type) else pa.float64()
        array = array.cast(kind)
        bare = pa.Array.from_buffers(kind, len(array), [None, array.buffers()[1]], offset=array.offset)
        return np.where(known, np.from_dlpack(bare), np.array(np.nan, kind.to_pandas_dtype()))
    return np.from_dlpack(array)


def texts(column: pa.Array | pa.ChunkedArray) -> NDArray[np.str_]:
    """Return a column of texts, shape (N,)."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    encoded = array.dictionary_encode(null_encoding="encode")
    found: NDArray[np.str_] = np.array(encoded.dictionary.to_pylist(), np.str_)[numbers(encoded.indices)]
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


def text_column(values: Iterable[str]) -> pa.Array:
    """Return an Arrow array of texts; `pyarrow.ArrowInvalid` beyond 2 GB."""
    raw = [value.encode() for value in values]
    ends = np.cumsum([0, *map(len, raw)], dtype=np.int64)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(raw))]
    return pa.Array.from_buffers(pa.large_string(), len(raw), buffers).cast(pa.string())


def rows_where(table: pa.Table, name: str, value: str | int) -> pa.Table:
    """Return the rows whose column ``name`` holds ``value``."""
    column = table.column(name)
    held = texts(column) if isinstance(value, str) else numbers(column)
    return table.filter(number_column(held == value))
