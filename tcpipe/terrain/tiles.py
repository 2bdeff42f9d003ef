"""Interface of a map for sampling, and a pool that decodes each of its tiles once while samples come tile by tile."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import AnyArray, Floats, GenericArray, Ints
from tcpipe.terrain.layers import STACKS, ClassTable, Layers, Stack, find_no_data_value, group_stacks
from tcpipe.terrain.projection import Projection, compute_area, parse_crs
from tcpipe.terrain.resampling import choose_factor
from tcpipe.terrain.sampling_kernel import Tiles, compute_morton
from tcpipe.terrain.target_grid import MapGrid

CACHED_TILES = 96
"""Decoded tiles kept: 150 MB of three layers at 512 px."""

_STRIP_TILES = CACHED_TILES // 3 - 3
"""Width of a strip [tiles]: three of its rows fit the cache. At 15,000 px most maps are one strip."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapReader(ABC):
    """A map: its grid, classes, layers, and windows of each layer."""

    name: str
    """The map's name in the store."""
    grid: MapGrid
    classes: ClassTable
    layers: Layers
    """Its layers by name; ``height``, the relative one, is always there."""
    tile_px: int
    """Side of the square tiles that are cheap to read, aligned with pixel (0, 0)."""
    height_reference_m: float
    """Reference of the stored heights [m]."""
    factors: tuple[int, ...]
    """Levels that `at` gives: how many pixels of the full map a pixel of each spans, rising from 1."""

    def select(self, layers: Collection[str]) -> Self:
        """Return the map with these of its layers alone; ``height`` is one of them."""
        return replace(self, layers={name: layer for name, layer in self.layers.items() if name in layers})

    @abstractmethod
    def at(self, factor: int) -> MapReader:
        """Return the map at one of its ``factors``."""

    @abstractmethod
    def read(self, layer: str, row0: int, row1: int, col0: int, col1: int) -> AnyArray:
        """Return rows ``row0:row1`` and columns ``col0:col1`` of a layer.

        Height is in metres above `height_reference_m`; no data is NaN, or 0 in layers of bytes.
        """

    @abstractmethod
    def expect(self, tiles: Sequence[tuple[int, int]]) -> None:
        """Have tiles (row, column) of all layers at hand that are read soon, where that takes long."""

    @abstractmethod
    def read_tile(self, layer: str, i: int, j: int, out: GenericArray) -> None:
        """Copy the tile in row i and column j into ``out``, contiguous, `tile_px` each way; no data beyond the map."""


def choose_level(source: MapReader, pixel_size_m: float) -> MapReader:
    """Return the map's coarsest level with pixels up to ``pixel_size_m`` [m], to neither alias nor lose detail."""
    factor = choose_factor(source.factors, source.grid.pixel_size_m, pixel_size_m)
    return source if factor == 1 else source.at(factor)


def find_map_projection(source: MapReader, gnss_crs: str) -> Projection:
    """Return the projection from a geographic CRS (longitude, latitude) to the map's; `MapError` for an invalid CRS."""
    crs = parse_crs(source.grid.crs, where=f"map {source.name}")
    return Projection(parse_crs(gnss_crs, where="gnss_crs"), crs, compute_area(crs, source.grid.bounds_m))


def group_by_tile(px: Floats, source: MapReader) -> Iterator[Ints]:
    """Yield the indices of pixel positions, shape (N, 2), by tile; within a tile in Z-order.

    Tiles come row by row inside strips narrow enough that a tile is still held when the rows above and below want it.
    """
    limit = np.array([source.grid.cols - 1, source.grid.rows - 1])
    cells = np.clip(np.floor(px), 0, limit).astype(np.int64)
    tile_j, tile_i = (cells // source.tile_px).T
    fine = compute_morton(cells[:, 0] % source.tile_px, cells[:, 1] % source.tile_px)
    order = np.lexsort((fine, tile_j, tile_i, tile_j // _STRIP_TILES))
    changed = (np.diff(tile_i[order]) != 0) | (np.diff(tile_j[order]) != 0)
    yield from (group for group in np.split(order, np.flatnonzero(changed) + 1) if group.size)


def read_tile_window(  # noqa: PLR0917
    source: MapReader, layer: str, row0: int, row1: int, col0: int, col1: int
) -> AnyArray:
    """Return a window of a layer that may reach beyond the map, where it has no data."""
    dtype, grid = source.layers[layer].mapped, source.grid
    out: AnyArray = np.full((row1 - row0, col1 - col0), find_no_data_value(dtype), dtype)
    top, bottom, left, right = max(row0, 0), min(row1, grid.rows), max(col0, 0), min(col1, grid.cols)
    if top < bottom and left < right:
        out[top - row0 : bottom - row0, left - col0 : right - col0] = source.read(layer, top, bottom, left, right)
    return out


class TilePool:
    """Cache of tiles being sampled, one array for each kind of layer; replaces the least recently used."""

    __slots__ = ("_flat", "_held", "_map", "_stacks", "slots")

    def __init__(self, source: MapReader) -> None:
        grid, side = source.grid, source.tile_px
        self._map = source
        self._stacks = group_stacks(source.layers)
        self.slots: NDArray[np.int32] = np.full((-(-grid.rows // side), -(-grid.cols // side)), -1, np.int32)
        """Which of the held tiles is the one in row i and column j; -1 where it is not held."""
        self._held: OrderedDict[tuple[int, int], int] = OrderedDict()
        self._flat: dict[Stack, AnyArray] = {
            stack: np.empty((len(names), 0), STACKS[stack]) for stack, names in self._stacks.items()
        }
        self._grow(min(CACHED_TILES, self.slots.size))

    @property
    def tiles(self) -> Tiles:
        """The held tiles, as the sampling kernel takes them."""
        flat = {str(stack): values.reshape(-1) for stack, values in self._flat.items()}
        return Tiles(**flat, slots=self.slots, rows=self._map.tile_px, cols=self._map.tile_px)

    def expect(self, boxes: Ints) -> None:
        """Preload the tiles that any of the boxes touches, as in `hold`, for later calls with parts of them."""
        touched = _list_touched(boxes, self._map.tile_px, self.slots.shape)
        self._map.expect([tile for tile in touched if tile not in self._held])

    def hold(self, boxes: Ints) -> None:
        """Load the tiles that any of the boxes touches (first row, column, last row, column exclusive; (N, 4))."""
        wanted = _list_touched(boxes, self._map.tile_px, self.slots.shape)
        absent = [tile for tile in wanted if tile not in self._held]
        for tile in wanted:
            if tile in self._held:
                self._held.move_to_end(tile)
        self._grow(len(wanted))
        for tile in absent:
            if len(self._held) < self._flat["relative"].shape[1] // self._map.tile_px**2:
                slot = len(self._held)
            else:
                gone, slot = self._held.popitem(last=False)
                self.slots[gone] = -1
            self._read(tile, slot)
            self._held[tile] = slot
            self.slots[tile] = slot

    def _grow(self, tiles: int) -> None:
        """Make room for a number of tiles."""
        size = tiles * self._map.tile_px**2
        for stack, old in self._flat.items():
            if old.shape[1] < size:
                self._flat[stack] = np.empty((len(old), size), old.dtype)
                self._flat[stack][:, : old.shape[1]] = old

    def _read(self, tile: tuple[int, int], slot: int) -> None:
        side = self._map.tile_px
        for stack, names in self._stacks.items():
            for row, layer in enumerate(names):
                place = self._flat[stack][row, slot * side**2 : (slot + 1) * side**2]
                self._map.read_tile(layer, *tile, place.reshape(side, side))


def _list_touched(boxes: Ints, side: int, shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the tiles of the map that boxes touch, row by row."""
    first, last = boxes[:, :2] // side, (boxes[:, 2:] - 1) // side
    rows, cols = (last - first + 1).max(axis=0, initial=0).tolist()
    touched = np.zeros(shape, bool)
    for i, j in product(range(rows), range(cols)):
        tile = first + np.array([i, j])
        inside = ((tile >= 0) & (tile < shape) & (tile <= last)).all(axis=1)
        touched[tuple(tile[inside].T)] = True
    return [(int(i), int(j)) for i, j in np.argwhere(touched)]
