"""Energy of the drive rails between any two times (paper, section III: E is the integral of V(t) I(t)).

A rail's voltage and current may come at different times. Both are brought to the union of their stamps, where both are known; then

- ``exact``: both are straight between samples and their product is integrated in closed form;
- ``averaged``: each sample is the mean since the one before it (clearpath_platform_msgs/Power, Jackal and Warthog Status): steps;
- ``right_endpoint``: the paper's sum V(t_i) I(t_i) Δt_i over the union's stamps, its first and last term prorated.

Every rule is prorated at both ends of a span. Negative power (regeneration) counts as it is.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.geometry.piecewise_linear import integrate_held_to, integrate_product_to
from tcpipe.power.rails import Rail

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

Rule = Literal["exact", "averaged", "right_endpoint"]


def integrate_energy(rails: list[Rail], start_ns: Ints, end_ns: Ints, *, rule: Rule) -> Floats:
    """Return the energy of all rails over each span, [J], shape (M,); NaN where any rail is not known throughout, or there is none.

    Parameters
    ----------
    start_ns, end_ns : [ns], shape (M,).
    """
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
    """Return how many current samples lie in (start, end], the fewest of any rail, and the plain mean power of the samples there.

    Returns
    -------
    [1], shape (M,), 0 without rails; [W], shape (M,), sum over rails of the mean of V·I at the union's stamps, NaN where it has none.
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
