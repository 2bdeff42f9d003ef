"""What may have happened where sensors contradict each other for a while: hypotheses, each scored by the evidence of all measurements.

A hypothesis is a set of changes. A change makes one block of the state uncertain at a tick, and where it ends makes it what it was: fixes
are off by a constant, the antenna was moved, a clock stepped, a gyroscope's bias jumped, the scale of an odometry changed, the robot was
carried, the frame of a pose turned, a sensor is useless for a while. The scale of an odometry may also vary much, throughout. A step of
fixes makes them uncertain on both sides, since nothing shows which side is right. Each hypothesis runs the filter
over the same measurements, predicted whether they are used or not; its score is the log likelihood, with what lies beyond the gate counted
as the gate, less a cost by kind. The changes that explain most are found one after the other; hypotheses that are nearly as good widen the
deviations where they differ.

Blame is never what is left when a sensor is ignored: without fixes everything is explained.

Two candidates need no search. Smooth excursions of fixes, which no gate sees, show in windows of the pairs' residuals that are far beyond
the noise of the run: a step at t is beyond in every window that holds t, an excursion only in windows as long as itself. A jump of the
gyroscope's bias shows in the turns of camera and wheels.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion import state
from tcpipe.fusion.densities import GaussMarkov, NoiseModel
from tcpipe.fusion.filter_kernel import ACCEPTED, NONE, REJECTED, Tests
from tcpipe.fusion.level_motion import find_turn_roles, get_turn_rates
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.fusion.pair_residuals import ACROSS, ALONG, Residuals, align_turns
from tcpipe.fusion.parameters import FIX_AXES, Event
from tcpipe.fusion.signals import compute_interval_means, compute_seconds, is_covered
from tcpipe.fusion.ticks import Pass, Ticks
from tcpipe.robust import estimate_robust_std

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

    ``size``: how far fixes are off [m]. ``jump``: of a gyroscope, where its turns show it.
    """

    kind: str
    role: int
    first: int
    last: int | None = None
    size: float = 0.0
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
            yield Event(self.first, place, count, std, is_new=self.kind == "step")
            if self.last is not None:
                yield Event(self.last, place, count, std, is_new=place == state.FIX_OFFSET)

    def alter_ticks(self, ticks: Ticks, *, drifts: bool) -> Ticks:
        """Return the ticks as they are under the change; if ``drifts``, fixes may also drift before and after a step."""
        inputs = ticks.inputs
        if self.kind in {"noise", "wander"} or (self.kind == "step" and drifts):
            kept, noise, variance = inputs.fix_kept.copy(), inputs.fix_noise.copy(), ticks.fix_variance_m2.copy()
            first, last = self.first, kept.size if self.last is None else self.last
            if self.kind == "noise":
                kept[:] = np.exp(-inputs.period_s / _NOISE_S)
            elif self.kind == "step":
                around = round(_AROUND_STEP_S / inputs.period_s)
                first, last = max(first - around, 0), min(first + around, kept.size)
            variance[first:last] = np.maximum(variance[first:last], np.square(self.size * FIX_AXES))
            if last < kept.size:
                kept[last] *= np.sqrt(variance[last, 0] / variance[last - 1, 0])
            earlier = np.concatenate((variance[:1], variance[:-1]))
            noise[first:] = np.maximum(variance - kept[:, None] ** 2 * earlier, 0.0)[first:]
            return replace(ticks, inputs=inputs._replace(fix_kept=kept, fix_noise=noise), fix_variance_m2=variance)
        if self.jump is not None:
            value, spread = inputs.value.copy(), inputs.variance.copy()
            value[self.first, state.STATIONARY_RATE] = 0.0, 0.0, self.size
            spread[self.first, state.STATIONARY_RATE] = _UNMEASURED, _UNMEASURED, self.jump.std**2
            return replace(ticks, inputs=inputs._replace(value=value, variance=spread))
        return ticks


_AROUND_STEP_S = 40.0
"""How long before and after a step fixes may drift by as much [s]: corrections age, and ambiguities are resolved slowly."""
_NOISE_S = 1.5
"""Correlation time of a larger noise of fixes [s]: reflected signals change as the antenna moves by a metre."""
_SLOW_S = 60.0
"""Correlation time of a slow error of fixes [s]: the paths of reflected signals change with the satellites."""
_UNMEASURED = 1e3  # rad²/s²
_BLOCKS: dict[tuple[str, int], tuple[tuple[int, int, float], ...]] = {
    ("offset", state.FIX): ((state.FIX_OFFSET, 3, 1.0),),
    ("step", state.FIX): ((state.FIX_OFFSET, 3, 0.0),),  # drawn from the prior that `Hypothesis.alter_noise` gives
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
    "noise": 0.0,
    "step": 12.0,
    "slow": 0.0,
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
    """Set of changes with its score [nat], and the number of changes in a rejected set that explains clearly more."""

    changes: tuple[Change, ...]
    score: float
    rival_change_count: int = 0

    @property
    def events(self) -> tuple[Event, ...]:
        """What all changes change in the state, in order of time."""
        return tuple(sorted((e for c in self.changes for e in c.list_events()), key=lambda event: event.tick))

    def alter_ticks(self, ticks: Ticks, *, drifts: bool = False) -> Ticks:
        """Return the ticks as they are under all changes; ``drifts`` is False while hypotheses are compared."""
        for change in self.changes:
            ticks = change.alter_ticks(ticks, drifts=drifts)
        return ticks

    def alter_noise(self, noise: NoiseModel) -> NoiseModel:
        """Return the noise of the sensors as it is under all changes."""
        roles = [ROLES[change.role] for change in self.changes if change.kind == "varies"]
        varying = {role: replace(noise.odometries[role], correlated=_VARYING) for role in roles}
        # Either side of a step may be right: both are off by half of it, 1σ, for as long as they last.
        step_m, slow_m = (
            max((change.size for change in self.changes if change.kind == kind), default=0.0)
            for kind in ("step", "slow")
        )
        offset = GaussMarkov(max(0.5 * step_m, slow_m) ** 2, _SLOW_S if slow_m else np.inf)
        return replace(noise, odometries={**noise.odometries, **varying}, offset=offset)

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
                best = replace(top, changes=(*top.changes[:-1], replace(change, kind="step")))
            tests = run(best, 0, size).tests
        elif number > 0:
            break
    rivals = [each for each in found if best.score - _NEAR < each.score and each.changes != best.changes]
    if best.changes:
        best, tests = _drop_needless_changes(best, tests, run, gates)
        best = replace(best, changes=(*best.changes, *find_steps(tests, period_s)))
    return [best, *sorted(rivals, key=lambda each: -each.score)[:_MOST_RIVALS]] if best.changes or rivals else []


def _drop_needless_changes(
    best: Hypothesis, tests: Tests, run: Callable[[Hypothesis, int, int], Pass], gates: Floats
) -> tuple[Hypothesis, Tests]:
    """Return a hypothesis without the changes that later ones explain as well, and its tests."""
    size = tests.verdict.shape[0]
    for change in best.changes[:-1]:
        fewer = replace(best, changes=tuple(each for each in best.changes if each is not change))
        of_fewer = run(fewer, 0, size).tests
        lost = compute_evidence(tests, gates, 0, size) - compute_evidence(of_fewer, gates, 0, size) - change.cost
        if lost < _SURELY:
            best, tests = replace(fewer, score=best.score - lost), of_fewer
    return best, tests


def _is_possible(change: Change, best: Hypothesis, active: Collection[int]) -> bool:
    """Return whether the state has the errors that a change is of, and a scale that it lets vary does not vary already."""
    if change.kind == "varies" and any((each.kind, each.role) == ("varies", change.role) for each in best.changes):
        return False
    return all(e in active for place, count, _ in change.blocks for e in range(place, place + count))


def find_steps(tests: Tests, period_s: float) -> list[Change]:
    """Return a step of the fixes wherever they are rejected for long."""
    return [
        Change("step", state.FIX, each.first, size=float(np.linalg.norm(_find_innovation_m(each, tests))))
        for each in find_suspects(tests, period_s)
        if each.role == state.FIX
    ]


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
    for kind, at in (("antenna", first), ("clock", first), ("step", first), ("gyroscope", silent), ("pose", silent)):
        yield Change(kind, role, at, size=size_m)


def _find_innovation_m(suspect: Suspect, tests: Tests) -> Floats:
    """Return the median of the rejected fixes' innovations, east and north."""
    span = slice(suspect.first, suspect.last)
    rejected = tests.fix_innovation[span][tests.verdict[span, state.FIX] == REJECTED]
    return np.asarray(np.median(rejected[:, :2], axis=0))


# Candidates that need no search

_GATE = 4.0  # standard deviations
_FEWEST_WINDOWS = 3  # overlapping windows
_SHORTEST_S = 4.0  # single fixes off are for the gate
_LEAST = 1e-6  # m² or rad²
_ALIKE_CHANGES = 2.0
_LONG_S = 8.0


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
        each for each in residuals if GNSS in each.pair and each.axis in {ALONG, ACROSS} and each.time_s >= _SHORTEST_S
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
    return [one for one in found if one.time_s > _LONG_S and any(_is_confirmed(one, other) for other in found)]


def _is_confirmed(one: EventCandidate, other: EventCandidate) -> bool:
    overlap_ns = min(one.end_ns, other.end_ns) - max(one.start_ns, other.start_ns)
    is_other = other.pair != one.pair and other.axis == one.axis and overlap_ns > 0
    return (
        is_other
        and one.change * other.change > 0.0
        and abs(other.change) < _ALIKE_CHANGES * abs(one.change) < _ALIKE_CHANGES**2 * abs(other.change)
    )


def _find_runs(each: Residuals, noise: NoiseModel) -> Iterator[EventCandidate]:
    """Yield each run of overlapping windows beyond the noise."""
    densities = noise.densities.get(each.axis, {})
    variance = _LEAST + sum((densities.get(name, 0.0) * factor for name, factor in each.features.items()), start=0.0)
    z = each.value / np.sqrt(variance)
    beyond = np.flatnonzero(np.abs(z) > _GATE)
    if not beyond.size:
        return
    overlaps = each.start_ns[beyond][1:] < each.end_ns[beyond][:-1]
    for rows in np.split(beyond, np.flatnonzero(~overlaps) + 1):
        if rows.size < _FEWEST_WINDOWS:
            continue
        worst = rows[np.argmax(np.abs(z[rows]))]
        start_ns = int(each.start_ns[rows[0]])
        middle_ns = 0.5 * ((each.start_ns[rows] - start_ns) + (each.end_ns[rows] - start_ns))
        at_ns = start_ns + round(float(np.average(middle_ns, weights=z[rows] ** 2)))
        yield EventCandidate(
            each.pair, each.axis, each.time_s, start_ns, int(each.end_ns[rows[-1]]), at_ns,
            float(each.value[worst]), float(abs(z[worst])),
        )  # fmt: skip


_STEP_S = 0.5
_BLOCK_S = 10.0
_AROUND_S, _LEAST_S = 60.0, 15.0  # compared before and after a jump
_FAR = 4.0  # standard deviations beyond which a turn is a slip
_JUMPS = 8.0  # standard deviations
_LEAST_JUMP_RADPS = 0.003
_MOST_GAIN = 50.0
_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class TurnJump:
    """A jump of the gyroscope's bias, by the turns of an odometry.

    Attributes
    ----------
    at_ns, time_std_s : [ns] when, and how well that is known [s].
    change, std : [rad/s].
    gain : log likelihood against none.
    """

    at_ns: int
    time_std_s: float
    change: float
    std: float
    gain: float


def find_turn_jump(m: Measurements) -> TurnJump | None:
    """Return the largest jump of the gyroscope's vertical bias that turns of camera or wheels show; None if there is none."""
    roles = find_turn_roles(m)
    if m.imu is None or len(roles) < 2:
        return None
    found = [jump for role in roles if role != IMU for jump in _find_jumps(m, role)]
    return max(found, key=lambda jump: abs(jump.change) / jump.std, default=None)


def _find_jumps(m: Measurements, role: str) -> Iterator[TurnJump]:
    """Yield the largest jump by one odometry."""
    sources = [get_turn_rates(m, each) for each in (IMU, role)]
    begin_ns, end_ns = (
        max(int(stamp_ns[0]) for stamp_ns, _ in sources),
        min(int(stamp_ns[-1]) for stamp_ns, _ in sources),
    )
    edges_ns = np.arange(begin_ns, end_ns, round(_STEP_S * 1e9))
    around, least, block = (round(each / _STEP_S) for each in (_AROUND_S, _LEAST_S, _BLOCK_S))
    if edges_ns.size <= 2 * least + block:
        return
    edges_s = compute_seconds(edges_ns, begin_ns)
    turns = []
    for stamp_ns, rate in sources:
        mean = compute_interval_means(compute_seconds(stamp_ns, begin_ns), rate[:, 2:], edges_s[:-1], edges_s[1:])[:, 0]
        turns.append(np.where(is_covered(stamp_ns, edges_ns[:-1], edges_ns[1:]), mean, np.nan) * _STEP_S)
    known = np.isfinite(turns).all(axis=0)
    if known.sum() <= 2 * least + block:
        return
    turn = np.cumsum(np.stack(turns, -1)[known], axis=0)
    rows = np.arange(least, len(turn) - least)
    before, after = np.minimum(rows, around), np.minimum(len(turn) - 1 - rows, around)
    jumped = np.zeros(len(turn))
    for _ in range(_ROUNDS):  # the scale is fitted without the jump
        aligned = align_turns(turn - np.column_stack((jumped, 0.0 * jumped)), block) + jumped
        off = np.diff(aligned) / _STEP_S
        off -= np.median(off)
        scatter = estimate_robust_std(off) + 1e-9
        off = off.clip(-_FAR * scatter, _FAR * scatter)
        total = np.concatenate(([0.0], np.cumsum(off)))
        step = (total[rows + after] - total[rows]) / after - (total[rows] - total[rows - before]) / before
        blocks = off[: off.size // block * block].reshape(-1, block).mean(1)
        # Differences of neighbours hold no jump, but for one of them.
        density = estimate_robust_std(np.diff(blocks)) ** 2 / 2.0 * block
        std = np.sqrt(density * (1.0 / before + 1.0 / after)) + 1e-9
        top = int(np.argmax(np.abs(step) / std))
        change, spread = float(step[top]), float(std[top])
        jumped = change * _STEP_S * np.arange(-rows[top], len(turn) - rows[top]).clip(0)
    if abs(change) < max(_JUMPS * spread, _LEAST_JUMP_RADPS):
        return
    time_std_s = max(_STEP_S, 2.0 * density * _STEP_S / change**2)
    at_ns = int(edges_ns[:-1][known][rows[top] + 1])
    yield TurnJump(at_ns, time_std_s, change, spread, min(_MOST_GAIN, 0.5 * (change / spread) ** 2))
