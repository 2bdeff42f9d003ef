"""How much noise the process is given, and what follows from it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from unit.fusion import drive
from unit.fusion.test_error_state import fuse, truth

from tcpipe.fusion.preparation import inflate_jittery_fixes, prepare_imu
from tcpipe.fusion.process import find_turn_scale_std, make_motion_noise
from tcpipe.fusion.state import Mode


@cache
def measured(**options):
    return drive.measure(truth(), 1, **options)


def estimate_density(m, at_ns, mode):
    """Return the density of the velocity's noise forward [m²/s³] at some stamps."""
    modes = np.full(at_ns.size, mode, np.int8)
    return make_motion_noise(m, drive.estimate_noise(m), at_ns, modes, np.zeros((at_ns.size, 3)), 0.05)[:, 3] / 0.05


def test_vibration_counts_where_it_is():
    rng = np.random.default_rng(2)
    stamp_ns = np.arange(4000, dtype=np.int64) * 5_000_000
    shaken = np.where(np.arange(4000) < 2000, 0.05, 0.4)[:, None] * rng.normal(size=(4000, 3)) + [0.0, 0.0, 9.81]
    names = [f"linear_acceleration_{axis}_mps2" for axis in "xyz"]
    columns = dict(zip(names, shaken.T, strict=True))
    columns |= {f"angular_velocity_{axis}_radps": np.zeros(4000) for axis in "xyz"}
    columns |= {f"quat_{c}": np.full(4000, np.nan) for c in "xyzw"}
    place = {"xyz_m": (0.0, 0.0, 0.0), "quat_xyzw": (0.0, 0.0, 0.0, 1.0)}
    imu, _ = prepare_imu(stamp_ns, columns, **place, gyro_std_radps=0.002, accelerometer_std_mps2=0.02)
    assert imu.accelerometer_noise_mps2[:1700] == pytest.approx(np.full(1700, 0.05), rel=0.3)
    assert imu.accelerometer_noise_mps2[2300:] == pytest.approx(np.full(1700, 0.4), rel=0.3)
    density = estimate_density(replace(measured(), imu=imu), stamp_ns[[1000, 3000]], Mode.INERTIAL)
    assert density == pytest.approx(np.array([0.05, 0.4]) ** 2 / 200, rel=0.6)


def test_without_an_imu_the_velocity_may_change_where_every_odometry_says_so():
    moving, held = measured(imu=False), Mode.FLAT_TURN
    at_ns = drive.ns([4.3, 30.0])  # starting, and driving steadily
    starting, steady = estimate_density(moving, at_ns, held)
    assert starting > 5 * steady
    digging = moving.wheels.velocity_mps.copy()
    digging[:, 0] += np.clip((moving.wheels.stamp_ns - at_ns[1]) * 1e-9, 0, 1)  # the camera sees no such start
    again = estimate_density(replace(moving, wheels=replace(moving.wheels, velocity_mps=digging)), at_ns, held)
    assert again[1] < 5 * steady
    blind = replace(moving, visual=None, wheels=replace(moving.wheels, velocity_mps=digging))
    assert estimate_density(blind, at_ns + 300_000_000, held)[1] > 5 * steady


def test_a_turn_rate_has_a_scale_to_be_found():
    with_imu, without = measured(), measured(imu=False)
    assert find_turn_scale_std(replace(with_imu, gnss=None)) == 0.0
    rate = with_imu.imu.angular_velocity_radps
    found = fuse(replace(with_imu, imu=replace(with_imu.imu, angular_velocity_radps=1.05 * rate)))
    assert 1.0 / (1.0 - found.facts.parameters["turn scale"].value[0]) == pytest.approx(1.05, abs=0.005)
    assert drive.errors(truth(), found)["yaw_deg"] < 0.5
    assert find_turn_scale_std(without) > 0.1
    found = fuse(without)
    (value,) = found.facts.parameters["turn scale"].value
    assert 1.0 / (1.0 - value) == pytest.approx(0.8, abs=0.03)
    assert "gyroscope bias" not in found.facts.parameters
    assert drive.errors(truth(), found)["yaw_deg"] < 1.5


def test_a_robot_with_an_antenna_alone_looks_along_its_course():
    alone = fuse(measured(imu=False, visual=False, wheels=False))
    speed = np.linalg.norm(alone.velocity_enu_mps, axis=1)
    assert np.median(alone.yaw_std_rad[speed > 0.5]) < 0.3
    assert np.median(alone.yaw_std_rad[speed < 0.02]) > 1.0
    found = drive.errors(truth(), alone)
    assert found["xy"] < 0.35
    assert 0.05 < found["nees_position"] < 3.0


def test_an_error_of_the_fixes_that_lasts_does_not_average_out():
    """A first-order Gauss-Markov error of a metre with a correlation time of a minute, ten times a second."""
    std_m = 1.0
    m = measured(gnss_std=1e-3, gnss_outliers=0.01)
    error = std_m * drive.make_lasting_errors((m.gnss.stamp_ns - drive.ZERO_NS) * 1e-9, 60.0, 3)
    variance = np.full(error.shape, std_m**2)
    fixes = replace(m.gnss, position_enu_m=m.gnss.position_enu_m + error, variance_m2=variance)
    found = fuse(replace(m, gnss=fixes))
    figures = drive.errors(truth(), found)
    assert 0.05 < figures["nees_position"] < 3.0
    assert figures["forward"] < 0.02
    assert figures["nees_forward"] < 3.0


def test_clean_fixes_show_none_also_with_outliers_slip_and_stops():
    measurements = drive.measure(truth(), 8)
    assert np.mean(inflate_jittery_fixes(measurements.gnss, measurements.wheels)[1] > 0) < 0.02


def test_late_fixes_are_seen_and_their_variance_raised_while_driving():
    measurements = drive.measure(truth(), 8, gnss_hz=2.5)
    stamp = measurements.gnss.stamp_ns
    late = stamp + (np.random.default_rng(9).uniform(0, 0.35, stamp.size) * 1e9).astype(np.int64)  # deviation 0.10 s
    gnss = replace(measurements.gnss, stamp_ns=late)
    raised, jitter = inflate_jittery_fixes(gnss, measurements.wheels)
    assert np.median(jitter) == pytest.approx(0.10, abs=0.03)
    speed = np.abs(np.interp(late, drive.ns(truth().t), truth().forward))
    assert (raised.variance_m2[speed > 0.7, 0] > 0.1**2).mean() > 0.9
    assert (raised.variance_m2[speed < 0.01, 0] < 0.05**2).mean() > 0.9
    assert (raised.variance_m2[:, 2] == gnss.variance_m2[:, 2]).all()
    assert not raised.has_claims
