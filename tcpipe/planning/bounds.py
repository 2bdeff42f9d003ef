"""Which cells could still be on a better path: of ground that is not predicted, only the class is known, and what cheap ground of it costs.

A step onto such ground is taken to cost no less than the cheapest tenth of the known steps on its class (the mean of both classes at a
border), the grade taken out: no path is made of the best metres alone. With these steps beside the known ones, the cheapest path over a
cell is found from both its ends. Where even that costs more than a path that is known, the model need not be asked about the cell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.planning.search import Found, Steps, best_potential, least_over_cells

Floats = NDArray[np.float64]
Classes = NDArray[np.uint8]

_CHEAP = 0.1
_FEWEST_STEPS = 20
"""Known steps without which a class is taken to be as cheap as the cheapest other."""

_PROBES = 6
_CLASSES = 256


def probe_cells(class_id: Classes, open_: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return cells to be predicted before anything is said of a class: squares of three by three around some of it, spread evenly.

    Parameters
    ----------
    class_id, open_ : of each cell, and whether it may be driven over as far as is known, shape (rows, cols).
    """
    rows, cols = class_id.shape
    found = np.zeros(class_id.shape, np.bool_)
    for number in np.unique(class_id[open_]).tolist():
        own = np.flatnonzero((class_id == number) & open_)
        middle = own[((np.arange(_PROBES) + 0.5) / _PROBES * own.size).astype(np.int64)]
        for row, col in np.stack(np.divmod(middle, cols), axis=1).tolist():
            found[max(row - 1, 0) : min(row + 2, rows), max(col - 1, 0) : min(col + 2, cols)] = True
    return found & open_


def could_be_better(
    steps: Steps, class_id: Classes, found: Found | None, start: int, goal: int
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the least that a path over each cell can cost, shape (cells,), and whether that is less than the path that was found.

    Parameters
    ----------
    steps : every step that may be possible; those with a cost are known.
    class_id : of each cell, shape (rows, cols).
    found : the best path over known steps, None if there is none.
    start, goal : flat indices of cells.
    """
    known = np.isfinite(steps.cost)
    sure = Steps(steps.begin[known], steps.end[known], steps.cost[known], steps.length_m[known], steps.rise_m[known])
    reduced = sure.cost - (found.potential if found else best_potential(sure)) * sure.rise_m
    of_cell = class_id.reshape(-1)
    cheap = _cheap_by_class(sure, reduced, of_cell)
    least = np.empty(steps.cost.size)
    least[known] = reduced
    least[~known] = (0.5 * (cheap[of_cell[steps.begin]] + cheap[of_cell[steps.end]]) * steps.length_m)[~known]
    limit = found.reduced_cost * (1.0 - 1e-9) if found else np.inf
    over = least_over_cells(steps, least, of_cell.size, start, goal, limit=limit)
    return over, over < limit


def _cheap_by_class(steps: Steps, reduced: Floats, of_cell: Classes) -> Floats:
    """Return the cheapest tenth of a metre of each class, shape (256,)."""
    found = np.full(_CLASSES, np.nan)
    within, per_m = of_cell[steps.begin], reduced / steps.length_m
    inside = within == of_cell[steps.end]
    for number in np.unique(within).tolist():
        own = per_m[inside & (within == number)]
        if own.size >= _FEWEST_STEPS:
            found[number] = max(float(np.quantile(own, _CHEAP)), 0.0)
    known = found[np.isfinite(found)]
    return np.where(np.isfinite(found), found, known.min() if known.size else 0.0)
