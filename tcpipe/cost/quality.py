"""Quality bits of labels; none of them removes a segment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.power.noise import compute_median_period_s
from tcpipe.power.rails import Rail, Samples
from tcpipe.tables.bits import Quality

Floats = NDArray[np.float64]
MIN_INSTANTANEOUS_HZ = 10.0
MIN_AVERAGED_HZ = 2.0
_VOLTAGE_SHARE = 0.02
_RATE_TOLERANCE = 0.98  # a 10 Hz source is 10 Hz though its stamps jitter


def combine_flags(flags: dict[Quality, NDArray[np.bool_]], count: int) -> NDArray[np.uint32]:
    """Return the flags of ``count`` segments as bits, shape (M,)."""
    quality = np.zeros(count, dtype=np.uint32)
    for bit, flagged in flags.items():
        quality[flagged] |= np.uint32(bit)
    return quality


def find_wanted_rate(*, averaged: bool) -> float:
    """Return how often power is wanted [Hz]."""
    return MIN_AVERAGED_HZ if averaged else MIN_INSTANTANEOUS_HZ


def is_too_slow(rate_hz: float, *, averaged: bool) -> bool:
    """Return whether power at a rate [Hz] comes less often than is wanted."""
    return rate_hz < _RATE_TOLERANCE * find_wanted_rate(averaged=averaged)


def has_low_power_rate(rails: list[Rail]) -> bool:
    """Return whether the current of any rail comes more slowly than 10 Hz (averaged by its source: 2 Hz), or a voltage that varies.

    A voltage varies where it changes by more than 2 % (root mean square) from sample to sample; a battery's mostly does by less.
    """
    return any(
        _is_slow(each.current, each) or (_is_slow(each.voltage, each) and _is_varying(each.voltage)) for each in rails
    )


def _is_slow(signal: Samples, each: Rail) -> bool:
    return is_too_slow(1.0 / compute_median_period_s(signal), averaged=each.averaged)


def _is_varying(voltage: Samples) -> bool:
    steps = np.diff(voltage.value)
    return steps.size > 0 and float(np.sqrt(np.mean(steps**2))) > _VOLTAGE_SHARE * abs(float(np.mean(voltage.value)))


def touches_voltage_outside(
    rails: list[Rail], start_ns: NDArray[np.int64], end_ns: NDArray[np.int64], *, range_volt: tuple[float, float] | None
) -> NDArray[np.bool_]:
    """Return the spans that touch a voltage sample outside the range [V], shape (M,); none without a range."""
    outside = np.zeros(len(start_ns), dtype=np.bool_)
    low, high = range_volt or (-np.inf, np.inf)
    for voltage in (rail.voltage for rail in rails):
        bad = np.concatenate(([0], np.cumsum((voltage.value < low) | (voltage.value > high))))
        first = np.maximum(np.searchsorted(voltage.stamp_ns, start_ns, side="right") - 1, 0)
        last = np.minimum(np.searchsorted(voltage.stamp_ns, end_ns, side="left") + 1, len(voltage.value))
        outside |= bad[last] > bad[first]
    return outside


def spans_near(position_m: Floats, start_m: Floats, end_m: Floats, *, within_m: float) -> NDArray[np.bool_]:
    """Return which spans of path length [m], shape (M,), have one of the positions [m], shape (G,), inside or nearer than ``within_m``."""
    ordered = np.sort(position_m)
    first = np.searchsorted(ordered, start_m - within_m, side="left")
    last = np.searchsorted(ordered, end_m + within_m, side="right")
    return last > first


def has_slip(wheel_mps: Floats, ground_mps: Floats, *, above: float = 0.2) -> NDArray[np.bool_]:
    """Return where wheel and body speed differ by more than a share of the wheel speed, shape (M,); not where it is unknown.

    Both are means over the segment along the body's x axis [m/s]: along the slope, not horizontal.
    """
    return np.abs(wheel_mps - ground_mps) > above * np.abs(wheel_mps)


def has_mean_mismatch(mean_watt: Floats, power_watt: Floats, *, above: float = 0.05) -> NDArray[np.bool_]:
    """Return where the plain mean of the power samples is off the time-weighted mean by more than a share of it; not where unknown."""
    return np.abs(mean_watt - power_watt) > above * np.abs(power_watt)
