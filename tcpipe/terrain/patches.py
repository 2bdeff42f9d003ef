"""Patch geometry: which point of the map each pixel of a patch shows (paper section IV-B; docs/explanation/rulings.md, Patch).

A patch is a square on the ground, turned so that its columns run along the segment. Where its side equals the chord, the
segment's start is the middle of its rear edge (column 0) and the end the middle of its front edge; otherwise it is centred on the
chord's midpoint. Row 0 is the left of travel. Pixel (r, c) is centred at ((c + ½)·pitch, patch/2 - (r + ½)·pitch) along and left.

The axes are taken in the map's CRS from the projected end points, so grid convergence needs no correction; and a metre of the
patch is a metre of *ground*: the projected chord over ``chord_m`` is the map's scale there (1 ± 1e-3), and the patch takes it on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import TableError
from tcpipe.tables.catalogue import read_threshold
from tcpipe.terrain.grid import MapGrid

FloatArray = NDArray[np.float64]

_MAX_SCALE_ERROR = 0.02
_PIXELS_DIFFER = "patch-pixels-unlike-map"


@dataclass(frozen=True, slots=True)
class PatchFrames:
    """Where N patches lie in the map's CRS: centre [m], and the vectors of one ground metre along and left of travel, (N, 2)."""

    centre_xy_m: FloatArray
    along_xy: FloatArray
    left_xy: FloatArray

    def rows(self, chosen: NDArray[np.int64]) -> PatchFrames:
        """Return the chosen frames, in their order."""
        return PatchFrames(self.centre_xy_m[chosen], self.along_xy[chosen], self.left_xy[chosen])


def make_patch_frames(start_xy_m: FloatArray, end_xy_m: FloatArray, chord_m: FloatArray) -> PatchFrames:
    """Return the frames of patches from their segments' projected ends.

    Parameters
    ----------
    start_xy_m, end_xy_m : end points in the map's CRS [m], shape (N, 2).
    chord_m : the segments' lengths on the ground [m], shape (N,).
    """
    along = (end_xy_m - start_xy_m) / chord_m[:, None]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return PatchFrames((start_xy_m + end_xy_m) / 2.0, along, left)


def compute_footprints(frames: PatchFrames, patch_m: float) -> FloatArray:
    """Return each patch's corners in the map's CRS [m], counter-clockwise from rear right, shape (N, 4, 2)."""
    signs = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]) * (patch_m / 2.0)
    corners: FloatArray = (
        frames.centre_xy_m[:, None, :]
        + signs[None, :, :1] * frames.along_xy[:, None, :]
        + signs[None, :, 1:] * frames.left_xy[:, None, :]
    )
    return corners


def count_corners_on(grid: MapGrid, footprint_xy_m: FloatArray) -> NDArray[np.int64]:
    """Return how many corners of each footprint, shape (N, 4, 2), lie on the map, shape (N,); what is not finite does not."""
    inside = grid.contains(np.where(np.isfinite(footprint_xy_m), footprint_xy_m, np.inf))
    return np.asarray(np.count_nonzero(inside, axis=1))


def check_scale(frames: PatchFrames) -> None:
    """Raise `TableError` if a ground metre is not nearly a metre on the map: then chords and end positions contradict each other."""
    scale = np.linalg.norm(frames.along_xy, axis=1)
    wrong = np.flatnonzero(~(np.abs(scale - 1.0) < _MAX_SCALE_ERROR))
    if wrong.size:
        raise TableError(
            f"table segments: {wrong.size} chords contradict their end positions (the first is {scale[wrong[0]]:.3f} times as long "
            "on the map); expected longitude and latitude of the same two points"
        )


def map_px_from_patch(frames: PatchFrames, grid: MapGrid, *, patch_m: float, patch_px: int) -> FloatArray:
    """Return, for each patch, the map pixel coordinates of its pixel (0, 0) and their steps.

    Returns
    -------
    numpy.ndarray : shape (N, 6): x and y of patch pixel (0, 0); dx, dy for one column forward; dx, dy for one row to the right [map px].
    """
    pixel_size_m = patch_m / patch_px
    reach_m = (patch_m - pixel_size_m) / 2.0
    first = frames.centre_xy_m - reach_m * frames.along_xy + reach_m * frames.left_xy
    down = np.array([1.0, -1.0]) * (pixel_size_m / grid.pixel_size_m)
    return np.hstack([grid.px_from_xy(first), frames.along_xy * down, -frames.left_xy * down])


def sample_chord_px(frames: PatchFrames, grid: MapGrid, *, chord_m: FloatArray, points: int) -> FloatArray:
    """Return map pixel coordinates of evenly spread points on each chord.

    Returns
    -------
    numpy.ndarray : shape (N, 4): x and y of the first point, dx and dy to the next [map px]; point k lies at (k + ½) / points of the chord.
    """
    step_m = chord_m[:, None] / points
    first = frames.centre_xy_m + frames.along_xy * (step_m - chord_m[:, None]) / 2.0
    return np.hstack([grid.px_from_xy(first), frames.along_xy * step_m * np.array([1.0, -1.0]) / grid.pixel_size_m])


def has_other_pixels(patch_pixel_m: float, map_pixel_m: float) -> bool:
    """Return whether patches ask for finer or much coarser pixels than the map's level has."""
    least, most = read_threshold(_PIXELS_DIFFER, "min_ratio"), read_threshold(_PIXELS_DIFFER, "max_ratio")
    return not least * map_pixel_m <= patch_pixel_m <= most * map_pixel_m
