"""Where something may have happened: windows whose residual is far beyond the noise of the run, as plain data.

A candidate says when and between which sensors, never which of them errs. A step at t is beyond in every window that holds t; a wrong span
shows a step at either end; a smooth excursion shows only in windows as long as itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.fusion.densities import NoiseModel
from tcpipe.fusion.level_motion import find_turn_roles, get_turn_rates
from tcpipe.fusion.measurements import GNSS, IMU, Measurements
from tcpipe.fusion.pair_residuals import ACROSS, ALONG, TURN, Residuals, align_turns
from tcpipe.fusion.signals import compute_interval_means, compute_seconds, is_covered
from tcpipe.robust import estimate_robust_std

_GATE = 4.0  # standard deviations
_FEWEST = 3  # overlapping windows
_SHORTEST_S = 4.0  # single fixes off are for the gate
_LEAST = 1e-6  # m² or rad²
_ALIKE = 2.0
_LONG_S = 8.0


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


def find_fix_excursions(residuals: Sequence[Residuals], noise: NoiseModel) -> tuple[EventCandidate, ...]:
    """Return where fixes moved otherwise than two odometries alike, which did not slip at the same time."""
    of_fixes = [
        each for each in find_event_candidates(residuals, noise) if GNSS in each.pair and each.axis in {ALONG, ACROSS}
    ]
    # Shorter ones may show only that the antenna is elsewhere than stated while the robot turns.
    long = [each for each in of_fixes if each.time_s > _LONG_S]
    return tuple(one for one in long if any(_is_confirmed(one, other) for other in of_fixes))


def _is_confirmed(one: EventCandidate, other: EventCandidate) -> bool:
    overlap_ns = min(one.end_ns, other.end_ns) - max(one.start_ns, other.start_ns)
    is_other = other.pair != one.pair and other.axis == one.axis and overlap_ns > 0
    return (
        is_other
        and one.change * other.change > 0.0
        and abs(other.change) < _ALIKE * abs(one.change) < _ALIKE**2 * abs(other.change)
    )


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
