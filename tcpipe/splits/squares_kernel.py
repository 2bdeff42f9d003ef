"""Distance and shared ground of pairs of footprints: compiled, since a large dataset has millions of pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel

Floats = NDArray[np.float64]


@compile_kernel
def pair_distances(ours: Floats, theirs: Floats, i: NDArray[np.int64], j: NDArray[np.int64], out: Floats) -> None:
    """Write the distance between squares ``ours[i]`` and ``theirs[j]`` to ``out``, (P,); 0 where they touch; corners are (N, 4, 2)."""
    for pair in range(i.size):
        a, b = ours[i[pair]], theirs[j[pair]]
        out[pair] = (
            0.0 if _touch(a, b) else np.sqrt(min(_compute_corner_distance(a, b), _compute_corner_distance(b, a)))
        )


@compile_kernel
def pair_overlaps(ours: Floats, theirs: Floats, i: NDArray[np.int64], j: NDArray[np.int64], out: Floats) -> None:
    """Write the area that squares ``ours[i]`` and ``theirs[j]`` share to ``out``, (P,); corners run counter-clockwise."""
    polygon, clipped = np.empty((8, 2)), np.empty((8, 2))
    for pair in range(i.size):
        a, b = ours[i[pair]], theirs[j[pair]]
        for k in range(4):  # not as slices, see `tcpipe.fusion.state_kernel.copy_values`
            polygon[k, 0], polygon[k, 1] = a[k, 0], a[k, 1]
        corners = 4
        for edge in range(4):
            corners = _clip(polygon, corners, b[edge], b[(edge + 1) % 4], clipped)
            polygon, clipped = clipped, polygon
        area = 0.0
        for k in range(corners):
            px, py = polygon[k, 0] - polygon[0, 0], polygon[k, 1] - polygon[0, 1]
            qx, qy = polygon[(k + 1) % corners, 0] - polygon[0, 0], polygon[(k + 1) % corners, 1] - polygon[0, 1]
            area += px * qy - py * qx
        out[pair] = area / 2.0


@compile_kernel
def _compute_side(p: Floats, q: Floats, x: float, y: float) -> Any:
    """Return twice the signed area of p, q and (x, y): positive to the left of p → q."""
    return (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])


@compile_kernel
def _touch(a: Floats, b: Floats) -> bool:
    """Tell whether no edge of either square has the other wholly to its right."""
    for one, other in ((a, b), (b, a)):
        for edge in range(4):
            apart = True
            for k in range(4):
                if _compute_side(one[edge], one[(edge + 1) % 4], other[k, 0], other[k, 1]) >= 0.0:
                    apart = False
            if apart:
                return False
    return True


@compile_kernel
def _compute_corner_distance(a: Floats, b: Floats) -> float:
    """Return the smallest squared distance from a corner of ``a`` to an edge of ``b``."""
    best = np.inf
    for k in range(4):
        for edge in range(4):
            p, q = b[edge], b[(edge + 1) % 4]
            dx, dy = q[0] - p[0], q[1] - p[1]
            ex, ey = a[k, 0] - p[0], a[k, 1] - p[1]
            t = min(max((ex * dx + ey * dy) / (dx * dx + dy * dy), 0.0), 1.0)
            best = min(best, (ex - t * dx) ** 2 + (ey - t * dy) ** 2)
    return best


@compile_kernel
def _clip(polygon: Floats, corners: int, p: Floats, q: Floats, out: Floats) -> int:
    """Keep what lies to the left of p → q (Sutherland and Hodgman 1974); return its corners."""
    kept = 0
    for k in range(corners):
        a, b = polygon[k], polygon[(k + 1) % corners]
        left, right = _compute_side(p, q, a[0], a[1]), _compute_side(p, q, b[0], b[1])
        if left >= 0.0:
            out[kept, 0], out[kept, 1] = a[0], a[1]
            kept += 1
        if left * right < 0.0:
            for c in range(2):
                out[kept, c] = a[c] + (b[c] - a[c]) * (left / (left - right))
            kept += 1
    return kept
