"""Least-cost paths, against Bellman-Ford over steps that are found by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tcpipe.planning.cost_grid import COURSES, MOVES, CostGrid, find_crossed_cells
from tcpipe.planning.plan import find_possible_gain, probe_cells
from tcpipe.planning.search import compute_least_costs, find_best_potential, find_least_cost_path, make_steps
from tcpipe.terrain.grid import MapGrid

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


def _by_hand(costs, objective, open_, start):
    """Bellman-Ford with every step written out."""
    rows, cols = costs.grid.rows, costs.grid.cols
    per_metre, edges = costs.per_metre(objective).astype(float), []
    for course in range(COURSES):
        east, north = MOVES[course].tolist()
        for row in range(rows):
            for col in range(cols):
                cells = [(row - t.north, col + t.east, t.share) for t in find_crossed_cells(course)]
                if all(0 <= r < rows and 0 <= c < cols and open_[course, r, c] for r, c, _ in cells):
                    cost = np.hypot(east, north) * sum(s * per_metre[course, r, c] for r, c, s in cells if s)
                    edges.append((row * cols + col, (row - north) * cols + col + east, cost))
    best = np.full(rows * cols, np.inf)
    best[start] = 0.0
    for _ in range(rows * cols):
        before = best.copy()
        for a, b, cost in edges:
            best[b] = min(best[b], best[a] + cost)
        if np.array_equal(before, best):
            break
    return best


@settings(max_examples=25)
@given(
    arrays.arrays(float, (COURSES, 5, 6), elements=st.floats(20.0, 300.0)),
    arrays.arrays(bool, (5, 6), elements=st.sampled_from([True, True, True, False])),
)
def test_paths_are_as_cheap_as_can_be_round_any_obstacles(power, free):
    costs = _grid(power, 0.8, np.zeros((5, 6)))
    open_ = np.broadcast_to(free, (COURSES, 5, 6))
    found = find_least_cost_path(make_steps(costs, "energy", open_, METRES), 30, 0, 29)
    best = _by_hand(costs, "energy", open_, 0)[29]
    if found is None:
        assert np.isinf(best)
    else:
        assert found.cost == pytest.approx(best, rel=1e-6)
        assert free.reshape(-1)[found.cells].all()


@settings(max_examples=15)
@given(arrays.arrays(float, (COURSES, 5, 6), elements=st.floats(20.0, 300.0)))
def test_the_least_over_a_cell_is_the_way_there_and_on_from_there(power):
    costs, open_ = _grid(power, 0.8, np.zeros((5, 6))), np.ones((COURSES, 5, 6), bool)
    steps = make_steps(costs, "energy", open_, METRES)
    over = compute_least_costs(steps, steps.cost, 30, 0, 29, limit=np.inf)
    there = _by_hand(costs, "energy", open_, 0)
    for cell in (3, 14, 29):
        assert over[cell] == pytest.approx(there[cell] + _by_hand(costs, "energy", open_, cell)[29], rel=1e-6)
    assert over.min() == pytest.approx(there[29], rel=1e-6)


def test_no_cell_of_a_better_path_is_left_out_and_the_rest_need_not_be_asked_about():
    """Costs vary little within a class: what is known of each bounds the rest, and only a part of the cells could be better."""
    rng, shape = np.random.default_rng(5), (24, 30)
    class_id = np.where(rng.random((6, 5)) < 0.4, 5, 4).astype(np.uint8).repeat(4, axis=0).repeat(6, axis=1)
    power = np.where(class_id == 5, 150.0, 80.0) * rng.uniform(1.0, 1.02, (COURSES, *shape))
    open_, start, goal = np.ones((COURSES, *shape), bool), 10 * 30 + 4, 14 * 30 + 25
    whole = make_steps(_grid(power, 1.0, np.zeros(shape)), "energy", open_, METRES)
    best = find_least_cost_path(whole, class_id.size, start, goal)
    predicted = probe_cells(class_id, open_[0])
    predicted[9:16, 3:27] = True
    steps = make_steps(_grid(np.where(predicted, power, np.nan), 1.0, np.zeros(shape)), "energy", open_, METRES)
    found = find_least_cost_path(
        make_steps(_grid(power, 1.0, np.zeros(shape)), "energy", open_ & predicted, METRES), class_id.size, start, goal
    )
    over, better = find_possible_gain(steps, class_id, found, start, goal)
    assert found.cost > best.cost
    unknown = best.cells[~predicted.reshape(-1)[best.cells]]
    assert unknown.size
    assert better[unknown].all()
    assert over[goal] <= best.cost
    assert np.count_nonzero(better & ~predicted.reshape(-1)) < 0.5 * np.count_nonzero(~predicted)


def test_probes_meet_every_class_that_can_be_driven():
    class_id, open_ = np.full((40, 50), 4, np.uint8), np.ones((40, 50), bool)
    class_id[20], class_id[:5, :5], open_[:5, :5] = 6, 2, False
    probes = probe_cells(class_id, open_)
    assert set(class_id[probes].tolist()) == {4, 6}
    assert probes.sum() <= 2 * 6 * 9


def test_downhill_energy_that_comes_back_does_not_mislead_the_search():
    """Friction and the whole grade, which downhill is less than nothing: the potential takes it out, and the best path is found."""
    rng = np.random.default_rng(3)
    height = np.cumsum(np.cumsum(rng.normal(0.0, 0.06, (7, 8)), axis=0), axis=1)
    friction = rng.uniform(20.0, 60.0, (7, 8))
    steps = make_steps(_grid(1.0, 1.0, height), "distance", np.ones((COURSES, 7, 8), bool), METRES)
    middle = (friction.reshape(-1)[steps.begin] + friction.reshape(-1)[steps.end]) / 2.0
    cost = middle * steps.length_m + 600.0 * steps.rise_m
    assert cost.min() < 0.0
    steps = type(steps)(steps.begin, steps.end, cost, steps.length_m, steps.rise_m)
    found = find_least_cost_path(steps, 56, 0, 55)
    best = np.full(56, np.inf)
    best[0] = 0.0
    for _ in range(56):
        np.minimum.at(best, steps.end, best[steps.begin] + cost)
    assert found.cost == pytest.approx(best[55], rel=1e-9)
    assert found.negative_steps == 0
    assert find_best_potential(steps) == pytest.approx(600.0, rel=0.1)


def test_what_gives_back_more_than_it_was_lifted_for_is_counted():
    steps = make_steps(_grid(-50.0, 1.0, np.zeros((4, 4))), "energy", np.ones((COURSES, 4, 4), bool), METRES)
    found = find_least_cost_path(steps, 16, 0, 15)
    assert found.negative_steps == steps.cost.size
    assert found.cost < 0.0
