"""Turns of a path: what they cost beyond the usual, and plans that turn less for it."""

from dataclasses import replace

import numpy as np
import pytest
from physics_model import PhysicsModel
from planning_worlds import lonlat, plane

from tcpipe.planning.cost_grid import make_survey
from tcpipe.planning.path_cost import compute_path_cost
from tcpipe.planning.plan import plan_path
from tcpipe.planning.search import Steps, compute_turns, find_least_cost_path, find_least_turning_path, find_turning
from tcpipe.tables.facts import PhysicsFit, PhysicsTerm
from tcpipe.terrain.classes import PAPER_CLASSES

USUAL_RADPM = 0.05


def physics(**joule_per_rad):
    terms = tuple(PhysicsTerm("turning", name, value, 5.0, "W s/rad") for name, value in joule_per_rad.items())
    return PhysicsFit(500, terms, {}, 0.4, 8.0, {}, None, None, USUAL_RADPM, None)


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
    # On paved ground; the pieces beside the corner would have turned their usual 5 cm a metre anyway.
    assert 180.0 * (np.pi / 2 - 4 * USUAL_RADPM) < more < 180.0 * (np.pi / 2 - USUAL_RADPM)
    table = with_turns.pieces
    assert table["turn_energy_joule"].to_numpy().sum() == pytest.approx(more)
    assert with_turns.totals.duration_s == without.totals.duration_s


def test_a_straight_path_and_one_of_jitter_cost_nothing_more():
    source, fit = plane(), physics(all=264.0)
    assert cost(source, (3.0, 3.0), (20.0, 15.0), fit=fit).totals.turn_energy_joule == 0.0
    x = np.linspace(3.0, 20.0, 171)
    jitter = np.column_stack([x, 8.0 + 0.004 * np.random.default_rng(0).standard_normal(171)])
    assert cost(source, *jitter, fit=fit).totals.turn_energy_joule < 1.0


def test_without_physics_nothing_is_said_of_turns():
    found = cost(plane(), *CORNER)
    assert found.totals.turn_energy_joule is None
    assert found.pieces["turn_energy_joule"].null_count == found.pieces.num_rows
    assert find_turning(None, PAPER_CLASSES) is None
    assert find_turning(physics(), PAPER_CLASSES) is None


def test_a_circle_turns_once_round_however_fine_it_is_cut():
    for count in (24, 200):
        angle = np.linspace(0.0, 2.0 * np.pi, count + 1)
        points = np.column_stack([np.cos(angle), np.sin(angle)])
        turned = compute_turns(points[:-1], points[1:]).sum()
        assert turned == pytest.approx(2.0 * np.pi * (1.0 - 1.0 / count))


def steps_on_open_ground(size, cost_per_cell=1.0):
    """Every step of 16 courses on a square grid without slopes."""
    from tcpipe.planning.cost_grid import MOVES

    rows, cols = np.mgrid[:size, :size]
    parts = []
    for east, north in MOVES.tolist():
        row, col = rows - north, cols + east
        inside = (row >= 0) & (row < size) & (col >= 0) & (col < size)
        begin, end = (rows * size + cols)[inside], (row * size + col)[inside]
        parts.append((begin, end, np.full(begin.size, cost_per_cell * np.hypot(east, north))))
    begin, end, costs = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Steps(begin, end, costs, costs / cost_per_cell, np.zeros(len(costs)))


def test_free_turns_are_the_search_without_them():
    steps = steps_on_open_ground(12)
    plain = find_least_cost_path(steps, 144, 0, 12 * 9 + 7)
    turning = find_least_turning_path(steps, 12, 0, 12 * 9 + 7, np.zeros(144))
    assert turning.cost == pytest.approx(plain.cost, abs=1e-6)


def test_turns_add_up_along_the_path():
    """From corner to corner of a wall's end: by hand, the straight way is shut, and every way round turns."""
    size = 9
    steps = steps_on_open_ground(size)
    wall = (
        {row * size + 4 for row in range(6)}
        | {row * size + 3 for row in range(6)}
        | {row * size + 5 for row in range(6)}
    )
    open_ = np.array([b not in wall and e not in wall for b, e in zip(steps.begin, steps.end, strict=True)])
    steps = Steps(*(getattr(steps, name)[open_] for name in Steps.__slots__))
    start, goal = 0, size - 1
    cheap = find_least_turning_path(steps, size, start, goal, np.full(size * size, 0.01))
    dear = find_least_turning_path(steps, size, start, goal, np.full(size * size, 50.0))

    def turned(found):
        row, col = np.divmod(found.cells, size)
        course = np.unwrap(np.arctan2(-np.diff(row), np.diff(col)))
        return np.abs(np.diff(course)).sum()

    assert turned(dear) <= turned(cheap) + 1e-9
    length = np.hypot(*np.array([np.diff(of) for of in np.divmod(dear.cells, size)])).sum()
    assert dear.cost == pytest.approx(length + 50.0 * turned(dear), rel=1e-6)


def slalom(east, north):
    """Cheap grass in a zigzag through paved ground that costs more."""
    return np.where(np.abs(north - 12.0 - 5.0 * np.sign(np.sin(east * 0.7)) * 0.5) < 2.0, 4, 5)


def test_a_plan_that_pays_for_turns_turns_less():
    source = plane(30.0, classes=slalom)
    found = {}
    for name, fit in (("free", None), ("dear", physics(all=2000.0))):
        model = replace(PhysicsModel(), physics=fit)
        ends = lonlat(source, (2.0, 12.0), (28.0, 12.0))
        found[name] = plan_path(make_survey(model, source, 1.0), ends[0], ends[1], "energy")
    assert found["dear"].totals.turn_rad <= found["free"].totals.turn_rad
    # Judged alike, turns included, the plan that knew of them is no dearer.
    lines = {name: plan.lonlat_deg for name, plan in found.items()}
    judge = replace(PhysicsModel(), physics=physics(all=2000.0))
    paid = {
        name: compute_path_cost(judge, source, line, where="plan").totals.energy_joule for name, line in lines.items()
    }
    assert paid["dear"] <= paid["free"] * 1.001
