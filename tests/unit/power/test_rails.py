"""Power at the track's stamps, by hand."""

import numpy as np
import pytest

from tcpipe.power.rails import compute_power_at, make_samples
from tcpipe.power.rails import make_rail as made_of

MS = 1_000_000


def rail(stamps_ms, volt, amp, current_ms=None, *, averaged=False):
    stamp = np.array(stamps_ms, np.int64) * MS
    current = stamp if current_ms is None else np.array(current_ms, np.int64) * MS
    signals = make_samples(stamp, np.array(volt, float)), make_samples(current, np.array(amp, float))
    return made_of("drive", *signals, averaged=averaged)


def test_rails_are_summed_and_interpolated():
    left = rail([0, 100, 200], [24, 26, 26], [1, 3, 3])
    right = rail([0, 200], [20, 20], [-2, -4], current_ms=[0, 200])
    at = np.array([-1, 0, 50, 200, 201], np.int64) * MS
    volt, amp, watt = compute_power_at([left, right], at, max_gap_ns=300 * MS)
    assert np.isnan(volt[[0, 4]]).all()
    assert volt[1:4] == pytest.approx([22, 22.5, 23])
    assert amp[1:4] == pytest.approx([-1, -0.5, -1])
    assert watt[1:4] == pytest.approx([24 - 40, 25 * 2 + 20 * -2.5, 26 * 3 - 80])


def test_an_averaged_source_has_the_value_of_the_message_that_ends_the_period():
    source = rail([0, 1000, 2000], [24, 25, 26], [1, 2, 3], averaged=True)
    at = np.array([0, 1, 999, 1000, 1001, 2000], np.int64) * MS
    _, amp, watt = compute_power_at([source], at, max_gap_ns=300 * MS)
    assert amp.tolist() == [1, 2, 2, 2, 3, 3]
    assert watt.tolist() == [24, 50, 50, 50, 78, 78]


def test_a_gap_is_longer_than_three_periods_and_than_the_recipe_says():
    stamps = [*range(0, 1000, 50), *range(1400, 2000, 50)]  # 450 ms without a sample
    source = rail(stamps, np.full(32, 24.0), np.ones(32))
    at = np.arange(0, 1901, 50, dtype=np.int64) * MS
    watt = compute_power_at([source], at, max_gap_ns=300 * MS)[2]
    assert np.flatnonzero(np.isnan(watt)).tolist() == list(range(20, 28))
    assert np.isfinite(compute_power_at([source], at, max_gap_ns=500 * MS)[2]).all()
    slow = rail(range(0, 10_000, 1000), np.full(10, 24.0), np.ones(10))
    assert np.isfinite(compute_power_at([slow], at, max_gap_ns=300 * MS)[2]).all()


def test_without_rails_nothing_is_known():
    found = compute_power_at([], np.array([0, 1], np.int64), max_gap_ns=1)
    assert all(np.isnan(values).all() and values.shape == (2,) for values in found)
    for averaged in (False, True):
        empty = rail([], [], [], averaged=averaged)
        assert np.isnan(compute_power_at([empty], np.array([0], np.int64), max_gap_ns=1)[2]).all()


def test_samples_are_sorted_and_finite_and_the_first_of_a_stamp_counts():
    got = make_samples(np.array([2, 1, 1, 3]), np.array([5.0, 1.0, 7.0, np.nan]))
    assert got.stamp_ns.tolist() == [1, 2]
    assert got.value.tolist() == [1.0, 5.0]
