"""The start of a section against the truth of simulated drives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from unit.fusion import drive

from tcpipe.fusion.initial import find_initial_state, find_stationary_intervals
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.geometry.rotation import rpy_from_quat


def start_of(measurements):
    motion = [s for s in (measurements.gnss, measurements.wheels, measurements.visual) if s is not None]
    start = int(min(s.stamp_ns[0] for s in motion))
    return find_initial_state(measurements, find_stationary_intervals(measurements), start)


@pytest.mark.parametrize(
    ("how", "faults"),
    [
        ({}, {}),
        ({"start_yaw": -3.1}, {}),
        ({"reverse_s": 12.0}, {}),
        ({"stand_s": 0.2, "turns": 2.0}, {}),
        ({}, {"gnss_outages": ((0.0, 25.0),)}),
        ({}, {"gnss_outages": ((6.0, 16.0), (26.0, 36.0), (42.0, 56.0))}),
        ({}, {"wheels": False}),
        ({}, {"wheels": False, "visual": False}),
        ({}, {"imu": False}),
        ({}, {"gnss_std": 1.0, "gnss_hz": 1.0}),
        ({}, {"gnss_outliers": 0.15}),
    ],
    ids=[
        "stands",
        "west",
        "reverse",
        "turning",
        "late gnss",
        "gaps",
        "visual",
        "gnss imu",
        "no imu",
        "sbas",
        "outliers",
    ],
)
def test_yaw_tilt_and_position_lie_within_their_deviations(how, faults):
    truth = drive.make_drive(60.0, **how)
    initial = start_of(drive.measure(truth, 4, **faults))
    true = Rotation.from_matrix(truth.rotation[0])
    error = (true.inv() * Rotation.from_quat(initial.quat_xyzw)).as_rotvec()
    assert initial.heading_from == "course over ground"
    assert abs(error[2]) < 3 * initial.yaw_std_rad
    assert initial.yaw_std_rad <= 0.4
    assert np.abs(error[:2]).max() < 3 * initial.tilt_std_rad
    assert (np.abs(initial.position_enu_m - truth.position[0]) < 3 * initial.position_std_m).all()


def test_gyroscope_bias_is_seen_while_standing():
    truth = drive.make_drive(60.0)
    assert start_of(drive.measure(truth, 4)).gyro_bias_radps == pytest.approx([0.006, -0.004, 0.008], abs=5e-4)


def test_a_robot_that_never_moves_has_no_heading_and_says_so():
    truth = drive.make_drive(20.0, stand_s=100.0)
    initial = start_of(drive.measure(truth, 4))
    assert initial.heading_from == "unknown"
    assert initial.yaw_std_rad > 0.5


def test_without_gnss_yaw_is_the_units_own_or_zero():
    truth = drive.make_drive(20.0)
    bare = drive.measure(truth, 4, gnss=False)
    initial = start_of(bare)
    assert initial.heading_from == "local frame"
    assert rpy_from_quat(initial.quat_xyzw)[2] == pytest.approx(0.0, abs=1e-12)
    quat = truth.slerp((bare.imu.stamp_ns - drive.ZERO_NS) * 1e-9).as_quat()
    initial = start_of(replace(bare, imu=replace(bare.imu, quat_xyzw=quat)))
    assert initial.heading_from == "orientation"
    assert rpy_from_quat(initial.quat_xyzw)[2] == pytest.approx(0.7, abs=0.01)


def test_every_interval_is_standing_and_long_stays_are_found():
    truth = drive.make_drive(150.0)
    found = (find_stationary_intervals(drive.measure(truth, 5)) - drive.ZERO_NS) * 1e-9
    assert found.shape[0] >= 3  # the start and two stops, of which the robot turns in place for a part
    for first, last in found:
        inside = (truth.t >= first) & (truth.t <= last)
        assert np.abs(truth.forward[inside]).max() < 0.03
        assert np.abs(truth.rate[inside]).max() < 0.05
    assert found[0, 0] < 0.5
    assert found[0, 1] > 2.5


def test_neither_sign_alone_is_enough():
    truth = drive.make_drive(30.0)
    assert find_stationary_intervals(drive.measure(truth, 5, wheels=False)).shape == (0, 2)
    assert find_stationary_intervals(drive.measure(truth, 5, imu=False)).shape == (0, 2)


@pytest.mark.parametrize("slope_rad", [0.2, -0.2])
def test_a_robot_that_starts_on_a_slope_rises_or_falls_with_it(slope_rad):
    stamp_ns = np.arange(0, 20_000_000_000, 10_000_000, dtype=np.int64)
    along = np.array([np.cos(slope_rad), 0.0, np.sin(slope_rad)])  # east, and up the slope
    n = stamp_ns.size
    force = np.tile([9.80665 * np.sin(slope_rad), 0.0, 9.80665 * np.cos(slope_rad)], (n, 1))
    imu = InertialMeasurements(stamp_ns, np.zeros((n, 3)), force, np.full((n, 4), np.nan), 0.003, 0.1)
    only_x = np.column_stack((np.ones(n // 2), np.full((n // 2, 2), np.nan)))
    unknown = np.full(n // 2, np.nan)
    wheels = BodyVelocities(stamp_ns[::2], only_x, 1e-4 * only_x, unknown)
    fix_ns = stamp_ns[::10]
    fixes = Positions(fix_ns, np.outer(fix_ns * 1e-9, along), np.full((fix_ns.size, 3), 1e-4))
    initial = start_of(Measurements(gnss=fixes, imu=imu, wheels=wheels))
    assert initial.velocity_enu_mps == pytest.approx(along, abs=0.05)
