"""Parts of a clock epoch, on the grid of `lags`: all of it in windows, or the half hour in which the robot drives most."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.lags import make_grid_ns
from tcpipe.fusion.measurements import Measurements
from tcpipe.fusion.signals import compute_seconds

Ints = NDArray[np.int64]

_SECOND_NS = 1_000_000_000
_LONGEST_NS = 1800 * _SECOND_NS
_STEP_NS = 300 * _SECOND_NS
_PLACES_NS = 10 * _SECOND_NS


def iterate_windows_ns(m: Measurements, length_ns: int) -> Iterator[Ints]:
    """Yield grids [ns] of about ``length_ns`` that follow each other over the time of a set, wherever it has measurements."""
    span = find_span_ns(m)
    if span is None:
        return
    count = max(1, round((span[1] - span[0]) / length_ns))
    edges = np.linspace(*span, count + 1).astype(np.int64)
    stamps = [sensor.stamp_ns for sensor in m.sensors().values()]
    heard = np.unique(np.concatenate([np.searchsorted(edges, stamp, side="right") - 1 for stamp in stamps]))
    for window in np.unique(np.clip(np.concatenate((heard - 1, heard, heard + 1)), 0, count - 1)):
        yield make_grid_ns(int(edges[window]), int(edges[window + 1]))


def find_span_ns(m: Measurements) -> tuple[int, int] | None:
    """Return first and last stamp of a set's measurements; None where no sensor has two."""
    stamps = [sensor.stamp_ns for sensor in m.sensors().values() if sensor.stamp_ns.size > 1]
    return (min(int(s[0]) for s in stamps), max(int(s[-1]) for s in stamps)) if stamps else None


def find_liveliest_window_ns(m: Measurements) -> Ints | None:
    """Return the grid [ns] of the half hour in which the robot drives most; None without measurements."""
    span = find_span_ns(m)
    if span is None:
        return None
    first_ns, last_ns = span
    begin = np.arange(first_ns, max(last_ns - _LONGEST_NS, first_ns) + 1, _STEP_NS, dtype=np.int64)
    way_m = _compute_driven_m(m, np.concatenate((begin, begin + _LONGEST_NS)))
    best = int(begin[np.argmax(way_m[begin.size :] - way_m[: begin.size])])
    return make_grid_ns(best, min(last_ns, best + _LONGEST_NS))


def _compute_driven_m(m: Measurements, at_ns: Ints) -> NDArray[np.float64]:
    """Return the distance driven before each time [m], by the first sensor that tells one."""
    source = m.wheels or m.visual
    if source is not None:
        stamp_ns, speed_mps = source.stamp_ns, np.nan_to_num(np.abs(source.velocity_mps[:, 0]))
        steps_m = speed_mps[1:] * np.diff(compute_seconds(stamp_ns, int(stamp_ns[0])))
    elif m.gnss is not None:
        stamp_ns = np.arange(m.gnss.stamp_ns[0], m.gnss.stamp_ns[-1] + 1, _PLACES_NS, dtype=np.int64)
        places = [np.interp(stamp_ns, m.gnss.stamp_ns, axis) for axis in m.gnss.position_enu_m[:, :2].T]
        steps_m = np.hypot(*np.diff(places, axis=1))
    else:
        return np.zeros(at_ns.size)
    way_m: NDArray[np.float64] = np.interp(at_ns, stamp_ns, np.concatenate(([0.0], np.cumsum(steps_m))))
    return way_m
