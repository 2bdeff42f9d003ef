"""Splits under random footprints and regions: a partition, honest to the buffer, unmoved by growth."""

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from splits_squares import squares

from tcpipe.splits.assignment import assign_splits
from tcpipe.splits.holdouts import Groups, draw_groups, draw_samples
from tcpipe.splits.neighbours import near_pairs, nearest_m, shared_fraction
from tcpipe.splits.ranking import hash_ranks
from tcpipe.splits.regions import Regions, Side, sides_of

coordinate = st.floats(-30, 30, allow_nan=False)


@st.composite
def regions(draw):
    """A star-shaped polygon with a hole, a second one, and perhaps an exclude and an unseen rectangle."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    angle = np.sort(rng.uniform(0, 2 * np.pi, 9))
    star = shapely.Polygon(np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(6, 25, (9, 1))).buffer(0)
    train = star.difference(shapely.Point(rng.uniform(-5, 5, 2)).buffer(rng.uniform(0.1, 4)))
    unseen = shapely.box(20, -25, 29, -12).difference(train)
    x, y = rng.uniform(-10, 10, 2)
    exclude = shapely.box(x, y, x + rng.uniform(0.2, 8), y + rng.uniform(0.2, 8))
    return Regions(train, unseen if rng.random() < 0.5 else shapely.MultiPolygon(), exclude)


@settings(max_examples=60, deadline=None)
@given(regions(), st.integers(0, 2**32 - 1), st.floats(0.05, 3.0))
def test_sides_agree_with_plain_geometry_one_footprint_at_a_time(areas, seed, buffer_m):
    rng = np.random.default_rng(seed)
    corners = squares(rng.uniform(-30, 30, (40, 2)), rng.uniform(-np.pi, np.pi, 40))
    usable = areas.train_test.difference(areas.exclude)
    other = areas.unseen.difference(areas.exclude)
    for corner, side in zip(corners, sides_of(corners, areas, buffer_m=buffer_m), strict=True):
        square = shapely.Polygon(corner)
        nearest = min(square.distance(area.boundary) for area in (usable, other, areas.exclude) if not area.is_empty)
        if abs(nearest - buffer_m) < 1e-9:
            continue
        if areas.exclude.covers(square):
            expected = Side.EXCLUDED
        elif nearest < buffer_m:
            expected = Side.BUFFER
        else:
            expected = Side.INSIDE if usable.covers(square) else Side.UNSEEN
        assert side == expected


@settings(max_examples=30, deadline=None)
@given(regions(), st.integers(0, 2**32 - 1), st.sampled_from(["sample", "block", "run"]), st.floats(0.0, 0.9))
def test_every_sample_has_one_split_and_train_keeps_its_distance(areas, seed, holdout, fraction):
    rng = np.random.default_rng(seed)
    corners = squares(rng.uniform(-30, 30, (80, 2)), rng.uniform(-np.pi, np.pi, 80))
    ranks = hash_ranks([f"s{i}" for i in range(80)], seed=seed, purpose="test")
    found = assign_splits(
        ranks,
        np.arange(80) % 5,
        [f"r{i}" for i in range(5)],
        corners,
        areas,
        holdout=holdout,
        test_fraction=fraction,
        block_m=10.0,
        buffer_m=1.5,
        folds=3,
        seed=seed,
    )
    split = found.split
    assert set(split) <= {"train", "test", "unseen", "buffer", "excluded"}
    inside, outside = np.isin(split, ("train", "test")), split == "unseen"
    assert ((found.fold >= 0) == inside).all()
    apart = shapely.distance(shapely.polygons(corners[inside])[:, None], shapely.polygons(corners[outside])[None])
    assert apart.size == 0 or apart.min() >= 3.0 - 1e-9  # a buffer on either side of every border


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 400), st.integers(0, 60), st.integers(0, 1000), st.sampled_from([0.1, 0.2, 0.5]))
def test_growth_moves_only_as_many_as_the_cut_has_moved(before, added, seed, fraction):
    old = [f"a-{i}" for i in range(before)]
    new = [f"b-{i}" for i in range(added)]
    ranks = hash_ranks([*old, *new], seed=seed, purpose="test")
    first = draw_samples(ranks[:before], test_fraction=fraction)
    then = draw_samples(ranks, test_fraction=fraction)[:before]
    left, joined = int((first & ~then).sum()), int((~first & then).sum())
    assert left == 0 or joined == 0  # one cut through one ranking moves one way
    assert left + joined <= added


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 30), min_size=2, max_size=60), st.integers(0, 1000), st.sampled_from([0.1, 0.2, 0.5]))
def test_groups_are_whole_and_no_untaken_group_would_bring_test_nearer(sizes, seed, fraction):
    member = np.repeat(np.arange(len(sizes)), sizes)
    whole = Groups(member, tuple(f"g{i}" for i in range(len(sizes))))
    test = draw_groups(whole, np.zeros(len(member), int), test_fraction=fraction, seed=seed)[member]
    groups = np.array(whole.names)[member]
    names = set(groups[test])
    assert names.isdisjoint(groups[~test])
    assert 0 < len(names) < len(sizes)
    wanted = fraction * len(groups)
    if test.sum() < wanted and len(names) < len(sizes) - 1:
        left = [size for i, size in enumerate(sizes) if f"g{i}" not in names]
        assert min(abs(test.sum() + size - wanted) for size in left) >= abs(test.sum() - wanted)


def test_a_new_run_leaves_the_old_test_set_almost_as_it_was():
    old = [f"old-{i}" for i in range(6428)]
    first = draw_samples(hash_ranks(old, seed=0, purpose="test"), test_fraction=0.2)
    moved = []
    for seed in range(10):
        ranks = hash_ranks([*old, *(f"new{seed}-{i}" for i in range(640))], seed=0, purpose="test")
        moved.append((first & ~draw_samples(ranks, test_fraction=0.2)[: len(old)]).sum() / first.sum())
    assert np.mean(moved) < 0.01


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40), st.sampled_from([5.0, 40.0, 400.0]))
def test_distance_and_shared_ground_are_those_of_shapely(seed, n, m, extent_m):
    rng = np.random.default_rng(seed)
    ours, theirs = (
        squares(rng.uniform(0, extent_m, (count, 2)), rng.uniform(-np.pi, np.pi, count)) for count in (n, m)
    )
    a, b = shapely.polygons(ours)[:, None], shapely.polygons(theirs)[None]
    np.testing.assert_allclose(nearest_m(ours, theirs), shapely.distance(a, b).min(axis=1), atol=1e-9)
    shared = np.zeros((n, m))
    for i, j in near_pairs(ours.mean(axis=1), theirs.mean(axis=1), within_m=np.sqrt(2) + 1e-9):
        shared[i, j] = shared_fraction(ours, theirs, i, j)
    np.testing.assert_allclose(shared, shapely.area(shapely.intersection(a, b)), atol=1e-9)
