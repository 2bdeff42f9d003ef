"""Smooth excursions of fixes, which no gate rejects: windows of the pairs' residuals that are far beyond the noise of the section.

A step at t is beyond in every window that holds t, an excursion only in windows as long as itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.fusion import state
from tcpipe.fusion.changes import Change
from tcpipe.fusion.densities import NoiseModel
from tcpipe.fusion.measurements import GNSS
from tcpipe.fusion.pair_residuals import ACROSS, ALONG, Residuals
from tcpipe.fusion.ticks import Ticks

_GATE = 4.0  # standard deviations of a residual that noise does not reach [1]
_MIN_WINDOWS = 3  # overlapping windows beyond the gate [1]
_MIN_WINDOW_S = 4.0  # shortest windows [s]: the filter's gate rejects single fixes
_MIN_VARIANCE = 1e-6  # of a residual [m² or rad²]
_MAX_RATIO = 2.0  # of the changes against two odometries that confirm each other [1]
_LONG_WINDOW_S = 8.0  # shorter excursions may show only a wrong lever arm while the robot turns [s]


@dataclass(frozen=True, slots=True)
class EventCandidate:
    """Three or more overlapping windows in which fixes moved otherwise than an odometry, far beyond the noise.

    Attributes
    ----------
    pair, axis : the sensors compared, by role; along or across.
    time_s : [s], length of the windows.
    start_ns, end_ns : [ns], from the start of the first window to the end of the last.
    at_ns : [ns], middle of the windows, weighted by z²: where a single step is.
    change, z : [m], the residual of the window that is farthest beyond, and the same in standard deviations.
    """

    pair: tuple[str, str]
    axis: str
    time_s: float
    start_ns: int
    end_ns: int
    at_ns: int
    change: float
    z: float


def find_event_candidates(residuals: Sequence[Residuals], noise: NoiseModel) -> list[EventCandidate]:
    """Return candidates of events of the fixes, the farthest beyond the noise first.

    ``noise`` was fitted to these residuals. Of candidates of one pair and axis at one time, the one that is farthest beyond stands for all.
    """
    of_fixes = [
        each
        for each in residuals
        if GNSS in each.pair and each.axis in {ALONG, ACROSS} and each.time_s >= _MIN_WINDOW_S
    ]
    kept: list[EventCandidate] = []
    for candidate in sorted((one for each in of_fixes for one in _find_runs(each, noise)), key=lambda each: -each.z):
        of_same = (each for each in kept if (each.pair, each.axis) == (candidate.pair, candidate.axis))
        if not any(each.start_ns <= candidate.at_ns <= each.end_ns for each in of_same):
            kept.append(candidate)
    return kept


def find_fix_excursions(residuals: Sequence[Residuals], noise: NoiseModel) -> list[EventCandidate]:
    """Return where fixes moved otherwise than two odometries alike, which did not slip at the same time."""
    found = find_event_candidates(residuals, noise)
    # Shorter ones may show only that the antenna is elsewhere than stated while the robot turns.
    return [one for one in found if one.time_s > _LONG_WINDOW_S and any(_is_confirmed(one, other) for other in found)]


def _is_confirmed(one: EventCandidate, other: EventCandidate) -> bool:
    overlap_ns = min(one.end_ns, other.end_ns) - max(one.start_ns, other.start_ns)
    is_other = other.pair != one.pair and other.axis == one.axis and overlap_ns > 0
    return (
        is_other
        and one.change * other.change > 0.0
        and abs(other.change) < _MAX_RATIO * abs(one.change) < _MAX_RATIO**2 * abs(other.change)
    )


def _find_runs(each: Residuals, noise: NoiseModel) -> Iterator[EventCandidate]:
    """Yield each run of overlapping windows beyond the noise."""
    densities = noise.densities.get(each.axis, {})
    variance = _MIN_VARIANCE + sum(
        (densities.get(name, 0.0) * factor for name, factor in each.features.items()), start=0.0
    )
    z = each.value / np.sqrt(variance)
    beyond = np.flatnonzero(np.abs(z) > _GATE)
    if not beyond.size:
        return
    overlaps = each.start_ns[beyond][1:] < each.end_ns[beyond][:-1]
    for rows in np.split(beyond, np.flatnonzero(~overlaps) + 1):
        if rows.size < _MIN_WINDOWS:
            continue
        worst = rows[np.argmax(np.abs(z[rows]))]
        start_ns = int(each.start_ns[rows[0]])
        middle_ns = 0.5 * ((each.start_ns[rows] - start_ns) + (each.end_ns[rows] - start_ns))
        at_ns = start_ns + round(float(np.average(middle_ns, weights=z[rows] ** 2)))
        yield EventCandidate(
            each.pair, each.axis, each.time_s, start_ns, int(each.end_ns[rows[-1]]), at_ns,
            float(each.value[worst]), float(abs(z[worst])),
        )  # fmt: skip


def find_excursions(residuals: Sequence[Residuals], noise: NoiseModel, ticks: Ticks) -> tuple[Change, ...]:
    """Return the spans in which fixes err smoothly, by two odometries."""
    size = ticks.stamp_ns.size
    changes: list[Change] = []
    for each in sorted(find_fix_excursions(residuals, noise), key=lambda each: each.start_ns):
        first, last = np.searchsorted(ticks.stamp_ns, (each.start_ns, each.end_ns)).clip(0, size).tolist()
        off_m = abs(each.change)
        if changes and first < (changes[-1].last or size):
            before = changes.pop()
            first, last, off_m = before.first, max(last, before.last or size), max(off_m, before.size)
        changes.append(Change("wander", state.FIX, first, None if last >= size else last, off_m))
    return tuple(changes)
