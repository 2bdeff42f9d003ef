"""What a signal is made of, by hand: second differences, scatter where it is calm or still, and where each of them begins to count."""

import numpy as np
import pytest

from tcpipe.power.noise import (
    SignalModel,
    _compute_second_differences,
    _estimate_stationary_error,
    _predict_second_differences,
    compute_curvature,
    estimate_calmest_variance,
    estimate_local_scale,
    fit_signal_model,
)
from tcpipe.power.rails import Samples

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
    assert _compute_second_differences(signal(value, 1.0), every, 1.0)[0].tolist() == [
        1,
        2,
        3,
        4,
    ]  # five seconds at most
    assert _compute_second_differences(signal(value, 1.25), every, 1.25)[0].tolist() == [1, 2, 3, 4]


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
