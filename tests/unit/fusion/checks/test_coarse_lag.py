"""Clocks minutes apart, on drives of a generator of its own: found where the drive shows them, else nothing is said."""

import numpy as np
import pytest

from tcpipe.fusion.checks.clock_offsets import find_coarse_offsets, find_other_clocks
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions

STEP_S = 0.02
SECONDS = np.arange(0.0, 360.0, STEP_S)


def wander(seed):
    """Speed and yaw rate of stops, starts and turns at random times."""
    rng = np.random.default_rng(seed)
    speed, turn = np.zeros((2, SECONDS.size))
    begin = 3.0
    while begin < SECONDS[-1] - 20.0:
        length, pause = rng.uniform(5.0, 30.0), rng.uniform(1.0, 6.0)
        inside = np.clip(np.minimum(SECONDS - begin, begin + length - SECONDS), 0.0, 1.0)
        speed += rng.uniform(0.6, 1.4) * inside
        for _ in range(int(length / 6)):
            at = rng.uniform(begin + 2.0, begin + length - 2.0)
            turn += rng.normal(0.0, 0.4) * np.exp(-(((SECONDS - at) / rng.uniform(0.7, 2.0)) ** 2)) * (inside > 0)
        begin += length + pause
    return speed, turn


def lanes():
    """20 equal lanes of 16 s, each with a turn at its end."""
    phase = np.mod(SECONDS, 18.0)
    return np.clip(np.minimum(phase, 18.0 - phase), 0.0, 1.0), 0.9 * np.exp(-(((phase - 15.0) / 1.2) ** 2))


def straight():
    return np.clip(np.minimum(SECONDS - 5.0, 350.0 - SECONDS), 0.0, 1.0), np.zeros(SECONDS.size)


def measure(speed, turn, *, seed=0, fix_std_m=0.02, without=(), **late_s):
    """Measurements of a flat drive; ``late_s``: how much later the stamps of a sensor are."""
    rng = np.random.default_rng(seed + 100)

    def stamps(sensor, every):
        return np.round((SECONDS[::every] + late_s.get(sensor, 0.0) + 1000.0) * 1e9).astype(np.int64)

    course = np.cumsum(turn) * STEP_S
    place = np.cumsum(speed * np.exp(1j * course)) * STEP_S
    fixes, rows = place[::10], SECONDS[::2].size
    enu = np.column_stack((fixes.real, fixes.imag, 0.0 * fixes.real)) + rng.normal(0.0, fix_std_m, (fixes.size, 3))
    gyro = np.column_stack((rng.normal(0.0, 0.01, (2, rows)).T, turn[::2] + rng.normal(0.0, 0.01, rows) + 0.005))
    force = np.column_stack((np.gradient(speed, STEP_S)[::2], np.zeros(rows), np.full(rows, 9.81)))
    nothing, one = np.full(rows, np.nan), np.ones((rows, 3))
    velocity = np.column_stack((1.03 * speed[::2] + rng.normal(0.0, 0.02, rows), nothing, nothing))
    made = {
        "gnss": Positions(stamps("gnss", 10), enu, np.full(enu.shape, fix_std_m**2)),
        "imu": InertialMeasurements(stamps("imu", 2), gyro, force, np.full((rows, 4), np.nan), 0.01, 0.1),
        "wheels": BodyVelocities(stamps("wheels", 2), velocity, one, turn[::2] + rng.normal(0.0, 0.03, rows)),
    }
    return Measurements(**{name: sensor for name, sensor in made.items() if name not in without})


def find_far(m):
    """The coarse offsets of more than a second."""
    return {role: each.offset_s for role, each in find_coarse_offsets(m).items() if each.is_significant}


@pytest.mark.parametrize(("late_s", "std_m"), [(1.5, 0.02), (-3.7, 0.1), (18.0, 0.02), (-120.0, 0.1), (270.0, 0.02)])
def test_fixes_on_another_clock_are_found(late_s, std_m):
    drive = measure(*wander(1), gnss=late_s, fix_std_m=std_m)
    assert find_far(drive) == {"gnss": pytest.approx(late_s, abs=0.3)}
    found = find_other_clocks(drive)
    assert {role for role, offset in found.items() if offset.is_significant} == {"gnss"}
    assert found["gnss"].offset_s == pytest.approx(late_s, abs=0.02)


@pytest.mark.parametrize("late", ["imu", "wheels"])
def test_the_sensor_that_differs_from_two_others_is_found(late):
    assert find_far(measure(*wander(2), **{late: -18.0})) == {
        late.replace("wheels", "wheel_odometry"): pytest.approx(-18.0, abs=0.3)
    }


def test_of_two_sensors_the_fixes_are_taken_for_the_late_one():
    assert [*find_far(measure(*wander(3), gnss=18.0, without=("imu",)))] == ["gnss"]


def test_beside_fixes_or_wheels_alone_the_imu_is_taken_for_the_late_one():
    for other in ("gnss", "wheels"):
        assert [*find_far(measure(*wander(3), imu=18.0, without=(other,)))] == ["imu"]


@pytest.mark.parametrize("late_s", [0.0, -0.9])
def test_small_offsets_are_left_to_the_fine_search(late_s):
    drive = measure(*wander(4), gnss=late_s)
    assert find_coarse_offsets(drive)["gnss"].offset_s == pytest.approx(late_s, abs=0.1)
    assert find_other_clocks(drive) == {}


@pytest.mark.parametrize(("drive", "late_s"), [(lanes, 0.0), (lanes, 18.0), (straight, 0.0)])
def test_lanes_that_repeat_show_no_offset_and_a_straight_no_wrong_one(drive, late_s):
    assert find_far(measure(*drive(), gnss=late_s)) == {}


def test_nothing_is_found_between_drives_of_different_places():
    """Each of eight pairs of drives has thousands of lags at which noise could look like an offset."""
    for seed in range(8):
        here, there = measure(*wander(10 + seed)), measure(*wander(30 + seed))
        assert find_far(Measurements(gnss=there.gnss, imu=here.imu, wheels=here.wheels)) == {}


def test_a_clock_that_steps_has_no_offset():
    late_s = np.where(SECONDS < 180.0, 0.0, 18.0)
    assert find_far(measure(*wander(5), gnss=late_s[::10])) == {}
