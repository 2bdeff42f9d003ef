"""A table too large to hold: written piece by piece to an Arrow file and mapped back; rows cost memory only while they are used."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa


def write_pieces(path: Path, schema: pa.Schema, pieces: Iterable[pa.Table]) -> None:
    """Write tables of one schema one after another."""
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, schema) as writer:
        for piece in pieces:
            writer.write_table(piece)


def map_table(path: Path) -> pa.Table:
    """Return the whole table as a view of the file, which must outlive it."""
    with pa.memory_map(str(path)) as source:
        return pa.ipc.open_file(source).read_all()


def write_table_bytes(table: pa.Table) -> bytes:
    """Return a table as bytes, schema and all; `read_table_bytes` is the way back."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return bytes(sink.getvalue())


def read_table_bytes(data: bytes) -> pa.Table:
    """Return the table in bytes of `write_table_bytes`."""
    with pa.ipc.open_stream(data) as reader:
        return reader.read_all()
