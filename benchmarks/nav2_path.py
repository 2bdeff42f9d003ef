"""Energy of paths planned on the scalar maps for Nav2, against the path of least energy by the directional costs.

    python benchmarks/nav2_path.py [METRES] [PAIRS]

A made site of METRES x METRES (default 160): waves of height with slopes to about 23 degrees, four classes, obstacles.
`make_cost_map` writes its files; the map, its mask and its parameters are read as Nav2's map_server, its static layer
of main and lyrical, and Smac 2D read them. Between PAIRS of ends (default 30) two paths are planned on the map: that of
Smac 2D, on the eight courses of a grid without its smoother, and the best path of straight lines, which has the
direction-free costs and no error of the grid. `compute_path_cost` predicts the energy of each, without turns, and that
of `plan_path` over the directional costs.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from map_worlds import ArrayMap, make_waves
from physics_model import PhysicsModel

from tcpipe.errors import PathError
from tcpipe.planning.cost_grid import COURSES, CostGrid, make_survey
from tcpipe.planning.cost_map import make_cost_map, open_cost_map
from tcpipe.planning.frames import find_lonlat_projection
from tcpipe.planning.path_cost import compute_path_cost
from tcpipe.planning.plan import plan_path
from tcpipe.planning.search import find_least_cost_paths, make_steps, straighten_path
from tcpipe.terrain.target_grid import MapGrid

Floats = NDArray[np.float64]

PIXEL_M = 0.25
RANGES = {"slope_rad": (-1.5, 1.5), "cross_slope_rad": (-1.5, 1.5), "relief_m": (0.0, 9.0)}
GRADE_NEWTON, RECOVERED = 700.0, 0.2
"""Weight over the drive's efficiency [N], 50 kg at 0.7, and share of negative work that comes back [1]."""


class Robot(PhysicsModel):
    """The model of the tests with the weight of a Husky, which recovers little downhill."""

    def predict(self, patches, extra_features=None):  # type: ignore[no-untyped-def]
        """Return power [W] and velocity [m/s]."""
        power, velocity = super().predict(patches, extra_features).T
        height = patches[..., self.channels.index("height")]
        along = (np.arange(height.shape[1]) + 0.5) / height.shape[1] - 0.5
        slope = (height.mean(axis=1) * along).sum(axis=1) / (along**2).sum()
        work = power - 40.0 + velocity * (GRADE_NEWTON - 300.0) * slope
        return np.stack([40.0 + np.where(work > 0.0, work, RECOVERED * work), velocity], axis=1)


MODEL = replace(Robot(patch_px=8), training_range=RANGES)


def make_site(metres: int) -> ArrayMap:
    """Return a hilly map of four classes with obstacles."""
    count = round(metres / PIXEL_M)
    height, terrain = make_waves((np.arange(count) + 0.5) * PIXEL_M, (metres / 2, metres / 5, metres / 12), 0.08)
    layers = {"height": height.astype(np.float32), "ortho": np.full(height.shape, 128, np.uint8), "terrain": terrain}
    return ArrayMap(MapGrid("EPSG:32633", 500_000.0, 5_200_000.0, PIXEL_M, count, count), layers, 128)


def read_pgm(yaml: Path) -> tuple[NDArray[np.int64], dict[str, object]]:
    """Return the grey values of a map, shape (rows, cols), and its description."""
    about = YAML(typ="safe").load(yaml.read_text())
    data = (yaml.parent / about["image"]).read_bytes()
    magic, size, most, pixels = data.split(b"\n", 3)
    assert (magic, most) == (b"P5", b"255")
    cols, rows = map(int, size.split())
    return np.frombuffer(pixels, np.uint8).reshape(rows, cols).astype(np.int64), about


def read_costs(directory: Path) -> tuple[Floats, NDArray[np.bool_], float]:
    """Return the weight of a metre in each cell by Smac 2D, the cells that can be crossed, and the multiplier of its parameters."""
    grey, about = read_pgm(directory / "energy.yaml")
    shade = (255.0 - grey) / 255.0
    occupancy = np.where(shade > about["occupied_thresh"], 100, np.rint(100.0 * shade / about["occupied_thresh"]))
    cost = np.where(occupancy > 0, np.rint(1 + (occupancy - 1) * 251 / 97), 0)
    mask, about = read_pgm(directory / "keepout.yaml")
    assert about["mode"] == "raw"
    is_free = (occupancy < 99) & (mask < 100)
    parameters = YAML(typ="safe").load((directory / "nav2.yaml").read_text())
    multiplier = parameters["planner_server"]["ros__parameters"]["GridBased"]["cost_travel_multiplier"]
    return np.where(is_free, 1.0 + multiplier * cost / 252.0, np.inf), is_free, multiplier


def search_as_smac(weight: Floats, start: int, goal: int) -> NDArray[np.int64]:
    """Return the cells of the least-cost path over eight courses; a step costs the weight of the cell that it enters."""
    rows, cols = weight.shape
    parts = []
    for north, east in ((0, 1), (1, 0), (1, 1), (1, -1)):
        row, col = np.mgrid[: rows - north, max(-east, 0) : cols - max(east, 0)]
        one, other = (row * cols + col).ravel(), ((row + north) * cols + col + east).ravel()
        parts += [(one, other, np.hypot(north, east)), (other, one, np.hypot(north, east))]
    begin, end, length = (
        np.concatenate(column) for column in zip(*[(a, b, np.full(a.size, d)) for a, b, d in parts], strict=True)
    )
    cost, free = weight.ravel()[end] * length, np.isfinite(weight.ravel()[begin] + weight.ravel()[end])
    graph = csr_array((cost[free], (begin[free], end[free])), shape=(weight.size, weight.size))
    _, before = dijkstra(graph, indices=start, return_predecessors=True)
    cells = [goal]
    while cells[-1] != start:
        cells.append(int(before[cells[-1]]))
    return np.array(cells[::-1])


def main() -> None:
    metres = int(sys.argv[1]) if len(sys.argv) > 1 else 160
    pairs = int(sys.argv[2]) if len(sys.argv) > 2 else 30
    source = make_site(metres)
    with tempfile.TemporaryDirectory() as name:
        card = make_cost_map(MODEL, source, Path(name, "map"), cell_size_m=1.0).card
        directional, (weight, is_free, multiplier) = (
            open_cost_map(Path(name, "map"), card),
            read_costs(Path(name, "map")),
        )
    grid, survey = card.grid, make_survey(MODEL, source, directional)
    shape = (COURSES, *weight.shape)
    power = np.broadcast_to(np.where(is_free, weight, np.nan), shape).astype(np.float32)
    reasons = np.broadcast_to(np.where(is_free, 0, 4), shape).astype(np.uint16)
    scalar = CostGrid(grid, power, np.ones(shape, np.float32), reasons, np.zeros(weight.shape, np.float32))
    rng, free = np.random.default_rng(1), np.argwhere(is_free)
    ratios: dict[str, list[float]] = {"Smac 2D": [], "straight lines": []}

    def cost_of(xy_m: Floats) -> float:
        lonlat = find_lonlat_projection(source).inverse(xy_m)
        return compute_path_cost(MODEL, source, lonlat, where="path").totals.known_energy_joule

    while len(ratios["Smac 2D"]) < pairs:
        ends = free[rng.choice(len(free), 2, replace=False)]
        if np.linalg.norm(ends[1] - ends[0]) < 0.4 * metres:
            continue
        start, goal = (ends @ [grid.cols, 1]).tolist()
        xy_m = grid.xy_from_px(ends[:, ::-1].astype(np.float64))
        try:
            best = plan_path(survey, *find_lonlat_projection(source).inverse(xy_m), "energy").totals.known_energy_joule
        except PathError:
            continue
        steps = make_steps(
            scalar, scalar.per_metre("energy"), reasons == 0, survey.frames.metres(np.array([start, goal]))
        )
        cells = {
            "Smac 2D": search_as_smac(weight, start, goal),
            "straight lines": find_least_cost_paths(steps, 0.0, start, goal)[0].cells,
        }
        for kind, path in cells.items():
            points = np.stack(np.divmod(path, grid.cols)[::-1], axis=1).astype(np.float64)
            line = straighten_path(steps, points) if kind == "straight lines" else points
            ratios[kind].append(cost_of(grid.xy_from_px(line)) / best)
    print(f"{metres} x {metres} cells, {pairs} pairs; cost_travel_multiplier {multiplier:.3f}")
    for kind, found in ratios.items():
        print(
            f"{kind} on the Nav2 map: {100.0 * (np.mean(found) - 1.0):.1f} % more energy than the path of least energy on average, "
            f"at most {100.0 * (max(found) - 1.0):.1f} %"
        )


if __name__ == "__main__":
    main()
