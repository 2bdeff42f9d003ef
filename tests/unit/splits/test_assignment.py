"""Who trains and who tests, on rows of footprints short enough to decide by hand."""

import numpy as np
import pytest
import shapely
from splits_squares import squares

from tcpipe.splits.assignment import NO_FOLD, Assignment, assign_splits, draw_groups, group_by_run
from tcpipe.splits.regions import Regions

ROW = squares([(10.0 * i + 5.0, 5.0) for i in range(10)])
"""Each in a block of its own."""


def assigned(
    corners=ROW, *, run=None, regions=None, holdout="sample", kept=None, fraction=0.2, ranks=None, block_m=10.0
):
    run = np.zeros(len(corners), int) if run is None else np.array(run)
    return assign_splits(
        np.arange(len(corners)).astype(np.uint64) if ranks is None else np.array(ranks, np.uint64),
        run,
        [f"r{number}" for number in range(run.max() + 1)],
        corners,
        regions,
        holdout=holdout,
        test_fraction=fraction,
        block_m=block_m,
        buffer_m=1.0,
        folds=2,
        seed=0,
        kept=kept,
    )


def kept(splits, folds=None):
    names = {"t": "train", "T": "test", ".": "", "u": "unseen"}
    folds = [NO_FOLD] * len(splits) if folds is None else folds
    return Assignment(np.array([names[letter] for letter in splits]), np.array(folds))


def test_the_lowest_ranks_test_and_all_inside_have_a_fold():
    found = assigned(ranks=np.arange(10)[::-1])
    assert found.split.tolist() == ["train"] * 8 + ["test"] * 2
    assert sorted(found.fold.tolist()) == [0] * 5 + [1] * 5


def test_each_region_has_its_word_and_no_fold_outside_of_train_and_test():
    regions = Regions(shapely.box(0, 0, 60, 10), unseen=shapely.box(70, 0, 100, 10), exclude=shapely.box(40, 0, 50, 10))
    found = assigned(regions=regions, corners=squares([(5, 5), (15, 5), (25, 5), (45, 5), (60, 5), (85, 5), (65, 5)]))
    assert found.split.tolist() == ["test", "train", "train", "excluded", "buffer", "unseen", "unseen"]
    assert ((found.fold != NO_FOLD) == [True, True, True, False, False, False, False]).all()


def test_what_was_decided_stays_but_for_what_a_region_excludes_now():
    regions = Regions(shapely.box(0, 0, 100, 10), exclude=shapely.box(90, 0, 100, 10))
    before = kept("tT.......T", [1, 0, *[NO_FOLD] * 7, 0])
    found = assigned(regions=regions, kept=before)
    assert found.split[[0, 1, 9]].tolist() == ["train", "test", "excluded"]
    assert found.fold[[0, 1, 9]].tolist() == [1, 0, NO_FOLD]
    assert (found.split == "test").sum() == 2  # a fifth of nine


@pytest.mark.parametrize("holdout", ["sample", "block", "run"])
def test_a_sample_that_was_unseen_stays_unseen(holdout):
    found = assigned(kept=kept("u........."), holdout=holdout, run=np.arange(10))
    assert (found.split[0], found.fold[0]) == ("unseen", NO_FOLD)
    assert set(found.split[1:]) == {"train", "test"}


def test_whole_runs_or_whole_blocks_test():
    run = np.repeat([0, 1, 2, 3, 4], 2)
    by_run = assigned(run=run, holdout="run")
    assert sorted(np.bincount(run, by_run.split == "test").tolist()) == [0, 0, 0, 0, 2]
    assert (by_run.fold[::2] == by_run.fold[1::2]).all()
    by_block = assigned(run=run, holdout="block", block_m=50.0)
    assert sorted(np.bincount([0] * 5 + [1] * 5, by_block.split == "test").tolist()) == [0, 5]


def test_a_sample_of_a_group_that_tests_keeps_what_it_was():
    run = np.repeat([0, 1], 5)
    found = assigned(run=run, holdout="run", kept=kept("TTTt.ttttt"))
    assert found.split.tolist() == ["test"] * 3 + ["train", "test"] + ["train"] * 5


def test_runs_are_drawn_by_their_names():
    run = np.arange(10)
    groups, others = (group_by_run(run, [f"{before}{number}" for number in run]) for before in ("r", ""))
    test, otherwise = (draw_groups(each, run, test_fraction=0.2, seed=0)[each.member] for each in (groups, others))
    assert (assigned(run=run, holdout="run").split == "test").tolist() == test.tolist()
    assert otherwise.tolist() != test.tolist()
