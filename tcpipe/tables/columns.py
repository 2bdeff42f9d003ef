"""A column with its unit and meaning, and a table schema that checks Arrow tables against its columns.

The Arrow field metadata contain units, frames, flag bits and one-line meanings, so that every Parquet file explains itself.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntFlag

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.errors import TableError
from tcpipe.tables.arrays import make_text_column, number_column, to_numbers
from tcpipe.tables.bits import flag_name


@dataclass(frozen=True, slots=True)
class Column:
    """One column: name (its suffix is the unit), Arrow type, unit, meaning, frame, whether null is allowed, flag bits."""

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
        """Raise `TableError` naming every column that is missing, extra (unless ``more`` is welcome), of a wrong type, or null in vain."""
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


def to_floats(table: pa.Table, name: str) -> NDArray[np.float64]:
    """Return a column as float64, null as NaN, shape (N,)."""
    values: NDArray[np.float64] = to_numbers(table.column(name)).astype(np.float64, copy=False)
    return values


def read_lonlat_deg(table: pa.Table, end: str) -> NDArray[np.float64]:
    """Return longitude and latitude of the ``start`` or ``end`` of segments [deg], null as NaN, shape (N, 2)."""
    return np.stack([to_floats(table, f"{end}_{axis}_deg") for axis in ("lon", "lat")], axis=1)


def read_float_columns(table: pa.Table) -> dict[str, NDArray[np.float64]]:
    """Return the columns of floating-point numbers by name, as `to_floats`."""
    return {field.name: to_floats(table, field.name) for field in table.schema if pa.types.is_floating(field.type)}


def to_integers(table: pa.Table, name: str) -> NDArray[np.int64]:
    """Return a column without nulls as int64, shape (N,)."""
    values: NDArray[np.int64] = to_numbers(table.column(name)).astype(np.int64, copy=False)
    return values


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
