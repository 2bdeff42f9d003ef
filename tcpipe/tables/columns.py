"""A column with its unit and meaning, and a table schema that checks Arrow tables against its columns.

Arrow field metadata contain units, frames, flag bits and one-line meanings, so that every Parquet file explains itself.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.arrays import AnyArray, Floats, Ints, Texts
from tcpipe.errors import TableError
from tcpipe.tables.bits import flag_name

Tables: TypeAlias = Mapping[str, pa.Table]
"""By role or topic."""


def to_numbers(column: pa.Array | pa.ChunkedArray) -> AnyArray:
    """Return a numeric or Boolean column, shape (N,), possibly read-only; integers with nulls as float64, null: NaN."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if pa.types.is_boolean(array.type) and not array.null_count:
        return np.from_dlpack(array.cast(pa.uint8())).view(np.bool_)
    if array.null_count:
        known, kind = to_numbers(array.is_valid()), array.type if pa.types.is_floating(array.type) else pa.float64()
        array = array.cast(kind)
        bare = pa.Array.from_buffers(kind, len(array), [None, array.buffers()[1]], offset=array.offset)
        return np.where(known, np.from_dlpack(bare), np.array(np.nan, kind.to_pandas_dtype()))
    return np.from_dlpack(array)


def to_texts(column: pa.Array | pa.ChunkedArray) -> Texts:
    """Return a column of texts, shape (N,)."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    encoded = array.dictionary_encode(null_encoding="encode")
    return np.array(encoded.dictionary.to_pylist(), np.str_)[to_numbers(encoded.indices)]


def number_column(values: AnyArray, *, nan_is_null: bool = False) -> pa.Array:
    """Return an Arrow array over numbers or truth values, shape (N,)."""
    if values.dtype == np.bool_:
        packed = np.packbits(values.view(np.uint8) != 0, bitorder="little")
        return pa.Array.from_buffers(pa.bool_(), values.size, [None, pa.py_buffer(packed)])
    values = np.ascontiguousarray(values, values.dtype.newbyteorder("="))
    known = ~np.isnan(values) if nan_is_null else np.ones(1, bool)
    valid = None if known.all() else pa.py_buffer(np.packbits(known, bitorder="little"))
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), values.size, [valid, pa.py_buffer(values)])


def make_text_column(values: Iterable[str]) -> pa.Array:
    """Return an Arrow array of texts; `pyarrow.ArrowInvalid` beyond 2 GB."""
    raw = [value.encode() for value in values]
    ends = np.cumsum([0, *map(len, raw)], dtype=np.int64)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(raw))]
    return pa.Array.from_buffers(pa.large_string(), len(raw), buffers).cast(pa.string())


def select_rows(table: pa.Table, name: str, value: str | int) -> pa.Table:
    """Return the rows whose column ``name`` has the value ``value``; the table itself if all have it."""
    column = table.column(name)
    chosen = (to_texts(column) if isinstance(value, str) else to_numbers(column)) == value
    return table if chosen.all() else table.filter(number_column(chosen))


def encode_rows(table: pa.Table, names: Sequence[str]) -> list[bytes]:
    """Return the values of 64-bit columns row by row, to be compared bit by bit."""
    columns = [to_numbers(table.column(name)).view(np.int64) for name in names]
    return [row.tobytes() for row in np.column_stack(columns)]


_POINT, _LINE_STRING = 1, 2
_LITTLE_ENDIAN = 1


def make_lines(start_deg: Floats, end_deg: Floats) -> pa.Array:
    """Return the straight lines between points x, y, shape (N, 2) each, as LineStrings; null if an end is NaN."""
    ends = np.unwrap(np.stack([start_deg, end_deg], axis=1), axis=1, period=360.0)  # short on the date line too
    rows = np.zeros(len(ends), [("order", "u1"), ("kind", "<u4"), ("points", "<u4"), ("xy", "<f8", (2, 2))])
    rows["order"], rows["kind"], rows["points"], rows["xy"] = _LITTLE_ENDIAN, _LINE_STRING, 2, ends
    return _make_column(rows)


def make_points(xy_deg: Floats) -> pa.Array:
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


@dataclass(frozen=True, slots=True)
class Column:
    """Column: name (its suffix is the unit), Arrow type, unit, meaning, frame, whether null is allowed, flag bits."""

    name: str
    dtype: pa.DataType
    unit: str
    doc: str
    frame: str = ""
    nullable: bool = False
    flags: type[IntFlag] | None = None

    def field(self) -> pa.Field:
        """Return the Arrow field, with unit, frame, meaning and bit names as metadata."""
        metadata = {"unit": self.unit, "doc": self.doc}
        if self.frame:
            metadata["frame"] = self.frame
        if self.flags is not None:
            metadata["flags"] = json.dumps({str(int(bit)): flag_name(bit) for bit in self.flags})
        return pa.field(self.name, self.dtype, nullable=self.nullable, metadata=metadata)


@dataclass(frozen=True, slots=True)
class TableSchema:
    """A table's contract: its name, its level in the pipeline, its meaning and its columns."""

    name: str
    level: str
    doc: str
    columns: tuple[Column, ...]

    def arrow(self) -> pa.Schema:
        """Return the Arrow schema, field metadata included."""
        return pa.schema([column.field() for column in self.columns])

    def names(self) -> list[str]:
        """Return the column names in order."""
        return [column.name for column in self.columns]

    def table(self, **arrays: object) -> pa.Table:
        """Make a checked table from one array (numpy or Arrow) a column; NaN in nullable float columns becomes null."""
        if wrong := arrays.keys() ^ set(self.names()):
            raise TableError(f"table {self.name}: columns {', '.join(sorted(wrong))} are missing or not in its schema")
        columns = [_to_arrow(arrays[column.name], column) for column in self.columns]
        table = pa.Table.from_arrays(columns, schema=self.arrow())
        self.check(table)
        return table

    def empty(self) -> pa.Table:
        """Return the table without rows."""
        return pa.Table.from_batches([], self.arrow())

    def select_columns(self, *names: str) -> TableSchema:
        """Return the schema of some of the columns."""
        return replace(self, columns=tuple(column for column in self.columns if column.name in names))

    def check(self, table: pa.Table, *, more: bool = False) -> None:
        """Raise `TableError` with all columns missing, extra (unless ``more``), of a wrong type, or wrongly null."""
        problems = list(self.find_problems(table, more=more))
        if problems:
            raise TableError(*problems)

    def find_problems(self, table: pa.Table, *, more: bool = False) -> Iterable[str]:
        """Yield a line for each wrong column, as `check`."""
        for column in self.columns:
            if column.name not in table.column_names:
                yield f"table {self.name}: column {column.name} is missing (expected {column.dtype}, {column.unit})"
                continue
            got = table.schema.field(column.name).type
            data = table.column(column.name)
            if got != column.dtype:
                yield f"table {self.name}: column {column.name} is {got}, expected {column.dtype}"
            elif data.null_count and not column.nullable:
                yield f"table {self.name}: column {column.name} has {data.null_count} nulls, expected none"
            elif (
                pa.types.is_floating(got)
                and not pc.all(pc.is_finite(data.drop_null())).as_py()
                and len(data) > data.null_count
            ):
                yield f"table {self.name}: column {column.name} has values that are not finite"
        for name in table.column_names:
            if name not in self.names() and not more:
                yield f"table {self.name}: column {name} is not in its schema"


def to_floats(table: pa.Table, name: str) -> Floats:
    """Return a column as float64, null as NaN, shape (N,)."""
    return np.asarray(to_numbers(table.column(name)), float)


def stack_floats(table: pa.Table, *names: str) -> Floats:
    """Return columns side by side as float64, null as NaN, shape (N, columns)."""
    return np.stack([to_floats(table, name) for name in names], axis=1)


def read_lonlat_deg(table: pa.Table, end: str) -> Floats:
    """Return longitude and latitude of the ``start`` or ``end`` of segments [deg], null as NaN, shape (N, 2)."""
    return stack_floats(table, f"{end}_lon_deg", f"{end}_lat_deg")


def read_spans_ns(segments: pa.Table) -> tuple[Ints, Ints]:
    """Return start and end of segments [ns], shape (N,) each."""
    return to_integers(segments, "start_ns"), to_integers(segments, "end_ns")


def read_rise(segments: pa.Table) -> Floats:
    """Return the rise of the track over each segment per metre of its chord, shape (N,)."""
    return (to_floats(segments, "end_z_m") - to_floats(segments, "start_z_m")) / to_floats(segments, "chord_m")


def read_ends_deg(segments: pa.Table) -> tuple[Floats, Floats]:
    """Return longitude and latitude of start and end of segments [deg], null as NaN, (N, 2) each."""
    return read_lonlat_deg(segments, "start"), read_lonlat_deg(segments, "end")


def read_ends_m(segments: pa.Table) -> tuple[Floats, Floats]:
    """Return east and north of start and end of segments in their own frames [m], null as NaN, (N, 2) each."""
    return stack_floats(segments, "start_x_m", "start_y_m"), stack_floats(segments, "end_x_m", "end_y_m")


def read_float_columns(table: pa.Table) -> dict[str, Floats]:
    """Return the columns of floating-point numbers by name, as `to_floats`."""
    return {field.name: to_floats(table, field.name) for field in table.schema if pa.types.is_floating(field.type)}


def to_integers(table: pa.Table, name: str) -> Ints:
    """Return a column without nulls as int64, shape (N,)."""
    return np.asarray(to_numbers(table.column(name)), np.int64)


def _to_arrow(values: object, column: Column) -> pa.Array:
    if isinstance(values, pa.ChunkedArray):
        values = values.combine_chunks()
    if isinstance(values, pa.Array):
        return values if values.type == column.dtype else values.cast(column.dtype)
    wanted, array = column.dtype, np.asarray(values)
    if pa.types.is_string(wanted) and array.dtype.kind == "U":
        return make_text_column(array.tolist())
    if array.dtype.kind not in "biuf":
        return pa.array(values, type=wanted)
    return number_column(array, nan_is_null=column.nullable and array.dtype.kind == "f").cast(wanted)
