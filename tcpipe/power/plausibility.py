"""Rows of a power topic without a measurement: missing or marked values, outliers, and overflows.

A meter may be read less often than its messages are sent: the neighbours of a value are the nearest different values.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tcpipe.arrays import Floats, Mask
from tcpipe.robots import UNMEASURED_AMP
from tcpipe.tables.findings import read_threshold

EXCLUDED, REJECTED = "power-values-excluded", "power-rejected"
_FEWEST_VALUES, _MARKS, _MOST_REPEATS = 20, 2, 5
_SHORTEST_DRIVE_S = 1.0  # no robot starts and stops within this
_JUMP, _ASYMMETRY, _FEWEST_JUMPS = 0.6, 0.02, 4
"""An overflow: smallest step and largest difference of both ends [fractions of the span], and fewest steps."""


def find_missing_rows(voltage_volt: Floats, current_amp: Floats) -> Mask:
    """Return the rows without a possible voltage, or with only one of both, shape (N,).

    If most rows have only one of them, and currents without a voltage change, two sensors of different rates share a
    table.
    """
    has_voltage, has_current = np.isfinite(voltage_volt), np.isfinite(current_amp)
    live = voltage_volt[has_voltage & (voltage_volt > 0.0)]
    median_volt = np.median(live) if live.size else np.nan
    low, high = (read_threshold(EXCLUDED, name) * median_volt for name in ("min_of_median", "max_of_median"))
    missing: Mask = has_voltage & ~((voltage_volt >= low) & (voltage_volt <= high))
    both, lone = np.count_nonzero(has_voltage & has_current), current_amp[has_current & ~has_voltage]
    is_paired = 2 * both > np.count_nonzero(has_voltage | has_current) or (both and 0 < np.unique(lone).size <= _MARKS)
    return missing | (has_voltage != has_current) if is_paired else missing


def find_isolated(values: Floats, time_s: Floats) -> tuple[Mask, bool]:
    """Return the rows whose value is isolated, shape (N,), and whether such values are too many, or too many in a row.

    One or two values in a row are isolated if their distance from the median of five exceeds the largest usual value,
    or half of it where other values are near their medians. An exact value that may mean "not measured" is isolated if
    it is farther from both neighbours than usual steps, and is not repeated much longer than other values.
    """
    rows, found = np.flatnonzero(np.isfinite(values)), np.zeros(len(values), bool)
    new = np.diff(values[rows], prepend=np.nan) != 0.0
    value, at_s = values[rows][new], time_s[rows][new]
    marked = np.isclose(np.abs(value)[:, None], UNMEASURED_AMP[""], rtol=1e-6, atol=0.0).any(axis=1)
    rest = np.flatnonzero(~marked)
    if rest.size < _FEWEST_VALUES:
        return found, False
    after = np.clip(np.searchsorted(rest, np.arange(value.size)), 1, rest.size - 1)
    distance = np.minimum(*(np.abs(value - value[rest[at]]) for at in (after - 1, after)))
    steps, repeats = np.abs(np.diff(value[rest])), np.bincount(np.cumsum(new) - 1)
    isolated = marked & (distance > _compute_usual(steps)) & (repeats <= _MOST_REPEATS * np.median(repeats[rest]))
    rest = np.flatnonzero(~isolated)
    deviation, (by_most, relative) = _compare_with_median(value[rest], 5, (0.9, 0.99))
    limit, low_limit, times = (
        read_threshold(EXCLUDED, f"max_{name}") for name in ("of_top", "of_top_clear", "scatters")
    )
    scatter, is_far = max(np.quantile(deviation, 0.9), np.median(steps)), relative > limit
    isolated[rest] = is_far | ((relative > low_limit) & (deviation > times * scatter))
    found[rows] = isolated[np.cumsum(new) - 1]
    _, (by_wide_median,) = _compare_with_median(value[rest], 11, (0.99,))
    block = np.flatnonzero(by_wide_median > limit)
    runs = np.split(rest[block], np.flatnonzero(np.diff(block) > 1) + 1)
    is_block = any(run.size > 2 and at_s[run[-1]] - at_s[run[0]] < _SHORTEST_DRIVE_S for run in runs)
    share = max(is_far.mean(), np.mean(by_most > limit))
    return found, bool(is_block or share > read_threshold(REJECTED, "max_isolated_fraction"))


def _compute_usual(steps: Floats) -> float:
    """Return the 99 % quantile of the absolute steps between different values; 0 without any."""
    return float(np.quantile(np.abs(np.append(0.0, steps[steps != 0.0])), 0.99))


def _compare_with_median(values: Floats, width: int, quantiles: tuple[float, ...]) -> tuple[Floats, list[Floats]]:
    """Return absolute deviations from the median of ``width`` values, and relative to the larger of it or quantiles."""
    middle = np.median(sliding_window_view(np.pad(values, width // 2, mode="edge"), width), axis=1)
    size, deviation = np.abs(middle), np.abs(values - middle)
    tops = np.quantile(size[size > 0.0], quantiles) if size.any() else np.ones(len(quantiles))
    return deviation, [deviation / np.maximum(size, top) for top in tops]


def undo_overflow(current_amp: Floats) -> tuple[Floats, float, bool]:
    """Return currents [A] without overflow of a signed register, its span [A], and whether usual steps are smaller.

    The span is 0 without overflow. Values end at ± half of it, and jump from one end to the other. A driver may scale
    or round after the overflow, so that the span need not be a power of two of the resolution.
    """
    rows = np.flatnonzero(np.isfinite(current_amp))
    value = current_amp[rows]
    levels = np.unique(np.round(value, 6))
    if levels.size < _FEWEST_VALUES:
        return current_amp, 0.0, False
    quantum = float(np.diff(levels).min())
    span = float(levels[-1] - levels[0]) + quantum
    step = np.diff(value)
    jumps = np.abs(step) > _JUMP * span
    if abs(levels[-1] + levels[0]) > max(2.0 * quantum, _ASYMMETRY * span) or jumps.sum() < _FEWEST_JUMPS:
        return current_amp, 0.0, False
    whole = current_amp.copy()
    whole[rows[1:]] -= span * np.cumsum(np.where(jumps, np.sign(step), 0.0))
    usual_step = _compute_usual(step[~jumps])
    if np.quantile(np.abs(np.diff(whole[rows]))[jumps], 0.9) > max(usual_step, 3.0 * quantum):
        return current_amp, 0.0, False
    return whole, span, usual_step < span / 4.0
