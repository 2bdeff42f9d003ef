"""Replacing steps along 16 courses by straight lines where these are cheaper.

Dijkstra's path has 16 courses and is up to 2.8 % longer than necessary. This finds the cheapest path over a subset of its points, joined by
straight lines. The cost of a line is its integral over the cells that it crosses, interpolated between the two nearest courses. The result
never costs more than the steps and crosses no cell that is closed to them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel
from tcpipe.planning.cost_grid import ANGLES_DEG, CostGrid

SAMPLES_A_CELL = 4


@compile_kernel
def find_best_lines(  # noqa: PLR0917
    per_metre: NDArray[np.float32],
    open_: NDArray[np.bool_],
    angles: NDArray[np.float64],
    metres: NDArray[np.float64],
    points: NDArray[np.float64],
    window: int,
    so_far: NDArray[np.float64],
    before: NDArray[np.int64],
) -> None:
    """Write the cost from the first point to each point of a path, and where its last line begins, to ``so_far`` and ``before``, (P,).

    ``per_metre`` and ``open_`` have shape (16, rows, cols). ``angles``, (16,), are the courses [rad], counter-clockwise from the grid's
    east, rising from 0; ``metres``, (16,), the ground metres a cell along each. ``points`` [cells] are as in `straighten_path`. A line
    begins at most ``window`` points earlier; a line between neighbours is a step of the path and always allowed.
    """
    so_far[0], before[0] = 0.0, 0
    for j in range(1, points.shape[0]):
        so_far[j] = np.inf
        for i in range(max(j - window, 0), j):
            cost = so_far[i] + _compute_line_cost(per_metre, open_, angles, metres, points[i], points[j], i == j - 1)
            if cost < so_far[j] - 1e-9 * abs(so_far[j]) or (so_far[j] == np.inf and cost < np.inf):
                so_far[j], before[j] = cost, i


@compile_kernel
def _compute_line_cost(  # noqa: PLR0917
    per_metre: NDArray[np.float32],
    open_: NDArray[np.bool_],
    angles: NDArray[np.float64],
    metres: NDArray[np.float64],
    begin: NDArray[np.float64],
    end: NDArray[np.float64],
    is_step: bool,  # noqa: FBT001
) -> float:
    """Return the cost of a straight line, of its course by interpolation between the two nearest; infinite where it may not be driven."""
    east, north = end[0] - begin[0], begin[1] - end[1]
    length = np.hypot(east, north)
    if length == 0.0:
        return 0.0
    angle = np.arctan2(north, east) % (2.0 * np.pi)
    low = np.searchsorted(angles, angle, side="right") - 1
    high = (low + 1) % angles.size
    gap = (angles[high] - angles[low]) % (2.0 * np.pi)
    share = ((angle - angles[low]) % (2.0 * np.pi)) / gap
    count = int(np.ceil(length * SAMPLES_A_CELL))
    total = 0.0
    for k in range(count):
        t = (k + 0.5) / count
        col = int(np.floor(begin[0] + t * east + 0.5))
        row = int(np.floor(begin[1] - t * north + 0.5))
        if not is_step and (
            (share < 0.999 and not open_[low, row, col]) or (share > 0.001 and not open_[high, row, col])
        ):
            return np.inf
        a, b = per_metre[low, row, col], per_metre[high, row, col]
        if a != a:  # not known  # noqa: PLR0124
            a = b
        if b != b:  # noqa: PLR0124
            b = a
        total += (1.0 - share) * a + share * b
    if total != total:  # a step from ground of which nothing is known  # noqa: PLR0124
        return np.inf
    scale = (1.0 - share) * metres[low] + share * metres[high]
    return float(total / count * length * scale)


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
    """Return how many points earlier a line may begin, which bounds the work."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    each = max(float(steps.mean()), 1.0) * SAMPLES_A_CELL / 2.0
    return int(np.clip(np.sqrt(_MOST_SAMPLES / (len(points) * each)), 2, len(points)))
