"""The energy's deviation against the scatter of many noisy, sampled or rounded records of one truth."""

import numpy as np
import pytest
from made_tracks import stamps
from scipy.signal import lfilter

from tcpipe.power.energy import integrate_energy
from tcpipe.power.noise import (
    _estimate_rounding,
    _find_first_and_last,
    _select_stationary_samples,
    _select_used_samples,
    compute_median_period_s,
    estimate_energy_noise,
    estimate_resolution,
    fit_signal_model,
    sum_squared_weights,
)
from tcpipe.power.rails import Rail, Samples, make_rail, make_samples

ZERO = stamps(1)[0]
STARTS = ZERO + (np.arange(5, 595, 1.3) * 1e9).astype(np.int64)
ENDS = STARTS + 1_200_000_000

NEVER_STILL = np.empty((0, 2), dtype=np.int64)


def energy_noise_joule(rails, start_ns, end_ns, *, still_ns=NEVER_STILL):
    return estimate_energy_noise(rails, start_ns, end_ns, still_ns).std_joule()


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


def test_what_a_faster_source_would_leave():
    rng = np.random.default_rng(8)
    fine, decay = 0.005, np.exp(-0.005 / 0.5)
    amp = 6 + lfilter([np.sqrt(1 - decay**2)], [1, -decay], rng.normal(0, 1.0, 120_000))
    t = np.arange(120_000) * fine
    slow, fast = ([record(t[::step], amp[::step])] for step in (60, 10))
    told = estimate_energy_noise(slow, STARTS, ENDS, NEVER_STILL, rate_hz=20.0).rate.mean()
    truth = integrate_energy([record(t, amp)], STARTS, ENDS, rule="exact")
    error = integrate_energy(fast, STARTS, ENDS, rule="exact") - truth
    assert np.sqrt(told) == pytest.approx(error.std(), rel=0.25)


def test_the_median_period_needs_two_samples():
    assert compute_median_period_s(make_samples(ZERO + np.array([0, 50_000_000]), np.zeros(2))) == pytest.approx(0.05)
    assert compute_median_period_s(make_samples(ZERO + np.array([0]), np.zeros(1))) == np.inf


def test_weights_of_a_record_that_ends_with_the_span():
    """By hand: joined by lines, samples a second apart weigh a half, one and a half second."""
    at = ZERO + np.arange(3) * 1_000_000_000
    assert sum_squared_weights(at, at[:1], at[2:], averaged=False) == pytest.approx([1.5], rel=1e-6)


def test_a_span_uses_the_samples_in_it_and_one_on_either_side():
    at = ZERO + np.arange(10) * 1_000_000_000
    used = _select_used_samples(at, ZERO + np.array([2_500_000_000]), ZERO + np.array([4_500_000_000]))
    assert np.flatnonzero(used).tolist() == [2, 3, 4, 5]


def test_a_span_begins_and_ends_one_sample_beyond():
    at = np.arange(5) * 10
    starts, ends = np.array([0, 10, 11, 45, -5]), np.array([10, 20, 19, 50, 5])
    first, last = _find_first_and_last(at, starts, ends)
    assert first.tolist() == [0, 1, 1, 3, 0]
    assert last.tolist() == [1, 2, 2, 4, 1]


def test_noise_does_not_hang_on_when_the_clock_began():
    rng = np.random.default_rng(10)
    value = 6 + rng.normal(0, 0.5, 240)
    spans = np.array([[3.01, 5.27], [4.2, 6.4]])
    found = []
    for zero in (1_000_000_000, ZERO):
        stamp_ns = zero + np.arange(240) * 50_000_000
        made = [
            make_rail(
                "drive", make_samples(stamp_ns, np.full(240, 24.0)), make_samples(stamp_ns, value), averaged=False
            )
        ]
        start_ns, end_ns = zero + np.round(spans * 1e9).astype(np.int64)
        found.append(energy_noise_joule(made, start_ns, end_ns))
    assert found[0] == pytest.approx(found[1], rel=1e-9)
    assert (found[0] > 0).all()


def test_a_sample_counts_as_still_two_tenths_of_a_second_from_any_move():
    at = np.arange(1, 31) * 100_000_000
    halts = np.array([[500, 1500], [1600, 2600]]) * 1_000_000
    signal = Samples(at, np.zeros(30))
    assert (at[_select_stationary_samples(signal, halts, averaged=False)] // 100_000_000).tolist() == [
        *range(7, 14),
        *range(18, 25),
    ]
    assert (at[_select_stationary_samples(signal, halts, averaged=True)] // 100_000_000).tolist() == [
        *range(8, 14),
        *range(19, 25),
    ]
    slow = Samples(np.array([700, 1300, 1800, 2300]) * 1_000_000, np.zeros(4))
    assert _select_stationary_samples(slow, halts, averaged=True).tolist() == [
        True,
        True,
        False,
        True,
    ]  # the third began in the halt before


def test_rounding_is_one_error_for_each_level_that_a_span_crosses():
    at = np.arange(8) * 1_000_000_000
    signal = Samples(at, np.array([0.0, 0, 0, 0.5, 0.5, 0, 0, 0]))
    starts, ends = np.array([1, 1]) * 1_000_000_000, np.array([2, 6]) * 1_000_000_000
    assert _estimate_rounding(signal, starts, ends) == pytest.approx([0.5**2 / 12, (0.5 * 5) ** 2 / 12 / 3])


def test_a_resolution_shows_where_more_than_half_of_the_values_repeat():
    assert estimate_resolution(Samples(np.arange(4), np.array([0.0, 0.5, 0.0, 0.5]))) == 0.0
    assert estimate_resolution(Samples(np.arange(5), np.array([0.0, 0.5, 0.0, 0.5, 0.0]))) == 0.5
    assert estimate_resolution(Samples(np.arange(5), np.zeros(5))) == 0.0


def test_nothing_is_said_of_two_samples_and_of_a_rail_without_any():
    second = ZERO + np.array([0]), ZERO + np.array([1_000_000_000]), NEVER_STILL
    assert estimate_energy_noise([record(np.arange(2.0), np.arange(2.0))], *second).std_joule().tolist() == [0.0]
    empty = Samples(np.empty(0, np.int64), np.empty(0))
    gone = Rail("drive", empty, empty, False, empty.stamp_ns, empty.value, empty.value)
    assert estimate_energy_noise([gone], *second).std_joule().tolist() == [0.0]


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
