"""Whether power is averaged, told by the motion of simulated drives."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.power.sampling import is_stated_averaged
from tcpipe.simulation import Faults, make_tiny, simulate_readings
from tcpipe.simulation.sensors import Power

FAULTS = Faults.only("wheel_slip", "wheel_noise", "power_noise")


def test_a_mean_of_a_second_is_told_and_a_sample_never_taken_for_one():
    said = {}
    for averaged in (True, False):
        site = make_tiny(FAULTS, seconds=200.0)
        power = Power(rate_hz=1.0, averaged=averaged)
        drive = replace(site.drives[0], sensors=replace(site.drives[0].sensors, power=power))
        _, readings = simulate_readings(replace(site, drives=(drive,)), seed=3)
        drawn, wheels = readings["power"], readings["wheels"]
        watt = drawn.values["voltage_volt"] * (drawn.values["left_amp"] + drawn.values["right_amp"])
        motion = (wheels.values["velocity_mps"], wheels.values["yaw_rate_radps"])
        said[averaged] = is_stated_averaged(drawn.stamp_ns, watt, wheels.stamp_ns, *motion)
    assert said[True] is True
    assert said[False] is not True


def drawn_by(late_s: float, width_s: float):
    """Power at 1 Hz that follows a speed of two tones, late by so much and over such a width; and the motion at 50 Hz."""
    motion_s = np.arange(0.0, 200.0, 0.02)
    speed = 1.0 + 0.4 * np.sin(1.1 * motion_s) + 0.3 * np.sin(2.3 * motion_s)
    power_s = np.arange(2.0, 198.0)
    ago_s = late_s + width_s * (np.arange(50) + 0.5) / 50
    watt = 80.0 + 150.0 * np.interp((power_s[:, None] - ago_s).ravel(), motion_s, speed).reshape(-1, 50).mean(1)
    return (power_s * 1e9).astype(np.int64), watt, (motion_s * 1e9).astype(np.int64), speed, 0.0 * speed


@pytest.mark.parametrize(("late_s", "width_s", "wanted"), [(0.0, 1.0, True), (0.0, 0.0, False), (3.0, 0.0, None)])
def test_by_a_formula(late_s, width_s, wanted):
    assert is_stated_averaged(*drawn_by(late_s, width_s)) is wanted


def test_too_little_tells_nothing():
    assert is_stated_averaged(*(values[:40] for values in drawn_by(0.0, 1.0))) is None
    assert is_stated_averaged(*(values[:0] for values in drawn_by(0.0, 1.0))) is None
