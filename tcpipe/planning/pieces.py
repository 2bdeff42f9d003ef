"""A path cut into pieces of one chord, as segments of a drive are (paper, section III-A): each ends where the path first is d away."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from tcpipe.terrain.patches import PatchFrames, patch_frames
from tcpipe.terrain.projection import metres_from_plane

Floats = NDArray[np.float64]

_LEAST_M = 1e-3
"""A rest shorter than this is the rounding of coordinates, not a piece [m]."""


@dataclass(frozen=True, slots=True)
class Pieces:
    """N pieces of a path, in order.

    Attributes
    ----------
    start_xy_m, end_xy_m : in the map's CRS [m], shape (N, 2).
    chord_m, arc_m : straight and along the path, on the ground [m], shape (N,); ``chord_m`` is d but for the last.
    scale : ground metres a map metre.
    """

    start_xy_m: Floats
    end_xy_m: Floats
    chord_m: Floats
    arc_m: Floats
    scale: float

    def frames(self, chord_m: float) -> PatchFrames:
        """Return the patch of each piece; that of a shorter last one ends with it and reaches back over the piece before."""
        along = (self.end_xy_m - self.start_xy_m) / np.linalg.norm(self.end_xy_m - self.start_xy_m, axis=1)[:, None]
        start = self.end_xy_m - along * (chord_m / self.scale)
        return patch_frames(start, self.end_xy_m, np.full(len(start), chord_m))


def ground_scale(crs: CRS, xy_m: Floats) -> float:
    """Return metres of ground a metre of the map's plane, the mean over points of shape (N, 2)."""
    return float(np.mean(np.sqrt(np.abs(np.linalg.det(metres_from_plane(crs, xy_m))))))


def cut_path(xy_m: Floats, *, chord_m: float, scale: float) -> Pieces:
    """Return the pieces of a polyline.

    Parameters
    ----------
    xy_m : its points in the map's CRS [m], shape (P, 2).
    chord_m : d, on the ground [m].
    scale : ground metres a map metre; over the some kilometres that a robot drives it is one number to 1e-5.
    """
    points = xy_m[np.r_[True, (np.diff(xy_m, axis=0) != 0.0).any(axis=1)]]
    cuts = _cuts(points.tolist(), chord_m / scale)
    ends = np.array([(x, y) for x, y, _ in cuts]).reshape(-1, 2)
    arc = np.diff(np.array([length for _, _, length in cuts])) * scale
    chord = np.linalg.norm(np.diff(ends, axis=0), axis=1) * scale
    return Pieces(ends[:-1], ends[1:], chord, arc, scale)


def _cuts(points: list[list[float]], radius: float) -> list[tuple[float, float, float]]:
    """Return x, y and length so far of the path's start, of each cut and, if a rest is left, of its end."""
    (x0, y0), length = points[0], 0.0
    cuts = [(x0, y0, 0.0)]
    for (ax, ay), (bx, by) in pairwise(points):
        side = math.hypot(bx - ax, by - ay)
        ux, uy = (bx - ax) / side, (by - ay) / side
        while True:  # the point at s along this side is `radius` from the last cut
            along, off = (x0 - ax) * ux + (y0 - ay) * uy, (x0 - ax) * uy - (y0 - ay) * ux
            s = along + math.sqrt(max(radius * radius - off * off, 0.0))
            if s > side:
                break
            x0, y0 = ax + s * ux, ay + s * uy
            cuts.append((x0, y0, length + s))
        length += side
    rest = math.hypot(points[-1][0] - x0, points[-1][1] - y0)
    if rest > _LEAST_M and length - cuts[-1][2] > _LEAST_M:
        cuts.append((points[-1][0], points[-1][1], length))
    return cuts
