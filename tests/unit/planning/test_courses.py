"""The 16 courses and the cells that a step touches."""

import math

import numpy as np
import pytest

from tcpipe.planning.cost_grid import ANGLES_DEG, COURSES, DIRECTIONS, MAX_DETOUR, MOVES, find_crossed_cells


def test_courses_rise_from_east_counter_clockwise_and_lead_to_16_cells():
    assert len({tuple(move) for move in MOVES.tolist()}) == COURSES
    assert (np.diff(ANGLES_DEG) > 18.0).all()
    assert ANGLES_DEG[0] == 0.0
    assert MOVES[4].tolist() == [0, 1]
    assert all(math.gcd(east, north) == 1 for east, north in MOVES.tolist())


@pytest.mark.parametrize("course", range(COURSES))
def test_shares_are_the_lengths_of_the_step_in_each_cell(course):
    """Against a walk along the step in small strides."""
    at = (np.arange(40_000) + 0.5)[:, None] / 40_000 * MOVES[course]
    cells, counts = np.unique(np.floor(at + 0.5).astype(int), axis=0, return_counts=True)
    walked = {tuple(cell): count / 40_000 for cell, count in zip(cells.tolist(), counts.tolist(), strict=True)}
    found = {(touch.east, touch.north): touch.share for touch in find_crossed_cells(course)}
    assert {cell: share for cell, share in found.items() if share} == pytest.approx(walked, abs=1e-3)


def test_a_diagonal_step_touches_the_two_cells_beside_its_corner():
    corners = {(touch.east, touch.north) for touch in find_crossed_cells(2) if not touch.share}
    assert corners == {(1, 0), (0, 1)}


def test_no_direction_is_further_from_the_courses_than_the_bound_says():
    angle = np.radians(np.linspace(0.0, 360.0, 3601))
    wanted = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    best = np.full(angle.size, np.inf)
    for k in range(COURSES):  # a straight metre as steps along two neighbouring courses
        pair = np.stack([DIRECTIONS[k], DIRECTIONS[(k + 1) % COURSES]], axis=1)
        parts = np.linalg.solve(pair, wanted.T)
        inside = (parts >= -1e-12).all(axis=0)
        best[inside] = np.minimum(best[inside], parts.sum(axis=0)[inside])
    assert best.max() == pytest.approx(MAX_DETOUR, abs=1e-5)
    assert MAX_DETOUR < 1.0276
