"""From pairs to one clock: who is late is settled by least squares and by the majority; worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.fusion.checks import clock_offsets
from tcpipe.fusion.checks.clock_offsets import find_clock_offsets, make_pair, shift_stamps, solve_offsets
from tcpipe.fusion.checks.motions import Lag
from tcpipe.fusion.measurements import (
    BodyVelocities,
    InertialMeasurements,
    Measurements,
    Positions,
    select_measurements,
)
from tcpipe.tables.facts import ClockOffset


def pair(late, against, offset_s, std_s=0.002, explained=0.9, *, by="speed"):
    return make_pair(late, against, by, Lag(offset_s, std_s, explained))


@pytest.mark.parametrize(
    ("lever_arm_m", "speed_mps"), [((0, 1, 0), 0.5), ((0, -1, 0), 1.5), ((1, 0, 0), 1.25**0.5), ((0, 0, 1), 1.0)]
)
def test_an_antenna_inside_a_turn_is_slower_and_one_outside_is_faster(lever_arm_m, speed_mps):
    to_the_left = np.array([[1.0, 0.5]])
    assert clock_offsets._compute_antenna_speed(to_the_left, lever_arm_m) == pytest.approx(speed_mps)


def test_the_one_that_differs_is_the_one_that_is_late():
    found = solve_offsets((pair("gnss", "wheel_odometry", 0.25), pair("wheel_odometry", "imu", 0.001)))
    assert found.reference == "imu"
    assert found.offsets["gnss"].offset_s == pytest.approx(0.251)
    assert {role: offset.is_significant for role, offset in found.offsets.items()} == {
        "wheel_odometry": False,
        "gnss": True,
    }


def test_the_majority_rules_over_the_order():
    pairs = pair("wheel_odometry", "imu", 0.1), pair("visual_odometry", "imu", 0.1), pair("gnss", "wheel_odometry", 0.0)
    found = solve_offsets(pairs)
    assert found.reference == "wheel_odometry"
    assert {role for role, offset in found.offsets.items() if offset.is_significant} == {"imu"}
    assert found.offsets["imu"].offset_s == pytest.approx(-0.1)


def test_a_doubtful_clock_is_no_reference():
    """Against fixes, known to 0.018 s, nobody is surely off; against the wheels the IMU is."""
    pairs = (
        pair("wheel_odometry", "imu", 0.1),
        pair("visual_odometry", "imu", 0.1),
        pair("gnss", "wheel_odometry", -0.02, 0.018),
    )
    found = solve_offsets(pairs)
    assert found.reference == "wheel_odometry"
    assert {role for role, offset in found.offsets.items() if offset.is_significant} == {"imu"}


def test_pairs_in_a_ring_are_weighed_by_their_variances():
    """0.10 ± 0.01 directly, 0.14 ± 0.01·√2 round the third: weights 2 : 1 give 0.1133 ± 0.01·√(2/3)."""
    ring = (
        pair("visual_odometry", "imu", 0.10, 0.01),
        pair("wheel_odometry", "imu", 0.04, 0.01),
        pair("visual_odometry", "wheel_odometry", 0.10, 0.01),
    )
    offset = solve_offsets(ring).offsets["visual_odometry"]
    assert offset.offset_s == pytest.approx(0.34 / 3)
    assert offset.std_s == pytest.approx(0.01 * (2 / 3) ** 0.5)


@pytest.mark.parametrize(
    ("offset_s", "std_s", "explained", "determined"),
    [
        (0.0, 0.019, 0.9, True),
        (0.0, 0.03, 0.9, False),
        (0.3, 0.025, 0.9, True),
        (0.3, 0.05, 0.9, False),
        (0.7, 0.08, 0.9, False),
        (0.3, 0.01, 0.2, False),
    ],
)
def test_what_is_not_known_well_is_not_spoken_of(offset_s, std_s, explained, determined):
    found = solve_offsets((pair("gnss", "wheel_odometry", offset_s, std_s, explained),))
    assert found.pairs[0].determined == determined
    assert bool(found.offsets) == determined


def test_small_offsets_are_not_noted():
    assert not solve_offsets((pair("gnss", "wheel_odometry", 0.045),)).offsets["gnss"].is_significant
    assert solve_offsets((pair("gnss", "wheel_odometry", -0.055),)).offsets["gnss"].is_significant


def blamed(*pairs):
    return {role for role, offset in solve_offsets(pairs).offsets.items() if offset.is_wrong}


def test_a_sensor_is_blamed_only_where_two_others_agree_against_it():
    late = pair("gnss", "wheel_odometry", 0.2)
    assert blamed(late) == set()
    assert blamed(late, pair("wheel_odometry", "imu", 0.001, by="yaw rate")) == {"gnss"}
    ring = pair("visual_odometry", "wheel_odometry", 0.0), pair("gnss", "visual_odometry", 0.0)
    assert blamed(late, *ring) == set()
    assert blamed(late, pair("gnss", "visual_odometry", 0.2)) == {"gnss"}
    assert blamed(late, pair("visual_odometry", "wheel_odometry", 0.0)) == {"gnss"}


HALF_HOUR = np.arange(0.0, 1900.0, 0.04)


def drive_with_clocks(**late_s):
    """Half an hour of starts, stops and turns by wheels, gyroscope and fixes; ``late_s``: how late a sensor's stamps are, by time."""
    t = HALF_HOUR
    speed = np.clip(np.minimum(np.mod(t, 13.0) - 2.0, 11.5 - np.mod(t, 13.0)), 0.0, 1.0)
    turn = 0.4 * np.sin(0.9 * t + np.sin(0.05 * t)) * (speed > 0)
    step = speed * np.exp(1j * np.cumsum(turn) * 0.04) * 0.04
    place = np.cumsum(step) - step / 2
    rng = np.random.default_rng(7)

    def stamps(sensor):
        return np.round((t + late_s.get(sensor, np.zeros_like(t))) * 1e9).astype(np.int64)

    nothing, one = np.full(t.size, np.nan), np.ones((t.size, 3))
    wheels = BodyVelocities(
        stamps("wheels"),
        np.column_stack((speed + rng.normal(0, 0.02, t.size), nothing, nothing)),
        one,
        turn + rng.normal(0, 0.02, t.size),
    )
    gyro = np.column_stack((rng.normal(0, 0.01, (t.size, 2)), turn + rng.normal(0, 0.01, t.size)))
    imu = InertialMeasurements(stamps("imu"), gyro, 9.81 * one, np.full((t.size, 4), np.nan), 0.01, 0.1)
    enu = np.column_stack((place.real, place.imag, 0 * t)) + rng.normal(0, 0.01, (t.size, 3))
    fixes = slice(None, None, 5)
    gnss = Positions(stamps("gnss")[fixes], enu[fixes], 1e-4 * one[fixes])
    return Measurements(gnss=gnss, imu=imu, wheels=wheels)


def test_a_clock_that_drifts_is_told_from_one_that_is_off():
    """The receiver's clock runs 150 ppm slow about a middle of +0.02 s: over half an hour 0.28 s, of which a constant shows nothing."""
    rate = 150e-6
    found = find_clock_offsets(drive_with_clocks(gnss=0.02 + rate * (HALF_HOUR - 950.0)))
    gnss = found.offsets["gnss"]
    assert gnss.is_significant
    assert gnss.drift_ppm == pytest.approx(1e6 * rate, rel=0.1)
    assert gnss.offset_s == pytest.approx(0.02, abs=0.01)
    assert found.offsets["wheel_odometry"].drift_ppm == 0.0
    of_gnss = [pair for pair in found.pairs if pair.late == "gnss"]
    assert len(of_gnss) >= 3
    assert [p.offset_s for p in of_gnss] == pytest.approx([0.02 + rate * p.from_middle_s for p in of_gnss], abs=0.02)


def test_a_drift_of_two_seconds_in_a_thousand_shows_within_three_minutes():
    short = select_measurements(drive_with_clocks(imu=2e-3 * (HALF_HOUR - 90.0)), 0, 180 * 10**9)
    imu = find_clock_offsets(short).offsets["imu"]
    assert imu.drift_ppm == pytest.approx(2000.0, rel=0.1)


def test_steady_clocks_do_not_drift_and_a_late_one_is_only_late():
    found = find_clock_offsets(drive_with_clocks(gnss=np.full(HALF_HOUR.size, 0.2)))
    assert not any(offset.drift_ppm for offset in found.offsets.values())
    assert {role for role, offset in found.offsets.items() if offset.is_significant} == {"gnss"}
    assert found.offsets["gnss"].offset_s == pytest.approx(0.2, abs=0.01)


def test_the_drift_of_the_reference_is_its_own():
    """Wheels and fixes agree with each other for ever; the gyroscope's clock drifts from both."""
    found = find_clock_offsets(drive_with_clocks(imu=200e-6 * (HALF_HOUR - 950.0)))
    assert found.reference == "wheel_odometry"
    assert {role for role, offset in found.offsets.items() if offset.drift_ppm} == {"imu"}
    assert found.offsets["imu"].drift_ppm == pytest.approx(200.0, rel=0.05)


def test_a_straight_tells_nothing_of_clocks():
    """On 1.8 km without a turn the controller weaves: the wheels steer against what the gyroscope felt 0.28 s before."""
    straight = drive_with_clocks()
    weave = 0.03 * np.sin(0.7 * HALF_HOUR + np.sin(0.05 * HALF_HOUR))
    speed = np.clip(np.minimum(HALF_HOUR - 2.0, 1890.0 - HALF_HOUR), 0.0, 1.0)
    noise = np.random.default_rng(3).normal(0, 0.01, (3, HALF_HOUR.size))
    wheels = replace(
        straight.wheels,
        velocity_mps=np.column_stack((speed + noise[0], *straight.wheels.velocity_mps[:, 1:].T)),
        yaw_rate_radps=np.roll(weave, 7) + noise[1],
    )
    gyro = straight.imu.angular_velocity_radps.copy()
    gyro[:, 2] = weave + noise[2]
    imu = replace(straight.imu, angular_velocity_radps=gyro)
    found = find_clock_offsets(Measurements(imu=imu, wheels=wheels))
    assert found.offsets == {}
    assert not any(each.determined for each in found.pairs)


def test_the_mean_of_a_clock_that_steps_is_not_known():
    """Late by 0.3 s from half-time: 0.15 s sets neither half right, and parts of the run show it."""
    drive = drive_with_clocks(gnss=np.where(HALF_HOUR < 200.0, 0.0, 0.3))
    found = find_clock_offsets(select_measurements(drive, 0, 400 * 10**9))
    assert "gnss" not in found.offsets


def test_stamps_without_offset_and_drift():
    """0.1 s in the middle of 100 s and 0.36 s an hour: 0.095 s at the beginning, 0.105 s at the end."""
    stamp_ns = np.array([0, 50, 100], np.int64) * 10**9
    steady = ClockOffset(0.1, 0.01, is_significant=True)
    assert (stamp_ns - shift_stamps(stamp_ns, steady, 50 * 10**9)).tolist() == [100_000_000] * 3
    drifting = replace(steady, drift_ppm=100.0)
    assert (stamp_ns - shift_stamps(stamp_ns, drifting, 50 * 10**9)).tolist() == [95_000_000, 100_000_000, 105_000_000]
