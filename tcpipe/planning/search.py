"""Least-cost paths over a cost grid: scipy's Dijkstra on a sparse graph of 16 courses (ADR-27).

The cost of a step is the integral of the cost a metre, along the step's course, over the cells it crosses. Downhill a metre may cost less
than zero, which Dijkstra forbids. A potential proportional to height removes the grade: c' = c - k (h_b - h_a) changes all paths from a
start to a goal by the same amount, so the best path stays the best. k maximises the cost of the cheapest metre; steps that stay negative
count as zero, and `LeastCostPath` has their number.

Turns cost ``M |turn|`` beyond those of the model's segments, which were nearly straight: the torque of a skid-steered robot hardly depends
on its turn rate (ADR-13). Turns take no time here.

Replacing steps along 16 courses by straight lines where these are cheaper.

Dijkstra's path has 16 courses and is up to 2.8 % longer than necessary. This finds the cheapest path over a subset of its points, joined by
straight lines. The cost of a line is its integral over the cells that it crosses, interpolated between the two nearest courses. The result
never costs more than the steps and crosses no cell that is closed to them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from tcpipe.compiled import compile_kernel
from tcpipe.geometry.rotation import wrap_to_pi
from tcpipe.planning.cost_grid import ANGLES_DEG, COURSES, MOVES, CostGrid, find_crossed_cells
from tcpipe.tables.facts import PhysicsFit
from tcpipe.terrain.classes import ClassTable

Floats = NDArray[np.float64]

_LEAST = 1e-9
"""Steps that cost nothing cost this: a zero is no edge to scipy."""

_BINS = 512
_FLAT = 1e-9
_STEEPEST_PER_M = 1e5
"""No robot's weight over its drive's efficiency is above this [N]: ten tonnes."""

_PRECISION = 1e-3


@dataclass(frozen=True, slots=True)
class Steps:
    """All steps between neighbouring cells that can be made.

    Attributes
    ----------
    begin, end : flat indices of cells, shape (M,).
    cost : of the step, in the objective's unit, shape (M,); NaN where a cell that it crosses is not predicted.
    length_m : on the ground [m], shape (M,).
    rise_m : height of the end above the begin [m], shape (M,).
    """

    begin: NDArray[np.int64]
    end: NDArray[np.int64]
    cost: Floats
    length_m: Floats
    rise_m: Floats


@dataclass(frozen=True, slots=True)
class LeastCostPath:
    """A least-cost path: flat indices of its cells, its cost, its cost without the grade, and the potential a metre that takes it out."""

    cells: NDArray[np.int64]
    cost: float
    reduced_cost: float
    potential: float
    negative_steps: int


def make_steps(costs: CostGrid, objective: str, open_: NDArray[np.bool_], metres: Floats) -> Steps:
    """Return every step along every course.

    Parameters
    ----------
    costs, objective : what a metre costs.
    open_ : where a course may be driven, shape (16, rows, cols): cells a step only touches at a corner must be open, too.
    metres : ground metres a map metre along each course, shape (16,).
    """
    rows, cols = costs.grid.rows, costs.grid.cols
    per_metre = costs.per_metre(objective)
    known_m = costs.height_m[np.isfinite(costs.height_m)]
    height = np.nan_to_num(costs.height_m.astype(np.float64), nan=float(np.median(known_m)) if known_m.size else 0.0)
    parts: list[tuple[NDArray[np.int64], NDArray[np.int64], Floats, Floats, Floats]] = []
    for course in range(COURSES):
        east, north = MOVES[course].tolist()
        length_m = float(np.hypot(east, north)) * costs.grid.pixel_size_m * float(metres[course])
        row0, row1 = max(north, 0), rows + min(north, 0)  # rows run south
        col0, col1 = max(-east, 0), cols - max(east, 0)
        if row0 >= row1 or col0 >= col1:
            continue
        can = np.ones((row1 - row0, col1 - col0), np.bool_)
        mean = np.zeros(can.shape)
        for touch in find_crossed_cells(course):
            part = (slice(row0 - touch.north, row1 - touch.north), slice(col0 + touch.east, col1 + touch.east))
            can &= open_[course][part]
            if touch.share:
                mean += touch.share * np.where(open_[course][part], per_metre[course][part], 0.0)
        i, j = np.nonzero(can)
        begin = (i + row0) * cols + j + col0
        end = begin - north * cols + east
        rise = height.reshape(-1)[end] - height.reshape(-1)[begin]
        parts.append((begin, end, mean[i, j] * length_m, np.full(i.size, length_m), rise))
    return Steps(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def find_best_potential(steps: Steps) -> float:
    """Return k, the potential a metre of height, that makes the cheapest metre of ``steps`` as dear as can be: a concave search.

    Metres of about the same grade are taken as their cheapest at either end of the bin, so that a step is never dearer than it is.
    """
    per_m, grade = steps.cost / steps.length_m, steps.rise_m / steps.length_m
    if not grade.size or float(np.ptp(grade)) < _FLAT:
        return 0.0
    edges = np.linspace(grade.min(), grade.max(), _BINS + 1)
    cheapest = np.full(_BINS, np.inf)
    np.minimum.at(cheapest, np.clip(np.searchsorted(edges, grade, side="right") - 1, 0, _BINS - 1), per_m)
    used = np.isfinite(cheapest)
    grades, costs = np.concatenate([edges[:-1][used], edges[1:][used]]), np.tile(cheapest[used], 2)
    low, high = -_STEEPEST_PER_M, _STEEPEST_PER_M
    while high - low > _PRECISION:
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        low, high = (a, high) if (costs - a * grades).min() < (costs - b * grades).min() else (low, b)
    return 0.5 * (low + high)


def find_least_cost_path(steps: Steps, cells: int, start: int, goal: int) -> LeastCostPath | None:
    """Return the least-cost path from a cell to another (flat indices of ``cells`` in all); None where there is none."""
    if not steps.cost.size:
        return None
    k = find_best_potential(steps)
    reduced = steps.cost - k * steps.rise_m
    negative = int(np.count_nonzero(reduced < 0.0))
    cost, before = dijkstra(_build_graph(steps, reduced, cells), indices=start, return_predecessors=True)
    if not np.isfinite(cost[goal]):
        return None
    path = [goal]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    order = np.array(path[::-1])
    taken = np.isin(steps.begin * cells + steps.end, order[:-1] * cells + order[1:])
    return LeastCostPath(order, float(steps.cost[taken].sum()), float(cost[goal]), k, negative)


def compute_least_costs(steps: Steps, reduced: Floats, cells: int, start: int, goal: int, *, limit: float) -> Floats:
    """Return what the cheapest path over each cell costs, shape (cells,); infinite where that is more than ``limit``.

    Parameters
    ----------
    steps, reduced : all steps, and what each is taken to cost without the grade, shape (M,).
    """
    graph = _build_graph(steps, reduced, cells)
    there = dijkstra(graph, indices=start, limit=limit)
    back = dijkstra(graph.T.tocsr(), indices=goal, limit=limit)
    return np.asarray(there + back)


def _build_graph(steps: Steps, reduced: Floats, cells: int) -> csr_array:
    return csr_array((np.maximum(reduced, _LEAST), (steps.begin, steps.end)), shape=(cells, cells))


_CLASSES = 256
_ALL = "all"


@dataclass(frozen=True, slots=True)
class Turning:
    """Energy of a turn by class id [J/rad], shape (256,), and what a metre of the model's segments turns anyway [rad/m]."""

    joule_per_rad: Floats
    usual_radpm: float

    def energy_joule(self, turn_rad: Floats, length_m: Floats, class_id: NDArray[np.uint8]) -> Floats:
        """Return what turns cost beyond the usual [J], shape (N,), of N pieces of path of these lengths on these classes."""
        beyond_rad = np.maximum(np.abs(turn_rad) - self.usual_radpm * length_m, 0.0)
        return np.asarray(self.joule_per_rad[class_id] * beyond_rad)


def find_turning(fit: PhysicsFit | None, classes: ClassTable) -> Turning | None:
    """Return what turning costs by a fit, None without such a term; a class without a term costs the mean of the others."""
    found = {} if fit is None else {of.terrain: of.value for of in fit.terms if of.term == "turning"}
    if fit is None or not found:
        return None
    joule_per_rad = np.full(_CLASSES, found.get(_ALL, float(np.mean(list(found.values())))))
    for class_id, name in enumerate(classes.names().tolist()):
        joule_per_rad[class_id] = found.get(name, joule_per_rad[class_id])
    return Turning(joule_per_rad, fit.mean_turn_radpm)


def compute_turns(start_xy_m: Floats, end_xy_m: Floats) -> Floats:
    """Return how far each of N path segments turns [rad], shape (N,): half of the change of course at either of its ends, shape (N, 2).

    It compares the courses of chords, so that jitter of the drawn points is no turn.
    """
    east, north = (end_xy_m - start_xy_m).T
    change = np.abs(wrap_to_pi(np.diff(np.arctan2(north, east))))
    return np.asarray(0.5 * (np.append(change, 0.0) + np.insert(change, 0, 0.0)))


Ints = NDArray[np.int64]

_TURNS_RAD = np.radians(np.diff(np.append(ANGLES_DEG, 360.0)))
"""From each course to the next [rad], shape (16,)."""


def find_least_turning_path(
    steps: Steps, cols: int, start: int, goal: int, joule_per_rad: Floats
) -> LeastCostPath | None:
    """Return the path of least energy with turns, None where there is none.

    ``steps`` cost joules on a grid of ``cols`` columns; ``start`` and ``goal`` are flat indices; ``joule_per_rad`` has shape (cells,).
    """
    cells, place = np.unique(np.concatenate([steps.begin, steps.end]), return_inverse=True)
    if not np.isin([start, goal], cells).all():
        return None
    first, end = np.split(place, 2)
    k = find_best_potential(steps)
    reduced = steps.cost - k * steps.rise_m
    course = _find_courses(steps, cols)
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
    return LeastCostPath(order, total, float(cost[last]), k, int(np.count_nonzero(reduced < 0.0)))


def _find_courses(steps: Steps, cols: int) -> Ints:
    """Return the course of each step, shape (M,); rows run south."""
    (row0, col0), (row1, col1) = np.divmod(steps.begin, cols), np.divmod(steps.end, cols)
    table = np.zeros((5, 5), np.int64)
    table[MOVES[:, 0] + 2, MOVES[:, 1] + 2] = np.arange(COURSES)
    return np.asarray(table[col1 - col0 + 2, row0 - row1 + 2])


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
