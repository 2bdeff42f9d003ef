"""From steps along 16 courses to straight lines: a path's bends are left out where the line between two of its points is cheaper.

Dijkstra's path is made of 16 courses and up to 2.8 % longer than need be. Of all paths over some of its points, joined by straight lines,
the cheapest is found; a line's cost is integrated over the cells it crosses, at its own course, interpolated between the two nearest. It
never costs more than the steps, and crosses no cell that they could not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.planning.cost_grid import CostGrid
from tcpipe.planning.courses import ANGLES_DEG
from tcpipe.planning.straight_kernel import SAMPLES_A_CELL, find_best_lines

_MOST_SAMPLES = 3e8
_PASSES = 4


def straighten_path(
    costs: CostGrid,
    objective: str,
    open_: NDArray[np.bool_],
    metres: NDArray[np.float64],
    points_px: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Return the points that remain, and the cost of the path over them.

    Parameters
    ----------
    costs, objective : what a metre costs.
    open_ : where a course may be driven, shape (16, rows, cols).
    metres : ground metres a map metre along each course, shape (16,).
    points_px : the path's points [cells], centres are integers, shape (P, 2).
    """
    per_metre = costs.per_metre(objective).astype(np.float32, copy=False)
    angles, scale = np.radians(ANGLES_DEG), metres * costs.grid.pixel_size_m
    limit = np.array([costs.grid.cols, costs.grid.rows]) - 0.5 - 1e-9
    points, cost = np.clip(points_px, -0.5, limit), np.inf
    for _ in range(_PASSES):
        so_far, before = np.empty(len(points)), np.zeros(len(points), np.int64)
        find_best_lines(per_metre, open_, angles, scale, points, _choose_window(points), so_far, before)
        kept = [len(points) - 1]
        while kept[-1]:
            kept.append(int(before[kept[-1]]))
        unchanged = len(kept) == len(points)
        points, cost = points[kept[::-1]], float(so_far[-1])
        if unchanged:
            break
    return points, cost


def _choose_window(points: NDArray[np.float64]) -> int:
    """Return how many points back lines may begin, so that the work stays bounded."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    each = max(float(steps.mean()), 1.0) * SAMPLES_A_CELL / 2.0
    return int(np.clip(np.sqrt(_MOST_SAMPLES / (len(points) * each)), 2, len(points)))
