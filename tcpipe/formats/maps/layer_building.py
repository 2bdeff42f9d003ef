"""One layer of a map: its raster (one file, or tiles on one grid) or polygons, resampled shard by shard and counted.

Tiles share CRS, type, bands and grid (to a twentieth of a pixel). Where they overlap, the later file has priority
where it has data, as with gdalwarp; ground without a tile has no data. A few files are open at one time, however many
there are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from tcpipe.arrays import AnyArray, Bytes, Floats, Ints, Mask
from tcpipe.errors import MapError
from tcpipe.formats.geojson import shorten_problems
from tcpipe.formats.maps.geotiff import COLOUR_USES, OpenFile, Tile, Use, read_tile, read_window
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding, read_threshold
from tcpipe.terrain.layers import PAPER_LAYERS, ClassScheme, Layer, Pixels
from tcpipe.terrain.projection import Projection, parse_crs
from tcpipe.terrain.resampling import mean, resample_bilinear, resample_majority
from tcpipe.terrain.target_grid import LATTICE_STEP_PX, Georeference, MapGrid, compute_source_lattice

MAX_FILES = 100_000
"""Most files of one layer."""

_OFF_GRID_PX = 0.05  # largest offset of a tile's corners from the pixels of the others for one common grid [px]


@dataclass(frozen=True, slots=True)
class Raster:
    """Tiles that are used as a role together; ``names`` as of `tcpipe.formats.maps.geotiff.Tile`."""

    role: str
    unit: str
    georeference: Georeference
    """Georeference; its name, for messages, is the path and the number of further files."""
    findings: Findings
    """One a code, of the first tile that has it."""
    names: Mapping[int, str]
    tiles: tuple[Tile, ...]
    _corners: Ints = field(repr=False)
    """First row, last row (not included), first column, last column of each tile, shape (T, 4)."""
    open_file: OpenFile = field(repr=False)
    step: int = 1
    """Every ``step``-th pixel of the files, in both directions, is a pixel of the raster."""

    @property
    def name(self) -> str:
        """Its name without the folder."""
        return label_files([Path(tile.path.name) for tile in self.tiles])

    def read(self, row0: int, row1: int, col0: int, col1: int) -> tuple[AnyArray, Mask]:
        """Return a window, and which of its pixels have data, as `tcpipe.formats.maps.geotiff.read_window`."""
        low = np.maximum(self._corners[:, ::2], (row0, col0))
        high = np.minimum(self._corners[:, 1::2], (row1, col1))
        values = np.zeros((row1 - row0, col1 - col0), self.tiles[0].dtype)
        valid = np.zeros(values.shape, bool)
        for n in np.flatnonzero((low < high).all(axis=1)).tolist():
            (top, left), (bottom, right) = low[n].tolist(), high[n].tolist()
            (row, _, col, _), step, tile = self._corners[n].tolist(), self.step, self.tiles[n]
            rows = (top - row) * step, min((bottom - row) * step, tile.rows)
            cols = (left - col) * step, min((right - col) * step, tile.cols)
            shape = (bottom - top, right - left) if step > 1 else None
            part, there = read_window(self.open_file, tile, *rows, *cols, shape)
            if part.shape == values.shape and len(self.tiles) == 1:
                return part, there
            window = slice(top - row0, bottom - row0), slice(left - col0, right - col0)
            np.copyto(values[window], part, where=there)
            valid[window] |= there
        return values, valid

    def thin(self, step: int) -> Raster:
        """Return the raster with every ``step``-th pixel alone."""
        corners, (a, b, x, d, e, y) = self._corners // step, self.georeference.affine
        affine = (a * step, b * step, x, d * step, e * step, y)
        rows, cols = int(corners[:, 1].max()), int(corners[:, 3].max())
        place = replace(self.georeference, affine=affine, rows=rows, cols=cols)
        return replace(self, georeference=place, _corners=corners, step=step)


def open_raster(paths: Sequence[Path], role: str, use: Use, open_file: OpenFile, crs: CRS | None = None) -> Raster:
    """Return the tiles of a role in drawing order, the last on top; ``crs`` is that of tiles without one.

    `MapError`: a file cannot be used as the role, the files differ in kind or grid, or have no CRS.
    """
    label = label_files(paths)
    if len(paths) > MAX_FILES:
        raise MapError(
            f"{label}: {len(paths)} files for {role}, at most {MAX_FILES}; join some: rio merge part*.tif joined.tif"
        )
    tiles: list[Tile] = []
    problems: list[str] = []
    for path in paths:
        try:
            tiles.append(read_tile(path, role, use))
        except MapError as error:
            problems += error.problems
    if problems:
        raise MapError(*shorten_problems(problems))
    if crs is not None:  # placeholder of a local CRS
        tiles = [replace(tile, crs="") if tile.crs and CRS(tile.crs).is_engineering else tile for tile in tiles]
    known = {text: parse_crs(text, where=label) for text in dict.fromkeys(tile.crs for tile in tiles) if text}
    _refuse_odd(tiles, "CRS", _find_crs_keys(tiles), "rio warp in.tif out.tif --dst-crs EPSG:n")
    _refuse_odd(tiles, "type and bands", [tile.kind for tile in tiles], "rio convert in.tif out.tif --dtype T")
    found = known.get(tiles[0].crs, crs)
    if found is None:
        raise MapError(f"{label}: has no CRS; if you know it, give it with --crs EPSG:n")
    affine, corners = _lay_out_tiles(tiles)
    findings = {finding.code: finding for tile in reversed(tiles) for finding in reversed(tile.findings)}
    return Raster(
        role=role,
        unit=tiles[0].unit,
        georeference=Georeference(found, affine, int(corners[:, 1].max()), int(corners[:, 3].max()), label),
        findings=tuple(findings.values()),
        names=_join_value_names(tiles),
        tiles=tuple(tiles),
        _corners=corners,
        open_file=open_file,
    )


def label_files(paths: Sequence[Path]) -> str:
    """Return files as text for a message: the first, the last, and their number."""
    return str(paths[0]) if len(paths) == 1 else f"{paths[0]} … {paths[-1].name} ({len(paths)} files)"


def _find_crs_keys(tiles: Sequence[Tile]) -> list[str]:
    """Return, for each tile, the first WKT that is equivalent to its own."""
    first: dict[str, str] = {"": ""}
    for text in dict.fromkeys(tile.crs for tile in tiles if tile.crs):
        same = (known for known in first if known and CRS(known).equals(CRS(text), ignore_axis_order=True))
        first[text] = next(same, text)
    return [first[tile.crs] for tile in tiles]


def _refuse_odd(tiles: Sequence[Tile], what: str, keys: Sequence[str], mended: str) -> None:
    """Raise `MapError` for tiles that differ from most tiles, with their names."""
    usual = Counter(keys).most_common(1)[0][0]
    wrong = [(tile, key) for tile, key in zip(tiles, keys, strict=True) if key != usual]
    if wrong:
        names = ", ".join(shorten_problems([str(tile.path) for tile, _ in wrong]))
        got, wanted = ((CRS(key).name if key else "none") if what == "CRS" else key for key in (wrong[0][1], usual))
        raise MapError(
            f"{tiles[0].role}: {len(wrong)} of {len(tiles)} files have another {what} than the rest ({got}, expected {wanted}): {names}; "
            f"write them like the rest: {mended}"
        )


def _lay_out_tiles(tiles: Sequence[Tile]) -> tuple[tuple[float, float, float, float, float, float], Ints]:
    """Return the affine of all tiles together, and each one's first row, last row, first column, last column in it."""
    pixels = [tuple(f"{tile.affine[n]:.6g}" for n in (0, 1, 3, 4)) for tile in tiles]
    base = pixels.index(Counter(pixels).most_common(1)[0][0])
    at, off = _find_grid_positions(tiles, base)
    if off.sum() > len(tiles) / 2:  # the first tile is the different one
        base = next((n for n in np.flatnonzero(off).tolist() if pixels[n] == pixels[base]), base)
        at, off = _find_grid_positions(tiles, base)
    misaligned = [tile for tile, far in zip(tiles, off, strict=True) if far]
    if misaligned:
        got, wanted = (
            f"{abs(tile.affine[0]):.6g} x {abs(tile.affine[4]):.6g}" for tile in (misaligned[0], tiles[base])
        )
        raise MapError(
            f"{tiles[0].role}: {len(misaligned)} of {len(tiles)} files are not aligned with the pixels of the others "
            f"({got}, the rest {wanted}): {', '.join(shorten_problems([str(tile.path) for tile in misaligned]))}; "
            f"put all on one grid: rio merge --resampling {'nearest' if tiles[0].use == 'classes' else 'bilinear'} "
            f"--nodata {-9999 if tiles[0].use == 'metres' else 0} *.tif joined.tif"
        )
    a, b, x, d, e, y = tiles[base].affine
    col, row = at.min(axis=0).tolist()
    first = (at - at.min(axis=0)).astype(np.int64)
    last = first + [(tile.cols, tile.rows) for tile in tiles]
    corners = np.stack([first[:, 1], last[:, 1], first[:, 0], last[:, 0]], axis=1)
    return (a, b, x + a * col + b * row, d, e, y + d * col + e * row), corners


def _find_grid_positions(tiles: Sequence[Tile], base: int) -> tuple[Floats, Mask]:
    """Return column and row of every tile's first pixel on the grid of one tile, shape (T, 2), and which are off it."""
    affines = np.array([tile.affine for tile in tiles], float).reshape(-1, 2, 3)
    sizes = np.array([(tile.cols, tile.rows) for tile in tiles])
    starts = affines[:, :, 2] - affines[base, :, 2]
    if tiles[base].crs and CRS(tiles[base].crs).is_geographic:  # tiles across the antimeridian count on beyond 180°
        starts[:, 0] -= 360.0 * np.round(starts[:, 0] / 360.0)
    ends = starts + np.einsum("nij,nj->ni", affines[:, :, :2], sizes)
    first, last = (np.linalg.solve(affines[base, :, :2], xy.T).T for xy in (starts, ends))
    at = np.rint(first).astype(float)
    far = np.maximum(np.abs(first - at), np.abs(last - (at + sizes))).max(axis=1)
    return at, ~(far <= _OFF_GRID_PX)


def _join_value_names(tiles: Sequence[Tile]) -> dict[int, str]:
    """Return the names of the tiles' values; `MapError` if two tiles name a value differently."""
    names: dict[int, str] = {}
    for tile in tiles:
        for value, name in tile.names.items():
            if names.setdefault(value, name) != name:
                raise MapError(
                    f"{tile.path}: value {value} is {name!r}, but {names[value]!r} in the files before; name it with --classes"
                )
    return names


_BLOCK_PX = 1024
_HIGHEST_M = 9_000.0
_DEEPEST_M = -500.0  # lowest and highest dry land [m]
_MEAN_FROM = 1.5  # fewest source pixels per map pixel for averaging a layer; with fewer it is interpolated
_LISTED = 8
_NAMED = 3
_ISOLATED, _NARROW = "value-isolated", "ortho-range-narrow"
_TAIL = 0.001  # share of the darkest, and of the brightest, pixels of an orthophoto outside the range that counts


@dataclass(slots=True)
class Plateau:
    """Pixels of exactly the smallest value of a raster; ``counts``: these, steps to their neighbours, large steps."""

    value: float = math.inf
    counts: Ints = field(default_factory=lambda: np.zeros(3, np.int64))
    total: int = 0

    def count(self, values: Floats, valid: Mask, *, min_step: float) -> None:
        """Count a window that has data."""
        lowest = float(values[valid].min())
        inside, self.total = valid & (values == lowest), self.total + int(valid.sum())
        if lowest > self.value or inside.sum() < read_threshold(_ISOLATED, "min_pixel_count"):
            return
        if lowest < self.value:
            self.value, self.counts = lowest, np.zeros(3, np.int64)
        known = np.where(valid, values, np.nan)
        step = np.concatenate([np.abs(np.diff(known, axis=axis))[np.diff(inside, axis=axis)] for axis in (0, 1)])
        self.counts += (inside.sum(), np.isfinite(step).sum(), (step >= min_step).sum())

    def is_isolated(self, min_fraction: float) -> bool:
        """Return whether such a share of pixels has the value, in areas, with large steps at most of their borders."""
        pixels, steps, large_steps = self.counts.tolist()
        is_steep = large_steps >= read_threshold(_ISOLATED, "min_large_step_fraction") * steps
        return bool(is_steep and 0 < steps < pixels and pixels >= min_fraction * self.total)


@dataclass(slots=True)
class Tally:
    """Statistics of one layer, counted while it is written."""

    pixels: int = 0
    low: float = math.inf
    high: float = -math.inf
    by_class: Ints = field(default_factory=lambda: np.zeros(256, np.int64))
    unnamed: set[int] = field(default_factory=set)
    unnamed_pixels: int = 0
    nodata: float = math.nan
    """Tag of the raster; NaN also if it has none."""
    plateaus: dict[float, Plateau] = field(default_factory=lambda: {1.0: Plateau(), -1.0: Plateau()})
    """Plateaus of values times 1 and times -1; heights have only the first."""

    def count(self, layer: Layer, label: str, shard: Pixels) -> bool:
        """Count the pixels of a shard and return whether any has data; `MapError` if heights are not metres of land."""
        if layer.kind == "categorical":
            found = np.bincount(shard.reshape(-1), minlength=256)
            self.by_class += found
            self.pixels += int(found[1:].sum())
            return bool(found[1:].any())
        present = shard[layer.has_data(shard)]
        self.pixels += present.size
        if layer.stack == "greys":
            self.by_class += np.bincount(shard.reshape(-1), minlength=256)
        elif present.size:
            self.low, self.high = min(self.low, float(present.min())), max(self.high, float(present.max()))
            if layer.kind == "relative" and (self.high > _HIGHEST_M or self.low < _DEEPEST_M):
                raise MapError(self._describe_range(label))
        return bool(present.size)

    def _describe_range(self, label: str) -> str:
        """Return the problem that heights are no dry land, with the command that makes them no data."""
        wrong, sign, limit = (self.low, "<", _DEEPEST_M) if self.low < _DEEPEST_M else (self.high, ">", _HIGHEST_M)
        tag, more = (self.nodata, "") if math.isfinite(self.nodata) else (-9999.0, " --dtype float32 --co nodata=-9999")
        return (
            f"{label}: heights from {self.low:.6g} to {self.high:.6g} are not metres of dry land; if {wrong:.6g} is no data: rio calc "
            f'--not-masked "(where ({sign} (read 1 1) {limit:g}) {tag:.9g} (read 1 1))" in.tif out.tif{more}; '
            "if they are centimetres: rio edit-info FILE --bidx 1 --units cm"
        )

    def note_unnamed(self, values: Pixels) -> None:
        """Remember raster values that the class table does not name."""
        if values.size:
            self.unnamed_pixels += values.size
            self.unnamed.update(int(value) for value in np.unique(values)[: 4 * _LISTED])


@dataclass(frozen=True, slots=True)
class RasterLayer:
    """A raster as a layer; ``projection`` is from its CRS to the grid's, None if they are the same."""

    layer: Layer
    raster: Raster
    grid: MapGrid
    projection: Projection | None
    scheme: ClassScheme | None
    """Classes of a categorical layer."""
    tally: Tally = field(default_factory=Tally)

    @property
    def label(self) -> str:
        """The raster's files, for messages."""
        return self.raster.georeference.name

    @property
    def name(self) -> str:
        """The same without their folder."""
        return self.raster.name

    def shard(self, row0: int, col0: int, rows: int, cols: int) -> Pixels:
        """Resample a part of the grid, block by block, so that the raster's window stays small."""
        shard: Pixels = np.empty((rows, cols), np.uint8 if self.layer.kind == "categorical" else np.float64)
        ratio = _compute_source_px_per_px(self._compute_lattice(row0, col0, 1, 1))
        block = _BLOCK_PX if not ratio > 2.0 else max(int(2 * _BLOCK_PX / ratio), LATTICE_STEP_PX)
        for i in range(0, rows, block):
            for j in range(0, cols, block):
                self._fill(shard[i : i + block, j : j + block], row0 + i, col0 + j)
        if self.layer.stack == "greys":
            return np.where(np.isfinite(shard), np.clip(np.rint(shard), 1.0, 255.0), 0.0).astype(np.uint8)
        return shard

    def thin(self) -> RasterLayer:
        """Return the layer of fewer source pixels, at least `_PICTURE_TAPS` each way for a pixel of the grid."""
        ratio = _compute_source_px_per_px(self._compute_lattice(self.grid.rows // 2, self.grid.cols // 2, 1, 1))
        return replace(self, raster=self.raster.thin(int(max(ratio // _PICTURE_TAPS, 1.0))))

    def explain_no_class(self) -> str | None:
        """Return the problem that none of its values is a class; None if some are."""
        if not self.tally.unnamed or self.scheme is None:
            return None
        option = "--classes" if self.layer.name == "terrain" else f"--categorical {self.layer.name}=FILE"
        named = ", ".join(str(value) for value in list(self.scheme.id_by_value)[:_LISTED])
        unnamed, names = sorted(self.tally.unnamed), self.raster.names
        values = ", ".join(f"{v} ({names[v]})" if v in names else str(v) for v in unnamed[:_LISTED])
        values += " …" if len(unnamed) > _LISTED else ""
        return (
            f"{self.label}: none of its values {values} is in the class table (which names {named}); "
            f"give one (value,id,name,traversable) with {option}"
        )

    @property
    def values(self) -> Sequence[int]:
        """The values that were found, if the class table maps each value to itself."""
        return sorted({*(np.flatnonzero(self.tally.by_class[1:]) + 1).tolist(), *self.tally.unnamed})

    def list_findings(self) -> Findings:
        """Return the raster's findings: rough datum shift, values without a class, isolated values, narrow range."""
        subject = Subject("layer", self.layer.name)
        rough = self.projection.find_rough_shift(subject) if self.projection else ()
        found = self._find_unnamed(subject) if self.tally.unnamed else self._find_isolated(subject)
        return (*self.raster.findings, *rough, *found)

    def _find_unnamed(self, subject: Subject) -> Iterator[Finding]:
        unnamed, count = sorted(self.tally.unnamed), self.tally.unnamed_pixels
        values = ", ".join(map(str, unnamed[:_NAMED])) + (" …" if len(unnamed) > _NAMED else "")
        names = {"values": values, "file": self.name}
        yield make_finding("class-values-unnamed", subject, names=names, pixel_count=count, value_count=len(unnamed))

    def _find_isolated(self, subject: Subject) -> Iterator[Finding]:
        """Yield findings on values that are probably no data, and on a photo that uses few of 16 bits."""
        names = {"file": self.name}
        least = 0.0 if self.layer.kind == "relative" else read_threshold(_ISOLATED, "min_ortho_fraction")
        for sign, plateau in self.tally.plateaus.items():
            if plateau.is_isolated(least):
                named = names | {"value": f"{sign * plateau.value:.6g}"}
                share = plateau.counts[0] / plateau.total
                yield make_finding(_ISOLATED, subject, names=named, pixel_fraction=share)
        counts = self.tally.by_class[1:255]
        if self.layer.name == "ortho" and "uint16" in self.raster.tiles[0].kind and counts.any():
            low, high = np.searchsorted(np.cumsum(counts) / counts.sum(), (_TAIL, 1.0 - _TAIL)).tolist()
            if (share := (high - low + 1) / 255.0) < read_threshold(_NARROW, "min_range_fraction"):
                yield make_finding(_NARROW, subject, names=names, range_fraction=share)

    def _compute_lattice(self, row0: int, col0: int, rows: int, cols: int) -> Floats:
        return compute_source_lattice(self.grid, self.raster.georeference, self.projection, row0, rows, col0, cols)

    def _fill(self, part: Pixels, row0: int, col0: int) -> None:
        """Resample one block of the grid from the raster."""
        lattice = self._compute_lattice(row0, col0, *part.shape)
        part[...] = 0 if self.layer.kind == "categorical" else np.nan
        flat = lattice.reshape(-1, 2)
        if not np.isfinite(flat).all():
            return
        low = np.maximum(np.floor(flat.min(axis=0)).astype(np.int64) - 1, 0)
        high = np.minimum(
            np.ceil(flat.max(axis=0)).astype(np.int64) + 2,
            (self.raster.georeference.cols, self.raster.georeference.rows),
        )
        if (low >= high).any():
            return
        values, valid = self.raster.read(int(low[1]), int(high[1]), int(low[0]), int(high[0]))
        if not valid.any():  # the most of a survey that is laid across its bounding box
            return
        ratio = _compute_source_px_per_px(lattice)
        lattice -= low
        parts = math.ceil(ratio) if ratio > _MEAN_FROM else 1
        if self.scheme is not None:
            ids = self.scheme.ids(values, valid)
            self.tally.note_unnamed(values[valid & (ids == 0)])
            resample_majority(ids, lattice, parts, part)
            return
        if self.layer.name == "height":
            steep = read_threshold(_ISOLATED, "min_step_ratio") * self.grid.pixel_size_m / ratio
            self.tally.plateaus[1.0].count(values, valid, min_step=max(steep, read_threshold(_ISOLATED, "min_step_m")))
        for sign, plateau in self.tally.plateaus.items() if self.layer.name == "ortho" else ():
            plateau.count(sign * values, valid, min_step=read_threshold(_ISOLATED, "min_step_grey"))
        source = np.where(valid, values, np.nan).astype(float, copy=False)
        if parts > 1:
            mean(source, lattice, parts, part)
        else:
            resample_bilinear(source, lattice, part)


def split_colours(ortho: Raster) -> dict[str, Raster]:
    """Return the colours of an orthophoto as rasters by layer; {} for a grey one. Its findings are not repeated."""
    if len(ortho.tiles[0].bands) == 1 and "palette" not in ortho.tiles[0].kind:
        return {}
    colours = dict[str, Raster]()
    for layer, use in COLOUR_USES.items():
        tiles = tuple(replace(tile, use=use) for tile in ortho.tiles)
        colours[layer] = replace(ortho, role=layer, tiles=tiles, findings=())
    return colours


_PICTURE_BLOCK_PX = 128
"""Side of the parts of a picture that are read for all colours in turn [px]: GDAL decodes and keeps them once."""

_PICTURE_TAPS = 3
"""Least source pixels that are averaged, each way, for a pixel of a picture; of a finer raster some are left out."""


def draw_colours(ortho: RasterLayer, side_px: int) -> Bytes | None:
    """Return an orthophoto of at most ``side_px`` in colour, shape (R, C, 3), no data in white; None of a grey one."""
    colours = split_colours(ortho.raster)
    if not colours:
        return None
    grid, step = ortho.grid, -(-max(ortho.grid.rows, ortho.grid.cols) // side_px)
    grid = replace(grid, pixel_size_m=step * grid.pixel_size_m, rows=-(-grid.rows // step), cols=-(-grid.cols // step))
    layers = [
        RasterLayer(PAPER_LAYERS[name], raster, grid, ortho.projection, None).thin() for name, raster in colours.items()
    ]
    picture = np.empty((grid.rows, grid.cols, len(layers)), np.uint8)
    for row0, col0, rows, cols in iterate_shards(grid, _PICTURE_BLOCK_PX):
        part = np.stack([layer.shard(row0, col0, rows, cols) for layer in layers], axis=-1)
        picture[row0 : row0 + rows, col0 : col0 + cols] = np.where(part, part, 255)
    return picture


def _compute_source_px_per_px(lattice: Floats) -> float:
    """Return the number of source pixels per map pixel along the longer side; NaN if the CRS is undefined there."""
    across = np.linalg.norm(lattice[0, 1] - lattice[0, 0])
    down = np.linalg.norm(lattice[1, 0] - lattice[0, 0])
    return float(max(across, down)) / LATTICE_STEP_PX


def iterate_shards(grid: MapGrid, side_px: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield the parts that a map is written in: first row, first column, rows, columns."""
    for row0 in range(0, grid.rows, side_px):
        for col0 in range(0, grid.cols, side_px):
            yield row0, col0, min(side_px, grid.rows - row0), min(side_px, grid.cols - col0)
