"""What stands beside a patch: from columns to the numbers that a model takes, and what is not known."""

from types import SimpleNamespace

import numpy as np
import pytest

from tcpipe.dataset.extra_features import (
    COLUMNS,
    ExtraFeature,
    ExtraFeatures,
    available_features,
    empty_extra_features,
    read_extra_features,
    standardize_features,
)

TURN = ExtraFeature("turn_radpm", 0.1, 0.05, 0.1, (0.0, 0.3))
SPEED = ExtraFeature("command_mps", 0.8, 0.2, 0.9, (0.5, 1.0))


def split_of(**columns):
    given = dict.fromkeys((*COLUMNS, "terrain_class", "slope_rad"), np.array([np.nan, np.nan])) | columns
    return SimpleNamespace(column=given.__getitem__)


def test_a_turn_is_the_angle_of_a_metre():
    found = read_extra_features(
        split_of(
            mean_abs_yaw_rate_radps=np.array([0.2, np.nan]),
            duration_s=np.array([1.5, 1.0]),
            arc_length_m=np.array([1.2, 1.0]),
        )
    )
    assert found.turn_radpm == pytest.approx([0.25, np.nan], nan_ok=True)
    assert found.class_id.tolist() == [0, 0]


def test_inputs_are_those_that_any_sample_tells():
    extra_features = ExtraFeatures(np.zeros(3, int), np.zeros(3), np.array([0.1, 0.3, np.nan]), np.full(3, np.nan))
    (turn,) = available_features(extra_features)
    assert (turn.name, turn.mean, turn.usual, turn.training_range) == (
        "turn_radpm",
        pytest.approx(0.2),
        pytest.approx(0.2),
        (0.1, 0.3),
    )
    assert turn.deviation == pytest.approx(0.1)
    assert available_features(empty_extra_features(4)) == ()


def test_numbers_are_deviations_and_what_is_not_known_is_usual():
    extra_features = ExtraFeatures(np.zeros(2, int), np.zeros(2), np.array([0.2, np.nan]), np.array([np.nan, 0.6]))
    assert standardize_features([TURN, SPEED], extra_features) == pytest.approx(np.array([[2.0, 0.5], [0.0, -1.0]]))
    assert standardize_features([], extra_features).shape == (2, 0)
