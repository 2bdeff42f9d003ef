"""Curves and trees together: the features of patches, LightGBM's text, and texts that are none."""

import re

import numpy as np
import pytest

from tcpipe.errors import ModelError
from tcpipe.learning import table_model as forest
from tcpipe.learning.predictor import Inputs
from tcpipe.learning.table_model import (
    BoostingModel,
    compute_patch_features,
    fit_table,
)
from tcpipe.recipe import TrainConfig

PX, PATCH_M = 40, 1.0
ALONG, ACROSS = np.meshgrid(*[(np.arange(PX) + 0.5) / PX - 0.5] * 2)


def _of_height(height_m):
    patches = np.asarray(height_m, np.float32)[None, ..., None]
    return compute_patch_features(patches, channels=("height",), class_count=7, patch_m=PATCH_M)[0]


def test_a_paraboloid_has_its_slopes_and_curvatures_and_no_roughness():
    found = _of_height(0.4 + 0.2 * ALONG - 0.1 * ACROSS + 0.15 * ALONG**2 - 0.05 * ACROSS**2)
    assert found[:5] == pytest.approx([np.arctan(0.2), np.arctan(0.1), 0.3, -0.1, 0.0], abs=1e-5)
    assert found[5] == pytest.approx(np.ptp(0.2 * ALONG - 0.1 * ACROSS + 0.15 * ALONG**2 - 0.05 * ACROSS**2), abs=1e-6)


def test_roughness_is_the_deviation_from_the_paraboloid():
    rough = 0.01 * np.where(
        (np.indices((PX, PX)).sum(axis=0)) % 2, 1.0, -1.0
    )  # a chessboard, which no paraboloid resembles
    assert _of_height(0.5 + rough)[4] == pytest.approx(0.01, rel=1e-3)
    assert _of_height(0.5 + 0.1 * ALONG + rough)[4] == pytest.approx(0.01, rel=1e-3)


def test_shares_of_classes_and_the_picture():
    patch = np.zeros((1, PX, PX, 3), np.float32)
    patch[0, :, :10, 1], patch[0, :, 10:, 1] = 3 / 6, 6 / 6
    patch[0, :, ::2, 0] = 0.5
    patch[..., 2] = 0.25
    found = compute_patch_features(patch, channels=("ortho", "terrain", "roots"), class_count=7, patch_m=PATCH_M)[0]
    assert found == pytest.approx([0.25, 0.25, 0.5, 0, 0, 0, 0.25, 0, 0, 0.75, 0.25, 0, 0])


RULES = forest.make_rules(TrainConfig())


def _drawn(count, seed=0):
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(count, 4))
    labels = np.column_stack([100.0 + 20.0 * features[:, 0], 0.8 + 0.1 * np.tanh(features[:, 1])])
    return features, labels + rng.normal(size=labels.shape) * [5.0, 0.02], rng.integers(0, 5, count)


def _make_trees(count=600):
    features, labels, folds = _drawn(count)
    return features, labels, folds, *forest.grow(features, labels, folds)


def test_they_predict_as_lightgbm_and_are_its_own_text():
    lightgbm = pytest.importorskip("lightgbm")
    features, labels, folds, trees, held_out, largest = _make_trees()
    for number, (label, text) in enumerate(zip(labels.T, trees, strict=True)):
        booster = lightgbm.Booster(model_str=text)
        whole = lightgbm.train(RULES, lightgbm.Dataset(features, label), booster.num_trees())
        assert booster.predict(features) == pytest.approx(whole.predict(features), rel=1e-12)
        assert booster.num_trees() <= largest
        assert forest.clean_trees(text, 4) == text, number
    assert np.std(held_out - labels, axis=0) == pytest.approx([5.0, 0.02], rel=0.25)
    assert forest.grow(features, labels, folds)[0] == trees


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("split_feature", "4", "invalid nodes"),
        ("left_child", "900", "invalid nodes"),
        ("left_child", "0", "invalid nodes"),  # of the first node: a cycle
        ("right_child", "-900", "invalid nodes"),
        ("threshold", "nan", "not finite"),
        ("leaf_value", "inf", "not finite"),
        ("leaf_value", "1 2", "invalid nodes"),
        ("num_leaves", "19", "invalid nodes"),
        ("num_cat", "1", "training cannot produce"),
        ("is_linear", "1", "training cannot produce"),
        ("split_feature", "99999999999999999999", "cannot be read"),
    ],
)
def test_a_text_by_which_the_reader_would_leave_its_memory_is_refused(name, value, words):
    pytest.importorskip("lightgbm")
    text = _make_trees(200)[3][0]
    broken = re.sub(rf"(?m)^{name}=\S+", f"{name}={value}", text, count=1)
    assert broken != text
    with pytest.raises(ModelError, match=words):
        forest.clean_trees(broken, 4)
    for part in ("", text[:300], text.replace("Tree=0", "Tree=0\nTree=0")):
        with pytest.raises(ModelError, match="training cannot produce"):
            forest.clean_trees(part, 4)


def test_without_lightgbm_there_is_one_line(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "lightgbm", None)
    with pytest.raises(ModelError, match=r"lightgbm not installed, .* pip install 'tcpipe\[tables\]'"):
        forest.grow(*_drawn(9)[:2], np.arange(9) % 3)


pytest.importorskip("lightgbm")

CHANNELS, CLASSES = ("ortho", "terrain", "height"), 5
INPUTS = Inputs(CHANNELS, 40, CHANNELS, 1.0, CLASSES, (), ("power_watt", "velocity_mps"), (1.0, 1.0))


def ground(count=900, steepest=0.2, seed=0):
    """Features of patches of classes 4 and 5; power rises with the slope, by class, and where the picture has texture."""
    rng = np.random.default_rng(seed)
    slope, class_id, texture = rng.uniform(-steepest, steepest, count), rng.choice([4, 5], count), rng.random(count)
    features = rng.normal(size=(count, 3 + CLASSES + 6))
    features[:, 2], features[:, 3 + CLASSES] = texture, slope
    features[:, 3 : 3 + CLASSES] = np.eye(CLASSES)[class_id - 1]
    power = 100.0 + 20.0 * (class_id == 5) + 300.0 * slope + 30.0 * (texture > 0.5)
    return features, np.column_stack([power, 0.8 - slope]), rng.integers(0, 5, count)


@pytest.fixture(scope="module")
def fitted():
    features, labels, folds = ground()
    return fit_table(features, labels, folds, INPUTS)


def test_steeper_ground_than_any_goes_on_straight_and_texture_is_heeded(fitted):
    model, *_ = fitted
    features, labels, _ = ground(300, steepest=0.4, seed=1)
    said = model.predict_table(features)
    assert np.abs(said[:, 0] - labels[:, 0]).mean() < 4.0
    assert said[:, 1] == pytest.approx(labels[:, 1], abs=0.02)


def test_what_the_other_folds_said_is_no_better_than_what_is_new(fitted):
    """Residuals of a fit that saw its samples would promise too much."""
    model, held_out, _ = fitted
    features, labels, _ = ground()
    new, told, _ = ground(seed=2)
    seen, held, unseen = (
        np.abs(said[:, 0] - wanted[:, 0]).mean()
        for said, wanted in (
            (model.predict_table(features), labels),
            (held_out, labels),
            (model.predict_table(new), told),
        )
    )
    assert seen < held
    assert held > 0.8 * unseen


def test_arrays_there_and_back_and_another_model():
    features, labels, folds = ground()
    features = features[:, : 3 + CLASSES + 6]
    model, *_ = fit_table(features, labels, folds, INPUTS)
    again = BoostingModel.from_arrays(model.to_arrays(), INPUTS)
    assert np.array_equal(again.predict_table(features), model.predict_table(features))
    trees = {name: array for name, array in model.to_arrays().items() if name.startswith("trees")}
    with pytest.raises(ModelError, match=r"the weights of another model: curve_.* is missing; train the model again"):
        BoostingModel.from_arrays(trees, INPUTS)
