"""The model of physics: a robot of known coefficients is found again, with turns and unknown ground."""

from dataclasses import replace

import numpy as np
import pytest

from tcpipe.dataset.extra_features import ExtraFeatures
from tcpipe.errors import ModelError
from tcpipe.learning.physics_model import fit_physics_model

COUNT = 600


def _predict(model, features):
    """Physics does not look at patches."""
    return model.predict(None, features)


def drive(seed=0, count=COUNT):
    """A robot of 50 W, 400 N a rise, 30 or 60 N of rolling, 80 J/rad; it is slower uphill."""
    rng = np.random.default_rng(seed)
    class_id, slope, turn = rng.choice([4, 6], count), rng.uniform(-0.05, 0.25, count), rng.exponential(0.1, count)
    velocity = np.where(class_id == 4, 0.8, 0.9) - 1.0 * slope
    rolling = np.where(class_id == 4, 60.0, 30.0)
    power = 50.0 + velocity * (rolling + 400.0 * np.tan(slope) + 80.0 * turn)
    return ExtraFeatures(class_id, slope, turn, np.full(count, np.nan)), np.column_stack([power, velocity])


def test_a_robot_is_found_again():
    extra_features, labels = drive()
    model = fit_physics_model(extra_features, labels, idle_watt=50.0)
    assert model.no_load_watt == pytest.approx(50.0, rel=0.01)
    assert model.grade_newton == pytest.approx(400.0, rel=0.01)
    assert model.rolling_newton[[4, 6]] == pytest.approx([60.0, 30.0], rel=0.02)
    assert model.turning_joule_per_rad[[4, 6]] == pytest.approx(80.0, rel=0.02)
    other, told = drive(seed=1)
    assert _predict(model, other) == pytest.approx(told, rel=0.01)


def test_what_the_drives_take_without_a_load_is_found_where_halts_tell_less():
    """14 W at halts, 62 N more as soon as it moves, seen where slopes drive the robot."""
    extra_features, labels = drive()
    slope = extra_features.slope_rad - 0.15
    velocity = labels[:, 1] * 0.0 + 0.9 - 0.3 * np.maximum(slope, 0.0)
    power = 14.0 + 62.0 * velocity / np.cos(slope) + np.maximum(velocity * (40.0 + 400.0 * np.tan(slope)), 0.0)
    moved, told = replace(extra_features, slope_rad=slope), np.column_stack([power, velocity])
    model = fit_physics_model(moved, told, idle_watt=14.0)
    assert [model.no_load_watt, model.drivetrain_newton] == pytest.approx([14.0, 62.0], rel=0.01)
    assert np.abs(_predict(model, moved)[:, 0] - power).mean() < 1.0


def test_what_is_not_known_is_as_usual():
    extra_features, labels = drive()
    model = fit_physics_model(extra_features, labels, idle_watt=50.0)
    unknown = replace(extra_features, turn_radpm=np.full(COUNT, np.nan))
    usual = replace(extra_features, turn_radpm=np.full(COUNT, np.mean(extra_features.turn_radpm)))
    assert _predict(model, unknown) == pytest.approx(_predict(model, usual))
    elsewhere = _predict(model, ExtraFeatures(np.array([2]), np.array([0.0]), np.array([0.0]), np.array([np.nan])))[0]
    assert 50.0 + 30.0 * 0.7 < elsewhere[0] < 50.0 + 60.0 * 1.0
    assert 0.75 < elsewhere[1] < 0.95


def test_without_turns_in_the_data_there_is_no_term_for_them():
    extra_features, labels = drive()
    blind = replace(extra_features, turn_radpm=np.full(COUNT, np.nan))
    assert not fit_physics_model(blind, labels, idle_watt=None).turning_joule_per_rad.any()


def test_too_few_samples_are_said():
    extra_features, labels = drive(count=19)
    with pytest.raises(ModelError, match="19 samples to fit physics to, expected at least 20"):
        fit_physics_model(extra_features, labels, idle_watt=None)
