"""The least-cost path between two points (paper, section I), proved to be the best without predicting the whole map.

A path over a point p is at least as long as the straight lines start-p-goal, so a path shorter than a known one lies in an ellipse. The
search judges the ground in this ellipse without predictions and enlarges it until the shortest path is proved. Then it asks the model about
the ground of the shortest path and some cells of every class, and then about cells that could lie on a better path, until there are none.

The grid knows cells, and a path is judged by its metres. So the search offers several paths: of each objective, with turns and without, as
steps and as straight lines, and for ``risk`` with several multiples of the standard deviation of a cell added to its cost. The path
returned is the one that costs least as `tcpipe predict-path` predicts it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.prediction_errors import Errors
from tcpipe.errors import ModelError, PathError
from tcpipe.formats.json_files import convert_record
from tcpipe.planning.cost_grid import BARRED, COURSES, LazyCostGrid, Mask
from tcpipe.planning.cost_model import Reason
from tcpipe.planning.frames import find_projection
from tcpipe.planning.path_cost import PathCost, PathTotals, compute_path_cost, describe_off_map
from tcpipe.planning.search import (
    LeastCostPath,
    Steps,
    compute_least_costs,
    compute_steps_within,
    find_best_potential,
    find_least_cost_paths,
    find_turning,
    make_steps,
    straighten_path,
)
from tcpipe.tables.bits import flag_names
from tcpipe.terrain.layers import NODATA_ID
from tcpipe.terrain.sampling import find_classes_at

logger = logging.getLogger("tcpipe")

Floats = NDArray[np.float64]
Classes = NDArray[np.uint8]
Objective = Literal["energy", "time", "distance"]

OBJECTIVES: tuple[Objective, ...] = ("energy", "time", "distance")

_FIRST = 1.3
"""The first ellipse is of all points that make the straight way no longer than so many times."""

_GROWTH = 1.5

_CAUTIONS = (0.5, 1.0, 2.0)
"""Standard deviations of a cell that are added to its cost, for paths of little risk."""

_FEWEST_ASKED = 512
"""Cells asked about together, at least: a few seconds, more than finding the next takes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanTotals(PathTotals):
    """What a planned path costs in all, and how it was found."""

    objective: Objective
    """What it is the least of."""
    allow_extrapolation: bool
    finalists: int
    """Paths that were judged; this one is the best of them."""
    predicted_cells: int
    """Cells that the model was asked about."""
    negative_steps: int
    """Steps that give back more than height explains, taken as free."""
    risk: float | None = None
    """Probability with which the path takes no more than ``risk_cost``, by which it was chosen; None: by its prediction."""
    risk_cost: float | None = None
    """In the objective's unit."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A planned path.

    Attributes
    ----------
    lonlat_deg, xy_m : its points, WGS 84 and in the map's CRS, shape (P, 2); from the start as given to the goal as given.
    cost : what `tcpipe predict-path` says of it.
    totals : that in all, and how it was found.
    """

    lonlat_deg: Floats
    xy_m: Floats
    cost: PathCost
    totals: PlanTotals


def plan_paths(
    survey: LazyCostGrid,
    start_deg: Floats,
    goal_deg: Floats,
    objectives: Sequence[Objective],
    *,
    allow_extrapolation: bool = False,
    risk: float | None = None,
    step: Callable[[int, int], None] = lambda _, __: None,
) -> dict[Objective, Plan]:
    """Return the least-cost path from a point to another of each objective.

    Parameters
    ----------
    survey : the map and the model, and what is known so far; it learns what it lacks.
    start_deg, goal_deg : longitude and latitude, WGS 84 [deg], shape (2,).
    objectives : what is to be least.
    allow_extrapolation : whether ground unlike any that the model was trained on may be crossed.
    risk : the probability with which a path shall take no more than what is least; None: its prediction is least.
    step : is told how many blocks of how many are looked at, or predicted, in each round.

    Raises `PathError` where an end is off the map or on closed ground, or no path connects them; `ModelError` where the model states no
    errors for ``risk``.
    """
    errors = survey.model.errors
    if risk is not None and errors is None:
        raise ModelError(
            f"{survey.model.name}: has too few held-out samples for errors, which --risk and --budget need"
        )
    ends_xy_m = find_projection(survey.source).forward(np.stack([start_deg, goal_deg]))
    search = _Search(survey, ends_xy_m, np.stack([start_deg, goal_deg]), allow_extrapolation, step)
    search.check_ends()
    lines, negative = search.find_finalists(objectives, None if risk is None else errors)
    lonlats = [find_projection(survey.source).inverse(xy_m) for xy_m in lines]
    costs = [compute_path_cost(survey.model, survey.source, lonlat, where="the planned path") for lonlat in lonlats]
    predicted_cells = int(np.count_nonzero(survey.predicted))
    plans = {}
    for objective in objectives:
        of_all = [_judge(cost, objective, risk) for cost in costs]
        best = min((cost.totals.path_segments_without_cost, of_all[at], at) for at, cost in enumerate(costs))[-1]
        totals = convert_record(
            costs[best].totals,
            PlanTotals,
            objective=objective,
            allow_extrapolation=allow_extrapolation,
            finalists=len(lines),
            predicted_cells=predicted_cells,
            negative_steps=negative.get(objective, 0),
            risk=risk,
            risk_cost=None if risk is None else of_all[best],
        )
        plans[objective] = Plan(lonlats[best], lines[best], costs[best], totals)
    return plans


def _judge(cost: PathCost, objective: Objective, risk: float | None) -> float:
    """Return what a path costs in the objective's unit, and is not exceeded with the probability ``risk``."""
    if objective == "distance":
        return cost.totals.length_m
    quantity = "energy" if objective == "energy" else "duration"
    if risk is not None and cost.errors is not None:
        return cost.errors[quantity].compute_quantile(risk)
    return cost.totals.known_energy_joule if objective == "energy" else cost.totals.duration_s


@dataclass(frozen=True, slots=True)
class _Search:
    survey: LazyCostGrid
    ends_xy_m: Floats
    ends_deg: Floats
    allow_extrapolation: bool
    step: Callable[[int, int], None]

    @property
    def _cells(self) -> NDArray[np.int64]:
        """Flat indices of the cells of start and goal."""
        grid = self.survey.costs.grid
        col, row = np.floor(grid.px_from_xy(self.ends_xy_m) + 0.5).astype(np.int64).T
        return np.asarray(np.clip(row, 0, grid.rows - 1) * grid.cols + np.clip(col, 0, grid.cols - 1))

    def check_ends(self) -> None:
        """Raise `PathError` for ends off the map, on ground that cannot be driven, or nearer than a chord; both at once."""
        source, problems = self.survey.source, []
        labels = [
            f"--{name} {lon:.6f},{lat:.6f}" for name, (lon, lat) in zip(("from", "to"), self.ends_deg, strict=True)
        ]
        on = np.isfinite(self.ends_xy_m).all(axis=1) & source.grid.contains(
            np.nan_to_num(self.ends_xy_m, posinf=np.inf)
        )
        problems += [
            describe_off_map(source, label, end[None])
            for label, end, inside in zip(labels, self.ends_deg, on, strict=True)
            if not inside
        ]
        if problems:
            raise PathError(*problems)
        if "terrain" in source.layers:
            names, may = source.classes.names(), source.classes.traversable()
            for label, class_id in zip(labels, find_classes_at(source, self.ends_xy_m).tolist(), strict=True):
                if class_id == NODATA_ID:
                    problems.append(f"{label}: map {source.name} has no data there")
                elif not may[class_id]:
                    problems.append(f"{label}: is on {names[class_id]}, which is not traversable")
        apart_m = float(np.linalg.norm(self.ends_xy_m[1] - self.ends_xy_m[0]))
        if apart_m < self.survey.model.card.chord_m:
            problems.append(
                f"{labels[0]} and {labels[1]} are {apart_m:.2f} m apart; expected at least {self.survey.model.card.chord_m:g} m"
            )
        elif len(set(self._cells.tolist())) == 1:
            pixel_size_m = self.survey.costs.grid.pixel_size_m
            problems.append(
                f"{labels[0]} and {labels[1]} are in one cell of {pixel_size_m:g} m; choose a smaller --cell-size"
            )
        if problems:
            raise PathError(*problems)

    def _check_open(self) -> None:
        """Raise `PathError` for an end from which no course can be driven; both at once."""
        bits = self.survey.costs.reasons.reshape(len(self.survey.costs.reasons), -1)[:, self._cells]
        forbidden, problems = BARRED if self.allow_extrapolation else 0xFFFF, []
        for label, own in zip(("--from", "--to"), (bits & forbidden).T, strict=True):
            if own.all():
                common = int(np.bitwise_and.reduce(own)) or int(np.bitwise_or.reduce(own))
                words = ", ".join(name.replace("_", " ") for name in flag_names(common, Reason))
                is_closed = self.allow_extrapolation or common & BARRED
                hint = "" if is_closed else ", or allow such ground with --allow-extrapolation"
                problems.append(
                    f"{label}: no course can be driven from there on map {self.survey.source.name} ({words}); choose another point{hint}"
                )
        if problems:
            raise PathError(*problems)

    def _ellipse(self, bound_m: float) -> Mask:
        """Return the cells over which a path from start to goal need not be longer than ``bound_m``, and those beside the ends."""
        grid = self.survey.costs.grid
        scale = self._metres().min()
        x = grid.x_min_m + (np.arange(grid.cols) + 0.5) * grid.pixel_size_m
        y = grid.y_max_m - (np.arange(grid.rows) + 0.5) * grid.pixel_size_m
        away = sum(np.hypot(x[None, :] - end[0], y[:, None] - end[1]) for end in self.ends_xy_m)
        return np.asarray(away * scale <= bound_m + 4.0 * grid.pixel_size_m)

    def _metres(self) -> Floats:
        return self.survey.frames.metres(self._cells)

    def _find(
        self,
        objective: Objective,
        known: Mask,
        class_id: Classes | None = None,
        errors: Errors | None = None,
        caution: float = 0.0,
    ) -> tuple[Steps, tuple[LeastCostPath, ...]]:
        """Return the steps over known cells and the best paths over them; with the cells' classes, that with turns comes first."""
        costs, (start, goal) = self.survey.costs, self._cells.tolist()
        open_ = costs.open_courses(allow_extrapolation=self.allow_extrapolation) & known
        per_metre = costs.per_metre(objective)
        if errors is not None and class_id is not None:
            for course in per_metre:
                course += caution * errors.compute_std(course, class_id)  # noqa: PLW2901  in place
        steps = make_steps(costs, per_metre, open_, self._metres())
        if start == goal or not open_.any():
            return steps, ()
        if objective != "energy" or class_id is None:
            return steps, find_least_cost_paths(steps, 0.0, start, goal)
        turning = find_turning(self.survey.model.card.physics, self.survey.model.card.class_table)
        return steps, find_least_cost_paths(steps, find_best_potential(steps), start, goal, turning, class_id)

    def find_finalists(
        self, objectives: Sequence[Objective], errors: dict[str, Errors] | None
    ) -> tuple[list[Floats], dict[Objective, int]]:
        """Return the lines of paths that may be the best of any objective, (P, 2) each, and the steps taken as free by objective."""
        negative = dict[Objective, int]()
        lines = list(self._iterate_finalists(objectives, errors, negative))
        different = {np.round(line, 3).tobytes(): line for line in lines}
        return list(different.values()), negative

    def _iterate_finalists(
        self, objectives: Sequence[Objective], errors: dict[str, Errors] | None, negative: dict[Objective, int]
    ) -> Iterator[Floats]:
        """Yield the shortest path; the best of each objective, for which the model is asked; then others over what is known by then.

        Those are the best of objectives that were not asked for, and with ``errors`` those of little risk.
        """
        bound_m, steps, paths = self._find_shortest()
        yield from self._draw_lines(steps, paths)
        asked = [objective for objective in objectives if objective != "distance"]
        class_id = self.survey.class_id() if asked else None
        if class_id is None:
            return
        for objective in asked:
            steps, paths = self._find_best(objective, bound_m, class_id)
            negative[objective] = paths[0].negative_steps
            yield from self._draw_lines(steps, paths)
        for objective, quantity in (("energy", "energy"), ("time", "duration")):
            cautions = (0.0,) if objective not in asked else () if errors is None else _CAUTIONS
            for caution in cautions:
                of_all = None if errors is None else errors[quantity]
                yield from self._draw_lines(*self._find(objective, self.survey.predicted, class_id, of_all, caution))

    def _find_shortest(self) -> tuple[float, Steps, tuple[LeastCostPath, ...]]:
        """Return the length of the shortest path that can be driven, the steps and the path; only the ground is looked at."""
        straight_m = float(np.linalg.norm(self.ends_xy_m[1] - self.ends_xy_m[0]) * self._metres().max())
        bound_m = straight_m * _FIRST
        while True:
            ellipse = self._ellipse(bound_m)
            if not self.survey.judged[ellipse].all():
                logger.info("checking the ground of %d cells", np.count_nonzero(ellipse & ~self.survey.judged))
            self.survey.judge(ellipse, self.step)
            self._check_open()
            steps, paths = self._find("distance", self.survey.judged)
            if paths and (paths[0].cost <= bound_m or ellipse.all()):
                return paths[0].cost, steps, paths
            if ellipse.all():
                raise PathError(self._no_way())
            bound_m = max(bound_m * _GROWTH, paths[0].cost if paths else 0.0)

    def _find_best(
        self, objective: Objective, bound_m: float, class_id: Classes
    ) -> tuple[Steps, tuple[LeastCostPath, ...]]:
        """Return the least-cost paths; the model is asked about every cell that could be on the first."""
        survey, open_ = self.survey, np.asarray(self._maybe_open().any(axis=0))
        probes, ellipse = probe_cells(class_id, open_), self._ellipse(bound_m) & open_
        if not survey.predicted[probes | ellipse].all():
            logger.info(
                "without --cost-map the model predicts %d to %d cells, %d courses each; "
                "with a cost map (tcpipe cost-map) a plan takes seconds",
                *(int(np.count_nonzero(cells & ~survey.predicted)) for cells in (probes | ellipse, open_)),
                COURSES,
            )
        self._ask(probes)
        self._ask(ellipse)
        while True:
            steps, paths = self._find(objective, survey.predicted, class_id)
            wanted = self._could_be_better(objective, paths[0] if paths else None, class_id)
            if not wanted.any():
                if not paths:
                    raise PathError(self._no_way())
                return steps, paths
            self._ask(wanted)

    def _maybe_open(self) -> NDArray[np.bool_]:
        """Return where a course may be driven as far as is known, shape (16, rows, cols)."""
        return np.asarray(
            self.survey.costs.open_courses(allow_extrapolation=self.allow_extrapolation) | ~self.survey.judged
        )

    def _could_be_better(self, objective: Objective, found: LeastCostPath | None, class_id: Classes) -> Mask:
        """Return those cells to ask about next that are the likeliest of all that could lie on a better path."""
        survey, (start, goal) = self.survey, self._cells.tolist()
        if survey.predicted.all():
            return ~survey.predicted
        per_metre = survey.costs.per_metre(objective)
        steps = make_steps(survey.costs, per_metre, self._maybe_open(), self._metres())
        over, better = find_possible_gain(steps, class_id, found, start, goal)
        cells = np.flatnonzero(better & ~survey.predicted.reshape(-1))
        most = max(_FEWEST_ASKED, int(survey.predicted.sum()) // 2)
        wanted = np.zeros(survey.predicted.shape, np.bool_)
        wanted.reshape(-1)[cells[np.argsort(over[cells], kind="stable")[:most]]] = True
        return wanted

    def _ask(self, wanted: Mask) -> None:
        """Ask the model about cells, and log how many."""
        if count := int(np.count_nonzero(wanted & ~self.survey.predicted)):
            logger.info("predicting %d cells", count)
            self.survey.predict(wanted, self.step)

    def _draw_lines(self, steps: Steps, paths: Iterable[LeastCostPath]) -> Iterator[Floats]:
        """Yield each path in the map's CRS [m], from end to end as they were given: as its steps, and as straight lines that cost less."""
        grid = self.survey.costs.grid
        for path in paths:
            points = np.stack(np.divmod(path.cells, grid.cols)[::-1], axis=1).astype(np.float64)
            points[[0, -1]] = grid.px_from_xy(self.ends_xy_m)
            yield grid.xy_from_px(points)
            yield grid.xy_from_px(straighten_path(steps, points))

    def _no_way(self) -> str:
        """Say why there is no way."""
        text = f"no path from start to goal on map {self.survey.source.name}"
        if not self.allow_extrapolation:
            other = _Search(self.survey, self.ends_xy_m, self.ends_deg, allow_extrapolation=True, step=self.step)
            if other._find("distance", self.survey.judged)[1]:
                return f"{text} within the training range of the model; --allow-extrapolation crosses other ground"
        return f"{text}: the ground between them is not traversable or has no data"


_CHEAP = 0.1
_FEWEST_STEPS = 20
"""Known steps without which a class is taken to be as cheap as the cheapest other."""

_PROBES = 6
_CLASSES = 256


def probe_cells(class_id: Classes, open_: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return cells to predict first: for each class squares of three by three cells, spread evenly over it.

    ``class_id`` and ``open_`` (whether a cell may be driven over as far as is known) have shape (rows, cols).
    """
    rows, cols = class_id.shape
    found = np.zeros(class_id.shape, np.bool_)
    for number in np.unique(class_id[open_]).tolist():
        own = np.flatnonzero((class_id == number) & open_)
        middle = own[((np.arange(_PROBES) + 0.5) / _PROBES * own.size).astype(np.int64)]
        for row, col in np.stack(np.divmod(middle, cols), axis=1).tolist():
            found[max(row - 1, 0) : min(row + 2, rows), max(col - 1, 0) : min(col + 2, cols)] = True
    return found & open_


def find_possible_gain(
    steps: Steps, class_id: Classes, found: LeastCostPath | None, start: int, goal: int
) -> tuple[Floats, Mask]:
    """Return the least that a path over each cell can cost, shape (cells,), and whether that is less than ``found`` costs.

    ``steps`` are all steps that may be possible, with a cost where it is known; ``class_id`` has shape (rows, cols); ``found`` is the best
    path over known steps; ``start`` and ``goal`` are flat indices of cells.
    """
    k = found.potential if found else find_best_potential(steps)
    bounded = steps._replace(bound_per_m=_find_cheap_by_class(steps, k, class_id)[class_id])
    limit = found.reduced_cost * (1.0 - 1e-9) if found else np.inf
    over = compute_least_costs(bounded, k, start, goal, limit=limit)
    return over, over < limit


def _find_cheap_by_class(steps: Steps, k: float, class_id: Classes) -> NDArray[np.float32]:
    """Return the cheapest tenth of a metre of each class without the grade, shape (256,)."""
    per_m = np.full((COURSES, *steps.shape), np.nan, np.float32)
    for course in range(COURSES):
        compute_steps_within(steps, k, course, class_id, per_m[course])
    cheap = np.full(_CLASSES, np.nan, np.float32)
    for number in np.unique(class_id).tolist():
        own = per_m[:, class_id == number]
        own = own[np.isfinite(own)]
        if own.size >= _FEWEST_STEPS:
            cheap[number] = max(float(np.quantile(own, _CHEAP)), 0.0)
    known = cheap[np.isfinite(cheap)]
    return np.where(np.isfinite(cheap), cheap, known.min() if known.size else np.float32(0.0))
