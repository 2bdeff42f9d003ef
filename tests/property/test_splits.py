"""Splits under random footprints and regions: a partition, honest to the buffer, unmoved by growth."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from splits_squares import squares

from tcpipe.splits.assignment import Groups, assign_splits, draw_groups, hash_ranks
from tcpipe.splits.audit import Footprints, audit_leakage, compute_nearest_m, compute_shared_fraction, find_near_pairs
from tcpipe.splits.regions import Regions, Side, classify_footprints


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
    for corner, side in zip(corners, classify_footprints(corners, areas, buffer_m=buffer_m), strict=True):
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


@st.composite
def drives(draw):
    """Footprints of some runs that wind over a field, the numbers of the runs, and where a further one comes in time."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lengths = draw(st.lists(st.integers(1, 250), min_size=2, max_size=8))
    side_m, parts = draw(st.sampled_from([30.0, 120.0])), []
    for length in lengths:
        course = np.cumsum(rng.normal(0.0, 0.2, length))
        way = rng.uniform(0, side_m, 2) + np.cumsum(np.column_stack([np.cos(course), np.sin(course)]), axis=0)
        parts.append(squares(np.abs((way + side_m) % (2 * side_m) - side_m), course))
    return np.concatenate(parts), np.repeat(np.arange(len(lengths)), lengths)


def split_of(corners, run, names, *, holdout, fraction=0.2):
    _, number = np.unique(run, return_inverse=True)
    ids = [f"{names[r]}-{i}" for r in np.unique(run) for i in range((run == r).sum())]
    return assign_splits(
        hash_ranks(ids, seed=0, purpose="test"),
        number,
        [names[r] for r in np.unique(run)],
        corners,
        None,
        holdout=holdout,
        test_fraction=fraction,
        block_m=10.0,
        buffer_m=1.5,
        folds=3,
        seed=0,
    )


@settings(max_examples=60, deadline=None)
@given(drives(), st.sampled_from(["sample", "block", "run"]), st.sampled_from([0.1, 0.2, 0.5]))
def test_a_run_that_is_recorded_later_takes_nothing_out_of_test(driven, holdout, fraction):
    corners, run = driven
    names = [f"r{i}" for i in range(run.max() + 1)]
    old = run < run.max()
    before = split_of(corners[old], run[old], names, holdout=holdout, fraction=fraction)
    after = split_of(corners, run, names, holdout=holdout, fraction=fraction)
    assert not ((before.split == "test") & (after.split[old] == "train")).any()
    assert holdout == "sample" or (before.fold == after.fold[old]).all()


@settings(max_examples=60, deadline=None)
@given(drives(), st.integers(0, 7))
def test_a_run_that_comes_in_between_moves_a_sample_a_run_at_most(driven, where):
    corners, run = driven
    names = [f"r{i}" for i in range(run.max() + 1)]
    old = run != where % (run.max() + 1)
    before = split_of(corners[old], run[old], names, holdout="sample").split
    after = split_of(corners, run, names, holdout="sample").split
    assert (after == "test").sum() == -(-len(run) // 5)
    for number in np.unique(run[old]):
        here = run[old] == number
        moved = (before == "test")[here] & (after[old] == "train")[here]
        assert moved.sum() <= 1


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


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40), st.sampled_from([5.0, 40.0, 400.0]))
def test_distance_and_shared_ground_are_those_of_shapely(seed, n, m, extent_m):
    rng = np.random.default_rng(seed)
    ours, theirs = (
        squares(rng.uniform(0, extent_m, (count, 2)), rng.uniform(-np.pi, np.pi, count)) for count in (n, m)
    )
    a, b = shapely.polygons(ours)[:, None], shapely.polygons(theirs)[None]
    ground = Footprints(theirs, np.arange(m))
    np.testing.assert_allclose(compute_nearest_m(ours, ground), shapely.distance(a, b).min(axis=1), atol=1e-9)
    shared = np.zeros((n, m))
    i, j = find_near_pairs(ours.mean(axis=1), ground.tree, within_m=np.sqrt(2) + 1e-9)
    shared[i, j] = compute_shared_fraction(ours, theirs, i, j)
    np.testing.assert_allclose(shared, shapely.area(shapely.intersection(a, b)), atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(drives(), st.integers(0, 2**32 - 1))
def test_the_audit_is_that_of_plain_geometry_pair_by_pair(driven, seed):
    corners, run = driven[0][-300:], driven[1][-300:]
    rng = np.random.default_rng(seed)
    split = rng.choice(["train", "test", "unseen", "buffer"], len(run), p=[0.5, 0.2, 0.2, 0.1])
    polygons, start_ns = shapely.polygons(corners), np.arange(len(run))
    train = np.flatnonzero(split == "train")
    held = {name: split == name for name in ("test", "unseen")}
    for part in audit_leakage(split == "train", held, run, start_ns, corners, chord_m=1.0):
        held = np.flatnonzero(split == part.split)
        shared = shapely.area(shapely.intersection(polygons[held][:, None], polygons[train][None])) > 1e-3
        apart_m = shapely.distance(polygons[held][:, None], polygons[train][None])
        follow = [
            {split[i], split[i + 1]} == {part.split, "train"}
            for i in range(len(run) - 1)
            if run[i] == run[i + 1] and np.linalg.norm(corners[i].mean(0) - corners[i + 1].mean(0)) <= 1.5
        ]
        assert part.samples == len(held)
        assert part.overlapping_pairs == shared.sum()
        assert part.overlapping_samples == shared.any(axis=1).sum()
        assert part.repeated_place_samples == (shared & (run[held][:, None] != run[train])).any(axis=1).sum()
        assert part.same_track_pairs == sum(follow)
        if apart_m.size:
            assert part.nearest_train_min_m == pytest.approx(apart_m.min(), abs=1e-9)
            assert part.nearest_train_median_m == pytest.approx(np.median(apart_m.min(axis=1)), abs=1e-9)
        else:
            assert part.nearest_train_min_m is None
