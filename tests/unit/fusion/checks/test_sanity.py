"""Which sensors cannot be right, by made motion: units, a robot that is stuck, mirror images, and who drives backwards."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.fusion.checks.motions import GRID_NS, GRID_S
from tcpipe.fusion.checks.sanity import (
    Command,
    check_sensors,
    compute_agreement,
    compute_command_ratio,
    rescale_odometries,
)
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions

AT_NS = np.arange(0, 120_000_000_000, GRID_NS, dtype=np.int64)
T = AT_NS * 1e-9
TWIST = np.column_stack((0.9 + 0.2 * np.sin(0.8 * T), 0.3 * np.sin(0.3 * T)))
STILL = np.zeros_like(TWIST)


def path(twist=TWIST, *, std_m=0.02, scale=1.0, mirror=False):
    yaw = np.cumsum(twist[:, 1]) * GRID_S + 0.7
    place = scale * np.cumsum(twist[:, 0] * np.exp(1j * yaw)) * GRID_S
    place = np.conj(place) if mirror else place
    rows = slice(None, None, 5)
    noise = np.random.default_rng(4).normal(0.0, std_m, (T[rows].size, 3))
    enu = np.column_stack((place.real, place.imag, np.zeros(T.size)))[rows] + noise
    return Positions(AT_NS[rows], enu, np.full_like(enu, std_m**2))


def odometry(twist, *, axes=1):
    noise = np.random.default_rng(7).normal(0.0, 1e-3, (T.size, 2))
    velocity = np.full((T.size, 3), np.nan)
    velocity[:, :axes] = 0.0
    velocity[:, 0] = twist[:, 0] + noise[:, 0]
    return BodyVelocities(
        AT_NS, velocity, np.ones_like(velocity) * 1e-4, twist[:, 1] + noise[:, 1], np.full(T.size, 1e-4)
    )


def gyroscope(yaw_rate=TWIST[:, 1], forward=TWIST):
    """An upright IMU on a robot with some twist."""
    random = np.random.default_rng(5)
    rate = np.column_stack((np.zeros((T.size, 2)), yaw_rate)) + random.normal(0.0, 0.01, (T.size, 3))
    force = np.column_stack((np.gradient(forward[:, 0], GRID_S), forward[:, 0] * forward[:, 1], np.full(T.size, 9.81)))
    force += random.normal(0.0, 0.05, force.shape)
    return InertialMeasurements(AT_NS, rate, force, np.full((T.size, 4), np.nan), 0.01, 0.05)


def order(stamp_ns, forward_mps):
    return Command(stamp_ns, forward_mps, np.zeros(stamp_ns.size))


def checked(gnss=None, *, wheels=None, visual=None, imu=None, command=None, stated=True):
    m = Measurements(
        gnss=gnss,
        imu=imu,
        wheels=None if wheels is None else odometry(wheels),
        visual=None if visual is None else odometry(visual, axes=3),
    )
    wanted = None if command is None else order(AT_NS, command[:, 0])
    return check_sensors(m, command=wanted, stated={"imu": stated}, felt=np.nan if imu is None else 9.81)


def excluded(*args, **sensors):
    return {role: of.code for role, of in checked(*args, **sensors)[0].items()}


def test_sensors_that_agree_are_let_be():
    assert excluded(path(), wheels=TWIST * [1.1, 1.3], visual=TWIST, command=TWIST, imu=gyroscope()) == {}
    assert excluded(path(std_m=2.0), wheels=TWIST) == {}


def test_of_three_the_one_that_differs_is_wrong():
    assert excluded(path(), wheels=TWIST * [3.6, 1], visual=TWIST) == {"wheel_odometry": "unit-suspected"}
    assert excluded(path(scale=1 / 57.3), wheels=TWIST, visual=TWIST) == {"gnss": "unit-suspected"}
    assert excluded(path(), wheels=TWIST, visual=TWIST * [0.4, 1]) == {"visual_odometry": "distance-contradicted"}


def test_of_two_odometries_the_command_decides_or_nobody():
    assert set(excluded(wheels=TWIST * [3.6, 1], visual=TWIST, command=TWIST * [1.2, 1])) == {"wheel_odometry"}
    both, _ = checked(wheels=TWIST * [3.6, 1], visual=TWIST)
    assert {role: of.names["suspect"] for role, of in both.items()} == {
        "visual_odometry": "wheel_odometry",
        "wheel_odometry": "visual_odometry",
    }


@pytest.mark.parametrize("std_m", [0.02, 2.0])
@pytest.mark.parametrize("factor", [0.25, 0.43, 2.5, 3.6])
def test_a_lone_odometry_whose_path_is_that_of_the_fixes_has_another_scale(factor, std_m):
    found, scales = checked(path(std_m=std_m), wheels=TWIST * [factor, 1])
    assert found == {}
    assert scales["wheel_odometry"] == pytest.approx(factor, rel=0.1)


def test_a_command_that_goes_by_the_odometry_blames_the_fixes_and_fusion_estimates_a_scale_near_one():
    assert set(excluded(path(scale=0.35), wheels=TWIST, command=TWIST * [1.1, 1])) == {"gnss"}
    assert checked(path(), wheels=TWIST * [1.6, 1]) == ({}, {})


def test_two_that_have_nothing_in_common_are_both_excluded():
    assert set(excluded(path(), wheels=TWIST * [10.0, 1])) == {"gnss", "wheel_odometry"}


def test_wheels_that_turn_while_the_robot_stands_are_stuck_not_wrong():
    assert excluded(path(STILL), wheels=TWIST) == {}
    assert excluded(path(STILL), wheels=TWIST, visual=STILL, command=TWIST * [1.2, 1]) == {}
    assert set(excluded(path(STILL), wheels=TWIST, imu=gyroscope())) == {"gnss"}  # the robot turns


@pytest.mark.parametrize("sensor", ["gnss", "wheel_odometry", "imu"])
def test_a_sensor_that_repeats_one_value_is_frozen(sensor):
    one = np.tile(TWIST[100], (T.size, 1))
    fixes, imu = path(), gyroscope()
    if sensor == "gnss":
        fixes = replace(fixes, position_enu_m=np.tile(fixes.position_enu_m[:1], (fixes.stamp_ns.size, 1)))
    if sensor == "imu":
        imu = replace(imu, specific_force_mps2=np.tile(imu.specific_force_mps2[:1], (T.size, 1)))
    m = Measurements(gnss=fixes, imu=imu, visual=odometry(TWIST, axes=3), wheels=odometry(TWIST))
    if sensor == "wheel_odometry":
        frozen = replace(
            m.wheels, velocity_mps=m.wheels.velocity_mps[:1] * np.ones((T.size, 1)), yaw_rate_radps=one[:, 1]
        )
        m = replace(m, wheels=replace(frozen, velocity_mps=0.1 * frozen.velocity_mps))
    found, _ = check_sensors(m, command=None, stated={}, felt=9.81)
    assert {role: of.code for role, of in found.items()} == {sensor: "frozen"}


def test_a_mirrored_path_shows_in_its_bends():
    assert excluded(path(mirror=True), wheels=TWIST, visual=TWIST) == {"gnss": "path-mirrored"}
    assert excluded(path(mirror=True), wheels=TWIST, imu=gyroscope()) == {"gnss": "path-mirrored"}
    assert excluded(path(mirror=True), wheels=TWIST) == {"gnss": "path-mirrored", "wheel_odometry": "yaw-rate-sign"}
    straight = TWIST * [1, 0]
    assert excluded(path(straight, mirror=True), wheels=straight, visual=straight) == {}


def test_a_path_of_another_drive_is_unlike_but_slip_noise_and_a_late_clock_are_not():
    other = np.column_stack((TWIST[:, 0], 0.4 * np.cos(0.17 * T)))
    assert excluded(path(), wheels=other, visual=other) == {"gnss": "path-unlike"}
    assert excluded(path(), wheels=other) == {}  # wheels that skid turn otherwise, too
    slipping = TWIST * np.column_stack((1.2 + 0.2 * np.sin(T / 5), np.full(T.size, 1.4)))
    assert excluded(path(), wheels=slipping, visual=slipping) == {}
    assert excluded(path(std_m=2.0), wheels=other, visual=other) == {}
    assert excluded(path(np.roll(TWIST, 50, axis=0)), wheels=TWIST, visual=TWIST) == {}


@pytest.mark.parametrize("turn", [1, -1])
def test_who_drives_backwards_or_turns_otherwise_is_what_fewer_confirm(turn):
    other = TWIST * [-1, turn]
    wrong, _ = checked(path(), wheels=other, visual=TWIST, imu=gyroscope())
    assert {role: of.code for role, of in wrong.items()} == {"wheel_odometry": "drives-backwards"}
    assert wrong["wheel_odometry"].turned_by == pytest.approx(np.diag([-1.0, -turn, turn]))
    assert excluded(wheels=TWIST, visual=TWIST * [1, -1], imu=gyroscope()) == {"visual_odometry": "yaw-rate-sign"}
    assert excluded(wheels=TWIST, visual=TWIST, imu=gyroscope(-TWIST[:, 1])) == {"imu": "imu-sign"}
    assert excluded(wheels=TWIST * [1, -1], imu=gyroscope(), stated=True) == {"wheel_odometry": "yaw-rate-sign"}
    assert excluded(wheels=TWIST * [1, -1], imu=gyroscope(), stated=False) == {"imu": "imu-sign"}


@pytest.mark.parametrize("yaw_rad", [np.pi, np.pi / 2])
def test_an_imu_that_looks_elsewhere_is_rotated_whatever_is_commanded(yaw_rad):
    imu = gyroscope()
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    imu = replace(
        imu,
        specific_force_mps2=imu.specific_force_mps2 @ turn,
        angular_velocity_radps=imu.angular_velocity_radps @ turn,
    )
    found, _ = checked(path(), wheels=TWIST, visual=TWIST, imu=imu, command=TWIST * 1.1)
    assert {role: of.code for role, of in found.items()} == {"imu": "imu-rotated"}
    assert found["imu"].turned_by == pytest.approx(turn, abs=1e-9)


def test_agreement_counts_only_what_moves():
    speed = np.where(T % 12 > 3, 1.0, 0.0)
    assert compute_agreement(speed, -speed) == -1.0
    assert compute_agreement(speed, 0.8 * speed) == 1.0
    assert compute_agreement(speed, np.zeros_like(speed)) is None


@pytest.mark.parametrize("factor", [0.25, 3.6])
def test_a_scale_is_taken_out_and_the_claim_does_not_become_better(factor):
    m = Measurements(wheels=odometry(TWIST * [factor, 1]))
    rescaled = rescale_odometries(m, {"wheel_odometry": factor}).wheels
    assert rescaled.velocity_mps[:, 0] == pytest.approx(TWIST[:, 0], abs=0.03)
    assert (rescaled.variance_m2ps2 >= m.wheels.variance_m2ps2).all()


COMMAND_NS = np.arange(0, 120 * 10**9, 10**8, dtype=np.int64)


def driven(over, *, commanded):
    """Wheels that are ``over`` times as fast as commanded, half a second later, with the scatter that the ground makes."""
    stamp_ns = np.arange(0, 120 * 10**9, 2 * 10**7, dtype=np.int64)
    told = commanded[np.clip(np.searchsorted(COMMAND_NS, stamp_ns - 5 * 10**8, "right") - 1, 0, None)]
    speed = told * (over + 0.05 * np.sin(stamp_ns * 1e-9))
    velocity = np.column_stack((speed, np.full((stamp_ns.size, 2), np.nan)))
    nothing = np.full(stamp_ns.size, np.nan)
    return BodyVelocities(stamp_ns, velocity, velocity * 0 + 1e-4, nothing, nothing)


@pytest.mark.parametrize(("over", "found"), [(0.9, None), (1.0, None), (1.2, 1.2)])
def test_a_robot_that_is_faster_than_its_command_has_other_wheels(over, found):
    jitter = np.random.default_rng(1).normal(0, 0.01, COMMAND_NS.size)
    commanded = np.where(COMMAND_NS % (30 * 10**9) < 24 * 10**9, 1.0 + jitter, 0.0)
    told = compute_command_ratio(Measurements(wheels=driven(over, commanded=commanded)), order(COMMAND_NS, commanded))
    assert told == (None if found is None else pytest.approx(found, abs=0.02))


def test_a_command_that_is_not_what_drives_tells_nothing():
    moving = driven(1.2, commanded=np.ones(COMMAND_NS.size))
    assert compute_command_ratio(Measurements(wheels=moving), order(COMMAND_NS, np.zeros(COMMAND_NS.size))) is None
    assert compute_command_ratio(Measurements(wheels=moving), order(COMMAND_NS[:0], np.zeros(0))) is None


def test_speeds_while_the_commands_are_silent_prove_no_ratio():
    is_sent = COMMAND_NS % (20 * 10**9) < 6 * 10**9
    another_source = np.where(np.roll(is_sent, 20), 1.0, 1.3)  # it drives until two seconds after the commands return
    command = order(COMMAND_NS[is_sent], np.ones(is_sent.sum()))
    assert compute_command_ratio(Measurements(wheels=driven(1.0, commanded=another_source)), command) is None
