"""The energy's deviation against the scatter of many noisy, sampled or rounded records of one truth."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_tracks import stamps
from scipy.optimize import nnls
from scipy.signal import lfilter

from tcpipe.power import noise as energy_noise
from tcpipe.power.noise import (
    SignalModel,
    _compute_second_differences,
    _estimate_rounding,
    _estimate_stationary_error,
    _find_first_and_last,
    _predict_second_differences,
    _select_stationary_samples,
    _select_used_samples,
    compute_curvature,
    compute_median_period_s,
    estimate_calmest_variance,
    estimate_energy_noise,
    estimate_local_scale,
    estimate_resolution,
    fit_signal_model,
    solve_non_negative,
    sum_squared_weights,
)
from tcpipe.power.rails import Rail, Samples, integrate_energy, make_rail, make_samples

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
    for averaged, first in ((False, 7), (True, 8)):
        still = at[_select_stationary_samples(signal, halts, averaged=averaged)] // 100_000_000
        assert still.tolist() == [*range(first, 14), *range(first + 11, 25)]
    slow = Samples(np.array([700, 1300, 1800, 2300]) * 1_000_000, np.zeros(4))
    still = _select_stationary_samples(slow, halts, averaged=True)
    assert still.tolist() == [True, True, False, True], "the third began in the halt before"


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


ZIGZAG = np.arange(100) % 2.0


def signal(value, period_s=0.05):
    return Samples(1_000_000_000 + np.round(np.arange(len(value)) * period_s * 1e9).astype(np.int64), np.array(value))


def test_curvature_is_the_distance_from_the_line_through_the_neighbours():
    uneven = Samples(np.array([0, 1, 3]) * 1_000_000_000, np.array([0.0, 1.0, 0.0]))
    assert compute_curvature(uneven) == pytest.approx([1 / (1 + 1 / 9 + 4 / 9)])
    assert compute_curvature(signal(ZIGZAG)) == pytest.approx(np.full(98, 1 / 1.5))


@pytest.mark.parametrize(("period_s", "fewest"), [(0.1, 17), (0.05, 32), (1.0, 10)])
def test_the_calmest_stretch_is_of_a_second_and_a_half_and_of_eight_samples_at_least(period_s, fewest):
    assert estimate_calmest_variance(signal(ZIGZAG[: fewest - 1], period_s), period_s) == 0.0
    assert estimate_calmest_variance(signal(ZIGZAG[:fewest], period_s), period_s) == pytest.approx(1 / 1.5)
    calm = np.where(np.arange(100) < 50, ZIGZAG, 5 * ZIGZAG)
    assert estimate_calmest_variance(signal(calm, period_s), period_s) == pytest.approx(1 / 1.5)


def test_what_scatters_at_a_standstill_is_told_from_nine_samples_on_and_without_what_a_motor_makes():
    still = np.zeros(100, bool)
    still[:8] = True
    assert _estimate_stationary_error(signal(ZIGZAG), still) is None
    still[8] = True
    assert _estimate_stationary_error(signal(ZIGZAG), still) == pytest.approx(0.5)
    starting = np.where(np.arange(100) < 5, ZIGZAG, ZIGZAG + 100.0)
    assert _estimate_stationary_error(signal(starting), still) == pytest.approx(0.5)


def test_second_differences_count_by_how_many_they_are_at_each_spacing():
    every = np.ones(100, bool)
    value = np.random.default_rng(1).normal(size=100)
    spacing, seen, weight = _compute_second_differences(signal(value), every, 0.05)
    assert spacing.tolist() == [1, 2, 3, 4, 6, 8, 12, 16, 24, 32]
    count = 100 - 2 * spacing
    assert weight * seen == pytest.approx(np.sqrt(count / spacing))
    of_three = value[:-6] - 2 * value[3:-3] + value[6:]
    assert seen[2] == pytest.approx(np.mean(of_three**2) / 6)
    for period_s in (1.0, 1.25):  # five seconds at most
        assert _compute_second_differences(signal(value, period_s), every, period_s)[0].tolist() == [1, 2, 3, 4]


def test_second_differences_want_twenty_that_no_hole_and_no_unsteady_sample_divides():
    value = np.random.default_rng(2).normal(size=100)
    assert _compute_second_differences(signal(value[:22]), np.ones(22, bool), 0.05)[0].tolist() == [1]
    assert not len(_compute_second_differences(signal(value[:21]), np.ones(21, bool), 0.05)[0])
    unsteady = np.ones(23, bool)
    unsteady[-1] = False  # takes one of 21 away
    assert _compute_second_differences(signal(value[:23]), unsteady, 0.05)[0].tolist() == [1]
    unsteady[0] = False
    assert not len(_compute_second_differences(signal(value[:23]), unsteady, 0.05)[0])
    late = signal(value)
    late.stamp_ns[50:] += 24_000_000  # less than half a period: not a hole
    assert _compute_second_differences(late, np.ones(100, bool), 0.05)[2][0] > 0
    for shift_ns, whole in ((24_000_000, 98), (26_000_000, 96)):
        late = signal(value)
        late.stamp_ns[50:] += shift_ns
        _, seen, weight = _compute_second_differences(late, np.ones(100, bool), 0.05)
        assert (weight * seen)[0] == pytest.approx(np.sqrt(whole))


def test_what_a_process_shows_in_second_differences_is_known_in_closed_form():
    spacing = np.array([1, 3])
    far = np.array([1.0, 3.0]) * 0.05 / 0.1
    rough = (6 - 8 * np.exp(-far) + 2 * np.exp(-2 * far)) / 6
    assert _predict_second_differences(spacing, 0.05, 0.1, smooth=False, averaged=False) == pytest.approx(rough)
    smooth = (6 - 8 * (1 + far) * np.exp(-far) + 2 * (1 + 2 * far) * np.exp(-2 * far)) / 6
    assert _predict_second_differences(spacing, 0.05, 0.1, smooth=True, averaged=False) == pytest.approx(smooth)
    tau = 2.0  # in periods; means of exp(-d / tau) over a period each
    own = 2 * tau * (1 - tau * (1 - np.exp(-1 / tau)))
    apart = tau**2 * (np.exp(1 / tau) - 2 + np.exp(-1 / tau)) * np.exp(-np.array([[1, 3], [2, 6]]) / tau)
    means = (6 * own - 8 * apart[0] + 2 * apart[1]) / 6
    assert _predict_second_differences(spacing, 0.05, 0.1, smooth=False, averaged=True) == pytest.approx(
        means, rel=1e-3
    )


def test_a_record_too_short_to_tell_is_made_of_nothing():
    value = np.random.default_rng(3).normal(size=22)
    nowhere = np.zeros(22, bool)
    model = fit_signal_model(signal(value), ~nowhere, nowhere, averaged=False)
    assert model.error_variance + model.variance.sum() > 0
    assert model.period_s == pytest.approx(0.05)
    short = fit_signal_model(signal(value[:21]), ~nowhere[:21], nowhere[:21], averaged=False)
    assert (short.error_variance, short.curvature_variance, short.variance.sum()) == (0.0, 0.0, 0.0)
    # Where too little is steady, the whole record tells.
    again = fit_signal_model(signal(value), nowhere, nowhere, averaged=False)
    assert again.variance == pytest.approx(model.variance)


def test_covariances_of_processes_add_up():
    model = SignalModel(0.05, 0.0, np.array([2.0, 3.0]), np.array([0.1, 0.2]), np.array([False, True]), 1.0)
    got = model.covariance(np.array([0.0, 0.2]))
    assert got == pytest.approx([5.0, 2 * np.exp(-2) + 3 * 2 * np.exp(-1)])


def test_scale_is_the_scatter_within_two_seconds_of_a_span_with_the_record_as_four_samples():
    value = np.where((np.arange(200) >= 100) & (np.arange(200) < 110), 3 * (np.arange(200) % 2.0), 0.0)
    made = signal(value)
    model = SignalModel(0.05, 0.1, np.zeros(1), np.ones(1), np.zeros(1, bool), 0.5)
    steady = np.ones(200, bool)
    start, end = made.stamp_ns[[100, 20]], made.stamp_ns[[110, 30]]
    off = compute_curvature(made)
    near = off[
        100 - 41 : 110 + 40
    ]  # from two seconds before to two after, ends and all; the first inner sample is number 1
    wanted = (near.sum() + 4 * 0.6) / (len(near) + 4) - 0.1
    assert estimate_local_scale(model, made, steady, start, end) == pytest.approx(
        [wanted / 0.5, ((4 * 0.6) / (30 + 40 + 4) - 0.1) / 0.5 if (4 * 0.6) / 74 > 0.125 else 0.05]
    )
    none = SignalModel(0.05, 0.1, np.zeros(1), np.ones(1), np.zeros(1, bool), 0.0)
    assert estimate_local_scale(none, made, steady, start, end).tolist() == [1.0, 1.0]
    assert estimate_local_scale(model, signal([1.0, 2.0]), np.ones(2, bool), start, end).tolist() == [1.0, 1.0]
    assert estimate_local_scale(model, made, ~steady, start, end) == pytest.approx(
        estimate_local_scale(model, made, steady, start, end)
    )


@given(st.integers(0, 2**32), st.integers(1, 10), st.floats(0.0, 1.0), st.booleans())
def test_as_scipy_of_what_a_signal_is_made_of(seed, spacings, noise, averaged):
    draw = np.random.default_rng(seed)
    period_s = draw.choice([0.02, 0.1, 1.0])
    spacing = np.array(energy_noise._SPACINGS[:spacings])
    taus = [*((tau, False) for tau in energy_noise._ROUGH_TAU), *((tau, True) for tau in energy_noise._SMOOTH_TAU)]
    made = np.stack(
        [
            energy_noise._predict_second_differences(spacing, period_s, tau * period_s, smooth=s, averaged=averaged)
            for tau, s in taus
        ]
    )
    size = np.where(draw.random(len(taus)) < 0.3, draw.exponential(size=len(taus)), 0.0)
    seen = np.abs(size @ made * (1.0 + noise * draw.normal(size=spacings))) + 1e-6
    weight = np.sqrt(draw.integers(20, 5000, spacings)) / seen
    matrix, wanted = (made * weight).T, seen * weight
    theirs, residual = nnls(matrix, wanted)
    ours = solve_non_negative(matrix, wanted)
    assert ours.min() >= 0.0
    assert np.linalg.norm(matrix @ ours - wanted) == pytest.approx(residual, rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-8 * theirs.max(initial=1.0))


@pytest.mark.parametrize(
    ("made", "seen", "size"),
    [
        ([[1, 0], [1, 0], [0, 1]], [2, 1, 1], [1.5, 1]),
        ([[1, 0], [1, 0], [0, 1]], [-1, -1, -1], [0, 0]),
        ([[1, 1], [1, 1]], [1, 1], [1, 0]),  # two that are the same: the first
        ([[0, 0], [0, 0]], [1, 1], [0, 0]),
    ],
)
def test_by_hand(made, seen, size):
    np.testing.assert_allclose(solve_non_negative(np.array(made, float), np.array(seen, float)), size, atol=1e-12)
