"""Tables of messages as numpy arrays, for the pure packages."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.logs.placements import Transforms
from tcpipe.tables.arrays import numbers, texts


def message_arrays(table: pa.Table, in_lists: Collection[str] = ()) -> dict[str, NDArray[Any]]:
    """Return a table's columns: numbers as they are, texts as str, lists of numbers as (N, k) with NaN where a row is shorter.

    Columns of other kinds (lists of messages, null) are left out, but for the numbers inside lists of messages that ``in_lists`` names
    (``drivers[].current``): those are (N, k) as well.
    """
    found: dict[str, NDArray[Any]] = {}
    for name in table.column_names:
        array = _combined(table.column(name))
        kind = array.type
        if pa.types.is_string(kind) or pa.types.is_large_string(kind):
            found[name] = texts(array)
        elif _is_number(kind):
            found[name] = numbers(array)
        elif _is_list(kind) and _is_number(kind.value_type):
            found[name] = _matrix(array)
    for path in in_lists:
        name, _, inner = path.partition("[].")
        if (
            name in table.column_names
            and (values := _inside(_combined(table.column(name)), inner.split("."))) is not None
        ):
            found[path] = values
    return found


def _inside(lists: pa.Array, path: list[str]) -> NDArray[np.float64] | None:
    """Return a number of every message in lists of messages, shape (N, k); None where there is no such number."""
    kind = lists.type.value_type if _is_list(lists.type) else pa.null()
    for name in path:
        index = kind.get_field_index(name) if pa.types.is_struct(kind) else -1
        if index < 0:
            return None
        kind = kind.field(index).type
    if not _is_number(kind):
        return None
    return _filled(numbers(pc.list_value_length(lists)).astype(np.int64), pc.struct_field(pc.list_flatten(lists), path))


def _combined(column: pa.ChunkedArray) -> pa.Array:
    combined = column.combine_chunks()
    return combined if isinstance(combined, pa.Array) else pa.concat_arrays(combined.chunks)


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind))


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _matrix(lists: pa.Array) -> NDArray[np.float64]:
    if pa.types.is_fixed_size_list(lists.type):
        values: NDArray[np.float64] = numbers(pc.list_flatten(lists)).astype(np.float64, copy=False)
        return values.reshape(len(lists), lists.type.list_size)
    return _filled(numbers(pc.list_value_length(lists)).astype(np.int64), pc.list_flatten(lists))


def _filled(lengths: NDArray[np.int64], flat: pa.Array) -> NDArray[np.float64]:
    values: NDArray[np.float64] = numbers(flat).astype(np.float64, copy=False)
    if len(lengths) and lengths.min() == lengths.max():
        return values.reshape(len(lengths), -1)
    matrix = np.full((len(lengths), int(lengths.max(initial=0))), np.nan)
    matrix[np.arange(matrix.shape[1]) < lengths[:, None]] = values
    return matrix


def transforms(table: pa.Table) -> Transforms:
    """Return all transforms of a tf2_msgs/TFMessage table, message after message."""
    flat = pc.list_flatten(_combined(table.column("transforms")))

    def names(*path: str) -> list[str]:
        found: list[str] = pc.struct_field(flat, list(path)).to_pylist()
        return found

    def vectors(name: str, components: str) -> NDArray[np.float64]:
        parts = [pc.struct_field(flat, ["transform", name, component]) for component in components]
        return np.stack([numbers(part).astype(np.float64) for part in parts], -1)

    return Transforms(
        names("header", "frame_id"), names("child_frame_id"), vectors("translation", "xyz"), vectors("rotation", "xyzw")
    )
