"""Lags of made signals: sub-sample, through other scales and axes, with an error that is what repeated trials show."""

import itertools

import numpy as np
import pytest

from tcpipe.fusion.checks.motions import (
    GRID_NS,
    GRID_S,
    average,
    find_lag,
    find_liveliest_window_ns,
    iterate_windows_ns,
    make_grid_ns,
    resample_signal,
)
from tcpipe.fusion.measurements import BodyVelocities, Measurements

S = 1_000_000_000
AT = make_grid_ns(0, 120 * S)
SECONDS = AT * 1e-9


def speed(t):
    """Starts and stops every 12 s, with ramps of a second."""
    phase = np.mod(t, 12.0)
    return np.clip(np.minimum(phase - 2.0, 10.5 - phase), 0.0, 1.0) * (0.9 + 0.05 * np.sin(t))


@pytest.mark.parametrize("late_s", [-0.7132, -0.021, 0.0, 0.0067, 0.25, 1.1])
def test_a_smooth_signal_gives_its_shift_to_a_millisecond(late_s):
    late, regressor = (average(speed(SECONDS - shift), 0.2) for shift in (late_s, 0.0))
    found = find_lag(3.0 * late - 1.0, regressor)
    assert found.offset_s == pytest.approx(late_s, abs=1e-3)
    assert found.explained == pytest.approx(1.0, abs=2e-4)
    assert found.factor == pytest.approx(3.0, abs=0.01)


def test_a_vector_is_found_turned_and_scaled():
    rng = np.random.default_rng(3)
    walk = np.cumsum(rng.standard_normal((AT.size + 40, 2)), axis=0) * 0.05 @ [1.0, 1j]
    vector, factor = average(walk, 0.1), 2.0 * np.exp(2.5j)
    target, regressor = factor * vector[: AT.size], vector[27 : 27 + AT.size]
    found = find_lag(target, regressor)  # the target is at row 27 where the regressor was at row 0
    assert found.offset_s == pytest.approx(27 * GRID_S, abs=1e-3)
    assert found.factor == pytest.approx(factor, rel=1e-3)
    assert found.explained == pytest.approx(1.0, abs=2e-3)


def test_the_standard_deviation_is_that_of_repeated_trials():
    rng = np.random.default_rng(5)
    target, regressor = (average(speed(SECONDS - shift), 0.2) for shift in (0.1, 0.0))
    noise = [average(rng.normal(0.0, 0.5, AT.size), 0.2) for _ in range(60)]
    found = [find_lag(target + each, regressor) for each in noise]
    errors = np.array([each.offset_s - 0.1 for each in found])
    assert abs(errors.mean()) < 0.4 * errors.std()
    assert np.median([each.std_s for each in found]) == pytest.approx(errors.std(), rel=0.35)


def test_nothing_is_said_of_too_little():
    flat, noise = np.ones(AT.size), np.random.default_rng(1).standard_normal(AT.size)
    moving = average(speed(SECONDS), 0.2)
    assert find_lag(flat, moving) is None
    assert find_lag(np.full(AT.size, np.nan), moving) is None
    assert find_lag(moving[:400], moving[:400]) is None
    unrelated = find_lag(average(noise, 0.2), moving)
    assert unrelated is None or unrelated.explained < 0.1


def test_cells_are_means_and_gaps_are_unknown():
    stamp = np.array([0, 1, 2, 3, 9, 10]) * S
    cells = resample_signal(stamp, (stamp * 1e-9)[:, None] * 2.0, AT[: 11 * 50])[:, 0]
    known = np.isfinite(cells)
    inside = (AT[: 11 * 50] + GRID_NS // 2 <= 3 * S) | (AT[: 11 * 50] - GRID_NS // 2 >= 9 * S)
    np.testing.assert_array_equal(known[50:500], inside[50:500])
    np.testing.assert_allclose(cells[50:140], AT[50:140] * 2e-9, atol=1e-9)


def test_a_running_mean_knows_nothing_beside_a_hole():
    values = np.arange(20.0)
    values[10] = np.nan
    mean = average(values, 4 * GRID_S)
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(mean)), [2, 3, 4, 5, 6, 7, 13, 14, 15, 16, 17])
    np.testing.assert_allclose(mean[[2, 7, 17]], [2.0, 7.0, 17.0])


def test_a_motion_that_repeats_itself_and_one_event_give_no_lag():
    slalom = average(np.sin(2 * np.pi * SECONDS / 0.8), 0.1)  # three periods lie in the search
    assert find_lag(slalom, slalom) is None
    once = average(np.clip(SECONDS - 60.0, 0.0, 1.0), 0.2)
    masked = np.where(np.abs(SECONDS - 60.5) < 3.0, once, np.nan)
    assert find_lag(masked, once) is None


def test_a_flat_peak_tells_little_however_alike_its_parts_are():
    rng = np.random.default_rng(2)
    slow = average(np.sin(2 * np.pi * SECONDS / 10.0), 0.2)
    noisy = slow + average(rng.normal(0.0, 2.0, AT.size), 0.2)
    found, clear = find_lag(noisy, slow), find_lag(slow + 1e-3 * noisy, slow)
    assert found is None or found.std_s > 0.05
    assert clear.std_s < 1e-2


def test_an_hour_of_standing_is_not_what_is_judged():
    stamp_ns = np.arange(0, 3 * 3600, dtype=np.int64) * 1_000_000_000
    speed = np.where(stamp_ns > 2.2 * 3600e9, 1.0, 0.0)
    nothing = np.full(speed.size, np.nan)
    wheels = BodyVelocities(stamp_ns, np.column_stack((speed, nothing, nothing)), np.ones((speed.size, 3)), nothing)
    at_ns = find_liveliest_window_ns(Measurements(wheels=wheels))
    assert at_ns[0] >= 2.1 * 3600e9
    assert (at_ns[-1] - at_ns[0]) * 1e-9 == pytest.approx(1800.0, abs=1.0)


def wheels_at(at_s):
    nothing = np.full(at_s.size, np.nan)
    velocity = np.column_stack((np.ones(at_s.size), nothing, nothing))
    return BodyVelocities(np.int64(at_s) * 10**9, velocity, np.ones((at_s.size, 3)), nothing)


def test_where_nothing_was_measured_for_years_there_are_no_windows():
    years = np.concatenate((np.arange(600), 10**9 + np.arange(600)))
    assert len(list(iterate_windows_ns(Measurements(wheels=wheels_at(years)), 600 * 10**9))) == 4


def test_windows_cover_all_of_the_time_once():
    found = list(iterate_windows_ns(Measurements(wheels=wheels_at(np.arange(2501))), 600 * 10**9))
    assert len(found) == 4
    assert found[0][0] == 0
    assert all(abs(b[0] - a[-1]) <= GRID_NS for a, b in itertools.pairwise(found))
    assert 2500 * 10**9 - found[-1][-1] < GRID_NS
