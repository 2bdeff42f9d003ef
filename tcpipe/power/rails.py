"""Rails: one voltage and one current each, and their values between samples (paper, section III: power V(t) I(t)).

One rule: a sample of a source that averages over its message period (clearpath_platform_msgs/Power, Jackal and Warthog
Status) is the mean over the interval that *ends* at its stamp, so its value applies backwards from there; other samples
are joined by straight lines.

Energy of the drive rails between any two times (paper, section III: E is the integral of V(t) I(t)).

A rail's voltage and current may have different stamps. Both are brought to the union of the stamps, where both are
known; then

- ``exact``: both are straight between samples and their product is integrated in closed form;
- ``averaged``: each sample is the mean since the one before it: steps;
- ``right_endpoint``: the paper's sum V(t_i) I(t_i) Δt_i over the union's stamps, its first and last term prorated.

Every rule is prorated at both ends of a span. Negative power (regeneration) counts as negative.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask, accumulate
from tcpipe.geometry.piecewise_linear import integrate_held_to, integrate_product_to, interpolate

_PERIODS = 3  # periods without a sample that are a gap, if the recipe allows less: single lost messages are no gap


@dataclass(frozen=True, slots=True)
class SampledSignal:
    """One measured signal: stamps [ns], shape (N,), int64, strictly increasing, and values, shape (N,)."""

    stamp_ns: Ints
    value: Floats


UNIT_VOLT = 1.0
"""Voltage of a rail of which only the power is known: its current then is the power in watts."""


def is_power_only(voltage_volt: Floats) -> bool:
    """Return whether a rail's voltages [V] mark it as known by its power only."""
    return bool(len(voltage_volt)) and bool(np.all(voltage_volt == UNIT_VOLT))


@dataclass(frozen=True, slots=True)
class Rail:
    """Drive rail in one clock epoch: samples, and both signals on the union of their stamps where both are known.

    Attributes
    ----------
    voltage, current : samples as measured, [V] and [A], current positive when drawn.
    averaged : whether a sample is the mean since the one before it.
    stamp_ns : [ns], shape (N,), union of both stamps from the later first to the earlier last; empty without overlap.
    voltage_volt, current_amp : [V], [A], shape (N,), at those stamps.
    """

    name: str
    voltage: SampledSignal
    current: SampledSignal
    averaged: bool
    stamp_ns: Ints
    voltage_volt: Floats
    current_amp: Floats


def make_samples(stamp_ns: Ints, value: Floats) -> SampledSignal:
    """Return the finite values in time order; of several at one stamp the first given, as for every other sensor.

    For means the second has no information: its interval is empty.
    """
    known = np.isfinite(value)
    stamps, first = np.unique(stamp_ns[known], return_index=True)
    return SampledSignal(stamps, value[known][first])


def make_rail(name: str, voltage: SampledSignal, current: SampledSignal, *, averaged: bool) -> Rail:
    """Return a rail of its voltage [V] and current [A], with both signals on the union of their stamps."""
    union = np.union1d(voltage.stamp_ns, current.stamp_ns)
    if not len(voltage.stamp_ns) or not len(current.stamp_ns):
        nothing = np.empty(0)
        return Rail(name, voltage, current, averaged, union[:0], nothing, nothing)
    begin = max(voltage.stamp_ns[0], current.stamp_ns[0])
    end = min(voltage.stamp_ns[-1], current.stamp_ns[-1])
    union = union[(union >= begin) & (union <= end)]
    volt, amp = (interpolate_value(each, union, averaged=averaged) for each in (voltage, current))
    return Rail(name, voltage, current, averaged, union, volt, amp)


def interpolate_value(signal: SampledSignal, at_ns: Ints, *, averaged: bool) -> Floats:
    """Return a signal of one sample or more at each time, shape (M,), by the one rule; ends are held beyond them."""
    if averaged:
        ends_at = np.searchsorted(signal.stamp_ns, at_ns, side="left")
        return signal.value[np.minimum(ends_at, len(signal.value) - 1)]
    return interpolate(signal.stamp_ns, signal.value, at_ns)


def interpolate_rail(each: Rail, at_ns: Ints) -> tuple[Floats, Floats]:
    """Return a rail's voltage [V] and current [A] at each time, shape (M,), ends held; NaN if never both known."""
    if not len(each.stamp_ns):
        return np.full(len(at_ns), np.nan), np.full(len(at_ns), np.nan)
    volt, amp = (SampledSignal(each.stamp_ns, value) for value in (each.voltage_volt, each.current_amp))
    return interpolate_value(volt, at_ns, averaged=each.averaged), interpolate_value(amp, at_ns, averaged=each.averaged)


def compute_power_watt(rails: list[Rail], at_ns: Ints) -> Floats:
    """Return the power of all rails [W] at each time, shape (M,), ends held; NaN without rails or for unknown ones."""
    total = np.full(len(at_ns), np.nan if not rails else 0.0)
    for each in rails:
        volt, amp = interpolate_rail(each, at_ns)
        total += volt * amp
    return total


def sum_power(rails: list[Rail]) -> SampledSignal | None:
    """Return the power of all rails [W] at the first one's currents; None without rails, or if one is never known."""
    if not rails or not all(len(each.stamp_ns) for each in rails):
        return None
    stamp_ns = rails[0].current.stamp_ns
    return SampledSignal(stamp_ns, compute_power_watt(rails, stamp_ns))


def compute_power_at(rails: list[Rail], at_ns: Ints, *, max_gap_ns: int) -> tuple[Floats, Floats, Floats]:
    """Return mean voltage [V], summed current [A] and summed power [W] at each stamp, each of shape (M,).

    NaN without rails, and where any rail has no voltage or current on both sides within max(3 of its periods,
    ``max_gap_ns``). Voltage and current are also NaN where only the power of a rail is known.
    """
    if not rails:
        return (np.full(at_ns.size, np.nan),) * 3
    voltage, current = np.stack([interpolate_rail(each, at_ns) for each in rails], axis=1)
    for each in rails:
        for signal in (each.voltage, each.current):
            current[:, ~_is_near_samples(signal.stamp_ns, at_ns, max_gap_ns)] = np.nan
    watt = (voltage * current).sum(0)
    measured = np.isfinite(watt) & (not any(is_power_only(each.voltage.value) for each in rails))
    volt, amp = (np.where(measured, value, np.nan) for value in (voltage.mean(0), current.sum(0)))
    return volt, amp, watt


def _is_near_samples(stamp_ns: Ints, at_ns: Ints, max_gap_ns: int) -> Mask:
    """Return whether each time, shape (M,), is that of a sample, or between two that are near each other."""
    if stamp_ns.size == 0:
        return np.zeros(at_ns.size, bool)
    longest = max(max_gap_ns, _PERIODS * (int(np.median(np.diff(stamp_ns))) if stamp_ns.size > 1 else 1))
    before, last = np.searchsorted(stamp_ns, at_ns, "right") - 1, stamp_ns.size - 1
    after = np.searchsorted(stamp_ns, at_ns, "left")
    width = stamp_ns[np.minimum(after, last)] - stamp_ns[np.maximum(before, 0)]
    return (before >= 0) & (after <= last) & (width <= longest)


Rule = Literal["exact", "averaged", "right_endpoint"]


def integrate_energy(rails: list[Rail], start_ns: Ints, end_ns: Ints, *, rule: Rule) -> Floats:
    """Return the energy of all rails over each span [J], shape (M,); NaN without rails, or if one is partly unknown."""
    total = np.full(len(start_ns), np.nan if not rails else 0.0)
    for each in rails:
        inside = np.zeros(len(start_ns), bool)
        if len(each.stamp_ns) >= 2:
            inside = (start_ns >= each.stamp_ns[0]) & (end_ns <= each.stamp_ns[-1])
        total += np.where(inside, integrate_recorded_energy([each], start_ns, end_ns, rule=rule), np.nan)
    return total


def integrate_recorded_energy(rails: list[Rail], start_ns: Ints, end_ns: Ints, *, rule: Rule) -> Floats:
    """Return the recorded energy of each span [J], shape (M,): a rail adds nothing where it is not known.

    Unlike a label's energy, this is bookkeeping: energies of consecutive spans add up to the run's. Parameters:
    `integrate_energy`.
    """
    total = np.zeros(len(start_ns))
    for each in rails:
        if len(each.stamp_ns) >= 2:
            begin, end = (np.clip(at_ns, each.stamp_ns[0], each.stamp_ns[-1]) for at_ns in (start_ns, end_ns))
            total += _integrate_to(each, end, rule) - _integrate_to(each, begin, rule)
    return total


def count_samples_inside(rails: list[Rail], start_ns: Ints, end_ns: Ints) -> tuple[Ints, Floats]:
    """Return the fewest current samples of any rail in (start, end], and the plain mean power of the samples there [W].

    Both have shape (M,); 0 and NaN without rails, the mean NaN also where a rail has no sample.
    """
    count = np.zeros(len(start_ns), dtype=np.int64)
    mean = np.full(len(start_ns), np.nan if not rails else 0.0)
    for i, each in enumerate(rails):
        before, until = (np.searchsorted(each.current.stamp_ns, at, side="right") for at in (start_ns, end_ns))
        samples = (until - before).astype(np.int64)
        count = samples if i == 0 else np.minimum(count, samples)
        sums = accumulate(each.voltage_volt * each.current_amp)
        first, last = (np.searchsorted(each.stamp_ns, at, side="right") for at in (start_ns, end_ns))
        part = np.full(len(start_ns), np.nan)
        np.divide(sums[last] - sums[first], last - first, out=part, where=last > first)
        mean += part
    return count, mean


def _integrate_to(each: Rail, at_ns: Ints, rule: Rule) -> Floats:
    if rule == "exact":
        return integrate_product_to(each.stamp_ns, each.voltage_volt, each.current_amp, at_ns)
    return integrate_held_to(each.stamp_ns, each.voltage_volt * each.current_amp, at_ns)


FEWEST_ROWS = 40
"""Fewest rows of a stationary robot."""
_QUARTERS = 4
_UNSEEN_SHARE = 0.1
"""Share of the power by which one stationary second may differ from the rest of the run. The battery pack of FoMo's
robot, stationary only once, for seconds, gives 12 % of that power more than the drives take while driving
(docs/explanation/real-data.md)."""


@dataclass(frozen=True, slots=True)
class IdlePower:
    """Idle power of a run: median of the means of seconds [W], and its σ for any second of the run; NaN if unknown.

    ``highest_watt``: highest median of a stop from 1 s after its start, when motors no longer brake, plus three steps
    of the record.
    """

    watt: float
    std_watt: float
    highest_watt: float = np.nan


def estimate_idle_power(power_watt: Floats, halt: Ints, *, window_rows: int, step_watt: float) -> IdlePower:
    """Return the idle power, by means of seconds: as long as a segment takes, and finer than the record's step.

    Parameters
    ----------
    power_watt : [W], shape (N,), while the robot is stationary, in order of time; NaN where unknown.
    halt : shape (N,), number of the row's stop, increasing; negative at the edges of a stop, where motors may draw
        current.
    window_rows : rows of a second.
    step_watt : [W], resolution of power; a record that stays on one level has an error of up to half of it.
    """
    known = np.isfinite(power_watt)
    if np.count_nonzero(known) < FEWEST_ROWS:
        return IdlePower(np.nan, np.nan)
    is_inner = known & (halt >= 0)
    used = is_inner if is_inner.any() else known
    halts = [power_watt[used & (halt == number)] for number in np.unique(halt[used]).tolist()]
    seconds = _split_halts(halts, window_rows)
    means = np.array([each.mean() for each in seconds])
    watt = float(np.median(means))
    scatter = float(np.mean((means - watt) ** 2))
    lasting = max(scatter - _estimate_noise_variance(seconds), 0.0)
    levels = 1 + np.count_nonzero(np.diff(power_watt[used]))
    unseen = _UNSEEN_SHARE * watt / means.size
    std_watt = float(np.sqrt(lasting + scatter / means.size + step_watt**2 / 12.0 / levels + unseen**2))
    medians = [float(np.median(each[window_rows:])) for each in halts if each.size >= 2 * window_rows]
    return IdlePower(watt, std_watt, max(medians, default=np.nan) + 3.0 * step_watt)


def _split_halts(halts: list[Floats], rows: int) -> list[Floats]:
    """Split stops into parts of at least ``rows`` rows; parts of less than half are left out unless all are."""
    parts = [part for each in halts for part in np.array_split(each, max(each.size // rows, 1))]
    return [part for part in parts if 2 * part.size >= rows] or parts


def _estimate_noise_variance(seconds: list[Floats]) -> float:
    """Return the variance of a second's mean due to noise [W²], by the means of its quarters (rows correlate)."""
    found = [
        float(np.var([quarter.mean() for quarter in np.array_split(each, _QUARTERS)], ddof=1)) / _QUARTERS
        for each in seconds
        if each.size >= _QUARTERS
    ]
    return float(np.mean(found)) if found else 0.0
