"""The 16 courses of a cost map, and which cells a step along each of them touches (ADR-27).

The courses are the directions from a cell to the nearest 16 cells that can be reached without passing another's centre: (1, 0), (2, 1),
(1, 1), (1, 2) and so on around. They lie 18.4° to 26.6° apart, 0°, 26.6°, 45°, 63.4°, 90° …, counter-clockwise from the grid's east. So the
cost of a step is that of exactly its own course, and a path of such steps is at most 1 / cos(13.3°) - 1 = 2.8 % longer than a straight one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

COURSES = 16

MAX_DETOUR = 1.0 / math.cos(math.atan2(1.0, 2.0) / 2.0)
"""How much longer than the straight line a path of steps can be, at most, on open ground."""

_FIRST_QUARTER = ((1, 0), (2, 1), (1, 1), (1, 2))
"""East and north in cells."""


def _list_moves() -> NDArray[np.int64]:
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
    """A cell that a step touches: east and north of where it begins, in cells, and the share of the step that lies in it.

    A share of 0 is a corner: the step only touches it, but a robot has a width.
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
