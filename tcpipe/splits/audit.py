"""The leakage audit: how much ground of test and unseen samples training has, too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.splits.neighbours import compute_nearest_m, compute_shared_fraction, iterate_near_pairs

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CONTACT_FRACTION = 1e-3
"""Footprints that share less of their area than this touch; consecutive segments always do."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """One held-out split against train; counts are of samples or of pairs of samples."""

    split: str
    """``test`` or ``unseen``."""
    samples: int
    """Samples in it."""
    overlapping_samples: int
    """Those whose footprint shares ground with a train footprint."""
    overlapping_pairs: int
    """Pairs of footprints, one held out and one in train, that share ground."""
    same_track_pairs: int
    """Pairs that follow one another on one track, one held out and one in train."""
    repeated_place_samples: int
    """Those that share ground with a train footprint of another run."""
    nearest_train_min_m: float | None
    """Distance between the nearest footprints of the two splits [m]; None where one is empty."""
    nearest_train_median_m: float | None
    """Median over the held-out samples of the distance to the nearest train footprint [m]."""


def audit_leakage(
    split: NDArray[np.str_], run: Ints, start_ns: Ints, corners_xy_m: Floats, *, chord_m: float
) -> tuple[HeldOut, ...]:
    """Return one entry for ``test`` and one for ``unseen``, each against train.

    Parameters
    ----------
    split, run, start_ns : split of each sample, number of its run, and start of its segment [ns], shape (N,).
    corners_xy_m : corners of the footprints [m], shape (N, 4, 2).
    chord_m : segment length [m]; samples follow one another if their centres are at most 1.5 chords apart.
    """
    follows = _find_consecutive(run, start_ns, corners_xy_m.mean(axis=1), chord_m=chord_m)
    return tuple(_audit_split(name, split, run, follows, corners_xy_m) for name in ("test", "unseen"))


def _find_consecutive(run: Ints, start_ns: Ints, centres_xy_m: Floats, *, chord_m: float) -> Ints:
    """Return index pairs of samples that follow one another on one track, shape (P, 2)."""
    order = np.lexsort((start_ns, run))
    before, after = order[:-1], order[1:]
    apart_m = np.linalg.norm(centres_xy_m[after] - centres_xy_m[before], axis=1)
    adjoining = (run[before] == run[after]) & (apart_m <= 1.5 * chord_m)
    return np.column_stack([before[adjoining], after[adjoining]])


def _audit_split(name: str, split: NDArray[np.str_], run: Ints, follows: Ints, corners_xy_m: Floats) -> HeldOut:
    held, train = np.flatnonzero(split == name), np.flatnonzero(split == "train")
    queries, references = corners_xy_m[held], corners_xy_m[train]
    pairs, overlaps, repeated = 0, np.zeros(len(held), np.bool_), np.zeros(len(held), np.bool_)
    diagonal_m = float(np.linalg.norm(corners_xy_m[:, 2] - corners_xy_m[:, 0], axis=1).max(initial=0.0))
    for i, j in iterate_near_pairs(queries.mean(axis=1), references.mean(axis=1), within_m=diagonal_m):
        real = compute_shared_fraction(queries, references, i, j) > _CONTACT_FRACTION
        pairs += int(real.sum())
        overlaps[i[real]] = True
        repeated[i[real & (run[held[i]] != run[train[j]])]] = True
    crossing = (split[follows] == name).any(axis=1) & (split[follows] == "train").any(axis=1)
    apart_m = compute_nearest_m(queries, references)
    return HeldOut(
        split=name,
        samples=len(held),
        overlapping_samples=int(overlaps.sum()),
        overlapping_pairs=pairs,
        same_track_pairs=int(crossing.sum()),
        repeated_place_samples=int(repeated.sum()),
        nearest_train_min_m=float(apart_m.min()) if len(apart_m) else None,
        nearest_train_median_m=float(np.median(apart_m)) if len(apart_m) else None,
    )
