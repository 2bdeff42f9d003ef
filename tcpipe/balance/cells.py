"""Cells of class, slope and speed, how much a dataset knows of each, and ground of rare cells to drive next (ADR-19)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import label
from shapely.geometry.base import BaseGeometry

from tcpipe.balance.correlation import Correlation, compute_effective_size
from tcpipe.tables.findings import read_threshold

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SLOPE_EDGES_DEG = (-15.0, -10.0, -5.0, -2.0, 2.0, 5.0, 10.0, 15.0)
"""Between the ranges of slope along travel [deg]; the paper's robot climbs 22.5°."""

SLOPE_NAMES = (
    *("below -15°", "-15° to -10°", "-10° to -5°", "-5° to -2°", "-2° to 2°"),
    *("2° to 5°", "5° to 10°", "10° to 15°", "above 15°"),
)

_SPEEDS = 5
"""Ranges of speed below the 99 % quantile."""

CELL_M = 4.0
"""Side of a cell of ground [m]: a robot that is steered by GNSS hits it, and four segments fit in."""

LEVEL = 4
"""Range of slope (`SLOPE_NAMES`) that is the same in every direction."""

_PATCHES_EACH = 20
"""Largest patches of ground for each class and slope."""

_MOST_KEYS = 256
"""Classes, ranges of slope and ranges of speed each have smaller numbers."""

CLOSED = -1
"""Class of ground that is closed or unknown."""

_WINDS = ("E", "NE", "N", "NW", "W", "SW", "S", "SE")


@dataclass(frozen=True, slots=True)
class Cell:
    """Samples of one class and range of slope, and of one range of speed unless ``speed`` is None.

    ``effective`` is the number of independent samples that they are worth, None if unknown.
    """

    terrain_class: int
    """0 without a terrain layer."""
    slope: int
    """Number of the range in `SLOPE_NAMES`."""
    speed: int | None
    samples: Mapping[str, int]
    """By split."""
    effective: float | None
    effective_train: float | None

    @property
    def is_undersampled(self) -> bool:
        """Whether it has few independent samples: with 30, its mean is known to 1/√30, a fifth, of its standard deviation."""
        count = self.effective if self.effective is not None else sum(self.samples.values())
        return count < read_threshold("thin-ground", "enough_count")


def find_slope_ranges(slope_rad: Floats) -> NDArray[np.int8]:
    """Return the range of `SLOPE_NAMES` that each slope [rad] lies in, shape (N,)."""
    return np.searchsorted(np.radians(SLOPE_EDGES_DEG), slope_rad, side="right").astype(np.int8)


def choose_speed_edges(velocity_mps: Floats) -> tuple[float, ...]:
    """Return the borders between ranges of speed [m/s]: round steps, about five of them up to the fastest hundredth."""
    top = float(np.quantile(velocity_mps, 0.99)) if len(velocity_mps) else 0.0
    if not top > 0.0:
        return ()
    power = 10.0 ** np.floor(np.log10(top / _SPEEDS))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power * _SPEEDS >= top * (1 - 1e-9))
    return tuple(round(step * number, 9) for number in range(1, _SPEEDS) if step * number < top)


def count_cells(
    keys: Sequence[NDArray[np.integer]],
    splits: Mapping[str, NDArray[np.bool_]],
    xy_m: Floats,
    correlations: Sequence[Correlation],
) -> list[Cell]:
    """Return every cell that holds a sample, by class, slope and speed.

    Parameters
    ----------
    keys : class ids, ranges of slope and, if cells have one, of speed, each of shape (N,).
    splits : which samples are in each split that counts, ``train`` among them, shape (N,).
    xy_m : centre of every footprint [m], shape (N, 2).
    correlations : of the labels; the one with the smallest effective size counts.
    """
    counted = np.flatnonzero(np.any(list(splits.values()), axis=0))
    code = np.zeros(len(counted), np.int32)
    for key in keys:
        code = code * _MOST_KEYS + key[counted]
    codes = np.unique(code)
    member = np.searchsorted(codes, code).astype(np.int32)
    order = np.argsort(member, kind="stable")
    parts = np.split(counted[order], np.flatnonzero(np.diff(member[order])) + 1)
    cells = []
    for found, rows in zip(codes.tolist(), parts, strict=False):  # a part even where there is no cell
        terrain, slope, *speed = (found // _MOST_KEYS**at % _MOST_KEYS for at in reversed(range(len(keys))))
        train = rows[splits["train"][rows]]
        cells.append(
            Cell(
                terrain,
                slope,
                speed[0] if speed else None,
                {name: int(is_in_split[rows].sum()) for name, is_in_split in splits.items()},
                compute_effective_size(xy_m[rows], *correlations) if correlations else None,
                compute_effective_size(xy_m[train], *correlations) if correlations else None,
            )
        )
    return cells


@dataclass(frozen=True, slots=True)
class MapGround:
    """Cells of a map, (R, C), row 0 in the north: class id or `CLOSED`, and gradient (metres up a metre east and north), (R, C, 2).

    ``x_min_m`` and ``y_max_m`` are the outer corner of cell (0, 0), ``cell_m`` its side. ``up`` and ``down`` are the ranges of slope of its
    fall line in both directions.
    """

    terrain_class: NDArray[np.int16]
    gradient: Floats
    x_min_m: float
    y_max_m: float
    cell_m: float
    up: NDArray[np.int8] = field(init=False)
    down: NDArray[np.int8] = field(init=False)

    def __post_init__(self) -> None:
        """Find the ranges of slope."""
        steepest = np.arctan(np.hypot(self.gradient[..., 0], self.gradient[..., 1]))
        object.__setattr__(self, "up", find_slope_ranges(steepest))
        object.__setattr__(self, "down", find_slope_ranges(-steepest))

    def find_cells(self, xy_m: Floats) -> tuple[Ints, Ints, NDArray[np.bool_]]:
        """Return row and column of points, shape (N, 2) [m], and whether they lie on the map."""
        col = np.floor((xy_m[:, 0] - self.x_min_m) / self.cell_m).astype(np.int64)
        row = np.floor((self.y_max_m - xy_m[:, 1]) / self.cell_m).astype(np.int64)
        rows, cols = self.terrain_class.shape
        return row, col, (row >= 0) & (row < rows) & (col >= 0) & (col < cols)


@dataclass(frozen=True, slots=True)
class Patch:
    """Connected ground that offers one class and slope: its polygon in the map's plane, and the mean direction of travel there."""

    area_m2: float
    towards: str | None
    """One of eight winds; None on level ground, where every direction will do."""
    polygon: BaseGeometry


def cells_available(ground: MapGround, terrain_class: int, slope: int) -> NDArray[np.bool_]:
    """Return which cells offer a class and a range of slope, (R, C): a cell offers the two slopes of its fall line."""
    found: NDArray[np.bool_] = (ground.terrain_class == terrain_class) & (
        (ground.up if _sign(slope) > 0 else ground.down) == slope
    )
    return found


def find_undersampled_ground(ground: MapGround, terrain_class: int, slope: int, driven_xy_m: Floats) -> Iterator[Patch]:
    """Yield the patches of connected ground of a class and a range of slope without samples there, the largest first.

    ``driven_xy_m`` are the centres of the samples of that class and slope [m], shape (N, 2).
    """
    free = cells_available(ground, terrain_class, slope)
    row, col, on = ground.find_cells(driven_xy_m)
    free[row[on], col[on]] = False
    for row, col in _find_largest_patches(free):
        yield _make_patch(ground, row, col, slope)


def _sign(slope: int) -> int:
    """Return whether a range of slope is driven up (1) or down (-1) the fall line."""
    return 1 if slope >= LEVEL else -1


def _find_largest_patches(free: NDArray[np.bool_]) -> list[tuple[Ints, Ints]]:
    """Return rows and columns of the largest connected patches of cells, the first in the map's order among equals."""
    numbers, count = label(free)
    cells = np.flatnonzero(free)
    patch_number = numbers.reshape(-1)[cells]
    sizes = np.bincount(patch_number, minlength=count + 1)[1:]
    order, ends = cells[np.argsort(patch_number, kind="stable")], np.append(0, np.cumsum(sizes))
    chosen = np.argsort(-sizes, kind="stable")[:_PATCHES_EACH]
    parts = (order[ends[number] : ends[number + 1]] for number in chosen.tolist())
    return [(part // free.shape[1], part % free.shape[1]) for part in parts]


def _make_patch(ground: MapGround, row: Ints, col: Ints, slope: int) -> Patch:
    boxes = shapely.box(col, -row - 1, col + 1, -row)  # in whole cells: edges that meet are equal
    corner_m = np.array([ground.x_min_m, ground.y_max_m])
    polygon = shapely.transform(shapely.union_all(boxes), lambda cells: corner_m + cells * ground.cell_m)
    east_up, north_up = _sign(slope) * ground.gradient[row, col].sum(axis=0)
    wind = int(np.round(np.degrees(np.arctan2(north_up, east_up)) / 45.0)) % 8
    return Patch(len(row) * ground.cell_m**2, None if slope == LEVEL else _WINDS[wind], polygon)


def fit_cell_gradients(height_m: Floats, pixels: int, pixel_size_m: float) -> Floats:
    """Return the slope of a plane fitted to each square of ``pixels`` × ``pixels`` heights: metres up a metre east and north, (R, C, 2)."""
    rows, cols = height_m.shape[0] // pixels, height_m.shape[1] // pixels
    blocks = height_m[: rows * pixels, : cols * pixels].reshape(rows, pixels, cols, pixels)
    offset_m = (np.arange(pixels) - (pixels - 1) / 2.0) * pixel_size_m
    scale = pixels * (offset_m**2).sum()
    east, north = np.einsum("ricj,j->rc", blocks, offset_m), np.einsum("ricj,i->rc", blocks, -offset_m)
    return np.asarray(np.stack([east, north], axis=-1) / scale)


def find_cell_classes(terrain: NDArray[np.uint8], pixels: int, traversable: NDArray[np.bool_]) -> NDArray[np.int16]:
    """Return the class of more than half of each square of pixels, `CLOSED` unless every pixel may be driven over, (R, C)."""
    rows, cols = terrain.shape[0] // pixels, terrain.shape[1] // pixels
    blocks = terrain[: rows * pixels, : cols * pixels].reshape(rows, pixels, cols, pixels).swapaxes(1, 2)
    flat = blocks.reshape(rows, cols, pixels * pixels)
    middle = np.sort(flat, axis=-1)[..., flat.shape[-1] // 2]  # more than half of one class: the median is it
    most = (flat == middle[..., None]).mean(axis=-1) > 0.5
    return np.where(traversable[flat].all(axis=-1) & most, middle.astype(np.int16), np.int16(CLOSED))
