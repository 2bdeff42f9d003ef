"""Trees as arrays say what LightGBM says, and what was held out was not seen."""

import numpy as np
import pytest

from tcpipe.errors import ModelError
from tcpipe.learning import forest

RULES = {**forest._RULES}


def _drawn(count, seed=0):
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(count, 4))
    labels = np.column_stack([100.0 + 20.0 * features[:, 0], 0.8 + 0.1 * np.tanh(features[:, 1])])
    return features, labels + rng.normal(size=labels.shape) * [5.0, 0.02], rng.integers(0, 5, count)


def test_trees_by_hand():
    """Two trees of the first output, a stump and one leaf; of the second a tree of two steps."""
    made = forest.Forest(
        feature=np.array([1, 0, 0, 0, 0, 0, 1, 0, 0], np.uint32),
        threshold=np.array([0.5, 0.0, 0.0, 0.0, 2.0, 0.0, -1.0, 0.0, 0.0]),
        child=np.array([[1, 2], [1, 1], [2, 2], [3, 3], [5, 6], [5, 5], [7, 8], [7, 7], [8, 8]], np.uint32),
        value=np.array([0.0, 1.0, 2.0, 10.0, 0.0, 3.0, 0.0, 4.0, 5.0]),
        root=np.array([0, 3, 4], np.uint32),
        depth=np.array([1, 0, 2], np.uint32),
        output=np.array([0, 0, 1], np.uint32),
    )
    features = np.array([[0.0, 0.5], [3.0, 0.6], [3.0, -1.0], [2.0, 0.0]])
    assert made.predict(features).tolist() == [[11.0, 3.0], [12.0, 5.0], [11.0, 4.0], [11.0, 3.0]]
    assert made.predict(np.tile(features, (200, 1)))[796:].tolist() == made.predict(features).tolist()
    assert forest.read_forest(made.arrays(), "here").predict(features[:1]).tolist() == [[11.0, 3.0]]
    with pytest.raises(ModelError, match="here: holds the weights of another model"):
        forest.read_forest({"head/bias": np.zeros(2)}, "here")


def test_they_say_what_lightgbm_says():
    lightgbm = pytest.importorskip("lightgbm")
    features, labels, folds = _drawn(600)
    grown = forest.grow(features, labels, np.ones_like(labels), folds)
    for number, label in enumerate(labels.T):
        rounds = int((grown.forest.output == number).sum())
        booster = lightgbm.train(RULES, lightgbm.Dataset(features, label), rounds)
        assert grown.forest.predict(features)[:, number] == pytest.approx(booster.predict(features), rel=1e-12)
    assert np.std(grown.held_out - labels, axis=0) == pytest.approx([5.0, 0.02], rel=0.25)
    again = forest.grow(features, labels, np.ones_like(labels), folds)
    assert all(np.array_equal(array, again.forest.arrays()[name]) for name, array in grown.forest.arrays().items())


def test_without_lightgbm_there_is_one_line(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "lightgbm", None)
    with pytest.raises(ModelError, match=r"lightgbm not installed, .* pip install 'tcpipe\[tables\]'"):
        forest.grow(*_drawn(9)[:2], np.ones((9, 2)), np.arange(9) % 3)
