"""Each kind of unsteady driving, and what must not be taken for it."""

import numpy as np
import pytest

from tcpipe.motion import masks
from tcpipe.motion.pieces import MotionRows

PERIOD = 0.05


def rows(velocity, *, yaw_rate=0.0, wheel=np.nan, commanded=np.nan):
    velocity = np.asarray(velocity, dtype=float)
    full = lambda value: np.broadcast_to(np.asarray(value, dtype=float), velocity.shape).copy()  # noqa: E731
    return MotionRows(
        velocity, full(yaw_rate), full(wheel), full(commanded), np.zeros(len(velocity), dtype=np.int64), PERIOD
    )


def seconds(mask):
    return np.flatnonzero(mask) * PERIOD


def test_standing_needs_both_limits():
    limits = {"below_velocity_mps": 0.05, "below_yaw_rate_radps": 0.05}
    assert masks.standing(rows([0.04] * 3), **limits).all()
    assert not masks.standing(rows([0.04] * 3, yaw_rate=0.06), **limits).any()
    assert not masks.standing(rows([0.06] * 3), **limits).any()


def test_a_change_of_direction_stands_for_an_instant():
    got = masks.standing(rows([0.6, 0.3, -0.2, -0.6]), below_velocity_mps=0.05, below_yaw_rate_radps=0.05)
    assert got.tolist() == [False, False, True, False]


def test_stuck_is_wheels_without_ground():
    limits = {"standing_velocity_mps": 0.05, "wheel_velocity_above_mps": 0.2}
    assert masks.stuck(rows([0.01] * 4, wheel=0.5), **limits).all()
    assert not masks.stuck(rows([0.3] * 4, wheel=0.5), **limits).any()
    assert not masks.stuck(rows([0.01] * 4), **limits).any()


TURNING = {"below_velocity_mps": 0.1, "above_yaw_rate_radps": 0.1, "min_radius_m": 0.5, "min_s": 0.2}


def test_turning_on_the_spot_must_last():
    yaw = np.zeros(20)
    yaw[2:5] = 0.15  # 0.15 s
    yaw[10:14] = 0.15  # 0.20 s
    got = masks.turning_in_place(rows(np.full(20, 0.09), yaw_rate=yaw), **TURNING)
    assert np.flatnonzero(got).tolist() == [10, 11, 12, 13]


@pytest.mark.parametrize(("radius_m", "turning"), [(0.45, True), (0.55, False)])
def test_turning_tighter_than_the_radius_at_any_speed(radius_m, turning):
    got = masks.turning_in_place(rows([0.9], yaw_rate=-0.9 / radius_m), **TURNING)
    assert got.tolist() == [turning]


def test_acceleration_is_the_slope_of_a_noisy_velocity():
    t = np.arange(0, 20, PERIOD)
    v = np.where(t < 10, 0.5, np.minimum(0.5 + 0.5 * (t - 10), 1.0)) + np.random.default_rng(0).normal(0, 0.01, len(t))
    acceleration = masks.forward_acceleration_mps2(rows(v), window_s=0.45)
    got = seconds(masks.accelerating(rows(v), acceleration, above_mps2=0.3, min_s=0.2, dilate_s=0.25))
    assert got.min() == pytest.approx(10 - 0.25, abs=0.15)
    assert got.max() == pytest.approx(11 + 0.25, abs=0.15)
    assert len(got) * PERIOD == pytest.approx(1.5, abs=0.3)


def test_noise_alone_is_no_acceleration():
    v = 0.9 + np.random.default_rng(1).normal(0, 0.02, 10_000)
    acceleration = masks.forward_acceleration_mps2(rows(v), window_s=0.45)
    assert not masks.accelerating(rows(v), acceleration, above_mps2=0.3, min_s=0.2, dilate_s=0.25).any()


def test_ramps_beside_a_halt_end_where_the_speed_settles():
    t = np.arange(0, 30, PERIOD)
    v = np.clip(0.2 * (t - 5), 0, 0.8) * (t < 20) + np.clip(0.8 - 0.2 * (t - 20), 0, 0.8) * (t >= 20)
    made = rows(v)
    halted = v < 0.05
    got = masks.ramps(made, masks.forward_acceleration_mps2(made, window_s=0.45), halted, above_mps2=0.1, min_s=0.2)
    found = seconds(got)
    start, stop = found[found < 15], found[found > 15]
    assert (start.min(), start.max()) == (pytest.approx(5.25, abs=0.1), pytest.approx(9, abs=0.2))
    assert (stop.min(), stop.max()) == (pytest.approx(20, abs=0.2), pytest.approx(23.75, abs=0.1))


def test_a_slowdown_far_from_any_halt_is_no_ramp():
    t = np.arange(0, 20, PERIOD)
    v = 0.9 - 0.4 * np.exp(-(((t - 10) / 1.5) ** 2))
    made = rows(v)
    acceleration = masks.forward_acceleration_mps2(made, window_s=0.45)
    assert not masks.ramps(made, acceleration, np.zeros(len(t), dtype=bool), above_mps2=0.1, min_s=0.2).any()


CHANGE = {"step_mps": 0.1, "window_s": 0.5, "settle_s": 2.0}


@pytest.mark.parametrize("step", [-1.0, -0.5, 0.12, 0.5, 1.0])
def test_a_commanded_step_is_dropped_from_its_moment_for_two_seconds(step):
    t = np.arange(0, 20, PERIOD)
    got = seconds(masks.command_changed(rows(0 * t, commanded=np.where(t < 10, 1.0, 1.0 + step)), **CHANGE))
    assert got.min() == pytest.approx(10, abs=1e-9)
    assert got.max() == pytest.approx(12, abs=1e-9)
    assert len(got) == 41


def test_a_commanded_ramp_is_dropped_until_two_seconds_after_its_end():
    t = np.arange(0, 20, PERIOD)
    got = seconds(masks.command_changed(rows(0 * t, commanded=np.clip(0.5 * (t - 5), 0, 1)), **CHANGE))
    assert got.min() == pytest.approx(5.2, abs=0.15)
    assert got.max() == pytest.approx(7 + 2, abs=0.25)


def test_a_slow_ramp_and_the_jitter_of_a_joystick_are_no_change():
    t = np.arange(0, 60, PERIOD)
    slow = np.clip(0.5 + 0.01 * t, 0, 1)
    jitter = 0.95 + np.random.default_rng(0).uniform(-0.1, 0.1, len(t))
    alternating = np.where(np.arange(len(t)) % 2, 0.8, 1.0)
    for commanded in (slow, jitter, alternating):
        assert not masks.command_changed(rows(0 * t, commanded=commanded), **CHANGE).any()


def test_two_changes_are_both_found_and_an_unknown_command_is_none():
    t = np.arange(0, 20, PERIOD)
    commanded = np.where(t < 5, 0.0, np.where(t < 6, 1.0, 0.0))
    got = seconds(masks.command_changed(rows(0 * t, commanded=commanded), **CHANGE))
    assert (got.min(), got.max()) == (pytest.approx(5), pytest.approx(8))
    commanded = np.where(t < 10, np.nan, 1.0)
    assert not masks.command_changed(rows(0 * t, commanded=commanded), **CHANGE).any()


def test_below_limit_follows_the_command_not_its_jitter():
    t = np.arange(0, 20, PERIOD)
    commanded = np.where(t < 10, 1.0, 0.8)
    commanded[::7] -= 0.06  # jitter: 0.94 now and then
    got = seconds(masks.below_limit(rows(0 * t, commanded=commanded), limit_mps=0.95, window_s=0.5))
    assert got.min() == pytest.approx(10, abs=0.05)
    assert len(got) == pytest.approx(200, abs=1)
    assert not masks.below_limit(rows(0 * t), limit_mps=0.95, window_s=0.5).any()


def test_reversing_at_full_speed_is_not_below_the_limit():
    assert not masks.below_limit(rows([-1.0] * 20, commanded=-1.0), limit_mps=0.95, window_s=0.5).any()
    assert masks.reversing(rows([-0.06, -0.04, 0.3]), standing_velocity_mps=0.05).tolist() == [True, False, False]
