"""Maps on disk: ``maps/<name>.zarr``, a Zarr v3 group with one array a layer on one common grid.

===========  =======  ==========================================================================
array        type     meaning
===========  =======  ==========================================================================
height       float32  metres above the attribute ``add_offset``; NaN: no data
ortho        uint8    grey from 1 to 255 (black is stored as 1); 0: no data
terrain      uint8    class ids of the class table; 0: no data
ortho_red …  uint8    red, green and blue of an orthophoto kept in colour, as ortho
any other    float32  a user's continuous layer, in its own unit; NaN: no data
any other    uint8    a user's categorical layer: class ids of its own table; 0: no data
bands/NAME   float    a user's layer of several bands, a group: (band, y, x) on a grid of its own, x and y; NaN: no data
x, y         float64  pixel centres in the map's CRS [m]
spatial_ref  int64    CF grid mapping: the CRS as WKT, and GDAL's GeoTransform
===========  =======  ==========================================================================

The groups ``overviews/2``, ``overviews/4`` … hold the same arrays at coarser levels (`tcpipe.terrain.resampling`). Attributes follow
CF (``grid_mapping``, ``flag_values``) and GeoZarr (``proj:``, ``spatial:``), so that xarray opens map and overviews as they are, and
so does GDAL from 3.13 on, the first that reads shards.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from tcpipe.errors import MapError, StoreError
from tcpipe.formats.bucket_directories import FetchedShards
from tcpipe.formats.integrity import read_checksums
from tcpipe.formats.json_files import convert_record, parse_typed, read_json, to_plain
from tcpipe.formats.maps.map_facts import Description, MapFacts, MapSummary, describe_layer, make_cf_flags, read_layers
from tcpipe.formats.place import prove_files
from tcpipe.formats.shards import DESCRIPTION, ShardedArray, open_sharded
from tcpipe.formats.zarr_arrays import add_array, consolidate_metadata, create_group
from tcpipe.tables.facts import LEFT_OUT
from tcpipe.tables.options import rename_keys
from tcpipe.terrain.classes import ClassScheme, ClassTable, TerrainClass
from tcpipe.terrain.layers import LAYERS, PAPER_LAYERS, Layer, Pixels, find_no_data_value
from tcpipe.terrain.resampling import iterate_levels, list_factors, make_overview_grid
from tcpipe.terrain.target_grid import MAX_PIXELS, MAX_SIDE_PX, MapGrid

TILE_PX = 512
"""Side of a tile: the unit that is decoded."""

BANDS = "bands"
"""Group of the layers of several bands."""

SHARD_PX = 2048
"""Side of a shard: the unit that is a file, and that is written at once."""

PAPER_VERSION, OWN_VERSION, MAP_VERSION = "1.1", "1.2", "1.3"
"""1.2: a map has other layers than the paper's, which its key ``described`` tells of; 1.3: some of several bands."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Attributes:
    """What a map keeps of itself, as the attribute ``tcpipe_map``."""

    version: str
    name: str
    grid: MapGrid
    class_table: tuple[TerrainClass, ...]
    id_by_value: Mapping[int, int]
    layers: tuple[str, ...]
    described: Mapping[str, Description] = field(default_factory=dict, metadata=LEFT_OUT)
    band_grids: Mapping[str, MapGrid] = field(default_factory=dict, metadata=LEFT_OUT)
    """Of layers of several bands."""
    factors: tuple[int, ...]
    tile_px: int
    height_reference_m: float
    facts: MapFacts


@dataclass(frozen=True, slots=True)
class BandFile:
    """A layer of several bands; satisfies `tcpipe.terrain.tiles.BandReader`."""

    name: str
    """Of the map."""
    layer: Layer
    grid: MapGrid
    tile_px: int
    _array: ShardedArray

    def read(self, row0: int, row1: int, col0: int, col1: int) -> NDArray[Any]:
        """Return a window of all bands, shape (bands, rows, columns), NaN without data; `MapError`: a tile is damaged."""
        try:
            bands = range(self._array.shape[0])
            return np.stack([self._array.window(row0, row1, col0, col1, lead=(band,)) for band in bands])
        except StoreError as error:
            raise MapError(f"map {self.name}: {self.layer.name} cannot be read ({error}); add the map again") from error


@dataclass(frozen=True, slots=True)
class MapFile:
    """An open map; satisfies `tcpipe.terrain.tiles.MapReader`."""

    name: str
    grid: MapGrid
    classes: ClassTable
    layers: Mapping[str, Layer]
    tile_px: int
    height_reference_m: float
    facts: MapFacts
    id_by_value: Mapping[int, int]
    """Which values of its terrain raster stood for which class ids."""
    factors: tuple[int, ...]
    _levels: Mapping[int, Mapping[str, ShardedArray]]
    """The arrays of each factor."""
    banded: Mapping[str, BandFile]
    """Layers of several bands, at their own resolution; the same at every factor."""
    _factor: int = 1

    def at(self, factor: int) -> MapFile:
        """Return the map at one of its ``factors``, which are the full map's."""
        return replace(self, grid=make_overview_grid(self.grid, factor), factors=(1,), _factor=factor)

    def select(self, layers: Collection[str]) -> MapFile:
        """Return the map with these of its layers alone."""
        kept = {name: layer for name, layer in self.layers.items() if name in layers}
        return replace(self, layers=kept, banded={name: bands for name, bands in self.banded.items() if name in layers})

    @property
    def all_layers(self) -> dict[str, Layer]:
        """All layers, those of several bands last."""
        return {**self.layers, **{name: bands.layer for name, bands in self.banded.items()}}

    def summary(self) -> MapSummary:
        """Return what the map is as a whole."""
        grid = self.grid
        return convert_record(
            self.facts,
            MapSummary,
            name=self.name,
            crs=grid.crs,
            rows=grid.rows,
            cols=grid.cols,
            pixel_size_m=grid.pixel_size_m,
            bounds_m=grid.bounds_m,
            layers=tuple(self.all_layers),
            overviews=self.factors[1:],
            class_table=self.classes.classes,
            described=_describe_layers(self.all_layers),
        )

    def read(self, layer: str, row0: int, row1: int, col0: int, col1: int) -> NDArray[Any]:
        """Return a window of a layer as stored: NaN or, of bytes, 0 where there is no data. `MapError`: a tile of the window is damaged."""
        with self._told(layer, row0, row1, col0, col1):
            return self._levels[self._factor][layer].window(row0, row1, col0, col1)

    def expect(self, tiles: Sequence[tuple[int, int]]) -> None:
        """Have tiles (row, column) of all layers brought here that are read soon, where they lie in a bucket."""
        for array in self._levels[self._factor].values():
            array.expect(tiles)

    def read_tile(self, layer: str, i: int, j: int, out: NDArray[Any]) -> None:
        """Decode the tile in row i and column j into ``out``, contiguous, `tile_px` each way; `MapError` as `read`."""
        grid, side = self.grid, self.tile_px
        with self._told(layer, i * side, (i + 1) * side, j * side, (j + 1) * side):
            array = self._levels[self._factor][layer]
            array.chunk((i, j), out=out)
        out[max(grid.rows - i * side, 0) :] = array.fill  # what a file holds beyond its array is nobody's promise
        out[:, max(grid.cols - j * side, 0) :] = array.fill

    @contextmanager
    def _told(self, layer: str, row0: int, row1: int, col0: int, col1: int) -> Iterator[None]:
        """Say which part of the map it was that could not be read."""
        try:
            yield
        except StoreError as error:
            raise MapError(
                f"map {self.name}: {layer}, rows {row0} to {row1}, columns {col0} to {col1} cannot be read ({error}); add the map again"
            ) from error


def open_map(path: Path, fetched: FetchedShards | None = None, *, proved: bool = True) -> MapFile:
    """Open a map for reading; its shards lie beside their descriptions, or are ``fetched``.

    Raises
    ------
    MapError : there is none, it is not a map of this program, or, where that is to be ``proved``, its descriptions are not as they were
        written or a file is gone: lost tiles would read as ground without data.
    """
    if not (path / DESCRIPTION).is_file():
        raise MapError(f"{path}: not a map, it has no {DESCRIPTION}; add one with: tcpipe add-map")
    try:
        attributes = read_json(path / DESCRIPTION).get("attributes")
    except StoreError as error:
        raise MapError(f"{path}: not a map ({error.problems[0]}); add one with: tcpipe add-map") from None
    found = attributes.get("tcpipe_map") if isinstance(attributes, dict) else None
    if not isinstance(found, dict) or found.get("version") not in {PAPER_VERSION, OWN_VERSION, MAP_VERSION}:
        version = found.get("version") if isinstance(found, dict) else None
        raise MapError(f"{path}: not a map of this version (got {version}, expected {MAP_VERSION}); add it again")
    try:
        kept = parse_typed(found | {"grid": rename_keys(found.get("grid"))}, _Attributes, path)
        described = {name: kept.described.get(name, {}) for name in (*kept.layers, *kept.band_grids)}
        every = read_layers(described, kept.class_table, path)
        layers = {name: every[name] for name in kept.layers}
        _refuse_sizes(kept, path)
    except StoreError as error:
        raise MapError(*(f"{problem}; add the map again" for problem in error.problems)) from None
    wanted = [f"{_level_path(factor)}{layer}" for factor in kept.factors for layer in kept.layers]
    wanted += [f"{BANDS}/{name}/{name}" for name in kept.band_grids]
    missing = [array for array in wanted if not (path / array / DESCRIPTION).is_file()]
    if missing:
        raise MapError(f"{path}: the map's {', '.join(missing)} is missing; add the map again")
    if proved:
        _prove(path, fetched)
    try:
        levels = {
            factor: {name: _open_array(path, layer, kept.grid, factor, fetched) for name, layer in layers.items()}
            for factor in kept.factors
        }
        banded = {
            name: BandFile(kept.name, every[name], grid, TILE_PX, _open_bands(path, every[name], grid, fetched))
            for name, grid in kept.band_grids.items()
        }
    except StoreError as error:
        raise MapError(*(f"{problem}; add the map again" for problem in error.problems)) from None
    classes = ClassTable(kept.class_table)
    return convert_record(kept, MapFile, classes=classes, layers=layers, _levels=levels, banded=banded)


def _refuse_sizes(kept: _Attributes, path: Path) -> None:
    """Raise `StoreError` where a map says that it is larger than any, or cut otherwise than every map is."""
    for grid in (kept.grid, *kept.band_grids.values()):
        rows, cols, pixel_size_m = grid.rows, grid.cols, grid.pixel_size_m
        if not (0 < rows <= MAX_SIDE_PX and 0 < cols <= MAX_SIDE_PX and rows * cols <= MAX_PIXELS and pixel_size_m > 0):
            raise StoreError(
                f"{path}: says that it has {rows} x {cols} pixels of {pixel_size_m} m, at most {MAX_SIDE_PX} a side"
            )
    wanted = (TILE_PX, list_factors(kept.grid))
    if (kept.tile_px, kept.factors) != wanted:
        raise StoreError(f"{path}: tiles and overviews are {(kept.tile_px, kept.factors)}, expected {wanted}")


def _open_array(path: Path, layer: Layer, whole: MapGrid, factor: int, fetched: FetchedShards | None) -> ShardedArray:
    grid, shard_px = make_overview_grid(whole, factor), _compute_shard_px(factor)
    return open_sharded(
        path / f"{_level_path(factor)}{layer.name}",
        shape=(grid.rows, grid.cols),
        chunk_shape=(TILE_PX, TILE_PX),
        shard_shape=(shard_px, shard_px),
        dtype=np.dtype(layer.mapped),
        fill=find_no_data_value(layer.mapped),
        sparse=True,
        fetched=fetched,
    )


def _open_bands(path: Path, layer: Layer, grid: MapGrid, fetched: FetchedShards | None) -> ShardedArray:
    return open_sharded(
        path / BANDS / layer.name / layer.name,
        shape=(len(layer.bands), grid.rows, grid.cols),
        chunk_shape=(1, TILE_PX, TILE_PX),
        shard_shape=(1, SHARD_PX, SHARD_PX),
        dtype=layer.mapped,
        fill=float("nan"),
        sparse=True,
        fetched=fetched,
    )


def _compute_shard_px(factor: int) -> int:
    """Return the side of a shard at a level."""
    return max(SHARD_PX // factor, TILE_PX)


def _prove(path: Path, fetched: FetchedShards | None) -> None:
    """Compare what describes a map with its checksums, and its other files by size: their tiles carry checksums of their own."""
    try:
        listed = read_checksums(path)
        prove_files(path, listed, [name for name in listed if Path(name).name == DESCRIPTION])
    except StoreError as error:
        raise MapError(*(f"{problem}; add the map again" for problem in error.problems)) from None
    size_of = fetched.size if fetched else _measure_size_on_disk
    lost = [str(path / name) for name, entry in listed.items() if not _has_size(path / name, entry.size_bytes, size_of)]
    if lost:
        more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
        raise MapError(f"{lost[0]}{more}: gone or cut short; add the map again")


def _has_size(path: Path, size_bytes: int, size_of: Callable[[Path], int]) -> bool:
    try:
        return size_of(path) == size_bytes
    except OSError:
        return False


def _measure_size_on_disk(path: Path) -> int:
    return path.stat().st_size


def _level_path(factor: int) -> str:
    return "" if factor == 1 else f"overviews/{factor}/"


class MapWriter:
    """Writes a map and its overviews shard by shard into a directory; `finish` makes it complete."""

    __slots__ = (
        "_banded",
        "_factors",
        "_grid",
        "_group",
        "_layers",
        "_levels",
        "_name",
        "_scheme",
        "height_reference_m",
    )

    def __init__(
        self, directory: Path, *, name: str, grid: MapGrid, scheme: ClassScheme, layers: Mapping[str, Layer]
    ) -> None:
        self._name, self._grid, self._scheme, self._layers = name, grid, scheme, layers
        self._factors = list_factors(grid)
        self._group = create_group(directory)
        self._levels = {factor: self._add_level(factor) for factor in self._factors}
        self._banded: dict[str, tuple[Any, MapGrid]] = {}
        self.height_reference_m: float | None = None
        """What stored heights are above [m]: the floor of the smallest of the first shard that has any."""

    def _add_level(self, factor: int) -> dict[str, Any]:
        group = self._group if factor == 1 else self._group.create_group(_level_path(factor).rstrip("/"))
        grid = make_overview_grid(self._grid, factor)
        return {name: _add_layer(group, layer, grid, _compute_shard_px(factor)) for name, layer in self._layers.items()}

    def write(self, layer: str, row0: int, col0: int, values: Pixels) -> None:
        """Write a shard whose corner is at a multiple of `SHARD_PX`; floats with NaN, bytes with 0, as no data."""
        if self._layers[layer].kind == "relative":
            if self.height_reference_m is None and np.isfinite(values).any():
                self.height_reference_m = float(np.floor(np.nanmin(values)))
            values = values - (self.height_reference_m or 0.0)
        _put(self._levels[1][layer], row0, col0, values)
        for factor, level in iterate_levels(self._layers[layer], values, self._factors):
            _put(self._levels[factor][layer], row0 // factor, col0 // factor, level)

    def add_bands(self, layer: Layer, grid: MapGrid) -> None:
        """Add a layer of several bands on a grid of its own, whose bands `write_band` writes."""
        group = self._group.create_group(f"{BANDS}/{layer.name}")
        _place(group, grid, f"{self._name}, {layer.name}")
        array = add_array(
            group,
            layer.name,
            shape=(len(layer.bands), grid.rows, grid.cols),
            dtype=layer.mapped,
            chunks=(1, TILE_PX, TILE_PX),
            shards=(1, SHARD_PX, SHARD_PX),
            dimensions=("band", "y", "x"),
            fill_value=float("nan"),
            attributes={"long_name": layer.long_name, "units": layer.unit, "grid_mapping": "spatial_ref"},
        )
        self._banded[layer.name] = array, grid

    def write_band(self, layer: str, band: int, row0: int, col0: int, values: Pixels) -> None:
        """Write a shard of one band, as `write`."""
        array, (rows, cols) = self._banded[layer][0], values.shape
        array[band, row0 : row0 + rows, col0 : col0 + cols] = values.astype(array.dtype)

    def finish(self, facts: MapFacts, layers: Mapping[str, Layer]) -> None:
        """Write coordinates and attributes; ``layers`` are all those of before, with the range that was found."""
        reference_m = self.height_reference_m or 0.0
        for factor, arrays in self._levels.items():
            arrays["height"].attrs.update({"add_offset": reference_m})
            group = self._group if factor == 1 else self._group[_level_path(factor).rstrip("/")]
            _place(
                group,
                make_overview_grid(self._grid, factor),
                f"{self._name}, {factor} x coarser" if factor > 1 else self._name,
            )
        kept = _Attributes(
            version=MAP_VERSION if self._banded else PAPER_VERSION if set(layers) <= set(LAYERS) else OWN_VERSION,
            name=self._name,
            grid=self._grid,
            class_table=self._scheme.table.classes,
            id_by_value=self._scheme.id_by_value,
            layers=tuple(name for name in layers if name not in self._banded),
            described=_describe_layers(layers),
            band_grids={name: grid for name, (_, grid) in self._banded.items()},
            factors=self._factors,
            tile_px=TILE_PX,
            height_reference_m=reference_m,
            facts=facts,
        )
        self._group.attrs.update({"tcpipe_map": to_plain(kept)})
        consolidate_metadata(self._group)


def _put(array: Any, row0: int, col0: int, values: Pixels) -> None:
    if values.size:
        array[row0 : row0 + values.shape[0], col0 : col0 + values.shape[1]] = values.astype(array.dtype)


def _place(group: Any, grid: MapGrid, title: str) -> None:
    """Say where a group's pixels lie: coordinates, the grid mapping, and the same as attributes."""
    crs = CRS(grid.crs)
    _add_axis(group, "x", grid.x_min_m + (np.arange(grid.cols) + 0.5) * grid.pixel_size_m)
    _add_axis(group, "y", grid.y_max_m - (np.arange(grid.rows) + 0.5) * grid.pixel_size_m)
    mapping = add_array(
        group,
        "spatial_ref",
        shape=(),
        dtype=np.int64,
        chunks=(),
        dimensions=(),
        attributes={**crs.to_cf(), "GeoTransform": " ".join(repr(value) for value in grid.geotransform)},
    )
    mapping[...] = 0
    authority = crs.to_authority(min_confidence=100)
    group.attrs.update(
        {
            "Conventions": "CF-1.11",
            "title": title,
            **({"proj:code": ":".join(authority)} if authority else {}),
            "proj:wkt2": crs.to_wkt(),
            "spatial:dimensions": ["y", "x"],
            "spatial:transform": [grid.pixel_size_m, 0.0, grid.x_min_m, 0.0, -grid.pixel_size_m, grid.y_max_m],
            "spatial:bbox": list(grid.bounds_m),
            "spatial:shape": [grid.rows, grid.cols],
        }
    )


_LONG_NAMES = {"height": "height of the ground", "ortho": "grey of the orthophoto", "terrain": "terrain class"}


def _describe_layers(layers: Mapping[str, Layer]) -> dict[str, Description]:
    """Return the descriptions of layers other than the paper's."""
    return {name: describe_layer(layer) for name, layer in layers.items() if name not in PAPER_LAYERS}


def _add_layer(group: Any, layer: Layer, grid: MapGrid, shard_px: int) -> Any:
    attributes: dict[str, Any] = {"long_name": _LONG_NAMES.get(layer.name, layer.long_name)}
    if layer.kind == "categorical":
        attributes |= {**make_cf_flags(layer.classes), "_FillValue": 0}
    else:
        attributes |= {"units": layer.unit, "scale_factor": layer.step if layer.stack == "greys" else 1.0}
        attributes |= {"_FillValue": 0} if layer.stack == "greys" else {}
    return add_array(
        group,
        layer.name,
        shape=(grid.rows, grid.cols),
        dtype=layer.mapped,
        chunks=(TILE_PX, TILE_PX),
        shards=(shard_px, shard_px),
        dimensions=("y", "x"),
        fill_value=find_no_data_value(layer.mapped),
        attributes={**attributes, "grid_mapping": "spatial_ref"},
    )


def _add_axis(group: Any, name: str, centres_m: NDArray[np.floating[Any]]) -> None:
    attributes = {"units": "m", "standard_name": f"projection_{name}_coordinate"}
    axis = add_array(
        group,
        name,
        shape=centres_m.shape,
        dtype=np.float64,
        chunks=centres_m.shape,
        dimensions=(name,),
        attributes=attributes,
    )
    axis[:] = centres_m
