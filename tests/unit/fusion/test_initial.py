"""The start of a stretch against the truth of simulated drives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from unit.fusion import drive

from tcpipe.fusion.initial import find_initial_state, find_stationary_intervals
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
        ({}, {"wheels": False}),
        ({}, {"wheels": False, "visual": False}),
        ({}, {"imu": False}),
        ({}, {"gnss_std": 1.0, "gnss_hz": 1.0}),
        ({}, {"gnss_outliers": 0.15}),
    ],
    ids=["stands", "west", "reverse", "turning", "late gnss", "visual", "gnss imu", "no imu", "sbas", "outliers"],
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
