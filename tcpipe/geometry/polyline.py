"""A driven path between samples: cubic Hermite interpolation, horizontal arc length, and first exit from a circle.

The estimated track has position and velocity at 20 Hz; between two samples the path is the one cubic that has both at
both ends. Every length of the pipeline, of segments and of the distance breakdown, is measured on this one curve, so
that they add up. Stamps are int64 nanoseconds and strictly increasing. The caller handles gaps
(docs/explanation/rulings.md, Endpoints and Gaps).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints, accumulate
from tcpipe.compiled import compile_kernel

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(8)
_NS = 1e-9
_PARTS = 8  # parts of an interval that are searched: 6 ms at 20 Hz


def find_row_before(stamp_ns: Ints, at_ns: Ints) -> NDArray[np.intp]:
    """Return for each time the row that begins its interval: the last row at or before it, at most the last but one.

    Parameters
    ----------
    stamp_ns : [ns], shape (N,), strictly increasing, N >= 2.
    at_ns : [ns], shape (M,), inside the span of ``stamp_ns``.
    """
    rows: NDArray[np.intp] = np.searchsorted(stamp_ns, at_ns, side="right") - 1
    return np.clip(rows, 0, len(stamp_ns) - 2)


@dataclass(frozen=True, slots=True)
class Polyline:
    """An uninterrupted piece of path: samples, and the horizontal length from the first sample to each.

    Attributes
    ----------
    stamp_ns : [ns], shape (N,), int64, strictly increasing, N >= 2.
    position_m, velocity_mps : [m], [m/s], shape (N, 3): east, north, up.
    length_m : [m], shape (N,): horizontal length of the Hermite path from the first sample.
    """

    stamp_ns: Ints
    position_m: Floats
    velocity_mps: Floats
    length_m: Floats

    def position_at(self, at_ns: Ints) -> Floats:
        """Return positions [m], shape (M, 3), at times inside the span; at a sample's stamp exactly its position."""
        row, u, step_s = _locate(self.stamp_ns, at_ns)
        v0, v1 = self.velocity_mps[row] * step_s, self.velocity_mps[row + 1] * step_s
        blend = u * u * (3.0 - 2.0 * u)
        swing = u * (1.0 - u) * ((1.0 - u) * v0 - u * v1)
        return self.position_m[row] * (1.0 - blend) + self.position_m[row + 1] * blend + swing

    def length_at(self, at_ns: Ints) -> Floats:
        """Return the horizontal length from the first sample to each time: [m], shape (M,).

        Differences telescope, so the pieces of a path add up to the whole.
        """
        row, u, step_s = _locate(self.stamp_ns, at_ns)
        return self.length_m[row] + _compute_partial_length_m(
            self.position_m[:, :2], self.velocity_mps[:, :2], row, u, step_s
        )

    def first_crossing_ns(self, start_ns: int, *, radius_m: float) -> int | None:
        """Return the first time at which the path is horizontally ``radius_m`` [m] from its start position; or None.

        Each interval is examined in eighths, so that only an excursion of micrometres can be missed. The time is
        rounded to a nanosecond: the residual is about speed x 0.5 ns. ``radius_m`` is the chord d of the paper's III-A.
        """
        at = np.array([start_ns], dtype=np.int64)
        row, u, _ = _locate(self.stamp_ns, at)
        x0, y0, _z0 = self.position_at(at)[0]
        start = (row[0], u[0, 0])
        found = int(_find_first_crossing(self.stamp_ns, self.position_m, self.velocity_mps, start, (x0, y0, radius_m)))
        return None if found < 0 else found


def fit_polyline(stamp_ns: Ints, position_m: Floats, velocity_mps: Floats) -> Polyline:
    """Return the path through samples: cubic Hermite, with its length by 8-node Gauss-Legendre quadrature of speed.

    Parameters
    ----------
    stamp_ns : [ns], shape (N,), int64, strictly increasing.
    position_m, velocity_mps : [m], [m/s], shape (N, 3): east, north, up in one frame.
    """
    position_m, velocity_mps = np.ascontiguousarray(position_m), np.ascontiguousarray(velocity_mps)
    row = np.arange(len(stamp_ns) - 1)
    step_s = np.diff(stamp_ns)[:, None] * _NS
    steps = _compute_partial_length_m(position_m[:, :2], velocity_mps[:, :2], row, np.ones((len(row), 1)), step_s)
    return Polyline(stamp_ns, position_m, velocity_mps, accumulate(steps))


def _locate(stamp_ns: Ints, at_ns: Ints) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Return each time's interval, its share of it (0 to 1) and the interval's length [s]; the latter two (M, 1)."""
    row = find_row_before(stamp_ns, at_ns)
    step_s = (stamp_ns[row + 1] - stamp_ns[row])[:, None].astype(np.float64) * _NS
    return row, ((at_ns - stamp_ns[row]) * _NS)[:, None] / step_s, step_s


def _compute_partial_length_m(
    xy_m: Floats, velocity_mps: Floats, row: NDArray[np.intp], until: Floats, step_s: Floats
) -> Floats:
    """Return the length from each row's sample to the share ``until`` (M, 1) of its interval."""
    u = (until * (0.5 * (_GAUSS_NODES + 1.0)))[:, :, None]
    step_m = (xy_m[row + 1] - xy_m[row])[:, None, :]
    v0, v1 = (velocity_mps[row] * step_s)[:, None, :], (velocity_mps[row + 1] * step_s)[:, None, :]
    tangent = 6.0 * u * (1.0 - u) * step_m + (1.0 - u) * (1.0 - 3.0 * u) * v0 + u * (3.0 * u - 2.0) * v1
    return until[:, 0] * (np.hypot(tangent[..., 0], tangent[..., 1]) @ (0.5 * _GAUSS_WEIGHTS))


@compile_kernel
def _compute_distance_m(
    position_m: Floats, velocity_mps: Floats, step_s: float, u: float, centre: tuple[float, float]
) -> float:
    """Return the horizontal distance from a centre at a share u of the interval between two rows."""
    blend = u * u * (3.0 - 2.0 * u)
    total = 0.0
    for axis in range(2):
        v0, v1 = velocity_mps[0, axis] * step_s, velocity_mps[1, axis] * step_s
        swing = u * (1.0 - u) * ((1.0 - u) * v0 - u * v1)
        off = position_m[0, axis] * (1.0 - blend) + position_m[1, axis] * blend + swing - centre[axis]
        total += off * off
    return math.sqrt(total)


@compile_kernel
def _find_first_crossing(
    stamp_ns: Ints,
    position_m: Floats,
    velocity_mps: Floats,
    start: tuple[int, float],
    circle: tuple[float, float, float],
) -> np.int64:
    """Return the first stamp at which the path leaves a circle, or -1; halves the first part that ends outside."""
    row, share = start
    x0, y0, radius_m = circle
    for k in range(row, len(stamp_ns) - 1):
        begin_ns: np.int64 = stamp_ns[k]
        step_ns = stamp_ns[k + 1] - begin_ns
        ends = position_m[k : k + 2], velocity_mps[k : k + 2], step_ns * _NS
        low = share if k == row else 0.0
        while low < 1.0:
            high = min(low + 1.0 / _PARTS, 1.0)
            if _compute_distance_m(*ends, high, (x0, y0)) >= radius_m:
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    if _compute_distance_m(*ends, middle, (x0, y0)) < radius_m:
                        low = middle
                    else:
                        high = middle
                return begin_ns + np.int64(np.round(high * step_ns))
            low = high
    return np.int64(-1)
