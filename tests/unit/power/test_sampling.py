"""Repeated readings are distinguished from a slow or coarse signal that was measured for every message."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from tcpipe.power.rails import make_samples
from tcpipe.power.sampling import (
    DELAY_MARGIN_S,
    SMOOTHING_MARGIN_S,
    estimate_smoothing_variance,
    find_delay,
    find_readings,
    find_smoothing,
    is_stated_averaged,
    make_power_fit,
)
from tcpipe.simulation import Faults, make_tiny, simulate_readings
from tcpipe.simulation.sensors import Power

COUNT = 6000
AT_NS = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(COUNT, dtype=np.int64)


def wandering(count, rows, rng):
    """Return a signal of unit variance that is forgotten within so many rows."""
    kept = np.exp(-1.0 / rows)
    return lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], rng.standard_normal(count))


def repeated(reading_hz, *, step, jitter=0.0, seed=1):
    """Return the estimate from messages at 20 Hz of a device with another rate, and the rows of its readings."""
    rng = np.random.default_rng(seed)
    period_s = 1.0 / reading_hz
    read_s = np.arange(0.37 * period_s, COUNT / 20, period_s)
    read_s = read_s + jitter * period_s * rng.uniform(-1, 1, read_s.size)
    value = np.round((5.0 + 1.5 * wandering(10 * COUNT, 60, rng)[(read_s * 200).astype(int)]) / step) * step
    last = np.maximum(np.searchsorted(read_s, np.arange(COUNT) / 20, "right") - 1, 0)
    return value[last], np.flatnonzero(np.diff(last)) + 1


@pytest.mark.parametrize("step", [0.01, 0.5])
@pytest.mark.parametrize("jitter", [0.0, 0.1])
@pytest.mark.parametrize("reading_hz", [0.5, 3.0, 8.0, 10.0])
def test_readings_are_found_at_the_first_message_that_holds_them(reading_hz, jitter, step):
    value, arrivals = repeated(reading_hz, step=step, jitter=jitter)
    rows = find_readings(AT_NS, value[:, None])
    assert len(rows) == pytest.approx(len(arrivals), rel=0.02)
    assert set(np.flatnonzero(np.diff(value)) + 1) <= set(rows)
    # A reading that equals the last shows no change: it is expected to within a part of its period.
    aside = np.abs(rows - arrivals[np.abs(rows[:, None] - arrivals).argmin(axis=1)])[1:-1]
    assert aside.max() <= max(1.0, 0.3 * 20 / reading_hz)


@pytest.mark.parametrize("step", [0.02, 0.3, 2.0])
@pytest.mark.parametrize("rows", [1, 10, 100, 1000])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_coarse_signal_is_no_repeated_one(rows, step, noise):
    rng = np.random.default_rng(3)
    value = np.round((5.0 + wandering(COUNT, rows, rng) + noise * rng.standard_normal(COUNT)) / step) * step
    assert find_readings(AT_NS, value[:, None]) is None


@pytest.mark.parametrize("share", [0.01, 0.05, 0.1, 0.25, 0.5])
def test_levels_that_change_at_irregular_times_are_no_repeated_readings(share):
    rng = np.random.default_rng(5)
    for _ in range(8):
        value = np.cumsum((rng.random(COUNT) < share) * rng.integers(-4, 5, COUNT)) * 0.1
        assert find_readings(AT_NS, value[:, None]) is None


@pytest.mark.parametrize("step", [0.1, 1.0])
def test_a_ramp_and_an_oscillation_pass_from_level_to_level(step):
    at_s = np.arange(COUNT) / 20
    for value in (24.0 - 0.05 * at_s, 5.0 + 1.3 * np.sin(0.3 * at_s), 5.0 + 1.3 * np.sin(2.4 * at_s)):
        assert find_readings(AT_NS, (np.round(value / step) * step)[:, None]) is None


def test_of_missing_messages_the_next_reading_is_no_older_than_it_says():
    value, arrivals = repeated(1.0, step=0.01)
    kept = np.ones(COUNT, bool)
    kept[::97] = False
    kept[3005:3066] = False  # three readings are lost
    rows = np.flatnonzero(kept)[find_readings(AT_NS[kept], value[kept, None])]
    assert len(rows) == pytest.approx(len(arrivals) - 3, abs=2)
    assert not set(rows) & set(range(3066, arrivals[arrivals > 3066][0]))
    assert np.abs(rows[1:-1, None] - arrivals).min(axis=1).max() <= 1


def test_twenty_readings_are_too_few():
    value, _ = repeated(1.0, step=0.01)
    assert find_readings(AT_NS[:400], value[:400, None]) is None
    assert find_readings(AT_NS[:1], value[:1, None]) is None


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


def drive_by_formula(seed):
    """Return motion at 20 Hz (forward velocity, yaw rate, rate of climb), and power that follows it and the ground [W]."""
    rng = np.random.default_rng(seed)
    forward = np.clip(0.8 + 0.5 * wandering(COUNT, 80, rng), 0.0, 1.2)
    turning, climb = 0.3 * wandering(COUNT, 40, rng), 0.1 * forward * wandering(COUNT, 100, rng)
    power = 40.0 + 90.0 * forward + 30.0 * np.abs(turning) + 900.0 * climb + 15.0 * wandering(COUNT, 40, rng)
    return np.column_stack((forward, turning, climb)), power


def average_before(values, seconds):
    sums = np.cumsum(np.concatenate((np.full(20 * seconds, values[0]), values)))
    return (sums[20 * seconds :] - sums[: -20 * seconds]) / (20 * seconds)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("seconds", [2, 4, 8])
def test_smoothing_is_found_with_its_width_and_what_it_hides(seed, seconds):
    motion, power = drive_by_formula(seed)
    smooth = make_samples(AT_NS, average_before(power, seconds))
    found = find_smoothing(make_power_fit(smooth, AT_NS, motion, averaged=False, margin_s=SMOOTHING_MARGIN_S))
    assert found.width_s == pytest.approx(seconds, rel=0.3)
    assert found.after_s == 0.0
    hidden = power - smooth.value
    assert estimate_smoothing_variance(smooth, np.ones(COUNT, bool), found) == pytest.approx(
        np.mean(hidden**2), rel=0.5
    )


@pytest.mark.parametrize("seconds", [2, 4])
def test_a_delay_that_the_recipe_corrects_leaves_a_mean_about_the_stamp(seconds):
    motion, power = drive_by_formula(4)
    corrected_s = -seconds / 2
    moved = make_samples(AT_NS + round(1e9 * corrected_s), average_before(power, seconds))
    found = find_smoothing(
        make_power_fit(moved, AT_NS, motion, averaged=False, margin_s=SMOOTHING_MARGIN_S), corrected_s=corrected_s
    )
    assert found.before_s == pytest.approx(found.after_s, rel=0.5)
    hidden = np.mean((moved.value[20 * seconds :] - power[10 * seconds : -10 * seconds]) ** 2)
    assert estimate_smoothing_variance(moved, np.ones(COUNT, bool), found) == pytest.approx(hidden, rel=0.6)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 0.3], ids=["motion is known", "motion is noisy"])
def test_power_as_it_is_and_noisy_motion_are_no_smoothing(seed, noise):
    motion, power = drive_by_formula(seed)
    motion = motion + noise * motion.std(0) * np.random.default_rng(seed).standard_normal(motion.shape)
    for averaged in (False, True):
        assert (
            find_smoothing(
                make_power_fit(
                    make_samples(AT_NS, power), AT_NS, motion, averaged=averaged, margin_s=SMOOTHING_MARGIN_S
                )
            )
            is None
        )
    slow = slice(None, None, 20)  # a mean of a second, as the source states
    mean = make_samples(AT_NS[slow], average_before(power, 1)[slow])
    assert find_smoothing(make_power_fit(mean, AT_NS, motion, averaged=True, margin_s=SMOOTHING_MARGIN_S)) is None


@pytest.mark.parametrize("seed", [4, 6, 7, 11, 13])
def test_power_that_wanders_slowly_in_a_short_record_is_no_smoothing(seed):
    motion, at_ns = drive_by_formula(seed)[0][:1800], AT_NS[:1800]
    ground = 60.0 * wandering(COUNT, 200, np.random.default_rng(seed + 100))[:1800]
    power = make_samples(at_ns, 90.0 * motion[:, 0] + ground)
    assert find_smoothing(make_power_fit(power, at_ns, motion, averaged=False, margin_s=SMOOTHING_MARGIN_S)) is None


def find_delay_of(power, motion, delay_s, *, rate_hz=20.0):
    rows = slice(None, None, round(20.0 / rate_hz))
    late = make_samples(AT_NS[rows] + round(1e9 * delay_s), power[rows])
    return find_delay(make_power_fit(late, AT_NS, motion, averaged=False, margin_s=DELAY_MARGIN_S))


@pytest.mark.parametrize("rate_hz", [1.0, 20.0])
@pytest.mark.parametrize("delay_s", [-0.3, 0.0, 0.1, 0.36, 1.0])
def test_a_delay_is_found_within_its_uncertainty(delay_s, rate_hz):
    for seed in range(3):
        motion, power = drive_by_formula(seed)
        found_s, std_s = find_delay_of(power, motion, delay_s, rate_hz=rate_hz)
        assert abs(found_s - delay_s) < max(3.0 * std_s, 0.01)
        assert std_s < 0.15


def test_power_that_the_motion_does_not_explain_has_no_delay():
    motion, power = drive_by_formula(1)
    other = 40.0 + 15.0 * wandering(COUNT, 40, np.random.default_rng(9))
    assert find_delay_of(other, motion, 0.36) is None
    assert find_delay_of(power, motion[:, [0, 1, 1]] * [1, 1, 0], 0.36) is None  # hills whose slopes are unknown
    assert find_delay_of(np.full(COUNT, 40.0), motion, 0.36) is None
    assert find_delay_of(power, 0.0 * motion, 0.36) is None
