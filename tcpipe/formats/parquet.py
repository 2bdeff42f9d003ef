"""Parquet, written so that the same table gives the same bytes, and read back with its metadata.

Every page carries a checksum that is proved when it is read: damage is an error, never a number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from tcpipe.errors import StoreError
from tcpipe.formats.atomic import atomic_file

ROWS_PER_GROUP = 1 << 17
"""Rows of a group: what is decoded together."""
EMPTY_MEMBER = "structure_needs_at_least_one_member"


def write_table(table: pa.Table, path: Path) -> None:
    """Write ``table`` to ``path`` whole or not at all; zstd level 1 without dictionaries (half the default's time)."""
    with parquet_rows(path, table.schema) as write:
        write(table)


@contextmanager
def parquet_rows(path: Path, schema: pa.Schema) -> Iterator[Callable[[pa.Table], None]]:
    """Yield a function that adds rows to ``path``, each call a row group or more; the file appears at the end, whole or not at all."""
    with atomic_file(path) as temporary, _writer(temporary, schema) as writer:
        yield lambda table: writer.write_table(table.combine_chunks(), row_group_size=ROWS_PER_GROUP)


def parquet_bytes(table: pa.Table, *, rows_per_group: int) -> bytes:
    """Return the file that `write_table` writes, in groups of so many rows."""
    sink = pa.BufferOutputStream()
    with _writer(sink, table.schema) as writer:
        writer.write_table(table.combine_chunks(), row_group_size=rows_per_group)
    return bytes(sink.getvalue())


def _writer(sink: Path | pa.NativeFile, schema: pa.Schema) -> pq.ParquetWriter:
    return pq.ParquetWriter(
        sink,
        schema,
        compression="zstd",
        compression_level=1,
        use_dictionary=[field.name for field in schema if pa.types.is_string(field.type)],
        store_schema=True,
        write_page_checksum=True,
    )


def storable(table: pa.Table) -> pa.Table:
    """Return the table as Parquet can hold it: messages without fields, in arrays, get the member ROS 2 gives them on the wire, null."""
    for at, field in enumerate(table.schema):
        wanted = _with_a_member(field.type)
        if wanted != field.type:
            table = table.set_column(at, field.with_type(wanted), pa.array(table.column(at).to_pylist(), wanted))
    return table


def _with_a_member(of: pa.DataType) -> pa.DataType:
    """Return the type with a member in every struct that has none."""
    if pa.types.is_struct(of):
        fields = [field.with_type(_with_a_member(field.type)) for field in of]
        return pa.struct(fields or [pa.field(EMPTY_MEMBER, pa.uint8())])
    if pa.types.is_fixed_size_list(of):
        return pa.list_(_with_a_member(of.value_type), of.list_size)
    return pa.list_(_with_a_member(of.value_type)) if pa.types.is_list(of) else of


@contextmanager
def _damage_of(where: Path | str) -> Iterator[None]:
    """Raise `StoreError` where the file cannot be read."""
    try:
        yield
    except (OSError, pa.ArrowException) as error:
        raise StoreError(f"{where}: not a readable Parquet file ({str(error).splitlines()[0]}); rebuild it") from None


def parquet_of(data: bytes, where: str, columns: list[str]) -> pa.Table:
    """Return columns of the table in the bytes of a Parquet file that lies at ``where``; `StoreError` names one that cannot be read."""
    with _damage_of(where), pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True) as file:
        return file.read(columns, use_threads=False)  # Arrow's threads could outlive a command that ends at once


def read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Read a Parquet file with its schema metadata; `StoreError` names a file that cannot be read."""
    with _damage_of(path):
        return pq.read_table(path, columns=columns, memory_map=True, partitioning=None, page_checksum_verification=True)


def read_row_group(path: Path, group: int, columns: list[str]) -> pa.Table:
    """Read columns of one row group of a Parquet file; `StoreError` names a file that cannot be read."""
    with _damage_of(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
        return file.read_row_group(group, columns=columns)


def column_names(path: Path) -> list[str]:
    """Return the names of the columns of a Parquet file from its footer."""
    return list(read_schema(path).names)


def read_schema(path: Path) -> pa.Schema:
    """Return the schema of a Parquet file, with its metadata, from its footer; `StoreError` names a file that cannot be read."""
    with _damage_of(path):
        return pq.read_schema(path)


def lowest(path: Path, column: str) -> int:
    """Return the lowest value of a column of whole numbers, from the statistics in the footer; `StoreError` where they lack."""
    return min(_statistics(path, column))[0]


def highest(path: Path, column: str) -> int:
    """Return the highest value of a column of whole numbers, as `lowest`."""
    return max(of[1] for of in _statistics(path, column))


def _statistics(path: Path, column: str) -> list[tuple[int, int]]:
    """Return the lowest and the highest value of a column in every row group that has rows."""
    with _damage_of(path):
        about = pq.read_metadata(path)
        groups = [about.row_group(index) for index in range(about.num_row_groups)]
        at = about.schema.to_arrow_schema().get_field_index(column)
        found = [group.column(at).statistics for group in groups if at >= 0 and group.num_rows]
    if not found or not all(of is not None and of.has_min_max for of in found):
        raise StoreError(f"{path}: has no statistics of {column}")
    return [(int(of.min), int(of.max)) for of in found]
