"""GeoTIFF, JPEG 2000 and ERDAS Imagine, as windows of numbers with their validity: the one home of rasterio.

GDAL opens every file that a raster refers to, also on other disks or servers. Therefore tcpipe checks a user's
file first: its first bytes determine its one driver, and the files of its name in the same folder must be plain too.
Virtual rasters (VRT), which name other files, are not supported.

A raster is opened *for a role* (height, ortho, terrain, or a layer of the user's) and refused at once, in one line, if
it cannot play it: no place on the earth, placed by control points only, wrong bands, wrong numbers. Pixel-is-point
tags, south-up and rotated affines, scale and offset tags, units, palettes, alpha, mask bands, nodata tags and NaN are
handled here; the results are metres, grey from 0 to 255, or raw class values, each with a mask.
"""

import logging
import shlex
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

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

from tcpipe.arrays import AnyArray, Bytes, Floats, Mask
from tcpipe.errors import MapError
from tcpipe.formats.atomic import write_atomic_file
from tcpipe.formats.maps.map_facts import read_value_names
from tcpipe.tables.findings import Findings, Subject, make_finding
from tcpipe.terrain.layers import LUMA_RGB
from tcpipe.terrain.target_grid import MapGrid

Use = Literal["metres", "grey", "red", "green", "blue", "classes", "numbers"]
"""Content of a raster: heights, an orthophoto or one of its colours, class values, or numbers in their own unit."""

USES: dict[str, Use] = {"height": "metres", "ortho": "grey", "terrain": "classes"}
"""Use by role."""

COLOUR_USES: dict[str, Use] = {"ortho_red": "red", "ortho_green": "green", "ortho_blue": "blue"}
"""Use of an orthophoto by the layer of its colour."""

_WEIGHTS = {"grey": LUMA_RGB, "red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0)}
"""Weights of red, green and blue, by use."""

_METRES = {"": 1.0, "m": 1.0, "metre": 1.0, "km": 1000.0, "kilometre": 1000.0, "dm": 0.1, "decimetre": 0.1}
_METRES |= {"cm": 0.01, "centimetre": 0.01, "mm": 0.001, "millimetre": 0.001}
_METRES |= dict.fromkeys(("ft", "foot", "ftint", "intft", "internationalfoot"), 0.3048)
_METRES |= dict.fromkeys(("usft", "ftus", "footus", "usfoot", "ussft", "surveyfoot", "ussurveyfoot"), 1200.0 / 3937.0)
"""Metres by the name of a unit, of letters only."""

GDAL_CONFIG = {
    "GDAL_CACHEMAX": 256_000_000,  # [byte] decoded blocks: many windows need a strip of a wide raster
    "GDAL_DISABLE_READDIR_ON_OPEN": "TRUE",  # files beside the raster are requested by name, see `_refuse_beside`
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "GDAL_PAM_ENABLED": "YES",
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
}
"""How GDAL is set up wherever a raster of the user's is opened."""

_HFA = b"EHFA_HEADER_TAG\0"
_DRIVERS = {
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "GTiff"),
    **dict.fromkeys((b"\0\0\0\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51"), "JP2OpenJPEG"),
    _HFA: "HFA",
}
"""Drivers by the first bytes of a file. All have a zero byte there, which ends the text that other drivers read."""

_OTHERS = {
    b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"\x89HDF": "HDF5 or netCDF 4",
    b"CDF": "netCDF",
    b"SQLite format 3": "a GeoPackage or another SQLite database",
    b"PK": "a zip archive",
    b"\x1f\x8b": "compressed by gzip",
    b"ncols": "an ASCII grid",
    b"NCOLS": "an ASCII grid",
    b"{": "JSON",
    b"<": "XML",
}
"""Kinds of files by their first bytes; GDAL reads most of them as rasters."""

_VRT = b"<VRTDataset"  # by which GDAL knows a virtual raster, in the first bytes of a file of any name

_REDIRECTIONS = ("OVERVIEWS", "ProxyOverviewRequest")
"""Domains of tags, in a GeoTIFF or in its statistics file, that make GDAL open another file, or an address."""

_MAX_OPEN = 32  # files that are open at one time

_MAX_BLOCK_BYTES = 256_000_000  # largest block that is decoded at one time: a tile or a strip of a raster [byte]

_MAX_STATISTICS_BYTES = 16_000_000

_OPAQUE = 1  # least mask or alpha of a valid pixel; 16-bit alpha is often written as 255, which is almost transparent


@dataclass(frozen=True, slots=True)
class Tile:
    """A raster file that can be used as its role; `read_window` reads it.

    ``affine`` is (a, b, c, d, e, f) of x = a·col + b·row + c, y = d·col + e·row + f at pixel *corners*; ``crs`` is WKT,
    or empty where the file has none; ``findings`` are about its bands and tags.
    """

    path: Path
    role: str
    use: Use
    crs: str
    affine: tuple[float, float, float, float, float, float]
    rows: int
    cols: int
    kind: str
    """Type and bands, which the tiles of one layer share."""
    findings: Findings
    names: Mapping[int, str]
    """Names of values, from the raster attribute table or the category names; empty without such names."""
    driver: str
    dtype: str
    """Type of the values that are read: the file's for classes, else float64."""
    nodata: float
    """The tag; NaN also without a tag."""
    bands: tuple[int, ...]
    scale: tuple[float, float]
    """Scale and offset to metres, to grey from 0 to 255, or to the numbers that are meant."""
    unit: str
    """Unit of numbers by the file; empty if the file states no unit."""
    opaque: Mask | None
    """Whether each index of a palette is visible."""


OpenFile = Callable[[Path, str], Any]
"""Returns a raster's dataset by its path and driver."""


@contextmanager
def keep_open() -> Iterator[OpenFile]:
    """Yield a function that opens rasters with GDAL set up as `GDAL_CONFIG`; those read last stay open."""
    kept = lru_cache(_MAX_OPEN)(_open)
    with rasterio.Env(**GDAL_CONFIG):
        try:
            yield kept
        finally:
            kept.cache_clear()


def read_window(  # noqa: PLR0917
    open_file: OpenFile, tile: Tile, row0: int, row1: int, col0: int, col1: int, shape: tuple[int, int] | None = None
) -> tuple[AnyArray, Mask]:
    """Return a window of a tile, and which of its pixels have data; `MapError`: damaged, or missing file.

    Values are float64 metres or numbers, float64 grey or colour from 0 to 255, or raw integers of classes. If the
    ``shape`` is smaller than the window, GDAL takes the nearest pixels, from the file's overviews if it has any.
    """
    window = Window(col0, row0, col1 - col0, row1 - row0)
    dataset = open_file(tile.path, tile.driver)
    try:
        raw = dataset.read(tile.bands, window=window, out_shape=shape and (len(tile.bands), *shape))
        mask = dataset.dataset_mask(window=window, out_shape=shape)
    except RasterioError as error:
        raise MapError(
            f"{tile.path}: rows {row0} to {row1}, columns {col0} to {col1} cannot be read; the file is damaged: "
            f"{describe_raster_error(error)}"
        ) from error
    valid = mask >= _OPAQUE
    if tile.use == "classes" and raw.dtype.kind == "f":
        valid &= np.isfinite(raw[0])
        return _read_whole_numbers(tile, raw[0], valid), valid
    if tile.use == "classes":
        return raw[0], valid if tile.opaque is None else valid & tile.opaque[raw[0]]
    weights = _WEIGHTS.get(tile.use)
    values = raw[0] * tile.scale[0] + tile.scale[1] if weights is None else _read_grey(dataset, tile, raw, weights)
    return values, valid & np.isfinite(values)


def _read_whole_numbers(tile: Tile, values: AnyArray, valid: Mask) -> AnyArray:
    """Return class values that are stored as floats; `MapError` for one that is no whole number."""
    whole = np.where(valid, values, 0.0)
    invalid = whole[(whole != np.rint(whole)) | (np.abs(whole) > np.iinfo(tile.dtype).max)]
    if invalid.size:
        raise MapError(
            f"{tile.path}: {tile.role} has the value {invalid[0]:g}, expected whole numbers; if classes were interpolated, transform the "
            "original raster: rio warp in.tif out.tif --like height.tif --resampling nearest"
        )
    return whole.astype(tile.dtype)


def _read_grey(dataset: Any, tile: Tile, raw: AnyArray, weights_rgb: tuple[float, float, float]) -> Floats:
    if dataset.colorinterp[tile.bands[0] - 1] == ColorInterp.palette:
        return np.asarray(_read_palette_grey(dataset.colormap(tile.bands[0]), weights_rgb)[raw[0]])
    weights = np.array(weights_rgb if len(tile.bands) == 3 else (1.0,)) * tile.scale[0]
    return np.tensordot(weights, raw.astype(float), 1)


def read_tile(path: Path, role: str, use: Use) -> Tile:
    """Return a raster file as the tile of a role.

    `MapError`: it is no raster of a kind that is read, names files elsewhere, has no place on the earth, or its bands
    cannot play the role.
    """
    with rasterio.Env(**GDAL_CONFIG):
        driver, _ = _list_plain_files(path)
        with _open(path, driver) as dataset:
            _refuse_unplaced(dataset, path)
            bands, unusual = _choose_bands(dataset, path, role, use)
            scale, ignored = _read_scaling(dataset, path, role, use, bands)
            unit = (dataset.units[bands[0] - 1] or "").strip() if use == "numbers" else ""
            palette = use == "classes" and dataset.colorinterp[bands[0] - 1] == ColorInterp.palette
            colours = ", ".join(dataset.colorinterp[band - 1].name for band in bands)
            many = f"{len(bands)} x " if len(bands) > 1 else ""
            return Tile(
                path=path,
                role=role,
                use=use,
                crs=dataset.crs.to_wkt() if dataset.crs else "",
                affine=tuple(dataset.transform)[:6],
                rows=dataset.height,
                cols=dataset.width,
                kind=f"{many}{dataset.dtypes[bands[0] - 1]} ({colours[:80]}{', ' if unit else ''}{unit})",
                findings=(*unusual, *ignored),
                names=read_value_names(_describe_as_vrt(dataset), bands[0]) if use == "classes" else {},
                driver=driver,
                dtype=dataset.dtypes[bands[0] - 1].replace("float", "int") if use == "classes" else "float64",
                nodata=float(np.nan if (tag := dataset.nodatavals[bands[0] - 1]) is None else tag),
                bands=bands,
                scale=scale,
                unit=unit,
                opaque=np.isfinite(_read_palette_grey(dataset.colormap(bands[0]))) if palette else None,
            )


def list_raster_files(path: Path) -> tuple[Path, ...]:
    """Return all files of a raster: itself, and files of its name in its folder (masks, world files, statistics)."""
    with rasterio.Env(**GDAL_CONFIG):
        return _list_plain_files(path)[1]


def _find_driver(path: Path, raster: Path) -> str:
    """Return a file's driver by its first bytes, as GDAL does; ``raster`` is that file or the raster it belongs to."""
    head = _read_beginning(path)
    for start, driver in _DRIVERS.items():
        if head.startswith(start):
            return driver
    if _VRT in head:
        raise MapError(
            f"{path}: is a GDAL virtual raster (VRT), which names other files; write it out as a GeoTIFF: {_rewrite(raster)}"
        )
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    known = next((name for start, name in _OTHERS.items() if text.startswith(start)), None)
    what = known or ("something else" if head else "empty")
    more = f" ({_rewrite(raster)})" if known else ""
    if path.suffix.lower() in {".shp", ".gpkg", ".kml", ".geojson", ".json"}:
        more += "; terrain may also be polygons, exported as .geojson"
    raise MapError(f"{path}: is {what}, not a raster that is read; expected GeoTIFF, JPEG 2000 or ERDAS Imagine{more}")


def _read_beginning(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(4096)
    except FileNotFoundError:
        raise MapError(f"{path}: there is no such file") from None
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from None


def _list_plain_files(path: Path, raster: Path | None = None) -> tuple[str, tuple[Path, ...]]:
    """Return a raster's driver and files, itself first; `MapError` if one of them names another file or is too large.

    ``raster`` is the raster to which it belongs, if any.
    """
    driver = _find_driver(path, raster or path)
    _refuse_beside(path)
    with _open(path, driver) as dataset:
        check_layout(dataset, str(path), f"write it again: {_rewrite(path)}")
        files = {Path(name) for name in dataset.files}
    strangers = sorted(str(file) for file in files if file.parent != path.absolute().parent)
    if strangers:
        raise MapError(f"{path}: refers to {strangers[0]}, which is not in the same directory; {_rewrite(path)}")
    return driver, (path, *sorted(path.with_name(file.name) for file in files if file.name != path.name))


def check_layout(dataset: Any, where: str, remedy: str) -> None:
    """Raise `MapError` for complex numbers, overviews in another file, and blocks that do not fit into memory."""
    if any(dtype.startswith("complex") for dtype in dataset.dtypes):
        raise MapError(
            f"{where}: has complex numbers, expected real ones; keep their real part: "
            'rio calc --not-masked "(real (read 1 1))" in.tif out.tif --dtype float32'
        )
    if any(dataset.tags(ns=domain) for domain in _REDIRECTIONS):
        raise MapError(f"{where}: names another file for its overviews, which tcpipe does not open; {remedy}")
    block = max(
        rows * cols * np.dtype(dtype).itemsize
        for (rows, cols), dtype in zip(dataset.block_shapes, dataset.dtypes, strict=True)
    )
    block *= dataset.count if dataset.profile.get("interleave") == "pixel" else 1
    if block > _MAX_BLOCK_BYTES:
        raise MapError(
            f"{where}: stored in blocks of {block / 1e6:.0f} MB, at most {_MAX_BLOCK_BYTES // 10**6}; "
            f"{remedy} --co tiled=true --co blockxsize=256 --co blockysize=256 --co bigtiff=if_safer"
        )


def _refuse_beside(path: Path) -> None:
    """Refuse masks, overviews and statistics of a raster that point GDAL to other places or are too large."""
    endings = [ending for lower in (".msk", ".ovr", ".aux") for ending in (lower, lower.upper())]
    names = [*(f"{path.name}{ending}" for ending in endings), *(f"{path.stem}{ending}" for ending in endings[-2:])]
    for beside in (path.with_name(name) for name in names if name != path.name):
        if not beside.is_file() or (beside.suffix.lower() == ".aux" and not _read_beginning(beside).startswith(_HFA)):
            continue
        _list_plain_files(beside, path)
    statistics = path.with_name(f"{path.name}.aux.xml")
    if statistics.is_file() and statistics.stat().st_size > _MAX_STATISTICS_BYTES:
        size = f"{statistics.stat().st_size / 1e6:.0f} MB"
        raise MapError(
            f"{statistics}: {size}, at most {_MAX_STATISTICS_BYTES // 10**6}; write its raster again: {_rewrite(path)}"
        )


def _rewrite(path: Path) -> str:
    """Return the command that writes a raster as a GeoTIFF beside it."""
    target = path.with_suffix(".tif")
    return shlex.join(
        ["rio", "convert", str(path), str(target if target != path else path.with_stem(f"{path.stem}-copy"))]
    )


def _open(path: Path, driver: str) -> Any:
    logging.getLogger("rasterio").addHandler(logging.NullHandler())  # the error of tcpipe contains GDAL's lines
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            return rasterio.open(path.absolute(), driver=driver)  # from the root on: no GDAL prefix, no address
        except RasterioError as error:
            raise MapError(
                f"{path}: not a raster that GDAL can read; the file is damaged: {describe_raster_error(error)}"
            ) from error


def describe_raster_error(error: BaseException) -> str:
    """Return the first line of an error of GDAL."""
    return str(error.__cause__ or error).splitlines()[0][:200]


def _refuse_unplaced(dataset: Any, path: Path) -> None:
    if dataset.count == 0:
        raise MapError(f"{path}: the file contains no bands itself; export one of its subdatasets as a GeoTIFF")
    if dataset.crs is None and dataset.gcps[0]:
        raise MapError(
            f"{path}: placed only by {len(dataset.gcps[0])} ground control points; rectify it: rio warp in.tif out.tif --dst-crs EPSG:n"
        )
    if dataset.transform.is_identity:
        raise MapError(
            f"{path}: has no georeference; give it one (rio edit-info FILE --crs EPSG:n --transform '[pixel,0,x_min,0,-pixel,y_max]')"
        )
    if dataset.transform.is_degenerate:
        raise MapError(f"{path}: its georeference has pixels without area")


def _choose_bands(dataset: Any, path: Path, role: str, use: Use) -> tuple[tuple[int, ...], Findings]:
    subject, file = Subject("layer", role), {"file": path.name}
    colours = {colour: band for band, colour in reversed(list(enumerate(dataset.colorinterp, 1)))}
    plain = [band for band, colour in enumerate(dataset.colorinterp, 1) if colour != ColorInterp.alpha]
    names = ", ".join(colour.name for colour in dataset.colorinterp)
    kinds = {np.dtype(dataset.dtypes[band - 1]) for band in plain}
    if use == "grey":
        rgb = [colours.get(colour) for colour in (ColorInterp.red, ColorInterp.green, ColorInterp.blue)]
        palette = dataset.colorinterp[0] == ColorInterp.palette
        if not palette and any(kind not in {np.dtype(np.uint8), np.dtype(np.uint16)} for kind in kinds):
            expected = "8-bit or 16-bit unsigned; scale it to 1 to 255, with 0 for no data (rio calc)"
            raise MapError(f"{path}: ortho is {dataset.dtypes[0]}, expected {expected}")
        if None not in rgb:
            more = make_finding("ortho-bands-unused", subject, names={**file, "bands": names})
            return tuple(band for band in rgb if band is not None), (more,) if len(plain) > 3 else ()
        if len(plain) == 1:
            return (plain[0],), ()
        if len(plain) == 3:
            return tuple(plain), (make_finding("ortho-colours-assumed", subject, names=file),)
        raise MapError(
            f"{path}: ortho has {dataset.count} bands ({names}), expected grey or red, green, blue, and alpha at most"
        )
    if len(plain) != 1:
        problem = f"{path}: {role} has {dataset.count} bands ({names[:80]}), expected one"
        has_colours = use == "classes" and len(plain) == 3 and kinds == {np.dtype(np.uint8)}
        raise MapError(problem + " of class values; convert each colour to a value (rio calc)" * has_colours)
    kind = kinds.pop()
    wanted = "metres" if use == "metres" else "numbers"
    if use != "classes" and dataset.colorinterp[plain[0] - 1] == ColorInterp.palette:
        hint = "" if use == "metres" else f"; are they classes? add --categorical {role}"
        raise MapError(f"{path}: {role} is a palette of colours, expected {wanted}{hint}")
    if use != "classes" and kind.kind not in "fiu":
        raise MapError(f"{path}: {role} is {kind}, expected floating point or integer {wanted}")
    if use == "classes" and kind.kind not in "iuf":
        raise MapError(f"{path}: {role} is {kind}, expected integer class values")
    return tuple(plain), ()


def _read_scaling(
    dataset: Any, path: Path, role: str, use: Use, bands: tuple[int, ...]
) -> tuple[tuple[float, float], Findings]:
    """Return scale and offset to metres, numbers or grey; for grey and classes, a finding that tags were ignored."""
    scale, offset = dataset.scales[bands[0] - 1], dataset.offsets[bands[0] - 1]
    if use == "numbers":
        return (scale, offset), ()
    if use != "metres":
        size = np.dtype(dataset.dtypes[bands[0] - 1]).itemsize
        bits = dataset.tags(bands[0], ns="IMAGE_STRUCTURE").get("NBITS", 8 * size)  # 12 of 16
        grey = (255.0 / (2 ** int(bits) - 1) if use == "grey" else 1.0, 0.0)
        if (scale, offset) == (1.0, 0.0):
            return grey, ()
        subject, file = Subject("layer", role), {"file": path.name}
        return grey, (make_finding("scale-not-applied", subject, names=file, scale=scale, offset=offset),)
    unit = (dataset.units[bands[0] - 1] or "").strip()
    name = "".join(letter for letter in unit.lower() if letter.isalpha())
    name = name.replace("meter", "metre").replace("metres", "metre").replace("feet", "foot")
    if name not in _METRES or bool(unit) != bool(name):
        raise MapError(
            f"{path}: height is in {unit!r}, expected a unit that tcpipe knows; name it: "
            f"rio edit-info {shlex.quote(str(path))} --bidx {bands[0]} --units m (or dm, cm, mm, km, ft, us-ft)"
        )
    metres = _METRES[name] if unit else _find_vertical_unit_m(dataset, path)
    return (scale * metres, offset * metres), ()


def _find_vertical_unit_m(dataset: Any, path: Path) -> float:
    """Return the unit of a compound CRS's heights [m]; a metre if the CRS has no height unit and is metric itself."""
    crs = CRS.from_wkt(dataset.crs.to_wkt()) if dataset.crs else None
    vertical = [part for part in crs.sub_crs_list if part.is_vertical] if crs else []
    if vertical:
        return float(vertical[0].axis_info[0].unit_conversion_factor)
    if crs is not None and crs.is_projected and "foot" in (lain := crs.axis_info[0].unit_name).lower():
        raise MapError(
            f"{path}: its CRS is in {lain}, and the unit of its heights is unknown; state it in the file: "
            f"rio edit-info {shlex.quote(str(path))} --bidx 1 --units ft (or us-ft, or m)"
        )
    return 1.0


def _describe_as_vrt(dataset: Any) -> str:
    """Return the dataset as a VRT document: GDAL's own reading of attribute tables and names in any format."""
    with MemoryFile(ext=".vrt") as memory:
        rasterio.shutil.copy(dataset, memory.name, driver="VRT")
        return str(memory.read().decode("utf-8", "replace"))


def burn_polygons(polygons: NDArray[np.object_], ids: Bytes, grid: MapGrid) -> Bytes:
    """Return the id of the last polygon that contains each pixel's centre, shape (rows, cols); 0 without a polygon."""
    shape = grid.rows, grid.cols
    if not len(polygons):
        return np.zeros(shape, np.uint8)
    shapes = zip(polygons.tolist(), ids.tolist(), strict=True)
    return np.asarray(rasterize(shapes, shape, transform=rasterio.Affine.from_gdal(*grid.geotransform), dtype=np.uint8))


def _read_palette_grey(
    colormap: dict[int, tuple[int, int, int, int]], weights_rgb: tuple[float, float, float] = LUMA_RGB
) -> Floats:
    """Return grey by palette index; NaN where the palette is transparent or has no entry."""
    grey = np.full(65536, np.nan)
    for index, (red, green, blue, alpha) in colormap.items():
        if alpha >= _OPAQUE:
            grey[index] = np.dot(weights_rgb, (red, green, blue))
    return grey


_STRIP_ROWS = 512


def write_geotiff(
    path: Path,
    strip: Callable[[int, int], AnyArray],
    grid: MapGrid,
    *,
    dtype: str,
    bands: int = 1,
    nodata: float | None = None,
    palette: Mapping[int, tuple[int, int, int]] | None = None,
) -> None:
    """Write a tiled, deflated GeoTIFF strip by strip, whole or not at all.

    ``strip(first_row, last_row)`` returns (bands, rows, cols); four bands are RGB and alpha.
    """
    profile = {"driver": "GTiff", "height": grid.rows, "width": grid.cols, "count": bands, "dtype": dtype}
    profile |= {
        "crs": grid.crs,
        "transform": rasterio.Affine.from_gdal(*grid.geotransform),
        "nodata": nodata,
        "BIGTIFF": "IF_SAFER",
    }
    profile |= {"tiled": True, "blockxsize": 256, "blockysize": 256}
    profile |= {"compress": "deflate", "zlevel": 1, "predictor": 3 if dtype == "float32" else 2}
    if bands == 4:
        profile |= {"photometric": "RGB", "alpha": "YES"}
    with write_atomic_file(path) as temporary:
        with rasterio.open(temporary, "w", **profile) as dataset:
            if palette is not None:  # before the first pixel, since GDAL cannot change it later
                dataset.write_colormap(1, {value: (*colour, 255) for value, colour in palette.items()})
            for first in range(0, grid.rows, _STRIP_ROWS):
                last = min(first + _STRIP_ROWS, grid.rows)
                dataset.write(strip(first, last), window=Window(0, first, grid.cols, last - first))
        with _convert_late_errors():
            _read_again(temporary)


@contextmanager
def _convert_late_errors() -> Iterator[None]:
    """Convert errors of GDAL while it writes into `OSError`; its errors have no common base class."""
    try:
        yield
    except Exception as error:
        raise OSError(
            f"GDAL could not finish the file (often: No space left on device): {describe_raster_error(error)}"
        ) from error


def _read_again(path: Path) -> None:
    """Read every pixel of a file: on a full disk GDAL closes it without an error, and its end is missing."""
    with rasterio.open(path) as dataset:
        for first in range(0, dataset.height, _STRIP_ROWS):
            dataset.read(window=Window(0, first, dataset.width, min(_STRIP_ROWS, dataset.height - first)))


def write_cog(
    path: Path, strip: Callable[[int, int], AnyArray], grid: MapGrid, *, dtype: str, bands: Sequence[tuple[str, str]]
) -> None:
    """Write a Cloud-Optimised GeoTIFF as `write_geotiff`; overviews contain every second pixel, without averaging.

    ``bands`` are names and units.
    """
    with write_atomic_file(path) as temporary:
        plain = temporary.with_name("plain.tif")
        nodata = float("nan") if np.dtype(dtype).kind == "f" else None
        write_geotiff(plain, strip, grid, dtype=dtype, bands=len(bands), nodata=nodata)
        with _convert_late_errors():
            with rasterio.open(plain, "r+") as dataset:
                dataset.descriptions = [name for name, _ in bands]
                dataset.units = [unit for _, unit in bands]
            options = {"compress": "deflate", "predictor": "yes", "blocksize": 256, "overview_resampling": "nearest"}
            rasterio.shutil.copy(plain, temporary, driver="COG", bigtiff="IF_SAFER", **options)
            _read_again(temporary)


def read_bands(path: Path, bands: Sequence[int]) -> AnyArray:
    """Return bands, counted from 1, of a GeoTIFF from `write_cog`, shape (B, rows, cols). `MapError`: unreadable."""
    try:
        with keep_open() as open_file:
            dataset = open_file(path, _list_plain_files(path)[0])
            return np.asarray(dataset.read(list(bands)))
    except RasterioError as error:
        raise MapError(f"{path}: cannot be read; the file is damaged ({describe_raster_error(error)})") from error
