"""Time, peak memory and cost of a plan of least energy with turns, as ratios to a full search of an explicit graph.

    python benchmarks/plan_path.py [CELLS] [PAIRS]

A made site of CELLS x CELLS cells of 1 m (default 300; 1000 takes minutes and 5 GB for the explicit graph): waves of
height, four classes, obstacles. The costs of all cells are known, as from a cost map. The explicit graph has a node for
each cell and course; scipy's Dijkstra searches it. Each of the two runs in its own process, so that its peak memory is
its own; the memory of the site is subtracted from both (what is left is at least 0.1 MB). Costs are compared for PAIRS
of ends (default 3). The last line compares the energy of the three plans of each pair, as `tcpipe predict-path` judges
it.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from map_worlds import ArrayMap, make_waves
from physics_model import PhysicsModel, power_watt, velocity_mps
from planning_worlds import lonlat

from tcpipe.planning.cost_grid import (
    ANGLES_DEG,
    COURSES,
    DIRECTIONS,
    MOVES,
    CostGrid,
    LazyCostGrid,
    find_crossed_cells,
    make_grid,
    make_survey,
)
from tcpipe.planning.plan import OBJECTIVES, plan_path
from tcpipe.planning.search import find_best_potential, find_least_cost_paths, find_turning, make_steps
from tcpipe.tables.facts import PhysicsFit, PhysicsTerm
from tcpipe.terrain.target_grid import MapGrid

JOULE_PER_RAD = 264.0
TURNING = PhysicsTerm("turning", "all", JOULE_PER_RAD, 5.0, "W s/rad")
FIT = PhysicsFit(500, (TURNING,), {}, 0.4, 8.0, {}, None, 0.05)
RANGES = {"slope_rad": (-1.5, 1.5), "cross_slope_rad": (-1.5, 1.5), "relief_m": (0.0, 9.0)}
MODEL = replace(PhysicsModel(), physics=FIT, training_range=RANGES)


def make_site(cells: int) -> tuple[LazyCostGrid, NDArray[np.uint8]]:
    """Return a site whose costs are known, and the class of each cell."""
    height, terrain = make_waves((np.arange(2 * cells) + 0.5) * 0.5, (cells / 2, cells / 5, cells / 15), 0.02)
    class_id = terrain[::2, ::2].copy()
    terrain = class_id.repeat(2, axis=0).repeat(2, axis=1)
    layers = {"height": height.astype(np.float32), "ortho": np.full(height.shape, 128, np.uint8), "terrain": terrain}
    grid = MapGrid("EPSG:32633", 500_000.0, 5_200_000.0, 0.5, 2 * cells, 2 * cells)
    source = ArrayMap(grid, layers, 512)
    middle = height.reshape(cells, 2, cells, 2).mean(axis=(1, 3))
    down, right = np.gradient(middle)
    shape = (COURSES, cells, cells)
    power, velocity = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for course, (e, n) in enumerate(DIRECTIONS):
        power[course] = np.where(class_id == 2, np.nan, power_watt(class_id, e * right - n * down))
        velocity[course] = np.where(class_id == 2, np.nan, velocity_mps(class_id, e * right - n * down))
    reasons = np.broadcast_to(np.where(class_id == 2, 4, 0).astype(np.uint16), shape).copy()
    costs = CostGrid(make_grid(source, 1.0), power, velocity, reasons, middle.astype(np.float32))
    return make_survey(MODEL, source, costs), class_id


def choose_ends(class_id: NDArray[np.uint8], pair: int) -> list[int]:
    """Return flat indices of two free cells, far apart."""
    rng, cells = np.random.default_rng(pair), len(class_id)
    free = np.argwhere(class_id != 2)
    wanted = np.array(
        [[rng.uniform(0.7, 0.95), rng.uniform(0.05, 0.95)], [rng.uniform(0.05, 0.3), rng.uniform(0.05, 0.95)]]
    )
    near = [free[np.abs(free - cells * at).sum(axis=1).argmin()] for at in wanted]
    return [int(row * cells + col) for row, col in near]


def search_explicitly(survey: LazyCostGrid, class_id: NDArray[np.uint8], ends: list[int]) -> float:
    """Return the least energy with turns, by scipy on a graph of all cells and courses."""
    rows, cols = class_id.shape
    per_metre, parts = survey.costs.per_metre("energy").astype(np.float64), []
    height, metres = survey.costs.height_m.astype(np.float64).reshape(-1), survey.frames.metres(np.array(ends))
    k = find_best_potential(
        make_steps(survey.costs, survey.costs.per_metre("energy"), survey.costs.reasons == 0, metres)
    )
    for course, (east, north) in enumerate(MOVES.tolist()):
        row, col = (
            of.reshape(-1) for of in np.mgrid[max(north, 0) : rows + min(north, 0), max(-east, 0) : cols - max(east, 0)]
        )
        mean, can = np.zeros(row.size), np.ones(row.size, bool)
        for cell in find_crossed_cells(course):
            cost = per_metre[course, row - cell.north, col + cell.east]
            can &= np.isfinite(cost)
            mean += cell.share * np.nan_to_num(cost)
        begin = (row * cols + col)[can]
        end = begin - north * cols + east
        cost = mean[can] * np.hypot(east, north) * metres[course] - k * (height[end] - height[begin])
        parts.append((begin * COURSES + course, end * COURSES + course, np.maximum(cost, 1e-9)))
    state = np.arange(rows * cols * COURSES)
    following = state - state % COURSES + (state + 1) % COURSES
    turn = np.tile(np.radians(np.diff(np.append(ANGLES_DEG, 360.0))), rows * cols) * JOULE_PER_RAD
    begin, end, cost = (
        np.concatenate(of) for of in zip(*parts, (state, following, turn), (following, state, turn), strict=True)
    )
    graph = csr_array((cost, (begin, end)), shape=(state.size, state.size))
    best = dijkstra(graph, indices=ends[0] * COURSES + np.arange(COURSES), min_only=True)
    return float(best[ends[1] * COURSES :][:COURSES].min())


def search(survey: LazyCostGrid, class_id: NDArray[np.uint8], ends: list[int]) -> float:
    """Return the least energy with turns, by the planner's search."""
    steps = make_steps(
        survey.costs, survey.costs.per_metre("energy"), survey.costs.reasons == 0, survey.frames.metres(np.array(ends))
    )
    turning = find_turning(FIT, survey.source.classes)
    k = find_best_potential(steps)
    paths = find_least_cost_paths(steps, k, *ends, turning, class_id)
    return paths[0].cost - k * float(np.subtract(*steps.height_m.flat[ends[::-1]])) if paths else np.inf


def measure(kind: str, cells: int, pairs: int) -> tuple[list[float], float, float]:
    """Return the least costs, and CPU seconds and peak memory [MB] of the last, without the site."""
    survey, class_id = make_site(cells)
    run = {"explicit": search_explicitly, "implicit": search}[kind]
    small = make_site(60)
    run(*small, choose_ends(small[1], 0))  # compiles
    before, costs, begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, [], 0.0
    for pair in range(pairs):
        begun = time.process_time()
        costs.append(run(survey, class_id, choose_ends(class_id, pair)))
    spent = time.process_time() - begun
    return costs, spent, max(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, 100) / 1e3


def plan(cells: int, pairs: int) -> tuple[list[dict[str, float]], tuple[float, float], float]:
    """Return the judged energy of each plan by objective; wall and CPU seconds of a plan of least energy, and peak memory [MB] in all."""
    survey, class_id = make_site(cells)
    judged, spent = [], (0.0, 0.0)
    for pair in range(pairs):
        ends = [(end % cells + 0.5, cells - end // cells - 0.5) for end in choose_ends(class_id, pair)]
        begun = time.perf_counter(), time.process_time()
        plans = {"energy": plan_path(survey, *lonlat(survey.source, *ends), "energy")}
        spent = time.perf_counter() - begun[0], time.process_time() - begun[1]
        plans |= {name: plan_path(survey, *lonlat(survey.source, *ends), name) for name in OBJECTIVES[1:]}
        judged.append({name: of.totals.energy_joule for name, of in plans.items()})
    return judged, spent, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def run_alone(function: Callable[..., Any], *arguments: object) -> Any:
    """Return what a function returns, in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def main() -> None:
    cells = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    pairs = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    found = {kind: run_alone(measure, kind, cells, pairs) for kind in ("explicit", "implicit")}
    judged, (wall_s, plan_s), plan_mb = run_alone(plan, cells, pairs)
    (costs, spent, peak), (theirs, their_s, their_mb) = found["implicit"], found["explicit"]
    off = max(0.0 if a == b else abs(a / b - 1.0) for a, b in zip(costs, theirs, strict=True))
    print(f"{cells} x {cells} cells, {pairs} pairs")
    print(f"cost of the search: at most {off:.1e} from that of the full search")
    print(f"CPU time: {spent / their_s:.2f} x that of the full search ({spent:.2f} of {their_s:.2f} s)")
    print(
        f"peak memory: {peak / their_mb:.2f} x that of the full search ({peak:.0f} of {their_mb:.0f} MB, without the site)"
    )
    print(
        f"a whole plan of least energy: {wall_s:.2f} s at a load of {os.getloadavg()[0]:.1f}, {plan_s:.2f} s of CPU; "
        f"peak memory of its process {plan_mb:.0f} MB, with the site"
    )
    worst = max(plans["energy"] / min(plans.values()) for plans in judged) - 1.0
    print(f"plans of least energy take at most {worst:.1%} more energy than those of least time and distance")


if __name__ == "__main__":
    main()
