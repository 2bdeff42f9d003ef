"""The least-cost path where turns cost, too: Dijkstra over cells and courses, with edges between neighbouring courses of one cell.

A robot in a cell, on one of 16 courses, goes on along it, or turns to the next one for what that turn costs on the ground there.
The course of the start, and that of the goal, are free. Without costs of turns this finds what `tcpipe.planning.search` finds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from tcpipe.planning.courses import ANGLES_DEG, COURSES, MOVES
from tcpipe.planning.search import Found, Steps, best_potential

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_LEAST = 1e-9
"""What costs nothing costs this: a zero is no edge to scipy."""

_TURNS_RAD = np.radians(np.diff(np.append(ANGLES_DEG, 360.0)))
"""From each course to the next [rad], shape (16,)."""


def least_turning_path(steps: Steps, cols: int, start: int, goal: int, joule_per_rad: Floats) -> Found | None:
    """Return the path of least energy, that of its turns included; None where there is none.

    Parameters
    ----------
    steps : all steps, with a cost each [J].
    cols : columns of the grid.
    start, goal : flat indices of cells.
    joule_per_rad : what a turn costs in each cell, shape (cells,).
    """
    cells, first, end = _numbered(steps, start, goal)
    if cells is None:
        return None
    k = best_potential(steps)
    reduced = steps.cost - k * steps.rise_m
    course = _courses(steps, cols)
    node, there = first * COURSES + course, end * COURSES + course
    here = np.arange(len(cells) * COURSES)
    following = here - here % COURSES + (here + 1) % COURSES
    turn = np.tile(_TURNS_RAD, len(cells)) * np.repeat(joule_per_rad[cells], COURSES)
    graph = csr_array(
        (
            np.maximum(np.concatenate([reduced, turn, turn]), _LEAST),
            (np.concatenate([node, here, following]), np.concatenate([there, following, here])),
        ),
        shape=(len(here), len(here)),
    )
    ends = [int(np.searchsorted(cells, of)) * COURSES + np.arange(COURSES) for of in (start, goal)]
    cost, before, _ = dijkstra(graph, indices=ends[0], return_predecessors=True, min_only=True)
    last = int(ends[1][np.argmin(cost[ends[1]])])
    if not np.isfinite(cost[last]):
        return None
    nodes = [last]
    while before[nodes[-1]] >= 0:
        nodes.append(int(before[nodes[-1]]))
    visited = cells[np.array(nodes[::-1]) // COURSES]
    order = visited[np.append(True, np.diff(visited) != 0)]
    taken = np.isin(steps.begin * len(joule_per_rad) + steps.end, order[:-1] * len(joule_per_rad) + order[1:])
    total = float(cost[last] + k * steps.rise_m[taken].sum())
    return Found(order, total, float(cost[last]), k, int(np.count_nonzero(reduced < 0.0)))


def _numbered(steps: Steps, start: int, goal: int) -> tuple[Ints | None, Ints, Ints]:
    """Return the cells that steps begin or end in, rising, and the place of each step's ends among them; None where an end is not one."""
    cells, place = np.unique(np.concatenate([steps.begin, steps.end]), return_inverse=True)
    first, end = place[: len(steps.begin)], place[len(steps.begin) :]
    return (cells if np.isin([start, goal], cells).all() else None), first, end


def _courses(steps: Steps, cols: int) -> Ints:
    """Return the course of each step, shape (M,); rows run south."""
    (row0, col0), (row1, col1) = np.divmod(steps.begin, cols), np.divmod(steps.end, cols)
    table = np.zeros((5, 5), np.int64)
    table[MOVES[:, 0] + 2, MOVES[:, 1] + 2] = np.arange(COURSES)
    return np.asarray(table[col1 - col0 + 2, row0 - row1 + 2])
