"""A window of a GeoTIFF that is elsewhere, by range reads that tcpipe makes itself: GDAL sees bytes of one file, and no address.

GDAL asks a file object for the bytes that it needs, so tiles, strips, BigTIFF, masks and separate bands need no code here.
"""

from __future__ import annotations

import io
import itertools
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from pyproj import CRS
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import RasterioError
from rasterio.windows import Window
from shapely import Geometry
from shapely.affinity import affine_transform

from tcpipe.errors import MapError
from tcpipe.formats.cache import fetch_cached
from tcpipe.formats.https import HttpsClient
from tcpipe.formats.maps.geotiff import GDAL_CONFIG, check_layout, describe_error
from tcpipe.terrain.projection import Projection, parse_crs

_BLOCK_BYTES = 1 << 16
_MOST_BLOCKS = 128
"""Most blocks of one request: 8 MB."""
_MOST_BLOCKS_READ = 1_000_000
"""Most blocks of one raster."""
_LARGEST_BYTES = 1 << 42
"""Largest remote file [byte]; a sparse local file has its parts at the same offsets."""
_MOST_PIXELS = 400_000_000
_SAME_PLACE = 1.0
"""In units of a raster's CRS: names of one CRS differ, and so do its shifts to WGS 84, but not by more."""
_NAME = "/raster.tif"


class RemoteFile:
    """The bytes of one URL, fetched in whole blocks when they are wanted."""

    def __init__(self, client: HttpsClient, url: str) -> None:
        self._client, self.url, self._have = client, url, set[int]()
        self.size, self.version = 0, ""
        self.error: Exception | None = None
        self._local = tempfile.TemporaryFile()  # noqa: SIM115  closed by `close`

    def close(self) -> None:
        """Remove what was fetched."""
        self._local.close()

    def fetch(self, spans: Iterable[tuple[int, int]]) -> None:
        """Fetch what is missing of spans (offset, count), neighbours in one request."""
        wanted = {
            block
            for offset, count in spans
            for block in range(offset // _BLOCK_BYTES, -(-min(offset + count, self.size) // _BLOCK_BYTES))
        }
        missing = enumerate(sorted(wanted - self._have))
        for _, run in itertools.groupby(missing, key=lambda pair: (pair[1] - pair[0], pair[0] // _MOST_BLOCKS)):
            blocks = [block for _, block in run]
            self.fetch_blocks(blocks[0], blocks[-1])

    def read(self, offset: int, count: int) -> bytes:
        """Return bytes for GDAL; none after an error, which GDAL could not pass on."""
        try:
            self.fetch([(offset, count)])
        except (MapError, OSError) as error:
            self.error = error
            return b""
        self._local.seek(offset)
        return self._local.read(count)

    def fetch_blocks(self, first: int, last: int) -> None:
        """Fetch blocks; later blocks must have the size and version of the file of the first."""
        span = first * _BLOCK_BYTES, (last + 1) * _BLOCK_BYTES - 1
        data, headers = self._client.get(self.url, span=span, most=span[1] + 1 - span[0])
        found = re.fullmatch(rf"bytes {span[0]}-(\d{{1,15}})/(\d{{1,15}})", headers["Content-Range"] or "")
        size, version = int(found[2]) if found else 0, headers["ETag"] or headers["Last-Modified"] or ""
        self.size, self.version = self.size or size, self.version or version
        is_whole = len(data) == min(span[1] + 1, size) - span[0] and size <= _LARGEST_BYTES
        if not is_whole or (size, version) != (self.size, self.version):
            raise MapError(
                f"{self.url}: asked for bytes {span[0]} to {span[1]}, got {len(data)} ({headers['Content-Range']}, version {version}) "
                f"of a file that had {self.size} (version {self.version}); run the command again"
            )
        self._local.seek(span[0])
        self._local.write(data)
        self._have.update(range(first, last + 1))


class _Handle(io.RawIOBase):
    """A remote file as Python's files are; GDAL opens it several times."""

    def __init__(self, remote: RemoteFile) -> None:
        super().__init__()
        self._remote, self._at = remote, 0

    def read(self, size: int = -1) -> bytes:
        data = self._remote.read(self._at, self._remote.size - self._at if size < 0 else size)
        self._at += len(data)
        return data

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + (0, self._at, self._remote.size)[whence]
        return self._at

    def tell(self) -> int:
        return self._at


class RemoteWindow:
    """The pixels of a raster around an area; `copy` reads them."""

    def __init__(self, client: HttpsClient, remote: RemoteFile, dataset: Any, window: Window) -> None:
        self._remote, self._dataset, self._window = remote, dataset, window
        self._spans = list(_iterate_blocks(dataset, window, remote.url))
        self.to_read_bytes = sum(count for _, count in self._spans)
        client.check_left(remote.url, self.to_read_bytes)
        self.version = remote.version
        unit = parse_crs(dataset.crs.to_wkt(), where=remote.url).axis_info[0].unit_name
        self.resolution = f"{np.hypot(dataset.transform.a, dataset.transform.d):.6g} {unit}"

    def copy(self, path: Path) -> None:
        """Write the pixels as a GeoTIFF, from the cache if they were read before."""
        key = f"{self._remote.url} {self.version} {self._remote.size} {self._window}"
        if self.version:
            shutil.copyfile(fetch_cached(key, self._write), path)
        else:  # nothing tells whether the file is still the same
            self._write(path)

    def _write(self, path: Path) -> None:
        self._remote.fetch(self._spans)
        _copy_pixels(self._dataset, self._window, path)
        if self._remote.error is not None:
            raise self._remote.error
        with path.open("rb") as written:
            os.fsync(written)  # the cache itself does not: a power cut must not leave half a window


@contextmanager
def open_window(client: HttpsClient, url: str, area: Geometry, *, crs: str | None) -> Iterator[RemoteWindow | None]:
    """Yield what an area [deg] takes of a raster, of which only the head is read; None where they do not meet.

    ``crs`` is what the catalogue says. `MapError`: the raster cannot be read by ranges, is none, is damaged, is elsewhere than the
    catalogue says, or the window is too large.
    """

    def open_handle(path: str, mode: str = "rb") -> _Handle:  # noqa: ARG001  rasterio names it
        if path != _NAME:
            raise FileNotFoundError(path)  # nothing lies beside it
        return _Handle(remote)

    with closing(RemoteFile(client, url)) as remote:
        remote.fetch_blocks(0, 0)
        try:
            with rasterio.Env(**GDAL_CONFIG), rasterio.open(_NAME, driver="GTiff", opener=open_handle) as dataset:
                check_layout(dataset, url, "download it and write it again: rio convert in.tif out.tif")
                window = _find_window(dataset, url, area, crs)
                yield None if window is None else RemoteWindow(client, remote, dataset, window)
        except RasterioError as error:
            raise remote.error or MapError(f"{url}: not a GeoTIFF, or damaged: {describe_error(error)}") from None


def _find_window(dataset: Any, url: str, area: Geometry, stated_crs: str | None) -> Window | None:
    """Return the pixels around the part of an area that lies on a raster."""
    if dataset.crs is None or dataset.transform.is_degenerate or dataset.transform.is_identity:
        raise MapError(f"{url}: has no georeference; tcpipe cannot tell which part of it covers the track")
    crs = parse_crs(dataset.crs.to_wkt(), where=url)
    placed = _project(area, crs)
    xy = shapely.get_coordinates(placed)
    stated = _project(area, parse_crs(stated_crs, where=f"{url} in the catalogue")) if stated_crs else placed
    if not np.allclose(xy, shapely.get_coordinates(stated), rtol=0.0, atol=_SAME_PLACE):
        raise MapError(
            f"{url}: its CRS is {crs.name!r}, the catalogue says {stated_crs}, which is elsewhere; give other rasters"
        )
    if not np.isfinite(xy).all():
        return None  # far outside the area of its CRS
    pixels = affine_transform(placed, (~dataset.transform).to_shapely())
    on_raster = shapely.intersection(pixels, shapely.box(0, 0, dataset.width, dataset.height))
    if not on_raster.area:
        return None
    bounds = shapely.bounds(on_raster)
    (left, top), (right, bottom) = np.floor(bounds[:2]).astype(int).tolist(), np.ceil(bounds[2:]).astype(int).tolist()
    if (right - left) * (bottom - top) * dataset.count > _MOST_PIXELS:
        raise MapError(
            f"{url}: {right - left} x {bottom - top} pixels of {dataset.count} bands around the track, at most {_MOST_PIXELS:.1g}; "
            "name fewer runs with --around, or a smaller --margin"
        )
    return Window(left, top, right - left, bottom - top)


def _project(area: Geometry, crs: CRS) -> Geometry:
    return shapely.transform(area, Projection(CRS.from_epsg(4326), crs, area.bounds).forward)


def _iterate_blocks(dataset: Any, window: Window, url: str) -> Iterator[tuple[int, int]]:
    """Yield offset and count of every block of a window, as GDAL finds them in the file; those of a mask are unknown."""
    bands = range(1, dataset.count + 1) if dataset.profile.get("interleave") == "band" else (1,)
    starts, ends = (window.row_off, window.col_off), (window.row_off + window.height, window.col_off + window.width)
    sides = dataset.block_shapes[0]
    rows, cols = (range(a // side, -(-b // side)) for a, b, side in zip(starts, ends, sides, strict=True))
    if len(rows) * len(cols) > _MOST_BLOCKS_READ:
        raise MapError(f"{url}: {len(rows) * len(cols)} blocks around the track, at most {_MOST_BLOCKS_READ}")
    for row, col, band in itertools.product(rows, cols, bands):
        found = [dataset.get_tag_item(f"BLOCK_{tag}_{col}_{row}", "TIFF", bidx=band) for tag in ("OFFSET", "SIZE")]
        if all(found):
            yield int(found[0]), int(found[1])


def _copy_pixels(dataset: Any, window: Window, path: Path) -> None:
    """Write a window as a GeoTIFF of the same pixels, with what the raster says of them, some rows at a time."""
    move, col, row = dataset.transform, window.col_off, window.row_off
    corner = move.a * col + move.b * row + move.c, move.d * col + move.e * row + move.f
    affine = rasterio.Affine(move.a, move.b, corner[0], move.d, move.e, corner[1])
    profile = {"width": window.width, "height": window.height, "count": dataset.count, "dtype": dataset.dtypes[0]}
    profile |= {"crs": dataset.crs, "transform": affine, "nodata": dataset.nodata}
    profile |= {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate", "BIGTIFF": "IF_SAFER"}
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "w", driver="GTiff", **profile) as out:
        out.colorinterp = dataset.colorinterp
        out.scales, out.offsets, out.units = dataset.scales, dataset.offsets, [unit or "" for unit in dataset.units]
        if dataset.colorinterp[0] == ColorInterp.palette:
            out.write_colormap(1, dataset.colormap(1))
        step = max(dataset.block_shapes[0][0], 256)
        for first in range(0, window.height, step):
            target = Window(0, first, window.width, min(step, window.height - first))
            source = Window(window.col_off, window.row_off + first, target.width, target.height)
            out.write(dataset.read(window=source), window=target)
            if dataset.mask_flag_enums[0] == [MaskFlags.per_dataset]:
                out.write_mask(dataset.dataset_mask(window=source) > 0, window=target)
