"""Curves and trees together: what trees alone cannot say, and what the curves leave to them."""

import numpy as np
import pytest

from tcpipe.errors import ModelError
from tcpipe.learning.table_model import find_slope_and_class, fit_table, read_table_model

pytest.importorskip("lightgbm")

CHANNELS, CLASSES = ("ortho", "terrain", "height"), 5


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
    return fit_table(features, labels, np.ones_like(labels), folds, channels=CHANNELS, class_count=CLASSES)


def test_slope_and_class_stand_where_the_channels_say():
    features, _, _ = ground(5)
    slope, class_id = find_slope_and_class(features, CHANNELS, CLASSES)
    assert slope.tolist() == features[:, 8].tolist()
    assert set(class_id.tolist()) <= {4, 5}
    height_first, _ = find_slope_and_class(features, ("height", "ortho"), CLASSES)
    assert height_first.tolist() == features[:, 0].tolist()
    nothing = find_slope_and_class(features[:, :3], ("ortho",), CLASSES)
    assert not np.any(nothing)


def test_steeper_ground_than_any_goes_on_straight_and_texture_is_heeded(fitted):
    model, _ = fitted
    features, labels, _ = ground(300, steepest=0.4, seed=1)
    said = model.predict(features)
    assert np.abs(said[:, 0] - labels[:, 0]).mean() < 4.0
    assert said[:, 1] == pytest.approx(labels[:, 1], abs=0.02)


def test_what_the_other_folds_said_is_no_better_than_what_is_new(fitted):
    """Residuals of a fit that saw its samples would promise too much."""
    model, held_out = fitted
    features, labels, _ = ground()
    new, told, _ = ground(seed=2)
    seen, held, unseen = (
        np.abs(said[:, 0] - wanted[:, 0]).mean()
        for said, wanted in ((model.predict(features), labels), (held_out, labels), (model.predict(new), told))
    )
    assert seen < held
    assert held > 0.8 * unseen


def test_arrays_there_and_back_and_an_older_kind(fitted):
    model, _ = fitted
    features, _, _ = ground(20)
    again = read_table_model(model.arrays(), "weights.npz", CHANNELS, CLASSES)
    assert np.array_equal(again.predict(features), model.predict(features))
    with pytest.raises(
        ModelError, match="holds the weights of another model, or of an older kind; train the model again"
    ):
        read_table_model(model.forest.arrays(), "weights.npz", CHANNELS, CLASSES)
