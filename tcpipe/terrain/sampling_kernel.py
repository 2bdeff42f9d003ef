"""Compiled sampling of patches from a map's tiles, one resampling a layer.

Height and orthophoto are bilinear, class is nearest; a tap without data makes the pixel invalid. Heights are
interpolated relative to the height under the patch's centre, so that single precision keeps 0.1 mm on any mountain. A
patch's surroundings are first copied from the tiles into a small window that fits the processor's cache. Indices of the
inner loops are unsigned, since numba tests signed ones for Python's negative indices.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Bytes, Floats, Floats32, GenericArray, Ints, Mask
from tcpipe.compiled import compile_kernel
from tcpipe.terrain.layers import HEIGHT_NODATA


class Tiles(NamedTuple):
    """Tiles in memory, one after another; layers of a kind follow each other.

    ``relative``: float32 [m], NaN: no data, shape (S,); ``floats``: the same, (F·S,); ``greys`` and ``classes``: uint8,
    0: no data, (G·S,), (C·S,). ``slots``: number of the tile in row i and column j of the map, (A, B), -1 for ground
    without data; ``rows`` and ``cols``: pixels of a tile.
    """

    relative: Floats32
    floats: Floats32
    greys: Bytes
    classes: Bytes
    slots: NDArray[np.int32]
    rows: int
    cols: int


class Ground(NamedTuple):
    """Frames of N patches on the map.

    ``boxes``: first row and column, last row and column (exclusive) of the map pixels that a patch and its chord touch,
    with taps and a margin of one pixel, (N, 4). ``frames`` and ``chords``: affine map pixel positions
    (`patches.map_px_from_patch`, `patches.chord_px`), (N, 6), (N, 4). ``chord_points``: points on the chord at which to
    take the class; ``classed``: its layer among the classes, -1 for none. ``pixel_size_m``: side of a patch pixel on
    the ground [m]; ``step_m``: unit of stored heights [m].
    """

    boxes: Ints
    frames: Floats
    chords: Floats
    chord_points: int
    classed: int
    pixel_size_m: float
    step_m: float


class Stacks(NamedTuple):
    """N patches of S x S pixels, by kind, as in `Tiles`.

    ``relative``: uint16 steps above the patch's smallest (65535: no data), (N, S, S); the others: (F, N, S, S), (G, N,
    S, S) and (C, N, S, S). ``stats``, (N, 7): smallest height [m], slope along and to the left [rad], valid fraction,
    share of valid pixels more than 1 m above the smallest, majority class under the chord, its share.
    """

    relative: NDArray[np.uint16]
    floats: Floats32
    greys: Bytes
    classes: Bytes
    stats: Floats


class _Taps(NamedTuple):
    """Position of each patch pixel in the window, (S·S,) each.

    ``at``: the window's pixel above and to the left; ``fx``, ``fy``: distances from it to the right and down [px];
    ``good``: valid patch pixels.
    """

    at: NDArray[np.uint64]
    fx: Floats32
    fy: Floats32
    good: Mask


@compile_kernel
def sample_tiles(tiles: Tiles, ground: Ground, chosen: Ints, out: Stacks) -> None:
    """Sample patches from tiles that are in memory; ``chosen`` are those rows of ``ground`` and ``out``, shape (n,)."""
    side, most = out.relative.shape[1], 0
    for n in chosen:
        box = ground.boxes[n]
        most = max(most, (box[2] - box[0]) * (box[3] - box[1]))
    heights, floats = np.empty(most, np.float32), np.empty((len(out.floats), most), np.float32)
    greys, classes = np.empty((len(out.greys), most), np.uint8), np.empty((len(out.classes), most), np.uint8)
    at, fx, fy = np.empty(side * side, np.uint64), np.empty(side * side, np.float32), np.empty(side * side, np.float32)
    taps = _Taps(at, fx, fy, np.empty(side * side, np.bool_))
    rise, votes = np.empty(side * side, np.float32), np.zeros(256, np.int64)
    for n in chosen:
        box, frame = ground.boxes[n], ground.frames[n]
        width = box[3] - box[1]
        _copy_window(tiles.relative, tiles, box, np.float32(np.nan), heights)
        for k in range(len(floats)):
            _copy_window(_take_layer(tiles.floats, k, tiles), tiles, box, np.float32(np.nan), floats[k])
        for k in range(len(greys)):
            _copy_window(_take_layer(tiles.greys, k, tiles), tiles, box, np.uint8(0), greys[k])
        for k in range(len(classes)):
            _copy_window(_take_layer(tiles.classes, k, tiles), tiles, box, np.uint8(0), classes[k])
        middle_x = np.int64(np.floor(frame[0] + 0.5 * (side - 1) * (frame[2] + frame[4]))) - box[1]
        middle_y = np.int64(np.floor(frame[1] + 0.5 * (side - 1) * (frame[3] + frame[5]))) - box[0]
        middle = heights[middle_y * width + middle_x]
        reference = middle if np.isfinite(middle) else np.float32(0.0)
        heights[: (box[2] - box[0]) * width] -= reference
        _find_taps(box, frame, side, taps)
        _sample_floats(heights, width, taps, rise)
        for k in range(len(floats)):
            _sample_floats(floats[k], width, taps, out.floats[k, n].reshape(-1))
        for k in range(len(greys)):
            _sample_greys(greys[k], width, taps, out.greys[k, n].reshape(-1))
        for k in range(len(classes)):
            _sample_classes(classes[k], width, taps, out.classes[k, n].reshape(-1))
        count = int(taps.good.sum())
        if count < taps.good.size:
            _clear(out, n, taps.good)
        lowest, clipped = _store_height(rise, taps.good, ground.step_m, out.relative[n].reshape(-1))
        along, left = _fit_slopes(rise, taps.good, side)
        entry, share = 0, 0.0
        if ground.classed >= 0:
            under = classes[ground.classed]
            entry, share = _find_class_under(under, width, box, ground.chords[n], ground.chord_points, votes)
        stats = out.stats[n]
        stats[0] = np.float64(reference) + np.float64(lowest)
        stats[1], stats[2] = np.arctan(along / ground.pixel_size_m), np.arctan(left / ground.pixel_size_m)
        stats[3], stats[4] = count / taps.good.size, clipped / max(count, 1)
        stats[5], stats[6] = entry, share


@compile_kernel
def _take_layer(stack: GenericArray, number: int, tiles: Tiles) -> GenericArray:
    """Return one of the layers of a kind, (S,)."""
    return stack[number * tiles.relative.size : (number + 1) * tiles.relative.size]


@compile_kernel
def _copy_window(layer: GenericArray, tiles: Tiles, box: Ints, blank: np.generic, window: GenericArray) -> None:
    """Copy a box of a layer from one or more tiles, row by row; ground without a tile is blank."""
    slots, high, wide = tiles.slots, tiles.rows, tiles.cols
    for i in range(box[0] // high, (box[2] - 1) // high + 1):
        for j in range(box[1] // wide, (box[3] - 1) // wide + 1):
            slot = slots[i, j] if 0 <= i < slots.shape[0] and 0 <= j < slots.shape[1] else -1
            begin, end = max(box[1], j * wide), min(box[3], (j + 1) * wide)
            for row in range(max(box[0], i * high), min(box[2], (i + 1) * high)):
                there, here = np.uint64((row - box[0]) * (box[3] - box[1]) + begin - box[1]), np.uint64(0)
                if slot >= 0:
                    here = np.uint64((slot * high + row - i * high) * wide + begin - j * wide)
                for k in range(np.uint64(end - begin)):
                    window[there + k] = layer[here + k] if slot >= 0 else blank


@compile_kernel
def _find_taps(box: Ints, frame: Floats, side: int, taps: _Taps) -> None:
    """Find the window's pixels that each patch pixel lies between; all are valid."""
    at, fx, fy, good = taps
    good[:] = True
    ax, ay, bx, by = np.float32(frame[2]), np.float32(frame[3]), np.float32(frame[4]), np.float32(frame[5])
    lx, ly, width = np.float32(frame[0] - box[1]), np.float32(frame[1] - box[0]), np.uint64(box[3] - box[1])
    for r in range(np.uint64(side)):
        rx, ry = lx + bx * np.float32(np.int32(r)), ly + by * np.float32(np.int32(r))
        for c in range(np.uint64(side)):
            x, y = rx + ax * np.float32(np.int32(c)), ry + ay * np.float32(np.int32(c))
            ix, iy, k = np.int32(x), np.int32(y), r * np.uint64(side) + c
            fx[k], fy[k] = x - np.float32(ix), y - np.float32(iy)
            at[k] = np.uint64(iy) * width + np.uint64(ix)


@compile_kernel
def _sample_floats(window: Floats32, width: int, taps: _Taps, out: Floats32) -> None:
    at, fx, fy, good = taps
    one, stride = np.uint64(1), np.uint64(width)
    for k in range(np.uint64(out.size)):
        i = at[k]
        upper = window[i] + fx[k] * (window[i + one] - window[i])
        lower = window[i + stride] + fx[k] * (window[i + stride + one] - window[i + stride])
        out[k] = upper + fy[k] * (lower - upper)
        good[k] &= out[k] == out[k]  # false for NaN


@compile_kernel
def _sample_greys(window: Bytes, width: int, taps: _Taps, out: Bytes) -> None:
    at, fx, fy, good = taps
    one, stride = np.uint64(1), np.uint64(width)
    for k in range(np.uint64(out.size)):
        i = at[k]
        g00, g01, g10, g11 = window[i], window[i + one], window[i + stride], window[i + stride + one]
        o00, o10 = np.float32(g00), np.float32(g10)
        upper, lower = o00 + fx[k] * (np.float32(g01) - o00), o10 + fx[k] * (np.float32(g11) - o10)
        out[k] = np.uint8(np.int32(upper + fy[k] * (lower - upper) + np.float32(0.5)))
        good[k] &= (g00 != 0) & (g01 != 0) & (g10 != 0) & (g11 != 0)


@compile_kernel
def _sample_classes(window: Bytes, width: int, taps: _Taps, out: Bytes) -> None:
    at, fx, fy, good = taps
    half = np.float32(0.5)
    for k in range(np.uint64(out.size)):
        out[k] = window[at[k] + np.uint64(fx[k] >= half) + np.uint64(fy[k] >= half) * np.uint64(width)]
        good[k] &= out[k] != 0


@compile_kernel
def _store_height(rise: Floats32, good: Mask, step_m: float, out: NDArray[np.uint16]) -> tuple[np.float32, int]:
    """Store valid heights in steps above the smallest; return the smallest (0 if none) and the count 1 m above it."""
    lowest, clipped = np.float32(np.inf), 0
    for k in range(np.uint64(rise.size)):
        lowest = rise[k] if good[k] and rise[k] < lowest else lowest
    inverse_step, most = np.float32(1.0 / step_m), np.float32(HEIGHT_NODATA - 1)
    for k in range(np.uint64(rise.size)):
        above = rise[k] - lowest if good[k] else np.float32(0.0)
        clipped += 1 if above > np.float32(1.0) else 0
        steps = np.uint16(np.int32(min(above * inverse_step + np.float32(0.5), most)))
        out[k] = steps if good[k] else np.uint16(HEIGHT_NODATA)
    return lowest if np.isfinite(lowest) else np.float32(0.0), clipped


@compile_kernel
def _clear(out: Stacks, n: int, good: Mask) -> None:
    """Take the data of a patch where any layer lacks it."""
    for k in range(good.size):
        if not good[k]:
            row, col = k // out.relative.shape[1], k % out.relative.shape[1]
            out.floats[:, n, row, col] = np.nan
            out.greys[:, n, row, col] = 0
            out.classes[:, n, row, col] = 0


@compile_kernel
def _fit_slopes(rise: Floats32, good: Mask, side: int) -> tuple[float, float]:
    """Return the fitted plane's rise per pixel along and left, by valid pixels; 0 if they span no plane."""
    middle = 0.5 * (side - 1)
    count = su = sv = suu = suv = svv = sh = suh = svh = 0.0
    for r in range(side):
        row_count = row_u = row_uu = row_h = row_uh = 0.0
        for c in range(side):
            k = np.uint64(r * side + c)
            used, u = np.float64(good[k]), c - middle
            h = np.float64(rise[k]) if good[k] else 0.0
            row_count += used
            row_u += used * u
            row_uu += used * u * u
            row_h += h
            row_uh += u * h
        v = middle - r
        count, su, suu, sh, suh = count + row_count, su + row_u, suu + row_uu, sh + row_h, suh + row_uh
        sv, suv, svv, svh = sv + v * row_count, suv + v * row_u, svv + v * v * row_count, svh + v * row_h
    count = max(count, 1.0)
    suu, suv, svv = suu - su * su / count, suv - su * sv / count, svv - sv * sv / count
    suh, svh = suh - su * sh / count, svh - sv * sh / count
    determinant = suu * svv - suv * suv
    if determinant <= 1e-9 * max(suu * svv, 1.0):
        return 0.0, 0.0
    return (suh * svv - svh * suv) / determinant, (svh * suu - suh * suv) / determinant


@compile_kernel
def _find_class_under(near: Bytes, width: int, box: Ints, chord: Floats, points: int, votes: Ints) -> tuple[int, float]:
    """Return the commonest class at points on the chord and its share of those that have one; ties go low."""
    votes[:] = 0
    for k in range(points):
        col = np.int64(np.floor(chord[0] + chord[2] * k + 0.5)) - box[1]
        row = np.int64(np.floor(chord[1] + chord[3] * k + 0.5)) - box[0]
        votes[near[row * width + col]] += 1
    best = int(np.argmax(votes[1:])) + 1
    return (best, votes[best] / (points - votes[0])) if votes[best] > 0 else (0, 0.0)


@compile_kernel
def compute_morton(x: Ints, y: Ints) -> Ints:
    """Return positions on the Z-order curve of non-negative integer cells, shape (N,): neighbours stay near."""
    code = np.empty(x.size, np.int64)
    for n in range(x.size):
        found = np.int64(0)
        for bit in range(31):
            found |= ((np.int64(x[n]) >> bit) & 1) << (2 * bit)
            found |= ((np.int64(y[n]) >> bit) & 1) << (2 * bit + 1)
        code[n] = found
    return code
