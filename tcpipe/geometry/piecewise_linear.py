"""Signals known at samples and straight between them: values, integrals, and the integral of a product of two.

The power of a drive is voltage times current, each sampled at its own times. If both are straight between samples,
their product is a parabola on each interval and its integral has a closed form; the trapezoid of sampled V·I differs
from it by up to 1.15 % a segment on noisy data. Stamps are int64 nanoseconds and strictly increasing; times are elapsed
since the first stamp.
"""

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints, accumulate
from tcpipe.geometry.polyline import find_row_before

_NS = 1e-9


def interpolate(stamp_ns: Ints, value: Floats, at_ns: Ints) -> Floats:
    """Return the signal at each time, shape (M,), in the unit of ``value``; ends are held beyond the samples."""
    origin = stamp_ns[0]
    return np.asarray(np.interp((at_ns - origin) * _NS, (stamp_ns - origin) * _NS, value))


def integrate_to(stamp_ns: Ints, value: Floats, at_ns: Ints) -> Floats:
    """Return the exact integral from the first sample to each time, shape (M,), in the unit of ``value`` times seconds.

    Parameters
    ----------
    stamp_ns : [ns], shape (N,), strictly increasing, N >= 2.
    value : any unit, shape (N,).
    at_ns : [ns], shape (M,), inside the span of ``stamp_ns``.
    """
    return integrate_product_to(stamp_ns, value, np.ones_like(value), at_ns)


def mean_between(stamp_ns: Ints, value: Floats, start_ns: Ints, end_ns: Ints) -> Floats:
    """Return the exact time-mean of the signal over each span, shape (M,); NaN where a NaN touches the span.

    Parameters as in `integrate_to`; every span is longer than zero.
    """
    known = np.isfinite(value)
    total, unknown = (
        integrate_to(stamp_ns, x, end_ns) - integrate_to(stamp_ns, x, start_ns)
        for x in (np.where(known, value, 0.0), 1.0 - known)
    )
    return np.where(unknown > _NS, np.nan, total / ((end_ns - start_ns) * _NS))


def integrate_product_to(stamp_ns: Ints, a: Floats, b: Floats, at_ns: Ints) -> Floats:
    """Return the exact integral of the product of two signals on one grid, from its first stamp to each time.

    On an interval of length h with end values a0, a1 and b0, b1 it is h (2 a0 b0 + 2 a1 b1 + a0 b1 + a1 b0) / 6.

    Parameters
    ----------
    stamp_ns : [ns], shape (N,), strictly increasing, N >= 2: the union of both signals' stamps.
    a, b : any units, shape (N,), values at those stamps.
    at_ns : [ns], shape (M,), inside the span of ``stamp_ns``.
    """
    step_s = np.diff(stamp_ns) * _NS
    whole = accumulate(_integrate_product(step_s, a[:-1], a[1:], b[:-1], b[1:]))
    row = find_row_before(stamp_ns, at_ns)
    part_s = (at_ns - stamp_ns[row]) * _NS
    share = part_s / step_s[row]
    a_end = a[row] + share * (a[row + 1] - a[row])
    b_end = b[row] + share * (b[row + 1] - b[row])
    return whole[row] + _integrate_product(part_s, a[row], a_end, b[row], b_end)


def integrate_held_to(stamp_ns: Ints, value: Floats, at_ns: Ints) -> Floats:
    """Return the integral, from the first stamp, of the step signal with an interval's value at its right end.

    It is exact for a source that reports the average since its last message (right-endpoint rectangle); it is also the
    sum of the paper's Eq. 1. Parameters as in `integrate_to`.
    """
    step_s = np.diff(stamp_ns) * _NS
    whole = accumulate(step_s * value[1:])
    row = find_row_before(stamp_ns, at_ns)
    return whole[row] + (at_ns - stamp_ns[row]) * _NS * value[row + 1]


def _integrate_product(step_s: NDArray[np.floating], a0: Floats, a1: Floats, b0: Floats, b1: Floats) -> Floats:
    return step_s * (2.0 * a0 * b0 + 2.0 * a1 * b1 + a0 * b1 + a1 * b0) / 6.0
