"""Least-cost paths over a cost grid: Dijkstra and A* on an implicit graph of 16 courses (ADR-27).

The cost of a step is the integral of the cost a metre, along the step's course, over the cells it crosses. Downhill a
metre may have a negative cost, which Dijkstra forbids. A potential proportional to height removes the grade: c' = c - k
(h_b - h_a) changes all paths from a start to a goal by the same amount, so the best path stays the best. k maximises
the cost of the cheapest metre; steps that stay negative count as zero, and `LeastCostPath` has their number.

Turns cost ``M |turn|`` beyond those of the model's segments, which were nearly straight: the torque of a skid-steered
robot hardly depends on its turn rate (ADR-13). Turns take no time here. The search with turns has a state for each cell
and course. Its bound for A* is the exact cost to the goal without turns, which turns can only raise, so that it visits
few states and its path is as cheap as that of a full search. No step is stored: both searches compute a step's cost
when they reach it.

Replacing steps along 16 courses by straight lines where these are cheaper.

Dijkstra's path has 16 courses and is up to 2.8 % longer than necessary. `straighten_path` finds the cheapest path over
a subset of its points, joined by straight lines. The cost of a line is its integral over the cells that it crosses,
interpolated between the two nearest courses. The result never costs more than the steps and crosses no cell that is
closed to them.
"""

from dataclasses import dataclass
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Bytes, Floats, Floats32, Ints, Mask
from tcpipe.compiled import compile_kernel
from tcpipe.geometry.rotation import wrap_to_pi
from tcpipe.planning.cost_grid import ANGLES_DEG, COURSES, MOVES, CostGrid, find_crossed_cells
from tcpipe.tables.facts import PhysicsFit
from tcpipe.terrain.layers import ClassTable

Classes = Bytes

_LEAST = 1e-9  # least cost of a step, so that no two states precede each other

_BINS = 512
_FLAT = 1e-9
_STEEPEST_PER_M = 1e5  # largest weight of a robot over its drive's efficiency [N]: ten tonnes

_PRECISION = 1e-3


class GridSteps(NamedTuple):
    """Inputs of the costs of all steps between neighbouring cells, for compiled kernels.

    Attributes
    ----------
    per_metre : cost of a metre in the objective's unit, shape (rows, cols, 16); infinite for closed courses.
    height_m : of the cells' middles, shape (rows, cols).
    length_m : of the step along each course, on the ground [m], shape (16,).
    crossed : north and east, in cells, of the cells that a step touches, the last one where it ends, shape (16, 4, 2).
    shares : of the step in each of them, shape (16, 4).
    """

    per_metre: Floats32
    height_m: Floats
    length_m: Floats
    crossed: Ints
    shares: Floats

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.per_metre.shape[0], self.per_metre.shape[1]


@dataclass(frozen=True, slots=True)
class LeastCostPath:
    """A least-cost path: flat indices of its cells, and its cost."""

    cells: Ints
    cost: float
    negative_steps: int
    """Steps that gain more energy than their height explains; they cost nothing."""


def make_steps(costs: CostGrid, per_metre: Floats32, open_: Mask, metres: Floats) -> GridSteps:
    """Return the steps from each cell along each course.

    Parameters
    ----------
    costs, per_metre : the cells, and their cost per metre along each course, shape (16, rows, cols).
    open_ : open courses, shape (16, rows, cols); cells that a step touches only at a corner must be open, too.
    metres : ground metres per map metre along each course, shape (16,).
    """
    known_m = costs.height_m[np.isfinite(costs.height_m)]
    merged = np.empty((*costs.height_m.shape, COURSES), np.float32)
    for course in range(COURSES):
        merged[:, :, course] = np.where(open_[course], per_metre[course], np.inf)
    crossed, shares = np.zeros((COURSES, 4, 2), np.int64), np.zeros((COURSES, 4))
    for course in range(COURSES):
        cells = find_crossed_cells(course)
        cells = (*cells[:1],) * (4 - len(cells)) + cells
        crossed[course] = [(cell.north, cell.east) for cell in cells]
        shares[course] = [cell.share for cell in cells]
        shares[course, : 4 - len(find_crossed_cells(course))] = 0.0
    return GridSteps(
        merged,
        np.nan_to_num(costs.height_m.astype(np.float64), nan=float(np.median(known_m)) if known_m.size else 0.0),
        np.hypot(*MOVES.T) * costs.grid.pixel_size_m * metres,
        crossed,
        shares,
    )


@compile_kernel
def compute_step(steps: GridSteps, k: float, course: int, row: int, col: int) -> float:
    """Return the cost of a step from a cell along a course, without the grade ``k``; infinite if it is closed."""
    rows, cols, _ = steps.per_metre.shape
    row1, col1 = row - steps.crossed[course, 3, 0], col + steps.crossed[course, 3, 1]
    if row1 < 0 or row1 >= rows or col1 < 0 or col1 >= cols:
        return np.inf
    mean = 0.0
    for touch in range(4):
        north, east = steps.crossed[course, touch]
        cost = steps.per_metre[row - north, col + east, course]
        if cost == np.inf:
            return np.inf
        share = steps.shares[course, touch]
        if share > 0.0:
            mean += share * cost
    return float(mean * steps.length_m[course] - k * (steps.height_m[row1, col1] - steps.height_m[row, col]))


@compile_kernel
def _bin_by_grade(steps: GridSteps, low: float, high: float, cheapest: Floats) -> tuple[float, float]:
    """Write the cheapest known metre of each bin of grade from ``low`` to ``high``; return the extreme grades."""
    rows, cols, courses = steps.per_metre.shape
    least, greatest = np.inf, -np.inf
    for row in range(rows):
        for col in range(cols):
            for course in range(courses):
                cost = compute_step(steps, 0.0, course, row, col)
                if cost < np.inf:
                    north, east = steps.crossed[course, 3]
                    rise = steps.height_m[row - north, col + east] - steps.height_m[row, col]
                    grade = rise / steps.length_m[course]
                    least, greatest = min(least, grade), max(greatest, grade)
                    if cheapest.size:
                        at = min(int((grade - low) / (high - low) * cheapest.size), cheapest.size - 1)
                        cheapest[at] = min(cheapest[at], cost / steps.length_m[course])
    return least, greatest


def find_best_potential(steps: GridSteps) -> float:
    """Return k, the potential a metre of height that maximises the cheapest metre of known steps (concave search).

    Metres of about the same grade count as the cheapest at either end of their bin, so that no step is overestimated.
    """
    low, high = _bin_by_grade(steps, 0.0, 0.0, np.empty(0))
    if not high - low >= _FLAT:
        return 0.0
    edges, cheapest = np.linspace(low, high, _BINS + 1), np.full(_BINS, np.inf)
    _bin_by_grade(steps, low, high, cheapest)
    used = np.isfinite(cheapest)
    grades, costs = np.concatenate([edges[:-1][used], edges[1:][used]]), np.tile(cheapest[used], 2)
    low, high = -_STEEPEST_PER_M, _STEEPEST_PER_M
    while high - low > _PRECISION:
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        low, high = (a, high) if (costs - a * grades).min() < (costs - b * grades).min() else (low, b)
    return 0.5 * (low + high)


@compile_kernel
def _fill_costs(steps: GridSteps, k: float, goal: int, out: Floats) -> int:
    """Write the least cost from each cell to the goal to ``out``, (cells,), infinite before; return the free steps."""
    rows, cols, courses = steps.per_metre.shape
    negative = 0
    out[goal] = 0.0
    heap = [(0.0, goal)]
    while heap:
        cost, here = heappop(heap)
        if cost > out[here]:
            continue
        row, col = here // cols, here % cols
        for course in range(courses):
            row1, col1 = row + steps.crossed[course, 3, 0], col - steps.crossed[course, 3, 1]
            if row1 < 0 or row1 >= rows or col1 < 0 or col1 >= cols:
                continue
            step = compute_step(steps, k, course, row1, col1)
            negative += step < 0.0
            new_cost = cost + max(step, _LEAST)
            if new_cost < out[row1 * cols + col1]:
                out[row1 * cols + col1] = new_cost
                heappush(heap, (new_cost, row1 * cols + col1))
    return negative


_CLASSES = 256
_ALL = "all"


@dataclass(frozen=True, slots=True)
class Turning:
    """Energy of a turn by class id [J/rad], shape (256,), and the mean turn of the training segments [rad/m]."""

    joule_per_rad: Floats
    usual_radpm: float

    def energy_joule(self, turn_rad: Floats, length_m: Floats, class_id: Bytes, *, is_driven: bool = False) -> Floats:
        """Return the cost of turns beyond the usual [J], shape (N,), of N path segments by length and class.

        A driven segment may turn less than usual and cost less; a drawn one turns at least as usual, since no robot
        drives exactly straight.
        """
        beyond_rad = np.abs(turn_rad) - self.usual_radpm * length_m
        return self.joule_per_rad[class_id] * (beyond_rad if is_driven else np.maximum(beyond_rad, 0.0))


def find_turning(fit: PhysicsFit | None, classes: ClassTable) -> Turning | None:
    """Return the cost of turns from a fit; None if the fit has no such term; classes without a term get the mean."""
    turn_energies = {} if fit is None else {term.terrain: term.value for term in fit.terms if term.term == "turning"}
    if fit is None or not turn_energies:
        return None
    joule_per_rad = np.full(_CLASSES, turn_energies.get(_ALL, float(np.mean(list(turn_energies.values())))))
    for class_id, name in enumerate(classes.names().tolist()):
        joule_per_rad[class_id] = turn_energies.get(name, joule_per_rad[class_id])
    return Turning(joule_per_rad, fit.mean_turn_radpm)


def compute_course_changes(start_xy_m: Floats, end_xy_m: Floats) -> Floats:
    """Return the turn of N path segments [rad], shape (N,): half of the course change at both ends, shape (N, 2).

    It compares the courses of chords, so that jitter of the drawn points is no turn.
    """
    east, north = (end_xy_m - start_xy_m).T
    change = np.abs(wrap_to_pi(np.diff(np.arctan2(north, east))))
    return np.asarray(0.5 * (np.append(change, 0.0) + np.insert(change, 0, 0.0)))


_TURNS_RAD = np.radians(np.diff(np.append(ANGLES_DEG, 360.0)))  # from each course to the next [rad], shape (16,)

_STEP, _LEFT, _RIGHT, _START = 1, 2, 3, 4  # ways by which the search reaches a state; 0: not reached


@compile_kernel
def _find_turning(  # noqa: PLR0917
    steps: GridSteps, k: float, joule_per_rad: Floats, class_id: Classes, turns_rad: Floats,
    to_goal: Floats, start: int, goal: int, labels: Floats, arrived: NDArray[np.int8],
) -> int:  # fmt: skip
    """Find the least cost with turns by A*; return the last state, a cell times 16 plus a course, or -1.

    ``labels`` and ``arrived``, (16 · cells,): cost of each reached state, and its predecessor; both are zeros before:
    unwritten pages take no memory.
    """
    cols, courses = steps.per_metre.shape[1:]
    heap = [(to_goal[start], start * courses + course) for course in range(courses)]
    for _, state in heap:
        labels[state], arrived[state] = 0.0, _START
    while heap:
        key, state = heappop(heap)
        cell, course = state // courses, state % courses
        cost = labels[state]
        if key > cost + to_goal[cell]:
            continue
        if cell == goal:
            return int(state)
        per_rad = joule_per_rad[class_id[cell]]
        for way in (_STEP, _LEFT, _RIGHT):
            if way == _STEP:
                step = compute_step(steps, k, course, cell // cols, cell % cols)
                if step == np.inf:
                    continue
                into = cell - steps.crossed[course, 3, 0] * cols + steps.crossed[course, 3, 1]
                other = into * courses + course
            else:
                step = per_rad * (turns_rad[course] if way == _LEFT else turns_rad[course - 1])
                into, other = cell, cell * courses + (course + (1 if way == _LEFT else -1)) % courses
            new_cost = cost + max(step, _LEAST)
            if arrived[other] == 0 or new_cost < labels[other]:
                labels[other], arrived[other] = new_cost, way
                heappush(heap, (new_cost + to_goal[into], other))
    return -1


def find_least_cost_paths(  # noqa: PLR0917
    steps: GridSteps, k: float, start: int, goal: int, turning: Turning | None = None, class_id: Classes | None = None
) -> tuple[LeastCostPath, ...]:
    """Return the least-cost path from a cell to another (flat indices); an empty tuple without one.

    ``k``: the potential. With the cost of turns, and the class of each cell, shape (rows, cols), the path of least
    energy with turns is the first.
    """
    to_goal = np.full(steps.height_m.size, np.inf)
    negative = _fill_costs(steps, k, goal, to_goal)
    if not np.isfinite(to_goal[start]):
        return ()
    of_turns = [np.zeros(_CLASSES)] if turning is None else [turning.joule_per_rad, np.zeros(_CLASSES)]
    classes = np.zeros(to_goal.size, np.uint8) if class_id is None else class_id.reshape(-1)
    paths = []
    for joule_per_rad in of_turns:
        labels, arrived = np.zeros(COURSES * to_goal.size), np.zeros(COURSES * to_goal.size, np.int8)
        last = _find_turning(steps, k, joule_per_rad, classes, _TURNS_RAD, to_goal, start, goal, labels, arrived)
        cells, raw, reduced = _trace_back(last, arrived, steps, k)
        paths.append(LeastCostPath(cells, float(labels[last]) - reduced + raw, negative))
    return tuple(paths)


def _trace_back(state: int, arrived: NDArray[np.int8], steps: GridSteps, k: float) -> tuple[Ints, float, float]:
    """Return the cells of the path to a state of the search with turns, and its cost with and without the grade."""
    cells, raw, reduced = [state // COURSES], 0.0, 0.0
    while (way := int(arrived[state])) != _START:
        cell, course = divmod(state, COURSES)
        if way == _STEP:
            row, col = np.divmod(cell, steps.shape[1]) + steps.crossed[course, 3] * (1, -1)
            cells.append(int(row * steps.shape[1] + col))
            raw += compute_step(steps, 0.0, course, row, col)
            reduced += max(compute_step(steps, k, course, row, col), _LEAST)
            state = cells[-1] * COURSES + course
        else:
            state = cell * COURSES + (course + (-1 if way == _LEFT else 1)) % COURSES
    return np.array(cells[::-1]), raw, reduced


SAMPLES_A_CELL = 4


@compile_kernel
def find_best_lines(  # noqa: PLR0917
    steps: GridSteps, angles: Floats, metres: Floats, points: Floats, window: int, so_far: Floats, before: Ints
) -> None:
    """Write the cost to each point of a path, and the start of its last line, to ``so_far`` and ``before``, (P,).

    ``angles``, (16,): courses [rad], counter-clockwise from the grid's east, rising from 0; ``metres``, (16,): ground
    metres of a cell's side along each. ``points`` [cells]: as in `straighten_path`. A line begins at most ``window``
    points earlier; a line between neighbours is a step of the path and always allowed.
    """
    so_far[0], before[0] = 0.0, 0
    for j in range(1, points.shape[0]):
        so_far[j] = np.inf
        for i in range(max(j - window, 0), j):
            cost = so_far[i] + _compute_line_cost(steps.per_metre, angles, metres, points[i], points[j], i == j - 1)
            if cost < so_far[j] - 1e-9 * abs(so_far[j]) or (so_far[j] == np.inf and cost < np.inf):
                so_far[j], before[j] = cost, i


@compile_kernel
def _compute_line_cost(  # noqa: PLR0917
    per_metre: Floats32,
    angles: Floats,
    metres: Floats,
    begin: Floats,
    end: Floats,
    is_step: bool,  # noqa: FBT001
) -> float:
    """Return the cost of a straight line, interpolated between the two nearest courses; infinite if it is closed."""
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
    total, known = 0.0, 0
    for k in range(count):
        t = (k + 0.5) / count
        col = int(np.floor(begin[0] + t * east + 0.5))
        row = int(np.floor(begin[1] - t * north + 0.5))
        a, b = per_metre[row, col, low], per_metre[row, col, high]
        if not is_step and ((share < 0.999 and a == np.inf) or (share > 0.001 and b == np.inf)):
            return np.inf
        if not np.isfinite(a):
            a = b
        if not np.isfinite(b):
            b = a
        if np.isfinite(a):  # an end that is not in the middle of its cell may touch a cell that the step does not
            total += (1.0 - share) * a + share * b
            known += 1
    if not known:
        return np.inf
    scale = (1.0 - share) * metres[low] + share * metres[high]
    return float(total / known * length * scale)


_MOST_SAMPLES = 3e7
_PASSES = 4


def straighten_path(steps: GridSteps, points_px: Floats) -> Floats:
    """Return the points of the cheapest path of straight lines between points of a path.

    ``points_px`` are the path's points [cells], centres are integers, shape (P, 2).
    """
    angles, metres = np.radians(ANGLES_DEG), steps.length_m / np.hypot(*MOVES.T)
    points = np.clip(points_px, -0.5, np.array(steps.shape[::-1]) - 0.5 - 1e-9)
    for _ in range(_PASSES):
        so_far, before = np.empty(len(points)), np.zeros(len(points), np.int64)
        each = max(float(np.linalg.norm(np.diff(points, axis=0), axis=1).mean()), 1.0) * SAMPLES_A_CELL / 2.0
        window = int(np.clip(np.sqrt(_MOST_SAMPLES / (len(points) * each)), 2, len(points)))  # it bounds the work
        find_best_lines(steps, angles, metres, points, window, so_far, before)
        kept = [len(points) - 1]
        while kept[-1]:
            kept.append(int(before[kept[-1]]))
        unchanged = len(kept) == len(points)
        points = points[kept[::-1]]
        if unchanged:
            break
    return points
