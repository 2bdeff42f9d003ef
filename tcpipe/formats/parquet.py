"""Tables in files: Parquet with GeoParquet metadata, and Arrow files; the same table gives the same bytes.

Every page carries a checksum that is proved when it is read: damage is an error, never a number. Before a page is
decoded, the headers of all pages say how large the table becomes: one that is out of proportion to its file is refused
(`MOST_BYTES`, `MOST_TIMES`).
"""

import ctypes
import math
import os
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import DTypeLike, NDArray

from tcpipe.arrays import AnyArray, Floats, Ints
from tcpipe.errors import StoreError
from tcpipe.formats.atomic import Location, write_atomic_file
from tcpipe.formats.json_files import to_json_line
from tcpipe.tables.columns import read_ends_deg
from tcpipe.tables.levels import GEOMETRY, Datum

N = TypeVar("N", bound=np.generic)

_M_MMAP_THRESHOLD = -3

ROWS_PER_GROUP = 1 << 17
"""Rows of a group, which is decoded as a whole."""
MOST_BYTES, MOST_TIMES = 256_000_000, 100
"""Largest table in memory [byte], and in multiples of its file: ours shrink to a tenth, except constant columns."""
_MOST_DEPTH = 4  # structs in one another in the header of a page
# Bytes of a value, by physical type.
_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}
EMPTY_MEMBER = "structure_needs_at_least_one_member"


def write_table(table: pa.Table, path: Path) -> None:
    """Write ``table`` to ``path`` whole or not at all; zstd level 1 without dictionaries (half the default's time)."""
    with write_parquet_rows(path, table.schema) as write:
        write(table)


@contextmanager
def write_parquet_rows(path: Path, schema: pa.Schema) -> Iterator[Callable[[pa.Table], None]]:
    """Yield a function that adds row groups to ``path``; the file appears at the end, complete or not at all."""
    with write_atomic_file(path) as temporary, _open_writer(temporary, schema) as writer:
        yield lambda table: writer.write_table(table.combine_chunks(), row_group_size=ROWS_PER_GROUP)


def write_parquet_bytes(table: pa.Table, *, rows_per_group: int = ROWS_PER_GROUP) -> bytes:
    """Return the file that `write_table` writes, in groups of this many rows."""
    sink = pa.BufferOutputStream()
    with _open_writer(sink, table.schema) as writer:
        writer.write_table(table.combine_chunks(), row_group_size=rows_per_group)
    return bytes(sink.getvalue())


def _open_writer(sink: Path | pa.NativeFile, schema: pa.Schema) -> pq.ParquetWriter:
    return pq.ParquetWriter(
        sink,
        schema,
        compression="zstd",
        compression_level=1,
        use_dictionary=[field.name for field in schema if pa.types.is_string(field.type)],
        store_schema=True,
        write_page_checksum=True,
    )


def make_storable(table: pa.Table) -> pa.Table:
    """Return the table for Parquet: messages without fields, in arrays, get ROS 2's placeholder member, null."""
    for at, field in enumerate(table.schema):
        wanted = _add_struct_member(field.type)
        if wanted != field.type:
            table = table.set_column(at, field.with_type(wanted), pa.array(table.column(at).to_pylist(), wanted))
    return table


def _add_struct_member(dtype: pa.DataType) -> pa.DataType:
    """Return the type with a member in every struct that has none."""
    if pa.types.is_struct(dtype):
        fields = [field.with_type(_add_struct_member(field.type)) for field in dtype]
        return pa.struct(fields or [pa.field(EMPTY_MEMBER, pa.uint8())])
    if pa.types.is_fixed_size_list(dtype):
        return pa.list_(_add_struct_member(dtype.value_type), dtype.list_size)
    return pa.list_(_add_struct_member(dtype.value_type)) if pa.types.is_list(dtype) else dtype


@contextmanager
def _convert_damage(where: Location) -> Iterator[None]:
    """Raise `StoreError` if the file cannot be read."""
    try:
        yield
    except (OSError, pa.ArrowException, ValueError, IndexError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise StoreError(f"{where}: not a readable Parquet file ({reason}); rebuild it") from None


def read_table(path: Path, columns: list[str] | None = None, *, group: int | None = None) -> pa.Table:
    """Read a Parquet file with its schema metadata, or one of its row groups; `StoreError` names an unreadable file."""
    with _convert_damage(path), pa.memory_map(str(path)) as file:
        return _read_bounded(file.read_buffer(), columns, group)


def read_parquet_bytes(data: bytes, where: str) -> pa.Table:
    """Read the content of a Parquet file from `write_parquet_bytes`; `StoreError` names one that cannot be read."""
    with _convert_damage(where), pq.ParquetFile(pa.BufferReader(data)) as file:
        return file.read()


def _read_bounded(data: pa.Buffer, columns: list[str] | None, group: int | None) -> pa.Table:
    """Return columns of a file or row group if their size is in proportion to it; else `ValueError`."""
    about = pq.read_metadata(pa.BufferReader(data))
    most = max(MOST_BYTES, MOST_TIMES * data.size)
    groups = [n for n in range(about.num_row_groups) if group in (None, n) and about.row_group(n).num_rows]
    schema = about.schema.to_arrow_schema()
    size, at_most = 0, dict.fromkeys((field.name for field in schema if pa.types.is_string(field.type)), 0)
    for name, least, longest in _iterate_column_sizes(
        memoryview(data), about, groups, None if columns is None else set(columns)
    ):
        size += least if name in at_most else longest
        at_most[name] = at_most.get(name, 0) + longest
    if size > most:
        raise ValueError(f"it expands to {size / 1e6:.0f} MB, at most {most / 1e6:.0f}")
    texts = [
        field.name for field in schema if pa.types.is_string(field.type) and at_most[field.name] > MOST_BYTES // 16
    ]
    source = pa.BufferReader(data)
    with pq.ParquetFile(source, metadata=about, read_dictionary=texts, page_checksum_verification=True) as file:
        table = file.read_row_groups(groups, columns)
    for at, field in enumerate(table.schema):  # each different text is stored here once
        if pa.types.is_dictionary(field.type):
            size += sum(
                int(pc.sum(pc.binary_length(chunk.dictionary).cast(pa.int64()).take(chunk.indices)).as_py() or 0)
                for chunk in table.column(at).chunks
            )
            if size > most:
                raise ValueError(f"its texts expand to more than {most / 1e6:.0f} MB")
            plain = schema.field(field.name)
            table = table.set_column(at, plain, table.column(at).cast(plain.type))
    return table


def _iterate_column_sizes(
    data: memoryview, about: pq.FileMetaData, groups: Iterable[int], columns: Collection[str] | None
) -> Iterator[tuple[str, int, int]]:
    """Yield each column of each row group and how large it becomes [byte], by the headers of its pages.

    The first size is that of a column of texts whose dictionary is kept, the second if each text were all of the
    dictionary.
    """
    leaves = [about.schema.column(index) for index in range(about.num_columns)]
    for number in groups:
        group = about.row_group(number)
        for index, leaf in enumerate(leaves):
            name = leaf.path.partition(".")[0]
            if columns is not None and name not in columns:
                continue
            chunk = group.column(index)
            width = leaf.length if leaf.physical_type == "FIXED_LEN_BYTE_ARRAY" else _WIDTHS.get(leaf.physical_type, 0)
            pages = list(_iterate_pages(data, chunk))
            values = sum(count for _, count, _ in pages)
            encoded = sum(size for size, *_ in pages)
            least = encoded + values * (width or 4)
            dictionary = 0 if width else sum(size for size, _, is_dictionary in pages if is_dictionary)
            yield name, least, max(least, encoded + values * dictionary)


def _iterate_pages(data: memoryview, chunk: pq.ColumnChunkMetaData) -> Iterator[tuple[int, int, bool]]:
    """Yield the uncompressed size [byte] of each page of a column, its values, and whether they are the dictionary."""
    at = min(chunk.data_page_offset, chunk.dictionary_page_offset or chunk.data_page_offset)
    end = at + chunk.total_compressed_size
    if not 0 < at <= end <= len(data):
        raise ValueError("a column lies beyond its end")
    while at < end:
        header, at = _read_struct(data, at)
        uncompressed, compressed = header.get(2, -1), header.get(3, -1)
        held = next((page for number in (5, 7, 8) if isinstance(page := header.get(number), dict)), {})
        values = held.get(1, 0)
        if not all(isinstance(value, int) and value >= 0 for value in (uncompressed, compressed, values)):
            raise ValueError("the header of a page is damaged")
        yield uncompressed, 0 if 7 in header else values, 7 in header
        at += compressed


def _read_struct(data: memoryview, at: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """Return a struct in Thrift's compact protocol by field number (texts and doubles as None), and where it ends.

    The header of a page contains no other fields (Apache Parquet, parquet.thrift, PageHeader).
    """
    fields, number = dict[int, Any](), 0
    while kind := data[at]:
        at += 1
        value: Any = None
        if kind >> 4:
            number += kind >> 4
        else:
            number, at = _read_zigzag(data, at)
        match kind & 15:
            case 1 | 2:
                value = kind & 15 == 1
            case 4 | 5 | 6:
                value, at = _read_zigzag(data, at)
            case 7:
                at += 8
            case 8:
                length, at = _read_varint(data, at)
                at += length
            case 12 if depth < _MOST_DEPTH:
                value, at = _read_struct(data, at, depth + 1)
            case _:
                raise ValueError("the header of a page is damaged")
        fields[number] = value
    return fields, at + 1


def _read_zigzag(data: memoryview, at: int) -> tuple[int, int]:
    value, at = _read_varint(data, at)
    return value >> 1 ^ -(value & 1), at


def _read_varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while (byte := data[at]) & 128 and shift < 64:
        value, shift, at = value | (byte & 127) << shift, shift + 7, at + 1
    return value | byte << shift, at + 1


def read_schema(path: Path) -> pa.Schema:
    """Return a Parquet file's schema with its metadata, from the footer; `StoreError` names an unreadable file."""
    with _convert_damage(path):
        return pq.read_schema(path)


def read_row_count(path: Path) -> int:
    """Return the rows of a Parquet file from its footer; `StoreError` names a file that cannot be read."""
    with _convert_damage(path):
        return int(pq.read_metadata(path).num_rows)


_WGS84 = "EPSG:4326"


def add_segments_metadata(table: pa.Table, datum: Datum | None) -> pa.Table:
    """Return a table of segments with its coordinate system as metadata; ``datum`` is the track's."""
    ends = np.concatenate(read_ends_deg(table))
    return add_geo_metadata(table, "LineString", ends, crs=_WGS84 if datum is None else datum.crs)


def add_geo_metadata(
    table: pa.Table, kind: Literal["LineString", "Point"], points_deg: Floats, *, crs: str = _WGS84
) -> pa.Table:
    """Return a table with metadata that describe its column ``geometry``.

    ``points_deg`` are longitude and latitude of all points, shape (N, 2), NaN where not known; longitude is first
    independent of ``crs``.
    """
    known = points_deg[np.isfinite(points_deg).all(axis=1)]
    column: dict[str, Any] = {"encoding": "WKB", "geometry_types": [kind]}
    if crs != _WGS84:  # without the key it is OGC:CRS84: WGS 84, longitude first
        from pyproj import CRS  # noqa: PLC0415  few stores need it

        column["crs"] = CRS.from_user_input(crs).to_json_dict()
    if len(known):
        column["bbox"] = [*known.min(axis=0), *known.max(axis=0)]
    geo = {"version": "1.1.0", "primary_column": GEOMETRY, "columns": {GEOMETRY: column}}
    return table.replace_schema_metadata({**(table.schema.metadata or {}), b"geo": to_json_line(geo).encode()})


def write_pieces(path: Path, schema: pa.Schema, pieces: Iterable[pa.Table]) -> None:
    """Write tables of one schema one after another."""
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, schema) as writer:
        for piece in pieces:
            writer.write_table(piece)


def map_table(path: Path) -> pa.Table:
    """Return the whole table as a view of the file, which must outlive it."""
    with pa.memory_map(str(path)) as source:
        return pa.ipc.open_file(source).read_all()


def take_rows(table: pa.Table, rows: Ints) -> pa.Table:
    """Return rows of a table: `pa.Table.take` would copy all of each column that has several chunks."""
    order = np.argsort(rows, kind="stable")
    ascending, first, taken = rows[order], 0, []
    for batch in table.to_batches():
        begin, end = np.searchsorted(ascending, (first, first + batch.num_rows))
        if begin < end:
            taken.append(batch.take(ascending[begin:end] - first))
        first += batch.num_rows
    back = np.empty(len(rows), np.int64)
    back[order] = np.arange(len(rows))
    return pa.Table.from_batches(taken, table.schema).take(back)


def make_mapped_array(directory: Path, shape: tuple[int, ...], dtype: DTypeLike) -> AnyArray:
    """Return an array of zeros in a nameless file in a directory, so that the system can free its memory."""
    size_bytes = np.dtype(dtype).itemsize * math.prod(shape)
    if not size_bytes:
        return np.zeros(shape, dtype)
    with tempfile.TemporaryFile(dir=directory) as file:
        os.posix_fallocate(file.fileno(), 0, size_bytes)  # a full disk is told now, not by a signal
        return np.memmap(file, dtype, "r+", shape=shape).view(np.ndarray)


def move_to_file(array: NDArray[N], directory: Path) -> NDArray[N]:
    """Return a copy of an array as `make_mapped_array` gives it."""
    mapped = make_mapped_array(directory, array.shape, array.dtype)
    mapped[...] = array
    return mapped


def move_rows_to_file(array: NDArray[N], rows: Ints, directory: Path) -> NDArray[N]:
    """Return rows of an array as `make_mapped_array` gives them."""
    mapped = make_mapped_array(directory, (len(rows), *array.shape[1:]), array.dtype)
    if mapped.size:
        np.take(array, rows, axis=0, out=mapped, mode="clip")  # "raise" would make a copy
    return mapped


def return_freed_memory() -> None:
    """Return freed memory of columns to the system: the heap would keep the largest amount that was ever used."""
    pa.set_memory_pool(pa.system_memory_pool())
    with suppress(OSError, AttributeError, TypeError):  # only glibc has it
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, 1 << 20)
        library.malloc_trim(0)
