"""What may have happened where sensors contradict each other for a while: hypotheses, each scored by the evidence of all measurements.

A hypothesis is a set of at most three changes. A change makes one block of the state uncertain at a tick, and where it ends makes it what
it was: fixes are off by a constant, the antenna was moved, a clock stepped, a gyroscope's bias jumped, the scale of an odometry changed,
the robot was carried, a sensor is useless for a while. Each hypothesis runs the filter over the same measurements, predicted whether they
are used or not; its score is the log likelihood, with what lies beyond the gate counted as the gate, less a cost by kind. The changes
that explain most are found one after the other; hypotheses that are nearly as good widen the deviations where they differ.

Blame is never what is left when a sensor is ignored: without fixes everything is explained.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion import state
from tcpipe.fusion.filter_kernel import ACCEPTED, NONE, Tests
from tcpipe.fusion.parameters import Event

if TYPE_CHECKING:
    from tcpipe.fusion.error_state import Pass

Floats = NDArray[np.float64]

POSSIBLE = (
    *range(state.ARM, state.FIX_OFFSET + 3),
    state.WHEEL_SCALE,
    state.VISUAL_SCALE,
    state.WHEEL_LAG,
    state.VISUAL_LAG,
)
"""Errors that changes change, beside those that always vary."""
_FEWEST = 5  # rejections in a row
_LASTS_S = {state.FIX: 1.0, state.WHEELS: 10.0, state.VISUAL: 10.0}  # wheels slip for seconds
_TOGETHER_S = 5.0
_MOST_SUSPECTS = 3
_MOST_CHANGES = 3
_HORIZON_S = 60.0
"""How far the score looks beyond the last contradiction."""
_SURELY = 20.0
"""Log likelihood by which a further change must explain more, beyond its cost."""
_TEMPER = 8.0
"""Errors of measurements last: so many of them tell as much as an independent one."""
_NEAR = 2.5 * _TEMPER
_MOST_RIVALS = 2


@dataclass(frozen=True, slots=True)
class Change:
    """One change: its kind, the sensor it is of, and its first and last tick (None: to the end of the section)."""

    kind: str
    role: int
    first: int
    last: int | None = None

    @property
    def cost(self) -> float:
        """Log of how unlikely it is beforehand."""
        return _COSTS[self.kind] + (0.0 if self.last is None else 2.0)

    @property
    def blocks(self) -> tuple[tuple[int, int, float], ...]:
        """Errors that it changes: the first, their number, and by how much [their unit]."""
        return _BLOCKS.get((self.kind, self.role), ())

    def list_events(self) -> Iterator[Event]:
        """Yield what it changes in the state."""
        for place, count, std in self.blocks:
            yield Event(self.first, place, count, std)
            if self.last is not None:
                yield Event(
                    self.last, place, count, 0.0 if place == state.FIX_OFFSET else std, is_new=place == state.FIX_OFFSET
                )


_BLOCKS: dict[tuple[str, int], tuple[tuple[int, int, float], ...]] = {
    ("offset", state.FIX): ((state.FIX_OFFSET, 3, 1.0),),
    ("antenna", state.FIX): ((state.ARM, 3, 0.3),),
    ("clock", state.FIX): ((state.FIX_LAG, 1, 0.3),),
    ("clock", state.WHEELS): ((state.WHEEL_LAG, 1, 0.3),),
    ("clock", state.VISUAL): ((state.VISUAL_LAG, 1, 0.3),),
    ("gyroscope", state.FIX): ((state.GYRO_BIAS, 3, 0.03),),
    ("scale", state.WHEELS): ((state.WHEEL_SCALE, 1, 0.3),),
    ("scale", state.VISUAL): ((state.VISUAL_SCALE, 1, 0.3),),
    ("pose", state.FIX): ((state.RHO, 3, 2.0), (state.THETA, 3, 0.1), (state.U, 3, 0.5)),
}
_COSTS = {
    "offset": 12.0,
    "antenna": 14.0,
    "clock": 14.0,
    "gyroscope": 16.0,
    "scale": 10.0,
    "pose": 20.0,
    "useless": 12.0,
}


@dataclass(frozen=True, slots=True)
class Suspect:
    """Ticks between which almost all measurements of a kind are rejected, the last excluded."""

    role: int
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Changes, and their score against that of none, in nats."""

    changes: tuple[Change, ...]
    score: float

    @property
    def events(self) -> tuple[Event, ...]:
        """What all changes change in the state, in order of time."""
        return tuple(sorted((e for c in self.changes for e in c.list_events()), key=lambda event: event.tick))

    @property
    def ignored(self) -> tuple[tuple[int, int, int], ...]:
        """Measurements that are not used: (kind, first tick, last tick)."""
        return tuple(
            (c.role, c.first, 1 << 60 if c.last is None else c.last) for c in self.changes if c.kind == "useless"
        )


def find_suspects(tests: Tests, period_s: float) -> list[Suspect]:
    """Return where sensors are rejected for long, the longest first."""
    found: list[Suspect] = []
    for kind, lasts_s in _LASTS_S.items():
        rows = np.flatnonzero(tests.verdict[:, kind] != NONE)
        rejected = np.concatenate(([0], (tests.verdict[rows, kind] != ACCEPTED).astype(np.int8), [0]))
        begins, ends = np.flatnonzero(np.diff(rejected) > 0), np.flatnonzero(np.diff(rejected) < 0)
        of_kind: list[Suspect] = []
        for begin, end in zip(begins, ends, strict=True):
            first, last = int(rows[begin]), int(rows[end]) if end < rows.size else int(tests.verdict.shape[0])
            if end - begin < _FEWEST or (last - first) * period_s < lasts_s:
                continue
            if of_kind and (first - of_kind[-1].last) * period_s < _TOGETHER_S:
                first = of_kind.pop().first
            of_kind.append(Suspect(kind, first, last))
        found += of_kind
    return sorted(found, key=lambda s: s.first - s.last)[:_MOST_SUSPECTS]


def compute_evidence(tests: Tests, gates: Floats, first: int, last: int) -> float:
    """Return the log likelihood of the measurements of some ticks; one beyond the gate counts as the gate."""
    kinds = [state.WHEELS, state.VISUAL, state.DOPPLER, state.FIX]
    nis = np.minimum(tests.nis[first:last, kinds], gates[kinds])
    return float(-0.5 * np.nansum(nis + tests.log_det[first:last, kinds]))


def explain(made: Pass, run: Callable[[Hypothesis, int, int], Pass], active: Collection[int]) -> list[Hypothesis]:
    """Return the hypotheses that explain best where sensors contradict each other, the best first; none where they do not.

    ``made`` is the pass without any change, in which no rejected fix is followed; ``run`` makes that under a hypothesis between two ticks
    (its rows before the first mean nothing). Only errors that are ``active`` can change. The longest contradiction is explained first; then the longest that is
    left.
    """
    period_s, gates, size = made.ticks.inputs.period_s, made.model.gates, made.states.shape[0]
    best, tests, found = Hypothesis((), 0.0), made.tests, [Hypothesis((), 0.0)]
    for _ in range(_MOST_CHANGES):
        suspects = find_suspects(tests, period_s)
        if not suspects:
            break
        first = min([suspects[0].first, *(c.first for c in best.changes)])
        last = min(size, suspects[0].last + round(_HORIZON_S / period_s))
        plain = compute_evidence(tests, gates, first, last)
        tried: list[tuple[Hypothesis, Pass]] = []
        for change in _list_changes(suspects[0], size):
            if all(e in active for place, count, _ in change.blocks for e in range(place, place + count)):
                changed = Hypothesis((*best.changes, change), 0.0)
                again = run(changed, first, last)
                gained = compute_evidence(again.tests, gates, first, last) - plain - change.cost
                tried.append((replace(changed, score=best.score + gained), again))
        top, _ = max(tried, key=lambda each: each[0].score)
        found += [each for each, _ in tried]
        if top.score < best.score + _SURELY:
            break
        best, tests = top, run(top, 0, size).tests
    rivals = [each for each in found if best.score - _NEAR < each.score and each.changes != best.changes]
    return [best, *sorted(rivals, key=lambda each: -each.score)[:_MOST_RIVALS]] if best.changes or rivals else []


def compute_weights(hypotheses: Sequence[Hypothesis]) -> Floats:
    """Return how likely each hypothesis is."""
    scores = np.array([each.score for each in hypotheses]) / _TEMPER
    weights = np.exp(scores - scores.max())
    return np.asarray(weights / weights.sum())


def _list_changes(suspect: Suspect, size: int) -> Iterator[Change]:
    """Yield single changes that could explain a suspect."""
    role, first, last = suspect.role, suspect.first, None if suspect.last >= size else suspect.last
    if role != state.FIX:
        yield Change("scale", role, first, last)
        yield Change("clock", role, first)
        yield Change("useless", role, first, last)
        yield Change("gyroscope", state.FIX, first)
        return
    if last is not None:
        yield Change("offset", role, first, last)
        yield Change("useless", role, first, last)
    for kind in ("offset", "antenna", "clock", "gyroscope", "pose"):
        yield Change(kind, role, first)
