"""Cutting a run, and the stamps of its track."""

import numpy as np

from tcpipe.fusion.measurements import BodyVelocities, InertialMeasurements, Measurements, Positions
from tcpipe.fusion.trajectory import cut_sections, make_track_stamps

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
    assert [(s.epoch, s.start_ns // S, -(-s.end_ns // S)) for s in found] == [(0, 0, 10), (0, 100, 110), (1, 5, 9)]
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
