"""Tables of messages as numpy arrays, for the pure packages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.logs.placements import Transforms


def message_arrays(table: pa.Table) -> dict[str, NDArray[Any]]:
    """Return a table's columns: numbers as they are, texts as str, lists of numbers as (N, k) with NaN where a row is shorter.

    Columns of other kinds (lists of messages, null) are left out.
    """
    found: dict[str, NDArray[Any]] = {}
    for name in table.column_names:
        array = _combined(table.column(name))
        kind = array.type
        if pa.types.is_string(kind) or pa.types.is_large_string(kind):
            found[name] = array.to_numpy(zero_copy_only=False).astype(str)
        elif _is_number(kind):
            found[name] = array.to_numpy(zero_copy_only=False)
        elif _is_list(kind) and _is_number(kind.value_type):
            found[name] = _matrix(array)
    return found


def _combined(column: pa.ChunkedArray) -> pa.Array:
    combined = column.combine_chunks()
    return combined if isinstance(combined, pa.Array) else pa.concat_arrays(combined.chunks)


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind))


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _matrix(lists: pa.Array) -> NDArray[np.float64]:
    lengths = pc.list_value_length(lists).to_numpy(zero_copy_only=False).astype(np.int64)
    values: NDArray[np.float64] = pc.list_flatten(lists).to_numpy(zero_copy_only=False).astype(np.float64, copy=False)
    if pa.types.is_fixed_size_list(lists.type):
        return values.reshape(len(lengths), lists.type.list_size)
    if len(lengths) and lengths.min() == lengths.max():
        return values.reshape(len(lengths), -1)
    matrix = np.full((len(lengths), int(lengths.max(initial=0))), np.nan)
    matrix[np.arange(matrix.shape[1]) < lengths[:, None]] = values
    return matrix


def transforms(table: pa.Table) -> Transforms:
    """Return all transforms of a tf2_msgs/TFMessage table, message after message."""
    flat = pc.list_flatten(_combined(table.column("transforms")))

    def texts(*path: str) -> list[str]:
        found: list[str] = pc.struct_field(flat, list(path)).to_pylist()
        return found

    def numbers(name: str, components: str) -> NDArray[np.float64]:
        parts = [pc.struct_field(flat, ["transform", name, component]) for component in components]
        return np.stack([part.to_numpy(zero_copy_only=False).astype(np.float64) for part in parts], -1)

    return Transforms(
        texts("header", "frame_id"), texts("child_frame_id"), numbers("translation", "xyz"), numbers("rotation", "xyzw")
    )
