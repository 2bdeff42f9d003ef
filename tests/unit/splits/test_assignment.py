"""Who trains and who tests, on rows of footprints short enough to decide by hand."""

import hashlib

import numpy as np
import pytest
import shapely
from splits_squares import squares

from tcpipe.splits.assignment import (
    NO_FOLD,
    Groups,
    assign_blocks,
    assign_splits,
    draw_folds,
    draw_groups,
    draw_samples,
    group_by_run,
    hash_ranks,
)
from tcpipe.splits.regions import Regions

ROW = squares([(10.0 * i + 5.0, 5.0) for i in range(10)])
"""Each in a block of its own."""


def assigned(corners=ROW, *, run=None, regions=None, holdout="sample", fraction=0.2, ranks=None, block_m=10.0):
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
    )


def test_the_lowest_ranks_test_and_all_inside_have_a_fold():
    found = assigned(ranks=np.arange(10)[::-1])
    assert found.split.tolist() == ["train"] * 8 + ["test"] * 2
    assert sorted(found.fold.tolist()) == [0] * 5 + [1] * 5


def test_each_region_has_its_word_and_no_fold_outside_of_train_and_test():
    regions = Regions(shapely.box(0, 0, 60, 10), unseen=shapely.box(70, 0, 100, 10), exclude=shapely.box(40, 0, 50, 10))
    found = assigned(regions=regions, corners=squares([(5, 5), (15, 5), (25, 5), (45, 5), (60, 5), (85, 5), (65, 5)]))
    assert found.split.tolist() == ["test", "train", "train", "excluded", "buffer", "unseen", "unseen"]
    assert ((found.fold != NO_FOLD) == [True, True, True, False, False, False, False]).all()


def test_whole_runs_or_whole_blocks_test():
    run = np.repeat([0, 1, 2, 3, 4], 2)
    by_run = assigned(run=run, holdout="run")
    assert sorted(np.bincount(run, by_run.split == "test").tolist()) == [0, 0, 0, 0, 2]
    assert (by_run.fold[::2] == by_run.fold[1::2]).all()
    by_block = assigned(run=run, holdout="block", block_m=50.0)
    assert sorted(np.bincount([0] * 5 + [1] * 5, by_block.split == "test").tolist()) == [0, 5]


def test_runs_are_drawn_by_their_names():
    run = np.arange(10)
    groups, others = (group_by_run(run, [f"{before}{number}" for number in run]) for before in ("r", ""))
    test, otherwise = (draw_groups(each, run, test_fraction=0.2, seed=0)[each.member] for each in (groups, others))
    assert (assigned(run=run, holdout="run").split == "test").tolist() == test.tolist()
    assert otherwise.tolist() != test.tolist()


IDS = [f"run-{i:05d}" for i in range(1000)]


def test_a_rank_is_the_hash_of_seed_and_name_and_nothing_else():
    expected = hashlib.blake2b(b"7:run-00003", digest_size=8, person=b"test").digest()
    assert int(hash_ranks(IDS, seed=7, purpose="test")[3]) == int.from_bytes(expected, "big")


def ranks(names, seed=0):
    return hash_ranks(names, seed=seed, purpose="test")


@pytest.mark.parametrize(("n", "tests"), [(6428, 1286), (5, 1), (6, 2), (35, 7), (1, 1), (0, 0)])
def test_test_is_the_ceiling_of_its_share(n, tests):  # 6428 is the paper's area A, 1286 its test set
    for arrival in (np.zeros(n, int), np.arange(n) // 37, np.arange(n)[::-1] // 400):
        assert draw_samples(ranks([str(i) for i in range(n)]), arrival, test_fraction=0.2).sum() == tests


def test_row_order_says_nothing_of_the_holdout():
    order = np.argsort(hash_ranks(IDS, seed=0, purpose="order"))
    test = draw_samples(ranks(IDS), np.zeros(1000, int), test_fraction=0.5)[order]
    first = test[:500].sum()
    assert 190 < first < 310  # 250 ± 4 sigma; equal salts would give 0 or 500
    assert sorted(order.tolist()) == list(range(1000))


def grouped(sizes):
    """Groups of so many samples each."""
    return Groups(np.repeat(np.arange(len(sizes)), sizes), tuple(f"g{i}" for i in range(len(sizes))))


def drawn(groups, arrival=None, **keywords):
    """Whether each sample tests."""
    arrival = np.zeros(len(groups.member), int) if arrival is None else arrival
    return draw_groups(groups, arrival, **{"test_fraction": 0.2, "seed": 0, **keywords})[groups.member]


def blocks(centres):
    return assign_blocks(np.repeat(centres[:, None], 4, axis=1), np.arange(len(centres)), block_m=10.0)


def test_blocks_that_are_far_apart_are_told_apart():
    cells = [(0, 1), (1, 0), (32, 0), (-32, 2), (2**20, -(2**20)), (-(2**20), 2**20)]
    found = blocks(10.0 * np.array(cells) + 5.0)
    assert [found.names[member] for member in found.member] == [f"10:{column}:{row}" for column, row in cells]


def test_a_cell_begins_at_its_border_and_holds_one_group_in_every_direction():
    found = blocks(np.array([[10.0, 0.0], [9.999, 0.0], [-10.0, -0.001], [-0.001, -10.0]]))
    assert [found.names[member] for member in found.member] == ["10:1:0", "10:0:0", "10:-1:-1", "10:-1:-1"]
    assert blocks(np.zeros((0, 2))).names == ()


def test_at_least_one_tests_the_nearest_in_size_and_one_trains():
    for seed in range(4):
        assert drawn(grouped([60, 50, 90]), test_fraction=0.01, seed=seed).sum() == 50
        assert drawn(grouped([1, 1, 1]), test_fraction=0.1, seed=seed).sum() == 1
        assert drawn(grouped([10, 10, 10]), test_fraction=0.99, seed=seed).sum() == 20
        assert drawn(grouped([50, 40]), seed=seed).sum() == 40
    assert not drawn(grouped([5] * 10), test_fraction=0.0).any()
    assert not drawn(grouped([9])).any()


def test_a_run_counts_once_it_came():
    arrival = np.repeat([0, 1], [30, 30])
    test = drawn(grouped([15, 15, 15, 15]), arrival, test_fraction=0.5)
    assert (test[:30].sum(), test[30:].sum()) == (15, 15)


def test_folds_are_dealt_from_the_largest_on():
    groups = grouped([1, 3, 5, 3])
    fold = draw_folds(groups, np.zeros(12, int), folds=2, seed=0)
    assert np.bincount(fold, weights=[1, 3, 5, 3]).tolist() == [6, 6]
    assert (fold[2], fold[1], fold[3], fold[0]) == (0, 1, 1, 0)


def test_runs_are_groups_by_their_names():
    found = group_by_run(np.array([3, 1, 3]), ["a", "b", "c", "d"])
    assert [found.names[member] for member in found.member] == ["d", "b", "d"]
