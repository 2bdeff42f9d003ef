"""GeoTIFFs and whatever else GDAL reads, as windows of numbers with their validity: the one home of rasterio.

A raster is opened *for a role* (height, ortho, terrain) and refused at once, in one line, if it cannot play it: no place on the
earth, placed by control points only, wrong bands, wrong numbers. Pixel-is-point tags, south-up and rotated affines, scale and offset
tags, units, palettes, alpha, mask bands, nodata tags and NaN are dealt with here; what leaves is metres, grey from 0 to 255, or raw
class values, each with a mask.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.features import rasterize
from rasterio.io import MemoryFile
from rasterio.windows import Window

from tcpipe.errors import MapError
from tcpipe.formats.atomic import atomic_file
from tcpipe.formats.value_names import value_names
from tcpipe.terrain.layers import LUMA_RGB

ROLES = ("height", "ortho", "terrain")

_METRES = {"": 1.0, "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0}
_METRES |= {"cm": 0.01, "centimetre": 0.01, "centimeter": 0.01, "mm": 0.001, "dm": 0.1, "km": 1000.0}
_METRES |= {"ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "us-ft": 1200.0 / 3937.0, "us survey foot": 1200.0 / 3937.0}

_CACHE_MB = 256
"""Decoded blocks GDAL keeps: a strip of a wide raster is wanted by many windows."""

_OPAQUE = 1
"""A pixel is there if its mask or alpha is at least this: 16-bit alpha is often written as 255, which is almost transparent."""


@dataclass(frozen=True, slots=True)
class Raster:
    """A raster that can play its role.

    ``affine`` is (a, b, c, d, e, f) of x = a·col + b·row + c, y = d·col + e·row + f at pixel *corners*; ``crs`` is WKT, or empty where
    the file has none; ``warnings`` are plain sentences.
    """

    path: Path
    role: str
    crs: str
    affine: tuple[float, float, float, float, float, float]
    rows: int
    cols: int
    warnings: tuple[str, ...]
    names: Mapping[int, str]
    """Names of values, from the raster attribute table or the category names; empty where there are none."""
    _dataset: Any = field(repr=False)
    _bands: tuple[int, ...] = ()
    _scale: tuple[float, float] = (1.0, 0.0)
    _opaque: NDArray[np.bool_] | None = None
    """Which indices of a palette can be seen."""

    def read(self, row0: int, row1: int, col0: int, col1: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return a window inside the raster, and which of its pixels have data.

        Values are float64 metres (height), float64 grey from 0 to 255 (ortho), or raw integers (terrain).

        Raises
        ------
        MapError
            The window's pixels are damaged.
        """
        window = Window(col0, row0, col1 - col0, row1 - row0)
        try:
            raw = self._dataset.read(self._bands, window=window)
            valid = self._dataset.dataset_mask(window=window) >= _OPAQUE
        except RasterioError as error:
            reason = str(error.__cause__ or error).splitlines()[0]
            raise MapError(
                f"{self.path}: rows {row0} to {row1}, columns {col0} to {col1} cannot be read; the file is damaged: {reason}"
            ) from error
        if self.role == "terrain":
            return raw[0], valid if self._opaque is None else valid & self._opaque[raw[0]]
        values = self._grey(raw) if self.role == "ortho" else raw[0] * self._scale[0] + self._scale[1]
        return values, valid & np.isfinite(values)

    def _grey(self, raw: NDArray[Any]) -> NDArray[np.float64]:
        if self._dataset.colorinterp[self._bands[0] - 1] == ColorInterp.palette:
            by_index = _palette_grey(self._dataset.colormap(self._bands[0]))
            return np.asarray(by_index[raw[0]])
        weights = np.array(LUMA_RGB if len(self._bands) == 3 else (1.0,)) * (255.0 / np.iinfo(raw.dtype).max)
        return np.asarray(np.tensordot(weights, raw.astype(np.float64), 1))


@contextmanager
def open_raster(path: Path, role: str) -> Iterator[Raster]:
    """Open a raster for a role.

    Raises
    ------
    MapError
        It is no raster, has no place on the earth, or its bands cannot play the role.
    """
    if not path.exists():
        raise MapError(f"{path}: there is no such file")
    with rasterio.Env(GDAL_CACHEMAX=_CACHE_MB), _opened(path) as dataset:
        _refuse_unplaced(dataset, path)
        bands, notes = _choose_bands(dataset, path, role)
        scale, more = _scaling(dataset, path, role, bands)
        palette = role == "terrain" and dataset.colorinterp[bands[0] - 1] == ColorInterp.palette
        yield Raster(
            path=path,
            role=role,
            crs=dataset.crs.to_wkt() if dataset.crs else "",
            affine=tuple(dataset.transform)[:6],
            rows=dataset.height,
            cols=dataset.width,
            warnings=(*notes, *more),
            names=value_names(_described(dataset), bands[0]) if role == "terrain" else {},
            _dataset=dataset,
            _bands=bands,
            _scale=scale,
            _opaque=np.isfinite(_palette_grey(dataset.colormap(bands[0]))) if palette else None,
        )


def raster_files(path: Path) -> list[Path]:
    """Return every file that a raster is made of, itself and what lies beside it (masks, world files, statistics), sorted.

    Raises
    ------
    MapError
        It is no raster.
    """
    if not path.exists():
        raise MapError(f"{path}: there is no such file")
    with _opened(path) as dataset:
        return sorted({path, *(Path(name) for name in dataset.files if Path(name).is_file())})


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    logging.getLogger("rasterio").addHandler(logging.NullHandler())  # GDAL's own lines come with our error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            dataset = rasterio.open(path)
        except RasterioError as error:
            raise MapError(f"{path}: not a raster that GDAL can read (wanted a GeoTIFF{_or_polygons(path)})") from error
    with dataset:
        yield dataset


def _or_polygons(path: Path) -> str:
    vector = path.suffix.lower() in {".shp", ".gpkg", ".kml", ".geojson", ".json"}
    return "; terrain may also be polygons, exported as .geojson" if vector else ""


def _refuse_unplaced(dataset: Any, path: Path) -> None:
    if dataset.count == 0:
        raise MapError(f"{path}: the file holds no bands itself; name one of its subdatasets as a GeoTIFF")
    if dataset.crs is None and dataset.gcps[0]:
        raise MapError(
            f"{path}: placed by {len(dataset.gcps[0])} ground control points only; rectify it first (gdalwarp -tps in.tif out.tif)"
        )
    if dataset.transform.is_identity:
        raise MapError(
            f"{path}: has no georeference; give it one (gdal_edit -a_srs EPSG:n -a_ullr xmin ymax xmax ymin)"
        )
    if dataset.transform.is_degenerate:
        raise MapError(f"{path}: its georeference has pixels without area")


def _choose_bands(dataset: Any, path: Path, role: str) -> tuple[tuple[int, ...], list[str]]:
    colours = {colour: band for band, colour in reversed(list(enumerate(dataset.colorinterp, 1)))}
    plain = [band for band, colour in enumerate(dataset.colorinterp, 1) if colour != ColorInterp.alpha]
    names = ", ".join(colour.name for colour in dataset.colorinterp)
    kinds = {np.dtype(dataset.dtypes[band - 1]) for band in plain}
    if role == "ortho":
        rgb = [colours.get(colour) for colour in (ColorInterp.red, ColorInterp.green, ColorInterp.blue)]
        palette = dataset.colorinterp[0] == ColorInterp.palette
        if not palette and any(kind not in {np.dtype(np.uint8), np.dtype(np.uint16)} for kind in kinds):
            raise MapError(f"{path}: ortho is {dataset.dtypes[0]}, wanted 8-bit or 16-bit unsigned")
        if None not in rgb:
            more = (
                [f"{path.name}: bands beyond red, green, blue and alpha are ignored ({names})"]
                if len(plain) > 3
                else []
            )
            return tuple(band for band in rgb if band is not None), more
        if len(plain) == 1:
            return (plain[0],), []
        if len(plain) == 3:
            return tuple(plain), [f"{path.name}: bands are not named by colour; taken as red, green, blue"]
        raise MapError(
            f"{path}: ortho has {dataset.count} bands ({names}), wanted grey or red, green, blue, and alpha at most"
        )
    if len(plain) != 1:
        raise MapError(f"{path}: {role} has {dataset.count} bands ({names}), wanted one")
    kind = kinds.pop()
    if role == "height" and dataset.colorinterp[plain[0] - 1] == ColorInterp.palette:
        raise MapError(f"{path}: height is a palette of colours, wanted metres")
    if role == "height" and kind.kind not in "fiu":
        raise MapError(f"{path}: height is {kind}, wanted floating point or integer metres")
    if role == "terrain" and kind.kind not in "iu":
        raise MapError(f"{path}: terrain is {kind}, wanted integer class values")
    return (plain[0],), []


def _scaling(dataset: Any, path: Path, role: str, bands: tuple[int, ...]) -> tuple[tuple[float, float], list[str]]:
    """Return scale and offset to metres; for other roles, a note that such tags were not applied."""
    scale, offset = dataset.scales[bands[0] - 1], dataset.offsets[bands[0] - 1]
    if role != "height":
        tagged = (scale, offset) != (1.0, 0.0)
        return (1.0, 0.0), [
            f"{path.name}: scale {scale:g} and offset {offset:g} are not applied to {role}"
        ] if tagged else []
    unit = (dataset.units[bands[0] - 1] or "").strip()
    if unit.lower() not in _METRES:
        raise MapError(f"{path}: height is in {unit!r}, wanted metres (or cm, mm, ft)")
    metres = _METRES[unit.lower()] if unit else _vertical_unit_m(dataset)
    return (scale * metres, offset * metres), []


def _vertical_unit_m(dataset: Any) -> float:
    """Return the unit of a compound CRS's heights [m]; a metre where the CRS says nothing of heights."""
    crs = CRS.from_wkt(dataset.crs.to_wkt()) if dataset.crs else None
    vertical = [part for part in crs.sub_crs_list if part.is_vertical] if crs else []
    return float(vertical[0].axis_info[0].unit_conversion_factor) if vertical else 1.0


def _described(dataset: Any) -> str:
    """Return the dataset as a VRT document: GDAL's own reading of attribute tables and names, wherever a format keeps them."""
    with MemoryFile(ext=".vrt") as memory:
        rasterio.shutil.copy(dataset, memory.name, driver="VRT")
        return str(memory.read().decode("utf-8", "replace"))


def burn_polygons(
    polygons: NDArray[np.object_],
    ids: NDArray[np.uint8],
    *,
    affine: tuple[float, float, float, float, float, float],
    rows: int,
    cols: int,
) -> NDArray[np.uint8]:
    """Return the id of the last polygon that each pixel's centre lies in, shape (rows, cols); 0 where there is none."""
    if not len(polygons):
        return np.zeros((rows, cols), np.uint8)
    shapes = zip(polygons.tolist(), ids.tolist(), strict=True)
    return np.asarray(rasterize(shapes, (rows, cols), transform=rasterio.Affine(*affine), dtype=np.uint8))


def _palette_grey(colormap: dict[int, tuple[int, int, int, int]]) -> NDArray[np.float64]:
    """Return grey by palette index; NaN where the palette is transparent or has no entry."""
    grey = np.full(65536, np.nan)
    for index, (red, green, blue, alpha) in colormap.items():
        if alpha >= _OPAQUE:
            grey[index] = np.dot(LUMA_RGB, (red, green, blue))
    return grey


_STRIP_ROWS = 512


def write_geotiff(
    path: Path,
    strip: Callable[[int, int], NDArray[Any]],
    *,
    rows: int,
    cols: int,
    affine: tuple[float, float, float, float, float, float],
    crs: str,
    dtype: str,
    bands: int = 1,
    nodata: float | None = None,
    palette: Mapping[int, tuple[int, int, int]] | None = None,
) -> None:
    """Write a tiled, deflated GeoTIFF strip by strip, whole or not at all.

    ``strip(first_row, last_row)`` returns (bands, rows, cols); ``affine`` is of pixel corners, as in `Raster`; four bands are RGB
    and alpha.
    """
    profile = {
        "driver": "GTiff",
        "height": rows,
        "width": cols,
        "count": bands,
        "dtype": dtype,
        "crs": crs,
        "nodata": nodata,
    }
    profile |= {
        "transform": rasterio.Affine(*affine),
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
        "BIGTIFF": "IF_SAFER",
    }
    profile |= {"compress": "deflate", "zlevel": 1, "predictor": 3 if dtype == "float32" else 2}
    if bands == 4:
        profile |= {"photometric": "RGB", "alpha": "YES"}
    with atomic_file(path) as temporary, rasterio.open(temporary, "w", **profile) as dataset:
        if palette is not None:  # before the first pixel: GDAL cannot change what is on disk already
            dataset.write_colormap(1, {value: (*colour, 255) for value, colour in palette.items()})
        for first in range(0, rows, _STRIP_ROWS):
            last = min(first + _STRIP_ROWS, rows)
            dataset.write(strip(first, last), window=Window(0, first, cols, last - first))


def write_cog(
    path: Path,
    strip: Callable[[int, int], NDArray[Any]],
    *,
    rows: int,
    cols: int,
    affine: tuple[float, float, float, float, float, float],
    crs: str,
    dtype: str,
    nodata: float | None,
    bands: Sequence[tuple[str, str]],
) -> None:
    """Write a Cloud-Optimised GeoTIFF strip by strip, whole or not at all; overviews hold every second pixel, nothing is averaged.

    ``strip`` and ``affine`` as in `write_geotiff`; ``bands`` are names and units.
    """
    with atomic_file(path) as temporary:
        plain = temporary.with_name("plain.tif")
        write_geotiff(
            plain, strip, rows=rows, cols=cols, affine=affine, crs=crs, dtype=dtype, bands=len(bands), nodata=nodata
        )
        with rasterio.open(plain, "r+") as dataset:
            dataset.descriptions = [name for name, _ in bands]
            dataset.units = [unit for _, unit in bands]
        options = {"compress": "deflate", "predictor": "yes", "blocksize": 256, "overview_resampling": "nearest"}
        rasterio.shutil.copy(plain, temporary, driver="COG", bigtiff="IF_SAFER", **options)


def read_bands(path: Path, bands: Sequence[int]) -> NDArray[Any]:
    """Return bands, counted from 1, of a GeoTIFF that `write_cog` wrote, shape (B, rows, cols).

    Raises
    ------
    MapError
        It cannot be read.
    """
    try:
        with _opened(path) as dataset:
            return np.asarray(dataset.read(list(bands)))
    except RasterioError as error:
        raise MapError(f"{path}: cannot be read; the file is damaged ({str(error).splitlines()[0]})") from error
