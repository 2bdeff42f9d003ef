"""What a model is shown beside: fitted on its samples, measured on the same, and said in words."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_models import CARD, made_comparison

from tcpipe.cost.prediction_errors import make_residuals
from tcpipe.dataset import Split, open_dataset
from tcpipe.learning.baselines import BASELINES, _group_samples, compare_baselines, describe_ratios, find_best
from tcpipe.learning.metrics import Ratio, compute_costs
from tcpipe.learning.models import Model
from tcpipe.learning.predictions import Predicted, collect_measured
from tcpipe.learning.predictor import Prediction


@pytest.fixture(scope="module")
def sets(dataset):
    data = open_dataset(dataset)
    names = {entry.id: entry.name for entry in data.card.classes}
    return data, {name: collect_measured(data[name], names) for name in ("test", "unseen")}


def said_by(sets, factor=1.0):
    """A model that says every label times a factor."""
    said = {
        name: compute_costs(factor * part.costs["w"], part.costs["v"], 1.0) | {"E": factor * part.costs["E"]}
        for name, part in sets.items()
    }
    return {name: Predicted(costs, {}) for name, costs in said.items()}


def model_of(kind="resnet18"):
    own = replace(CARD, training=replace(CARD.training, kind=kind))
    return Model("made", own, None, "0")


@pytest.fixture(scope="module")
def found(sets):
    pytest.importorskip("lightgbm")
    data, parts = sets
    return compare_baselines(model_of(), data, parts, said_by(parts, 1.1), seed=0)


def test_the_mean_of_each_class_by_hand(found, sets):
    data, parts = sets
    rows, lacking = found
    assert lacking == []
    assert {row.baseline for row in rows} == set(BASELINES)
    fitted, test = data["train"].fold(0)[0], parts["test"]
    power = {known: fitted.labels[fitted.column("terrain_class") == known, 0] for known in np.unique(test.class_ids)}
    told = np.array([power[known].mean() for known in test.class_ids])
    row = next(row for row in rows if (row.baseline, row.split, row.quantity) == ("mean per class", "test", "w"))
    off = np.sqrt(np.mean((told - test.costs["w"]) ** 2))
    assert row.errors.rmse == pytest.approx(off, rel=0.1)  # centred, and drawn a little to the mean of all
    ours = np.sqrt(np.mean((0.1 * test.costs["w"]) ** 2))
    assert row.rmse_ratio.value == pytest.approx(ours / row.errors.rmse)
    assert row.errors.count == len(test.split)


def test_a_model_is_not_its_own_baseline(sets):
    data, parts = sets
    rows, _ = compare_baselines(model_of("boosting"), data, parts, said_by(parts), seed=0)
    assert "gradient boosting" not in {row.baseline for row in rows}


def test_what_cannot_be_fitted_is_said(sets, monkeypatch):
    data, parts = sets
    real = Split.column
    monkeypatch.setattr(
        Split, "column", lambda split, name: np.zeros(len(split)) if name == "fold" else real(split, name)
    )
    rows, lacking = compare_baselines(model_of(), data, parts, said_by(parts), seed=0)
    assert any(of.subject.name == "gradient boosting" and "in one fold" in of.names["error"] for of in lacking)
    assert {row.baseline for row in rows} == set(BASELINES) - {"gradient boosting"}
    monkeypatch.setattr(Split, "labels", property(lambda split: np.full((len(split), 2), np.nan, np.float32)))
    assert compare_baselines(model_of(), data, parts, {}, seed=0)[0] == []


def test_the_best_baseline_is_named_with_the_ratio_and_its_interval():
    mean = made_comparison("mean per class", Ratio(0.5, 0.4, 0.6), rmse=9.0)
    linear = made_comparison("class and slope, linear", Ratio(0.9, 0.8, 0.97))
    assert describe_ratios([mean, linear]) == [
        "unseen, energy E: RMSE ratio to 'class and slope, linear', the best baseline, 0.90 (95 % CI 0.80 to 0.97, 34 runs)"
    ]
    assert find_best([mean, linear], "unseen", "E").is_beaten
    trees = made_comparison("gradient boosting", Ratio(1.25, 1.1, 1.4), rmse=4.0)
    worse = find_best([mean, linear, trees], "unseen", "E")
    assert (worse, worse.is_beaten, worse.is_better) == (trees, False, True)
    alike = made_comparison("class and slope, linear", Ratio(1.02, 0.95, 1.1), rmse=4.5)
    same = find_best([mean, alike], "unseen", "E")
    assert (same.is_beaten, same.is_better) == (False, False)
    rounded = made_comparison("physics", Ratio(1.0001, 1.00005, 1.0002), rmse=4.5)
    assert not find_best([mean, rounded], "unseen", "E").is_better
    few = made_comparison("physics", Ratio(0.5, None, None), rmse=5.0)
    assert "34 runs are too few" in describe_ratios([few])[0]
    assert not find_best([few], "unseen", "E").is_beaten
    assert describe_ratios([made_comparison("physics", Ratio(None, None, None), rmse=5.0)]) == []


def test_blocks_are_of_ground_whatever_the_runs_frames():
    """Samples 30 m apart along a parallel, of two runs."""
    east_m = np.array([1.0, 31.0, 31.5, 61.0]) / (111_320.0 * np.cos(np.radians(47.0)))
    known = {f"{end}_lat_deg": np.full(4, 47.0) for end in ("start", "end")} | {"start_lon_deg": 15.0 + east_m}
    columns = known | {"run_id": np.array(["a", "a", "b", "b"])}
    local = {"start_x_m": np.array([1.0, 31.0, 31.5, 61.0]), "start_y_m": np.zeros(4), "run_id": columns["run_id"]}
    for each, has_coordinates in ((columns, True), (local, False)):
        split = SimpleNamespace(column=each.__getitem__, has_coordinates=has_coordinates)
        kind, groups = _group_samples(split, 10.0)
        assert kind == "blocks"
        assert groups[1] == groups[2]
        assert len(set(groups.tolist())) == 3


def test_one_rule_centres_every_predictor(sets):
    """A predictor that says 20 % too much of E of one class on held-out samples loses that there."""
    data, parts = sets
    train = data["train"]
    factor = np.where(train.column("terrain_class") == 4, 1.2, 1.0)
    said = np.column_stack([train.labels[:, 0] * factor, train.labels[:, 1]]).astype(float)
    residuals = {name: train.column(name) for name in ("run_id", "start_ns", "terrain_class")}
    residuals |= make_residuals(train.labels.astype(float), said, np.zeros((len(said), 2, 2)))
    test = parts["test"]
    again = np.where(test.class_ids == 4, 1.2, 1.0)
    outputs = Prediction.without_covariance(np.column_stack([test.costs["w"] * again, test.costs["v"]]))
    found, true = Predicted.centre(residuals, outputs, test.class_ids, 1.0), test.costs["w"] / test.costs["v"]
    np.testing.assert_allclose(found.costs["E"], true, rtol=0.02)
