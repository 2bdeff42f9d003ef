"""The displacement error against error processes whose covariance is known."""

import numpy as np
import pytest

from tcpipe.motion.row_sections import MotionRows
from tcpipe.motion.uncertainty import (
    compute_along_std_m,
    compute_chord_ahead_std_m,
    compute_displacement_std_m,
    interpolate_durations_m,
)


def std(velocity_std, duration, start, end, *, smoothed, told=(np.nan, np.nan)):
    one = np.atleast_1d
    return compute_displacement_std_m(
        velocity_std_mps=one(velocity_std),
        duration_s=one(duration),
        start_std_m=one(start),
        end_std_m=one(end),
        smoothed=smoothed,
        lags_s=(1.0, 2.0),
        lag_std_m=np.array([told]),
    )[0]


def test_a_constant_velocity_error_adds_up():
    # Dead reckoning for 1.2 s with a constant error of 5 mm/s after 0.5 m of accumulated error.
    assert std(0.005, 1.2, 0.500, 0.506, smoothed=True) == pytest.approx(0.006, rel=1e-3)


@pytest.mark.parametrize("smoothed", [False, True])
def test_an_error_that_only_grows_is_no_jump(smoothed):
    assert std(0.005, 1.0, 2.0, 2.005, smoothed=smoothed) == pytest.approx(0.005, rel=1e-3)


@pytest.mark.parametrize("duration", [0.2, 1.0, 4.0])
def test_between_both_it_is_the_process_it_says(duration):
    # A random function with correlation 1 / (1 + t² / 2): its spectrum is exp(-sqrt(2) |w|), whose waves are drawn at random.
    rng = np.random.default_rng(0)
    waves = rng.exponential(1 / np.sqrt(2), (40, 20_000))
    phase = rng.uniform(0, 2 * np.pi, waves.shape)
    error = 0.01 * np.sqrt(2 / 40) * (np.cos(waves * duration + phase) - np.cos(phase)).sum(axis=0)
    assert std(0.01, duration, 0.01, 0.01, smoothed=True) == pytest.approx(error.std(), rel=0.03)


def test_a_fix_that_shrinks_the_error_moves_a_forward_filter():
    # Kalman update of a constant from variance P to P': the estimate moves by sqrt(P - P').
    p_before, r = 0.5**2, 0.1**2
    p_after = 1 / (1 / p_before + 1 / r)
    gain = p_before / (p_before + r)
    rng = np.random.default_rng(0)
    error = rng.normal(0, np.sqrt(p_before), 200_000)
    moved = gain * (rng.normal(0, np.sqrt(r), 200_000) - error)
    assert std(0.0, 1.0, np.sqrt(p_before), np.sqrt(p_after), smoothed=False) == pytest.approx(moved.std(), rel=0.01)


def test_between_told_durations_it_is_a_power_of_time():
    lags_s = (0.5, 1.0, 2.0)
    duration = np.array([0.2, 0.5, 0.8, 1.7, 2.0, 2.1, 1.5])
    told = 0.004 * np.sqrt(np.array(lags_s)) * np.ones((7, 1))  # a random walk of the displacement
    told[6, 2] = np.nan  # the track ends before
    got = interpolate_durations_m(duration, lags_s=lags_s, lag_std_m=told)
    assert got[1:5] == pytest.approx(0.004 * np.sqrt(duration[1:5]))
    assert got[0] == pytest.approx(0.004 * np.sqrt(0.5) * 0.2 / 0.5)  # a constant velocity error
    assert np.isnan(got[5:]).all()


def test_along_a_course():
    assert compute_along_std_m(np.array([0.3]), np.array([0.1]), np.array([np.pi / 2]))[0] == pytest.approx(0.1)
    assert compute_along_std_m(np.array([0.3]), np.array([0.1]), np.array([0.0]))[0] == pytest.approx(0.3)


def test_the_chord_ahead_sees_a_jump_before_it_comes():
    count = 200
    position_std = np.where(np.arange(count) < 100, 1.0, 0.02)
    nothing = np.full(count, np.nan)
    rows = MotionRows(np.full(count, 1.0), nothing, nothing, nothing, np.zeros(count, dtype=np.int64), 0.05)
    got = compute_chord_ahead_std_m(
        rows,
        velocity_std_mps=np.full(count, 0.004),
        position_std_m=position_std,
        chord_m=1.0,
        slowest_mps=0.1,
        smoothed=False,
        lags_s=(0.5, 2.0),
        lag_std_m=np.where(np.arange(count)[:, None] == 120, [0.2, 0.8], np.nan),
    )
    assert np.flatnonzero(got > 0.1).tolist() == [*range(80, 100), 120]
    assert got[120] == pytest.approx(0.4)  # a power of time between what is told of half and of two seconds


@pytest.mark.parametrize("told", [(0.012, 0.020), (0.010, np.nan)])
def test_beyond_the_durations_told_the_error_grows_at_most_linearly(told):
    # A slow robot of which positions are known to 0.5 m: the velocity's error, of 50 mm/s, does not last.
    assert std(0.05, 7.0, 0.5, 0.5, smoothed=True, told=told) == pytest.approx(0.070)
    assert std(0.05, 7.0, 0.5, 0.9, smoothed=True, told=told) == pytest.approx(0.4)  # the position error itself grew
    assert std(0.005, 7.0, 0.5, 0.5, smoothed=True, told=told) == pytest.approx(0.035, rel=1e-2)
