"""Each kind of unsteady driving, and what must not be taken for it."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.motion import masks
from tcpipe.motion.row_sections import MotionRows, fit_slope

PERIOD = 0.05


def rows(velocity, *, yaw_rate=0.0, wheel=np.nan, commanded=np.nan):
    velocity = np.asarray(velocity, dtype=float)
    full = lambda value: np.broadcast_to(np.asarray(value, dtype=float), velocity.shape).copy()  # noqa: E731
    return MotionRows(
        velocity, full(yaw_rate), full(wheel), full(commanded), np.zeros(len(velocity), dtype=np.int64), PERIOD
    )


def seconds(mask):
    return np.flatnonzero(mask) * PERIOD


STANDING = {"below_velocity_mps": 0.05, "below_yaw_rate_radps": 0.05}


def test_a_change_of_direction_stands_for_an_instant():
    got = masks.find_stationary(rows([0.6, 0.3, -0.2, -0.6]), **STANDING)
    assert got.tolist() == [False, False, True, False]


TURNING = {"below_velocity_mps": 0.1, "above_yaw_rate_radps": 0.1, "min_radius_m": 0.5, "min_s": 0.2}


def test_turning_on_the_spot_must_last():
    yaw = np.zeros(20)
    yaw[2:5] = 0.15  # 0.15 s
    yaw[10:14] = 0.15  # 0.20 s
    got = masks.find_turning_in_place(rows(np.full(20, 0.09), yaw_rate=yaw), **TURNING)
    assert np.flatnonzero(got).tolist() == [10, 11, 12, 13]


@pytest.mark.parametrize(("radius_m", "turning"), [(0.45, True), (0.55, False)])
def test_turning_tighter_than_the_radius_at_any_speed(radius_m, turning):
    got = masks.find_turning_in_place(rows([0.9], yaw_rate=-0.9 / radius_m), **TURNING)
    assert got.tolist() == [turning]


def test_acceleration_is_the_slope_of_a_noisy_velocity():
    t = np.arange(0, 20, PERIOD)
    v = np.where(t < 10, 0.5, np.minimum(0.5 + 0.5 * (t - 10), 1.0)) + np.random.default_rng(0).normal(0, 0.01, len(t))
    acceleration = masks.estimate_forward_acceleration_mps2(rows(v), window_s=0.45)
    got = seconds(masks.find_accelerating(rows(v), acceleration, above_mps2=0.3, min_s=0.2, dilate_s=0.25))
    assert got.min() == pytest.approx(10 - 0.25, abs=0.15)
    assert got.max() == pytest.approx(11 + 0.25, abs=0.15)
    assert len(got) * PERIOD == pytest.approx(1.5, abs=0.3)


def test_noise_alone_is_no_acceleration():
    v = 0.9 + np.random.default_rng(1).normal(0, 0.02, 10_000)
    acceleration = masks.estimate_forward_acceleration_mps2(rows(v), window_s=0.45)
    assert not masks.find_accelerating(rows(v), acceleration, above_mps2=0.3, min_s=0.2, dilate_s=0.25).any()


def test_ramps_beside_a_halt_end_where_the_speed_settles():
    t = np.arange(0, 30, PERIOD)
    v = np.clip(0.2 * (t - 5), 0, 0.8) * (t < 20) + np.clip(0.8 - 0.2 * (t - 20), 0, 0.8) * (t >= 20)
    made = rows(v)
    halted = v < 0.05
    got = masks.find_ramps(
        made, masks.estimate_forward_acceleration_mps2(made, window_s=0.45), halted, above_mps2=0.1, min_s=0.2
    )
    found = seconds(got)
    start, stop = found[found < 15], found[found > 15]
    assert (start.min(), start.max()) == (pytest.approx(5.25, abs=0.1), pytest.approx(9, abs=0.2))
    assert (stop.min(), stop.max()) == (pytest.approx(20, abs=0.2), pytest.approx(23.75, abs=0.1))


def test_a_slowdown_far_from_any_halt_is_no_ramp():
    t = np.arange(0, 20, PERIOD)
    v = 0.9 - 0.4 * np.exp(-(((t - 10) / 1.5) ** 2))
    made = rows(v)
    acceleration = masks.estimate_forward_acceleration_mps2(made, window_s=0.45)
    assert not masks.find_ramps(made, acceleration, np.zeros(len(t), dtype=bool), above_mps2=0.1, min_s=0.2).any()


CHANGE = {"step_mps": 0.1, "window_s": 0.5, "settle_s": 2.0}


@pytest.mark.parametrize("step", [-1.0, -0.5, 0.12, 0.5, 1.0])
def test_a_commanded_step_is_dropped_from_its_moment_for_two_seconds(step):
    t = np.arange(0, 20, PERIOD)
    got = seconds(masks.find_command_changes(rows(0 * t, commanded=np.where(t < 10, 1.0, 1.0 + step)), **CHANGE))
    assert got.min() == pytest.approx(10, abs=1e-9)
    assert got.max() == pytest.approx(12, abs=1e-9)
    assert len(got) == 41


def test_a_commanded_ramp_is_dropped_until_two_seconds_after_its_end():
    t = np.arange(0, 20, PERIOD)
    got = seconds(masks.find_command_changes(rows(0 * t, commanded=np.clip(0.5 * (t - 5), 0, 1)), **CHANGE))
    assert got.min() == pytest.approx(5.2, abs=0.15)
    assert got.max() == pytest.approx(7 + 2, abs=0.25)


def test_a_slow_ramp_and_the_jitter_of_a_joystick_are_no_change():
    t = np.arange(0, 60, PERIOD)
    slow = np.clip(0.5 + 0.01 * t, 0, 1)
    jitter = 0.95 + np.random.default_rng(0).uniform(-0.1, 0.1, len(t))
    alternating = np.where(np.arange(len(t)) % 2, 0.8, 1.0)
    for commanded in (slow, jitter, alternating):
        assert not masks.find_command_changes(rows(0 * t, commanded=commanded), **CHANGE).any()


def test_below_limit_follows_the_command_not_its_jitter():
    t = np.arange(0, 20, PERIOD)
    commanded = np.where(t < 10, 1.0, 0.8)
    commanded[::7] -= 0.06  # jitter: 0.94 now and then
    got = seconds(masks.find_below_full_speed(rows(0 * t, commanded=commanded), limit_mps=0.95, window_s=0.5))
    assert got.min() == pytest.approx(10, abs=0.05)
    assert len(got) == pytest.approx(200, abs=1)
    assert not masks.find_below_full_speed(rows(0 * t), limit_mps=0.95, window_s=0.5).any()


def test_reversing_at_full_speed_is_not_below_the_limit():
    assert not masks.find_below_full_speed(rows([-1.0] * 20, commanded=-1.0), limit_mps=0.95, window_s=0.5).any()
    reversing = masks.find_reversing(rows([-0.06, -0.04, 0.3]), stationary_velocity_mps=0.05)
    assert reversing.tolist() == [True, False, False]


def test_a_limit_itself_is_not_below_nor_above_it():
    for stuck in (rows([0.05], wheel=0.5), rows([0.01], wheel=0.2)):
        assert not masks.find_stuck(stuck, stationary_velocity_mps=0.05, wheel_velocity_above_mps=0.2).any()
    assert not masks.find_stationary(rows([0.05]), **STANDING).any()
    assert not masks.find_stationary(rows([0.0], yaw_rate=0.05), **STANDING).any()
    assert not masks.find_turning_in_place(rows([0.1] * 9, yaw_rate=0.15), **TURNING).any()
    assert not masks.find_turning_in_place(rows([0.06] * 9, yaw_rate=0.1), **TURNING).any()
    assert not masks.find_turning_in_place(rows([0.5] * 9, yaw_rate=1.0), **TURNING).any()
    assert not masks.find_reversing(rows([-0.05]), stationary_velocity_mps=0.05).any()
    acceleration = np.full(9, 0.25)
    assert not masks.find_accelerating(rows([0.5] * 9), acceleration, above_mps2=0.25, min_s=0.2, dilate_s=0.0).any()
    assert not masks.find_below_full_speed(rows([0.0] * 9, commanded=0.5), limit_mps=0.5, window_s=0.1).any()
    mean_is_the_limit = rows([0.0] * 3, commanded=[0.75, 0.25, 0.5])
    assert not masks.find_below_full_speed(mean_is_the_limit, limit_mps=0.5, window_s=0.1).any()


@pytest.mark.parametrize(("window_s", "half"), [(0.05, 1), (0.40, 4), (0.45, 4), (0.50, 4)])
def test_the_slope_is_over_the_window_that_is_asked_for(window_s, half):
    made = rows(np.random.default_rng(2).normal(0, 1, 40))
    expected = fit_slope(made.velocity_mps, made.piece, half_window=half, period_s=PERIOD)
    assert masks.estimate_forward_acceleration_mps2(made, window_s=window_s) == pytest.approx(expected)


def ramp_rows(acceleration, halted):
    acceleration = np.array(acceleration, dtype=float)
    halted = np.isin(np.arange(len(acceleration)), halted)
    got = masks.find_ramps(rows([0.5] * len(acceleration)), acceleration, halted, above_mps2=0.25, min_s=0.1)
    return np.flatnonzero(got).tolist()


def test_a_ramp_begins_at_a_halt_of_one_row_on_either_side():
    assert ramp_rows([0, 0, 0, -1, -1, -1, 0, 0, 0], [6]) == [3, 4, 5]
    assert ramp_rows([0, 1, 1, 0, 0, 0], [0]) == [1, 2]
    assert ramp_rows([1, 1, 1, 0, 0, 0], []) == []
    assert ramp_rows([0.25, 0.25, 0.25, 0, 0], [0]) == []
    assert ramp_rows([0, 0, 0, -0.25, -0.25], [4]) == []


def changed(commanded, *, window_s=0.5, piece=None):
    made = rows(np.zeros(len(commanded)), commanded=commanded)
    made = made if piece is None else replace(made, piece=np.array(piece))
    found = masks.find_command_changes(made, step_mps=0.1, window_s=window_s, settle_s=0.0)
    return np.flatnonzero(found).tolist()


def test_both_windows_touch_the_row_and_neither_holds_the_other_s():
    assert changed([0.0] * 20 + [0.105] * 20) == [20]
    assert changed([0.0] * 20 + [0.105] * 10 + [0.0] * 20)[0] == 20
    assert changed([0.0] + [1.0] * 20) == [1]
    assert changed([0.0] * 20 + [1.0]) == [20]


@pytest.mark.parametrize(("step", "found"), [(0.18, True), (0.15, False)])
def test_twice_what_jitter_leaves_is_allowed_for(step, found):
    jitter = np.where(
        np.arange(60) % 2, 0.05, -0.05
    )  # leaves 0.05 sqrt(0.4) = 0.032 in the difference of two means of ten
    assert bool(changed(jitter + np.where(np.arange(60) < 30, 0.0, step))) == found


def test_a_command_that_ends_or_steps_across_a_hole_is_no_change():
    assert changed([1.0] * 20 + [np.nan] * 20) == []
    assert changed([0.0] * 20 + [1.0] * 20, piece=[0] * 20 + [1] * 20) == []
