"""Vibration against scipy's Butterworth filter and against sines whose root mean square is known."""

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from tcpipe.motion.vibration import compute_vibration_mps2

ZERO = 1_700_000_000_000_000_000
GRAVITY = np.array([0.0, 0.0, 9.81])


def at(seconds):
    return ZERO + np.round(np.atleast_1d(seconds) * 1e9).astype(np.int64)


def imu(rate_hz, duration_s=40.0):
    return np.arange(0.0, duration_s, 1.0 / rate_hz)


@pytest.mark.parametrize("rate_hz", [50, 100, 400])
@pytest.mark.parametrize(("frequency_hz", "passes"), [(0.3, 0.0), (3.0, 0.5), (8.0, 1.0), (20.0, 0.5)])
def test_a_sine_passes_as_far_as_it_lies_in_the_band_at_any_rate(rate_hz, frequency_hz, passes):
    t = imu(rate_hz)
    force = GRAVITY + np.outer(np.sin(2 * np.pi * frequency_hz * t), [0.6, 0.0, 0.8])
    found, _ = compute_vibration_mps2(at(t), force, at([10.0, 20.0]), at([15.0, 25.0]))
    assert found == pytest.approx(passes / np.sqrt(2), abs=0.01)


def test_noise_is_filtered_as_a_butterworth_forwards_and_backwards():
    t = imu(200.0)
    force = GRAVITY + np.random.default_rng(1).normal(0.0, 0.4, (t.size, 3))
    begin, end = np.arange(5.0, 34.0, 1.2), np.arange(5.0, 34.0, 1.2) + 1.2
    found, _ = compute_vibration_mps2(at(t), force, at(begin), at(end))
    sections = butter(4, [3.0, 20.0], "bandpass", fs=200.0, output="sos")
    square = (sosfiltfilt(sections, force, axis=0) ** 2).sum(axis=1)
    wanted = [np.sqrt(square[(t > a + 1e-9) & (t <= b + 1e-9)].mean()) for a, b in zip(begin, end, strict=True)]
    assert found == pytest.approx(np.array(wanted), rel=0.05)  # the digital filter bends frequencies


def test_how_the_sensor_is_turned_and_tilted_does_not_count():
    t = imu(100.0)
    shake = np.outer(np.sin(2 * np.pi * 9.0 * t), [0.0, 0.0, 0.5])
    tilted = np.column_stack((9.81 * np.sin(0.3 * np.sin(t)), 0 * t, 9.81 * np.cos(0.3 * np.sin(t))))
    level, _ = compute_vibration_mps2(at(t), GRAVITY + shake, at(12.0), at(13.0))
    swaying, _ = compute_vibration_mps2(at(t), tilted + shake[:, [2, 0, 1]], at(12.0), at(13.0))
    assert swaying == pytest.approx(level, rel=0.01)


def test_nothing_is_said_of_gaps_nor_beyond_the_record():
    t = imu(100.0)
    t = t[(t < 20.0) | (t > 20.2)]
    force = GRAVITY + np.random.default_rng(2).normal(0.0, 0.4, (t.size, 3))
    begin = np.array([-1.0, 10.0, 18.9, 19.5, 20.05, 20.4, 21.0, 39.5])
    found, _ = compute_vibration_mps2(at(t), force, at(begin), at(begin + 1.0))
    assert np.isfinite(found).tolist() == [False, True, False, False, False, False, True, False]


def test_a_sensor_below_50_hz_tells_none_and_a_repeated_stamp_counts_once():
    t = imu(40.0)
    assert np.isnan(compute_vibration_mps2(at(t), GRAVITY + np.zeros((t.size, 3)), at(5.0), at(6.0))).all()
    t = imu(100.0)
    force = GRAVITY + np.random.default_rng(3).normal(0.0, 0.4, (t.size, 3))
    twice = np.repeat(np.arange(t.size), 1 + (np.arange(t.size) % 7 == 0))
    once, _ = compute_vibration_mps2(at(t), force, at(5.0), at(6.0))
    assert compute_vibration_mps2(at(t[twice]), force[twice], at(5.0), at(6.0))[0] == pytest.approx(once, rel=1e-12)
    assert np.isnan(compute_vibration_mps2(at(t[:2]), force[:2], at(0.0), at(0.01))).all()


@pytest.mark.parametrize("duration_s", [0.5, 1.2, 3.0])
@pytest.mark.parametrize("band_hz", [(0.1, 40.0), (4.0, 6.0)])
def test_the_standard_deviation_covers_the_variation_between_segments_of_the_same_ground(duration_s, band_hz):
    t = imu(100.0, 400.0)
    noise = np.random.default_rng(3).normal(0.0, 1.0, (t.size, 3))
    shake = sosfiltfilt(butter(2, band_hz, "bandpass", fs=100.0, output="sos"), noise, axis=0)
    begin = np.arange(5.0, 390.0, duration_s)
    found, std = compute_vibration_mps2(at(t), GRAVITY + shake, at(begin), at(begin + duration_s))
    off = np.abs(found - np.sqrt((found**2).mean())) / std
    assert 0.8 < np.sqrt(np.mean(off**2)) < 1.2
    assert 0.90 < (off < 2.0).mean() < 0.99
