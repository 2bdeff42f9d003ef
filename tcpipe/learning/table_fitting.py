"""Fitting a table model: features of every patch, trees over them, and what each fold's samples were told by the other folds."""

from __future__ import annotations

import logging
import time

import numpy as np

from tcpipe.dataset import Split
from tcpipe.learning.checkpoint import TrainingProgress
from tcpipe.learning.fitting import FitConfig, Fitted, Spent, Task, label_scale, labels_of
from tcpipe.learning.forest import MOST_ROUNDS, grow
from tcpipe.learning.losses import loss_factors, mean_loss
from tcpipe.learning.patch_features import Floats, patch_features

logger = logging.getLogger("tcpipe")

_READ_TOGETHER = 1024


def fit_table(task: Task, config: FitConfig, *, name: str, key: str, patch_m: float, class_count: int) -> Fitted:
    """Fit trees to all of train, as many as its folds are told best by.

    Parameters
    ----------
    task, config
        What, and how labels are weighed.
    name
        For the line about progress.
    key
        Of dataset and options.
    patch_m
        Side of a patch [m].
    class_count
        Largest class id of the dataset's table.

    Raises
    ------
    ModelError
        LightGBM is not installed.

    """
    split, scale, began = task.train, label_scale(task), time.perf_counter()
    features = features_of(split, patch_m, class_count)
    labels = labels_of(split, task.outputs).astype(np.float64)
    weighed = config.weights and split.weights.shape == labels.shape
    weights = split.weights.astype(np.float64) if weighed else np.ones_like(labels)
    fed_s = time.perf_counter() - began
    logger.info("%s: %d samples of %d features, each predicted by the other folds", name, *features.shape)
    grown = grow(features, labels, weights, split.column("fold"))
    factors, over = loss_factors(config.loss, scale), np.array(scale)
    loss, held = (
        float(mean_loss(said / over, labels / over, factors, weights))
        for said in (grown.forest.predict(features), grown.held_out)
    )
    rounds = int(np.bincount(grown.forest.output).max())
    progress = TrainingProgress(key, MOST_ROUNDS, rounds, held, [(rounds, loss, held)])
    spent = Spent(time.perf_counter() - began, fed_s, len(split))
    return Fitted(grown.forest.arrays(), (1.0,) * labels.shape[1], split, grown.held_out, progress, spent, "cpu")


def features_of(split: Split, patch_m: float, class_count: int) -> Floats:
    """Return the features of all samples, shape (N, features); patches are formed some at a time."""
    parts = []
    for first in range(0, len(split), _READ_TOGETHER):
        patches = split.batch(np.arange(first, min(first + _READ_TOGETHER, len(split))))[0]
        parts.append(patch_features(patches, channels=split.channels, class_count=class_count, patch_m=patch_m))
    return np.concatenate(parts)
