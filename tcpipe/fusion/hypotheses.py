"""What may have happened where sensors contradict each other for a while: hypotheses, each scored by the evidence of all measurements.

A hypothesis is a set of changes. A change makes one block of the state uncertain at a tick, and where it ends makes it what it was: fixes
are off by a constant, the antenna was moved, a clock stepped, a gyroscope's bias jumped, the scale of an odometry changed, the robot was
carried, the frame of a pose turned, a sensor is useless for a while. The scale of an odometry may also vary much, throughout. Fixes do not
err for ever: where nothing tells when they did, their lasting error is taken to be larger around a step. Each hypothesis runs the filter
over the same measurements, predicted whether they are used or not; its score is the log likelihood, with what lies beyond the gate counted
as the gate, less a cost by kind. The changes that explain most are found one after the other; hypotheses that are nearly as good widen the
deviations where they differ.

Blame is never what is left when a sensor is ignored: without fixes everything is explained.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion import state
from tcpipe.fusion.densities import GaussMarkov, NoiseModel
from tcpipe.fusion.event_candidates import EventCandidate, TurnJump
from tcpipe.fusion.filter_kernel import ACCEPTED, NONE, REJECTED, Tests
from tcpipe.fusion.measurements import DOPPLER, GNSS, VISUAL, WHEELS
from tcpipe.fusion.parameters import Event
from tcpipe.fusion.ticks import Pass, Ticks

Floats = NDArray[np.float64]

ROLES = {
    state.WHEELS: WHEELS,
    state.VISUAL: VISUAL,
    state.DOPPLER: DOPPLER,
    state.FIX: GNSS,
    state.ATTITUDE: GNSS,
}
"""Sensors by the kind of their measurements."""
POSSIBLE = (
    *range(state.ARM, state.FIX_OFFSET + 3),
    state.WHEEL_SCALE,
    state.VISUAL_SCALE,
    state.WHEEL_LAG,
    state.VISUAL_LAG,
)
"""Errors that changes change, beside those that always vary."""
_FEWEST = 5  # rejections in a row
_LASTS_S = {state.FIX: 1.0, state.WHEELS: 10.0, state.VISUAL: 10.0, state.ATTITUDE: 10.0}  # wheels slip for seconds
_TOGETHER_S = 5.0
_MOST_CHANGES = 3
_CARRIED_M = 1.0  # a jump that is smaller is one of the fixes
_ERR_FOR_S = 40.0
_SIDE = 60.0  # log likelihood by which fixes err rather before a step than after it
_MUCH_SHORTER = 0.25
_ALIKE = 0.4  # of the size of an innovation
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
    """One change: its kind, the sensor it is of, and its first and last tick (None: to the end of the section).

    ``size``: how far fixes are off [m]; ``steps_at``: the tick at which their error changes at once. ``jump``: of a gyroscope, where its
    turns tell it.
    """

    kind: str
    role: int
    first: int
    last: int | None = None
    size: float = 0.0
    steps_at: int | None = None
    jump: TurnJump | None = None

    @property
    def cost(self) -> float:
        """Log of how unlikely it is beforehand, less what the turns tell of it."""
        return _COSTS[self.kind] + (0.0 if self.last is None else 2.0) - (0.0 if self.jump is None else self.jump.gain)

    @property
    def blocks(self) -> tuple[tuple[int, int, float], ...]:
        """Errors that it changes: the first, their number, and by how much [their unit]."""
        blocks = _BLOCKS.get((self.kind, self.role), ())
        if self.jump is not None:  # the turn is not known while it is not known when the bias jumped
            return (*blocks, (state.THETA + 2, 1, abs(self.jump.change) * self.jump.time_std_s))
        return blocks

    def list_events(self) -> Iterator[Event]:
        """Yield what it changes in the state."""
        for place, count, std in self.blocks:
            yield Event(self.first, place, count, std)
            if self.last is not None:
                is_new = place == state.FIX_OFFSET
                yield Event(self.last, place, count, 0.0 if is_new else std, is_new)

    def alter_ticks(self, ticks: Ticks) -> Ticks:
        """Return the ticks as they are under the change."""
        inputs = ticks.inputs
        if self.kind == "wander":
            kept, noise, variance = inputs.fix_kept.copy(), inputs.fix_noise.copy(), ticks.fix_variance_m2.copy()
            span = slice(self.first, self.last)
            variance[span] = np.maximum(variance[span], np.square(self.size * _ERRS_ALONG))
            if self.steps_at is not None:
                kept[self.steps_at] = 0.0
            if self.last is not None:
                kept[self.last] *= np.sqrt(variance[self.last, 0] / variance[self.last - 1, 0])
            earlier = np.concatenate((variance[:1], variance[:-1]))
            noise[self.first :] = np.maximum(variance - kept[:, None] ** 2 * earlier, 0.0)[self.first :]
            return replace(ticks, inputs=inputs._replace(fix_kept=kept, fix_noise=noise), fix_variance_m2=variance)
        if self.jump is not None:
            value, spread = inputs.value.copy(), inputs.variance.copy()
            value[self.first, state.STATIONARY_RATE] = 0.0, 0.0, self.size
            spread[self.first, state.STATIONARY_RATE] = _UNMEASURED, _UNMEASURED, self.jump.std**2
            return replace(ticks, inputs=inputs._replace(value=value, variance=spread))
        return ticks


_ERRS_ALONG = np.array([1.0, 1.0, 1.7])  # heights err more
_UNMEASURED = 1e3  # rad²/s²
_BLOCKS: dict[tuple[str, int], tuple[tuple[int, int, float], ...]] = {
    ("offset", state.FIX): ((state.FIX_OFFSET, 3, 1.0),),
    ("antenna", state.FIX): ((state.ARM, 3, 0.3),),
    ("clock", state.FIX): ((state.FIX_LAG, 1, 0.3),),
    ("clock", state.WHEELS): ((state.WHEEL_LAG, 1, 0.3),),
    ("clock", state.VISUAL): ((state.VISUAL_LAG, 1, 0.3),),
    ("gyroscope", state.FIX): ((state.GYRO_BIAS, 3, 0.03),),
    ("scale", state.WHEELS): ((state.WHEEL_SCALE, 1, 0.3),),
    ("scale", state.VISUAL): ((state.VISUAL_SCALE, 1, 0.3),),
    ("varies", state.WHEELS): ((state.WHEEL_SLIP, 1, 0.0),),  # not by an event, but all the time
    ("varies", state.VISUAL): ((state.VISUAL_SLIP, 1, 0.0),),
    ("frame", state.ATTITUDE): ((state.POSE_FRAME, 3, 0.3),),
    ("pose", state.FIX): ((state.RHO, 3, 2.0), (state.THETA, 3, 0.1), (state.U, 3, 0.5)),
}
_VARYING = GaussMarkov(0.1**2, 5.0)
"""A scale that changes by a tenth with slope, ground or load."""
_COSTS = {
    "offset": 12.0,
    "antenna": 40.0,
    "clock": 14.0,
    "gyroscope": 16.0,
    "scale": 10.0,
    "varies": 40.0,
    "frame": 14.0,
    "pose": 20.0,
    "wander": 12.0,
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

    def alter_ticks(self, ticks: Ticks) -> Ticks:
        """Return the ticks as they are under all changes."""
        for change in self.changes:
            ticks = change.alter_ticks(ticks)
        return ticks

    def alter_noise(self, noise: NoiseModel) -> NoiseModel:
        """Return the noise of the sensors as it is under all changes."""
        roles = [ROLES[change.role] for change in self.changes if change.kind == "varies"]
        varying = {role: replace(noise.odometries[role], scale=_VARYING) for role in roles}
        return replace(noise, odometries={**noise.odometries, **varying})

    @property
    def ignored(self) -> tuple[tuple[int, int, int], ...]:
        """Measurements that are not used: (kind, first tick, last tick)."""
        return tuple(
            (c.role, c.first, 1 << 60 if c.last is None else c.last) for c in self.changes if c.kind == "useless"
        )


def find_suspects(tests: Tests, period_s: float) -> list[Suspect]:
    """Return where sensors are rejected for long, in order of time; last, what is much shorter than the longest."""
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
    longest = max((each.last - each.first for each in found), default=0)
    return sorted(found, key=lambda each: ((each.last - each.first) < _MUCH_SHORTER * longest, each.first))


def compute_evidence(tests: Tests, gates: Floats, first: int, last: int) -> float:
    """Return the log likelihood of the measurements of some ticks; one beyond the gate counts as the gate."""
    kinds = [state.WHEELS, state.VISUAL, state.DOPPLER, state.FIX, state.ATTITUDE]
    nis = np.minimum(tests.nis[first:last, kinds], gates[kinds])
    return float(-0.5 * np.nansum(nis + tests.log_det[first:last, kinds]))


def explain(
    made: Pass, run: Callable[[Hypothesis, int, int], Pass], active: Collection[int], jump: TurnJump | None = None
) -> list[Hypothesis]:
    """Return the hypotheses that explain best where sensors contradict each other, the best first; none where they do not.

    ``made`` is the pass without any change, in which no rejected fix is followed; ``run`` makes that under a hypothesis between two ticks
    (its rows before the first mean nothing). Only errors that are ``active`` can change. A ``jump`` that the gyroscope's turns show is
    tried first; then one contradiction after the other is explained.
    """
    period_s, gates, size = made.ticks.inputs.period_s, made.model.gates, made.states.shape[0]
    best, tests, found = Hypothesis((), 0.0), made.tests, [Hypothesis((), 0.0)]
    for number in range(_MOST_CHANGES + 1):
        suspects = find_suspects(tests, period_s)
        if number == 0:
            changes = [] if jump is None else [_make_jump(made, jump)]
            end = size
        elif suspects:
            changes, end = list(_list_changes(suspects[0], suspects, tests, period_s)), suspects[0].last
        else:
            break
        last = min(size, end + round(_HORIZON_S / period_s))
        tried: list[Hypothesis] = []
        for change in changes:
            if _is_possible(change, best, active):
                changed = Hypothesis((*best.changes, change), 0.0)
                first = min(c.first for c in changed.changes)
                plain = compute_evidence(tests, gates, first, last)
                gained = compute_evidence(run(changed, first, last).tests, gates, first, last) - plain - change.cost
                tried.append(replace(changed, score=best.score + gained))
        found += tried
        top = max(tried, key=lambda each: each.score, default=best)
        # Fixes that are rejected have to be explained: the filter would follow them in the end.
        if top.score >= best.score + _SURELY or (tried and number and suspects[0].role == state.FIX):
            found.remove(top)
            best = top
            if (change := top.changes[-1]).kind == "pose" and change.size < _CARRIED_M:
                # Such a step is one of the fixes, which err before or after it; if neither is more likely, around it.
                wanders = _list_wanders(change.first, change.size, size, period_s)
                around, *sides = (replace(top, changes=(*top.changes[:-1], each)) for each in wanders)
                begin = min(c.first for c in around.changes)
                likely = [compute_evidence(run(each, begin, last).tests, gates, begin, last) for each in sides]
                best = around if abs(likely[0] - likely[1]) < _SIDE else sides[int(np.argmax(likely))]
            tests = run(best, 0, size).tests
        elif number > 0:
            break
    if any(each.kind == "varies" for each in best.changes):
        best, tests = _drop_changes(best, tests, gates, run)
    left = [each for each in find_suspects(tests, period_s) if each.role == state.FIX] if best.changes else []
    rivals = [each for each in found if best.score - _NEAR < each.score and each.changes != best.changes]
    off_m = [float(np.linalg.norm(_find_innovation_m(each, tests))) for each in left]
    errs = [next(_list_wanders(each.first, size_m, size, period_s)) for each, size_m in zip(left, off_m, strict=True)]
    best = replace(best, changes=(*best.changes, *errs))
    return [best, *sorted(rivals, key=lambda each: -each.score)[:_MOST_RIVALS]] if best.changes or rivals else []


def _is_possible(change: Change, best: Hypothesis, active: Collection[int]) -> bool:
    """Return whether the state has the errors that a change is of, and a scale that it lets vary does not vary already."""
    if change.kind == "varies" and any((each.kind, each.role) == ("varies", change.role) for each in best.changes):
        return False
    return all(e in active for place, count, _ in change.blocks for e in range(place, place + count))


def _drop_changes(
    best: Hypothesis, tests: Tests, gates: Floats, run: Callable[[Hypothesis, int, int], Pass]
) -> tuple[Hypothesis, Tests]:
    """Return the hypothesis without the changes that a scale that varies explains as well, and its tests.

    Such a scale varies throughout, so it also explains what earlier changes were found for.
    """
    size, first = tests.verdict.shape[0], min(each.first for each in best.changes)
    for change in [each for each in best.changes if each.kind not in {"varies", "wander"}]:
        others = replace(best, changes=tuple(each for each in best.changes if each != change))
        rest = run(others, 0, size).tests
        lost = compute_evidence(tests, gates, first, size) - compute_evidence(rest, gates, first, size) - change.cost
        if lost < _SURELY:
            best, tests = replace(others, score=best.score - lost), rest
    return best, tests


def _list_wanders(tick: int, off_m: float, size: int, period_s: float) -> Iterator[Change]:
    """Yield changes by which fixes err around a tick at which they step, before it, and after it."""
    length = round(_ERR_FOR_S / period_s)
    first, last = max(0, tick - length), None if tick + length >= size else tick + length
    yield Change("wander", state.FIX, first, last, off_m, tick)
    yield Change("wander", state.FIX, first, tick, off_m, tick)
    yield Change("wander", state.FIX, tick, last, off_m, tick)


def make_excursions(made: Pass, candidates: Sequence[EventCandidate]) -> list[Hypothesis]:
    """Return the hypothesis that fixes err in the spans of candidates; none without candidates."""
    stamp_ns, size = made.ticks.stamp_ns, made.states.shape[0]
    changes: list[Change] = []
    for each in sorted(candidates, key=lambda each: each.start_ns):
        first, last = np.searchsorted(stamp_ns, (each.start_ns, each.end_ns)).clip(0, size).tolist()
        off_m = abs(each.change)
        if changes and first < (changes[-1].last or size):
            before = changes.pop()
            first, last, off_m = before.first, max(last, before.last or size), max(off_m, before.size)
        changes.append(Change("wander", state.FIX, first, None if last >= size else last, off_m))
    return [Hypothesis(tuple(changes), 0.0)] if changes else []


def _make_jump(made: Pass, jump: TurnJump) -> Change:
    """Return the change of a gyroscope whose bias is known afterwards: what it was before, and how far it jumped."""
    first = int(np.searchsorted(made.ticks.stamp_ns, jump.at_ns).clip(1, made.states.shape[0] - 1))
    before = float(made.states[first - 1, state.GYRO_BIAS + 8])
    return Change("gyroscope", state.FIX, first, size=before + jump.change, jump=jump)


def compute_weights(hypotheses: Sequence[Hypothesis]) -> Floats:
    """Return how likely each hypothesis is."""
    scores = np.array([each.score for each in hypotheses]) / _TEMPER
    weights = np.exp(scores - scores.max())
    return np.asarray(weights / weights.sum())


def _list_changes(suspect: Suspect, suspects: Sequence[Suspect], tests: Tests, period_s: float) -> Iterator[Change]:
    """Yield single changes that could explain a suspect."""
    size = tests.verdict.shape[0]
    role, first, last = suspect.role, suspect.first, None if suspect.last >= size else suspect.last
    for odometry in (state.WHEELS, state.VISUAL):
        yield Change("varies", odometry, first)
    if role != state.FIX:
        if role == state.ATTITUDE:
            yield Change("frame", role, first)
        else:
            yield Change("scale", role, first, last)
            yield Change("clock", role, first)
        yield Change("useless", role, first, last)
        yield Change("gyroscope", state.FIX, first)
        return
    off_m = _find_innovation_m(suspect, tests)
    # Fixes that return to what is right contradict a track that followed them as far, the other way.
    returns = [
        each.first
        for each in suspects
        if each.role == role
        and each.first > first
        and np.linalg.norm(_find_innovation_m(each, tests) + off_m) < _ALIKE * np.linalg.norm(off_m)
    ]
    size_m = float(np.linalg.norm(off_m))
    for end in dict.fromkeys([suspect.last, *sorted(returns)[:1]]):
        if end < size:
            yield Change("offset", role, first, end, size_m)
    if last is not None:
        yield Change("useless", role, first, last)
    heard = np.flatnonzero(tests.verdict[:first, role] != NONE)
    silent = int(heard[-1]) + 1 if heard.size and (first - heard[-1]) * period_s > _TOGETHER_S else first
    for kind, at in (("antenna", first), ("clock", first), ("gyroscope", silent), ("pose", silent)):
        yield Change(kind, role, at, size=size_m)


def _find_innovation_m(suspect: Suspect, tests: Tests) -> Floats:
    """Return the median of the rejected fixes' innovations, east and north."""
    span = slice(suspect.first, suspect.last)
    rejected = tests.fix_innovation[span][tests.verdict[span, state.FIX] == REJECTED]
    return np.asarray(np.median(rejected[:, :2], axis=0))
