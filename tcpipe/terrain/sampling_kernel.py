"""The compiled heart of sampling: patches straight from a map's tiles, one resampling a layer.

Height and orthophoto are bilinear, class is nearest; a tap without data makes the pixel invalid. Heights are interpolated relative to
the height under the patch's centre, so that single precision keeps 0.1 mm on any mountain.

A patch's surroundings are first copied from the tiles into a small window that stays in the processor's cache, in runs of fixed length
that become single instructions; the four taps of a byte layer are packed into one word, so that each is one load. Indices are unsigned,
since numba tests signed ones for Python's counting from the end. The rest is passes over patch rows that the compiler can vectorise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel
from tcpipe.terrain.layers import HEIGHT_NODATA

RUN_PX = 16
"""Pixels copied at once; windows are a multiple of it wide."""


class Tiles(NamedTuple):
    """Tiles in memory, one after another; layers of a kind follow each other, and there may be none of it.

    ``relative`` is float32 [m] with NaN as no data, shape (S,); ``floats`` the same, (F·S,); ``greys`` and ``classes`` are uint8 with 0 as
    no data, (G·S,), (C·S,). ``slots`` says which of them is the tile in row i and column j of the map, (A, B), -1 where there is none,
    which is ground without data; ``rows`` and ``cols`` are the pixels of a tile.
    """

    relative: NDArray[np.float32]
    floats: NDArray[np.float32]
    greys: NDArray[np.uint8]
    classes: NDArray[np.uint8]
    slots: NDArray[np.int32]
    rows: int
    cols: int


class Ground(NamedTuple):
    """Where N patches lie on the map.

    ``boxes`` are the first row and column, last row and column (exclusive) of the map pixels that a patch and its chord touch, taps and a
    pixel all around included, (N, 4); ``frames`` and ``chords`` affine map pixel positions (`patches.map_px_from_patch`,
    `patches.chord_px`), (N, 6), (N, 4), with ``chord_points`` points on the chord to take the class at, which is that of layer
    ``classed`` of the classes, -1 for none. ``pixel_size_m`` is the side of a patch pixel on the ground [m], ``step_m`` the unit of stored
    heights [m].
    """

    boxes: NDArray[np.int64]
    frames: NDArray[np.float64]
    chords: NDArray[np.float64]
    chord_points: int
    classed: int
    pixel_size_m: float
    step_m: float


class Stacks(NamedTuple):
    """N patches of S x S pixels, by kind, as in `Tiles`.

    ``relative`` is uint16 steps above the patch's smallest (65535 no data), (N, S, S); the others are (F, N, S, S), (G, N, S, S) and
    (C, N, S, S). ``stats``, (N, 7): smallest height [m], slope along and to the left [rad], valid fraction, share of valid pixels more
    than 1 m above the smallest, majority class under the chord, its share.
    """

    relative: NDArray[np.uint16]
    floats: NDArray[np.float32]
    greys: NDArray[np.uint8]
    classes: NDArray[np.uint8]
    stats: NDArray[np.float64]


class _Near(NamedTuple):
    """A patch's surroundings, by kind, as in `Tiles`: (M,), (F·M,), (G·M,), (C·M,)."""

    relative: NDArray[np.float32]
    floats: NDArray[np.float32]
    greys: NDArray[np.uint8]
    classes: NDArray[np.uint8]


@compile_kernel
def sample_tiles(tiles: Tiles, ground: Ground, chosen: NDArray[np.int64], out: Stacks) -> None:
    """Sample patches from tiles that are in memory; ``chosen`` are those rows of ``ground`` and ``out``, shape (n,)."""
    side = out.relative.shape[1]
    whole_patch = side * side
    most = 0
    for n in chosen:
        box = ground.boxes[n]
        most = max(most, (box[2] - box[0] + 2) * _compute_width(box) + 2 * RUN_PX)
    near = _Near(
        np.zeros(most, np.float32),
        np.zeros(len(out.floats) * most, np.float32),
        np.ones(len(out.greys) * most, np.uint8),
        np.ones(len(out.classes) * most, np.uint8),
    )
    taps = np.zeros(most, np.uint32)
    at = np.empty(whole_patch, np.uint32)
    fx, fy = np.empty(whole_patch, np.float32), np.empty(whole_patch, np.float32)
    rise = np.empty(whole_patch, np.float32)
    good = np.ones(whole_patch, np.uint8)
    votes = np.zeros(256, np.int64)
    for n in chosen:
        box, frame = ground.boxes[n], ground.frames[n]
        width, rows = _compute_width(box), box[2] - box[0]
        heights = out.relative[n].reshape(-1)
        middle_x = np.int64(np.floor(frame[0] + 0.5 * (side - 1) * (frame[2] + frame[4])))
        middle_y = np.int64(np.floor(frame[1] + 0.5 * (side - 1) * (frame[3] + frame[5])))
        reference = _read_height(tiles, middle_y, middle_x)
        _copy_near(tiles, box, near)
        near.relative[: rows * width] -= reference
        whole = _is_known(near.relative[: rows * width]) and _is_whole(near, rows * width)
        if not whole:
            good[:] = 1
        _find_positions(width, box, frame, side, at, fx, fy)
        _sample_floats(near.relative, width, at, fx, fy, rise)
        if not whole:
            _mark_known(rise, good)
        for k in range(len(out.floats)):
            values = out.floats[k, n].reshape(-1)
            _sample_floats(near.floats[k * most :], width, at, fx, fy, values)
            if not whole:
                _mark_known(values, good)
        for k in range(len(out.greys)):
            _pack_taps(near.greys[k * most :], width, rows, taps)
            _sample_greys(taps, at, fx, fy, out.greys[k, n].reshape(-1))
            if not whole:
                _mark_tapped(taps, at, good)
        for k in range(len(out.classes)):
            classes = out.classes[k, n].reshape(-1)
            _pack_taps(near.classes[k * most :], width, rows, taps)
            _sample_classes(taps, at, fx, fy, classes)
            if not whole:
                _mark_classed(classes, good)
        count = whole_patch if whole else int(good.sum())
        if count < whole_patch:
            _fill_gaps(rise, good)
        lowest, clipped = _store_height(rise, ground.step_m, heights)
        if count == whole_patch:
            along, left = _fit_slopes(rise, side)
        else:
            along, left = _fit_good_slopes(rise, good, side)
            _clear(out, n, good)
        entry, share = 0, 0.0
        if ground.classed >= 0:
            under = near.classes[ground.classed * most :]
            entry, share = _find_class_under(under, width, box, ground.chords[n], ground.chord_points, votes)
        stats = out.stats[n]
        stats[0] = np.float64(reference) + np.float64(lowest)
        stats[1], stats[2] = np.arctan(along / ground.pixel_size_m), np.arctan(left / ground.pixel_size_m)
        stats[3], stats[4] = count / whole_patch, clipped / max(count, 1)
        stats[5], stats[6] = entry, share


@compile_kernel
def _compute_width(box: NDArray[np.int64]) -> int:
    return int((box[3] - box[1] + RUN_PX - 1) // RUN_PX * RUN_PX)


@compile_kernel
def _find_slot(slots: NDArray[np.int32], i: int, j: int) -> int:
    return slots[i, j] if 0 <= i < slots.shape[0] and 0 <= j < slots.shape[1] else -1


@compile_kernel
def _read_height(tiles: Tiles, row: int, col: int) -> np.float32:
    """Return a pixel's height; 0 where it has none."""
    i, j = row // tiles.rows, col // tiles.cols
    slot = _find_slot(tiles.slots, i, j)
    if slot < 0:
        return np.float32(0.0)
    found = tiles.relative[(slot * tiles.rows + row - i * tiles.rows) * tiles.cols + col - j * tiles.cols]
    return found if np.isfinite(found) else np.float32(0.0)


@compile_kernel
def _copy_near(tiles: Tiles, box: NDArray[np.int64], near: _Near) -> None:
    """Copy a box of the map from one or more tiles, row by row; what a run carries too far, the next one overwrites."""
    heights, floats, greys, classes, slots, high, wide = (
        tiles  # taken out once: a field costs a reference count each time
    )
    near_heights, near_floats, near_greys, near_classes = near
    width, size, most = _compute_width(box), heights.size, near_heights.size
    float_count, grey_count, class_count = near_floats.size // most, near_greys.size // most, near_classes.size // most
    first_j, last_j = box[1] // wide, (box[3] - 1) // wide
    for i in range(box[0] // high, (box[2] - 1) // high + 1):
        for row in range(max(box[0], i * high), min(box[2], (i + 1) * high)):
            for j in range(first_j, last_j + 1):
                begin, end = max(box[1], j * wide), min(box[3], (j + 1) * wide)
                there, slot = (row - box[0]) * width + begin - box[1], _find_slot(slots, i, j)
                if slot < 0:
                    _fill_blank(near, there, there + end - begin)
                    continue
                here = (slot * high + row - i * high) * wide + begin - j * wide
                _copy_run(heights, here, near_heights, there, end - begin)
                for k in range(float_count):
                    _copy_run(floats, k * size + here, near_floats, k * most + there, end - begin)
                for k in range(grey_count):
                    _copy_run(greys, k * size + here, near_greys, k * most + there, end - begin)
                for k in range(class_count):
                    _copy_run(classes, k * size + here, near_classes, k * most + there, end - begin)


@compile_kernel
def _copy_run(source: NDArray[np.generic], here: int, near: NDArray[np.generic], there: int, count: int) -> None:
    run, begin, place = np.uint64(RUN_PX), np.uint64(here), np.uint64(there)
    if here + count + RUN_PX > source.size:  # the last pixels of all
        for k in range(np.uint64(count)):
            near[place + k] = source[begin + k]
        return
    for j in range(np.uint64(count + RUN_PX - 1) // run):
        for k in range(run):
            near[place + j * run + k] = source[begin + j * run + k]


@compile_kernel
def _fill_blank(near: _Near, first: int, last: int) -> None:
    """Leave a stretch of the window without data."""
    most = near.relative.size
    near.relative[first:last] = np.nan
    near.floats.reshape(-1, most)[:, first:last] = np.nan
    near.greys.reshape(-1, most)[:, first:last] = 0
    near.classes.reshape(-1, most)[:, first:last] = 0


@compile_kernel
def _is_whole(near: _Near, count: int) -> bool:
    """Tell whether no pixel of the window lacks data of any other layer."""
    most, whole = near.relative.size, True
    for first in range(0, near.floats.size, most):
        whole &= _is_known(near.floats[first : first + count])
    for first in range(0, near.greys.size, most):
        whole &= _find_least(near.greys[first : first + count]) > 0
    for first in range(0, near.classes.size, most):
        whole &= _find_least(near.classes[first : first + count]) > 0
    return whole


@compile_kernel
def _is_known(values: NDArray[np.float32]) -> bool:
    broken = np.uint32(0)
    for k in range(values.size):
        broken |= np.uint32(values[k] != values[k])  # true for NaN
    return bool(broken == 0)


@compile_kernel
def _find_least(values: NDArray[np.uint8]) -> np.uint8:
    least = np.uint8(255)
    for k in range(values.size):
        least = min(least, values[k])
    return least


@compile_kernel
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


@compile_kernel
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


@compile_kernel
def _sample_floats(
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


@compile_kernel
def _sample_greys(
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


@compile_kernel
def _sample_classes(
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


@compile_kernel
def _mark_known(values: NDArray[np.float32], good: NDArray[np.uint8]) -> None:
    """Leave good what is not NaN: no tap lacked data."""
    for k in range(values.size):
        good[k] &= np.uint8(values[k] == values[k])


@compile_kernel
def _mark_tapped(taps: NDArray[np.uint32], at: NDArray[np.uint32], good: NDArray[np.uint8]) -> None:
    """Leave good what has data in all four taps."""
    b8, b16, b24, byte = np.uint32(8), np.uint32(16), np.uint32(24), np.uint32(255)
    for k in range(at.size):
        four = taps[at[k]]
        whole = (four & byte != 0) & (four >> b8 & byte != 0) & (four >> b16 & byte != 0) & (four >> b24 != 0)
        good[k] &= np.uint8(whole)


@compile_kernel
def _mark_classed(classes: NDArray[np.uint8], good: NDArray[np.uint8]) -> None:
    """Leave good what has a class."""
    for k in range(classes.size):
        good[k] &= np.uint8(classes[k] != 0)


@compile_kernel
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


@compile_kernel
def _fill_gaps(rise: NDArray[np.float32], good: NDArray[np.uint8]) -> None:
    """Set heights without data to the smallest that has some, 0 where none has: it stays the smallest, and none of them is high."""
    known = rise[good == 1]
    rise[good == 0] = known.min() if known.size else np.float32(0.0)


@compile_kernel
def _clear(out: Stacks, n: int, good: NDArray[np.uint8]) -> None:
    """Take the data of a patch where any layer lacks it."""
    for k in range(good.size):
        if not good[k]:
            row, col = k // out.relative.shape[1], k % out.relative.shape[1]
            out.relative[n, row, col] = HEIGHT_NODATA
            out.floats[:, n, row, col] = np.nan
            out.greys[:, n, row, col] = 0
            out.classes[:, n, row, col] = 0


@compile_kernel
def _fit_slopes(rise: NDArray[np.float32], side: int) -> tuple[float, float]:
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


@compile_kernel
def _fit_good_slopes(rise: NDArray[np.float32], good: NDArray[np.uint8], side: int) -> tuple[float, float]:
    """Return what `_fit_slopes` does, of good pixels alone; 0 where they do not span a plane."""
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


@compile_kernel
def _find_class_under(
    near: NDArray[np.uint8],
    width: int,
    box: NDArray[np.int64],
    chord: NDArray[np.float64],
    points: int,
    votes: NDArray[np.int64],
) -> tuple[int, float]:
    """Return the commonest class at points on the chord and its share of those that have one; ties go low."""
    votes[:] = 0
    for k in range(points):
        col = np.int64(np.floor(chord[0] + chord[2] * k + 0.5)) - box[1]
        row = np.int64(np.floor(chord[1] + chord[3] * k + 0.5)) - box[0]
        votes[near[row * width + col]] += 1
    best = int(np.argmax(votes[1:])) + 1
    return (best, votes[best] / (points - votes[0])) if votes[best] > 0 else (0, 0.0)


@compile_kernel
def compute_morton(x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return positions on the Z-order curve of non-negative integer cells, shape (N,): neighbours stay near."""
    code = np.empty(x.size, np.int64)
    for n in range(x.size):
        found = np.int64(0)
        for bit in range(31):
            found |= ((np.int64(x[n]) >> bit) & 1) << (2 * bit)
            found |= ((np.int64(y[n]) >> bit) & 1) << (2 * bit + 1)
        code[n] = found
    return code
