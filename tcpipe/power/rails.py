"""Rails: one voltage and one current each, and what they are between their samples (paper, section III: power is V(t) I(t)).

The one rule: a sample of a source that averages over its message period (clearpath_platform_msgs/Power, Jackal and Warthog Status) is the
mean over the interval that *ends* at its stamp, so its value holds backwards from there; other samples are joined by straight lines.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.geometry.piecewise_linear import interpolate

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

_PERIODS = 3
"""So many periods without a sample are a gap, where the recipe allows less: a message that is lost now and then is none."""


@dataclass(frozen=True, slots=True)
class Samples:
    """One measured signal: stamps [ns], shape (N,), int64, strictly increasing, and values, shape (N,)."""

    stamp_ns: Stamps
    value: Floats


@dataclass(frozen=True, slots=True)
class Rail:
    """One drive rail in one clock epoch: its samples, and both signals on the union of their stamps where both are known.

    Attributes
    ----------
    voltage, current : samples as measured, [V] and [A], current positive when drawn.
    averaged : whether a sample is the mean since the one before it.
    stamp_ns : [ns], shape (N,), union of both stamps from the later first to the earlier last; empty if they never overlap.
    voltage_volt, current_amp : [V], [A], shape (N,), at those stamps.
    """

    name: str
    voltage: Samples
    current: Samples
    averaged: bool
    stamp_ns: Stamps
    voltage_volt: Floats
    current_amp: Floats


def make_samples(stamp_ns: Stamps, value: Floats) -> Samples:
    """Return the finite values in time order; of several at one stamp the first given, as for every other sensor.

    Of means the second says nothing: no time lies between it and the first.
    """
    known = np.isfinite(value)
    stamps, first = np.unique(stamp_ns[known], return_index=True)
    return Samples(stamps, value[known][first])


def make_rail(name: str, voltage: Samples, current: Samples, *, averaged: bool) -> Rail:
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


def interpolate_value(
    signal: Samples,
    at_ns: Stamps,
    *,
    averaged: bool,
    straight: Callable[[Stamps, Floats, Stamps], Floats] = interpolate,
) -> Floats:
    """Return a signal of at least one sample at each time, shape (M,), by the one rule; its ends are held beyond them."""
    if averaged:
        ends_at = np.searchsorted(signal.stamp_ns, at_ns, side="left")
        return signal.value[np.minimum(ends_at, len(signal.value) - 1)]
    return straight(signal.stamp_ns, signal.value, at_ns)


def interpolate_rail(each: Rail, at_ns: Stamps) -> tuple[Floats, Floats]:
    """Return voltage [V] and current [A] of a rail at each time, shape (M,), ends held; NaN if they are never both known."""
    if not len(each.stamp_ns):
        return np.full(len(at_ns), np.nan), np.full(len(at_ns), np.nan)
    volt, amp = (Samples(each.stamp_ns, value) for value in (each.voltage_volt, each.current_amp))
    return interpolate_value(volt, at_ns, averaged=each.averaged), interpolate_value(amp, at_ns, averaged=each.averaged)


def compute_power_watt(rails: list[Rail], at_ns: Stamps) -> Floats:
    """Return the power of all rails at each time, [W], shape (M,), ends held; NaN if a rail is never known, or there is none."""
    total = np.full(len(at_ns), np.nan if not rails else 0.0)
    for each in rails:
        volt, amp = interpolate_rail(each, at_ns)
        total += volt * amp
    return total


def compute_power_at(rails: list[Rail], at_ns: Stamps, *, max_gap_ns: int) -> tuple[Floats, Floats, Floats]:
    """Return mean voltage [V], summed current [A] and summed power [W] at each stamp, each of shape (M,).

    NaN without rails, and where any rail's voltage or current has no sample on both sides within max(3 of its periods, ``max_gap_ns``).
    """
    if not rails:
        return (np.full(at_ns.size, np.nan),) * 3
    voltage, current = (
        np.stack(
            [
                _interpolate_known(signal, at_ns, averaged=each.averaged, max_gap_ns=max_gap_ns)
                for each, signal in signals
            ]
        )
        for signals in ([(each, each.voltage) for each in rails], [(each, each.current) for each in rails])
    )
    power = voltage * current
    known = np.isfinite(power).all(0)
    volt, amp, watt = voltage.mean(0), current.sum(0), power.sum(0)
    return np.where(known, volt, np.nan), np.where(known, amp, np.nan), np.where(known, watt, np.nan)


def _interpolate_known(signal: Samples, at_ns: Stamps, *, averaged: bool, max_gap_ns: int) -> Floats:
    """Return a signal at each stamp; NaN where that lies neither on a sample nor between two that are near each other."""
    stamp_ns = signal.stamp_ns
    if stamp_ns.size == 0:
        return np.full(at_ns.size, np.nan)
    longest = max(max_gap_ns, _PERIODS * (int(np.median(np.diff(stamp_ns))) if stamp_ns.size > 1 else 1))
    before = np.searchsorted(stamp_ns, at_ns, "right") - 1
    after = np.searchsorted(stamp_ns, at_ns, "left")
    covered = (before >= 0) & (after < stamp_ns.size)
    last = stamp_ns.size - 1
    width = stamp_ns[np.minimum(after, last)] - stamp_ns[np.clip(before, 0, last)]
    value = interpolate_value(signal, at_ns, averaged=averaged, straight=_interpolate_ns)
    return np.where(covered & (width <= longest), value, np.nan)


def _interpolate_ns(stamp_ns: Stamps, value: Floats, at_ns: Stamps) -> Floats:
    """Return what `interpolate` does, computed in nanoseconds: in seconds the last digits of every track would be others."""
    zero = stamp_ns[0]
    between: Floats = np.interp((at_ns - zero).astype(np.float64), (stamp_ns - zero).astype(np.float64), value)
    return between
