"""Sampling many patches from one map: ordered along a space-filling curve, tile by tile, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.terrain.layers import HEIGHT_STEP_M, LAYERS
from tcpipe.terrain.patches import PatchFrames, chord_px, map_px_from_patch
from tcpipe.terrain.sampling_kernel import sample_tiles
from tcpipe.terrain.tiles import MapReader, TilePool, groups_by_tile, level_for

_MOVED_ROWS = 128
"""Patches moved at once: they stay in the processor's cache on the way."""


@dataclass(frozen=True, slots=True)
class Patches:
    """N sampled patches; ``ortho`` and ``terrain`` are None where the map has no such layer.

    Layers as in `tcpipe.terrain.layers`; the other arrays have shape (N,): smallest height [m], slopes of the fitted plane [rad], valid
    share, share clipped by the tensor, majority class under the chord (0: none) and its share.
    """

    ortho: NDArray[np.uint8] | None
    terrain: NDArray[np.uint8] | None
    height: NDArray[np.uint16]
    height_min_m: NDArray[np.float64]
    slope_rad: NDArray[np.float64]
    cross_slope_rad: NDArray[np.float64]
    valid_fraction: NDArray[np.float64]
    height_clipped_fraction: NDArray[np.float64]
    terrain_class: NDArray[np.uint8]
    terrain_purity: NDArray[np.float64]

    def only(self, good: NDArray[np.bool_]) -> Patches:
        """Return the good patches, in their order; their pixels move together in place, and these patches are void."""
        rising = np.flatnonzero(good)
        layers: list[NDArray[Any]] = [layer for layer in (self.ortho, self.terrain, self.height) if layer is not None]
        for layer, first in product(layers, range(0, len(rising), _MOVED_ROWS)):
            here = rising[first : first + _MOVED_ROWS]
            layer[first : first + len(here)] = layer[here]
        found: dict[str, Any] = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        for name, values in found.items():
            found[name] = None if values is None else values[: len(rising)] if name in LAYERS else values[good]
        return Patches(**found)


def sample_patches(
    source: MapReader,
    frames: PatchFrames,
    chord_m: NDArray[np.float64],
    *,
    patch_m: float,
    patch_px: int,
    pool: TilePool | None = None,
) -> Patches:
    """Return the patches of all frames, in their order, sampled tile by tile from the level of the map that fits them.

    Parameters
    ----------
    source
        The map.
    frames
        Where the patches lie, in the map's CRS.
    chord_m
        Length of each segment on the ground [m], shape (N,).
    patch_m, patch_px
        Side of a patch on the ground [m], and in pixels.
    pool
        Tiles of the level `level_for` the patches' pitch, to go on with from call to call; None holds them for this call alone.
    """
    level = level_for(source, patch_m / patch_px)
    pixels = map_px_from_patch(frames, level.grid, patch_m=patch_m, patch_px=patch_px)
    points = max(round(patch_px * float(np.median(chord_m)) / patch_m), 1) if chord_m.size else 1
    chords = chord_px(frames, level.grid, chord_m=chord_m, points=points)
    boxes = _boxes(pixels, patch_px, chords, points)
    has_ortho, has_terrain = "ortho" in level.layers, "terrain" in level.layers
    shape, nothing = (chord_m.size, patch_px, patch_px), (0, patch_px, patch_px)
    height = np.empty(shape, np.uint16)
    ortho, terrain = (np.empty(shape if has else nothing, np.uint8) for has in (has_ortho, has_terrain))
    stats = np.empty((chord_m.size, 7))
    pool, pitch_m = pool or TilePool(level), patch_m / patch_px
    for chosen in groups_by_tile(level.grid.px_from_xy(frames.centre_xy_m), level):
        pool.hold(boxes[chosen])
        where = (pool.slots, *pool.tile_shape, chosen, boxes, pixels, chords, points, pitch_m, HEIGHT_STEP_M)
        sample_tiles(*pool.layers, *where, height, ortho, terrain, stats)
    return Patches(
        ortho=ortho if has_ortho else None,
        terrain=terrain if has_terrain else None,
        height=height,
        height_min_m=stats[:, 0] + level.height_reference_m,
        slope_rad=stats[:, 1],
        cross_slope_rad=stats[:, 2],
        valid_fraction=stats[:, 3],
        height_clipped_fraction=stats[:, 4],
        terrain_class=stats[:, 5].astype(np.uint8),
        terrain_purity=stats[:, 6],
    )


def _boxes(pixels: NDArray[np.float64], patch_px: int, chords: NDArray[np.float64], points: int) -> NDArray[np.int64]:
    """Return the map pixels that each patch and its chord touch: first row and column, last row and column (exclusive), (N, 4)."""
    first, along, down = pixels[:, :2], pixels[:, 2:4] * (patch_px - 1), pixels[:, 4:6] * (patch_px - 1)
    begin, end = chords[:, :2], chords[:, :2] + chords[:, 2:] * (points - 1)
    touched = np.stack([first, first + along, first + down, first + along + down, begin, end])[..., ::-1]
    low, high = np.floor(touched.min(axis=0)) - 1, np.floor(touched.max(axis=0)) + 3
    return np.hstack([low, high]).astype(np.int64)
