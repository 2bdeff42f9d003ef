"""Energy of the drive rails between any two times (paper, section III: E is the integral of V(t) I(t)).

A rail's voltage and current may come at different times. Both are brought to the union of their stamps, where both are known; then

- ``exact``: both are straight between samples and their product is integrated in closed form;
- ``averaged``: each sample is the mean since the one before it (clearpath_platform_msgs/Power, Jackal and Warthog Status): steps;
- ``right_endpoint``: the paper's sum V(t_i) I(t_i) Δt_i over the union's stamps, its first and last term prorated.

Every rule is prorated at both ends of a span. Negative power (regeneration) counts as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.geometry.piecewise_linear import integrate_held_to, integrate_product_to
from tcpipe.power.rails import Rail

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

Rule = Literal["exact", "averaged", "right_endpoint"]


def integrate_energy(rails: list[Rail], start_ns: Ints, end_ns: Ints, *, rule: Rule) -> Floats:
    """Return the energy of all rails over each span [J], shape (M,); NaN where any rail is unknown in part of it, or there is none."""
    total = np.full(len(start_ns), np.nan if not rails else 0.0)
    for each in rails:
        energy = np.full(len(start_ns), np.nan)
        if len(each.stamp_ns) >= 2:
            inside = (start_ns >= each.stamp_ns[0]) & (end_ns <= each.stamp_ns[-1])
            energy[inside] = _integrate_to(each, end_ns[inside], rule) - _integrate_to(each, start_ns[inside], rule)
        total += energy
    return total


def integrate_recorded_energy(rails: list[Rail], start_ns: Ints, end_ns: Ints, *, rule: Rule) -> Floats:
    """Return the energy that the record holds for each span, [J], shape (M,): where a rail is not known it adds nothing.

    Unlike a label's, this is bookkeeping: spans that tile a run add up to the run's energy. Parameters as in `integrate_energy`.
    """
    total = np.zeros(len(start_ns))
    for each in rails:
        if len(each.stamp_ns) >= 2:
            begin, end = (np.clip(at_ns, each.stamp_ns[0], each.stamp_ns[-1]) for at_ns in (start_ns, end_ns))
            total += _integrate_to(each, end, rule) - _integrate_to(each, begin, rule)
    return total


def count_samples_inside(rails: list[Rail], start_ns: Ints, end_ns: Ints) -> tuple[Ints, Floats]:
    """Return the number of current samples in (start, end], the fewest of any rail, and the plain mean power of the samples there [W].

    Both have shape (M,); 0 and NaN without rails, the mean NaN also where a rail has no sample.
    """
    count = np.zeros(len(start_ns), dtype=np.int64)
    mean = np.full(len(start_ns), np.nan if not rails else 0.0)
    for i, each in enumerate(rails):
        mine = _count(each.current.stamp_ns, start_ns, end_ns)
        count = mine if i == 0 else np.minimum(count, mine)
        sums = np.concatenate(([0.0], np.cumsum(each.voltage_volt * each.current_amp)))
        first, last = (np.searchsorted(each.stamp_ns, at, side="right") for at in (start_ns, end_ns))
        part = np.full(len(start_ns), np.nan)
        np.divide(sums[last] - sums[first], last - first, out=part, where=last > first)
        mean += part
    return count, mean


def _count(stamp_ns: Ints, start_ns: Ints, end_ns: Ints) -> Ints:
    after = np.searchsorted(stamp_ns, end_ns, side="right") - np.searchsorted(stamp_ns, start_ns, side="right")
    return after.astype(np.int64)


def _integrate_to(each: Rail, at_ns: Ints, rule: Rule) -> Floats:
    if rule == "exact":
        return integrate_product_to(each.stamp_ns, each.voltage_volt, each.current_amp, at_ns)
    return integrate_held_to(each.stamp_ns, each.voltage_volt * each.current_amp, at_ns)


FEWEST_ROWS = 40
"""Fewest rows of a stationary robot."""
_QUARTERS = 4
_UNSEEN_SHARE = 0.1
"""Of the power: how far one stationary second may be from the rest of the run. The pack of FoMo's robot,
which stands once for seconds, gives 12 % of that more while driving than the drives take (docs/explanation/real-data.md)."""


@dataclass(frozen=True, slots=True)
class IdlePower:
    """Idle power of a run: the median of the means of seconds [W], and its standard deviation for any second of the run; NaN if unknown."""

    watt: float
    std_watt: float


def estimate_idle_power(
    power_watt: Floats, halt: NDArray[np.int64], *, window_rows: int, step_watt: float
) -> IdlePower:
    """Return the idle power. A second is about as long as a segment takes, and its mean is finer than the record's step.

    Parameters
    ----------
    power_watt : [W], shape (N,), while the robot is stationary, in order of time; NaN where unknown.
    halt : shape (N,), number of the row's halt, increasing; negative at the edges of a halt, where motors still or already draw.
    window_rows : rows of a second.
    step_watt : [W], resolution of power; a record that stays on one level has an error of up to half of it.
    """
    known = np.isfinite(power_watt)
    if np.count_nonzero(known) < FEWEST_ROWS:
        return IdlePower(np.nan, np.nan)
    settled = known & (halt >= 0)
    used = settled if settled.any() else known
    halts = [power_watt[used & (halt == number)] for number in np.unique(halt[used]).tolist()]
    seconds = _split_halts(halts, window_rows)
    means = np.array([each.mean() for each in seconds])
    watt = float(np.median(means))
    scatter = float(np.mean((means - watt) ** 2))
    lasting = max(scatter - _estimate_noise_variance(seconds), 0.0)
    levels = 1 + np.count_nonzero(np.diff(power_watt[used]))
    unseen = _UNSEEN_SHARE * watt / means.size
    return IdlePower(watt, float(np.sqrt(lasting + scatter / means.size + step_watt**2 / 12.0 / levels + unseen**2)))


def _split_halts(halts: list[Floats], rows: int) -> list[Floats]:
    """Return halts in parts of so many rows or somewhat more; those of less than half are left out where there are others."""
    parts = [part for each in halts for part in np.array_split(each, max(each.size // rows, 1))]
    return [part for part in parts if 2 * part.size >= rows] or parts


def _estimate_noise_variance(seconds: list[Floats]) -> float:
    """Return the variance [W²] that noise gives the mean of a second: estimated from the means of its quarters, however rows correlate."""
    found = [
        float(np.var([quarter.mean() for quarter in np.array_split(each, _QUARTERS)], ddof=1)) / _QUARTERS
        for each in seconds
        if each.size >= _QUARTERS
    ]
    return float(np.mean(found)) if found else 0.0
