"""Which inside samples test: the paper's per-sample draw, whole spatial blocks, or whole runs (docs/explanation/rulings.md, Split).

A dataset grows, and a sample that tested one must not train the next. So the draw of groups replays how the data came: run by run, in
the order of recording, groups may join test and none leaves it. What later runs add cannot undo what earlier ones decided.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.splits.ranking import sort_by_rank

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Holdout = Literal["block", "sample", "run", "tag"]

UNDECIDED = -1
"""A group of which nothing is known yet."""


@dataclass(frozen=True, slots=True)
class Groups:
    """Samples in groups that stay whole: ``member`` numbers each sample's group, (N,); ``names`` name the G groups."""

    member: Ints
    names: tuple[str, ...]

    def decided(self, values: Ints) -> Ints:
        """Return for each group the value that most of its samples have, `UNDECIDED` where none has one, (G,).

        Parameters
        ----------
        values : a small number for each sample, or `UNDECIDED`, shape (N,).
        """
        kinds = int(values.max(initial=UNDECIDED)) + 1
        if kinds == 0:
            return np.full(len(self.names), UNDECIDED)
        known = values != UNDECIDED
        ballots = self.member[known] * kinds + values[known]
        votes = np.bincount(ballots, minlength=len(self.names) * kinds).reshape(-1, kinds)
        return np.where(votes.any(axis=1), votes.argmax(axis=1), UNDECIDED)


def assign_blocks(centres_xy_m: Floats, *, block_m: float) -> Groups:
    """Return the spatial block of each footprint's centre: square cells of ``block_m`` [m] on the plane's own origin."""
    cells = np.floor(centres_xy_m / block_m).astype(np.int64)
    codes, first, member = np.unique((cells[:, 0] << 32) + cells[:, 1], return_index=True, return_inverse=True)
    names = tuple(f"{block_m:g}:{column}:{row}" for column, row in cells[first].tolist())
    return Groups(member.astype(np.int64).reshape(len(cells)), names if len(codes) else ())


def draw_samples(ranks: NDArray[np.uint64], arrival: Ints, *, test_fraction: float, kept: Ints | None = None) -> Mask:
    """Mark ceil(test_fraction · n) samples as test: those of lowest rank of every arrival, as many as make up the share so far.

    What comes later moves none of those before, and where something comes in between, every later arrival changes by one sample at most.

    Parameters
    ----------
    ranks : rank of each sample, shape (N,).
    arrival : when each came: the number of its run in the order of recording, shape (N,).
    test_fraction : wanted share.
    kept : 1 for samples that test whatever their rank, 0 for those that do not, `UNDECIDED` for the others, shape (N,).

    Returns
    -------
    Whether each sample tests, shape (N,).
    """
    exact = Fraction(str(test_fraction))  # 0.2 * 35 is 7.000000000000001 in binary
    kept = np.full(len(ranks), UNDECIDED) if kept is None else kept
    test: Mask = kept == 1
    order = np.lexsort((ranks, arrival))
    ends: list[int] = [*(np.flatnonzero(np.diff(arrival[order])) + 1).tolist(), len(order)]
    missing, first = -int(test.sum()), 0
    for end in ends:
        missing += math.ceil(exact * end) - math.ceil(exact * first)
        free = order[first:end][kept[order[first:end]] == UNDECIDED]
        chosen = free[: max(missing, 0)]
        test[chosen] = True
        missing, first = missing - len(chosen), end
    rest = np.flatnonzero((kept == UNDECIDED) & ~test)
    test[rest[np.argsort(ranks[rest], kind="stable")][: max(missing, 0)]] = True
    return test


def draw_groups(
    groups: Groups, arrival: Ints, *, test_fraction: float, seed: int, kept: Ints | None = None
) -> NDArray[np.bool_]:
    """Mark whole groups as test, nearest to a share of ``test_fraction``.

    After each arrival the groups seen so far are gone through by rank; one that does not test yet joins if it brings the share nearer to
    the wanted one. Two groups or more always leave something to test and something to train; a single group cannot be divided and trains.

    Parameters
    ----------
    groups : the samples' groups.
    arrival : when each sample came: the number of its run in the order of recording, shape (N,).
    test_fraction : wanted share of the samples.
    seed : the recipe's ``split.seed``.
    kept : 1 for groups that test, 0 for those that train, `UNDECIDED` for the others, shape (G,).

    Returns
    -------
    Whether each group tests, shape (G,).
    """
    count = len(groups.names)
    kept = np.full(count, UNDECIDED) if kept is None else kept
    tests: Mask = kept == 1
    order = sort_by_rank(groups.names, seed=seed, purpose="test")
    for sizes in _iterate_sizes(groups, arrival):
        free = order[(kept[order] == UNDECIDED) & (sizes[order] > 0)]
        _take(tests, free, sizes, wanted=test_fraction * float(sizes.sum()))
    return tests


def _take(tests: Mask, free: Ints, sizes: Ints, *, wanted: float) -> None:
    """Let groups in ``free``, which are by rank, join ``tests`` while that brings their share nearer."""
    seen = sizes > 0
    taken, left = int(sizes[tests].sum()), int((seen & ~tests).sum())
    for group in free[~tests[free]].tolist():
        if left > 1 and abs(taken + sizes[group] - wanted) < abs(taken - wanted):
            tests[group] = True
            taken, left = taken + int(sizes[group]), left - 1
    if wanted > 0 and not tests[seen].any() and seen.sum() > 1 and len(free):
        tests[free[np.argmin(np.abs(sizes[free] - wanted))]] = True


def draw_folds(groups: Groups, arrival: Ints, *, folds: int, seed: int, kept: Ints | None = None) -> Ints:
    """Deal groups to folds of cross-validation, each to the smallest fold when it first appears; a fold once given stays.

    Parameters
    ----------
    groups, arrival, seed : as `draw_groups`.
    folds : how many.
    kept : fold of groups that have one, `UNDECIDED` for the others, shape (G,).

    Returns
    -------
    Fold of each group from 0 on, shape (G,).
    """
    fold = np.full(len(groups.names), UNDECIDED) if kept is None else kept.copy()
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
    used, member = np.unique(run, return_inverse=True)
    return Groups(member.astype(np.int64).reshape(len(run)), tuple(names[number] for number in used.tolist()))
