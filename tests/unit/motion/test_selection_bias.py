"""Shares of removed metres by group, and which of them stand out, by hand."""

import numpy as np
import pytest

from tcpipe.motion.distance_breakdown import Group, find_main_reason, find_uneven_groups, list_groups, sum_lengths_m

REASONS = ("in_samples", "gap", "stuck")


def test_metres_are_summed_by_group_and_reason():
    group, reason = np.array([0, 0, 2, 2, 2]), np.array([0, 1, 0, 2, 2])
    tally = sum_lengths_m(group, reason, np.array([1.0, 2.0, 3.0, 4.0, 5.0]), shape=(3, 3))
    np.testing.assert_array_equal(tally, [[1, 2, 0], [0, 0, 0], [3, 0, 9]])
    first, last = list_groups(tally, ("grass", "mud", "paved"), REASONS)
    assert first == Group("grass", 3.0, 1.0, {"gap": 2.0}, 1.0 / 3.0)
    assert last == Group("paved", 12.0, 3.0, {"stuck": 9.0}, 0.25)
    assert find_main_reason(first) == "gap"
    assert find_main_reason(Group("mud", 1.0, 1.0, {}, 1.0)) == ""


def test_nothing_driven_gives_no_group():
    nothing = np.zeros(0, np.int64)
    assert list_groups(sum_lengths_m(nothing, nothing, np.zeros(0), shape=(2, 3)), ("a", "b"), REASONS) == ()


def groups(**used_of_driven):
    return [
        Group(name, driven, used, {"gap": driven - used}, used / driven)
        for name, (used, driven) in used_of_driven.items()
    ]


@pytest.mark.parametrize(
    ("mud", "odd"),
    [
        ((30.0, 100.0), ["grass", "mud"]),  # 0.30 against 0.80, where 2.5 standard deviations are 0.29
        ((68.0, 100.0), []),  # 0.68 against 0.80: nearer than 0.15
        ((6.0, 15.0), []),  # too short
        ((12.0, 25.0), []),  # 0.48 against 0.80, but of five stretches
    ],
)
def test_a_share_stands_out_when_it_is_far_off_and_surely_so(mud, odd):
    found = find_uneven_groups(groups(grass=(320.0, 400.0), mud=mud))
    assert [group.name for group in found] == odd


def test_one_group_alone_has_nothing_to_differ_from():
    assert find_uneven_groups(groups(grass=(10.0, 400.0))) == []


@pytest.mark.parametrize(
    ("mud", "odd"),
    [
        ((0.0, 20.0), ["grass", "mud"]),  # as short as may be spoken of
        ((0.0, 19.5), []),
        ((45.0, 100.0), ["grass", "mud"]),  # 0.35 off, 3.2 standard deviations
        ((51.0, 100.0), ["grass", "mud"]),  # 0.29 off, where 2.5 are 0.273
        ((54.0, 100.0), []),  # 0.26 off, where 2.5 are 0.271
    ],
)
def test_the_edges_of_what_stands_out(mud, odd):
    assert [group.name for group in find_uneven_groups(groups(grass=(320.0, 400.0), mud=mud))] == odd


def test_a_sure_but_small_difference_is_none():
    assert find_uneven_groups(groups(grass=(32_000.0, 40_000.0), mud=(7_000.0, 10_000.0))) == []


def test_half_a_metre_is_a_group_with_a_reason_and_a_share_and_nothing_is_none():
    tally = sum_lengths_m(np.array([1, 1]), np.array([0, 2]), np.array([0.25, 0.25]), shape=(2, 3))
    np.testing.assert_array_equal(tally, [[0, 0, 0], [0.25, 0, 0.25]])
    (only,) = list_groups(tally, ("grass", "mud"), REASONS)
    assert only == Group("mud", 0.5, 0.25, {"stuck": 0.25}, 0.5)
