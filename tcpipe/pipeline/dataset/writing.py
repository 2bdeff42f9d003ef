"""Patches that wait in the spool to the shards of a dataset: each a task of its own, whoever does it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import TcpipeError
from tcpipe.execution import run_all, sound
from tcpipe.formats.arrow_file import table_bytes, table_of
from tcpipe.formats.dataset_card import Shard
from tcpipe.formats.dataset_files import Drawer, FileFormat, ParquetDrawer, Pixels, parquet_drawers, zarr_drawers
from tcpipe.formats.place import DirectoryPlace, Place
from tcpipe.formats.zarr_arrays import Compression
from tcpipe.pipeline.dataset.content import Content, SampleTable
from tcpipe.pipeline.dataset.sampling import Workers


def write_patches(
    directory: Path, content: Content, file_format: FileFormat, workers: Workers, *, compression: Compression
) -> list[Shard]:
    """Have the layers written, shard by shard; return the shards, where the format has any."""
    samples, spool = content.samples, content.spool
    pixels = Pixels(spool.layers, spool.patch_px, samples.slots(), spool.read)
    if file_format == "parquet":
        rows = partial(_waiting_rows, workers.waiting, samples)
        drawers = parquet_drawers(workers.out, pixels, rows, samples.splits())
    else:
        drawers = zarr_drawers(
            directory, workers.out, pixels, samples.ids, compression=compression, threads=workers.jobs
        )
    with closing(run_all(_fill, drawers, jobs=1, cluster=workers.cluster)) as outcomes:
        for outcome in outcomes:
            sound(outcome)
    _bring(workers.out, directory)
    return [drawer.shard for drawer in drawers if isinstance(drawer, ParquetDrawer)]


def _waiting_rows(waiting: Place, samples: SampleTable, rows: NDArray[np.int64]) -> Callable[[], pa.Table]:
    """Put rows of the samples where whoever writes them sees them; return what gives them there."""
    name = f"rows/{rows[0]}"
    waiting.put(name, table_bytes(samples.take(rows)))
    return partial(_rows_at, waiting, name)


def _rows_at(waiting: Place, name: str) -> pa.Table:
    return table_of(waiting.read(name) or b"")


def _fill(drawer: Drawer) -> TcpipeError | None:
    try:
        drawer.write()
    except TcpipeError as error:
        return error
    return None


def _bring(out: Place, directory: Path) -> None:
    """Bring the files into the directory that is made, one at a time, where they were written elsewhere."""
    if out == DirectoryPlace(directory):
        return
    for entry in out.entries():
        (directory / entry.name).parent.mkdir(parents=True, exist_ok=True)
        (directory / entry.name).write_bytes(out.read_range(entry.name, 0, entry.size_bytes))
