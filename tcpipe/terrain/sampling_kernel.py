"""The compiled heart of sampling: patches straight from a map's tiles, one resampling a layer.

Height and orthophoto are bilinear, class is nearest; a tap without data makes the pixel invalid. Heights are interpolated relative to
the height under the patch's centre, so that single precision keeps 0.1 mm on any mountain.

A patch's surroundings are first copied from the tiles into a small window that stays in the processor's cache, in runs of fixed length
that become single instructions; the four taps of a byte layer are packed into one word, so that each is one load. Indices are unsigned,
since numba tests signed ones for Python's counting from the end. The rest is passes over patch rows that the compiler can vectorise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import kernel

RUN_PX = 16
"""Pixels copied at once; windows are a multiple of it wide."""

HEIGHT_NODATA = np.uint16(65535)
"""A stored height without data (`tcpipe.terrain.layers.HEIGHT_NODATA`), as kernels compare it."""


@kernel
def sample_tiles(
    height: NDArray[np.float32],
    ortho: NDArray[np.uint8],
    terrain: NDArray[np.uint8],
    slots: NDArray[np.int32],
    tile_rows: int,
    tile_cols: int,
    chosen: NDArray[np.int64],
    boxes: NDArray[np.int64],
    frames: NDArray[np.float64],
    chords: NDArray[np.float64],
    chord_points: int,
    pitch_m: float,
    step_m: float,
    out_height: NDArray[np.uint16],
    out_ortho: NDArray[np.uint8],
    out_terrain: NDArray[np.uint8],
    out_stats: NDArray[np.float64],
) -> None:
    """Sample patches from tiles that are in memory.

    Parameters
    ----------
    height, ortho, terrain
        Tiles one after another, flat: float32 [m] with NaN as no data, uint8 and uint8 with 0 as no data; empty where the map has no such
        layer.
    slots
        Which of them is the tile in row i and column j of the map, shape (A, B); -1 where there is none, which is ground without data.
    tile_rows, tile_cols
        Pixels of a tile.
    chosen
        Which patches to sample: rows of all that follows, shape (n,).
    boxes
        First row and column, last row and column (exclusive) of the map pixels that a patch and its chord touch, taps and a pixel all
        around included, shape (N, 4).
    frames, chords
        Affine map pixel positions (`patches.map_px_from_patch`, `patches.chord_px`), shapes (N, 6), (N, 4).
    chord_points
        Points on the chord to take the class at.
    pitch_m, step_m
        Side of a patch pixel on the ground [m]; one step of a stored height [m].
    out_height, out_ortho, out_terrain
        Shape (N, S, S): uint16 steps above the smallest (65535 no data), uint8, uint8; of length 0 where the map has no such layer.
    out_stats
        Shape (N, 7), float64: smallest height [m], slope along and to the left [rad], valid fraction, share of valid pixels more than 1 m
        above the smallest, majority class under the chord, its share.
    """
    side = out_height.shape[1]
    has_ortho, has_terrain = ortho.size > 0, terrain.size > 0
    most = 0
    for n in chosen:
        most = max(most, (boxes[n, 2] - boxes[n, 0] + 2) * _width(boxes[n]) + 2 * RUN_PX)
    near_height = np.zeros(most, np.float32)
    near_ortho, near_terrain = np.ones(most, np.uint8), np.ones(most, np.uint8)
    taps = np.zeros(most, np.uint32)
    at = np.empty(side * side, np.uint32)
    fx, fy = np.empty(side * side, np.float32), np.empty(side * side, np.float32)
    rise = np.empty(side * side, np.float32)
    good = np.ones(side * side, np.uint8)
    votes = np.zeros(256, np.int64)
    for n in chosen:
        box, frame = boxes[n], frames[n]
        width, rows = _width(box), box[2] - box[0]
        heights = out_height[n].reshape(-1)
        greys = out_ortho[n].reshape(-1) if has_ortho else out_ortho.reshape(-1)
        classes = out_terrain[n].reshape(-1) if has_terrain else out_terrain.reshape(-1)
        middle_x = np.int64(np.floor(frame[0] + 0.5 * (side - 1) * (frame[2] + frame[4])))
        middle_y = np.int64(np.floor(frame[1] + 0.5 * (side - 1) * (frame[3] + frame[5])))
        reference = _height_at(height, slots, tile_rows, tile_cols, middle_y, middle_x)
        _copy_near(
            height, ortho, terrain, slots, tile_rows, tile_cols, box, reference, near_height, near_ortho, near_terrain
        )
        _find_positions(width, box, frame, side, at, fx, fy)
        _sample_height(near_height, width, at, fx, fy, rise)
        if has_ortho:
            _pack_taps(near_ortho, width, rows, taps)
            _sample_ortho(taps, at, fx, fy, greys)
        whole, count = _is_whole(near_height, near_ortho, near_terrain, rows * width), side * side
        if not whole:
            count = _find_good(rise, taps, greys, at, good)
        if has_terrain:
            _pack_taps(near_terrain, width, rows, taps)
            _sample_terrain(taps, at, fx, fy, classes)
            if not whole:
                count = _find_classed(classes, good)
        if count == side * side:
            lowest, clipped = _store_height(rise, step_m, heights)
            along, left = _slopes(rise, side)
        else:
            lowest, clipped = _store_good_height(rise, good, step_m, heights)
            along, left = _good_slopes(rise, good, side)
            _clear(greys, good)
            _clear(classes, good)
        entry, share = np.int64(0), 0.0
        if has_terrain:
            entry, share = _class_under(near_terrain, width, box, chords[n], chord_points, votes)
        out_stats[n, 0] = np.float64(reference) + np.float64(lowest)
        out_stats[n, 1] = np.arctan(along / pitch_m)
        out_stats[n, 2] = np.arctan(left / pitch_m)
        out_stats[n, 3] = count / (side * side)
        out_stats[n, 4] = clipped / max(count, 1)
        out_stats[n, 5] = entry
        out_stats[n, 6] = share


@kernel
def _width(box: NDArray[np.int64]) -> int:
    return int((box[3] - box[1] + RUN_PX - 1) // RUN_PX * RUN_PX)


@kernel
def _slot(slots: NDArray[np.int32], i: int, j: int) -> int:
    return slots[i, j] if 0 <= i < slots.shape[0] and 0 <= j < slots.shape[1] else -1


@kernel
def _height_at(
    height: NDArray[np.float32], slots: NDArray[np.int32], tile_rows: int, tile_cols: int, row: int, col: int
) -> np.float32:
    """Return a pixel's height; 0 where it has none."""
    i, j = row // tile_rows, col // tile_cols
    slot = _slot(slots, i, j)
    if slot < 0:
        return np.float32(0.0)
    found = height[(slot * tile_rows + row - i * tile_rows) * tile_cols + col - j * tile_cols]
    return found if np.isfinite(found) else np.float32(0.0)


@kernel
def _copy_near(
    height: NDArray[np.float32],
    ortho: NDArray[np.uint8],
    terrain: NDArray[np.uint8],
    slots: NDArray[np.int32],
    tile_rows: int,
    tile_cols: int,
    box: NDArray[np.int64],
    reference: np.float32,
    near_height: NDArray[np.float32],
    near_ortho: NDArray[np.uint8],
    near_terrain: NDArray[np.uint8],
) -> None:
    """Copy a box of the map from one or more tiles, row by row; what a run carries too far, the next one overwrites."""
    run, width, size = np.uint64(RUN_PX), _width(box), np.uint64(height.size)
    has_ortho, has_terrain = ortho.size > 0, terrain.size > 0
    first_j, last_j = box[1] // tile_cols, (box[3] - 1) // tile_cols
    for i in range(box[0] // tile_rows, (box[2] - 1) // tile_rows + 1):
        for row in range(max(box[0], i * tile_rows), min(box[2], (i + 1) * tile_rows)):
            for j in range(first_j, last_j + 1):
                begin, end = max(box[1], j * tile_cols), min(box[3], (j + 1) * tile_cols)
                there = np.uint64((row - box[0]) * width + begin - box[1])
                count = np.uint64(end - begin)
                slot = _slot(slots, i, j)
                if slot < 0:
                    for k in range(count):
                        near_height[there + k] = np.nan
                        near_ortho[there + k] = 0 if has_ortho else 1
                        near_terrain[there + k] = 0 if has_terrain else 1
                    continue
                here = np.uint64((slot * tile_rows + row - i * tile_rows) * tile_cols + begin - j * tile_cols)
                stop = there + count
                while there < stop and here + run <= size:
                    for k in range(run):
                        near_height[there + k] = height[here + k] - reference
                    if has_ortho:
                        for k in range(run):
                            near_ortho[there + k] = ortho[here + k]
                    if has_terrain:
                        for k in range(run):
                            near_terrain[there + k] = terrain[here + k]
                    there += run
                    here += run
                while there < stop:  # the last pixels of all
                    near_height[there] = height[here] - reference
                    if has_ortho:
                        near_ortho[there] = ortho[here]
                    if has_terrain:
                        near_terrain[there] = terrain[here]
                    there += np.uint64(1)
                    here += np.uint64(1)


@kernel
def _is_whole(
    near_height: NDArray[np.float32], near_ortho: NDArray[np.uint8], near_terrain: NDArray[np.uint8], count: int
) -> bool:
    """Tell whether no pixel of the window lacks data."""
    broken, least = np.uint32(0), np.uint8(255)
    for k in range(count):
        broken |= np.uint32(near_height[k] != near_height[k])  # true for NaN
    for k in range(count):
        least = min(least, near_ortho[k])
    for k in range(count):
        least = min(least, near_terrain[k])
    return bool(broken == 0 and least > 0)


@kernel
def _pack_taps(near: NDArray[np.uint8], width: int, rows: int, taps: NDArray[np.uint32]) -> None:
    """Put each pixel and its right, lower and lower right neighbours into one word, from the lowest byte up."""
    one, run, stride = np.uint64(1), np.uint64(RUN_PX), np.uint64(width)
    b8, b16, b24 = np.uint32(8), np.uint32(16), np.uint32(24)
    for j in range(np.uint64((rows - 1) * width) // run):
        for k in range(run):
            i = j * run + k
            upper = np.uint32(near[i]) | np.uint32(near[i + one]) << b8
            lower = np.uint32(near[i + stride]) << b16 | np.uint32(near[i + stride + one]) << b24
            taps[i] = upper | lower


@kernel
def _find_positions(
    width: int,
    box: NDArray[np.int64],
    frame: NDArray[np.float64],
    side: int,
    at: NDArray[np.uint32],
    fx: NDArray[np.float32],
    fy: NDArray[np.float32],
) -> None:
    """Find which window pixel lies left above each patch pixel, and how far right and below of it that is [px]."""
    ax, ay, bx, by = np.float32(frame[2]), np.float32(frame[3]), np.float32(frame[4]), np.float32(frame[5])
    lx, ly, stride = np.float32(frame[0] - box[1]), np.float32(frame[1] - box[0]), np.uint32(width)
    for r in range(np.uint64(side)):
        rx, ry = lx + bx * np.float32(np.int32(r)), ly + by * np.float32(np.int32(r))
        first = r * np.uint64(side)
        for c in range(np.uint64(side)):
            x, y = rx + ax * np.float32(np.int32(c)), ry + ay * np.float32(np.int32(c))
            ix, iy = np.int32(x), np.int32(y)
            fx[first + c], fy[first + c] = x - np.float32(ix), y - np.float32(iy)
            at[first + c] = np.uint32(iy) * stride + np.uint32(ix)


@kernel
def _sample_height(
    near: NDArray[np.float32],
    width: int,
    at: NDArray[np.uint32],
    fx: NDArray[np.float32],
    fy: NDArray[np.float32],
    rise: NDArray[np.float32],
) -> None:
    one, stride = np.uint64(1), np.uint64(width)
    for k in range(np.uint64(rise.size)):
        i = np.uint64(at[k])
        h00, h01 = near[i], near[i + one]
        h10, h11 = near[i + stride], near[i + stride + one]
        upper = h00 + fx[k] * (h01 - h00)
        lower = h10 + fx[k] * (h11 - h10)
        rise[k] = upper + fy[k] * (lower - upper)


@kernel
def _sample_ortho(
    taps: NDArray[np.uint32],
    at: NDArray[np.uint32],
    fx: NDArray[np.float32],
    fy: NDArray[np.float32],
    out: NDArray[np.uint8],
) -> None:
    b8, b16, b24, byte, half = np.uint32(8), np.uint32(16), np.uint32(24), np.uint32(255), np.float32(0.5)
    for k in range(np.uint64(out.size)):
        four = taps[np.uint64(at[k])]
        o00, o01 = np.float32(np.int32(four & byte)), np.float32(np.int32(four >> b8 & byte))
        o10, o11 = np.float32(np.int32(four >> b16 & byte)), np.float32(np.int32(four >> b24))
        upper = o00 + fx[k] * (o01 - o00)
        lower = o10 + fx[k] * (o11 - o10)
        out[k] = np.uint8(np.int32(upper + fy[k] * (lower - upper) + half))


@kernel
def _sample_terrain(
    taps: NDArray[np.uint32],
    at: NDArray[np.uint32],
    fx: NDArray[np.float32],
    fy: NDArray[np.float32],
    out: NDArray[np.uint8],
) -> None:
    none, b8, b16, byte, half = np.uint32(0), np.uint32(8), np.uint32(16), np.uint32(255), np.float32(0.5)
    for k in range(np.uint64(out.size)):
        shift = (b8 if fx[k] >= half else none) + (b16 if fy[k] >= half else none)
        out[k] = np.uint8(np.int32(taps[np.uint64(at[k])] >> shift & byte))


@kernel
def _find_good(
    rise: NDArray[np.float32],
    taps_ortho: NDArray[np.uint32],
    greys: NDArray[np.uint8],
    at: NDArray[np.uint32],
    good: NDArray[np.uint8],
) -> int:
    """Find the pixels of which neither height nor orthophoto (``greys`` is empty without one) lacks a tap; return how many."""
    b8, b16, b24, byte = np.uint32(8), np.uint32(16), np.uint32(24), np.uint32(255)
    count = 0
    for k in range(rise.size):
        whole = rise[k] == rise[k]  # false for NaN
        if greys.size > 0:
            four = taps_ortho[at[k]]
            whole &= (four & byte != 0) & (four >> b8 & byte != 0) & (four >> b16 & byte != 0) & (four >> b24 != 0)
        good[k] = whole
        count += good[k]
    return count


@kernel
def _find_classed(classes: NDArray[np.uint8], good: NDArray[np.uint8]) -> int:
    """Leave good what has a class; return how many."""
    count = 0
    for k in range(classes.size):
        good[k] &= np.uint8(classes[k] != 0)
        count += good[k]
    return count


@kernel
def _store_height(rise: NDArray[np.float32], step_m: float, out: NDArray[np.uint16]) -> tuple[np.float32, int]:
    """Store heights of a whole patch in steps above the smallest; return that, and how many lie more than a metre above it."""
    lanes = np.full(RUN_PX, np.inf, np.float32)
    count = np.uint64(rise.size)
    for j in range(count // np.uint64(RUN_PX)):
        for c in range(np.uint64(RUN_PX)):
            value = rise[j * np.uint64(RUN_PX) + c]
            lanes[c] = value if value < lanes[c] else lanes[c]  # noqa: FURB136  (vectorises, min does not)
    lowest = lanes.min()
    for k in range(count // np.uint64(RUN_PX) * np.uint64(RUN_PX), count):
        lowest = min(lowest, rise[k])
    inverse_step, most, half = np.float32(1.0 / step_m), np.float32(HEIGHT_NODATA - 1), np.float32(0.5)
    clipped = np.uint32(0)
    for k in range(count):
        above = rise[k] - lowest
        clipped += np.uint32(above > np.float32(1.0))
        steps = above * inverse_step + half
        out[k] = np.uint16(np.int32(steps if steps < most else most))  # noqa: FURB136
    return lowest, int(np.int64(clipped))


@kernel
def _store_good_height(
    rise: NDArray[np.float32], good: NDArray[np.uint8], step_m: float, out: NDArray[np.uint16]
) -> tuple[np.float32, int]:
    """Store heights as `_store_height` does, of good pixels alone."""
    lowest, clipped = np.float32(np.inf), 0
    for k in range(rise.size):
        if good[k]:
            lowest = min(lowest, rise[k])
    lowest = lowest if np.isfinite(lowest) else np.float32(0.0)
    for k in range(rise.size):
        out[k] = HEIGHT_NODATA
        if good[k]:
            above = rise[k] - lowest
            clipped += above > np.float32(1.0)
            out[k] = np.uint16(min(above * np.float32(1.0 / step_m) + np.float32(0.5), np.float32(HEIGHT_NODATA - 1)))
    return lowest, clipped


@kernel
def _clear(out: NDArray[np.uint8], good: NDArray[np.uint8]) -> None:
    for k in range(out.size):
        out[k] = out[k] if good[k] else 0


@kernel
def _slopes(rise: NDArray[np.float32], side: int) -> tuple[float, float]:
    """Return the fitted plane's rise for one pixel along and one to the left: weighted sums, since the grid is symmetric."""
    of_column = np.zeros(side, np.float32)
    left_of_column = np.zeros(side, np.float32)
    middle = 0.5 * (side - 1)
    columns = np.uint64(side)
    for r in range(columns):
        v, first = np.float32(middle - np.float64(np.int32(r))), r * columns
        for c in range(columns):
            of_column[c] += rise[first + c]
            left_of_column[c] += v * rise[first + c]
    along = across = 0.0
    for c in range(side):
        along += (c - middle) * of_column[c]
        across += left_of_column[c]
    weight = side * side * (side * side - 1) / 12.0
    return along / weight, across / weight


@kernel
def _good_slopes(rise: NDArray[np.float32], good: NDArray[np.uint8], side: int) -> tuple[float, float]:
    """Return what `_slopes` does, of good pixels alone; 0 where they do not span a plane."""
    middle = 0.5 * (side - 1)
    count = su = sv = suu = suv = svv = sh = suh = svh = 0.0
    for r in range(side):
        for c in range(side):
            if good[r * side + c]:
                u, v, h = c - middle, middle - r, np.float64(rise[r * side + c])
                count += 1.0
                su += u
                sv += v
                suu += u * u
                suv += u * v
                svv += v * v
                sh += h
                suh += u * h
                svh += v * h
    count = max(count, 1.0)
    suu, suv, svv = suu - su * su / count, suv - su * sv / count, svv - sv * sv / count
    suh, svh = suh - su * sh / count, svh - sv * sh / count
    determinant = suu * svv - suv * suv
    if determinant <= 1e-9 * max(suu * svv, 1.0):
        return 0.0, 0.0
    return (suh * svv - svh * suv) / determinant, (svh * suu - suh * suv) / determinant


@kernel
def _class_under(
    near: NDArray[np.uint8],
    width: int,
    box: NDArray[np.int64],
    chord: NDArray[np.float64],
    points: int,
    votes: NDArray[np.int64],
) -> tuple[np.int64, float]:
    """Return the commonest class at points on the chord and its share of those that have one; ties go low. ``votes`` stay zero."""
    for k in range(points):
        col = np.int64(np.floor(chord[0] + chord[2] * k + 0.5)) - box[1]
        row = np.int64(np.floor(chord[1] + chord[3] * k + 0.5)) - box[0]
        votes[near[row * width + col]] += 1
    best, missing = np.int64(0), votes[0]
    for k in range(points):
        col = np.int64(np.floor(chord[0] + chord[2] * k + 0.5)) - box[1]
        row = np.int64(np.floor(chord[1] + chord[3] * k + 0.5)) - box[0]
        entry = np.int64(near[row * width + col])
        if entry > 0 and (best == 0 or votes[entry] > votes[best] or (votes[entry] == votes[best] and entry < best)):
            best = entry
    share = votes[best] / (points - missing) if best > 0 else 0.0
    for k in range(points):
        col = np.int64(np.floor(chord[0] + chord[2] * k + 0.5)) - box[1]
        row = np.int64(np.floor(chord[1] + chord[3] * k + 0.5)) - box[0]
        votes[near[row * width + col]] = 0
    return best, share


@kernel
def morton(x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return positions on the Z-order curve of non-negative integer cells, shape (N,): neighbours stay near."""
    code = np.empty(x.size, np.int64)
    for n in range(x.size):
        found = np.int64(0)
        for bit in range(31):
            found |= ((np.int64(x[n]) >> bit) & 1) << (2 * bit)
            found |= ((np.int64(y[n]) >> bit) & 1) << (2 * bit + 1)
        code[n] = found
    return code
