"""Errors of the power sensor that a log shows: offset of a current at rest, change of gain, lost sign.

A battery's voltage sags in proportion to the current: dU = -R dI over seconds, with resistance R. This needs no model
of the robot or ground, so it verifies the current: if R seems to change at once, the current's gain changed (by the
inverse); if the voltage rises with the current, the current flows back and its sign is lost. Nothing is corrected: the
errors found inflate σ.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from tcpipe.arrays import Floats, Ints, Mask, accumulate
from tcpipe.power.rails import Rail, interpolate_rail
from tcpipe.robust import estimate_robust_std
from tcpipe.tables.findings import read_threshold

_WINDOW_S = 10.0  # slower changes of the voltage are those of its charge
_BLOCK_S = 10.0
_FEWEST_BLOCKS = 6  # on either side of a change
_FEWEST_SAMPLES = 400
_CLEAR, _SURE, _GRADUAL = 20.0, 5.0, 3.0
"""Least [σ]: the resistance itself, its change, and proof that the change is not gradual (battery warms up)."""
_FEWEST_BRAKED = 5
_LIKELY = 8.0  # logarithm of a ratio of likelihoods: of three thousand segments one by chance
_SETTLED_NS = 300_000_000  # after a stop and before a start the motors still draw
_SHORTEST_HALT_NS = 1_000_000_000


def measure_rest_currents(rail: Rail, still_ns: Ints) -> Floats:
    """Return a rail's mean current in each stop of 1 s or more [A]; ``still_ns``: begin and end [ns], shape (S, 2)."""
    inner_ns = still_ns + np.array([_SETTLED_NS, -_SETTLED_NS])
    inner_ns = inner_ns[inner_ns[:, 1] - inner_ns[:, 0] >= _SHORTEST_HALT_NS]
    first, last = (np.searchsorted(rail.current.stamp_ns, at_ns) for at_ns in inner_ns.T)
    sums = accumulate(rail.current.value)
    used = last > first
    return np.asarray((sums[last] - sums[first])[used] / (last - first)[used])


def summarize_rest(rest_amp: Floats) -> tuple[float, float]:
    """Return the 0.2 and 0.8 quantile of currents at rest [A]; a fifth of the stops may be unusual (slope, stuck)."""
    low, high = np.quantile(rest_amp, (0.2, 0.8)).tolist()
    return low, high


def estimate_offset_std(rest_amp: Floats, rest_range_amp: tuple[float, float] | None, prior_amp: float) -> float:
    """Return the standard deviation of a rail's zero from its currents in stops [A], at least the prior.

    If currents in stops exceed the hardware's range by more than the prior, all offsets that explain them are equally
    likely. On a slope the drives may draw more, so that the low currents count. If stops differ, the zero has moved,
    and it is unknown which stop is right. Without a known range an offset below the current at rest is unobservable:
    half of that current is its standard deviation.
    """
    if not rest_amp.size:
        return prior_amp
    least, most = summarize_rest(rest_amp)
    if rest_range_amp is None:
        return max(least / 2.0, prior_amp)
    first, last = least - rest_range_amp[1], least - rest_range_amp[0]
    std = prior_amp
    if first > prior_amp or last < -prior_amp:
        std = max(std, ((first**2 + first * last + last**2) / 3.0) ** 0.5)
    if most - least > read_threshold("current-offset", "min_difference_amp"):
        std = max(std, (most - least) / 2.0**0.5)
    return std


@dataclass(frozen=True, slots=True)
class Sag:
    """Changes of voltage [V] and current [A] within seconds, (N,), and of the current's neighbours (other noise)."""

    stamp_ns: Ints
    volt: Floats
    amp: Floats
    neighbour_amp: Floats

    def products(self, edge_ns: Ints) -> tuple[Floats, Floats]:
        """Return the sums of voltage and of current, times the current's neighbours, up to each time, shape (E,)."""
        at = np.searchsorted(self.stamp_ns, edge_ns)
        sums = (accumulate(values * self.neighbour_amp) for values in (self.volt, self.amp))
        by_volt, by_amp = (cumulative[at] for cumulative in sums)
        return by_volt, by_amp


def measure_sag(rails: Sequence[Rail]) -> Sag | None:
    """Return how mean voltage and summed current of all rails change; None with too few samples."""
    known = [each for each in rails if len(each.stamp_ns)]
    if not known or len(known) < len(rails):
        return None
    first, last = max(each.stamp_ns[0] for each in known), min(each.stamp_ns[-1] for each in known)
    stamp_ns = known[0].current.stamp_ns
    stamp_ns = stamp_ns[(stamp_ns >= first) & (stamp_ns <= last)]
    if len(stamp_ns) < _FEWEST_SAMPLES:
        return None
    values = [interpolate_rail(each, stamp_ns) for each in known]
    if all(np.ptp(value[0]) == 0.0 for value in values):  # no measured voltage
        return None
    volt, amp = np.mean([value[0] for value in values], axis=0), np.sum([value[1] for value in values], axis=0)
    rows = max(round(_WINDOW_S * 1e9 / float(np.median(np.diff(stamp_ns)))), 3)
    volt, amp = (signal - uniform_filter1d(signal, rows, mode="nearest") for signal in (volt, amp))
    return Sag(stamp_ns, volt, amp, 0.5 * (np.roll(amp, 1) + np.roll(amp, -1)))


@dataclass(frozen=True, slots=True)
class GainChange:
    """A gain of the current that changed at ``at_ns`` [ns] by the factor ``ratio``."""

    at_ns: int
    ratio: float


def find_gain_change(sag: Sag | None) -> GainChange | None:
    """Return the clearest change of the gain, by the battery's resistance; None if it is uncertain or gradual."""
    if sag is None:
        return None
    start_ns, by_volt, weight = _split_blocks(sag)
    used = weight > 0.0
    start_ns, by_volt, weight = start_ns[used], by_volt[used], weight[used]
    count = len(weight)
    if count < 2 * _FEWEST_BLOCKS or _estimate_ohm(by_volt, weight) is None:
        return None
    resistance, place = -by_volt / weight, np.arange(count)

    def judge(first: int) -> tuple[float, float]:
        """Return how much better a step fits than a constant, and than a gradual change [variances]."""
        # The level of the current steps, too, when its gain does, which disturbs the blocks beside it.
        is_apart = np.abs(place - first + 0.5) > 1.0
        by, at = np.sqrt(weight[is_apart]), place[is_apart]
        target = resistance[is_apart] * by

        def unexplained(*columns: Floats | NDArray[np.bool_ | np.int64]) -> float:
            design = np.column_stack(columns) * by[:, None]
            return float(np.sum((target - design @ np.linalg.lstsq(design, target, rcond=None)[0]) ** 2))

        step, ones = unexplained(at < first, at >= first), np.ones(len(at))
        variance = max(step / (len(at) - 3), 1e-300)
        return (unexplained(ones) - step) / variance, (unexplained(ones, at) - step) / variance

    judged = {first: judge(first) for first in range(_FEWEST_BLOCKS, count - _FEWEST_BLOCKS + 1)}
    first = max(judged, key=lambda at: judged[at][0])
    before, after = (
        -float(by_volt[blocks].sum() / weight[blocks].sum()) for blocks in (slice(first - 1), slice(first + 1, None))
    )
    is_sure = judged[first][0] > _SURE**2 and judged[first][1] > _GRADUAL**2
    least = read_threshold("current-gain-changes", "min_change_fraction")
    if not is_sure or min(before, after) <= 0.0 or abs(before / after - 1.0) < least:
        return _compare_halves(start_ns, by_volt, weight)
    return GainChange(int(start_ns[first]), before / after)


def _compare_halves(start_ns: Ints, by_volt: Floats, weight: Floats) -> GainChange | None:
    """Return the gain of the second half of the blocks over the first; None if usual, or R is unknown in a half."""
    middle = len(weight) // 2
    first_ohm, last_ohm = (_estimate_ohm(by_volt[half], weight[half]) for half in (slice(middle), slice(middle, None)))
    if first_ohm is None or last_ohm is None:
        return None
    ratio, most = first_ohm / last_ohm, read_threshold("current-gain-changes", "max_ratio_of_halves")
    return None if 1.0 / most <= ratio <= most else GainChange(int(start_ns[middle]), ratio)


def estimate_resistance_ohm(sag: Sag | None) -> float | None:
    """Return the resistance of the battery by all of its sag [ohm]; None if it is not known to 5 %."""
    return None if sag is None else _estimate_ohm(*_split_blocks(sag)[1:])


def _split_blocks(sag: Sag) -> tuple[Ints, Floats, Floats]:
    """Return each block's start [ns], sum of voltage times current, and sum of squared current, shape (B,).

    Blocks start anew after a gap that is longer than a block.
    """
    block_ns = round(_BLOCK_S * 1e9)
    sections = np.split(sag.stamp_ns, np.flatnonzero(np.diff(sag.stamp_ns) > block_ns) + 1)
    edge_ns = np.concatenate([np.arange(each[0], each[-1], block_ns, dtype=np.int64) for each in sections])
    is_whole = np.diff(edge_ns) == block_ns
    by_volt, by_amp = (np.diff(product)[is_whole] for product in sag.products(edge_ns))
    return edge_ns[:-1][is_whole], by_volt, by_amp


def _estimate_ohm(by_volt: Floats, by_amp: Floats) -> float | None:
    """Return the resistance of the battery by blocks [ohm]; None unless the blocks' residuals show a clear sag."""
    total = float(by_amp.sum())
    if total <= 0.0:
        return None
    ohm = -float(by_volt.sum()) / total
    std_ohm = float(np.linalg.norm(by_volt + ohm * by_amp)) / total
    return ohm if ohm > _CLEAR * std_ohm else None


def find_lost_signs(sag: Sag | None, start_ns: Ints, end_ns: Ints, rise: Floats) -> Mask:
    """Return the segments whose current flows back without a sign, shape (M,); none unless several downhill do.

    Voltage and current rise together there; the likelihoods of both signs are compared. ``rise``: tangent of the slope
    along travel.
    """
    nothing = np.zeros(len(rise), dtype=bool)
    if sag is None or not len(rise):
        return nothing
    (volt_0, amp_0), (volt_1, amp_1) = sag.products(start_ns), sag.products(end_ns)
    by_volt, by_amp = volt_1 - volt_0, amp_1 - amp_0
    driven = rise > 0.0
    resistance = _estimate_ohm(by_volt[driven], by_amp[driven])
    if resistance is None:
        return nothing
    residual_volt = estimate_robust_std(sag.volt + resistance * sag.amp)
    gain = 2.0 * resistance * by_volt / residual_volt**2
    clear = gain > _LIKELY
    count, chance = np.count_nonzero(clear & ~driven), clear[driven].mean() * np.count_nonzero(~driven)
    if count < max(_FEWEST_BRAKED, 5.0 * chance):
        return nothing
    order = np.argsort(rise)
    steep = order[: int(np.argmax(np.cumsum(gain[order]))) + 1]  # few of which are clear by themselves
    # Segments as steep as most of these may flow back for a part of their time.
    lost: Mask = ~driven & ((gain > 0.0) | (rise <= np.quantile(rise[clear & ~driven], 0.8)))
    lost[steep] |= ~driven[steep]
    return lost
