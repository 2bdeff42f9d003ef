"""Sampling of many patches, or classes at points, along a space-filling curve, tile by tile, in bounded memory.

Patch geometry: the map point of each pixel of a patch (paper section IV-B; docs/explanation/rulings.md, Patch).

A patch is a square on the ground, turned so that its columns run along the segment. If its side equals the chord, the
segment's start is the middle of its rear edge (column 0) and the end the middle of its front edge; otherwise it is
centred on the chord's midpoint. Row 0 is left of travel. Pixel (r, c) is centred at ((c + ½)·pitch, patch/2 - (r +
½)·pitch) along and left.

The axes are those of the projected end points in the map's CRS, so grid convergence needs no correction. A metre of the
patch is a metre of *ground*: the projected chord over ``chord_m`` is the map's scale there (1 ± 1e-3), and scales the
patch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import AnyArray, Bytes, Floats, Ints, Mask, NamedArrays
from tcpipe.errors import TableError
from tcpipe.tables.findings import read_threshold
from tcpipe.terrain.layers import HEIGHT_NODATA, HEIGHT_STEP_M, STACKS, group_stacks
from tcpipe.terrain.sampling_kernel import Ground, Stacks, sample_tiles
from tcpipe.terrain.target_grid import MapGrid
from tcpipe.terrain.tiles import MapReader, TilePool, choose_level, group_by_tile, read_tile_window


def compute_relief_m(height: NDArray[np.uint16]) -> Floats:
    """Return the relief of patches, shape (N, px, px): largest difference of valid heights [m], shape (N,)."""
    steps = np.where(height == HEIGHT_NODATA, np.uint16(0), height).max(axis=(1, 2), initial=np.uint16(0))
    return np.asarray(steps * HEIGHT_STEP_M)


_MOVED_ROWS = 128  # patches moved together: they fit into the processor's cache


@dataclass(frozen=True, slots=True)
class Patches:
    """N sampled patches.

    ``pixels``: the map's layers by name, (N, S, S), as `tcpipe.terrain.layers` defines. The other arrays have shape
    (N,): smallest height [m], slopes of the fitted plane [rad], valid share, share clipped by the tensor, majority
    class of terrain under the chord (0: none) and its share. ``profile_m``: heights in the middle of rear edge, patch
    and front edge above the smallest [m], NaN without data, (N, 3).
    """

    pixels: NamedArrays
    height_min_m: Floats
    slope_rad: Floats
    cross_slope_rad: Floats
    valid_fraction: Floats
    height_clipped_fraction: Floats
    terrain_class: Bytes
    terrain_purity: Floats
    profile_m: Floats

    def columns(self) -> dict[str, AnyArray]:
        """Return all but the pixels, by name."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)[1:]}

    def keep_valid(self, good: Mask) -> Patches:
        """Return the good patches in order; their pixels move in place, so do not use these patches afterwards."""
        rising = np.flatnonzero(good)
        for layer, first in product(self.pixels.values(), range(0, len(rising), _MOVED_ROWS)):
            here = rising[first : first + _MOVED_ROWS]
            layer[first : first + len(here)] = layer[here]
        pixels = {name: layer[: len(rising)] for name, layer in self.pixels.items()}
        return Patches(pixels, **{name: values[good] for name, values in self.columns().items()})


def join_patches(parts: Sequence[Patches]) -> Patches:
    """Return patches one after another, all of the same layers."""
    if len(parts) == 1:
        return parts[0]
    pixels = {name: np.concatenate([part.pixels[name] for part in parts]) for name in parts[0].pixels}
    columns = [part.columns() for part in parts]
    return Patches(pixels, **{name: np.concatenate([each[name] for each in columns]) for name in columns[0]})


def sample_patches(
    source: MapReader,
    frames: PatchFrames,
    chord_m: Floats,
    *,
    patch_m: float,
    patch_px: int,
    pool: TilePool | None = None,
) -> Patches:
    """Return the patches of all frames, in their order, sampled tile by tile from the level of the map that fits them.

    Parameters
    ----------
    source : the map.
    frames : frames of the patches, in the map's CRS.
    chord_m : length of each segment on the ground [m], shape (N,).
    patch_m, patch_px : side of a patch on the ground [m], and in pixels.
    pool : tiles of the level that `choose_level` returns for the patches' pixel size, kept between calls; None keeps
        none.
    """
    level = choose_level(source, patch_m / patch_px)
    pixels = map_px_from_patch(frames, level.grid, patch_m=patch_m, patch_px=patch_px)
    points = max(round(patch_px * float(np.median(chord_m)) / patch_m), 1) if chord_m.size else 1
    chords = sample_chord_px(frames, level.grid, chord_m=chord_m, points=points)
    boxes = _compute_boxes(pixels, patch_px, chords, points)
    pixel_size_m, stacks = patch_m / patch_px, group_stacks(level.layers)
    classed = stacks["classes"].index("terrain") if "terrain" in level.layers else -1
    ground = Ground(boxes, pixels, chords, points, classed, pixel_size_m, HEIGHT_STEP_M)
    shape = (chord_m.size, patch_px, patch_px)
    floats, greys, classes = (
        np.empty((len(stacks[stack]), *shape), STACKS[stack]) for stack in ("floats", "greys", "classes")
    )
    out = Stacks(np.empty(shape, np.uint16), floats, greys, classes, np.empty((chord_m.size, 7)))
    pool = pool or TilePool(level)
    pool.expect(boxes)
    for chosen in group_by_tile(level.grid.px_from_xy(frames.centre_xy_m), level):
        pool.hold(boxes[chosen])
        sample_tiles(pool.tiles, ground, chosen, out)
    found = {
        name: out.relative if stack == "relative" else getattr(out, stack)[number]
        for stack, names in stacks.items()
        for number, name in enumerate(names)
    }
    height_m, slope_rad, cross_slope_rad, valid, clipped, terrain_class, purity = out.stats.T
    height_m, terrain_class = height_m + level.height_reference_m, terrain_class.astype(np.uint8)
    profile_m = _compute_profile(out.relative)
    return Patches(found, height_m, slope_rad, cross_slope_rad, valid, clipped, terrain_class, purity, profile_m)


def _compute_profile(height: NDArray[np.uint16]) -> Floats:
    """Return ``profile_m`` of `Patches` by stored heights, shape (N, px, px)."""
    middle = slice((height.shape[1] - 1) // 2, height.shape[1] // 2 + 1)
    along_m = np.where((line := height[:, middle]) == HEIGHT_NODATA, np.nan, line * HEIGHT_STEP_M).mean(axis=1)
    return np.stack([along_m[:, part].mean(axis=1) for part in (slice(1), middle, slice(-1, None))], axis=1)


def _compute_boxes(pixels: Floats, patch_px: int, chords: Floats, points: int) -> Ints:
    """Return the map pixels of each patch and its chord: first row and column, last (exclusive), shape (N, 4)."""
    first, along, down = pixels[:, :2], pixels[:, 2:4] * (patch_px - 1), pixels[:, 4:6] * (patch_px - 1)
    begin, end = chords[:, :2], chords[:, :2] + chords[:, 2:] * (points - 1)
    touched = np.stack([first, first + along, first + down, first + along + down, begin, end])[..., ::-1]
    low, high = np.floor(touched.min(axis=0)) - 1, np.floor(touched.max(axis=0)) + 3
    return np.hstack([low, high]).astype(np.int64)


OFF_THE_MAP = -1
"""Instead of a class id where a point is not on the map."""


def find_classes_at(source: MapReader, xy_m: Floats) -> NDArray[np.int16]:
    """Return the class id under each point, 0 without data, `OFF_THE_MAP` where the map ends, shape (N,).

    Parameters
    ----------
    source : a map with a terrain layer.
    xy_m : points in the map's CRS [m], shape (N, 2); points that are not finite are off the map.
    """
    found = np.full(len(xy_m), OFF_THE_MAP, np.int16)
    on = np.flatnonzero(source.grid.contains(xy_m))
    px = source.grid.px_from_xy(xy_m[on])
    for group in group_by_tile(px, source):
        col, row = np.floor(px[group] + 0.5).astype(np.int64).T
        col, row = np.clip(col, 0, source.grid.cols - 1), np.clip(row, 0, source.grid.rows - 1)
        top, left = int(row.min()), int(col.min())
        window = read_tile_window(source, "terrain", top, int(row.max()) + 1, left, int(col.max()) + 1)
        found[on[group]] = window[row - top, col - left]
    return found


_MAX_SCALE_ERROR = 0.02
_PIXELS_DIFFER = "patch-pixels-unlike-map"


@dataclass(frozen=True, slots=True)
class PatchFrames:
    """N patches in the map's CRS: centre [m], and vectors of one ground metre along and left of travel, (N, 2)."""

    centre_xy_m: Floats
    along_xy: Floats
    left_xy: Floats

    def rows(self, chosen: Ints) -> PatchFrames:
        """Return the chosen frames, in their order."""
        return PatchFrames(self.centre_xy_m[chosen], self.along_xy[chosen], self.left_xy[chosen])


def make_patch_frames(start_xy_m: Floats, end_xy_m: Floats, chord_m: Floats) -> PatchFrames:
    """Return the frames of patches from their segments' projected ends.

    Parameters
    ----------
    start_xy_m, end_xy_m : end points in the map's CRS [m], shape (N, 2).
    chord_m : the segments' lengths on the ground [m], shape (N,).
    """
    along = (end_xy_m - start_xy_m) / chord_m[:, None]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return PatchFrames((start_xy_m + end_xy_m) / 2.0, along, left)


def compute_footprints(frames: PatchFrames, patch_m: float) -> Floats:
    """Return each patch's corners in the map's CRS [m], counter-clockwise from rear right, shape (N, 4, 2)."""
    signs = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]) * (patch_m / 2.0)
    return (
        frames.centre_xy_m[:, None, :]
        + signs[None, :, :1] * frames.along_xy[:, None, :]
        + signs[None, :, 1:] * frames.left_xy[:, None, :]
    )


def count_corners_on(grid: MapGrid, footprint_xy_m: Floats) -> Ints:
    """Return the number of corners of each footprint, shape (N, 4, 2), on the map, shape (N,)."""
    return np.asarray(np.count_nonzero(grid.contains(footprint_xy_m), axis=1))


def check_scale(frames: PatchFrames) -> None:
    """Raise `TableError` if a ground metre is not a metre on the map: chords contradict their end positions."""
    scale = np.linalg.norm(frames.along_xy, axis=1)
    wrong = np.flatnonzero(~(np.abs(scale - 1.0) < _MAX_SCALE_ERROR))
    if wrong.size:
        raise TableError(
            f"table segments: {wrong.size} chords contradict their end positions "
            f"(the first is {scale[wrong[0]]:.3f} times as long "
            "on the map); expected longitude and latitude of the same two points"
        )


def map_px_from_patch(frames: PatchFrames, grid: MapGrid, *, patch_m: float, patch_px: int) -> Floats:
    """Return where patches begin on the map, and their steps, shape (N, 6) [map px].

    These are x and y of patch pixel (0, 0); dx, dy for one column forward; dx, dy for one row to the right.
    """
    pixel_size_m = patch_m / patch_px
    reach_m = (patch_m - pixel_size_m) / 2.0
    first = frames.centre_xy_m - reach_m * frames.along_xy + reach_m * frames.left_xy
    down = np.array([1.0, -1.0]) * (pixel_size_m / grid.pixel_size_m)
    return np.hstack([grid.px_from_xy(first), frames.along_xy * down, -frames.left_xy * down])


def sample_chord_px(frames: PatchFrames, grid: MapGrid, *, chord_m: Floats, points: int) -> Floats:
    """Return evenly spread points on each chord: x and y of the first, dx and dy to the next, shape (N, 4) [map px].

    Point k is at (k + ½) / points of the chord.
    """
    step_m = chord_m[:, None] / points
    first = frames.centre_xy_m + frames.along_xy * (step_m - chord_m[:, None]) / 2.0
    return np.hstack([grid.px_from_xy(first), frames.along_xy * step_m * np.array([1.0, -1.0]) / grid.pixel_size_m])


def has_other_pixels(patch_pixel_m: float, map_pixel_m: float) -> bool:
    """Return whether patches ask for finer or much coarser pixels than the map's level has."""
    least, most = read_threshold(_PIXELS_DIFFER, "min_ratio"), read_threshold(_PIXELS_DIFFER, "max_ratio")
    return not least * map_pixel_m <= patch_pixel_m <= most * map_pixel_m
