"""A model adapted to another run by its first metres: against a regression by hand, and by coverage over simulated runs."""

from dataclasses import replace

import numpy as np
import pytest
from adapted_drives import compare_adaptations

from tcpipe.cost.adaptation import MeasuredRun, Metres, adapt
from tcpipe.cost.prediction_errors import fit_errors


def made_errors(runs=8, per_run=200, seed=0):
    """Errors of a model of about 150 J/m: 5 % a metre, independent, and 1 % a run."""
    rng = np.random.default_rng(seed)
    count = runs * per_run
    predicted = rng.uniform(100.0, 200.0, count)
    energy = predicted * (
        1.0 + 0.05 * rng.standard_normal(count) + np.repeat(0.01 * rng.standard_normal(runs), per_run)
    )
    return fit_errors(
        {
            "run_id": np.repeat(np.arange(runs), per_run), "start_ns": np.tile(np.arange(per_run) * 10**9, runs),
            "terrain_class": np.full(count, 4), "power_watt": energy, "velocity_mps": np.ones(count),
            "power_predicted_watt": predicted, "velocity_predicted_mps": np.ones(count),
        }
    )["energy"]  # fmt: skip


def made_run(rng, metres=300, *, scale=1.0, offset=0.0, payload=0.0):
    slope = 0.1 * np.sin(np.arange(metres) / 15.0 + rng.uniform(0.0, 6.0))
    predicted = 150.0 + 600.0 * slope + rng.normal(0.0, 10.0, metres)
    measured = (scale * predicted + offset + payload * 600.0 * slope) * (1.0 + 0.05 * rng.standard_normal(metres))
    along, ones = np.arange(metres, dtype=float), np.ones(metres)
    return Metres(predicted, measured, np.full(metres, 4), along, ones, ones, slope, 0.0 * ones)


CHANGES = {"same": {}, "heavier": {"payload": 0.4}, "another robot": {"scale": 1.5, "offset": -20.0}}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_an_adapted_model_is_better_and_its_intervals_cover(change):
    """At least 90 % of metres and of sums after 50 m, less the chance of 60 runs; the error falls to that of the noise."""
    rng, errors = np.random.default_rng(1), made_errors()
    runs = [MeasuredRun(str(number), {"energy": made_run(rng, **change)}) for number in range(60)]
    found = {of.metres: of for of in compare_adaptations({"energy": errors}, runs, (0, 5, 10, 50))}
    plain, few, much = found[0], found[5], found[50]
    assert {(of.runs, of.samples) for of in found.values()} == {(60, 60 * 250)}
    assert 86.0 <= much.coverage_percent <= 99.0
    assert much.totals_inside >= 48
    if change:
        assert plain.coverage_percent < 60.0  # what is not adapted is overconfident, and wrong
        assert much.rmse < 0.7 * plain.rmse
        assert much.rmse < found[10].rmse
    else:  # nothing is lost where nothing has changed
        for some in found.values():
            assert some.total_error_percent < plain.total_error_percent + 0.5
            assert some.rmse < 1.03 * plain.rmse
        assert few.totals_inside >= 54


def test_a_long_run_leaves_the_least_squares_fit():
    """With very many metres the prior counts nothing: numpy's own least squares, weighted by the spreads, says the same."""
    errors, known = made_errors(), made_run(np.random.default_rng(3), 700, scale=1.4, offset=15.0, payload=0.2)
    errors = replace(errors, correlation=np.zeros_like(errors.correlation))
    adapted = adapt(errors, known, known).value
    design = np.column_stack([known.predicted, known.length_m, known.rise_m])
    spread = errors.compute_std(known.predicted, known.class_id)
    by_hand = design @ np.linalg.lstsq(design / spread[:, None], known.measured / spread, rcond=None)[0]
    np.testing.assert_allclose(adapted, by_hand, rtol=0.01)


def test_one_metre_hardly_moves_the_model():
    errors, run = made_errors(), made_run(np.random.default_rng(4))
    first = run.take(np.arange(300) < 1)
    odd = replace(first, measured=first.predicted * 1.1)
    ratio = adapt(errors, odd, run).value / run.predicted
    assert 1.0 < ratio.mean() < 1.08


def test_runs_that_are_too_short_are_in_no_row():
    run = MeasuredRun("short", {"energy": made_run(np.random.default_rng(5), 55)})
    assert list(compare_adaptations({"energy": made_errors()}, [run], (0, 50))) == []
