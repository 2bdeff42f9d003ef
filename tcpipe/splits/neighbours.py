"""Near pairs of square footprints, by their corners in one metric plane, in bounded memory; compiled for millions of pairs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tcpipe.compiled import compile_kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CHUNK = 16_384
"""Footprints looked at together."""

CLOSE = 1.05
"""Ground nearer than so many chords to a training sample counts as covered: consecutive samples are one chord apart."""

PLACES = ("start_lon_deg", "start_lat_deg", "end_lon_deg", "end_lat_deg")
"""Columns of a chord's ends."""

_M_A_DEG = 111_195.0  # of a great circle: to half a per cent


def compute_middles_deg(ends: Mapping[str, NDArray[np.generic]]) -> Floats:
    """Return lon, lat [deg] of the middles of chords, shape (N, 2), by the columns `PLACES`."""
    x0, y0, x1, y1 = (ends[name].astype(np.float64) for name in PLACES)
    return np.column_stack([(x0 + x1) / 2.0, (y0 + y1) / 2.0])


def are_near(ours_deg: Floats, theirs_deg: Floats, *, within_m: float) -> NDArray[np.bool_]:
    """Return which of ``ours``, lon, lat [deg], shape (N, 2), are at most so far from one of ``theirs``; NaN is near nothing."""
    scale = _M_A_DEG * np.array([np.cos(np.radians(np.nanmean(ours_deg[:, 1]))) if len(ours_deg) else 1.0, 1.0])
    known, others = np.isfinite(ours_deg).all(axis=1), theirs_deg[np.isfinite(theirs_deg).all(axis=1)]
    found = np.zeros(len(ours_deg), np.bool_)
    if known.any() and len(others):
        origin = others[0]
        tree = cKDTree((others - origin) * scale)
        apart_m, _ = tree.query((ours_deg[known] - origin) * scale, distance_upper_bound=within_m)
        found[known] = np.isfinite(apart_m)
    return found


def iterate_near_pairs(ours_xy_m: Floats, theirs_xy_m: Floats, *, within_m: float) -> Iterator[tuple[Ints, Ints]]:
    """Yield the index pairs of points at most ``within_m`` apart [m]: ``ours`` (N, 2) against ``theirs`` (M, 2), chunk by chunk of ours."""
    if len(ours_xy_m) == 0 or len(theirs_xy_m) == 0:
        return
    tree = cKDTree(theirs_xy_m)
    for first in range(0, len(ours_xy_m), _CHUNK):
        mine = cKDTree(ours_xy_m[first : first + _CHUNK])
        found = mine.sparse_distance_matrix(tree, within_m, output_type="ndarray")
        order = np.lexsort((found["j"], found["i"]))
        yield found["i"][order] + first, found["j"][order]


def compute_shared_fraction(ours: Floats, theirs: Floats, i: Ints, j: Ints) -> Floats:
    """Return the share of the ground of ``ours[i]`` that ``theirs[j]`` covers too, (P,); corners counter-clockwise, (N, 4, 2)."""
    shared_m2 = np.empty(len(i))
    pair_overlaps(ours, theirs, i, j, shared_m2)
    side_m = np.linalg.norm(ours[:, 1] - ours[:, 0], axis=1)
    return np.asarray(shared_m2 / side_m[i] ** 2)


def compute_nearest_m(ours: Floats, theirs: Floats) -> Floats:
    """Return the distance from each of ``ours`` to the nearest of ``theirs`` [m], (N,); empty if either is.

    Both are corners of squares of one size, shape (N, 4, 2) and (M, 4, 2).
    """
    if len(ours) == 0 or len(theirs) == 0:
        return np.empty(0)
    tree = cKDTree(theirs.mean(axis=1))
    reach_m = _compute_half_diagonal_m(ours) + _compute_half_diagonal_m(theirs)
    best_m = np.full(len(ours), np.inf)
    pending = [(rows, 8) for rows in _split_points(np.arange(len(ours)), _CHUNK)]
    while pending:
        rows, count = pending.pop()
        asked = min(count, len(theirs))
        distances_m, j = tree.query(ours[rows].mean(axis=1), k=np.arange(1, asked + 1))
        apart_m = np.empty(j.size)
        pair_distances(ours, theirs, np.repeat(rows, asked), j.reshape(-1).astype(np.int64), apart_m)
        best_m[rows] = apart_m.reshape(-1, asked).min(axis=1)
        # squares are nearer than their centres by at most two half diagonals: what is farther still cannot win
        doubtful = rows[(best_m[rows] > np.asarray(distances_m)[:, -1] - reach_m) & (best_m[rows] > 0.0)]
        if asked < len(theirs):
            pending += [(part, 4 * count) for part in _split_points(doubtful, max(_CHUNK * 2 // count, 1))]
    return best_m


def _split_points(rows: Ints, size: int) -> list[Ints]:
    return [rows[first : first + size] for first in range(0, len(rows), size)]


def _compute_half_diagonal_m(corners: Floats) -> float:
    across: Floats = corners[:, 2] - corners[:, 0]
    return float(np.hypot(across[:, 0], across[:, 1]).max()) / 2.0


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
