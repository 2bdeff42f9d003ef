"""What the turns of a path cost, by the physics of its robot: so many joules a radian, on the ground where it turns.

A model of patches knows of turning only what its segments did: they were steady and nearly straight. Of a path that turns more than a metre
of them, what is beyond costs ``M |turn|``: the torque of a skid-steered robot hardly depends on how fast it turns
(ADR-13). Nothing is said of the time that a turn takes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from tcpipe.geometry.angles import wrap_to_pi
from tcpipe.planning.courses import ANGLES_DEG, COURSES, MOVES
from tcpipe.planning.search import LeastCostPath, Steps, find_best_potential
from tcpipe.tables.facts import PhysicsFit
from tcpipe.terrain.classes import ClassTable

Floats = NDArray[np.float64]

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
    """Return what turning costs by a fit; a class that it does not name costs the mean of those that it does. None without such a term."""
    found = {} if fit is None else {of.terrain: of.value for of in fit.terms if of.term == "turning"}
    if fit is None or not found:
        return None
    joule_per_rad = np.full(_CLASSES, found.get(_ALL, float(np.mean(list(found.values())))))
    for class_id, name in enumerate(classes.names().tolist()):
        joule_per_rad[class_id] = found.get(name, joule_per_rad[class_id])
    return Turning(joule_per_rad, fit.mean_turn_radpm)


def compute_turns(start_xy_m: Floats, end_xy_m: Floats) -> Floats:
    """Return how far each of N pieces of a path turns [rad], shape (N,): half of the change of course at either of its ends.

    The chords' courses are compared, not those of the drawn line, so that the jitter of its points is no turn.

    Parameters
    ----------
    start_xy_m, end_xy_m : of the pieces, in order, shape (N, 2).
    """
    east, north = (end_xy_m - start_xy_m).T
    change = np.abs(wrap_to_pi(np.diff(np.arctan2(north, east))))
    return np.asarray(0.5 * (np.append(change, 0.0) + np.insert(change, 0, 0.0)))


Ints = NDArray[np.int64]

_LEAST = 1e-9
"""What costs nothing costs this: a zero is no edge to scipy."""

_TURNS_RAD = np.radians(np.diff(np.append(ANGLES_DEG, 360.0)))
"""From each course to the next [rad], shape (16,)."""


def find_least_turning_path(
    steps: Steps, cols: int, start: int, goal: int, joule_per_rad: Floats
) -> LeastCostPath | None:
    """Return the path of least energy, that of its turns included; None where there is none.

    Parameters
    ----------
    steps : all steps, with a cost each [J].
    cols : columns of the grid.
    start, goal : flat indices of cells.
    joule_per_rad : what a turn costs in each cell, shape (cells,).
    """
    cells, first, end = _number_nodes(steps, start, goal)
    if cells is None:
        return None
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


def _number_nodes(steps: Steps, start: int, goal: int) -> tuple[Ints | None, Ints, Ints]:
    """Return the cells that steps begin or end in, rising, and the place of each step's ends among them; None where an end is not one."""
    cells, place = np.unique(np.concatenate([steps.begin, steps.end]), return_inverse=True)
    first, end = place[: len(steps.begin)], place[len(steps.begin) :]
    return (cells if np.isin([start, goal], cells).all() else None), first, end


def _find_courses(steps: Steps, cols: int) -> Ints:
    """Return the course of each step, shape (M,); rows run south."""
    (row0, col0), (row1, col1) = np.divmod(steps.begin, cols), np.divmod(steps.end, cols)
    table = np.zeros((5, 5), np.int64)
    table[MOVES[:, 0] + 2, MOVES[:, 1] + 2] = np.arange(COURSES)
    return np.asarray(table[col1 - col0 + 2, row0 - row1 + 2])
