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
x, y         float64  pixel centres in the map's CRS [m]
spatial_ref  int64    CF grid mapping: the CRS as WKT, and GDAL's GeoTransform
===========  =======  ==========================================================================

The groups ``overviews/2``, ``overviews/4`` … contain the same arrays at coarser levels (`tcpipe.terrain.resampling`),
and the array ``overviews/rgb`` is the small picture that pages show of an orthophoto in colour. Attributes follow CF
(``grid_mapping``, ``flag_values``) and GeoZarr (``proj:``, ``spatial:``), so that xarray opens map and overviews as
they are, and so does GDAL from 3.13 on, the first that reads shards.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from tcpipe.arrays import AnyArray, Bytes
from tcpipe.errors import MapError, StoreError
from tcpipe.formats.integrity import read_checksums
from tcpipe.formats.json_files import convert_record, parse_typed, read_json, to_plain
from tcpipe.formats.maps.map_facts import Description, MapFacts, MapSummary, describe_layer, make_cf_flags, read_layers
from tcpipe.formats.place import prove_files
from tcpipe.formats.published_outputs import FetchedShards
from tcpipe.formats.zarr_arrays import (
    DESCRIPTION,
    Shape,
    ShardedArray,
    add_array,
    consolidate_metadata,
    create_group,
    open_sharded,
)
from tcpipe.tables.findings import omit
from tcpipe.tables.levels import DATA_MODEL_VERSION
from tcpipe.terrain.layers import (
    PAPER_LAYERS,
    ClassScheme,
    ClassTable,
    Layer,
    Layers,
    Pixels,
    TerrainClass,
    find_no_data_value,
)
from tcpipe.terrain.resampling import iterate_levels, list_factors, make_overview_grid
from tcpipe.terrain.target_grid import MAX_PIXELS, MAX_SIDE_PX, MapGrid
from tcpipe.terrain.tiles import MapReader

TILE_PX = 512
"""Side of a tile: the unit that is decoded."""

SHARD_PX = 2048
"""Side of a shard [px]: one file, written as a whole."""

PICTURE_PX = 900
"""Longest side of a map's pictures: the width of a page [px]."""

_PICTURE = "overviews/rgb"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Attributes:
    """Facts that a map stores in its attribute ``tcpipe_map``."""

    version: str
    name: str
    grid: MapGrid
    class_table: tuple[TerrainClass, ...]
    id_by_value: Mapping[int, int]
    layers: tuple[str, ...]
    described: Mapping[str, Description] = omit({})
    factors: tuple[int, ...]
    tile_px: int
    height_reference_m: float
    facts: MapFacts
    picture_shape: tuple[int, int, int] | None = omit()
    """Rows, columns and colours of the picture of an orthophoto in colour."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapFile(MapReader):
    """An open map; `read` and `read_tile` raise `MapError` if a tile is damaged."""

    facts: MapFacts
    id_by_value: Mapping[int, int]
    """Which values of its terrain raster stood for which class ids."""
    factors: tuple[int, ...]
    _levels: Mapping[int, Mapping[str, ShardedArray]]
    """The arrays of each factor."""
    _picture: ShardedArray | None
    _factor: int = 1

    def at(self, factor: int) -> MapFile:
        """Return the map at one of its ``factors``, which are the full map's."""
        return replace(self, grid=make_overview_grid(self.grid, factor), factors=(1,), _factor=factor)

    def summary(self) -> MapSummary:
        """Return the description of the whole map."""
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
            layers=tuple(self.layers),
            overviews=self.factors[1:],
            class_table=self.classes.classes,
            described=_describe_layers(self.layers),
        )

    def read(self, layer: str, row0: int, row1: int, col0: int, col1: int) -> AnyArray:
        """Return a window of a layer as stored."""
        with _name_damage(f"map {self.name}: {layer}, rows {row0} to {row1}, columns {col0} to {col1}"):
            return self._levels[self._factor][layer].window(row0, row1, col0, col1)

    def read_picture(self) -> Bytes | None:
        """Return the orthophoto in colour, shape (R, C, 3), at most `PICTURE_PX` a side; None without colours."""
        with _name_damage(f"map {self.name}: its picture"):
            return self._picture.chunk((0, 0, 0)) if self._picture else None

    def expect(self, tiles: Sequence[tuple[int, int]]) -> None:
        """Fetch tiles (row, column) of all layers that are read soon, if they are in a bucket."""
        for array in self._levels[self._factor].values():
            array.expect(tiles)

    def read_tile(self, layer: str, i: int, j: int, out: AnyArray) -> None:
        """Decode the tile in row i and column j into ``out``."""
        grid, side = self.grid, self.tile_px
        where = f"rows {i * side} to {(i + 1) * side}, columns {j * side} to {(j + 1) * side}"
        with _name_damage(f"map {self.name}: {layer}, {where}"):
            array = self._levels[self._factor][layer]
            array.chunk((i, j), out=out)
        out[max(grid.rows - i * side, 0) :] = array.fill  # a file may contain more than its array
        out[:, max(grid.cols - j * side, 0) :] = array.fill


@contextmanager
def _name_damage(what: str) -> Iterator[None]:
    """Add the part of the map that cannot be read to errors."""
    try:
        yield
    except StoreError as error:
        raise MapError(f"{what} cannot be read ({error}); add the map again") from error


def open_map(path: Path, fetched: FetchedShards | None = None, *, proved: bool = True) -> MapFile:
    """Open a map for reading; its shards are in the folders of their descriptions, or are ``fetched``.

    `MapError`: no map of this program; or, if ``proved``, changed descriptions or missing files: lost tiles would read
    as no data.
    """
    if not (path / DESCRIPTION).is_file():
        raise MapError(f"{path}: not a map, it has no {DESCRIPTION}; add one with: tcpipe add-map")
    try:
        attributes = read_json(path / DESCRIPTION).get("attributes")
    except StoreError as error:
        raise MapError(f"{path}: not a map ({error.problems[0]}); add one with: tcpipe add-map") from None
    found = attributes.get("tcpipe_map") if isinstance(attributes, dict) else None
    if not isinstance(found, dict) or found.get("version") != DATA_MODEL_VERSION:
        version = found.get("version") if isinstance(found, dict) else None
        raise MapError(
            f"{path}: not a map of this version (got {version}, expected {DATA_MODEL_VERSION}); add it again"
        )
    try:
        kept = parse_typed(found, _Attributes, path)
        described = {name: kept.described.get(name, {}) for name in kept.layers}
        every = read_layers(described, kept.class_table, path)
        layers = {name: every[name] for name in kept.layers}
        _refuse_sizes(kept, path)
        if proved:
            _prove(path, fetched)
        levels = {
            factor: {
                name: _open_array(path / _level_path(factor), layer, kept.grid, factor, fetched)
                for name, layer in layers.items()
            }
            for factor in kept.factors
        }
        picture = _open_picture(path / _PICTURE, kept.picture_shape, fetched) if kept.picture_shape else None
    except StoreError as error:
        raise MapError(*(f"{problem}; add the map again" for problem in error.problems)) from None
    classes = ClassTable(kept.class_table)
    return convert_record(kept, MapFile, classes=classes, layers=layers, _levels=levels, _picture=picture)


def _refuse_sizes(kept: _Attributes, path: Path) -> None:
    """Raise `StoreError` if a map's stated size is above the limits, or its tiles and levels are not tcpipe's."""
    rows, cols, pixel_size_m = kept.grid.rows, kept.grid.cols, kept.grid.pixel_size_m
    if not (0 < rows <= MAX_SIDE_PX and 0 < cols <= MAX_SIDE_PX and rows * cols <= MAX_PIXELS and pixel_size_m > 0):
        raise StoreError(
            f"{path}: claims to have {rows} x {cols} pixels of {pixel_size_m} m, at most {MAX_SIDE_PX} a side"
        )
    wanted = (TILE_PX, list_factors(kept.grid))
    if (kept.tile_px, kept.factors) != wanted:
        raise StoreError(f"{path}: tiles and overviews are {(kept.tile_px, kept.factors)}, expected {wanted}")


def _open_array(path: Path, layer: Layer, whole: MapGrid, factor: int, fetched: FetchedShards | None) -> ShardedArray:
    shape, chunk_shape, shard_shape = _shape_array(whole, factor)
    fill = find_no_data_value(layer.mapped)
    return open_sharded(
        path / layer.name,
        shape=shape,
        chunk_shape=chunk_shape,
        shard_shape=shard_shape,
        dtype=layer.mapped,
        fill=fill,
        sparse=True,
        fetched=fetched,
    )


def _open_picture(path: Path, shape: tuple[int, int, int], fetched: FetchedShards | None) -> ShardedArray:
    if max(shape) > PICTURE_PX or min(shape) < 1:
        raise StoreError(f"{path}: has the shape {shape}, at most {PICTURE_PX} a side")
    return open_sharded(
        path, shape=shape, chunk_shape=shape, shard_shape=shape, dtype=np.dtype(np.uint8), fill=0, fetched=fetched
    )


def _shape_array(whole: MapGrid, factor: int) -> tuple[Shape, Shape, Shape]:
    """Return the shapes of a layer's array at a level, of its tiles and of its shards."""
    grid, shard_px = make_overview_grid(whole, factor), max(SHARD_PX // factor, TILE_PX)
    return (grid.rows, grid.cols), (TILE_PX, TILE_PX), (shard_px, shard_px)


def _prove(path: Path, fetched: FetchedShards | None) -> None:
    """Compare a map's descriptions with their checksums, and its other files by size: tiles contain their checksums."""
    listed = read_checksums(path)
    prove_files(path, listed, [name for name in listed if Path(name).name == DESCRIPTION])
    size_of = fetched.size if fetched else os.path.getsize
    lost = [str(path / name) for name, entry in listed.items() if not _has_size(path / name, entry.size_bytes, size_of)]
    if lost:
        more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
        raise MapError(f"{lost[0]}{more}: missing or truncated; add the map again")


def _has_size(path: Path, size_bytes: int, size_of: Callable[[Path], int]) -> bool:
    try:
        return size_of(path) == size_bytes
    except OSError:
        return False


def _level_path(factor: int) -> str:
    return "" if factor == 1 else f"overviews/{factor}/"


class MapWriter:
    """Writes a map and its overviews shard by shard into a directory; `finish` makes it complete."""

    def __init__(self, directory: Path, *, name: str, grid: MapGrid, scheme: ClassScheme, layers: Layers) -> None:
        self._name, self._grid, self._scheme, self._layers = name, grid, scheme, layers
        self._factors = list_factors(grid)
        self._group = create_group(directory)
        self._levels: dict[int, dict[str, Any]] = {}
        for factor in self._factors:
            group = self._group if factor == 1 else self._group.create_group(_level_path(factor).rstrip("/"))
            self._levels[factor] = {layer.name: _add_layer(group, layer, grid, factor) for layer in layers.values()}
        self._picture_shape: tuple[int, int, int] | None = None
        self.height_reference_m: float | None = None
        """Reference of stored heights [m]: the floor of the smallest height of the first shard with heights."""

    def write(self, layer: str, row0: int, col0: int, values: Pixels) -> None:
        """Write a shard of a layer, its corner at a multiple of `SHARD_PX`; no data is NaN in floats and 0 in bytes."""
        if self._layers[layer].kind == "relative":
            if self.height_reference_m is None and np.isfinite(values).any():
                self.height_reference_m = float(np.floor(np.nanmin(values)))
            values = values - (self.height_reference_m or 0.0)
        _put(self._levels[1][layer], row0, col0, values)
        for factor, level in iterate_levels(self._layers[layer], values, self._factors):
            _put(self._levels[factor][layer], row0 // factor, col0 // factor, level)

    def write_picture(self, colours: Bytes) -> None:
        """Write the orthophoto in colour, shape (R, C, 3), at most `PICTURE_PX` a side."""
        rows, cols, count = self._picture_shape = colours.shape
        dimensions = ("picture_y", "picture_x", "colour")
        whole = (rows, cols, count)
        array = add_array(
            self._group, _PICTURE, shape=whole, dtype=np.uint8, chunks=whole, shards=whole, dimensions=dimensions
        )
        array[...] = colours

    def finish(self, facts: MapFacts, layers: Layers) -> None:
        """Write coordinates and attributes; ``layers`` are all those of before, with the range that was found."""
        reference_m = self.height_reference_m or 0.0
        for factor, arrays in self._levels.items():
            arrays["height"].attrs.update({"add_offset": reference_m})
            group = self._group if factor == 1 else self._group[_level_path(factor).rstrip("/")]
            title = f"{self._name}, {factor} x coarser" if factor > 1 else self._name
            _place(group, make_overview_grid(self._grid, factor), title)
        kept = _Attributes(
            version=DATA_MODEL_VERSION,
            name=self._name,
            grid=self._grid,
            class_table=self._scheme.table.classes,
            id_by_value=self._scheme.id_by_value,
            layers=tuple(layers),
            described=_describe_layers(layers),
            factors=self._factors,
            tile_px=TILE_PX,
            height_reference_m=reference_m,
            facts=facts,
            picture_shape=self._picture_shape,
        )
        self._group.attrs.update({"tcpipe_map": to_plain(kept)})
        consolidate_metadata(self._group)


def _put(array: Any, row0: int, col0: int, values: Pixels) -> None:
    if values.size:
        rows, cols = values.shape
        array[row0 : row0 + rows, col0 : col0 + cols] = values.astype(array.dtype)


def _place(group: Any, grid: MapGrid, title: str) -> None:
    """Write the georeference of a group's pixels: coordinates, grid mapping, and attributes."""
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


def _describe_layers(layers: Layers) -> dict[str, Description]:
    """Return the descriptions of layers other than the paper's."""
    return {name: describe_layer(layer) for name, layer in layers.items() if name not in PAPER_LAYERS}


def _add_layer(group: Any, layer: Layer, whole: MapGrid, factor: int) -> Any:
    """Add the array of a layer at a level."""
    attributes: dict[str, Any] = {"long_name": _LONG_NAMES.get(layer.name, layer.long_name)}
    if layer.kind == "categorical":
        attributes |= {**make_cf_flags(layer.classes), "_FillValue": 0}
    else:
        attributes |= {"units": layer.unit}
        attributes |= {"scale_factor": layer.step if layer.stack == "greys" else 1.0}
        attributes |= {"_FillValue": 0} if layer.stack == "greys" else {}
    shape, chunks, shards = _shape_array(whole, factor)
    return add_array(
        group,
        layer.name,
        shape=shape,
        dtype=layer.mapped,
        chunks=chunks,
        shards=shards,
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
