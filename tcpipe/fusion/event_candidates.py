"""Where something may have happened: windows whose residual is far beyond the noise of the run, as plain data.

A candidate says when and between which sensors, never which of them errs. A step at t is beyond in every window that holds t; a wrong span
shows a step at either end; a smooth excursion shows only in windows as long as itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.fusion.densities import NoiseModel
from tcpipe.fusion.measurements import GNSS
from tcpipe.fusion.pair_residuals import TURN, Residuals

_GATE = 4.0  # standard deviations
_FEWEST = 3  # overlapping windows
_SHORTEST_S = 4.0  # single fixes off are for the gate
_LEAST = 1e-6  # m² or rad²


@dataclass(frozen=True, slots=True)
class EventCandidate:
    """Three or more overlapping windows beyond the noise.

    Attributes
    ----------
    pair, axis : the sensors compared, by role; along, across, up or turn.
    time_s : [s], length of the windows.
    start_ns, end_ns : [ns], from the start of the first window to the end of the last.
    at_ns : [ns], middle of the windows, weighted by z²: where a single step is.
    change : [m], turns [rad]: the residual of the window that is farthest beyond.
    z : the same in standard deviations.
    windows : how many are beyond.
    """

    pair: tuple[str, str]
    axis: str
    time_s: float
    start_ns: int
    end_ns: int
    at_ns: int
    change: float
    z: float
    windows: int


def find_event_candidates(residuals: Sequence[Residuals], noise: NoiseModel) -> tuple[EventCandidate, ...]:
    """Return candidates of events, the farthest beyond the noise first.

    ``noise`` was fitted to these residuals. Of candidates of one pair and axis at one time, the one that is farthest beyond stands for all.
    """
    found = [candidate for each in residuals if each.time_s >= _SHORTEST_S for candidate in _find_runs(each, noise)]
    kept: list[EventCandidate] = []
    for candidate in sorted(found, key=lambda each: -each.z):
        of_same = (each for each in kept if (each.pair, each.axis) == (candidate.pair, candidate.axis))
        if not any(each.start_ns <= candidate.at_ns <= each.end_ns for each in of_same):
            kept.append(candidate)
    return tuple(kept)


def _find_runs(each: Residuals, noise: NoiseModel) -> Iterator[EventCandidate]:
    """Yield each run of overlapping windows beyond the noise."""
    densities = noise.densities.get(each.axis, {})
    variance = _LEAST + sum((densities.get(name, 0.0) * factor for name, factor in each.features.items()), start=0.0)
    z = each.value / np.sqrt(variance)
    compares_motion = GNSS in each.pair or each.axis == TURN
    beyond = np.flatnonzero((np.abs(z) > _GATE) & (compares_motion | ~each.is_still))
    if not beyond.size:
        return
    overlaps = each.start_ns[beyond][1:] < each.end_ns[beyond][:-1]
    for rows in np.split(beyond, np.flatnonzero(~overlaps) + 1):
        if rows.size < _FEWEST:
            continue
        worst = rows[np.argmax(np.abs(z[rows]))]
        start_ns = int(each.start_ns[rows[0]])
        middle_ns = 0.5 * ((each.start_ns[rows] - start_ns) + (each.end_ns[rows] - start_ns))
        at_ns = start_ns + round(float(np.average(middle_ns, weights=z[rows] ** 2)))
        yield EventCandidate(
            each.pair, each.axis, each.time_s, start_ns, int(each.end_ns[rows[-1]]), at_ns,
            float(each.value[worst]), float(abs(z[worst])), int(rows.size),
        )  # fmt: skip
