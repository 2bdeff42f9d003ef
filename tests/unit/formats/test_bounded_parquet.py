"""Parquet that expands out of all proportion is refused by the headers of its pages, in a process that may take little memory."""

import resource
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tcpipe.errors import StoreError
from tcpipe.formats.parquet import read_table, write_parquet_bytes, write_table

READ = """
import sys
from pathlib import Path
from tcpipe.formats.parquet import read_table
for path in sys.argv[1:]:
    try:
        read_table(Path(path))
    except Exception as error:
        print(type(error).__name__, error)
"""
ROWS = 40_000_000


def texts(rows):
    """Return rows of one long text that the file holds once."""
    text = pa.array(["x" * 500_000])
    return pa.table({"s": pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), text)})


def lists(rows):
    values = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), pa.array(["x" * 500_000]))
    offsets = pa.array(np.arange(rows + 1, dtype=np.int32))
    return pa.table({"s": pa.ListArray.from_arrays(offsets, values)})


BOMBS = {
    "zeros": lambda: pa.table({"a": np.zeros(ROWS)}),
    "nulls": lambda: pa.table({"a": pa.nulls(2 * ROWS, pa.float64())}),
    "many columns": lambda: pa.table({f"a{n}": np.zeros(ROWS // 8, np.int64) for n in range(9)}),
    "one text": lambda: texts(5000),
    "one text in lists": lambda: lists(5000),
}


def test_small_files_that_become_large_are_refused_before_they_do(tmp_path):
    paths = [tmp_path / f"{name}.parquet" for name in BOMBS]
    for path in paths:
        pq.write_table(BOMBS[path.stem](), path, compression="zstd", store_schema=False)
        assert path.stat().st_size < 2_000_000
    most = 1_600_000_000  # of addresses, of which Arrow takes many that it does not use
    found = subprocess.run(
        [sys.executable, "-c", READ, *paths],
        check=True,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (most, most)),
    )
    lines = found.stdout.splitlines()
    for path, line in zip(paths, lines, strict=True):
        assert line.startswith("StoreError"), line
        assert path.name in line
        assert "expand" in line
        if pq.read_metadata(path).num_row_groups == 1:
            with pytest.raises(StoreError, match="expand"):
                read_table(path, group=0)


@pytest.mark.parametrize("rows", [0, 1, 3, 5000])
def test_what_is_written_is_read_whatever_it_holds(tmp_path, rows):
    table = pa.table(
        {
            "n": pa.array(np.arange(rows)),
            "x": pa.array(np.arange(rows) / 3, pa.float32()),
            "text": pa.array([f"run-{n % 3}" if n % 5 else None for n in range(rows)], pa.string()),
            "each": pa.array([f"{n:0400}" for n in range(rows)], pa.string()),
            "yes": pa.array([n % 2 == 0 for n in range(rows)]),
            "list": pa.array([[1.0, 2.0]] * rows, pa.list_(pa.float32(), 2)),
            "texts": pa.array([["a", "b"]] * rows, pa.list_(pa.string())),
        },
    ).replace_schema_metadata({"a": "b"})
    write_table(table, tmp_path / "a.parquet")
    found = read_table(tmp_path / "a.parquet")
    assert found.equals(table)
    assert found.schema.metadata == table.schema.metadata
    assert read_table(tmp_path / "a.parquet", ["text", "n"]).equals(table.select(["text", "n"]))
    (tmp_path / "b.parquet").write_bytes(write_parquet_bytes(table, rows_per_group=1024))
    assert read_table(tmp_path / "b.parquet", ["each"]).equals(table.select(["each"]))


def test_a_damaged_file_is_an_error_in_a_line_wherever_a_byte_changed(tmp_path):
    path = tmp_path / "a.parquet"
    table = pa.table({"a": np.arange(300.0), "s": [f"t{n % 9}" for n in range(300)]})
    whole, rng = write_parquet_bytes(table, rows_per_group=100), np.random.default_rng(0)
    said = []
    for at in rng.integers(4, len(whole) - 4, 300):
        data = bytearray(whole)
        data[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            read_table(path, ["a", "s"])
        except StoreError as error:
            said += error.problems
    assert len(said) > 200
    assert not any("\n" in line for line in said)
