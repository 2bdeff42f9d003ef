"""Voltage, current and power at the stamps of the track, from the rails of a power stream."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.signals import median_period_ns


@dataclass(frozen=True, slots=True)
class RailSamples:
    """One rail: stamps [ns] and values of its voltage [V] and its current [A], which may come from different messages."""

    voltage_ns: NDArray[np.int64]
    voltage_volt: NDArray[np.float64]
    current_ns: NDArray[np.int64]
    current_amp: NDArray[np.float64]


def power_at(
    rails: list[RailSamples], at_ns: NDArray[np.int64], *, averaged: bool, max_gap_ns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return mean voltage [V], summed current [A] and summed power [W] at each stamp, each of shape (N,).

    Samples are interpolated linearly; a source that averages over its message period has the value of the message that ends the period.
    NaN where any rail's voltage or current has no sample on both sides within max(3 of its periods, ``max_gap_ns``).
    """
    if not rails:
        return (np.full(at_ns.size, np.nan),) * 3
    sample = _covering if averaged else _interpolated
    voltage = np.stack([sample(rail.voltage_ns, rail.voltage_volt, at_ns, max_gap_ns) for rail in rails])
    current = np.stack([sample(rail.current_ns, rail.current_amp, at_ns, max_gap_ns) for rail in rails])
    power = voltage * current
    known = np.isfinite(power).all(0)
    volt, amp, watt = voltage.mean(0), current.sum(0), power.sum(0)
    return np.where(known, volt, np.nan), np.where(known, amp, np.nan), np.where(known, watt, np.nan)


def _covering(
    stamp_ns: NDArray[np.int64], values: NDArray[np.float64], at_ns: NDArray[np.int64], max_gap_ns: int
) -> NDArray[np.float64]:
    later = np.searchsorted(stamp_ns, at_ns, "left")
    inside = _inside(stamp_ns, at_ns, max_gap_ns)
    held = values[np.minimum(later, stamp_ns.size - 1)] if stamp_ns.size else np.full(at_ns.size, np.nan)
    return np.where(inside, held, np.nan)


def _interpolated(
    stamp_ns: NDArray[np.int64], values: NDArray[np.float64], at_ns: NDArray[np.int64], max_gap_ns: int
) -> NDArray[np.float64]:
    if stamp_ns.size == 0:
        return np.full(at_ns.size, np.nan)
    zero = stamp_ns[0]
    between = np.interp((at_ns - zero).astype(np.float64), (stamp_ns - zero).astype(np.float64), values)
    return np.where(_inside(stamp_ns, at_ns, max_gap_ns), between, np.nan)


def _inside(stamp_ns: NDArray[np.int64], at_ns: NDArray[np.int64], max_gap_ns: int) -> NDArray[np.bool_]:
    """Whether each stamp lies on a sample, or between two that are near each other."""
    if stamp_ns.size == 0:
        return np.zeros(at_ns.size, np.bool_)
    longest = max(max_gap_ns, 3 * median_period_ns(stamp_ns))
    before = np.searchsorted(stamp_ns, at_ns, "right") - 1
    after = np.searchsorted(stamp_ns, at_ns, "left")
    covered = (before >= 0) & (after < stamp_ns.size)
    last = stamp_ns.size - 1
    width = stamp_ns[np.minimum(after, last)] - stamp_ns[np.clip(before, 0, last)]
    return covered & (width <= longest)
