"""Least-cost paths, against Bellman-Ford over steps that are found by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from physics_model import PhysicsModel
from planning_worlds import lonlat, plane

from tcpipe.planning.cost_grid import (
    COURSES,
    DIRECTIONS,
    MOVES,
    CostGrid,
    find_crossed_cells,
)
from tcpipe.planning.path_cost import compute_path_cost
from tcpipe.planning.search import (
    Turning,
    find_best_potential,
    find_least_cost_paths,
    find_turning,
    make_steps,
)
from tcpipe.tables.facts import PhysicsFit, PhysicsTerm
from tcpipe.terrain.layers import PAPER_CLASSES
from tcpipe.terrain.target_grid import MapGrid


@pytest.mark.parametrize("course", range(COURSES))
def test_shares_are_the_lengths_of_the_step_in_each_cell(course):
    """Against a walk along the step in small strides."""
    at = (np.arange(40_000) + 0.5)[:, None] / 40_000 * MOVES[course]
    cells, counts = np.unique(np.floor(at + 0.5).astype(int), axis=0, return_counts=True)
    walked = {tuple(cell): count / 40_000 for cell, count in zip(cells.tolist(), counts.tolist(), strict=True)}
    found = {(touch.east, touch.north): touch.share for touch in find_crossed_cells(course)}
    assert {cell: share for cell, share in found.items() if share} == pytest.approx(walked, abs=1e-3)


METRES = np.ones(COURSES)


def _grid(power, velocity, height):
    rows, cols = height.shape
    shape = (COURSES, rows, cols)
    grid = MapGrid("EPSG:32633", 0.0, float(rows), 1.0, rows, cols)
    return CostGrid(
        grid,
        np.broadcast_to(power, shape).astype(np.float32),
        np.broadcast_to(velocity, shape).astype(np.float32),
        np.zeros(shape, np.uint16),
        height.astype(np.float32),
    )


def _steps(costs, objective, open_):
    return make_steps(costs, costs.per_metre(objective), open_, METRES)


def _list_steps(costs, objective, open_):
    """Return begin, end, course and cost of every step, written out."""
    rows, cols = costs.grid.rows, costs.grid.cols
    per_metre, edges = costs.per_metre(objective).astype(float), []
    for course in range(COURSES):
        east, north = MOVES[course].tolist()
        for row in range(rows):
            for col in range(cols):
                cells = [(row - t.north, col + t.east, t.share) for t in find_crossed_cells(course)]
                if all(0 <= r < rows and 0 <= c < cols and open_[course, r, c] for r, c, _ in cells):
                    cost = np.hypot(east, north) * sum(s * per_metre[course, r, c] for r, c, s in cells if s)
                    edges.append((row * cols + col, (row - north) * cols + col + east, course, cost))
    return edges


def _bellman_ford(edges, count, starts):
    """Return the least cost of each of ``count`` states; ``edges`` are begin, end and cost."""
    begin, end, cost = (np.array(column) for column in zip(*edges, strict=True))
    best = np.full(count, np.inf)
    best[starts] = 0.0
    for _ in range(count):
        before = best.copy()
        np.minimum.at(best, end, best[begin] + cost)
        if np.array_equal(before, best):
            break
    return best


def _by_hand(costs, objective, open_, start):
    edges = _list_steps(costs, objective, open_)
    return _bellman_ford([(0, 0, 0.0), *((a, b, cost) for a, b, _, cost in edges)], open_[0].size, [start])


RANDOM_POWER = arrays.arrays(float, (COURSES, 5, 6), elements=st.floats(20.0, 300.0))
SOME_FREE = arrays.arrays(bool, (5, 6), elements=st.sampled_from([True, True, True, False]))


@settings(max_examples=25)
@given(RANDOM_POWER, SOME_FREE)
def test_paths_are_as_cheap_as_can_be_round_any_obstacles(power, free):
    costs = _grid(power, 0.8, np.zeros((5, 6)))
    open_ = np.broadcast_to(free, (COURSES, 5, 6))
    paths = find_least_cost_paths(_steps(costs, "energy", open_), 0.0, 0, 29)
    best = _by_hand(costs, "energy", open_, 0)[29]
    if not paths:
        assert np.isinf(best)
    else:
        assert paths[0].cost == pytest.approx(best, rel=1e-9)
        assert free.reshape(-1)[paths[0].cells].all()


@settings(max_examples=25)
@given(
    RANDOM_POWER, SOME_FREE, arrays.arrays(np.uint8, (5, 6), elements=st.integers(4, 6)), st.sampled_from([0, 9, 400])
)
def test_paths_with_turns_are_as_cheap_as_those_of_a_full_search_of_cells_and_courses(power, free, class_id, dear):
    joule_per_rad = np.zeros(256)
    joule_per_rad[4:7] = dear * np.array([1.0, 0.5, 2.0])
    costs, open_ = _grid(power, 0.8, np.zeros((5, 6))), np.broadcast_to(free, (COURSES, 5, 6))
    angle = np.arctan2(MOVES[:, 1], MOVES[:, 0])
    edges = [(a * 16 + course, b * 16 + course, cost) for a, b, course, cost in _list_steps(costs, "energy", open_)]
    for cell in range(30):
        for course in range(COURSES):
            for other in ((course + 1) % COURSES, (course - 1) % COURSES):
                turn = np.abs(np.angle(np.exp(1j * (angle[other] - angle[course]))))
                edges.append((cell * 16 + course, cell * 16 + other, turn * joule_per_rad[class_id.flat[cell]]))
    best = _bellman_ford(edges, 480, np.arange(16))[29 * 16 :].min()
    paths = find_least_cost_paths(_steps(costs, "energy", open_), 0.0, 0, 29, Turning(joule_per_rad, 0.0), class_id)
    if not paths:
        assert np.isinf(best)
    else:
        assert paths[0].cost == pytest.approx(best, rel=1e-9, abs=1e-6)
        assert paths[1].cost <= paths[0].cost + 1e-6
        turned = np.abs(np.diff(np.unwrap([angle[course] for course in _find_courses(paths[0].cells, 6)])))
        driven = _sum_edges(paths[0].cells, _list_steps(costs, "energy", open_))
        where = joule_per_rad[class_id.flat[paths[0].cells[1:-1]]]
        assert paths[0].cost == pytest.approx(driven + (turned * where).sum(), rel=1e-9, abs=1e-6)


def _find_courses(cells, cols):
    row, col = np.divmod(cells, cols)
    moves = {tuple(move): course for course, move in enumerate(MOVES.tolist())}
    return [moves[east, -south] for east, south in zip(np.diff(col).tolist(), np.diff(row).tolist(), strict=True)]


def _sum_edges(cells, edges):
    cost = {(a, b): cost for a, b, _, cost in edges}
    return sum(cost[a, b] for a, b in zip(cells[:-1].tolist(), cells[1:].tolist(), strict=True))


def test_downhill_energy_that_comes_back_does_not_mislead_the_search():
    """Friction and the whole grade, which downhill is less than nothing: the potential takes it out, and the best path is found."""
    rng = np.random.default_rng(3)
    row, col = np.mgrid[:7, :8]
    friction, open_ = rng.uniform(20.0, 60.0, (7, 8)), np.ones((COURSES, 7, 8), bool)
    grade = DIRECTIONS @ [0.1, -0.15]
    costs = _grid(friction + 600.0 * grade[:, None, None], 1.0, 0.1 * col + 0.15 * row)
    assert costs.power_watt.min() < 0.0
    steps = _steps(costs, "energy", open_)
    k = find_best_potential(steps)
    found = find_least_cost_paths(steps, k, 0, 55)[0]
    assert found.cost == pytest.approx(_by_hand(costs, "energy", open_, 0)[55], rel=1e-9)
    assert found.negative_steps == 0
    assert k == pytest.approx(600.0, rel=0.1)


USUAL_RADPM = 0.05


def physics(**joule_per_rad):
    terms = tuple(PhysicsTerm("turning", name, value, 5.0, "W s/rad") for name, value in joule_per_rad.items())
    return PhysicsFit(500, terms, {}, 0.4, 8.0, {}, None, USUAL_RADPM)


def cost(source, *points, fit=None):
    return compute_path_cost(replace(PhysicsModel(), physics=fit), source, lonlat(source, *points), where="path")


CORNER = (4.0, 4.0), (14.0, 4.0), (14.0, 14.0)


def test_a_corner_costs_its_angle_on_the_ground_where_it_is():
    source = plane(classes=lambda east, _: np.where(east < 9.0, 4, 7))
    without, with_turns = (
        cost(source, *CORNER),
        cost(source, *CORNER, fit=physics(**{"grass": 264.0, "paved road": 180.0})),
    )
    assert with_turns.totals.turn_rad == pytest.approx(np.pi / 2, abs=1e-3)
    more = with_turns.totals.energy_joule - without.totals.energy_joule
    assert more == pytest.approx(with_turns.totals.turn_energy_joule)
    # On paved ground; the path segments beside the corner would have turned their usual 5 cm a metre anyway.
    assert 180.0 * (np.pi / 2 - 4 * USUAL_RADPM) < more < 180.0 * (np.pi / 2 - USUAL_RADPM)
    table = with_turns.path_segments
    assert table["turn_energy_joule"].to_numpy().sum() == pytest.approx(more)
    assert with_turns.totals.duration_s == without.totals.duration_s


def test_without_physics_nothing_is_said_of_turns():
    found = cost(plane(), *CORNER)
    assert found.totals.turn_energy_joule is None
    assert found.path_segments["turn_energy_joule"].null_count == found.path_segments.num_rows
    assert find_turning(None, PAPER_CLASSES) is None
    assert find_turning(physics(), PAPER_CLASSES) is None
