"""Make ``store-2.1.tar.xz``: a site, its store and two datasets as data model 2.1 wrote them.

It was run once with the last commits that wrote 2.0 (456dda6) and 2.1 (36f6e15); what it made is kept and never made again:

    git worktree add /tmp/tcpipe-2.1 36f6e15
    cp tests/data/make_kept_store.py /tmp/tcpipe-2.1
    cd /tmp/tcpipe-2.1 && PYTHONPATH=. python make_kept_store.py store-2.1.tar.xz

A simulated drive of half a minute, its sensors slowed down, and rasters of half a metre over 26 m x 22 m keep it small. The log itself
is left out.
"""

import shutil
import sys
import tarfile
from dataclasses import replace
from pathlib import Path

import rasterio
from rasterio.windows import from_bounds

from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.maps import add_map
from tcpipe.simulation import make_tiny, simulate
from tcpipe.simulation.sensors import Imu, Sensors, Visual, Wheels

ROOT = Path("/tmp/tcpipe-kept")  # noqa: S108  stands in the records of the store
PITCH_M = 0.5
EAST_M, NORTH_M = (8.0, 34.0), (26.0, 48.0)


def coarse(path: Path, origin) -> None:
    """Rewrite a raster with pixels of half a metre, around the drive only."""
    with rasterio.open(path) as raster:
        west, south = origin
        window = from_bounds(
            west + EAST_M[0], south + NORTH_M[0], west + EAST_M[1], south + NORTH_M[1], raster.transform
        )
        shape = round((NORTH_M[1] - NORTH_M[0]) / PITCH_M), round((EAST_M[1] - EAST_M[0]) / PITCH_M)
        values = raster.read(window=window, out_shape=(raster.count, *shape))
        where = raster.window_transform(window)
        where *= where.scale(window.width / shape[1], window.height / shape[0])
        profile = {**raster.profile, "transform": where, "height": shape[0], "width": shape[1], "compress": "deflate"}
    with rasterio.open(path, "w", **{**profile, "tiled": False, "blockxsize": None, "blockysize": None}) as raster:
        raster.write(values)


def main(out: Path) -> None:
    shutil.rmtree(ROOT, ignore_errors=True)
    slow = Sensors(
        imu=replace(Imu(), rate_hz=50.0), wheels=replace(Wheels(), rate_hz=20.0), visual=replace(Visual(), rate_hz=15.0)
    )
    site = simulate(ROOT / "site", scenario=make_tiny(sensors=slow))
    with rasterio.open(site.rasters["height"]) as raster:
        origin = raster.bounds.left, raster.bounds.bottom
    for name in ("height", "ortho", "terrain"):
        coarse(site.rasters[name], origin)
    assert ingest(site.logs, store=ROOT / "store").exit_code == 0
    add_map("site", **site.rasters, store=ROOT / "store")
    for file_format in ("zarr", "parquet"):
        build_dataset(ROOT / file_format, store=ROOT / "store", holdout="sample", file_format=file_format)
    with tarfile.open(out, "w:xz", preset=9) as archive:
        for name in ("site/maps", "store", "zarr", "parquet"):
            archive.add(ROOT / name, name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
