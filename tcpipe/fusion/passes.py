"""Passes over the ticks of a section: forward, and backward as a smoother, which shows the evidence of events on its way.

Memory is bounded: the forward pass keeps a checkpoint for each block of ticks; on the way back each block is filtered once more, this
time with everything kept. The second filter repeats the arithmetic of the first exactly, gates included.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion import state
from tcpipe.fusion.changes import EVENTS, Change
from tcpipe.fusion.filter_kernel import Memory, Model, Tests, allocate_steps, filter_ticks
from tcpipe.fusion.measurements import DISPLACEMENT_LAGS_S
from tcpipe.fusion.smoother_kernel import (
    LARGEST_EVENT,
    SELDOM,
    Candidates,
    Smoothed,
    make_adjoint,
    smooth_ticks,
)
from tcpipe.fusion.ticks import Pass, Ticks

Floats = NDArray[np.float64]

_BLOCK = 1024
"""Ticks between checkpoints."""
_MIN_EVENT_GAIN = 20.0
"""Log evidence [nat] by which an event must explain more, beyond its cost: the best of a section's ticks reaches 12 by chance."""
_SETTLING_S = 1.0
"""Time after the start in which an event is an error of the start [s]."""


def make_tests(size: int) -> Tests:
    """Return tests to be filled."""
    shape = size, state.KINDS
    return Tests(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.int8), np.full((size, 3), np.nan))


def _list_blocks(size: int) -> list[tuple[int, int]]:
    """Return first and last tick, the latter excluded, of each block."""
    return list(pairwise([*range(0, size, _BLOCK), size]))


def filter_section(ticks: Ticks, model: Model, start: Memory, *, until: int | None = None) -> Pass:
    """Return the forward pass from a start, over all ticks or those before ``until``."""
    size = min(until or ticks.stamp_ns.size, ticks.stamp_ns.size)
    made = Pass(ticks, model, [], make_tests(size), np.zeros((size, state.NX)), start.copy())
    empty = allocate_steps(0, model.active.size)
    for first, last in _list_blocks(size):
        made.checkpoints.append(made.last.copy())
        filter_ticks(first, last, ticks.inputs, model, made.last, False, empty, made.tests, made.states)
    return made


def smooth_section(made: Pass, *, with_displacements: bool = True) -> tuple[Smoothed, tuple[Change, ...]]:
    """Return the smoothed estimate of a forward pass, and events that explain much more of it than they cost, the most likely first."""
    size, n = made.states.shape[0], made.model.active.size
    lags = np.array([round(lag_s / made.ticks.inputs.period_s) for lag_s in DISPLACEMENT_LAGS_S])
    adjoint = make_adjoint(n, int(lags.max()) if with_displacements else 0)
    possible, candidates = _list_candidates(made)
    out = Smoothed(
        np.zeros_like(made.states),
        np.zeros((size, 5)),
        np.full((size, lags.size), np.nan),
        np.zeros((-(-size // SELDOM), n)),
    )
    steps, again, filtered = allocate_steps(min(size, _BLOCK), n), make_tests(size), np.zeros_like(made.states)
    for (first, last), memory in zip(reversed(_list_blocks(size)), reversed(made.checkpoints), strict=True):
        steps.used[:] = False
        filter_ticks(first, last, made.ticks.inputs, made.model, memory.copy(), True, steps, again, filtered)
        smooth_ticks(first, last, made.ticks.inputs, made.model, steps, filtered, lags, adjoint, candidates, out)
    gains = candidates.best[:, 0] - np.array([EVENTS[key].cost for key in possible])
    events = []
    for row in np.argsort(-gains, kind="stable"):
        (kind, role), count, (_, tick, *change) = possible[row], candidates.sizes[row], candidates.best[row].tolist()
        event = Change(
            kind,
            role,
            int(tick) if np.isfinite(tick) else 0,
            size=float(np.linalg.norm(change[: min(count, 3)])),
            impulse=tuple(change[:count]),
            impulse_std=tuple(change[LARGEST_EVENT : LARGEST_EVENT + count]),
        )
        if gains[row] >= _MIN_EVENT_GAIN and event.size >= EVENTS[kind, role].least:
            events.append(event)
    return out, tuple(events)


def _list_candidates(made: Pass) -> tuple[list[tuple[str, int]], Candidates]:
    """Return the events whose errors the model has."""
    position = {int(error): place for place, error in enumerate(made.model.active)}
    possible = [key for key, kind in EVENTS.items() if all(error in position for error, _ in kind.block)]
    shape = len(possible), LARGEST_EVENT
    places, stds, sizes = np.zeros(shape, np.int64), np.ones(shape), np.zeros(shape[0], np.int64)
    for row, key in enumerate(possible):
        block = EVENTS[key].block
        sizes[row] = len(block)
        places[row, : len(block)], stds[row, : len(block)] = zip(*((position[e], std) for e, std in block), strict=True)
    earliest, best = round(_SETTLING_S / made.ticks.inputs.period_s), np.full((shape[0], 2 + 2 * shape[1]), -np.inf)
    return possible, Candidates(places, stds, sizes, earliest, best)
