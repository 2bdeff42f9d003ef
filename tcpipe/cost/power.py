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

from tcpipe.geometry.piecewise_linear import held_back_integral_to, interpolate, product_integral_to

Rule = Literal["exact", "averaged", "right_endpoint"]


@dataclass(frozen=True, slots=True)
class Samples:
    """One measured signal: stamps [ns], shape (N,), int64, strictly increasing, and values, shape (N,)."""

    stamp_ns: NDArray[np.int64]
    value: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rail:
    """One drive rail in one clock epoch: its samples, and both signals on the union of their stamps where both are known.

    Attributes
    ----------
    voltage, current : samples as measured, [V] and [A], current positive when drawn.
    stamp_ns : [ns], shape (N,), union of both stamps from the later first to the earlier last; empty if they never overlap.
    voltage_volt, current_amp : [V], [A], shape (N,), at those stamps.
    """

    name: str
    voltage: Samples
    current: Samples
    stamp_ns: NDArray[np.int64]
    voltage_volt: NDArray[np.float64]
    current_amp: NDArray[np.float64]


def samples(stamp_ns: NDArray[np.int64], value: NDArray[np.float64]) -> Samples:
    """Return the finite values in time order; of several at one time the last given."""
    known = np.isfinite(value)
    newest_first, index = np.unique(stamp_ns[known][::-1], return_index=True)
    return Samples(newest_first, value[known][::-1][index])


def rail(name: str, voltage: Samples, current: Samples, *, averaged: bool) -> Rail:
    """Return a rail with both signals on the union of their stamps.

    Parameters
    ----------
    voltage, current : [V], [A].
    averaged : whether a sample is the mean since the one before it, so that a value holds backwards from its stamp, instead of
        being joined to its neighbours by straight lines.
    """
    union = np.union1d(voltage.stamp_ns, current.stamp_ns)
    if not len(voltage.stamp_ns) or not len(current.stamp_ns):
        nothing = np.empty(0)
        return Rail(name, voltage, current, union[:0], nothing, nothing)
    begin = max(voltage.stamp_ns[0], current.stamp_ns[0])
    end = min(voltage.stamp_ns[-1], current.stamp_ns[-1])
    union = union[(union >= begin) & (union <= end)]
    at = _held_back if averaged else interpolate
    return Rail(
        name,
        voltage,
        current,
        union,
        at(voltage.stamp_ns, voltage.value, union),
        at(current.stamp_ns, current.value, union),
    )


def energy_joule(
    rails: list[Rail], start_ns: NDArray[np.int64], end_ns: NDArray[np.int64], *, rule: Rule
) -> NDArray[np.float64]:
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
            energy[inside] = _energy_to(each, end_ns[inside], rule) - _energy_to(each, start_ns[inside], rule)
        total += energy
    return total


def power_watt(rails: list[Rail], at_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the power of all rails at each time, [W], shape (M,), ends held; NaN if a rail is never known, or there is none."""
    total = np.full(len(at_ns), np.nan if not rails else 0.0)
    for each in rails:
        if not len(each.stamp_ns):
            return np.full(len(at_ns), np.nan)
        total += interpolate(each.stamp_ns, each.voltage_volt, at_ns) * interpolate(
            each.stamp_ns, each.current_amp, at_ns
        )
    return total


def recorded_energy_joule(
    rails: list[Rail], start_ns: NDArray[np.int64], end_ns: NDArray[np.int64], *, rule: Rule
) -> NDArray[np.float64]:
    """Return the energy that the record holds for each span, [J], shape (M,): where a rail is not known it adds nothing.

    Unlike a label's, this is bookkeeping: spans that tile a run add up to the run's energy. Parameters as in `energy_joule`.
    """
    total = np.zeros(len(start_ns))
    for each in rails:
        if len(each.stamp_ns) >= 2:
            begin, end = (np.clip(at_ns, each.stamp_ns[0], each.stamp_ns[-1]) for at_ns in (start_ns, end_ns))
            total += _energy_to(each, end, rule) - _energy_to(each, begin, rule)
    return total


def samples_inside(
    rails: list[Rail], start_ns: NDArray[np.int64], end_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
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


def _count(stamp_ns: NDArray[np.int64], start_ns: NDArray[np.int64], end_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    after = np.searchsorted(stamp_ns, end_ns, side="right") - np.searchsorted(stamp_ns, start_ns, side="right")
    return after.astype(np.int64)


def _energy_to(each: Rail, at_ns: NDArray[np.int64], rule: Rule) -> NDArray[np.float64]:
    if rule == "exact":
        return product_integral_to(each.stamp_ns, each.voltage_volt, each.current_amp, at_ns)
    return held_back_integral_to(each.stamp_ns, each.voltage_volt * each.current_amp, at_ns)


def _held_back(
    stamp_ns: NDArray[np.int64], value: NDArray[np.float64], at_ns: NDArray[np.int64]
) -> NDArray[np.float64]:
    return value[np.searchsorted(stamp_ns, at_ns, side="left")]
