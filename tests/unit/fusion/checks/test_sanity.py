"""Which sensors cannot be right, by made motion: units, a robot that is stuck, mirror images, and who drives backwards."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.fusion.checks.motions import GRID_NS, GRID_S
from tcpipe.fusion.checks.sanity import Command, check_sensors
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
    return BodyVelocities(AT_NS, velocity, np.ones_like(velocity) * 1e-4, twist[:, 1] + noise[:, 1])


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
    return check_sensors(m, wanted, is_imu_stated=stated, force_mps2=9.81)


def excluded(*args, **sensors):
    return {role: of.code for role, of in checked(*args, **sensors).items()}


def test_sensors_that_agree_are_let_be():
    assert excluded(path(), wheels=TWIST * [1.1, 1.3], visual=TWIST, command=TWIST, imu=gyroscope()) == {}
    assert excluded(path(std_m=2.0), wheels=TWIST) == {}


def test_of_three_the_one_that_differs_is_wrong():
    assert excluded(path(), wheels=TWIST * [3.6, 1], visual=TWIST) == {"wheel_odometry": "distance-contradicted"}
    assert excluded(path(scale=1 / 57.3), wheels=TWIST, visual=TWIST) == {"gnss": "distance-contradicted"}
    assert excluded(path(), wheels=TWIST, visual=TWIST * [0.4, 1]) == {"visual_odometry": "distance-contradicted"}


def test_of_two_odometries_nobody_decides():
    both = checked(wheels=TWIST * [3.6, 1], visual=TWIST)
    assert {role: of.names["suspect"] for role, of in both.items()} == {
        "visual_odometry": "wheel_odometry",
        "wheel_odometry": "visual_odometry",
    }


@pytest.mark.parametrize("std_m", [0.02, 2.0])
@pytest.mark.parametrize("factor", [0.25, 0.43, 2.5, 3.6])
def test_fixes_decide_about_the_scale_of_a_lone_odometry(factor, std_m):
    found = checked(path(std_m=std_m), wheels=TWIST * [factor, 1])
    assert {role: of.code for role, of in found.items()} == {"wheel_odometry": "distance-contradicted"}
    assert found["wheel_odometry"].scale == pytest.approx(factor, rel=0.02 if std_m < 1.0 else 0.25)


def test_fusion_estimates_a_scale_near_one():
    assert checked(path(), wheels=TWIST * [1.6, 1]) == {}


def test_two_that_have_nothing_in_common_are_both_excluded():
    assert set(excluded(path(), wheels=TWIST * [10.0, 1])) == {"gnss", "wheel_odometry"}


def test_of_wheels_that_turn_and_fixes_that_stay_a_third_sensor_decides():
    assert excluded(path(STILL), wheels=TWIST, visual=STILL, command=TWIST * [1.2, 1]) == {
        "wheel_odometry": "distance-contradicted"
    }
    assert set(excluded(path(STILL), wheels=TWIST, imu=gyroscope())) == {"gnss"}  # the robot turns
    assert set(excluded(path(STILL), wheels=TWIST)) == {"gnss", "wheel_odometry"}


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
    found = check_sensors(m, None, is_imu_stated=False, force_mps2=9.81)
    assert {role: of.code for role, of in found.items()} == {sensor: "frozen"}


def test_a_mirrored_path_shows_in_its_bends():
    assert excluded(path(mirror=True), wheels=TWIST, visual=TWIST) == {"gnss": "yaw-rate-sign"}
    assert excluded(path(mirror=True), wheels=TWIST, imu=gyroscope()) == {"gnss": "yaw-rate-sign"}
    assert excluded(path(mirror=True), wheels=TWIST) == {"gnss": "yaw-rate-sign", "wheel_odometry": "yaw-rate-sign"}
    straight = TWIST * [1, 0]
    assert excluded(path(straight, mirror=True), wheels=straight, visual=straight) == {}


def test_slip_noise_and_a_late_clock_exclude_nothing():
    slipping = TWIST * np.column_stack((1.2 + 0.2 * np.sin(T / 5), np.full(T.size, 1.4)))
    assert excluded(path(), wheels=slipping, visual=slipping) == {}
    assert excluded(path(np.roll(TWIST, 50, axis=0)), wheels=TWIST, visual=TWIST) == {}


@pytest.mark.parametrize("turn", [1, -1])
def test_who_drives_backwards_or_turns_otherwise_is_what_fewer_confirm(turn):
    other = TWIST * [-1, turn]
    wrong = checked(path(), wheels=other, visual=TWIST, imu=gyroscope())
    assert {role: of.code for role, of in wrong.items()} == {"wheel_odometry": "drives-backwards"}
    assert wrong["wheel_odometry"].turned_by == pytest.approx(np.diag([-1.0, -turn, turn]))
    assert excluded(wheels=TWIST, visual=TWIST * [1, -1], imu=gyroscope()) == {"visual_odometry": "yaw-rate-sign"}
    assert excluded(wheels=TWIST, visual=TWIST, imu=gyroscope(-TWIST[:, 1])) == {"imu": "yaw-rate-sign"}
    assert excluded(wheels=TWIST * [1, -1], imu=gyroscope(), stated=True) == {"wheel_odometry": "yaw-rate-sign"}
    assert excluded(wheels=TWIST * [1, -1], imu=gyroscope(), stated=False) == {"imu": "yaw-rate-sign"}


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
    found = checked(path(), wheels=TWIST, visual=TWIST, imu=imu, command=TWIST * 1.1)
    assert {role: of.code for role, of in found.items()} == {"imu": "imu-rotated"}
    assert found["imu"].turned_by == pytest.approx(turn, abs=1e-9)
