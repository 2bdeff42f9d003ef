"""Signals between samples, by hand."""

import numpy as np

from tcpipe.fusion.signals import hold_last, in_gap, median_period_ns, seconds


def test_intervals_that_touch_a_gap():
    stamp = np.array([0, 10, 20, 100, 110], np.int64)
    start = np.array([0, 12, 15, 25, 100, -4, -6, 109, 109, 20], np.int64)
    end = np.array([20, 15, 30, 30, 110, 0, 0, 114, 116, 20], np.int64)
    wanted = [False, False, True, True, False, False, True, False, True, False]
    assert in_gap(stamp, start, end, longest_ns=10).tolist() == wanted
    assert in_gap(np.empty(0, np.int64), start, end, longest_ns=10).all()


def test_last_value_is_held_and_unknown_before_the_first():
    found = hold_last(np.array([10, 20], np.int64), np.array([1.0, 2.0]), np.array([5, 10, 19, 20, 99], np.int64))
    assert np.isnan(found[0])
    assert found[1:].tolist() == [1.0, 1.0, 2.0, 2.0]
    assert np.isnan(hold_last(np.empty(0, np.int64), np.empty(0), np.array([5], np.int64))).all()


def test_seconds_keep_nanoseconds_of_large_stamps():
    zero = 1_700_000_000_000_000_000
    assert seconds(np.array([zero + 1], np.int64), zero)[0] == 1e-9
    assert median_period_ns(np.array([zero, zero + 10, zero + 20, zero + 90], np.int64)) == 10
    assert median_period_ns(np.array([zero], np.int64)) == 1
