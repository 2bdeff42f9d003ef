"""Another processor makes the same site, runs and samples, but for the last digits (docs/explanation/same-bytes.md)."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import rasterio
import shapely
import tiny_pipeline
from processors import ANOTHER_PROCESSOR
from simulated_streams import streams_of
from stored_files import tables

import tcpipe

NEAR = 1e-9
"""Largest difference, relative to the largest value of a column; the page says 1e-12, other processors may need more."""
NEAR_DIFFERENCE = 1e-7
"""The same of a standard deviation whose variance is a small difference of large ones."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two simulated sites; the log and the rasters of the first, ingested and built on both processors."""
    here, elsewhere = (tmp_path_factory.mktemp(name) for name in ("here", "elsewhere"))
    tiny_pipeline.main(here, here)
    subprocess.run(
        [sys.executable, tiny_pipeline.__file__, elsewhere, here], env={**os.environ, **ANOTHER_PROCESSOR}, check=True
    )
    return here, elsewhere


def _unlike(ours: pa.Table, theirs: pa.Table) -> list[str]:
    """Return the columns that differ by more than last digits; ids hold a stamp, and are left to the stamp."""
    assert (ours.num_rows, ours.column_names) == (theirs.num_rows, theirs.column_names)
    return [
        name for name in ours.column_names if not name.endswith("_id") and not _near(name, ours[name], theirs[name])
    ]


def _near(name: str, ours: pa.ChunkedArray, theirs: pa.ChunkedArray) -> bool:
    if pa.types.is_floating(ours.type):
        here, there = (column.to_numpy().astype(float) for column in (ours, theirs))
        near = NEAR_DIFFERENCE if name.startswith("displacement_std") else NEAR
        return np.allclose(there, here, rtol=0.0, atol=near * np.nanmax(np.abs(here), initial=0.0), equal_nan=True)
    if name == "geometry":
        here, there = (shapely.get_coordinates(shapely.from_wkb(column.to_pylist())) for column in (ours, theirs))
        return np.allclose(there, here, rtol=0.0, atol=NEAR * np.abs(here).max(initial=0.0))
    if name.endswith("_ns"):  # an interpolated stamp that is rounded to a whole one
        return bool(pc.all(pc.less_equal(pc.abs(pc.subtract(ours, theirs)), 1)).as_py())
    return ours.equals(theirs)


def _list_tables(place: Path) -> list[Path]:
    truths = sorted(place.glob("site/truth/*.parquet"))
    stored = [path for name in ("track", "segments") for path in tables(place / "store", name)]
    return [*truths, *stored, place / "dataset/samples.parquet"]


def test_tables_are_the_same_but_for_last_digits(made: tuple[Path, Path]) -> None:
    for here, there in zip(*map(_list_tables, made), strict=True):
        assert not _unlike(pq.read_table(here), pq.read_table(there))


def test_a_simulated_log_says_the_same_but_for_last_digits(made: tuple[Path, Path]) -> None:
    ours, theirs = (streams_of(next((place / "site" / "logs").iterdir())).tables for place in made)
    assert ours.keys() == theirs.keys()
    assert not {role: unlike for role in ours if (unlike := _unlike(ours[role], theirs[role]))}


@pytest.mark.parametrize("layer", ["height", "ortho", "terrain"])
def test_rasters_and_patches_differ_by_one_step_at_most(made: tuple[Path, Path], layer: str) -> None:
    rasters = []
    for place in made:
        with rasterio.open(place / "site" / "maps" / f"{layer}.tif") as raster:
            rasters.append(raster.read(masked=True).filled(0).astype(float))
    assert np.abs(rasters[0] - rasters[1]).max() <= (1e-4 if layer == "height" else 0.0 if layer == "terrain" else 1.0)
    patches = [tcpipe.open_dataset(place / "dataset")["train"].patches for place in made]
    assert np.abs(patches[0] - patches[1]).max() <= 1.001 / 255.0
