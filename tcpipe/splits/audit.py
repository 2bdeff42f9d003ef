"""Leakage audit: ground that test and unseen samples share with training, by near pairs of footprints in one plane."""

from collections.abc import Mapping, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tcpipe.arrays import Floats, GenericArray, Mask
from tcpipe.tables.facts import HeldOut

Ints = NDArray[np.signedinteger]

_CONTACT_FRACTION = 1e-3  # footprints that share less of their area than this touch; consecutive segments always do

_CHUNK = 4_096  # footprints per query: each may be near hundreds of others

_PAIRS = 65_536  # pairs that are geometries at one time (1 kB each)

CLOSE = 1.05
"""Distance to a training sample up to which ground counts as covered [chords]: consecutive samples are one apart."""

PLACES = ("start_lon_deg", "start_lat_deg", "end_lon_deg", "end_lat_deg")
"""Columns of a chord's ends."""

LOCAL_PLACES = ("start_x_m", "start_y_m", "end_x_m", "end_y_m")
"""The same in a dataset without coordinates, where all runs have one frame."""

_M_A_DEG = 111_195.0  # of a great circle: to half a per cent


def audit_leakage(
    train: Mask, held: Mapping[str, Mask], run: Ints, start_ns: Ints, corners_xy_m: Floats, *, chord_m: float
) -> tuple[HeldOut, ...]:
    """Return, for each split in ``held``, how much ground and how many neighbours its samples share with train.

    Parameters
    ----------
    train, held : which samples are in each split, shape (N,).
    run, start_ns : number of each sample's run, and start of its segment [ns], shape (N,).
    corners_xy_m : corners of the footprints [m], shape (N, 4, 2).
    chord_m : segment length [m]; samples follow one another if their centres are at most 1.5 chords apart.
    """
    neighbours = _count_neighbours(train, run, start_ns, corners_xy_m, chord_m=chord_m)
    ground = Footprints(corners_xy_m, np.flatnonzero(train))
    return tuple(_audit_split(name, np.flatnonzero(is_held), run, ground, neighbours) for name, is_held in held.items())


def _count_neighbours(train: Mask, run: Ints, start_ns: Ints, corners_xy_m: Floats, *, chord_m: float) -> Ints:
    """Return how many training samples follow or precede each sample on its track, shape (N,)."""
    order, found = np.lexsort((start_ns, run)), np.zeros(len(run), np.int8)
    for first in range(0, len(order) - 1, _CHUNK):
        rows = order[first : first + _CHUNK + 1]
        before, after = rows[:-1], rows[1:]
        apart_m = np.linalg.norm(np.diff(corners_xy_m[rows].mean(axis=1), axis=0), axis=1)
        adjoining = (run[before] == run[after]) & (apart_m <= 1.5 * chord_m)
        found[before] += adjoining & train[after]
        found[after] += adjoining & train[before]
    return found


class Footprints:
    """Ground of footprints ``rows`` among all, whose corners are in order around each square, shape (N, 4, 2) [m]."""

    def __init__(self, corners_xy_m: Floats, rows: Ints) -> None:
        self.corners_xy_m, self.rows = corners_xy_m, rows
        centres, self.half_diagonal_m = np.empty((len(rows), 2)), 0.0
        for first in range(0, len(rows), _CHUNK):
            corners = corners_xy_m[rows[first : first + _CHUNK]]
            centres[first : first + _CHUNK] = corners.mean(axis=1)
            self.half_diagonal_m = max(self.half_diagonal_m, _compute_half_diagonal_m(corners))
        self.tree = cKDTree(centres)


def _audit_split(name: str, held: Ints, run: Ints, train: Footprints, neighbours: Ints) -> HeldOut:
    pairs, apart_m = 0, [np.empty(0)]
    shares, repeats = np.zeros(len(held), bool), np.zeros(len(held), bool)
    for part in _split_points(np.arange(len(held)), _CHUNK) if len(train.rows) else []:
        rows = held[part]
        queries = train.corners_xy_m[rows]
        reach_m = _compute_half_diagonal_m(queries) + train.half_diagonal_m
        i, j = find_near_pairs(queries.mean(axis=1), train.tree, within_m=reach_m)
        j = train.rows[j]
        real = compute_shared_fraction(queries, train.corners_xy_m, i, j) > _CONTACT_FRACTION
        pairs += int(real.sum())
        shares[part[i[real]]] = True
        repeats[part[i[real & (run[rows[i]] != run[j])]]] = True
        apart_m.append(compute_nearest_m(queries, train))
    nearest_m = np.concatenate(apart_m)
    return HeldOut(
        split=name,
        samples=len(held),
        overlapping_samples=int(shares.sum()),
        overlapping_pairs=pairs,
        same_track_pairs=int(neighbours[held].sum()),
        repeated_place_samples=int(repeats.sum()),
        nearest_train_min_m=float(nearest_m.min()) if len(nearest_m) else None,
        nearest_train_median_m=float(np.median(nearest_m)) if len(nearest_m) else None,
    )


def compute_middles(ends: Sequence[GenericArray]) -> Floats:
    """Return the middles of chords, shape (N, 2), by the columns `PLACES` [deg] or `LOCAL_PLACES` [m]."""
    x0, y0, x1, y1 = (end.astype(float) for end in ends)
    return np.column_stack([(x0 + x1) / 2.0, (y0 + y1) / 2.0])


def are_near(queries: Floats, references: Floats, *, within_m: float, in_degrees: bool) -> Mask:
    """Return which of ``queries``, shape (N, 2), are within a distance of one of ``references``; NaN is near none.

    Both are lon, lat [deg] if ``in_degrees``, else x, y [m].
    """
    scale = np.ones(2)
    if in_degrees and len(queries):
        scale = _M_A_DEG * np.array([np.cos(np.radians(np.nanmean(queries[:, 1]))), 1.0])
    known, others = np.isfinite(queries).all(axis=1), references[np.isfinite(references).all(axis=1)]
    found = np.zeros(len(queries), bool)
    if known.any() and len(others):
        origin = others[0]
        tree = cKDTree((others - origin) * scale)
        apart_m, _ = tree.query((queries[known] - origin) * scale, distance_upper_bound=within_m)
        found[known] = np.isfinite(apart_m)
    return found


def find_near_pairs(queries_xy_m: Floats, tree: cKDTree, *, within_m: float) -> tuple[Ints, Ints]:
    """Return index pairs of ``queries``, (N, 2), and points of a tree at most ``within_m`` [m] apart, in order."""
    found = cKDTree(queries_xy_m).sparse_distance_matrix(tree, within_m, output_type="ndarray")
    order = np.lexsort((found["j"], found["i"]))
    return found["i"][order], found["j"][order]


def compute_shared_fraction(queries: Floats, references: Floats, i: Ints, j: Ints) -> Floats:
    """Return the share of ``queries[i]`` that ``references[j]`` covers, (P,); ordered corners, shape (N, 4, 2)."""
    ours, shared_m2 = shapely.polygons(queries), np.empty(len(i))
    for first in range(0, len(i), _PAIRS):
        part = slice(first, first + _PAIRS)
        theirs = shapely.polygons(references[j[part]])
        shared_m2[part] = shapely.area(shapely.intersection(ours[i[part]], theirs))
    return np.asarray(shared_m2 / shapely.area(ours)[i])


def compute_nearest_m(queries: Floats, ground: Footprints) -> Floats:
    """Return the distance of ``queries``, corners (N, 4, 2), to the nearest ground [m], (N,); empty if one is."""
    count = len(ground.rows)
    if len(queries) == 0 or count == 0:
        return np.empty(0)
    reach_m = _compute_half_diagonal_m(queries) + ground.half_diagonal_m
    best_m = np.full(len(queries), np.inf)
    pending = [(rows, 8) for rows in _split_points(np.arange(len(queries)), _CHUNK)]
    while pending:
        rows, wanted = pending.pop()
        count_per_query = min(wanted, count)
        distances_m, j = ground.tree.query(queries[rows].mean(axis=1), k=np.arange(1, count_per_query + 1))
        near = shapely.polygons(ground.corners_xy_m[ground.rows[j]])
        best_m[rows] = shapely.distance(shapely.polygons(queries[rows])[:, None], near).min(axis=1)
        # squares are nearer than their centres by at most two half diagonals: what is farther still cannot win
        doubtful = rows[(best_m[rows] > np.asarray(distances_m)[:, -1] - reach_m) & (best_m[rows] > 0.0)]
        if count_per_query < count:
            pending += [(part, 4 * wanted) for part in _split_points(doubtful, max(_CHUNK * 2 // wanted, 1))]
    return best_m


def _split_points(rows: Ints, size: int) -> list[Ints]:
    return [rows[first : first + size] for first in range(0, len(rows), size)]


def _compute_half_diagonal_m(corners: Floats) -> float:
    across: Floats = corners[:, 2] - corners[:, 0]
    return float(np.hypot(across[:, 0], across[:, 1]).max(initial=0.0)) / 2.0
