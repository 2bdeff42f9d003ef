"""Intervals of sums: against drives whose errors are drawn."""

import numpy as np
import pytest
from physics_model import made_residuals

from tcpipe.cost.prediction_errors import (
    NEAR,
    estimate_correlation,
    fit_bias_correction,
    fit_errors,
    make_residuals,
    propagate_stated,
)

_GRASS = np.uint8(4)


def _width(errors, count):
    low, high = errors.compute_sum(np.full(count, 100.0), np.full(count, _GRASS)).interval
    return (high - low) / (100.0 * count)


def test_one_piece_has_the_quantiles_of_the_held_out_errors():
    found = fit_errors(made_residuals(4000, sigma=0.1))["energy"]
    low, high = found.compute_intervals(np.array([200.0]), np.array([_GRASS]))
    assert low[0] == pytest.approx(200.0 * (1.0 - 1.645 * 0.1), rel=0.01)
    assert high[0] == pytest.approx(200.0 * (1.0 + 1.645 * 0.1), rel=0.01)


def test_independent_errors_shrink_with_the_root_of_the_length_and_shared_ones_do_not():
    alone = fit_errors(made_residuals(4000, shared=0.0))["energy"]
    together = fit_errors(made_residuals(4000, shared=1.0, runs=40))["energy"]
    assert _width(alone, 400) < 0.3 * _width(alone, 1)
    assert _width(together, 400) > 0.95 * _width(together, 1)


def _with_power(residuals, factor, rows=slice(None)):
    power = residuals["power_watt"].copy()
    power[rows] *= factor
    return {**residuals, "power_watt": power}


def test_a_model_that_is_off_on_average_is_centred_and_lies_in_its_interval():
    residuals = _with_power(made_residuals(1000, sigma=0.01), 1.2)
    power, velocity = fit_bias_correction(residuals).apply(np.full(50, 100.0), np.full(50, 0.8), np.full(50, _GRASS))
    assert power == pytest.approx(120.0, rel=0.003)
    assert velocity == pytest.approx(0.8)
    energy = power / velocity
    low, high = fit_errors(residuals)["energy"].compute_sum(energy, np.full(50, _GRASS)).interval
    assert 0.97 * energy.sum() < low < energy.sum() < high < 1.03 * energy.sum()


def test_a_few_samples_of_a_class_do_not_make_its_bias():
    """Three samples 10 % off, of errors of 10 %, are chance; three hundred are not."""
    residuals = made_residuals(1000, sigma=0.1)
    for count, least, most in ((3, -0.02, 0.02), (300, 0.07, 0.13)):
        few = {**residuals, "terrain_class": np.where(np.arange(1000) % 3 * 1000 + np.arange(1000) // 3 < count, 5, 4)}
        power, _ = fit_bias_correction(_with_power(few, 1.1, few["terrain_class"] == 5)).apply(
            np.ones(1), np.ones(1), np.array([5])
        )
        assert least < power[0] - 1.0 < most


@pytest.mark.parametrize(("is_everywhere", "power_ratio"), [(True, 1.25), (False, 1.0)])
def test_a_bias_of_the_only_fold_with_a_class_is_none_of_the_model(is_everywhere, power_ratio):
    """Forty metres of a class, all but three in one fold: what the other folds say of it there is not what the model of all folds says."""
    residuals = made_residuals(1000, sigma=0.02)
    fold = np.arange(1000) // 8 % 5
    of_class = np.flatnonzero(fold < 5 if is_everywhere else fold == 0)[:37]
    rows = np.concatenate([of_class, np.flatnonzero(fold > 0)[-3:]])
    is_class = np.isin(np.arange(1000), rows)
    few = {**residuals, "fold": fold, "terrain_class": np.where(is_class, 7, 4).astype(np.uint8)}
    power, _ = fit_bias_correction(_with_power(few, 1.25, is_class)).apply(np.ones(1), np.ones(1), np.array([7]))
    assert power[0] == pytest.approx(power_ratio, abs=0.03)


def test_an_end_that_two_metres_share_is_an_error_of_neither_together():
    """Where one metre is too long its neighbour is too short: ten in a row err like the two outer ends alone."""
    residuals, rng = made_residuals(8000), np.random.default_rng(1)
    residuals["power_watt"] = 150.0 * (1.0 + 0.1 * np.diff(rng.normal(size=8001)))
    found = fit_errors(residuals)["energy"]
    assert found.correlation[0] == pytest.approx(-0.5, abs=0.05)
    assert _width(found, 10) == pytest.approx(2.0 * 1.645 * 0.1 * np.sqrt(2.0) / 10.0, rel=0.3)


def test_two_runs_tell_less_of_a_third_than_twenty_do():
    few, many = (fit_errors(made_residuals(4000, shared=0.3, runs=runs))["energy"] for runs in (3, 40))
    assert (few.runs, many.runs) == (3, 40)
    assert many.of_run == pytest.approx(0.3, rel=0.4)
    errors = made_residuals(4000, shared=0.3, runs=3)["power_watt"][:3999] / 150.0
    means = errors.reshape(3, -1).mean(axis=1)  # Student's t with two degrees of freedom is 2.92
    assert few.of_run == pytest.approx(means.var(ddof=1) / errors.var() * (2.92 / 1.645) ** 2, rel=0.05)


def test_too_few_held_out_samples_say_nothing():
    assert fit_errors(made_residuals(19)) is None


def test_what_all_labels_have_in_common_adds_up_linearly_and_counts_against_the_truth_alone():
    """Labels of one sensor whose gain is known to 2 %: no residual shows it, no length makes it smaller, and the same sensor repeats it."""
    exact = made_residuals(4000, sigma=0.02)
    stated = {
        **exact,
        "duration_s": np.full(4000, 1.25),
        "duration_common_std_s": np.zeros(4000),
        "energy_common_std_joule": 0.02 * exact["power_watt"] * 1.25,
    }
    for count in (10, 1000):
        said, ground = np.full(count, 100.0), np.full(count, _GRASS)
        without, with_common = (fit_errors(of)["energy"].compute_sum(said, ground) for of in (exact, stated))
        assert with_common.common_std == pytest.approx(2.0 * count, rel=0.02)
        assert with_common.interval == without.interval
        added = np.sqrt(
            (with_common.compute_quantile(0.95) - 100.0 * count) ** 2
            - (without.compute_quantile(0.95) - 100.0 * count) ** 2
        )
        assert added == pytest.approx(1.645 * 2.0 * count, rel=0.02)
        assert fit_errors(stated)["duration"].compute_sum(said, ground).common_std == 0.0


@pytest.mark.parametrize("metres", [0.0, 2.0])
def test_intervals_of_long_paths_cover_new_runs_whose_neighbours_err_alike(metres):
    """Errors of neighbours correlate and those of runs do not: means of runs differ by it, which is no error of the run."""
    covered = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        rho, white = np.exp(-1.0 / metres) if metres else 0.0, rng.normal(size=(12, 200))
        errors = white.copy()
        for at in range(1, 200):
            errors[:, at] = rho * errors[:, at - 1] + np.sqrt(1.0 - rho**2) * white[:, at]
        held = made_residuals(1200, runs=6)
        held["power_watt"] = 150.0 * (1.0 + 0.1 * errors[:6].reshape(-1))
        total = fit_errors(held)["energy"].compute_sum(np.full(100, 187.5), np.full(100, _GRASS))
        measured = 187.5 * (100.0 + 0.1 * errors[6:].reshape(6, 2, 100).sum(axis=2))
        covered.append(np.mean((total.interval[0] <= measured) & (measured <= total.interval[1])))
    assert 0.87 < np.mean(covered) < 0.955


@pytest.mark.parametrize("shared", [0.0, 0.5])
def test_a_budget_suffices_as_often_as_its_probability_says(shared):
    """The power of drives errs as that of the held-out runs did."""
    count, metres = 2000, 300
    errors = fit_errors(made_residuals(8000, 0.2, shared, seed=1, runs=100))["energy"]
    predicted, class_id = np.full(metres, 150.0 / 0.8), np.full(metres, 4)
    total = errors.compute_sum(predicted, class_id)
    rng = np.random.default_rng(2)
    level = 0.2 * np.sqrt(shared) * rng.normal(size=count)
    noise = 0.2 * np.sqrt(1.0 - shared) * rng.normal(size=(count, metres)).mean(axis=1)
    taken = predicted.sum() * (1.0 + level + noise)
    for probability in (0.2, 0.5, 0.8, 0.95):
        budget = total.compute_quantile(probability)
        assert total.compute_probability(budget) == pytest.approx(probability)
        share = np.mean(taken <= budget)
        assert share > probability - 0.06 if probability > 0.5 else share < probability + 0.06
        if shared:
            assert share == pytest.approx(probability, abs=0.06)


def _with_covariances(stated_by, count=6000, seed=4):
    """Errors of power whose deviation varies by metre, and what a model states of it; correlated with those of velocity by half."""
    rng = np.random.default_rng(seed)
    true_std = rng.choice([2.0, 20.0], count)
    both = rng.standard_normal((2, count))
    power = 150.0 + true_std * both[0]
    velocity = 0.8 + 0.01 * (0.5 * both[0] + np.sqrt(0.75) * both[1])
    factor, std = stated_by(rng, true_std)
    covariance = factor**2 * np.array([[std**2, 0.005 * std], [0.005 * std, np.full(count, 0.01**2)]]).transpose(
        2, 0, 1
    )
    labels, mean = np.column_stack([power, velocity]), np.tile([150.0, 0.8], (count, 1))
    columns = {name: made_residuals(count)[name] for name in ("run_id", "start_ns", "terrain_class")}
    return columns | make_residuals(labels, mean, covariance), true_std, labels, covariance


def test_what_a_model_states_counts_as_far_as_held_out_errors_follow_it():
    """Half of the truth is doubled, so that metres of either deviation are covered; numbers that tell nothing are not followed."""
    residuals, true_std, labels, covariance = _with_covariances(lambda _, std: (0.5, std))
    errors, class_id = fit_errors(residuals), np.full(len(labels), _GRASS)
    stated = propagate_stated(np.tile([150.0, 0.8], (len(labels), 1)), covariance)
    for name, true in (("power", labels[:, 0]), ("energy", labels[:, 0] / labels[:, 1])):
        predicted = np.full(len(true), {"power": 150.0, "energy": 187.5}[name])
        low, high = errors[name].compute_intervals(predicted, class_id, stated[name])
        inside = (low <= true) & (true <= high)
        assert inside[true_std == 2.0].mean() == pytest.approx(0.9, abs=0.06)
        assert inside[true_std == 20.0].mean() == pytest.approx(0.9, abs=0.04)
    assert errors["power"].stated_share == pytest.approx(2.0, rel=0.1)
    usual = errors["power"].compute_std(np.full(1, 150.0), class_id[:1])
    assert usual == pytest.approx(np.mean(true_std), rel=0.1)
    useless, *_ = _with_covariances(lambda rng, std: (1.0, rng.permutation(std)))
    found = fit_errors(useless)["power"]
    assert found.stated_share * 20.0 < 0.1 * found.compute_std(np.full(1, 150.0), class_id[:1])[0]


def test_errors_of_power_and_velocity_are_correlated():
    assert estimate_correlation(_with_covariances(lambda _, std: (1.0, std))[0]) == pytest.approx(0.5 * 0.77, abs=0.05)


def test_propagation_is_that_of_small_errors():
    """Against 200,000 draws of a correlated normal."""
    mean, covariance = np.array([120.0, 0.7]), np.array([[4.0, -0.01], [-0.01, 1e-4]])
    power, velocity = np.random.default_rng(0).multivariate_normal(mean, covariance, 200_000).T
    found = propagate_stated(mean[None], covariance[None])
    drawn = {"power": power, "velocity": velocity, "duration": 1.0 / velocity, "energy": power / velocity}
    assert {name: of[0] for name, of in found.items()} == pytest.approx(
        {name: of.std() for name, of in drawn.items()}, rel=0.02
    )


def test_metres_near_training_ground_have_errors_of_their_own():
    """Predictions by other runs of ground that these drove err by a third; a path has the errors of its own metres."""
    residuals, rng = made_residuals(4000, sigma=0.15), np.random.default_rng(3)
    near = np.where(np.arange(4000) % 2, np.nan, residuals["power_watt"] / (1.0 + 0.05 * rng.normal(size=4000)))
    residuals |= dict(zip(NEAR, (near, np.where(np.isnan(near), np.nan, 0.8)), strict=True))
    errors, said, ground = fit_errors(residuals)["energy"], np.full(40, 187.5), np.full(40, _GRASS)
    widths = {}
    for share in (0, 20, 40):
        is_near = np.arange(40) < share
        low, high = errors.compute_sum(said, ground, None, is_near).interval
        widths[share] = high - low
        std = errors.compute_std(said, ground, None, is_near)
        np.testing.assert_allclose(std, 187.5 * np.where(is_near, 0.05, 0.15), rtol=0.05)
    assert widths[40] == pytest.approx(widths[0] / 3.0, rel=0.15)
    assert widths[40] < widths[20] < widths[0]
    assert (
        errors.compute_sum(said, ground).interval == errors.compute_sum(said, ground, None, np.zeros(40, bool)).interval
    )
