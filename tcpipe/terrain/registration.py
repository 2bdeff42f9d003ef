"""Registration of a map to a track, by the heights of the ground under the track.

A track's heights and the map's differ by a constant (ellipsoid against geoid, the robot's own height) without information. The rest is
the shape of the ground; the horizontal shift at which the two shapes agree best is searched over a small window, as in terrain-aided
navigation (Hollowell 1990; Nuth & Kääb 2011 for elevation models). Along directions in which the ground does not vary the shift is
not observable, and stays zero. The regression of the track's heights on the map's gives the unit of the map, such as feet.

The shift is fitted together with a tilt of the map and a drift of the track's heights, which look like a shift on a smooth hill, and from
the misfit itself: along slopes that are noisy a step is too short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.optimize import brentq
from scipy.stats import chi2

from tcpipe.robust import estimate_robust_std
from tcpipe.tables.findings import read_threshold
from tcpipe.terrain.sampling_kernel import compute_morton
from tcpipe.terrain.tiles import MapReader, choose_level, group_by_tile, read_window

FloatArray = NDArray[np.float64]
Rows = NDArray[np.int64]
Points = NDArray[np.bool_]

REACH_M = 4.0
"""Shifts are searched this far each way [m]: one of 3.5 m is not at the edge."""

KNOWN_M = 0.25
"""A direction along which the shift's standard deviation is larger is not determined by the ground [m]."""

_STEP_M = 0.25
_SPACING_M = 0.5
_MOST_POINTS, _MOST_TOGETHER = 1_200, 6_000
"""Most points of one track, and of several."""
_FEWEST_POINTS = 60
_BLOCKS = 12
"""Stretches left out in turn (delete-one-block jackknife): errors of GNSS and of the map are alike over metres."""
_CHI2_999 = 13.82
"""99.9 % of χ² with two degrees of freedom."""
_AGREE, _SCATTER_QUANTILE = 0.999, 0.1
"""Runs' own shifts scatter about the common one by at most the 90 % upper limit."""
_OUTLIER = 3.5
_SIGMAS = 5.0
"""Least fall of the misfit in its standard deviations: the best of 600 shifts falls by three by chance."""
_LEAST_GAIN = -2.0 * np.log(0.9)
"""A shift that leaves more than 90 % of the misfit is not what was wrong."""
_RIVAL_SIGMAS = 3.0
_APART_M = 0.75
"""Distance [m] at which ground that fits nearly as well makes the place of the track ambiguous."""
_RIDGE = 1e-12
_FLAT = 1e-4
"""The misfits of shifts rise so little along one direction, compared with the other, that the ground does not vary along it."""
_FEW_BLOCKS = 1.26
"""Factor of a variance from so few blocks, so that two standard deviations cover 95 % (square of the ratio of Student's t and normal)."""
_ROUNDS, _REWEIGHTINGS, _LEAST_MISFIT_M = 6, 20, 0.01
_DRIFT_M = 25.0
"""Stretches of path in which the track's heights may be off by a constant of their own [m]: those of GNSS drift over tens of seconds."""
_EDGE_M = 0.75 * _STEP_M
"""Where the best shift is so far from the best one inside the window's edge, the true one may be larger [m]."""
_NEAR = 2
"""A paraboloid is fitted to the misfits of shifts that are so many steps each way from the best."""
_CLIFF_M = 1.0
"""Ground that varies more among these shifts is steeper than what is driven on [m]."""
_NORTH_M, _EAST_M = np.mgrid[-_NEAR : _NEAR + 1, -_NEAR : _NEAR + 1].reshape(2, -1) * _STEP_M
_PARABOLOID = np.linalg.pinv(
    np.stack([np.ones_like(_EAST_M), _EAST_M, _NORTH_M, _EAST_M**2, _EAST_M * _NORTH_M, _NORTH_M**2], axis=1)
)
_UNITS = {0.3048: "ft", 0.1: "dm", 0.01: "cm", 0.001: "mm"}
_UNITS |= {1.0 / metres: "m" for metres in _UNITS}
"""Unit of a map's heights by their scale; metres that were converted from another unit by mistake have its inverse."""
_MAX_UNIT_ERROR = 0.07

_KNOWN_SCALE = 0.03
_EXPLAINED = 0.9
"""A scale is known if its standard deviation is 3 % and it explains nine tenths of the variance of the track's heights."""

_MAX_WRONG_STD, _MIN_WRONG_EXPLAINED = 0.1, 0.7
"""Relative standard deviation and explained share from which a scale far from one is certain."""


@dataclass(frozen=True, slots=True)
class HeightScale:
    """Metres that a track rises where the map rises by one, its standard deviation, and the share of the track's variance so explained.

    Where the ground is even the deviation is huge; where the map holds what the track does not (trees), little is explained.
    """

    value: float
    std: float
    explained: float

    @property
    def is_known(self) -> bool:
        """Whether it is certain enough to compare with one."""
        return self.std < _KNOWN_SCALE * max(self.value, 1.0) and self.explained > _EXPLAINED

    def is_wrong(self) -> bool:
        """Whether the map's heights are in another unit, or scaled: noise of the map lowers the value, but not below ``explained``."""
        if self.std > _MAX_WRONG_STD * self.value or self.explained < _MIN_WRONG_EXPLAINED:
            return False
        most, margin = read_threshold("map-height-scale", "max_factor"), 3.0 * self.std
        return self.value + margin < self.explained / most or self.value - margin > most

    def find_unit(self) -> str:
        """Return the unit of the map's heights; "" if it is no known unit."""
        error = max(3.0 * self.std / self.value, _MAX_UNIT_ERROR)
        return next((unit for scale, unit in _UNITS.items() if abs(self.value / scale - 1.0) < error), "")

    def is_off(self) -> bool:
        """Whether map and track surely do not rise alike."""
        return self.is_known and abs(self.value - 1.0) > max(
            _SIGMAS * self.std, read_threshold("map-height-scale", "min_error_fraction")
        )


@dataclass(frozen=True, slots=True)
class _Points:
    """Positions on the map, (N, 2) [m], and which track each is of, (N,), rising."""

    xy_m: FloatArray
    track: Rows

    def select(self, rows: Points) -> _Points:
        """Return the points that are True in a mask."""
        return _Points(self.xy_m[rows], self.track[rows])


@dataclass(frozen=True, slots=True)
class Registration:
    """How a map lies against a track.

    ``shift_xy_m`` is what to add to the track's positions to find their ground on the map [m, the map's axes], along determined
    directions only; ``shift_std_m`` its largest standard deviation along them, NaN where none is determined. ``height_offset_m`` is track
    minus map; ``misfit_m`` and ``shifted_misfit_m`` are standard deviations of what is left without and with the shift,
    ``shape_misfit_m`` of what is left with the shift, a tilt and a drift. ``significant``: the shift is not chance. ``at_reach``: the best
    shift lies at the window's edge, the true one may be larger. ``scale`` is of heights. ``information`` is the inverse of the shift's
    covariance, (2, 2) [1/m²], 0 along directions that are not determined.
    """

    points: int
    shift_xy_m: tuple[float, float]
    shift_std_m: float
    height_offset_m: float
    misfit_m: float
    shifted_misfit_m: float
    shape_misfit_m: float
    significant: bool
    at_reach: bool
    scale: HeightScale
    information: FloatArray

    @property
    def shift_m(self) -> float:
        """Length of the shift [m]."""
        return float(np.hypot(*self.shift_xy_m))

    @property
    def axis_std_m(self) -> FloatArray:
        """Standard deviations of the shift along both axes [m], NaN unless it is determined in both directions."""
        if _count_known(self.information) < 2:
            return np.full(2, np.nan)
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(self.information))))

    @property
    def position_std_m(self) -> float:
        """DRMS of the shift [m], NaN unless it is determined in both directions."""
        return float(np.hypot(*self.axis_std_m))

    @property
    def left_m(self) -> float:
        """Misfit with the shift if that is significant, else without [m]."""
        return self.shifted_misfit_m if self.significant else self.misfit_m


def register_tracks(source: MapReader, tracks: Sequence[tuple[FloatArray, FloatArray]]) -> Registration | None:
    """Find the one horizontal shift at which the map's ground fits the heights of tracks best.

    Parameters
    ----------
    source : the map.
    tracks : of each track the positions in the map's CRS, in the order driven, shape (N, 2) [m], of which what is not finite or not on the
        map is passed over, and their heights above any surface, shape (N,) [m].

    None where fewer than `_FEWEST_POINTS` points, half a metre apart, lie well inside the map and on its ground.
    """
    level = choose_level(source, _STEP_M)
    thinned = thin_tracks(tracks)
    xy_m, height_m = (np.concatenate([track[part] for track in thinned]) for part in (0, 1))
    number = np.repeat(np.arange(len(thinned)), [len(track[1]) for track in thinned])
    at = np.flatnonzero(level.grid.contains(xy_m))
    steps = round(REACH_M / _STEP_M)
    shift_m = np.arange(-steps, steps + 1, dtype=np.float64) * _STEP_M
    ground_m = _sample_heights(level, xy_m[at], shift_m)
    whole = np.isfinite(ground_m).all(axis=(1, 2))
    if whole.sum() < _FEWEST_POINTS:
        return None
    at, ground_m = at[whole], ground_m[whole]
    excess_m, points = ground_m - height_m[at][:, None, None], _Points(xy_m[at], number[at])
    near, good = _find_ground(excess_m, points)
    if near.sum() < _FEWEST_POINTS:
        return None
    scale = _fit_height_scale(ground_m[near], height_m[at][near], xy_m[at][near])
    return _refine_shift(excess_m, points, (near, good), shift_m, scale)


def _find_ground(excess_m: FloatArray, points: _Points) -> tuple[Points, Points]:
    """Return the points on the map's ground at the shift that fits best, (N,), and those of them that determine a shift.

    These are not on cliffs, unless too few are left.
    """
    middle = excess_m.shape[1] // 2
    flat_m = excess_m - _fit_tilt(points.xy_m, excess_m[:, middle, middle])[:, None, None]
    best = _find_least(np.median(np.abs(flat_m - np.median(flat_m, axis=0)), axis=0))
    for _ in range(_ROUNDS):
        tilt_m = _fit_tilt(points.xy_m, excess_m[:, *best])
        left = excess_m[:, *best] - tilt_m
        left = np.abs(left - np.median(left))
        relief_m = np.ptp(_take_near(excess_m, best), axis=(1, 2))
        # steep ground misfits where the shift is off by a step
        near = left - relief_m / 2.0 <= _OUTLIER * estimate_robust_std(left)
        good = near & (relief_m < _CLIFF_M)
        if good.sum() < _FEWEST_POINTS:
            return near, near
        before, best = best, _find_least(_flatten(excess_m[good], points.select(good))[0].var(axis=0))
        if best == before:
            break
    return near, good


def _fit_tilt(xy_m: FloatArray, excess_m: FloatArray) -> FloatArray:
    """Return the tilt of the plane that leaves the least absolute excess, shape (N,) [m]: a bridge or a tree does not turn it."""
    columns, weight = np.column_stack([xy_m - xy_m.mean(axis=0), np.ones(len(xy_m))]), np.ones(len(xy_m))
    for _ in range(_REWEIGHTINGS):
        fitted = np.linalg.lstsq(columns * weight[:, None], excess_m * weight, rcond=None)[0]
        weight = 1.0 / np.sqrt(np.abs(excess_m - columns @ fitted) + _LEAST_MISFIT_M)
    return np.asarray(columns[:, :2] @ fitted[:2])


def thin_tracks(tracks: Sequence[tuple[FloatArray, FloatArray]]) -> list[tuple[FloatArray, FloatArray]]:
    """Return finite points of tracks `_SPACING_M` of path apart, or further where that would be too many."""
    tracks = [
        (xy[is_finite], z[is_finite]) for xy, z in tracks for is_finite in (np.isfinite(xy).all(1) & np.isfinite(z),)
    ]
    paths_m = [
        np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])[: len(xy)] for xy, _ in tracks
    ]
    total_m = sum(path_m[-1] for path_m in paths_m if path_m.size)
    spacing_m = max(_SPACING_M, total_m / (_MOST_POINTS if len(tracks) == 1 else _MOST_TOGETHER))
    rows = [np.unique((path_m / spacing_m).astype(np.int64), return_index=True)[1] for path_m in paths_m]
    return [(xy[at], z[at]) for (xy, z), at in zip(tracks, rows, strict=True)]


def _sample_heights(level: MapReader, xy_m: FloatArray, shift_m: FloatArray) -> FloatArray:
    """Return the map's heights at every point moved by every pair of shifts (north, east), shape (N, K, K); NaN without data."""
    px = level.grid.px_from_xy(xy_m)
    offset_px = shift_m / level.grid.pixel_size_m
    reach_px = int(np.ceil(offset_px[-1])) + 2
    found = np.empty((len(xy_m), shift_m.size, shift_m.size))
    for group in group_by_tile(px, level):
        col0, row0 = np.floor(px[group].min(axis=0)).astype(int) - reach_px
        col1, row1 = np.floor(px[group].max(axis=0)).astype(int) + reach_px + 1
        window = read_window(level, "height", row0, row1, col0, col1).astype(np.float64)
        x = px[group, 0, None] - col0 + offset_px
        y = px[group, 1, None] - row0 - offset_px  # rows run south
        found[group] = _interpolate_bilinear(window, y[:, :, None], x[:, None, :])
    return found + level.height_reference_m


def _interpolate_bilinear(values: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
    i, j = np.floor(row).astype(np.int64), np.floor(col).astype(np.int64)
    v, u = row - i, col - j
    upper = values[i, j] * (1.0 - u) + values[i, j + 1] * u
    lower = values[i + 1, j] * (1.0 - u) + values[i + 1, j + 1] * u
    return np.asarray(upper * (1.0 - v) + lower * v)


def _find_least(spread: FloatArray) -> tuple[int, int]:
    """Return the lattice indices (north, east) of the shift that leaves the least spread."""
    i, j = np.unravel_index(int(spread.argmin()), spread.shape)
    return int(i), int(j)


def _fit_height_scale(ground_m: FloatArray, height_m: FloatArray, xy_m: FloatArray) -> HeightScale:
    """Return the scale of heights, fitted with a tilt of the map unless it is that of a known unit: no map is tilted so much."""
    whole, tilt = _regress_heights(ground_m, height_m), xy_m - xy_m.mean(axis=0)
    if whole.is_wrong() and whole.find_unit():
        return whole
    return _regress_heights(_remove_tilt(ground_m, tilt), _remove_tilt(height_m, tilt))


def _regress_heights(ground_m: FloatArray, height_m: FloatArray) -> HeightScale:
    """Regress the track's heights (N,) on the map's (N, K, K) where both are most alike; how sure, by leaving stretches out."""
    ground, height = ground_m - ground_m.mean(axis=0), height_m - height_m.mean()
    squares, products = np.einsum("nij,nij->ij", ground, ground), np.einsum("nij,n->ij", ground, height)
    explained = np.maximum(products, 0.0) ** 2 / (squares * (height @ height) + _RIDGE)
    i, j = np.unravel_index(int(explained.argmax()), explained.shape)
    along, blocks = ground[:, i, j], np.array_split(np.arange(len(height)), _BLOCKS)
    parts = [(along[block] @ along[block], along[block] @ height[block]) for block in blocks]
    without = [(products[i, j] - product) / (squares[i, j] - square + _RIDGE) for square, product in parts]
    std = float(np.sqrt(_estimate_covariance(np.array(without)[:, None])[0, 0]))
    return HeightScale(float(products[i, j] / (squares[i, j] + _RIDGE)), std, float(explained[i, j]))


def _refine_shift(
    raw_m: FloatArray, points: _Points, chosen: tuple[Points, Points], shift_m: FloatArray, scale: HeightScale
) -> Registration:
    """Refine the best shift of the lattice by the good points, with σ by leaving sections out; misfits are those of near points."""
    near, good = chosen
    excess_m, tilt, stretches = _flatten(raw_m[good], points.select(good))
    variance, middle = excess_m.var(axis=0), (shift_m.size // 2, shift_m.size // 2)
    best, inner = _find_least(variance), _find_least(variance[_NEAR:-_NEAR, _NEAR:-_NEAR])
    i, j = inner[0] + _NEAR, inner[1] + _NEAR
    step_m, covariance, blocks = _descend(
        _take_near(excess_m, (i, j)), tilt, _group_stretches(points.xy_m[good], stretches)
    )
    variances, axes = np.linalg.eigh(covariance)
    known = axes[:, variances < KNOWN_M**2]
    if not _is_distinct(excess_m, (i, j), known, shift_m, blocks):
        known = axes[:, :0]
    step_m = known @ np.clip(known.T @ step_m, -_STEP_M, _STEP_M)
    unshifted, shifted = _move(excess_m, middle, 0.0 * step_m), _move(excess_m, (i, j), step_m)
    outside_m = known.T @ (shift_m[[best[1], best[0]]] - shift_m[[j, i]])
    fitted = known @ known.T @ np.array([shift_m[j], shift_m[i]]) + step_m
    weight = float(((known.T @ fitted) ** 2 / variances[: known.shape[1]]).sum())
    gain, sigmas = _compute_gain(unshifted, shifted, blocks)
    return Registration(
        points=len(excess_m),
        shift_xy_m=(float(fitted[0]), float(fitted[1])),
        shift_std_m=float(np.sqrt(variances[known.shape[1] - 1])) if known.size else float("nan"),
        height_offset_m=-float(raw_m[near, i, j].mean()),
        misfit_m=float(raw_m[near, *middle].std()),
        shifted_misfit_m=float(_move(raw_m[near], (i, j), step_m).std()),
        shape_misfit_m=float(shifted.std()),
        significant=weight > _CHI2_999 and gain > _LEAST_GAIN and sigmas > _SIGMAS,
        at_reach=bool((np.abs(outside_m) > _EDGE_M).any()),
        scale=scale,
        information=(known / variances[: known.shape[1]]) @ known.T,
    )


def _move(excess_m: FloatArray, at: tuple[int, int], step_m: FloatArray) -> FloatArray:
    """Return the excess (N,) [m] at a step [m] beside a shift of the lattice, less its mean."""
    i, j = at
    east, north = excess_m[:, i, j + 1] - excess_m[:, i, j - 1], excess_m[:, i + 1, j] - excess_m[:, i - 1, j]
    moved = excess_m[:, i, j] + np.stack([east, north], axis=1) @ step_m / (2.0 * _STEP_M)
    return np.asarray(moved - moved.mean())


def _take_near(values: FloatArray, best: tuple[int, int]) -> FloatArray:
    """Return the values of shifts near the best one, shape (N, K, K)."""
    i, j = (min(max(index, _NEAR), values.shape[1] - 1 - _NEAR) for index in best)
    return values[:, i - _NEAR : i + _NEAR + 1, j - _NEAR : j + _NEAR + 1]


def _flatten(excess_m: FloatArray, points: _Points) -> tuple[FloatArray, FloatArray, list[Rows]]:
    """Return the excess without drift and tilt, the columns of a tilt, (N, 2), and the rows of stretches whose means are zero.

    Stretches are of one track, `_DRIFT_M` long, shorter where there would be too few to leave some out.
    """
    xy_m, tracks = points.xy_m, np.split(np.arange(len(points.track)), np.flatnonzero(np.diff(points.track)) + 1)
    paths_m = [np.linalg.norm(np.diff(xy_m[rows], axis=0), axis=1).sum() for rows in tracks]
    fewest = -(-_BLOCKS // len(tracks))
    counts = [max(fewest, round(float(path_m) / _DRIFT_M)) for path_m in paths_m]
    stretches = [part for rows, n in zip(tracks, counts, strict=True) for part in np.array_split(rows, n) if part.size]
    flat_m, tilt = (
        np.concatenate([values[rows] - values[rows].mean(axis=0) for rows in stretches]) for values in (excess_m, xy_m)
    )
    return _remove_tilt(flat_m, tilt), tilt, stretches


def _remove_tilt(values: FloatArray, tilt: FloatArray) -> FloatArray:
    """Return values, shape (N, ...), less the least-squares multiples of a tilt's columns, (N, 2), whose means are zero."""
    flat = values.reshape(len(values), -1)
    return np.asarray((flat - tilt @ (np.linalg.pinv(tilt) @ flat)).reshape(values.shape))


def _group_stretches(xy_m: FloatArray, stretches: Sequence[Rows]) -> list[list[Rows]]:
    """Return stretches in blocks, along the path and by place: errors of GNSS are alike in time, those of the map in place."""
    centre_m = np.stack([xy_m[rows].mean(axis=0) for rows in stretches])
    east, north = np.floor(centre_m - centre_m.min(axis=0)).astype(np.int64).T
    orders = (np.arange(len(centre_m)), np.argsort(compute_morton(east, north), kind="stable"))
    return [
        [np.concatenate([stretches[row] for row in block]) for block in np.array_split(order, min(_BLOCKS, len(order)))]
        for order in orders
    ]


def _descend(
    excess_m: FloatArray, tilt: FloatArray, groupings: Sequence[list[Rows]]
) -> tuple[FloatArray, FloatArray, list[Rows]]:
    """Return the step (2,) [m] from the middle of shifts, (N, K, K), to the least misfit, its covariance, and the blocks that gave it.

    Of the groupings of rows the one counts that gives the larger covariance; it is added to what independent errors would give.
    """
    step_m, independent = _find_bottom(excess_m, tilt)
    found = []
    for blocks in groupings:
        without = [_find_bottom(np.delete(excess_m, rows, axis=0), np.delete(tilt, rows, axis=0))[0] for rows in blocks]
        found.append(_estimate_covariance(np.stack(without)))
    most = int(np.argmax([np.trace(covariance) for covariance in found]))
    return step_m, _FEW_BLOCKS * found[most] + independent, groupings[most]


def _find_bottom(excess_m: FloatArray, tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the step [m] to the bottom of a paraboloid through the squared misfits, and its covariance if errors are independent.

    Along a furrow there is no bottom: the step is 0, its standard deviation the window's size.
    """
    misfit = (_remove_tilt(excess_m, tilt) ** 2).sum(axis=0)
    _, east, north, east2, both, north2 = _PARABOLOID @ misfit.ravel()
    curvature, axes = np.linalg.eigh(np.array([[2.0 * east2, both], [both, 2.0 * north2]]))
    is_flat = curvature <= _FLAT * curvature[1] + _RIDGE
    inverse = np.where(is_flat, 0.0, 1.0 / np.where(is_flat, 1.0, curvature))
    variance = np.where(is_flat, REACH_M**2, 2.0 * misfit.min() / len(excess_m) * inverse)
    return -axes @ (inverse * (axes.T @ [east, north])), (axes * variance) @ axes.T


def _is_distinct(
    excess_m: FloatArray, best: tuple[int, int], known: FloatArray, shift_m: FloatArray, blocks: Sequence[Rows]
) -> bool:
    """Tell whether every other shift that fits best around it, away along the known directions, fits clearly worse."""
    variance = excess_m.var(axis=0)
    north, east = np.meshgrid(shift_m - shift_m[best[0]], shift_m - shift_m[best[1]], indexing="ij")
    away = np.linalg.norm(np.stack([east, north], axis=-1) @ known, axis=-1) >= _APART_M
    rivals = np.argwhere(away & (variance == minimum_filter(variance, 3, mode="nearest")))
    left = excess_m[:, *best] - excess_m[:, *best].mean()
    return all(
        _compute_gain(excess_m[:, a, b] - excess_m[:, a, b].mean(), left, blocks)[1] > _RIVAL_SIGMAS for a, b in rivals
    )


def _compute_gain(unshifted: FloatArray, shifted: FloatArray, blocks: Sequence[Rows]) -> tuple[float, float]:
    """Return by how much the log of the mean squared misfit falls, and over how many of its standard deviations."""
    squares = np.stack([unshifted**2, shifted**2])
    gain = np.log(squares[0].sum() / squares[1].sum())
    parts = np.stack([squares[:, block].sum(axis=1) for block in blocks], axis=1)
    sums = squares.sum(axis=1, keepdims=True) - parts
    std = np.sqrt(_estimate_covariance(np.log(sums[0] / sums[1])[:, None])[0, 0])
    return float(gain), float(gain / max(std, 1e-12))


def _estimate_covariance(without: FloatArray) -> FloatArray:
    """Return the covariance of an estimate from its values with each stretch left out, shape (B, K)."""
    spread = without - without.mean(axis=0)
    covariance: FloatArray = (len(without) - 1) / len(without) * spread.T @ spread
    return covariance


@dataclass(frozen=True, slots=True)
class SharedShift:
    """The shift that a run takes from all runs of a map, if any, and how far its own is from theirs [m], NaN where they agree."""

    registration: Registration | None
    difference_m: float


def share_shift(
    alone: Sequence[Registration], together: Registration | None, track_std_m: FloatArray
) -> list[SharedShift]:
    """Return what each of several runs takes from a registration of all ``together``.

    The shift that all have in common, plus each run's own about it: by the standard deviation (DRMS) of its track, (N,) [m], and by what
    the runs' shifts scatter more. None is taken where they contradict each other, or too few are determined to bound their scatter.
    """
    shift_m, variance = np.array([registration.shift_xy_m for registration in alone]), track_std_m**2 / 2.0
    information = np.stack([registration.information for registration in alone])
    weights = _widen(information, variance)
    mean_m = np.linalg.pinv(weights.sum(axis=0), hermitian=True) @ np.einsum("nij,nj->i", weights, shift_m)
    freedom = int(_count_known(information).sum()) - 2
    none = [SharedShift(None, float("nan")) for _ in alone]
    if freedom <= 0:
        return none
    if _square(shift_m - mean_m, weights).sum() > chi2.ppf(_AGREE, freedom):
        return _find_contradictions(shift_m, weights)
    if together is None or together.at_reach or not np.isfinite(together.position_std_m):
        return none
    error_m = shift_m - together.shift_xy_m

    def compare(scatter: float) -> float:
        squares = _square(error_m, _widen(information, variance + scatter))
        return float(squares.sum() - chi2.ppf(_SCATTER_QUANTILE, freedom))

    scatter = float(brentq(compare, 0.0, 1e6)) if compare(0.0) > 0.0 else 0.0
    shared = []
    for own, wider in zip(alone, _widen(together.information[None], variance + scatter), strict=True):
        moved = replace(own, shift_xy_m=together.shift_xy_m, information=wider)
        std_m = float(moved.axis_std_m.max())
        taken = replace(moved, shift_std_m=std_m, shifted_misfit_m=together.shifted_misfit_m)
        shared.append(SharedShift(taken, float("nan")))
    return shared


def _find_contradictions(shift_m: FloatArray, weights: FloatArray) -> list[SharedShift]:
    """Return how far the shifts of runs, (N, 2) [m], are from the median of those that are determined; NaN where by chance."""
    is_known = _count_known(weights) > 1
    error_m = shift_m - (np.median(shift_m[is_known], axis=0) if is_known.any() else shift_m)
    squares = np.where(is_known, _square(error_m, weights), 0.0)
    is_odd = is_known & (squares >= min(_CHI2_999, squares.max()))
    return [SharedShift(None, difference_m) for difference_m in np.where(is_odd, np.hypot(*error_m.T), np.nan).tolist()]


def _square(error_m: FloatArray, weights: FloatArray) -> FloatArray:
    """Return squared errors over their variances, (N,)."""
    return np.asarray(np.einsum("ni,nij,nj->n", error_m, weights, error_m))


def _count_known(information: FloatArray) -> Rows:
    """Return how many directions an information, (..., 2, 2) [1/m²], determines."""
    return np.asarray((np.linalg.eigvalsh(information) > 1.0 / REACH_M**2).sum(axis=-1))


def _widen(information: FloatArray, variance: FloatArray) -> FloatArray:
    """Return an information (..., 2, 2) [1/m²] with a variance [m²] added along the directions that it determines."""
    values, axes = np.linalg.eigh(information)
    is_known = values > 1.0 / REACH_M**2
    wider = np.where(is_known, 1.0 / (1.0 / np.where(is_known, values, 1.0) + np.expand_dims(variance, -1)), 0.0)
    return np.asarray((axes * wider[..., None, :]) @ np.swapaxes(axes, -1, -2))
