"""The split and the fold of every sample, from its footprint, its run and its id."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.splits.holdouts import (
    UNDECIDED,
    Holdout,
    assign_blocks,
    draw_folds,
    draw_groups,
    draw_samples,
    group_by_run,
)
from tcpipe.splits.regions import Regions, Side, classify_footprints

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Names = NDArray[np.str_]

SPLITS = ("train", "test", "unseen", "buffer")
"""Values of the column ``split``."""

EXCLUDED = "excluded"
"""Assigned to samples of an exclude region; they do not enter the dataset."""

NO_FOLD = UNDECIDED
"""Fold of a sample that is neither train nor test."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """Split of every sample, one of `SPLITS` or `EXCLUDED`, (N,), and its fold or `NO_FOLD`, (N,)."""

    split: Names
    fold: Ints


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
    kept: Assignment | None = None,
    tagged: tuple[Ints, Sequence[str]] | None = None,
) -> Assignment:
    """Return train, test, unseen, buffer or excluded for every sample, and the fold of those that train or test.

    Parameters
    ----------
    ranks : rank of each sample's id for the draw of test, shape (N,).
    run, run_names : number of each sample's run in the order of recording, shape (N,), and the runs' ids by number.
    corners_xy_m : corners of the patch footprints in the map's metric plane [m], shape (N, 4, 2).
    regions : in the same plane; without regions every sample is inside.
    holdout : ``sample`` draws ceil(test_fraction · n) samples, of each run those of lowest rank; the others keep groups whole.
    test_fraction : share of test among the inside samples, after every drop and buffer.
    block_m : side of a spatial block [m].
    buffer_m : a footprint nearer than this to a region's border is in no split [m].
    folds : number of folds; blocks (runs, tags, with the holdout ``run``, ``tag``) stay whole in them.
    seed : seed of the ranks.
    kept : what an earlier dataset decided, "" and `NO_FOLD` where it knew nothing: none of its samples moves, but for those that a region
        excludes now.
    tagged : with the holdout ``tag``: number of each sample's value of the tag, shape (N,), and the values by number.
    """
    n = len(ranks)
    sides = np.zeros(n, np.uint8) if regions is None else classify_footprints(corners_xy_m, regions, buffer_m=buffer_m)
    split = np.array(["train", "unseen", "buffer", EXCLUDED], dtype=np.str_)[sides]
    old = np.full(n, "", np.str_) if kept is None else np.where(sides == Side.EXCLUDED, "", kept.split)
    split[old != ""] = old[old != ""]
    inside = np.flatnonzero(np.isin(split, ("train", "test")))
    known = np.select([old[inside] == "test", old[inside] == "train"], [1, 0], UNDECIDED)
    whole = {"run": (run, run_names), "tag": tagged}.get(holdout)
    groups = (
        assign_blocks(corners_xy_m[inside].mean(axis=1), block_m=block_m)
        if whole is None
        else group_by_run(whole[0][inside], whole[1])
    )
    if holdout == "sample":
        test = draw_samples(ranks[inside], run[inside], test_fraction=test_fraction, kept=known)
    else:
        chosen = draw_groups(groups, run[inside], test_fraction=test_fraction, seed=seed, kept=groups.decided(known))
        test = np.where(known == UNDECIDED, chosen[groups.member], known == 1)
    split[inside] = np.where(test, "test", "train")
    fold = np.full(n, NO_FOLD)
    old_fold = np.full(len(inside), NO_FOLD) if kept is None else kept.fold[inside]
    dealt = draw_folds(groups, run[inside], folds=folds, seed=seed, kept=groups.decided(old_fold))
    fold[inside] = np.where(old_fold == NO_FOLD, dealt[groups.member], old_fold)
    return Assignment(split, fold)
