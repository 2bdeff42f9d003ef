"""The split and the fold of every sample, from its footprint, its run and its id (docs/explanation/rulings.md, Split).

A dataset grows, and a test sample must never become a training sample. So the draw of groups replays the arrival of the
data: run by run, in the order of recording, groups may join test and none leaves it. Later runs do not change earlier
decisions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from hashlib import blake2b
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Bytes, Floats, Mask, Texts
from tcpipe.splits.regions import Regions, classify_footprints

Ints = NDArray[np.signedinteger]
Ranks = NDArray[np.uint64]
Holdout = Literal["block", "sample", "run", "tag"]

SPLITS = ("train", "test", "unseen", "buffer")
"""Values of the column ``split``."""

EXCLUDED = "excluded"
"""Assigned to samples of an exclude region; they do not enter the dataset."""

UNDECIDED = -1
"""A group or sample without a decision yet."""

NO_FOLD = UNDECIDED
"""Fold of a sample that is neither train nor test."""

_NAMES = np.array([*SPLITS, EXCLUDED])
_TRAIN, _TEST, _UNSEEN, _BUFFER, _EXCLUDED = np.arange(len(_NAMES), dtype=np.uint8)
_CODE_BY_SIDE = np.array([_TRAIN, _UNSEEN, _BUFFER, _EXCLUDED])

_CHUNK = 65_536  # footprints whose centres are computed together


@dataclass(frozen=True, slots=True)
class Groups:
    """Samples in groups that stay whole: ``member`` numbers each sample's group, (N,); ``names`` name the G groups."""

    member: Ints
    names: tuple[str, ...]


def assign_blocks(corners_xy_m: Floats, rows: Ints, *, block_m: float) -> Groups:
    """Return the block of the centres of footprints ``rows``: squares of ``block_m`` [m] from the plane's origin."""
    codes = np.empty(len(rows), np.int64)
    for first in range(0, len(rows), _CHUNK):
        part = slice(first, first + _CHUNK)
        cells = np.floor(corners_xy_m[rows[part]].mean(axis=1) / block_m).astype(np.int64)
        codes[part] = (cells[:, 0] << 32) + cells[:, 1]
    blocks = np.unique(codes)
    row = ((blocks + (1 << 31)) & 0xFFFF_FFFF) - (1 << 31)
    cells = np.stack([(blocks - row) >> 32, row], axis=1)
    names = tuple(f"{block_m:g}:{column}:{row}" for column, row in cells.tolist())
    return Groups(np.searchsorted(blocks, codes).astype(np.int32), names)


def draw_samples(ranks: NDArray[np.uint64], arrival: Ints, *, test_fraction: float) -> Mask:
    """Mark ceil(test_fraction · n) samples as test, shape (N,): the lowest ranks of each arrival, up to its share.

    A later arrival moves no earlier sample; one in between changes every later arrival by at most one sample.

    Parameters
    ----------
    ranks : rank of each sample, shape (N,).
    arrival : number of each sample's run in the order of recording, shape (N,).
    """
    exact = Fraction(str(test_fraction))  # 0.2 * 35 is 7.000000000000001 in binary
    test: Mask = np.zeros(len(ranks), bool)
    order, first = np.lexsort((ranks, arrival)), 0
    ends: list[int] = [*(np.flatnonzero(np.diff(arrival[order])) + 1).tolist(), len(order)]
    for end in ends:
        test[order[first : first + math.ceil(exact * end) - math.ceil(exact * first)]] = True
        first = end
    return test


def draw_groups(groups: Groups, arrival: Ints, *, test_fraction: float, seed: int) -> Mask:
    """Mark whole groups as test, shape (G,), nearest to a share ``test_fraction`` of the samples.

    After each arrival the groups so far are visited by rank; a training group joins test if that brings the share
    nearer to ``test_fraction``. Two or more groups always leave samples to test and to train; a single group trains.

    Parameters
    ----------
    arrival : number of each sample's run in the order of recording, shape (N,).
    """
    tests: Mask = np.zeros(len(groups.names), bool)
    order = sort_by_rank(groups.names, seed=seed, purpose="test")
    for sizes in _iterate_sizes(groups, arrival):
        free = order[sizes[order] > 0]
        _add_test_groups(tests, free, sizes, wanted=test_fraction * float(sizes.sum()))
    return tests


def _add_test_groups(tests: Mask, free: Ints, sizes: Ints, *, wanted: float) -> None:
    """Add groups in ``free``, sorted by rank, to ``tests`` while that brings their share nearer to ``wanted``."""
    has_samples = sizes > 0
    taken, remaining = int(sizes[tests].sum()), int((has_samples & ~tests).sum())
    for group in free[~tests[free]].tolist():
        if remaining > 1 and abs(taken + sizes[group] - wanted) < abs(taken - wanted):
            tests[group] = True
            taken, remaining = taken + int(sizes[group]), remaining - 1
    if wanted > 0 and not tests[has_samples].any() and has_samples.sum() > 1 and len(free):
        tests[free[np.argmin(np.abs(sizes[free] - wanted))]] = True


def draw_folds(groups: Groups, arrival: Ints, *, folds: int, seed: int) -> Ints:
    """Deal groups to folds of cross-validation, shape (G,), from 0 on: each to the smallest fold when it first appears.

    ``arrival`` is as in `draw_groups`.
    """
    fold = np.full(len(groups.names), UNDECIDED)
    order = sort_by_rank(groups.names, seed=seed, purpose="fold")
    for sizes in _iterate_sizes(groups, arrival):
        new = order[(fold[order] == UNDECIDED) & (sizes[order] > 0)]
        known = fold != UNDECIDED
        filled = np.bincount(fold[known], weights=sizes[known], minlength=folds)
        for group in new[np.argsort(-sizes[new], kind="stable")].tolist():
            fold[group] = int(np.argmin(filled[:folds]))
            filled[fold[group]] += sizes[group]
    return fold


def _iterate_sizes(groups: Groups, arrival: Ints) -> Iterator[Ints]:
    """Yield the sizes of the groups, (G,), after each arrival."""
    sizes = np.zeros(len(groups.names), np.int64)
    order = np.argsort(arrival, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(arrival[order])) + 1):
        if len(part):
            sizes = sizes + np.bincount(groups.member[part], minlength=len(sizes))
            yield sizes


def group_by_run(run: Ints, names: Sequence[str]) -> Groups:
    """Return runs as groups: the number of each sample's run, shape (N,), and the runs' names by number."""
    used = np.unique(run)
    return Groups(np.searchsorted(used, run).astype(np.int32), tuple(names[number] for number in used.tolist()))


@dataclass(frozen=True, slots=True)
class Assignment:
    """Split of every sample as a number, and its fold or `NO_FOLD`, each a byte: shape (N,)."""

    code: Bytes
    fold: NDArray[np.int8]

    @property
    def split(self) -> Texts:
        """The split of every sample by its name: one of `SPLITS` or `EXCLUDED`."""
        names: Texts = _NAMES[self.code]
        return names

    def is_in(self, *splits: str) -> Mask:
        """Return which samples are in one of these splits, shape (N,)."""
        return np.isin(_NAMES, splits)[self.code]

    def select(self, rows: Ints) -> Assignment:
        """Return the assignment of some samples."""
        return Assignment(self.code[rows], self.fold[rows])


def assign_splits(
    ranks: NDArray[np.uint64],
    run: Ints,
    run_names: Sequence[str],
    corners_xy_m: Floats,
    regions: Regions | None,
    *,
    holdout: Holdout,
    test_fraction: float,
    block_m: float,
    buffer_m: float,
    folds: int,
    seed: int,
    tagged: tuple[Ints, Sequence[str]] | None = None,
) -> Assignment:
    """Return train, test, unseen, buffer or excluded for every sample, and the fold of those that train or test.

    Parameters
    ----------
    ranks : rank of each sample's id for the draw of test, shape (N,).
    run, run_names : number of each sample's run in the order of recording, shape (N,), and the runs' ids by number.
    corners_xy_m : corners of the patch footprints in the map's metric plane [m], shape (N, 4, 2).
    regions : in the same plane; None: every sample is inside.
    holdout : ``sample`` draws single samples; the others keep groups whole.
    test_fraction : share of test among the inside samples, after every drop and buffer.
    block_m : side of a spatial block [m].
    buffer_m : a footprint nearer than this to a region's border is in no split [m].
    folds : number of folds; blocks (with the holdout ``run`` or ``tag`` runs or values) stay whole in them.
    tagged : with the holdout ``tag``: number of each sample's value of the tag, shape (N,), and the values by number.
    """
    n = len(ranks)
    sides = np.zeros(n, np.uint8) if regions is None else classify_footprints(corners_xy_m, regions, buffer_m=buffer_m)
    code = _CODE_BY_SIDE[sides]
    inside = np.flatnonzero(code == _TRAIN)
    whole = {"run": (run, run_names), "tag": tagged}.get(holdout)
    groups = (
        assign_blocks(corners_xy_m, inside, block_m=block_m)
        if whole is None
        else group_by_run(whole[0][inside], whole[1])
    )
    if holdout == "sample":
        test = draw_samples(ranks[inside], run[inside], test_fraction=test_fraction)
    else:
        test = draw_groups(groups, run[inside], test_fraction=test_fraction, seed=seed)[groups.member]
    code[inside] = np.where(test, _TEST, _TRAIN)
    fold = np.full(n, NO_FOLD, np.int8)
    fold[inside] = draw_folds(groups, run[inside], folds=folds, seed=seed)[groups.member]
    return Assignment(code, fold)


def hash_ranks(names: Sequence[str], *, seed: int, purpose: str) -> Ranks:
    """Return a rank for each name, uniform over 64 bits, shape (N,), independent of machine and other names.

    It is the first 8 bytes, big-endian, of blake2b over ``seed:name`` with ``purpose`` as person string: ranks for two
    purposes are independent, so that the row order does not depend on the holdout.
    """
    person = purpose.encode()[:16]
    digests = b"".join(blake2b(f"{seed}:{name}".encode(), digest_size=8, person=person).digest() for name in names)
    return np.frombuffer(digests, dtype=">u8").astype(np.uint64)


def sort_by_rank(names: Sequence[str], *, seed: int, purpose: str) -> NDArray[np.int64]:
    """Return the indices that sort ``names`` by their rank, names themselves breaking a tie; shape (N,)."""
    ranks = hash_ranks(names, seed=seed, purpose=purpose)
    order = np.argsort(ranks, kind="stable")
    if (np.diff(ranks[order]) == 0).any():
        order = np.lexsort((np.asarray(names, dtype=np.str_), ranks))
    return order.astype(np.int64, copy=False)
