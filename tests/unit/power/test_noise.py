"""The energy's deviation against the scatter of many noisy, sampled or rounded records of one truth."""

import tracemalloc

import numpy as np
import pytest
from made_tracks import stamps
from scipy.signal import lfilter

from tcpipe.power.noise import (
    estimate_energy_noise,
    estimate_resolution,
    fit_signal_model,
)
from tcpipe.power.rails import SampledSignal, integrate_energy, make_rail, make_samples

ZERO = stamps(1)[0]
STARTS = ZERO + (np.arange(5, 595, 1.3) * 1e9).astype(np.int64)
ENDS = STARTS + 1_200_000_000

NEVER_STILL = np.empty((0, 2), dtype=np.int64)


def energy_noise_joule(rails, start_ns, end_ns):
    return estimate_energy_noise(rails, start_ns, end_ns, NEVER_STILL).std_joule()


def record(t, amp, *, averaged=False):
    stamp_ns = ZERO + np.round(t * 1e9).astype(np.int64)
    return make_rail(
        "drive", make_samples(stamp_ns, np.full(len(t), 24.0)), make_samples(stamp_ns, amp), averaged=averaged
    )


def test_white_noise_of_samples():
    t = np.arange(0, 600, 0.05)
    made = [record(t, 6 + np.random.default_rng(1).normal(0, 0.5, len(t)))]
    error = integrate_energy(made, STARTS, ENDS, rule="exact") - 24 * 6 * 1.2
    got = energy_noise_joule(made, STARTS, ENDS)
    assert np.sqrt((got**2).mean()) == pytest.approx(error.std(), rel=0.1)


@pytest.mark.parametrize("period_s", [0.05, 0.2, 1.0])
def test_a_rough_current_sampled_slowly(period_s):
    # A current with a correlation time of 20 ms: what falls between two samples is lost.
    rng = np.random.default_rng(2)
    fine, decay = 0.005, np.exp(-0.005 / 0.02)
    amp = 6 + lfilter([np.sqrt(1 - decay**2)], [1, -decay], rng.normal(0, 3.0, 120_000))
    t = np.arange(120_000) * fine
    truth = integrate_energy([record(t, amp)], STARTS, ENDS, rule="exact")
    step = round(period_s / fine)
    made = [record(t[::step], amp[::step])]
    error = integrate_energy(made, STARTS, ENDS, rule="exact") - truth
    got = energy_noise_joule(made, STARTS, ENDS)
    assert 0.9 < np.sqrt((got**2).mean()) / error.std() < 1.5


@pytest.mark.parametrize("white_amp", [0.0, 0.15, 0.5])
def test_a_current_that_the_sampling_resolves_with_noise_on_top(white_amp):
    rng = np.random.default_rng(5)
    fine, decay = 0.005, np.exp(-0.005 / 0.15)
    amp = 6 + lfilter([np.sqrt(1 - decay**2)], [1, -decay], rng.normal(0, 1.5, 120_000))
    t = np.arange(120_000) * fine
    truth = integrate_energy([record(t, amp)], STARTS, ENDS, rule="exact")
    made = [record(t[::10], amp[::10] + rng.normal(0, white_amp, 12_000))]
    error = integrate_energy(made, STARTS, ENDS, rule="exact") - truth
    got = energy_noise_joule(made, STARTS, ENDS)
    assert np.sqrt((got**2).mean()) == pytest.approx(error.std(), rel=0.15)


def test_a_smooth_current_has_no_noise():
    t = np.arange(0, 600, 0.05)
    made = [record(t, 6 + np.sin(t / 5))]
    assert energy_noise_joule(made, STARTS, ENDS).max() < 0.02


def test_rounding_shows_as_resolution_and_noise_as_none():
    t = np.arange(0, 600, 0.05)
    rounded = np.round((6 + np.sin(t / 40)) / 0.5) * 0.5
    assert estimate_resolution(make_samples(stamps(len(t)), rounded)) == pytest.approx(0.5)
    assert estimate_resolution(make_samples(stamps(len(t)), np.random.default_rng(0).normal(0, 1, len(t)))) == 0
    made = [record(t, rounded)]
    error = integrate_energy(made, STARTS, ENDS, rule="exact") - integrate_energy(
        [record(t, 6 + np.sin(t / 40))], STARTS, ENDS, rule="exact"
    )
    got = energy_noise_joule(made, STARTS, ENDS)
    assert np.sqrt((got**2).mean()) == pytest.approx(error.std(), rel=0.25)


@pytest.mark.parametrize(("correlation_s", "white_amp"), [(0.02, 0.0), (0.15, 0.0), (0.15, 0.15), (2.0, 0.15)])
def test_means_err_by_their_noise_and_where_a_segment_divides_one(correlation_s, white_amp):
    rng = np.random.default_rng(6)
    fine, decay = 0.005, np.exp(-0.005 / correlation_s)
    amp = 6 + lfilter([np.sqrt(1 - decay**2)], [1, -decay], rng.normal(0, 1.5, 120_000))
    t = (np.arange(120_000) + 1) * fine
    amp[t > 540] = 1.0  # it stands
    moving = ENDS < ZERO + 535_000_000_000
    spans = STARTS[moving], ENDS[moving]
    truth = integrate_energy([record(t, amp, averaged=True)], *spans, rule="averaged")
    means = amp.reshape(-1, 40).mean(axis=1) + rng.normal(0, white_amp, 3_000)
    made = [record(t[39::40], means, averaged=True)]
    error = integrate_energy(made, *spans, rule="averaged") - truth
    got = energy_noise_joule(made, *spans)
    assert 0.8 < np.sqrt((got**2).mean()) / error.std() < 1.6


@pytest.mark.parametrize("averaged", [False, True])
def test_what_scatters_while_standing_is_noise(averaged):
    rng = np.random.default_rng(7)
    fine, decay = 0.005, np.exp(-0.005 / 0.1)
    amp = 6 + lfilter([np.sqrt(1 - decay**2)], [1, -decay], rng.normal(0, 0.5, 120_000))
    amp[102_000:] = 0.5  # it stands for the last 90 s
    t = (np.arange(120_000) + 1) * fine
    taken = amp.reshape(-1, 10).mean(axis=1) if averaged else amp[9::10]
    made = [record(t[9::10], taken + rng.normal(0, 0.2, 12_000), averaged=averaged)]
    moving = ENDS < ZERO + 505_000_000_000
    spans = STARTS[moving], ENDS[moving]
    still_ns = ZERO + np.array([[510, 600]]) * 1_000_000_000
    got = estimate_energy_noise(made, *spans, still_ns)
    assert np.sqrt(got.current.mean()) == pytest.approx(24 * 0.2 * np.sqrt(1.2 * 0.05), rel=0.1)
    truth = integrate_energy([record(t, amp, averaged=averaged)], *spans, rule="averaged" if averaged else "exact")
    error = integrate_energy(made, *spans, rule="averaged" if averaged else "exact") - truth
    assert np.sqrt((got.std_joule() ** 2).mean()) == pytest.approx(error.std(), rel=0.12)


def test_noise_of_a_coarse_record_is_its_own_and_that_of_rounding():
    """A median of rounded differences is a multiple of the step; motors that start among the samples are no noise."""
    rng = np.random.default_rng(9)
    t = np.arange(0, 600, 0.05)
    step, std_amp = 0.05, 0.113
    amp = np.where(np.arange(len(t)) % 600 < 300, 0.5, 6.0) + rng.normal(0, std_amp, len(t))
    still = np.arange(len(t)) % 600 < 305  # five samples of driving are taken as standing
    signal = make_samples(ZERO + np.round(t * 1e9).astype(np.int64), np.round(amp / step) * step)
    found = fit_signal_model(signal, ~still, still, averaged=True)
    assert found.error_variance == pytest.approx(std_amp**2 + step**2 / 12.0, rel=0.05)


def test_readings_of_1970_cost_no_memory_and_change_no_deviation():
    t, rng = np.arange(0, 600, 0.25), np.random.default_rng(12)
    rail = record(t, 6 + rng.normal(0, 0.5, len(t)))
    late = [
        make_samples(np.append([0, 250_000_000], each.stamp_ns), np.append(each.value[:2], each.value))
        for each in (rail.voltage, rail.current)
    ]
    for rate_hz in (None, 20.0):
        wanted = estimate_energy_noise([rail], STARTS, ENDS, NEVER_STILL, rate_hz=rate_hz)
        tracemalloc.start()
        got = estimate_energy_noise(
            [make_rail("drive", *late, averaged=False)], STARTS, ENDS, NEVER_STILL, rate_hz=rate_hz
        )
        peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert got.std_joule() == pytest.approx(wanted.std_joule(), rel=1e-2)
        assert peak_bytes < 40_000_000


def test_noise_of_a_current_counts_by_the_voltage_in_the_middle_of_a_span():
    t = np.arange(0, 60, 0.05)
    stamp_ns = ZERO + np.round(t * 1e9).astype(np.int64)
    amp = make_samples(stamp_ns, 6 + np.random.default_rng(11).normal(0, 0.5, len(t)))
    spans = STARTS[[2, 38]], ENDS[[2, 38]]
    middle_s = (spans[0] + spans[1]) / 2 * 1e-9 - ZERO * 1e-9
    flat, steep = (
        estimate_energy_noise(
            [make_rail("drive", make_samples(stamp_ns, volt), amp, averaged=False)], *spans, NEVER_STILL
        ).current
        for volt in (np.ones(len(t)), 10.0 + 0.5 * t)
    )
    assert steep / flat == pytest.approx((10.0 + 0.5 * middle_s) ** 2, rel=1e-4)


def signal(value, period_s=0.05):
    return SampledSignal(
        1_000_000_000 + np.round(np.arange(len(value)) * period_s * 1e9).astype(np.int64), np.array(value)
    )


def test_a_record_too_short_for_a_model_has_no_noise_and_one_without_steady_samples_that_of_all():
    value = np.random.default_rng(3).normal(size=22)
    nowhere = np.zeros(22, bool)
    model = fit_signal_model(signal(value), ~nowhere, nowhere, averaged=False)
    assert model.error_variance + model.variance.sum() > 0
    short = fit_signal_model(signal(value[:21]), ~nowhere[:21], nowhere[:21], averaged=False)
    assert (short.error_variance, short.curvature_variance, short.variance.sum()) == (0.0, 0.0, 0.0)
    again = fit_signal_model(signal(value), nowhere, nowhere, averaged=False)
    assert again.variance == pytest.approx(model.variance)


def test_a_rougher_part_of_a_drive_has_larger_deviations():
    """A current that the sampling resolves is five times as rough in the last third; each part has its own error."""
    rng = np.random.default_rng(13)
    fine, decay = 0.005, np.exp(-0.005 / 0.1)
    rough = lfilter([np.sqrt(1 - decay**2)], [1, -decay], rng.normal(0, 0.5, 120_000))
    t = np.arange(120_000) * fine
    amp = 6 + rough * np.where(t > 400, 5.0, 1.0)
    truth = integrate_energy([record(t, amp)], STARTS, ENDS, rule="exact")
    made = [record(t[::10], amp[::10])]
    error = integrate_energy(made, STARTS, ENDS, rule="exact") - truth
    got = energy_noise_joule(made, STARTS, ENDS)
    for part in (ENDS < ZERO + 395_000_000_000, STARTS > ZERO + 405_000_000_000):
        assert np.sqrt(np.mean(got[part] ** 2)) == pytest.approx(error[part].std(), rel=0.25)
