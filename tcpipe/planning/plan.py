"""The least-cost path between two points (paper, section I).

A path over a point p is at least as long as the straight lines start-p-goal, so an ellipse contains every path shorter
than a bound. Without a cost map the model predicts the cells of the ellipse of all paths up to `DETOUR` times as long
as the shortest, and the search uses these; with a cost map it uses all cells.

The search uses cells, but a path is judged by its metres. So the search returns several paths: of each objective, with
turns and without, as steps and as straight lines, and for ``risk`` with several multiples of the standard deviation of
a cell added to its cost. The returned path is the one with the least cost predicted by `tcpipe predict-path`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tcpipe.arrays import Bytes, Floats, Ints, Mask
from tcpipe.cost.prediction_errors import QuantityErrors
from tcpipe.errors import ModelError, PathError
from tcpipe.formats.json_files import convert_record
from tcpipe.planning.cost_grid import BARRED, COURSES, LazyCostGrid
from tcpipe.planning.cost_model import Reason
from tcpipe.planning.frames import find_lonlat_projection
from tcpipe.planning.path_cost import PathCost, PathTotals, compute_path_cost, describe_off_map
from tcpipe.planning.search import (
    GridSteps,
    LeastCostPath,
    find_best_potential,
    find_least_cost_paths,
    find_turning,
    make_steps,
    straighten_path,
)
from tcpipe.progress import logger
from tcpipe.tables.bits import flag_names
from tcpipe.terrain.layers import NODATA_ID
from tcpipe.terrain.sampling import find_classes_at

Classes = Bytes
Objective = Literal["energy", "time", "distance"]

OBJECTIVES: tuple[Objective, ...] = ("energy", "time", "distance")

DETOUR = 1.3
"""Length of a path over that of the shortest [1], up to which the search without a cost map finds the best."""

_GRID = 1.03  # length of a path of 16 courses over that of a straight line, at most [1]

_GROWTH = 1.5  # factor by which the ellipse grows while no path is found [1]

_CAUTIONS = (0.5, 1.0, 2.0)  # standard deviations of a cell that are added to its cost, for paths of little risk [1]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanTotals(PathTotals):
    """Totals of a planned path, and how it was found."""

    objective: Objective
    """The quantity that is minimised."""
    allow_extrapolation: bool
    finalists: int
    """Number of compared paths; this one is the best."""
    predicted_cells: int
    """Cells that the model predicted."""
    negative_steps: int
    """Steps that gain more energy than their height explains; they cost nothing."""
    risk: float | None = None
    """Probability that the path's cost is at most ``risk_cost``, the criterion; None: chosen by its prediction."""
    risk_cost: float | None = None
    """In the objective's unit."""
    budget_joule: float | None = None
    budget_probability: float | None = None
    """Probability that the budget suffices; None without a budget, or if some path segment has no cost."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A planned path.

    Attributes
    ----------
    lonlat_deg, xy_m : its points, WGS 84 and in the map's CRS, shape (P, 2), from the given start to the given goal.
    cost : as `tcpipe predict-path` predicts it.
    totals : its totals, and how it was found.
    """

    lonlat_deg: Floats
    xy_m: Floats
    cost: PathCost
    totals: PlanTotals


def plan_path(
    survey: LazyCostGrid,
    start_deg: Floats,
    goal_deg: Floats,
    objective: Objective,
    *,
    allow_extrapolation: bool = False,
    risk: float | None = None,
    budget_joule: float | None = None,
) -> Plan:
    """Return the least-cost path from a point to another.

    Parameters
    ----------
    survey : the map and the model, and the costs known so far; missing ones are predicted.
    start_deg, goal_deg : longitude and latitude, WGS 84 [deg], shape (2,).
    objective : the quantity to minimise.
    allow_extrapolation : whether to cross ground outside the training range.
    risk : minimise the cost that the path stays below with this probability; None: minimise the predicted cost.
    budget_joule : state the probability that this energy suffices.

    Raises `PathError` if an end is off the map or on closed ground, or no path connects them; `ModelError` if the model
    states no errors for ``risk`` or a budget.
    """
    errors = survey.model.errors
    if (risk is not None or budget_joule is not None) and errors is None:
        raise ModelError(
            f"{survey.model.name}: has too few held-out samples for errors, which --risk and --budget need"
        )
    ends_deg = np.stack([start_deg, goal_deg])
    projection = find_lonlat_projection(survey.source)
    search = _Search(survey, projection.forward(ends_deg), ends_deg, allow_extrapolation)
    search.check_ends()
    search.predict_ground()
    lines, negative = search.find_candidate_paths(objective, None if risk is None else errors)
    lonlats = [projection.inverse(xy_m) for xy_m in lines]
    costs = [compute_path_cost(survey.model, survey.source, lonlat, where="the planned path") for lonlat in lonlats]
    judged = [_judge(cost, objective, risk) for cost in costs]
    best = min((cost.totals.path_segments_without_cost, judged[at], at) for at, cost in enumerate(costs))[-1]
    found = costs[best]
    probability = None
    if budget_joule is not None and found.errors is not None and found.totals.complete:
        probability = found.errors["energy"].compute_probability(budget_joule)
    totals = convert_record(
        found.totals,
        PlanTotals,
        objective=objective,
        allow_extrapolation=allow_extrapolation,
        finalists=len(lines),
        predicted_cells=int(np.count_nonzero(survey.predicted)),
        negative_steps=negative,
        risk=risk,
        risk_cost=None if risk is None else judged[best],
        budget_joule=budget_joule,
        budget_probability=probability,
    )
    return Plan(lonlats[best], lines[best], found, totals)


def _judge(cost: PathCost, objective: Objective, risk: float | None) -> float:
    """Return the expected cost of a path, in the objective's unit; with ``risk`` its quantile of that probability."""
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

    @property
    def _cells(self) -> Ints:
        """Flat indices of the cells of start and goal."""
        grid = self.survey.costs.grid
        col, row = np.floor(grid.px_from_xy(self.ends_xy_m) + 0.5).astype(np.int64).T
        return np.asarray(np.clip(row, 0, grid.rows - 1) * grid.cols + np.clip(col, 0, grid.cols - 1))

    def check_ends(self) -> None:
        """Raise `PathError` for ends off the map, on closed ground, or nearer than a chord; one error for both ends."""
        source, problems = self.survey.source, []
        labels = [
            f"--{name} {lon:.6f},{lat:.6f}" for name, (lon, lat) in zip(("from", "to"), self.ends_deg, strict=True)
        ]
        is_on_map = np.isfinite(self.ends_xy_m).all(axis=1) & source.grid.contains(
            np.nan_to_num(self.ends_xy_m, posinf=np.inf)
        )
        problems += [
            describe_off_map(source, label, end[None])
            for label, end, inside in zip(labels, self.ends_deg, is_on_map, strict=True)
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
                f"{labels[0]} and {labels[1]} are {apart_m:.2f} m apart; "
                f"expected at least {self.survey.model.card.chord_m:g} m"
            )
        elif len(set(self._cells.tolist())) == 1:
            pixel_size_m = self.survey.costs.grid.pixel_size_m
            problems.append(
                f"{labels[0]} and {labels[1]} are in one cell of {pixel_size_m:g} m; choose a smaller --cell-size"
            )
        if problems:
            raise PathError(*problems)

    def predict_ground(self) -> None:
        """Predict the cells of all paths up to `DETOUR` times as long as the shortest; `PathError` without a path."""
        straight_m = float(np.linalg.norm(self.ends_xy_m[1] - self.ends_xy_m[0]) * self._metres().max())
        bound_m, survey = straight_m * DETOUR, self.survey
        while True:
            ellipse = self._ellipse(bound_m)
            if count := int(np.count_nonzero(ellipse & ~survey.predicted)):
                logger.info(
                    "predicting %d cells, %d courses each; a cost map (tcpipe cost-map) avoids this", count, COURSES
                )
                survey.predict(ellipse)
            self._check_open()
            paths = self._search("distance")[1]
            if paths and (paths[0].cost * DETOUR <= bound_m * _GRID or ellipse.all()):
                return
            if ellipse.all():
                raise PathError(self._describe_no_path())
            bound_m = max(bound_m * _GROWTH, paths[0].cost * DETOUR if paths else 0.0)

    def _check_open(self) -> None:
        """Raise `PathError` for an end from which no course can be driven; one error for both."""
        bits = self.survey.costs.reasons.reshape(COURSES, -1)[:, self._cells]
        forbidden, problems = BARRED if self.allow_extrapolation else 0xFFFF, []
        for label, own in zip(("--from", "--to"), (bits & forbidden).T, strict=True):
            if own.all():
                common = int(np.bitwise_and.reduce(own)) or int(np.bitwise_or.reduce(own))
                words = ", ".join(name.replace("_", " ") for name in flag_names(common, Reason))
                is_closed = self.allow_extrapolation or common & BARRED
                hint = "" if is_closed else ", or allow such ground with --allow-extrapolation"
                problems.append(
                    f"{label}: no course can be driven from there on map {self.survey.source.name} ({words}); choose "
                    f"another point{hint}"
                )
        if problems:
            raise PathError(*problems)

    def _ellipse(self, bound_m: float) -> Mask:
        """Return the cells of paths from start to goal of length ``bound_m`` or less, and those beside the ends."""
        grid = self.survey.costs.grid
        scale = self._metres().min()
        x = grid.x_min_m + (np.arange(grid.cols) + 0.5) * grid.pixel_size_m
        y = grid.y_max_m - (np.arange(grid.rows) + 0.5) * grid.pixel_size_m
        away = sum(np.hypot(x[None, :] - end[0], y[:, None] - end[1]) for end in self.ends_xy_m)
        return np.asarray(away * scale <= bound_m + 4.0 * grid.pixel_size_m)

    def _metres(self) -> Floats:
        return self.survey.frames.metres(self._cells)

    def _search(
        self,
        objective: Objective,
        class_id: Classes | None = None,
        errors: QuantityErrors | None = None,
        caution: float = 0.0,
    ) -> tuple[GridSteps, tuple[LeastCostPath, ...]]:
        """Return steps over predicted cells, and the best paths; with classes, the first one includes costs of turns."""
        costs, (start, goal) = self.survey.costs, self._cells.tolist()
        open_ = costs.open_courses(allow_extrapolation=self.allow_extrapolation) & self.survey.predicted
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

    def find_candidate_paths(
        self, objective: Objective, errors: Mapping[str, QuantityErrors] | None
    ) -> tuple[list[Floats], int]:
        """Return lines of candidate paths, (P, 2) each, and the number of free steps of the objective's search.

        Candidates are the best paths of each objective, and, with ``errors``, paths that avoid uncertain cells.
        """
        class_id, lines, negative = self.survey.class_id(), list[Floats](), 0
        for name in OBJECTIVES:
            steps, paths = self._search(name, class_id)
            negative = paths[0].negative_steps if name == objective else negative
            lines += self._draw_lines(steps, paths)
        if errors is not None and objective != "distance":
            of_cell = errors["energy" if objective == "energy" else "duration"]
            for caution in _CAUTIONS:
                lines += self._draw_lines(*self._search(objective, class_id, of_cell, caution))
        return list({np.round(line, 3).tobytes(): line for line in lines}.values()), negative

    def _draw_lines(self, steps: GridSteps, paths: tuple[LeastCostPath, ...]) -> Iterator[Floats]:
        """Yield each path in the map's CRS [m] between the given ends: as steps, and as straight lines of less cost."""
        grid = self.survey.costs.grid
        for path in paths:
            points = np.stack(np.divmod(path.cells, grid.cols)[::-1], axis=1).astype(float)
            points[[0, -1]] = grid.px_from_xy(self.ends_xy_m)
            yield grid.xy_from_px(points)
            yield grid.xy_from_px(straighten_path(steps, points))

    def _describe_no_path(self) -> str:
        """Return why there is no path."""
        text = f"no path from start to goal on map {self.survey.source.name}"
        if not self.allow_extrapolation:
            other = _Search(self.survey, self.ends_xy_m, self.ends_deg, allow_extrapolation=True)
            if other._search("distance")[1]:
                return f"{text} within the training range of the model; --allow-extrapolation crosses other ground"
        return f"{text}: the ground between them is not traversable or has no data"
