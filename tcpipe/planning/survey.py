"""What is known of a map so far, cell by cell: only the ground that a path could need is looked at, and less of it is predicted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.planning.cost_grid import CellFrames, CostGrid, blocks, empty_grid, grid_over
from tcpipe.planning.cost_model import CostModel
from tcpipe.planning.verdicts import verdicts_of
from tcpipe.terrain.point_classes import classes_at
from tcpipe.terrain.tiles import MapReader

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Survey:
    """Costs and reasons, and of which cells they are known, shape (rows, cols) each."""

    model: CostModel
    source: MapReader
    costs: CostGrid
    judged: Mask
    predicted: Mask
    frames: CellFrames

    def judge(self, wanted: Mask, step: Callable[[int, int], None]) -> None:
        """Learn what ground the wanted cells are, without predictions."""
        self._learn(wanted & ~self.judged, step, ask=False)
        self.judged[wanted] = True

    def predict(self, wanted: Mask, step: Callable[[int, int], None]) -> None:
        """Learn what the wanted cells cost."""
        self._learn(wanted & ~self.predicted, step, ask=True)
        self.judged[wanted] = True
        self.predicted[wanted] = True

    def class_id(self) -> NDArray[np.uint8]:
        """Return the class under the middle of each cell, shape (rows, cols); 0 without data, or without classes."""
        grid = self.costs.grid
        if "terrain" not in self.source.layers:
            return np.zeros((grid.rows, grid.cols), np.uint8)
        row, col = np.mgrid[: grid.rows, : grid.cols]
        middle = grid.xy_from_px(np.stack([col, row], axis=-1).reshape(-1, 2).astype(np.float64))
        return np.maximum(classes_at(self.source, middle), 0).astype(np.uint8).reshape(grid.rows, grid.cols)

    def _learn(self, wanted: Mask, step: Callable[[int, int], None], *, ask: bool) -> None:
        todo = list(blocks(self.source, self.model, self.costs.grid, wanted))
        answers = verdicts_of(self.model, self.source, (self.frames.of(cells) for cells in todo), ask=ask)
        for number, (cells, found) in enumerate(zip(todo, answers, strict=True), 1):
            self.costs.put(cells, found)
            step(number, len(todo))


def new_survey(model: CostModel, source: MapReader, step_m: float) -> Survey:
    """Return a survey of which nothing is known."""
    grid = grid_over(source, step_m)
    known = np.zeros((2, grid.rows, grid.cols), np.bool_)
    return Survey(model, source, empty_grid(grid), known[0], known[1], CellFrames(grid, where=f"map {source.name}"))


def survey_from(model: CostModel, source: MapReader, costs: CostGrid) -> Survey:
    """Return a survey of which all is known, from a cost map."""
    known = np.ones((2, costs.grid.rows, costs.grid.cols), np.bool_)
    return Survey(model, source, costs, known[0], known[1], CellFrames(costs.grid, where=f"map {source.name}"))
