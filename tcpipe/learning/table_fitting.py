"""Fitting a table model or physics, without epochs; models of the other folds also predict each sample."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset import Split
from tcpipe.dataset.extra_features import read_extra_features, standardize_features
from tcpipe.learning.architecture import compute_loss_factors, mean_loss
from tcpipe.learning.fitting import (
    FitConfig,
    Fitted,
    Task,
    TrainingProgress,
    TrainingTimes,
    collect_labels,
    find_label_scale,
)
from tcpipe.learning.physics_model import find_idle_power, fit_physics_model
from tcpipe.learning.table_model import Floats, compute_patch_features, fit_table

logger = logging.getLogger("tcpipe")

_READ_TOGETHER = 1024


@dataclass(frozen=True, slots=True)
class _FittedModel:
    """A model's arrays, what it and what those of the other folds said of each sample, (N, outputs); how large it is."""

    weights: dict[str, NDArray[np.generic]]
    said: Floats
    held_out: Floats
    rounds: int
    fed_s: float = 0.0


def fit_at_once(task: Task, config: FitConfig, *, name: str, key: str, patch_m: float, class_count: int) -> Fitted:
    """Fit a table or physics to all of train.

    Parameters
    ----------
    task, config : what, and how labels are weighed.
    name : for the line about progress.
    key : of dataset and options.
    patch_m : side of a patch [m].
    class_count : largest class id of the dataset's table.

    Raises
    ------
    ModelError : LightGBM is not installed, or there are too few samples.
    """
    split, scale, began = task.train, find_label_scale(task), time.perf_counter()
    labels = collect_labels(split, task.outputs).astype(np.float64)
    weighed = config.inverse_variance_weights and split.weights.shape == labels.shape
    weights = split.weights.astype(np.float64) if weighed else np.ones_like(labels)
    logger.info("%s: %d samples, each predicted by the other folds", name, len(split))
    made = (
        _fit_physics(split, labels)
        if config.model == "physics"
        else _fit_trees(task, labels, weights, patch_m, class_count)
    )
    factors, over = compute_loss_factors(config.loss, scale), np.array(scale)
    loss, held = (float(mean_loss(said / over, labels / over, factors, weights)) for said in (made.said, made.held_out))
    progress = TrainingProgress(key, made.rounds, made.rounds, held, [(made.rounds, loss, held)])
    training_times_s = TrainingTimes(time.perf_counter() - began, made.fed_s, len(split))
    return Fitted(made.weights, (1.0,) * labels.shape[1], split, made.held_out, progress, training_times_s, "cpu")


def _fit_trees(task: Task, labels: Floats, weights: Floats, patch_m: float, class_count: int) -> _FittedModel:
    """Grow trees, as many as the folds are told best by."""
    split, began = task.train, time.perf_counter()
    numbers = standardize_features(task.extra_features, read_extra_features(split))
    features = np.column_stack([compute_features(split, patch_m, class_count), numbers])
    fed_s = time.perf_counter() - began
    model, held_out = fit_table(
        features, labels, weights, split.column("fold"), channels=split.channels, class_count=class_count
    )
    rounds = int(np.bincount(model.forest.output).max())
    return _FittedModel(model.arrays(), model.predict(features), held_out, rounds, fed_s)


def _fit_physics(split: Split, labels: Floats) -> _FittedModel:
    """Fit physics to all, and to all but each fold."""
    extra_features, folds, idle_watt = read_extra_features(split), split.column("fold"), find_idle_power(split)
    held_out = np.empty_like(labels)
    for fold in np.unique(folds):
        held = folds == fold
        fitted = fit_physics_model(extra_features.take(~held), labels[~held], idle_watt=idle_watt)
        held_out[held] = fitted.predict(extra_features.take(held))
    whole = fit_physics_model(extra_features, labels, idle_watt=idle_watt)
    return _FittedModel(whole.arrays(), whole.predict(extra_features), held_out, 1)


def compute_features(split: Split, patch_m: float, class_count: int) -> Floats:
    """Return the features of all samples, shape (N, features); patches are formed some at a time."""
    parts = []
    for first in range(0, len(split), _READ_TOGETHER):
        patches = split.batch(np.arange(first, min(first + _READ_TOGETHER, len(split))))[0]
        parts.append(compute_patch_features(patches, channels=split.channels, class_count=class_count, patch_m=patch_m))
    return np.concatenate(parts)
