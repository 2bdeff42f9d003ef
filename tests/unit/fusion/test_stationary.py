"""Standing against the truth of a drive that stops."""

import numpy as np
from unit.fusion import drive

from tcpipe.fusion.initial import find_stationary_intervals


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
