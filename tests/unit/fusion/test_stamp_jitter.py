"""Jitter of GNSS stamps seen from the wheels."""

from dataclasses import replace

import numpy as np
import pytest
from unit.fusion import drive

from tcpipe.fusion.preparation import inflate_jittery_fixes


def test_clean_fixes_show_none_also_with_outliers_slip_and_stops():
    measurements = drive.measure(drive.make_drive(150.0), 8)
    assert np.mean(inflate_jittery_fixes(measurements.gnss, measurements.wheels)[1] > 0) < 0.02


def test_late_fixes_are_seen_and_their_variance_raised_while_driving():
    truth = drive.make_drive(150.0)
    measurements = drive.measure(truth, 8, gnss_hz=2.5)
    stamp = measurements.gnss.stamp_ns
    late = stamp + (np.random.default_rng(9).uniform(0, 0.35, stamp.size) * 1e9).astype(np.int64)  # deviation 0.10 s
    gnss = replace(measurements.gnss, stamp_ns=late)
    raised, jitter = inflate_jittery_fixes(gnss, measurements.wheels)
    assert np.median(jitter) == pytest.approx(0.10, abs=0.03)
    speed = np.abs(np.interp(late, drive.ns(truth.t), truth.forward))
    assert (raised.variance_m2[speed > 0.7, 0] > 0.1**2).mean() > 0.9
    assert (raised.variance_m2[speed < 0.01, 0] < 0.05**2).mean() > 0.9
    assert (raised.variance_m2[:, 2] == gnss.variance_m2[:, 2]).all()
