"""The order of events, and what lies between them."""

from dataclasses import replace

import numpy as np
import pytest
from unit.fusion import drive

from tcpipe.fusion import state_kernel as kernel
from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.fusion.timeline import build_timeline
from tcpipe.fusion.trajectory import cut_sections, make_track_stamps

NOBODY = np.empty((0, 2), np.int64)


def ramp_imu(stamp_ns):
    """Angular velocity that grows by 1 rad/s each second, force that is constant."""
    t = (stamp_ns - stamp_ns[0]) * 1e-9
    force = np.tile([0.0, 0.0, 9.8], (t.size, 1))
    return InertialMeasurements(
        stamp_ns, np.column_stack((0 * t, 0 * t, t)), force, np.full((t.size, 4), np.nan), 0.003, 0.1
    )


def fixes(stamp_ns):
    return Positions(stamp_ns, np.zeros((stamp_ns.size, 3)), np.ones((stamp_ns.size, 3)))


def test_events_are_sorted_wanted_stamps_last_steps_short():
    stamp = np.arange(0, 3_000_000_000, 500_000_000, dtype=np.int64)
    measurements = Measurements(
        gnss=fixes(stamp), imu=ramp_imu(np.arange(0, 3_000_000_000, 10_000_000, dtype=np.int64))
    )
    output = np.arange(0, 2_600_000_000, 250_000_000, dtype=np.int64)
    timeline = build_timeline(measurements, NOBODY, output)
    assert (np.diff(timeline.stamp_ns) >= 0).all()
    assert timeline.dt_s.max() <= 0.0500001
    wanted = np.flatnonzero(timeline.output >= 0)
    assert timeline.output[wanted].tolist() == list(range(output.size))
    assert timeline.stamp_ns[wanted].tolist() == output.tolist()
    for k in wanted:
        assert not (timeline.stamp_ns[k + 1 : k + 5] == timeline.stamp_ns[k]).any()
    assert np.sum(timeline.kind == kernel.GNSS_POSITION) == stamp.size
    assert np.sum(timeline.kind == kernel.SIDEWAYS) == pytest.approx(25, abs=1)
    assert np.sum(timeline.kind == kernel.LEVEL) == 0
    # The mean of the ramp over a step is its value in the middle.
    moved = timeline.dt_s > 0
    middle = timeline.stamp_ns * 1e-9 - timeline.dt_s / 2
    assert timeline.turn_rate_radps[moved, 2] == pytest.approx(middle[moved], abs=1e-9)
    assert timeline.turn_rate_now_radps[:, 2] == pytest.approx(timeline.stamp_ns * 1e-9, abs=1e-9)
    assert (timeline.mode[moved] == kernel.INERTIAL).all()


def test_a_gap_of_the_imu_changes_the_process_there_only():
    stamp = np.arange(0, 3_000_000_000, 10_000_000, dtype=np.int64)
    holed = stamp[(stamp <= 1_000_000_000) | (stamp >= 1_500_000_000)]
    timeline = build_timeline(Measurements(gnss=fixes(stamp[::10]), imu=ramp_imu(holed)), NOBODY, stamp[10:-10:50])
    end = timeline.stamp_ns
    start = end - np.rint(timeline.dt_s * 1e9).astype(np.int64)
    hole = (end > 1_000_000_000) & (start < 1_500_000_000)
    assert (timeline.mode[hole] == kernel.FLAT_TURN).all()
    assert (timeline.mode[~hole] == kernel.INERTIAL).all()


def test_the_constraint_and_a_lasting_error_carry_the_same_information_at_any_rate_of_the_wheels():
    truth = drive.make_drive(20.0)
    measurements = drive.measure(truth, 6)
    smooth = measurements.wheels.velocity_mps.copy()
    smooth[:, 0] = 1.0  # scatters by nothing of what its variance claims
    lasting = replace(measurements, wheels=replace(measurements.wheels, velocity_mps=smooth))
    timeline = build_timeline(lasting, NOBODY, drive.ns(np.arange(1.0, 19.0)))
    wheels = timeline.kind == kernel.WHEEL_VELOCITY
    rate_hz = wheels.sum() / 20.0
    assert np.sum(1 / timeline.variance[wheels, 1]) / 20.0 == pytest.approx(10.0 / 0.15**2, rel=0.02)
    assert np.sum(1 / timeline.variance[wheels, 0]) / 20.0 == pytest.approx(10.0 / 0.03**2, rel=0.02)
    assert rate_hz == pytest.approx(50.0, abs=1)
    scattering = build_timeline(measurements, NOBODY, drive.ns(np.arange(1.0, 19.0)))
    assert np.sum(1 / scattering.variance[wheels, 0]) / 20.0 == pytest.approx(50.0 / 0.03**2, rel=0.15)
    assert not (timeline.kind == kernel.SIDEWAYS).any()


def test_standing_measures_velocity_and_bias():
    stamp = np.arange(0, 3_000_000_000, 10_000_000, dtype=np.int64)
    imu = ramp_imu(stamp)
    standing = np.array([[1_000_000_000, 1_900_000_000]], np.int64)
    timeline = build_timeline(Measurements(gnss=fixes(stamp[::10]), imu=imu), standing, stamp[10:-10:50])
    assert np.sum(timeline.kind == kernel.STANDING) == 5
    rate = timeline.kind == kernel.STANDING_RATE
    assert timeline.value[rate, 2] == pytest.approx(timeline.stamp_ns[rate] * 1e-9, abs=1e-9)


def test_without_an_accelerometer_the_robot_is_about_level_and_the_odometry_turns_it():
    truth = drive.make_drive(20.0)
    measurements = drive.measure(truth, 6, imu=False)
    timeline = build_timeline(measurements, NOBODY, drive.ns(np.arange(1.0, 19.0)))
    assert np.sum(timeline.kind == kernel.LEVEL) == pytest.approx(20, abs=1)
    t = (timeline.stamp_ns - drive.ZERO_NS) * 1e-9
    true = 0.8 * np.interp(t, truth.t, truth.rate[:, 2])  # these wheels turn less than they say
    assert np.sqrt(np.mean((timeline.turn_rate_now_radps[:, 2] - true) ** 2)) < 0.03


S = 1_000_000_000


def wheels(stamp):
    stamp = np.asarray(stamp, np.int64)
    three = np.zeros((stamp.size, 3))
    return BodyVelocities(stamp, three, three + 1, three[:, 0], three[:, 0] + 1)


def imu(stamp):
    stamp = np.asarray(stamp, np.int64)
    three = np.zeros((stamp.size, 3))
    return InertialMeasurements(stamp, three, three, np.zeros((stamp.size, 4)), 0.003, 0.1)


def gnss(stamp):
    stamp = np.asarray(stamp, np.int64)
    return Positions(stamp, np.zeros((stamp.size, 3)), np.ones((stamp.size, 3)))


def grid(a, b, step):
    return np.arange(a, b, step, dtype=np.int64)


def test_epochs_and_long_pauses_cut():
    first = Measurements(wheels=wheels(np.concatenate((grid(0, 10 * S, S // 10), grid(100 * S, 110 * S, S // 10)))))
    # The clock was set back: stamps of the second epoch overlap those of the first.
    second = Measurements(wheels=wheels(grid(5 * S, 9 * S, S // 10)), gnss=gnss([6 * S]))
    found = cut_sections({1: second, 0: first})
    assert [(s.clock_epoch, s.start_ns // S, -(-s.end_ns // S)) for s in found] == [
        (0, 0, 10),
        (0, 100, 110),
        (1, 5, 9),
    ]
    assert found[0].measurements.wheels.stamp_ns.size == 100
    assert found[0].measurements.gnss is None
    assert found[2].measurements.gnss.stamp_ns.size == 1


def test_the_imu_bridges_a_pause_but_is_no_motion_by_itself():
    stamps = np.concatenate((grid(0, 10 * S, S // 10), grid(20 * S, 30 * S, S // 10)))
    bridged = Measurements(wheels=wheels(stamps), imu=imu(grid(0, 40 * S, S // 100)))
    found = cut_sections({0: bridged})
    assert len(found) == 1
    assert found[0].end_ns == stamps[-1]
    assert cut_sections({0: Measurements(imu=imu(grid(0, 9 * S, S // 100)))}) == []


def test_stamps_are_multiples_of_the_period_and_gaps_are_left_out():
    zero = 1_700_000_000 * S
    stamps = zero + 17_000_000 + np.concatenate((grid(0, 2 * S, S // 50), grid(4 * S, 5 * S, S // 50)))
    (stretch,) = cut_sections({0: Measurements(wheels=wheels(stamps))})
    found = make_track_stamps(stretch, period_ns=50_000_000, max_gap_ns=S)
    assert (found % 50_000_000 == 0).all()
    assert found[0] == zero + 50_000_000
    assert found[-1] <= stamps[-1]
    step = np.diff(found)
    assert np.unique(step).tolist() == [50_000_000, 2_100_000_000]
    # A gap no longer than allowed stays.
    assert (np.diff(make_track_stamps(stretch, period_ns=50_000_000, max_gap_ns=3 * S)) == 50_000_000).all()


def test_a_slow_sensor_has_no_gaps_of_its_own_making():
    (stretch,) = cut_sections({0: Measurements(gnss=gnss(grid(0, 60 * S, 2 * S)), imu=imu(grid(0, 60 * S, S // 50)))})
    assert (np.diff(make_track_stamps(stretch, period_ns=50_000_000, max_gap_ns=S)) == 50_000_000).all()
