"""Registration of a map to a track by ground heights: the horizontal shift, and the unit of the map's heights.

Heights of track and map differ by a constant and by the shape of the ground. The shift at which the shapes agree best
is searched on a lattice (terrain-aided navigation, Hollowell 1990; Nuth & Kääb 2011) and refined by a paraboloid
through the squared misfits. A tilt of the map and a drift of the track's heights, which look like a shift on a smooth
hill, are fitted with it. The shift's standard deviation is the scatter of the best shift among random draws of blocks
of the path (block bootstrap, Künsch 1989), since errors of GNSS are correlated over seconds, and those of the map over
metres. A shift along which the ground does not vary, or repeats itself, is unobservable and stays zero.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from tcpipe.arrays import Floats, Ints, Mask, accumulate
from tcpipe.robust import estimate_robust_std
from tcpipe.tables.findings import read_threshold
from tcpipe.terrain.sampling_kernel import compute_morton
from tcpipe.terrain.tiles import MapReader, choose_level, group_by_tile, read_tile_window

REACH_M, KNOWN_M = 4.0, 0.25
"""Range of shifts each way [m]; largest standard deviation of a shift along a determined direction [m]."""
_STEP_M, _NEAR = 0.25, 2
"""Step of the lattice of shifts [m], and steps each way from the best shift through which the paraboloid is fitted."""
_SHIFT_M = np.arange(-round(REACH_M / _STEP_M), round(REACH_M / _STEP_M) + 1) * _STEP_M
_LATTICE_M = np.stack(np.meshgrid(_SHIFT_M, _SHIFT_M), axis=-1)
"""Shifts to the east and north, by row (north) and column (east), (K, K, 2)."""
_MIDDLE = len(_SHIFT_M) // 2, len(_SHIFT_M) // 2


def _expand_square(east_m: Floats, north_m: Floats) -> Floats:
    """Return a paraboloid's terms (1, gradient, curvature) at places (N,), shape (N, 6)."""
    squares = east_m**2 / 2.0, east_m * north_m, north_m**2 / 2.0
    return np.stack([np.ones_like(east_m), east_m, north_m, *squares], axis=-1)


_PARABOLOID = np.linalg.pinv(
    _expand_square(*(np.mgrid[-_NEAR : _NEAR + 1, -_NEAR : _NEAR + 1].reshape(2, -1)[::-1] * _STEP_M))
)
_SPACING_M, _DRIFT_M, _CLIFF_M = 0.5, 25.0, 1.0
"""Spacing of points; path of one error of the track's heights; relief among near shifts that no robot drives on [m]."""
_FEWEST_POINTS, _MOST_POINTS = 60, 1_200
"""Fewest and most points of a track."""
_BLOCKS, _DRAWS, _FEW_BLOCKS = 12, 200, 1.38
"""Blocks of the path, draws of them, variance factor for few blocks: 12 / 11 times (Student's t / normal)²."""
_SIGMAS, _OUTLIER, _EDGE_M = 5.0, 3.5, 0.75 * _STEP_M
"""Least decrease of the misfit by a shift [σ]; least outlier [σ]; least step beyond the best inner shift [m]."""
_CHI2_999 = 13.82  # 99.9 % of χ² with two degrees of freedom
_LEAST_GAIN = -2.0 * np.log(0.9)  # A shift that leaves more than 90 % of the misfit is not the cause
_RIDGE = 1e-12  # smallest divisor
_UNITS = {0.3048: "ft", 0.1: "dm", 0.01: "cm", 0.001: "mm"}
_UNITS |= {1.0 / metres: "m" for metres in _UNITS}
"""Unit of a map's heights by their scale; metres that were converted from another unit by mistake have its inverse."""
_MAX_UNIT_ERROR = 0.07
_KNOWN_SCALE, _EXPLAINED, _MAX_WRONG_STD, _MIN_WRONG_EXPLAINED = 0.03, 0.9, 0.1, 0.7
"""Largest relative σ and least explained share of a scale to compare with 1; the same of a surely wrong scale."""


@dataclass(frozen=True, slots=True)
class HeightScale:
    """Metres that a track rises per metre on the map, its σ, and the explained share of the track's variance."""

    value: float
    std: float
    explained: float

    @property
    def is_known(self) -> bool:
        """Whether it is certain enough to compare with one."""
        return self.std < _KNOWN_SCALE * max(self.value, 1.0) and self.explained > _EXPLAINED

    def is_wrong(self) -> bool:
        """Return whether the map's heights are scaled or in another unit; map noise lowers `value` to ``explained``."""
        if self.std > _MAX_WRONG_STD * self.value or self.explained < _MIN_WRONG_EXPLAINED:
            return False
        most, margin = read_threshold("map-height-scale", "max_factor"), 3.0 * self.std
        return self.value + margin < self.explained / most or self.value - margin > most

    def find_unit(self) -> str:
        """Return the unit of the map's heights; "" if it is no known unit."""
        error = max(3.0 * self.std / self.value, _MAX_UNIT_ERROR)
        return next((unit for scale, unit in _UNITS.items() if abs(self.value / scale - 1.0) < error), "")

    def is_off(self) -> bool:
        """Return whether map and track certainly have different height scales."""
        least = read_threshold("map-height-scale", "min_error_fraction")
        return self.is_known and abs(self.value - 1.0) > max(_SIGMAS * self.std, least)


@dataclass(frozen=True, slots=True)
class Registration:
    """Shift of a map against a track, and the remaining misfit.

    ``shift_xy_m``: correction of the track's positions to their ground on the map [m, the map's axes], along determined
    directions only. ``height_offset_m``: track minus map. ``misfit_m``, ``shifted_misfit_m``: standard deviations of
    the misfit without and with the shift, ``shape_misfit_m`` with the shift, a tilt and a drift. ``significant``: the
    shift is not chance. ``at_reach``: the true shift may be beyond the lattice. ``scale``: of heights. ``covariance``:
    of the shift, (2, 2) [m²]; its variance is ``REACH_M**2`` along directions that are not determined.
    """

    points: int
    shift_xy_m: tuple[float, float]
    height_offset_m: float
    misfit_m: float
    shifted_misfit_m: float
    shape_misfit_m: float
    significant: bool
    at_reach: bool
    scale: HeightScale
    covariance: Floats

    @property
    def shift_m(self) -> float:
        """Length of the shift [m]."""
        return float(np.hypot(*self.shift_xy_m))

    @property
    def shift_std_m(self) -> float:
        """Largest standard deviation of the shift along determined directions [m], NaN where none is determined."""
        variances = np.linalg.eigvalsh(self.covariance)
        return float(max(variances[variances < KNOWN_M**2] ** 0.5, default=np.nan))

    @property
    def position_std_m(self) -> float:
        """DRMS of the shift [m], NaN unless it is determined in both directions."""
        is_known = np.linalg.eigvalsh(self.covariance)[-1] < KNOWN_M**2
        return float(np.sqrt(np.trace(self.covariance))) if is_known else np.nan

    @property
    def left_m(self) -> float:
        """Misfit with the shift if that is significant, else without [m]."""
        return self.shifted_misfit_m if self.significant else self.misfit_m


def register_track(source: MapReader, xy_m: Floats, height_m: Floats) -> Registration | None:
    """Return the horizontal shift at which the map's ground fits the heights of a track best.

    None if fewer than 60 points, half a metre apart, are well inside the map and on its ground.

    Parameters
    ----------
    source : the map.
    xy_m : positions in the map's CRS, in driving order, shape (N, 2) [m]; positions not finite or outside the map are
        skipped.
    height_m : their heights above any surface, shape (N,) [m].
    """
    level, (xy_m, height_m) = choose_level(source, _STEP_M), _thin_track(xy_m, height_m)
    inside = level.grid.contains(xy_m)
    xy_m, height_m = xy_m[inside], height_m[inside]
    ground_m = _sample_heights(level, xy_m)
    whole = np.isfinite(ground_m).all(axis=(1, 2))
    if whole.sum() < _FEWEST_POINTS:
        return None
    xy_m, height_m, ground_m = xy_m[whole], height_m[whole], ground_m[whole]
    excess_m = ground_m - height_m[:, None, None]
    near, good = _find_ground(excess_m, xy_m)
    if near.sum() < _FEWEST_POINTS:
        return None
    scale = _fit_height_scale(ground_m[near], height_m[near], xy_m[near])
    return _refine_shift(excess_m[near], excess_m[good], xy_m[good], scale)


def _thin_track(xy_m: Floats, height_m: Floats) -> tuple[Floats, Floats]:
    """Return finite points half a metre of path apart, or further apart if there are too many."""
    is_finite = np.isfinite(xy_m).all(axis=1) & np.isfinite(height_m)
    xy_m, height_m = xy_m[is_finite], height_m[is_finite]
    path_m = accumulate(np.hypot(*np.diff(xy_m, axis=0).T))[: len(xy_m)]
    spacing_m = max(_SPACING_M, path_m[-1] / _MOST_POINTS) if path_m.size else _SPACING_M
    rows = np.unique((path_m / spacing_m).astype(np.int64), return_index=True)[1]
    return xy_m[rows], height_m[rows]


def _sample_heights(level: MapReader, xy_m: Floats) -> Floats:
    """Return map heights at every point and pair of shifts (north, east), shape (N, K, K); NaN without data."""
    px, offset_px = level.grid.px_from_xy(xy_m), _SHIFT_M / level.grid.pixel_size_m
    reach_px, found = int(np.ceil(offset_px[-1])) + 2, np.empty((len(xy_m), *2 * _SHIFT_M.shape))
    for group in group_by_tile(px, level):
        first, last = (np.floor(ends).astype(int) for ends in (px[group].min(axis=0), px[group].max(axis=0) + 1.0))
        (col0, row0), (col1, row1) = first - reach_px, last + reach_px
        window = read_tile_window(level, "height", row0, row1, col0, col1).astype(float)
        x, y = px[group, 0, None] - col0 + offset_px, px[group, 1, None] - row0 - offset_px  # rows run south
        places = np.broadcast_arrays(y[:, :, None], x[:, None, :])
        found[group] = map_coordinates(window, places, order=1)
    return found + level.height_reference_m


def _find_ground(excess_m: Floats, xy_m: Floats) -> tuple[Mask, Mask]:
    """Return the points on the map's ground at the best shift, (N,), and those (off cliffs) that determine a shift."""
    flat_m = excess_m - _fit_tilt(xy_m, excess_m[:, *_MIDDLE])[:, None, None]
    best = _find_least(np.median(np.abs(flat_m - np.median(flat_m, axis=0)), axis=0))
    for _ in range(6):
        residual_m = excess_m[:, *best] - _fit_tilt(xy_m, excess_m[:, *best])
        residual_m = np.abs(residual_m - np.median(residual_m))
        row, column = np.clip(best, _NEAR, len(_SHIFT_M) - 1 - _NEAR) - _NEAR
        relief_m = np.ptp(excess_m[:, row : row + 2 * _NEAR + 1, column : column + 2 * _NEAR + 1], axis=(1, 2))
        # On steep ground, a shift by one step changes the residual by half of the relief.
        near = residual_m - relief_m / 2.0 <= _OUTLIER * estimate_robust_std(residual_m)
        good = near & (relief_m < _CLIFF_M)
        if good.sum() < _FEWEST_POINTS:
            return near, near
        before, best = best, _find_least(_flatten(excess_m[good], xy_m[good])[0].var(axis=0))
        if best == before:
            break
    return near, good


def _fit_tilt(xy_m: Floats, excess_m: Floats) -> Floats:
    """Return the tilt of the plane of least absolute excess, shape (N,) [m], robust against bridges and trees."""
    off_m, columns = excess_m - np.median(excess_m), np.column_stack([xy_m - xy_m.mean(axis=0), np.ones(len(xy_m))])
    plane = least_squares(lambda plane: columns @ plane - off_m, np.zeros(3), loss="soft_l1", f_scale=0.01).x
    return np.asarray(columns[:, :2] @ plane[:2])


def _find_least(spread: Floats) -> tuple[int, int]:
    """Return the lattice indices (north, east) of the shift that leaves the least spread."""
    i, j = np.unravel_index(int(spread.argmin()), spread.shape)
    return int(i), int(j)


def _flatten(excess_m: Floats, xy_m: Floats) -> tuple[Floats, Floats, Ints]:
    """Return the excess without tilt and piecewise constant drift; the tilt's columns, (N, 2); each point's block."""
    path_m = np.cumsum(np.hypot(*np.diff(xy_m, axis=0, prepend=xy_m[:1]).T))
    count = max(_BLOCKS, round(float(path_m[-1]) / _DRIFT_M))
    place = np.minimum(path_m * count // path_m[-1], count - 1)
    _, first, section, sizes = np.unique(place, return_index=True, return_inverse=True, return_counts=True)
    flat_m, tilt = (each - (np.add.reduceat(each, first).T / sizes).T[section] for each in (excess_m, xy_m))
    # Blocks of sections near each other: errors of the map repeat where the track passes again.
    east_m, north_m = ((xy_m - tilt)[first] - xy_m.min(axis=0)).T
    rank = np.argsort(np.argsort(compute_morton(east_m.astype(np.int64), north_m.astype(np.int64)), kind="stable"))
    return _remove_tilt(flat_m, tilt), tilt, (rank * min(_BLOCKS, len(sizes)) // len(sizes))[section]


def _remove_tilt(values: Floats, tilt: Floats) -> Floats:
    """Return values, shape (N, ...), less their least-squares fit by a tilt's columns, (N, 2), of mean zero."""
    flat = values.reshape(len(values), -1)
    return (flat - tilt @ (np.linalg.pinv(tilt) @ flat)).reshape(values.shape)


def _fit_height_scale(ground_m: Floats, height_m: Floats, xy_m: Floats) -> HeightScale:
    """Return the scale of heights, fitted with a tilt of the map unless the scale is that of a known unit."""
    whole, tilt = _regress_heights(ground_m, height_m), xy_m - xy_m.mean(axis=0)
    if whole.is_wrong() and whole.find_unit():
        return whole
    return _regress_heights(_remove_tilt(ground_m, tilt), _remove_tilt(height_m, tilt))


def _regress_heights(ground_m: Floats, height_m: Floats) -> HeightScale:
    """Return the regression of the track's heights, (N,), on the map's, (N, K, K), at the shift of best correlation."""
    ground, height = ground_m - ground_m.mean(axis=0), height_m - height_m.mean()
    squares, products = np.einsum("nij,nij->ij", ground, ground), np.einsum("nij,n->ij", ground, height)
    explained = np.maximum(products, 0.0) ** 2 / (squares * (height @ height) + _RIDGE)
    best = _find_least(-explained)
    along, first = ground[:, *best], np.arange(_BLOCKS) * len(height) // _BLOCKS
    without = products[best] - np.add.reduceat(along * height, first)
    without /= squares[best] - np.add.reduceat(along**2, first) + _RIDGE
    std = float(without.std() * np.sqrt(_BLOCKS - 1.0))  # jackknife
    return HeightScale(float(products[best] / (squares[best] + _RIDGE)), std, float(explained[best]))


def _refine_shift(near_m: Floats, good_m: Floats, xy_m: Floats, scale: HeightScale) -> Registration:
    """Return the best shift of the lattice, refined by the excess at good points; misfits are those of near points."""
    flat_m, tilt, block = _flatten(good_m, xy_m)
    squares = _resample_squares(flat_m, tilt, block)
    at, paraboloids = _fit_paraboloids(squares)
    curvature, axes = np.linalg.eigh(paraboloids[:, [3, 4, 4, 5]].reshape(-1, 2, 2))
    inverse = (axes / np.maximum(curvature, _RIDGE)[:, None]) @ axes.swapaxes(1, 2)
    steps_m = np.clip(-np.einsum("rij,rj->ri", inverse, paraboloids[:, 1:3]), -REACH_M, REACH_M)
    first_m = _LATTICE_M[*at[0]]
    error_m = _LATTICE_M[*at.T] + steps_m - first_m - steps_m[0]
    independent = 2.0 * paraboloids[0, 0] / len(flat_m) * inverse[0]
    variances, axes = np.linalg.eigh(_FEW_BLOCKS * error_m.T @ error_m / _DRAWS + independent)
    is_known = variances < KNOWN_M**2
    known = (axes * is_known) @ axes.T
    step_m = np.clip(known @ steps_m[0], -_STEP_M, _STEP_M)
    fitted_m, covariance = known @ first_m + step_m, (axes * np.where(is_known, variances, REACH_M**2)) @ axes.T
    gains = np.log(squares[:, *_MIDDLE] / squares[:, *at[0]])
    is_better = gains[0] > max(_LEAST_GAIN, _SIGMAS * gains[1:].std())
    terms = _expand_square(*step_m)
    return Registration(
        points=len(flat_m),
        shift_xy_m=(float(fitted_m[0]), float(fitted_m[1])),
        height_offset_m=-float(near_m[:, *at[0]].mean()),
        misfit_m=float(near_m[:, *_MIDDLE].std()),
        shifted_misfit_m=float(np.sqrt(_fit_paraboloids(near_m.var(axis=0)[None], at[:1])[1][0] @ terms)),
        shape_misfit_m=float(np.sqrt(paraboloids[0] @ terms / len(flat_m))),
        significant=bool(is_better and fitted_m @ np.linalg.inv(covariance) @ fitted_m > _CHI2_999),
        at_reach=bool(np.linalg.norm(known @ (_LATTICE_M[_find_least(squares[0])] - first_m)) > _EDGE_M),
        scale=scale,
        covariance=covariance,
    )


def _resample_squares(flat_m: Floats, tilt: Floats, block: Ints) -> Floats:
    """Return squared misfits of all points and of random blocks, shape (1 + draws, K, K), each without tilt."""
    flat, count = flat_m.reshape(len(flat_m), -1), int(block.max()) + 1
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), _DRAWS)
    weights, blocks = np.vstack((np.ones((1, count)), drawn)), [block == number for number in range(count)]
    squares = weights @ np.stack([np.square(flat[rows]).sum(axis=0) for rows in blocks])
    by_flat, by_tilt = (
        np.tensordot(weights, np.stack([tilt[rows].T @ each[rows] for rows in blocks]), 1) for each in (flat, tilt)
    )
    squares -= np.einsum("rik,rik->rk", by_flat, np.linalg.pinv(by_tilt, hermitian=True) @ by_flat)
    return np.asarray(squares.reshape(-1, *flat_m.shape[1:]))


def _fit_paraboloids(misfits: Floats, at: Ints | None = None) -> tuple[Ints, Floats]:
    """Return each misfit's minimum (north, east), (R, 2), and the paraboloid around it, (R, 6), as `_expand_square`."""
    near = sliding_window_view(misfits, (2 * _NEAR + 1,) * 2, axis=(1, 2))
    if at is None:
        inner = near[:, :, :, _NEAR, _NEAR]
        at = np.stack(np.unravel_index(inner.reshape(len(inner), -1).argmin(axis=1), inner.shape[1:]), axis=1) + _NEAR
    windows = near[np.arange(len(misfits)), *(at - _NEAR).T]
    return at, windows.reshape(len(misfits), -1) @ _PARABOLOID.T
