"""Which rows of a power topic are no measurement: values that are missing, marked, isolated from their neighbours, or have overflowed.

A meter may be read less often than its messages are sent. Neighbours of a value are therefore the nearest different values.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from tcpipe.robots import UNMEASURED_AMP
from tcpipe.tables.findings import read_threshold

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EXCLUDED, _REJECTED = "power-values-excluded", "power-rejected"
_FEWEST_VALUES = 20
_MOST_MARKED = 2
"""Largest number of successive rows that are marked as not measured; longer runs may be real."""
_MOST_ISOLATED = 2
"""Largest number of successive isolated values that are excluded; more of them reject the power."""
_SHORTEST_DRIVE_S = 1.0
"""No robot starts and stops within this."""


def find_missing_rows(voltage_volt: Floats, current_amp: Floats) -> Mask:
    """Return the rows without a possible voltage, or with only one of both where most rows have both, shape (N,)."""
    has_voltage, has_current = np.isfinite(voltage_volt), np.isfinite(current_amp)
    live = voltage_volt[has_voltage & (voltage_volt > 0.0)]
    usual = np.median(live) if live.size else np.nan
    low, high = (read_threshold(_EXCLUDED, name) * usual for name in ("min_of_median", "max_of_median"))
    missing: Mask = has_voltage & ~((voltage_volt >= low) & (voltage_volt <= high))
    if 2 * np.count_nonzero(has_voltage & has_current) > np.count_nonzero(has_voltage | has_current):
        missing |= has_voltage != has_current
    return missing


def find_marked(recorded: Floats) -> Mask:
    """Return where a recorded current has a value that may mean "not measured" and both neighbours are far from it, shape (N,)."""
    found = np.zeros(len(recorded), np.bool_)
    for mark in UNMEASURED_AMP[""]:
        marked = np.isclose(recorded, mark, rtol=1e-6, atol=0.0)
        other = np.flatnonzero(np.isfinite(recorded) & ~marked)
        rows = np.flatnonzero(marked)
        if not rows.size or other.size < _FEWEST_VALUES:
            continue
        rest = recorded[other][find_changes(recorded[other])]
        after = np.searchsorted(other, rows)
        inner = (after > 0) & (after < other.size)
        rows, after = rows[inner], after[inner]
        distance = np.minimum(*(np.abs(recorded[other[at]] - mark) for at in (after - 1, after)))
        usual = np.quantile(np.abs(np.diff(rest)), 0.99) if rest.size > 1 else 0.0
        found[rows] = (distance > usual) & (other[after] - other[after - 1] <= _MOST_MARKED + 1)
    return found


def find_changes(values: Floats) -> Mask:
    """Return where a value differs from the one before it, shape (N,); the first one does."""
    return np.concatenate((np.ones(min(values.size, 1), np.bool_), values[1:] != values[:-1]))


def find_isolated(values: Floats, time_s: Floats) -> tuple[Mask, bool]:
    """Return the rows whose value is isolated, shape (N,), and whether isolated values are too many, or too many in a row."""
    found = np.zeros(len(values), np.bool_)
    rows = np.flatnonzero(np.isfinite(values))
    new = find_changes(values[rows])
    value, at_s = values[rows][new], time_s[rows][new]
    if value.size < _FEWEST_VALUES:
        return found, False
    isolated = _is_far(value, 2 * _MOST_ISOLATED + 1, 0.99)
    found[rows] = isolated[np.cumsum(new) - 1]
    share = max(np.mean(each) for each in (isolated, _is_far(value, 2 * _MOST_ISOLATED + 1, 0.9)))
    block = np.flatnonzero(_is_far(value, 4 * _MOST_ISOLATED + 3, 0.99))
    runs = np.split(block, np.flatnonzero(np.diff(block) > 1) + 1)
    is_block = any(run.size > _MOST_ISOLATED and at_s[run[-1]] - at_s[run[0]] < _SHORTEST_DRIVE_S for run in runs)
    return found, bool(is_block or share > read_threshold(_REJECTED, "max_isolated_fraction"))


def _is_far(values: Floats, width: int, quantile: float) -> Mask:
    """Return where a value is far from the median of ``width`` around it, by that and by its quantile over the run."""
    middle = np.median(sliding_window_view(np.pad(values, width // 2, mode="reflect"), width), axis=1)
    size = np.abs(middle)
    top = np.quantile(size[size > 0.0], quantile) if size.any() else 0.0
    return np.asarray(np.abs(values - middle) > read_threshold(_EXCLUDED, "max_of_neighbours") * np.maximum(size, top))


def find_overflow(current_amp: Floats) -> tuple[float, bool] | None:
    """Return the span [A] that a signed register has, and whether usual steps are clearly smaller; None where nothing overflows.

    Values end at plus and minus half of the span, and jump from one end to the other. A driver may scale or round after the overflow, so
    that the span need not be a power of two of the resolution.
    """
    known = current_amp[np.isfinite(current_amp)]
    value = known[find_changes(known)]
    levels = np.unique(np.round(value, 6))
    if levels.size < _FEWEST_VALUES or not levels[0] < 0.0 < levels[-1]:
        return None
    quantum = float(np.diff(levels).min())
    span = float(levels[-1] - levels[0]) + quantum
    step = np.abs(np.diff(value))
    jumps = step > _JUMP * span
    if abs(levels[-1] + levels[0]) > max(2.0 * quantum, _ASYMMETRY * span) or jumps.sum() < _FEWEST_JUMPS:
        return None
    usual = float(np.quantile(step[~jumps], 0.99))
    after = np.quantile(np.abs(np.diff(undo_overflow(value, span)))[jumps], 0.9)
    return (span, usual < span / 4.0) if after <= max(usual, 3.0 * quantum) else None


_JUMP, _ASYMMETRY, _FEWEST_JUMPS = 0.6, 0.02, 4
"""Of the span: a step that is an overflow, and the difference of both ends; fewest overflows."""


def undo_overflow(current_amp: Floats, span_amp: float) -> Floats:
    """Return currents [A], shape (N,), continued beyond the ends of a span, from the first one on."""
    whole = current_amp.copy()
    known = np.isfinite(current_amp)
    step = np.diff(current_amp[known], prepend=current_amp[known][:1])
    turns = np.where(np.abs(step) > _JUMP * span_amp, -np.sign(step), 0.0)
    whole[known] += span_amp * np.cumsum(turns)
    return whole
