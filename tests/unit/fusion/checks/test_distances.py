"""Who goes how far, by made motion: units, a robot that is stuck, and mirror images."""

import itertools

import numpy as np
import pytest

from tcpipe.fusion.checks.distances import (
    COMMAND,
    compare_path_of_fixes,
    estimate_far_scale,
    find_contradictions,
    find_distances,
)
from tcpipe.fusion.checks.lags import GRID_NS, GRID_S, find_liveliest_window_ns, iterate_windows_ns
from tcpipe.fusion.measurements import BodyVelocities, Measurements, Positions

AT_NS = np.arange(0, 120_000_000_000, GRID_NS, dtype=np.int64)
T = AT_NS * 1e-9
TWIST = np.column_stack((np.full(T.size, 0.9), 0.3 * np.sin(0.3 * T)))
STILL = np.zeros_like(TWIST)
NOBODY = frozenset()


def path(twist, *, std_m=0.02, scale=1.0, mirror=False):
    yaw = np.cumsum(twist[:, 1]) * GRID_S + 0.7
    place = scale * np.cumsum(twist[:, 0] * np.exp(1j * yaw)) * GRID_S
    place = np.conj(place) if mirror else place
    rows = slice(None, None, 5)
    noise = np.random.default_rng(4).normal(0.0, std_m, (T[rows].size, 3))
    enu = np.column_stack((place.real, place.imag, np.zeros(T.size)))[rows] + noise
    return Positions(AT_NS[rows], enu, np.full_like(enu, std_m**2))


def judged(gnss, turning=NOBODY, **twists):
    return find_contradictions(find_distances(gnss, twists, AT_NS), turning=turning)


def test_sensors_that_agree_are_let_be():
    assert judged(path(TWIST), wheel_odometry=TWIST * [1.1, 1.3], visual_odometry=TWIST, command=TWIST) == {}
    assert judged(path(TWIST, std_m=2.0), wheel_odometry=TWIST) == {}


def test_of_three_the_one_that_differs_is_wrong():
    assert list(judged(path(TWIST), wheel_odometry=TWIST * [3.6, 1], visual_odometry=TWIST)) == ["wheel_odometry"]
    assert list(judged(path(TWIST, scale=1 / 57.3), wheel_odometry=TWIST, visual_odometry=TWIST)) == ["gnss"]


def test_of_two_the_command_decides_or_nobody():
    wrong = judged(path(TWIST), wheel_odometry=TWIST * [3.6, 1], **{COMMAND: TWIST * [1.2, 1]})
    assert list(wrong) == ["wheel_odometry"]
    assert (wrong["wheel_odometry"].code, wrong["wheel_odometry"].names["unit"]) == ("unit-suspected", "km/h")
    assert "suspect" not in wrong["wheel_odometry"].names
    both = judged(path(TWIST), wheel_odometry=TWIST * [3.6, 1])
    assert set(both) == {"gnss", "wheel_odometry"}
    assert {role: of.names["suspect"] for role, of in both.items()} == {
        "gnss": "wheel_odometry",
        "wheel_odometry": "gnss",
    }


def test_wheels_that_turn_while_the_robot_stands_are_stuck_not_wrong():
    assert judged(path(STILL), wheel_odometry=TWIST) == {}
    assert judged(path(STILL), wheel_odometry=TWIST, visual_odometry=STILL, **{COMMAND: TWIST * [1.2, 1]}) == {}
    moving = frozenset({"wheel_odometry"})  # by the gyroscope: the fixes are wrong
    assert list(judged(path(STILL), moving, wheel_odometry=TWIST)) == ["gnss"]


@pytest.mark.parametrize(("mirror", "how"), [(False, "alike"), (True, "mirrored")])
def test_a_mirrored_path_shows_in_its_bends(mirror, how):
    assert compare_path_of_fixes(path(TWIST, mirror=mirror), TWIST * [1.1, 1.2], AT_NS) == how
    straight = TWIST * [1, 0]
    assert compare_path_of_fixes(path(straight, mirror=mirror), straight, AT_NS) is None


def test_a_path_of_another_drive_is_unlike_but_slip_noise_and_a_late_clock_are_not():
    other = np.column_stack((TWIST[:, 0], 0.4 * np.cos(0.17 * T)))
    assert compare_path_of_fixes(path(TWIST), other, AT_NS) == "unlike"
    slipping = TWIST * np.column_stack((1.2 + 0.2 * np.sin(T / 5), np.full(T.size, 1.4)))
    assert compare_path_of_fixes(path(TWIST), slipping, AT_NS) != "unlike"
    assert compare_path_of_fixes(path(TWIST, std_m=2.0), other, AT_NS) is None
    assert compare_path_of_fixes(path(np.roll(TWIST, 50, axis=0)), TWIST, AT_NS) != "unlike"


def test_an_hour_of_standing_is_not_what_is_judged():
    stamp_ns = np.arange(0, 3 * 3600, dtype=np.int64) * 1_000_000_000
    speed = np.where(stamp_ns > 2.2 * 3600e9, 1.0, 0.0)
    nothing = np.full(speed.size, np.nan)
    wheels = BodyVelocities(
        stamp_ns, np.column_stack((speed, nothing, nothing)), np.ones((speed.size, 3)), nothing, nothing
    )
    at_ns = find_liveliest_window_ns(Measurements(wheels=wheels))
    assert at_ns[0] >= 2.1 * 3600e9
    assert (at_ns[-1] - at_ns[0]) * 1e-9 == pytest.approx(1800.0, abs=0.1)


def wheels_at(at_s):
    nothing = np.full(at_s.size, np.nan)
    velocity = np.column_stack((np.ones(at_s.size), nothing, nothing))
    return BodyVelocities(np.int64(at_s) * 10**9, velocity, np.ones((at_s.size, 3)), nothing, nothing)


def test_where_nothing_was_measured_for_years_there_are_no_windows():
    years = np.concatenate((np.arange(600), 10**9 + np.arange(600)))
    assert len(list(iterate_windows_ns(Measurements(wheels=wheels_at(years)), 600 * 10**9))) == 4


def test_windows_cover_all_of_the_time_once():
    found = list(iterate_windows_ns(Measurements(wheels=wheels_at(np.arange(2501))), 600 * 10**9))
    assert len(found) == 4
    assert found[0][0] == 0
    assert all(abs(b[0] - a[-1]) <= GRID_NS for a, b in itertools.pairwise(found))
    assert 2500 * 10**9 - found[-1][-1] < GRID_NS


def test_coarse_fixes_contradict_an_odometry_over_longer_windows():
    wrong = judged(path(TWIST, std_m=2.0), wheel_odometry=TWIST * [0.4, 1])
    assert set(wrong) == {"gnss", "wheel_odometry"}


@pytest.mark.parametrize("std_m", [0.02, 2.0])
@pytest.mark.parametrize("factor", [0.25, 0.43, 1.6, 3.6])
def test_a_scale_far_from_one_is_told_by_the_fixes_where_the_paths_are_alike(factor, std_m):
    found, std = estimate_far_scale(path(TWIST, std_m=std_m), TWIST * [factor, 1], AT_NS)
    assert found == pytest.approx(factor, rel=0.06)
    assert std < 0.05 * factor


def test_a_scale_near_one_or_out_of_reason_or_of_another_path_is_none():
    fixes = path(TWIST)
    for other in (TWIST, TWIST * [1.3, 1], TWIST * [57.3, 1], TWIST * [0.43, -4.0], TWIST * [0.0, 1], STILL):
        assert estimate_far_scale(fixes, other, AT_NS) is None
    slips = np.where((T > 40) & (T < 80), 0.3, 0.9)[:, None]
    assert estimate_far_scale(fixes, TWIST * np.column_stack((slips, np.ones_like(slips))), AT_NS) is None
    assert estimate_far_scale(path(STILL, std_m=2.0), TWIST * [0.43, 1], AT_NS) is None
