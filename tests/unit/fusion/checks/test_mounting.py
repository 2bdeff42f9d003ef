"""How antenna and IMU are mounted, told from a drive whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from rough_drive import drive, measured, true_track
from scipy.spatial.transform import Rotation

from tcpipe.fusion.checks.mounting import (
    Tilt,
    TiltEvidence,
    add_antenna_uncertainty,
    collect_arm_evidence,
    collect_tilt_evidence,
    estimate_antenna_uncertainty,
    level_imu,
    make_unknown_arm,
    move_antenna,
    solve_arm,
    solve_lag,
    solve_tilt,
)
from tcpipe.fusion.measurements import Measurements

NOWHERE = np.zeros(3)


@pytest.fixture(scope="module")
def truth():
    return drive(240.0, 5)


@pytest.fixture(scope="module")
def sensors(truth):
    return measured(truth, 5)


@pytest.fixture(scope="module")
def track(truth):
    return true_track(truth)


def arm_of(track, sensors, moved_m=NOWHERE, **known):
    return solve_arm([collect_arm_evidence(track, sensors)], moved_m, **known)


def deviations(arm):
    return np.sqrt(np.diag(arm.covariance))


def tilted(imu, roll_deg, pitch_deg):
    """What a unit says that is mounted so against what it is taken for."""
    turned = Rotation.from_euler("xyz", [roll_deg, pitch_deg, 0.0], degrees=True)
    return replace(
        imu,
        angular_velocity_radps=turned.inv().apply(imu.angular_velocity_radps),
        specific_force_mps2=turned.inv().apply(imu.specific_force_mps2),
    )


def test_an_antenna_where_it_is_stated_is_left_there(track, sensors):
    arm = arm_of(track, sensors)
    assert np.abs(arm.error[:2]).max() < 0.05
    assert (np.abs(arm.error) < 4 * deviations(arm)).all()
    assert deviations(arm)[:2].max() < 0.05


def test_an_antenna_stated_elsewhere_is_found_and_stays_found(track, sensors):
    wrong = np.array([0.4, -0.3, 0.0])
    off = replace(sensors, gnss=move_antenna(sensors.gnss, wrong))
    assert off.gnss.lever_arm_m == pytest.approx((0.6, -0.4, 0.8))
    arm = arm_of(track, off, height_std_m=0.05)
    assert arm.error[:2] == pytest.approx(-wrong[:2], abs=0.05)
    mended = replace(off, gnss=move_antenna(off.gnss, arm.error[:3]))
    again = arm_of(track, mended, arm.error[:3], height_std_m=0.05)
    assert again.error == pytest.approx(arm.error, abs=1e-3)


def test_a_lag_is_told_from_an_antenna_further_back_by_the_changes_of_speed(track, sensors):
    """Fixes whose stamps are late by 0.1 s: each place was left 0.1 s before its stamp."""
    late = replace(sensors.gnss, stamp_ns=sensors.gnss.stamp_ns + 100_000_000)
    arm = arm_of(track, replace(sensors, gnss=late))
    assert arm.error[3] == pytest.approx(0.1, abs=0.03)
    assert np.abs(arm.error[:2]).max() < 0.06


def test_only_a_lag_that_is_sure_and_matters_is_believed(track, sensors):
    late_ns = round(0.2e9)
    late = replace(sensors.gnss, stamp_ns=sensors.gnss.stamp_ns + late_ns)
    lag_s, std_s = solve_lag([collect_arm_evidence(track, replace(sensors, gnss=late))], NOWHERE)
    assert lag_s == pytest.approx(0.2, abs=4 * std_s)
    assert solve_lag([collect_arm_evidence(track, sensors)], NOWHERE) is None
    assert solve_lag([None], NOWHERE) is None


def test_a_wrong_fix_now_and_then_and_for_a_while_moves_no_antenna(track, sensors):
    place = sensors.gnss.position_enu_m.copy()
    place[::50] += 3.0
    place[400:800] += [0.4, 0.3, 0.0]
    arm = arm_of(track, replace(sensors, gnss=replace(sensors.gnss, position_enu_m=place)))
    assert np.abs(arm.error[:2]).max() < 0.1


def test_what_only_two_windows_show_is_no_evidence(track, sensors):
    told = collect_arm_evidence(track, sensors)
    two = replace(told, matrix=told.matrix[:2], vector=told.vector[:2])
    assert solve_arm([two], np.zeros(3)) is None


def test_what_no_turn_shows_stays_unknown(track, sensors):
    """Straight ahead, an arm is but a constant: no evidence."""
    at_s = (track.stamp_ns - track.stamp_ns[0]) * 1e-9
    straight = replace(
        track,
        position_enu_m=np.outer(at_s, [0.8, 0.0, 0.0]),
        quat_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (at_s.size, 1)),
        velocity_enu_mps=np.tile([0.8, 0.0, 0.0], (at_s.size, 1)),
        angular_velocity_radps=np.zeros((at_s.size, 3)),
    )
    ahead = np.tile([0.8, 0.0, 0.0], (sensors.visual.stamp_ns.size, 1))
    fix_s = (sensors.gnss.stamp_ns - track.stamp_ns[0]) * 1e-9
    gnss = replace(sensors.gnss, position_enu_m=np.outer(fix_s, [0.8, 0.0, 0.0]) + sensors.gnss.lever_arm_m)
    visual = replace(sensors.visual, velocity_mps=ahead, lever_arm_m=(0.0, 0.0, 0.0))
    assert collect_arm_evidence(straight, Measurements(gnss=gnss, visual=visual)) is None


def test_an_axis_that_an_odometry_does_not_measure_moves_no_antenna(track, sensors):
    """A camera ahead of base_link goes sideways in turns; where that is said to be unmeasured, it is not taken for none."""
    velocity, variance = sensors.visual.velocity_mps.copy(), sensors.visual.variance_m2ps2.copy()
    velocity[:, 1], variance[:, 1] = 0.0, 1e6
    flat = replace(sensors.visual, velocity_mps=velocity, variance_m2ps2=variance, lever_arm_m=(0.4, 0.0, 0.4))
    arm = arm_of(track, replace(sensors, visual=flat))
    assert np.abs(arm.error[:2]).max() < 0.06


def test_wheels_do_not_see_where_the_robot_turns_about(track, sensors):
    arm = arm_of(track, replace(sensors, visual=None))
    assert deviations(arm)[0] >= 0.03
    assert collect_arm_evidence(track, replace(sensors, visual=None, wheels=None)) is None
    assert collect_arm_evidence(track, replace(sensors, gnss=None)) is None
    assert solve_arm([], NOWHERE) is None


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0.0, 0.0), (0.0, 5.0), (4.0, -3.0)])
def test_a_tilted_imu_is_found(track, sensors, roll_deg, pitch_deg):
    unit = tilted(sensors.imu, roll_deg, pitch_deg)
    tilt = solve_tilt([collect_tilt_evidence(track, replace(sensors, imu=unit))])
    assert np.degrees(tilt.rad) == pytest.approx([roll_deg, pitch_deg], abs=1.0)
    assert (np.abs(np.degrees(tilt.rad) - [roll_deg, pitch_deg]) < 4 * np.degrees(tilt.std_rad)).all()
    assert np.degrees(tilt.std_rad).max() < 1.0


def test_without_fixes_or_force_nothing_tells_a_tilt(track, sensors):
    assert collect_tilt_evidence(track, replace(sensors, gnss=None)) is None
    assert collect_tilt_evidence(track, replace(sensors, imu=None)) is None
    assert collect_tilt_evidence(track, replace(sensors, imu=replace(sensors.imu, accelerometer_usable=False))) is None
    assert solve_tilt([]) is None


def test_what_is_not_known_of_an_arm_turns_with_the_robot(track, sensors):
    """An arm known to 0.3 m ahead: of a robot that looks north, north is unknown."""
    north = replace(
        track,
        quat_xyzw=np.tile(Rotation.from_euler("z", 90, degrees=True).as_quat(), (track.stamp_ns.size, 1)),
        velocity_enu_mps=np.tile([0.0, 0.9, 0.0], (track.stamp_ns.size, 1)),
    )
    doubted = add_antenna_uncertainty(north, np.diag([0.09, 0.0, 0.0]), sensors.gnss)
    assert doubted.position_std_m[:, 0] == pytest.approx(0.01)
    assert doubted.position_std_m[:, 1] == pytest.approx(np.hypot(0.01, 0.3))


def test_an_arms_error_that_goes_round_with_the_robot_is_an_error_of_ways_and_speeds_along_them(track, sensors):
    """An antenna known to 0.1 m sideways on a circle: the chord is off by both ends' difference, 2 sin(half the turn), along itself."""
    turn_radps, speed_mps = 0.5, 1.0
    at_s = (track.stamp_ns - track.stamp_ns[0]) * 1e-9
    yaw, radius_m, zero = turn_radps * at_s, speed_mps / turn_radps, np.zeros(at_s.size)
    round_ = replace(
        track,
        position_enu_m=radius_m * np.column_stack((np.sin(yaw), -np.cos(yaw), zero)),
        quat_xyzw=Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]).as_quat(),
        velocity_enu_mps=speed_mps * np.column_stack((np.cos(yaw), np.sin(yaw), zero)),
        angular_velocity_radps=np.column_stack((zero, zero, zero + turn_radps)),
        displacement_std_m=np.full_like(track.displacement_std_m, 1e-4),
        forward_velocity_std_mps=zero,
    )
    fixes = replace(sensors.gnss, variance_m2=np.full_like(sensors.gnss.variance_m2, 1e-8))
    doubted = add_antenna_uncertainty(round_, np.diag([0.0, 0.01, 0.0]), fixes)
    assert doubted.forward_velocity_std_mps == pytest.approx(np.full(at_s.size, 0.1 * turn_radps))
    expected = 0.1 * 2.0 * np.sin(turn_radps * np.array([0.5, 1.0, 2.0, 4.0]) / 2.0)
    assert doubted.displacement_std_m[:-100] == pytest.approx(np.tile(expected, (at_s.size - 100, 1)), rel=1e-5)
    ahead = add_antenna_uncertainty(round_, np.diag([0.01, 0.0, 0.0]), fixes)
    assert ahead.displacement_std_m == pytest.approx(1e-4, abs=1e-9)
    metres = replace(sensors.gnss, variance_m2=np.full_like(sensors.gnss.variance_m2, 1.0))  # odometry tells the way
    assert add_antenna_uncertainty(round_, np.diag([0.0, 0.01, 0.0]), metres).displacement_std_m == pytest.approx(
        1e-4, rel=1e-3
    )


def test_a_tilt_that_is_known_so_well_moves_an_antenna_above_it():
    assert estimate_antenna_uncertainty(None, None, (0.0, 0.0, 1.0)) is None
    tilt = Tilt(np.array([0.09, -0.03]), np.array([0.02, 0.01]))
    doubt = estimate_antenna_uncertainty(make_unknown_arm(), tilt, (0.0, 0.0, 0.9))
    assert np.diag(doubt) == pytest.approx([0.25 + 0.009**2, 0.25 + 0.018**2, 0.25])
    rolled = estimate_antenna_uncertainty(
        None, replace(tilt, rad=np.array([0.09, 0.0])), (0.0, 0.0, 0.9)
    )  # its pitch is as it is stated
    assert np.diag(rolled) == pytest.approx([0.0, 0.018**2, 0.0])


def test_a_roll_that_no_turn_shows_stays_nothing(track, sensors):
    """Straight ahead the gyroscope's own drift, alike about both axes, would be a roll, and sure."""
    at_s = (sensors.imu.stamp_ns - sensors.imu.stamp_ns[0]) * 1e-9
    drift = np.outer(np.sin(at_s / 60.0), [0.0, 0.03, 0.01])
    straight = replace(sensors.imu, angular_velocity_radps=drift)
    tilt = solve_tilt([collect_tilt_evidence(track, replace(sensors, imu=straight))])
    assert tilt.rad[0] == 0.0
    assert np.degrees(tilt.std_rad[0]) == pytest.approx(1.0, rel=0.01)
    rows = np.full(60, 200.0)
    turning = TiltEvidence(rows * 0.1**2, rows * 0.1**2 * np.radians(5.0), rows, np.zeros(60))
    assert np.degrees(solve_tilt([turning]).rad[0]) == pytest.approx(5.0)


def test_levelling_undoes_a_tilt(sensors):
    there_and_back = level_imu(tilted(sensors.imu, 4.0, -3.0), np.radians([4.0, -3.0]))
    for name in ("angular_velocity_radps", "specific_force_mps2"):
        assert getattr(there_and_back, name) == pytest.approx(getattr(sensors.imu, name), abs=1e-9)
