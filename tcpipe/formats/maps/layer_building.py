"""One layer of a map being made: a raster or polygons put on the map's grid shard by shard, with a tally of what was seen."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import MapError
from tcpipe.formats.maps.mosaic import Raster
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.terrain.classes import ClassScheme
from tcpipe.terrain.grid import MapGrid
from tcpipe.terrain.layers import Layer, Pixels
from tcpipe.terrain.projection import Projection
from tcpipe.terrain.resampling import mean, resample_bilinear, resample_majority
from tcpipe.terrain.target_grid import LATTICE_STEP_PX, Georeference, compute_source_lattice

_BLOCK_PX = 1024
_HIGHEST_M = 9_000.0
_DEEPEST_M = -500.0
"""Dry land lies between these."""
_MEAN_FROM = 1.5
"""From so many source pixels a map pixel on, a layer is averaged instead of interpolated."""
_LISTED = 8
_NAMED = 3


@dataclass(slots=True)
class Tally:
    """What has been seen of one layer while it was written."""

    pixels: int = 0
    low: float = math.inf
    high: float = -math.inf
    by_class: NDArray[np.int64] = field(default_factory=lambda: np.zeros(256, np.int64))
    unnamed: set[int] = field(default_factory=set)
    unnamed_pixels: int = 0

    def count(self, layer: LayerSource, shard: Pixels) -> bool:
        """Count the pixels of a shard and return whether any has data; `MapError` if heights are not metres of dry land."""
        if layer.layer.kind == "categorical":
            found = np.bincount(shard.reshape(-1), minlength=256)
            self.by_class += found
            self.pixels += int(found[1:].sum())
            return bool(found[1:].any())
        present = shard[layer.layer.has_data(shard)]
        self.pixels += present.size
        if layer.layer.stack != "greys" and present.size:
            self.low, self.high = min(self.low, float(present.min())), max(self.high, float(present.max()))
            if layer.layer.kind == "relative" and (self.high > _HIGHEST_M or self.low < _DEEPEST_M):
                wrong = self.low if self.low < _DEEPEST_M else self.high
                raise MapError(
                    f"{layer.label}: heights from {self.low:.6g} to {self.high:.6g} are not metres of dry land; say in the file that "
                    f"{wrong:.6g} is no data (gdal_edit -a_nodata {wrong:.9g}), or that they are centimetres (gdal_edit -scale 0.01)"
                )
        return bool(present.size)

    def note_unnamed(self, values: Pixels) -> None:
        """Remember raster values that the class table does not name."""
        if values.size:
            self.unnamed_pixels += values.size
            self.unnamed.update(int(value) for value in np.unique(values)[: 4 * _LISTED])


class LayerSource(Protocol):
    """What becomes a layer of a map."""

    @property
    def layer(self) -> Layer:
        """The layer that it becomes."""

    @property
    def label(self) -> str:
        """The files it comes from, for messages."""

    @property
    def name(self) -> str:
        """The same without their folder."""

    @property
    def tally(self) -> Tally:
        """What has been seen of it so far."""

    def shard(self, grid: MapGrid, row0: int, col0: int, rows: int, cols: int) -> Pixels:
        """Return a part of the map, shape (rows, cols): metres with NaN, or bytes with 0, as no data."""

    def nothing(self) -> str | None:
        """Return why it has no data, where a reason of its own is known."""

    def list_findings(self) -> tuple[Finding, ...]:
        """Return what was observed while it was placed and written."""


@dataclass(frozen=True, slots=True)
class RasterLayer:
    """A raster as a layer; ``projection`` is from its CRS to the map's, None where they are the same."""

    layer: Layer
    raster: Raster
    footing: Georeference
    projection: Projection | None
    scheme: ClassScheme | None
    """Of a categorical layer."""
    tally: Tally = field(default_factory=Tally)

    @property
    def label(self) -> str:
        """The raster's files, for messages."""
        return self.raster.label

    @property
    def name(self) -> str:
        """The same without their folder."""
        return self.raster.name

    def shard(self, grid: MapGrid, row0: int, col0: int, rows: int, cols: int) -> Pixels:
        """Resample a part of the map, block by block, so that the raster's window stays small."""
        shard: Pixels = np.empty((rows, cols), np.uint8 if self.layer.kind == "categorical" else np.float64)
        block = self._block_px(grid, row0, col0)
        for i in range(0, rows, block):
            for j in range(0, cols, block):
                self._fill(shard[i : i + block, j : j + block], grid, row0 + i, col0 + j)
        if self.layer.stack == "greys":
            return np.where(np.isfinite(shard), np.clip(np.rint(shard), 1.0, 255.0), 0.0).astype(np.uint8)
        return shard

    def nothing(self) -> str | None:
        """Say that none of its values is a class."""
        if not self.tally.unnamed or self.scheme is None:
            return None
        option = "--classes" if self.layer.name == "terrain" else f"--categorical {self.layer.name}=FILE"
        named = ", ".join(str(value) for value in list(self.scheme.id_by_value)[:_LISTED])
        return f"{self.label}: none of its values {self._unnamed()} is in the class table (which names {named}); give one with {option}"

    def list_findings(self) -> tuple[Finding, ...]:
        """Return the raster's findings, a datum shift that is known only roughly, and values that are no class."""
        subject, unnamed = Subject("layer", self.layer.name), sorted(self.tally.unnamed)
        rough = self.projection.find_rough_shift(subject) if self.projection else ()
        if not unnamed:
            return (*self.raster.findings, *rough)
        values = ", ".join(map(str, unnamed[:_NAMED])) + (" …" if len(unnamed) > _NAMED else "")
        finding = make_finding(
            "class-values-unnamed",
            subject,
            names={"values": values, "file": self.name},
            pixel_count=self.tally.unnamed_pixels,
            value_count=len(unnamed),
        )
        return (*self.raster.findings, *rough, finding)

    def _unnamed(self) -> str:
        names = self.raster.names
        first = [f"{v} ({names[v]})" if v in names else str(v) for v in sorted(self.tally.unnamed)[:_LISTED]]
        return ", ".join(first) + (" …" if len(self.tally.unnamed) > _LISTED else "")

    def _block_px(self, grid: MapGrid, row0: int, col0: int) -> int:
        """Return the side of the blocks a shard is made in, small where the raster is so much finer that its window would not fit."""
        ratio = _compute_source_px_per_px(compute_source_lattice(grid, self.footing, self.projection, row0, 1, col0, 1))
        return _BLOCK_PX if not ratio > 2.0 else max(int(2 * _BLOCK_PX / ratio), LATTICE_STEP_PX)

    def _fill(self, part: Pixels, grid: MapGrid, row0: int, col0: int) -> None:
        """Resample one block of the map from the raster."""
        lattice = compute_source_lattice(grid, self.footing, self.projection, row0, part.shape[0], col0, part.shape[1])
        part[...] = 0 if self.layer.kind == "categorical" else np.nan
        flat = lattice.reshape(-1, 2)
        if not np.isfinite(flat).all():
            return
        low = np.maximum(np.floor(flat.min(axis=0)).astype(np.int64) - 1, 0)
        high = np.minimum(np.ceil(flat.max(axis=0)).astype(np.int64) + 2, (self.footing.cols, self.footing.rows))
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
            resample_majority(ids, lattice, LATTICE_STEP_PX, parts, part)
            return
        source = np.where(valid, values, np.nan).astype(np.float64, copy=False)
        if parts > 1:
            mean(source, lattice, LATTICE_STEP_PX, parts, part)
        else:
            resample_bilinear(source, lattice, LATTICE_STEP_PX, part)


def _compute_source_px_per_px(lattice: NDArray[np.float64]) -> float:
    """Return how many source pixels a map pixel spans, the longer way; NaN where the raster's CRS is not defined."""
    across = np.linalg.norm(lattice[0, 1] - lattice[0, 0])
    down = np.linalg.norm(lattice[1, 0] - lattice[0, 0])
    return float(max(across, down)) / LATTICE_STEP_PX


def iterate_shards(grid: MapGrid, side_px: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield the parts that a map is written in: first row, first column, rows, columns."""
    for row0 in range(0, grid.rows, side_px):
        for col0 in range(0, grid.cols, side_px):
            yield row0, col0, min(side_px, grid.rows - row0), min(side_px, grid.cols - col0)
