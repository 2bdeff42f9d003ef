"""Signals between samples, by hand."""

import numpy as np
import pytest

from tcpipe.fusion.signals import (
    compute_median_period_ns,
    compute_seconds,
    compute_slopes,
    estimate_white_noise,
    hold_last,
    integrate_signal,
    is_in_gap,
    remove_spikes,
)


def test_intervals_that_touch_a_gap():
    stamp = np.array([0, 10, 20, 100, 110], np.int64)
    start = np.array([0, 12, 15, 25, 100, -4, -6, 109, 109, 20], np.int64)
    end = np.array([20, 15, 30, 30, 110, 0, 0, 114, 116, 20], np.int64)
    wanted = [False, False, True, True, False, False, True, False, True, False]
    assert is_in_gap(stamp, start, end, longest_ns=10).tolist() == wanted
    assert is_in_gap(np.empty(0, np.int64), start, end, longest_ns=10).all()


def test_last_value_is_held_and_unknown_before_the_first():
    found = hold_last(np.array([10, 20], np.int64), np.array([1.0, 2.0]), np.array([5, 10, 19, 20, 99], np.int64))
    assert np.isnan(found[0])
    assert found[1:].tolist() == [1.0, 1.0, 2.0, 2.0]
    assert np.isnan(hold_last(np.empty(0, np.int64), np.empty(0), np.array([5], np.int64))).all()


@pytest.mark.parametrize(("period_s", "longest_s"), [(0.05, 1.0), (0.5, 1.5), (5.0, 15.0)])
def test_a_value_is_unknown_after_a_second_or_three_periods(period_s, longest_s):
    stamp_ns = 10**18 + np.arange(20) * round(period_s * 1e9)
    held = hold_last(stamp_ns, np.ones(20), stamp_ns[-1] + np.array([0, longest_s - 0.01, longest_s + 0.01]) * 1e9)
    assert np.isfinite(held).tolist() == [True, True, False]


def test_a_single_value_is_held_for_a_second():
    held = hold_last(np.array([0], np.int64), np.ones(1), np.array([0, 10**9, 10**9 + 1], np.int64))
    assert np.isfinite(held).tolist() == [True, True, False]


def test_seconds_keep_nanoseconds_of_large_stamps():
    zero = 1_700_000_000_000_000_000
    assert compute_seconds(np.array([zero + 1], np.int64), zero)[0] == 1e-9
    assert compute_median_period_ns(np.array([zero, zero + 10, zero + 20, zero + 90], np.int64)) == 10
    assert compute_median_period_ns(np.array([zero], np.int64)) == 1


def test_slopes_of_a_line_are_its_own_whatever_its_stamps():
    stamp_ns = np.sort(np.random.default_rng(0).integers(0, 10**10, 200)) + 10**18
    values = 3.0 - 0.7 * (stamp_ns - 10**18) * 1e-9
    assert compute_slopes(stamp_ns, values, 0.6) == pytest.approx(np.full(200, -0.7), abs=1e-5)
    assert compute_slopes(stamp_ns[:1], values[:1], 0.6).tolist() == [0.0]


def test_white_noise_is_told_from_motion():
    t = np.arange(4000) / 200
    noise = 0.05 * np.random.default_rng(1).normal(size=(4000, 3))
    assert estimate_white_noise(noise + np.sin(t)[:, None]) == pytest.approx(0.05, rel=0.05)
    assert estimate_white_noise(noise[:2]) == 0.0


def test_the_integral_of_a_ramp_is_exact_at_any_stamp():
    stamp_s = np.array([0.0, 0.1, 0.5, 0.6, 2.0])
    at_s = np.array([0.0, 0.05, 0.5, 0.55, 1.7, 2.0])
    found = integrate_signal(stamp_s, np.column_stack((1.0 + 2.0 * stamp_s, -stamp_s)), at_s)
    assert found == pytest.approx(np.column_stack((at_s + at_s**2, -0.5 * at_s**2)), abs=1e-12)
    assert integrate_signal(stamp_s, stamp_s[:, None], np.array([-1.0, 3.0])) == pytest.approx(np.array([[0.0], [4.0]]))


def test_a_spike_on_a_ramp_is_bridged_and_its_neighbours_are_kept():
    ramp = 0.3 * np.arange(50.0) + 0.01 * np.random.default_rng(2).normal(size=50)
    spoiled = ramp.copy()
    spoiled[20] -= 7.0
    found = remove_spikes(spoiled)
    assert np.delete(found, 20).tolist() == np.delete(ramp, 20).tolist()
    assert found[20] == pytest.approx(6.0, abs=0.05)
    assert np.isnan(remove_spikes(spoiled, fill=np.nan)[20])
