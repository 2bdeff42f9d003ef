"""Costs of a metre along 16 courses in the cells of a coarse grid over a map (ADR-27).

A cell is a square of ``cell_size_m`` map metres; its cost along a course is that of the metre of ground around its
middle, driven in that direction. The courses are the directions to the nearest 16 cells that can be reached without
passing another's centre: (1, 0), (2, 1), (1, 1), (1, 2) and so on: 0°, 26.6°, 45°, 63.4°, 90° …, counter-clockwise from
the grid's east. A path of such steps is at most 1 / cos(13.3°) - 1 = 2.8 % longer than a straight line.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Bytes, Floats, Floats32, GenericArray, Ints, Mask, NamedArrays
from tcpipe.errors import MapError
from tcpipe.learning.models import Model
from tcpipe.planning.cost_model import BATCH, NO_COST, Bits, Reason, SegmentPredictions, iterate_predictions
from tcpipe.progress import Meter
from tcpipe.terrain.projection import make_metres_from_plane, parse_crs
from tcpipe.terrain.sampling import PatchFrames, find_classes_at
from tcpipe.terrain.target_grid import MapGrid
from tcpipe.terrain.tiles import CACHED_TILES, MapReader, choose_level

COURSES = 16

_FIRST_QUARTER = ((1, 0), (2, 1), (1, 1), (1, 2))  # east and north in cells


def _list_moves() -> Ints:
    moves = np.array(_FIRST_QUARTER)
    quarters = [moves]
    for _ in range(3):
        moves = np.stack([-moves[:, 1], moves[:, 0]], axis=1)
        quarters.append(moves)
    return np.concatenate(quarters)


MOVES = _list_moves()
"""East and north of each course's step, in cells, shape (16, 2)."""

DIRECTIONS = MOVES / np.linalg.norm(MOVES, axis=1)[:, None]
"""Unit vectors of the courses in the grid's plane, shape (16, 2)."""

ANGLES_DEG = np.degrees(np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0])) % 360.0
"""Counter-clockwise from the grid's east [deg], shape (16,)."""


@dataclass(frozen=True, slots=True)
class CrossedCell:
    """A cell that a step touches: east and north of its start [cells], and the share of the step inside.

    A share of 0 is a corner that the step only touches; a robot has a width.
    """

    east: int
    north: int
    share: float


def find_crossed_cells(course: int) -> tuple[CrossedCell, ...]:
    """Return the cells that a step along a course touches, the first and the last included."""
    east, north = MOVES[course].tolist()
    side_e, side_n = (east > 0) - (east < 0), (north > 0) - (north < 0)
    if abs(east) + abs(north) == 1:
        return CrossedCell(0, 0, 0.5), CrossedCell(east, north, 0.5)
    if abs(east) == abs(north):
        return (
            CrossedCell(0, 0, 0.5),
            CrossedCell(side_e, 0, 0.0),
            CrossedCell(0, side_n, 0.0),
            CrossedCell(east, north, 0.5),
        )
    middle = CrossedCell(side_e, 0, 0.25) if abs(east) == 2 else CrossedCell(0, side_n, 0.25)
    return CrossedCell(0, 0, 0.25), middle, CrossedCell(side_e, side_n, 0.25), CrossedCell(east, north, 0.25)


Classes = Bytes
Cells = Ints

CELLS_OF_BLOCK = BATCH // COURSES

# Tiles across a strip of the map, of which three rows are in memory (`tcpipe.terrain.tiles`).
_STRIP_TILES = CACHED_TILES // 3 - 3

_ROWS_TOGETHER = 256

BARRED = NO_COST | Reason.OBSTACLE
"""Reasons of ground that a planner never crosses."""


def make_grid(source: MapReader, cell_size_m: float) -> MapGrid:
    """Return the grid of whole cells from the map's north-west corner; `MapError`: the map is smaller than a cell."""
    grid = source.grid
    cells = [int(size * grid.pixel_size_m / cell_size_m + 1e-6) for size in (grid.rows, grid.cols)]
    if min(cells) < 1:
        raise MapError(
            f"map {source.name}: is smaller than one cell of {cell_size_m:g} m; choose a smaller --cell-size"
        )
    return MapGrid(grid.crs, grid.x_min_m, grid.y_max_m, cell_size_m, cells[0], cells[1])


@dataclass(frozen=True, slots=True)
class CostGrid:
    """Costs and reasons of every cell and course.

    Attributes
    ----------
    grid : the cells.
    power_watt, velocity_mps : shape (16, rows, cols); NaN where there is no cost.
    reasons : `Reason` bits, shape (16, rows, cols).
    height_m : of the cells' middles, shape (rows, cols); NaN where the map has none.
    """

    grid: MapGrid
    power_watt: Floats32
    velocity_mps: Floats32
    reasons: Bits
    height_m: Floats32

    def per_metre(self, objective: str) -> Floats32:
        """Return the cost of a metre: ``energy`` [J/m], ``time`` [s/m] or ``distance`` [m/m]; NaN if unknown."""
        if objective == "distance":
            return np.ones_like(self.velocity_mps)
        slowness = 1.0 / self.velocity_mps
        return self.power_watt * slowness if objective == "energy" else slowness

    def open_courses(self, *, allow_extrapolation: bool) -> Mask:
        """Return the courses without obstacle and inside the training range, shape (16, rows, cols)."""
        forbidden = np.uint16(BARRED) if allow_extrapolation else np.uint16(0xFFFF)
        return np.asarray(self.reasons & forbidden == 0)

    def take(self, cells: Cells) -> dict[str, GenericArray]:
        """Return the costs and heights of cells (flat indices, shape (n,)) by name."""
        shapes = {"power_watt": COURSES, "velocity_mps": COURSES, "reasons": COURSES, "height_m": 1}
        return {name: getattr(self, name).reshape(count, -1)[:, cells] for name, count in shapes.items()}

    def load(self, cells: Cells, arrays: NamedArrays) -> None:
        """Write the arrays of `take`."""
        for name, values in arrays.items():
            getattr(self, name).reshape(len(values), -1)[:, cells] = values

    def put(self, cells: Cells, found: SegmentPredictions) -> None:
        """Write the predictions of cells (flat indices, (n,)), 16 a cell, courses fastest."""
        for name in ("power_watt", "velocity_mps", "reasons"):
            getattr(self, name).reshape(COURSES, -1)[:, cells] = getattr(found, name).reshape(-1, COURSES).T
        self.height_m.reshape(-1)[cells] = average_known(found.height_m.reshape(-1, COURSES), 1)


def average_known(values: NDArray[np.floating], axis: int) -> Floats:
    """Return the mean over the courses, which are an axis of ``values``, that have a value; NaN where none has."""
    known = ~np.isnan(values)
    count, total = known.sum(axis=axis), np.where(known, values, 0.0).sum(axis=axis, dtype=float)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def make_empty_grid(grid: MapGrid) -> CostGrid:
    """Return a grid without predictions."""
    shape = (COURSES, grid.rows, grid.cols)
    nothing = np.float32(np.nan)
    return CostGrid(
        grid,
        np.full(shape, nothing),
        np.full(shape, nothing),
        np.full(shape, int(Reason.NODATA), np.uint16),
        np.full(shape[1:], nothing),
    )


def iterate_blocks(source: MapReader, model: Model, grid: MapGrid, wanted: Mask | None = None) -> Iterator[Cells]:
    """Yield flat indices of up to `CELLS_OF_BLOCK` cells by tile of the map, so that each tile is decoded once.

    A map wider than 29 tiles is cut into strips; the tiles at their borders are decoded twice.

    Parameters
    ----------
    source, model, grid : the map, whose patches are sampled from it, and the cells.
    wanted : which cells, shape (rows, cols); None: all.
    """
    level = choose_level(source, model.card.inputs.patch_m / model.card.inputs.patch_px)
    side_m = level.tile_px * level.grid.pixel_size_m
    tile_of_row, tile_of_col = (
        ((np.arange(count) + 0.5) * grid.pixel_size_m / side_m).astype(np.int64) for count in (grid.rows, grid.cols)
    )
    for first in range(0, int(tile_of_col[-1]) + 1, _STRIP_TILES):
        for i in np.unique(tile_of_row):
            rows = np.flatnonzero(tile_of_row == i)
            for j in range(first, min(first + _STRIP_TILES, int(tile_of_col[-1]) + 1)):
                cells = (rows[:, None] * grid.cols + np.flatnonzero(tile_of_col == j)[None, :]).reshape(-1)
                if wanted is not None:
                    cells = cells[wanted.reshape(-1)[cells]]
                yield from (cells[k : k + CELLS_OF_BLOCK] for k in range(0, cells.size, CELLS_OF_BLOCK))


class CellFrames:
    """Frames of the metres through the middles of cells, 16 a cell, with the map's scale at the cells."""

    __slots__ = ("_corners", "_grid")

    def __init__(self, grid: MapGrid, *, where: str) -> None:
        self._grid = grid
        corners = grid.xy_from_px(np.array([(c, r) for r in (0, grid.rows - 1) for c in (0, grid.cols - 1)], float))
        self._corners = make_metres_from_plane(parse_crs(grid.crs, where=where), corners).reshape(2, 2, 2, 2)

    def of(self, cells: Cells) -> PatchFrames:
        """Return the frames of cells (flat indices, (n,)), shape (16 n,), courses fastest."""
        row, col = np.divmod(cells, self._grid.cols)
        centre = self._grid.xy_from_px(np.stack([col, row], axis=1).astype(float))
        along = np.tile(DIRECTIONS / self.metres(cells)[:, None], (cells.size, 1))
        return PatchFrames(np.repeat(centre, COURSES, axis=0), along, np.stack([-along[:, 1], along[:, 0]], axis=1))

    def metres(self, cells: Cells) -> Floats:
        """Return ground metres a map metre by course at the cells, shape (16,), linear between the grid's corners."""
        down, right = np.divmod(cells, self._grid.cols)
        v, u = down.mean() / max(self._grid.rows - 1, 1), right.mean() / max(self._grid.cols - 1, 1)
        (north_west, north_east), (south_west, south_east) = self._corners
        ground = (1 - v) * ((1 - u) * north_west + u * north_east) + v * ((1 - u) * south_west + u * south_east)
        return np.asarray(np.linalg.norm(DIRECTIONS @ ground.T, axis=1))


@dataclass(frozen=True, slots=True)
class LazyCostGrid:
    """Costs of a map's cells, and which cells are predicted, shape (rows, cols)."""

    model: Model
    source: MapReader
    costs: CostGrid
    predicted: Mask
    frames: CellFrames

    def predict(self, wanted: Mask) -> None:
        """Predict the wanted cells that are not predicted yet."""
        todo = list(iterate_blocks(self.source, self.model, self.costs.grid, wanted & ~self.predicted))
        answers = iterate_predictions(self.model, self.source, (self.frames.of(cells) for cells in todo))
        meter = Meter("predicting", len(todo))
        for cells, found in zip(todo, answers, strict=True):
            self.costs.put(cells, found)
            meter.add(1)
        self.predicted[wanted] = True

    def class_id(self) -> Classes:
        """Return the class under the middle of each cell, shape (rows, cols); 0 without data, or without classes."""
        return read_classes(self.source, self.costs.grid)


def iterate_row_strips(grid: MapGrid) -> Iterator[tuple[int, int]]:
    """Yield first and last row (exclusive) of each strip of a grid; one strip is in memory at a time."""
    for first in range(0, grid.rows, _ROWS_TOGETHER):
        yield first, min(first + _ROWS_TOGETHER, grid.rows)


def read_classes(source: MapReader, grid: MapGrid) -> Classes:
    """Return the class under the middle of each cell, shape (rows, cols); 0 without data, or without classes."""
    classes = np.zeros((grid.rows, grid.cols), np.uint8)
    for first, last in iterate_row_strips(grid) if "terrain" in source.layers else ():
        rows = classes[first:last]
        row, col = np.mgrid[first : first + len(rows), : grid.cols]
        middle = grid.xy_from_px(np.stack([col, row], axis=-1).reshape(-1, 2).astype(float))
        rows[:] = np.maximum(find_classes_at(source, middle), 0).reshape(rows.shape)
    return classes


def make_survey(model: Model, source: MapReader, costs: CostGrid | float) -> LazyCostGrid:
    """Return a survey from a cost map, or one of cells of this side [m] without any prediction."""
    is_known = isinstance(costs, CostGrid)
    costs = costs if isinstance(costs, CostGrid) else make_empty_grid(make_grid(source, costs))
    known = np.full((costs.grid.rows, costs.grid.cols), is_known)
    return LazyCostGrid(model, source, costs, known, CellFrames(costs.grid, where=f"map {source.name}"))
