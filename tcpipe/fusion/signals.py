"""Sampled signals: integrals, means, interpolation, and gaps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints, Mask

Plane = NDArray[np.complex128]
Signal = NDArray[Any]  # samples of a signal: real, complex or integer

SPIKE_RATIO = 8.0  # least distance of a spike from its local median, in medians of such distances [1]: more than 5σ
MAX_GAP_NS = 500_000_000  # longest time between samples that is interpolated [ns]: motion sensors send at 2 Hz or more
MAX_ACCELERATION_MPS2 = 2.5
"""Acceleration of a robot that brakes hard [m/s²]; fixes with a larger acceleration are outliers."""


def compute_seconds(stamp_ns: Ints | int, zero_ns: int) -> Floats:
    """Return the time since ``zero_ns`` [s]; subtraction in integers avoids rounding errors."""
    return np.asarray(np.asarray(stamp_ns, np.int64) - zero_ns, np.float64) * 1e-9


def integrate_signal(stamp_s: Floats, values: Floats, at_s: Floats) -> Floats:
    """Return the integral [u s], shape (M, k), from the first sample to ``at_s``, of linearly interpolated (N, k) [u].

    Stamps [s] increase, N >= 1; before the first and after the last sample the signal is constant.
    """
    step = np.diff(stamp_s)
    index = np.clip(np.searchsorted(stamp_s, at_s, "right") - 1, 0, stamp_s.size - 1)
    after = at_s - stamp_s[index]
    later = np.minimum(index + 1, stamp_s.size - 1)
    inside = (index < stamp_s.size - 1) & (after > 0)
    between = np.where(later > index, stamp_s[later] - stamp_s[index], 1.0)
    found, total = np.empty((at_s.size, values.shape[1])), np.zeros(stamp_s.size)
    for axis, value in zip(found.T, values.T, strict=True):  # one axis at a time saves memory
        np.cumsum(0.5 * (value[1:] + value[:-1]) * step, out=total[1:])
        before = value[index]
        slope = np.where(inside, (value[later] - before) / between, 0.0)
        axis[:] = total[index] + after * (before + 0.5 * after * slope)
    return found


def compute_interval_means(stamp_s: Floats, values: Floats, start_s: Floats, end_s: Floats) -> Floats:
    """Return the mean of the piecewise-linear signal over each interval, (M, k); its value in empty intervals."""
    width = (end_s - start_s)[:, None]
    mean = (integrate_signal(stamp_s, values, end_s) - integrate_signal(stamp_s, values, start_s)) / np.where(
        width > 0, width, 1.0
    )
    return np.where(width > 0, mean, interpolate_signal(stamp_s, values, end_s))


def interpolate_signal(stamp_s: Floats, values: Floats, at_s: Floats) -> Floats:
    """Return the samples (N, k) interpolated linearly, shape (M, k); constant before the first and after the last."""
    return np.stack([np.interp(at_s, stamp_s, values[:, k]) for k in range(values.shape[1])], -1)


def is_in_gap(stamp_ns: Ints, start_ns: Ints, end_ns: Ints, *, longest_ns: int) -> Mask:
    """Return whether each interval overlaps a gap longer than ``longest_ns``, or is outside the samples.

    Up to half of ``longest_ns`` before the first and after the last sample counts as inside.
    """
    if stamp_ns.size == 0:
        return np.ones(start_ns.size, np.bool_)
    margin = longest_ns // 2
    outside = (start_ns < stamp_ns[0] - margin) | (end_ns > stamp_ns[-1] + margin)
    long = np.concatenate(([0], np.cumsum(np.diff(stamp_ns) > longest_ns)))  # long gaps before each sample
    before = np.clip(np.searchsorted(stamp_ns, start_ns, "right") - 1, 0, stamp_ns.size - 1)
    after = np.clip(np.searchsorted(stamp_ns, end_ns, "left"), 0, stamp_ns.size - 1)
    touches: Mask = outside | (long[after] > long[before])
    return touches


def is_covered(stamp_ns: Ints, start_ns: Ints, end_ns: Ints, *, least_ns: int = 100_000_000) -> Mask:
    """Return whether each interval is within the samples and without a gap, see `find_longest_step_ns`."""
    return ~is_in_gap(stamp_ns, start_ns, end_ns, longest_ns=find_longest_step_ns(stamp_ns, least_ns))


def find_longest_step_ns(stamp_ns: Ints, least_ns: int) -> int:
    """Return the longest time between samples that is not a gap [ns]: three periods, at least ``least_ns``."""
    return max(least_ns, 3 * compute_median_period_ns(stamp_ns))


def hold_last(stamp_ns: Ints, values: Floats, at_ns: Ints) -> Floats:
    """Return the last value at or before each stamp, (M,); NaN if it is older than 1 s and than three periods."""
    if not values.size:
        return np.full(at_ns.size, np.nan)
    index = np.searchsorted(stamp_ns, at_ns, "right") - 1
    last = np.maximum(index, 0)
    # A value holds for a second at least.
    is_known = (index >= 0) & (at_ns - stamp_ns[last] <= find_longest_step_ns(stamp_ns, 1_000_000_000))
    return np.where(is_known, values[last], np.nan)


def compute_median_period_ns(stamp_ns: Ints) -> int:
    """Return the median time between samples [ns], at least 1; 1 for fewer than two samples."""
    return max(1, int(np.median(np.diff(stamp_ns)))) if stamp_ns.size > 1 else 1


def compute_window_means(stamp_ns: Ints, values: Floats, at_ns: Ints, window_ns: int) -> Floats:
    """Return the means of the samples (N, k) within half a window of each stamp, shape (M, k); NaN without samples."""
    first = np.searchsorted(stamp_ns, at_ns - window_ns // 2, "left")
    last = np.searchsorted(stamp_ns, at_ns + window_ns // 2, "right")
    count = np.where(last > first, (last - first).astype(np.float64), np.nan)
    mean, total = np.empty((at_ns.size, values.shape[1])), np.zeros(stamp_ns.size + 1)
    for axis, value in zip(mean.T, values.T, strict=True):  # one axis at a time saves memory
        np.cumsum(value, out=total[1:])
        axis[:] = (total[last] - total[first]) / count
    return mean


def compute_running_median(values: Floats, rows: int = 5) -> Floats:
    """Return the running median over an odd number of rows of a signal (N, ...); end values are repeated."""
    if len(values) < rows:
        return values
    padded = np.pad(values, [(rows // 2, rows // 2)] + [(0, 0)] * (values.ndim - 1), mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, rows, axis=0), axis=-1))


def remove_spikes(values: Floats, *, fill: float | None = None) -> Floats:
    """Return a signal (N,) with spikes (far from the median of five samples) interpolated, or replaced by ``fill``."""
    if values.size < 5:
        return values
    deviation = np.abs(values - compute_running_median(values))
    is_spike = (
        deviation > SPIKE_RATIO * float(np.median(deviation[deviation > 0.0]))
        if (deviation > 0.0).any()
        else deviation > 0.0
    )
    rows = np.arange(values.size)
    return np.where(is_spike, np.interp(rows, rows[~is_spike], values[~is_spike]) if fill is None else fill, values)


def compute_moving_mean(values: Signal, half: int, *, least: float = 1.0) -> Signal:
    """Return the mean of the known values within ``half`` rows of each row, shape (N, ...).

    NaN where the known share of those rows is below ``least``.
    """
    known = np.isfinite(values)
    rows = np.arange(len(values))
    first, last = np.maximum(rows - half, 0), np.minimum(rows + half + 1, len(values))
    before = np.zeros((1, *values.shape[1:]))
    sums, counts = (np.concatenate((before, np.cumsum(each, axis=0))) for each in (np.where(known, values, 0.0), known))
    count = counts[last] - counts[first]
    mean = (sums[last] - sums[first]) / np.maximum(count, 1.0)
    return np.where(count >= least * (2 * half + 1), mean, np.nan)


def remove_xy_spikes(position_m: Floats) -> Plane:
    """Return positions (N, 2 or 3) as east + i north [m], shape (N,), with spikes of either axis interpolated."""
    return remove_spikes(position_m[:, 0]) + 1j * remove_spikes(position_m[:, 1])


def compute_slopes(stamp_ns: Ints, values: Floats, window_s: float) -> Floats:
    """Return the slope [u/s] of a line through the samples within half a window of each, (N,); 0 for one sample."""
    t, centred = compute_seconds(stamp_ns, int(stamp_ns[0])), values - values.mean()
    products = np.column_stack((t, centred, t * t, t * centred))
    time, value, square, product = compute_window_means(stamp_ns, products, stamp_ns, round(1e9 * window_s)).T
    spread = square - time**2
    return np.where(spread > 1e-9, (product - time * value) / np.maximum(spread, 1e-9), 0.0)


def estimate_white_noise(values: Floats) -> float:
    """Return the σ of white noise on a signal (N, k), the largest of its axes; 0 for fewer than three samples.

    The second difference of white noise has sqrt(6) times its standard deviation.
    """
    if values.shape[0] < 3:
        return 0.0
    second = np.diff(values, n=2, axis=0)
    return float(np.sqrt(np.mean(second**2, axis=0) / 6).max())


def multiply_by_vector(matrix: Floats, vector: Floats) -> Floats:
    """Return the product of a large matrix (M, C) and a vector (C,), bit-identical for any number of threads."""
    return np.asarray(np.einsum("mc,c->m", matrix, vector))


def solve_least_squares(matrix: Floats, target: Floats) -> Floats:
    """Return the least-squares solution of M equations, shape (C,), of least norm, by `multiply_by_vector`."""
    normal = np.einsum("mi,mj->ij", matrix, matrix)
    solved: Floats = np.linalg.lstsq(normal, np.einsum("mi,m->i", matrix, target), rcond=1e-13)[0]
    return solved
