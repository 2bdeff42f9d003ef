"""Fitting a network to one part of a dataset and stopping early by another, epoch by epoch, from where a checkpoint stands."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset import Split
from tcpipe.errors import ModelError
from tcpipe.learning.checkpoint import Arrays, TrainingProgress, read_checkpoint, write_checkpoint
from tcpipe.learning.keras_backend import load_keras
from tcpipe.learning.losses import Loss, keras_loss, loss_factors, mean_loss
from tcpipe.learning.network import Architecture, named_weights, resnet18

logger = logging.getLogger("tcpipe")

Floats = NDArray[np.float32]

ENERGY = "energy_joule"


@dataclass(frozen=True, slots=True)
class FitConfig:
    """How a network is trained; the paper gives ResNet-18, equation 4 and the learning rate."""

    loss: Loss = "nrmse"
    epochs: int = 100
    """At most."""
    patience: int = 12
    """Epochs without a better loss of the held-out fold before training stops."""
    batch: int = 64
    learning_rate: float = 1e-4
    seed: int = 0
    """Of weights, shuffles and mirrors."""
    fold: int = 0
    """Of train, that training is stopped by; the rest is fitted."""
    mirror: bool = True
    """Mirror every other patch across its direction of travel."""
    weights: bool = False
    """Weigh each label by its inverse variance."""
    width: int = 64
    """Filters of the first stage, a multiple of 16."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is fitted on what."""

    fit: Split
    held: Split
    outputs: tuple[str, ...]
    """The dataset's labels, or `ENERGY` alone."""


@dataclass(slots=True)
class Spent:
    """Where the time of training went [s], of this process."""

    total_s: float = 0.0
    feeding_s: float = 0.0
    """Sampling, shuffling, mirroring, batching."""
    samples: int = 0

    @property
    def feeding_share(self) -> float:
        """Return the share of the time in which the network waited for batches."""
        return self.feeding_s / self.total_s if self.total_s else 0.0


@dataclass(frozen=True, slots=True)
class Fitted:
    """A trained network with the best weights, what its labels were divided by, and how it went."""

    network: Any
    scale: tuple[float, ...]
    progress: TrainingProgress
    spent: Spent


def fit(task: Task, config: FitConfig, *, name: str, key: str, checkpoint: Path) -> Fitted:
    """Train until the held-out fold gets no better, and return the network as it was best.

    Parameters
    ----------
    task, config
        What and how.
    name
        For the lines about progress.
    key
        Of dataset and options, kept in the checkpoint.
    checkpoint
        Written before the first and after every epoch, and gone on from where it is.

    """
    keras = load_keras()
    scale = label_scale(task)
    factors = loss_factors(config.loss, scale)
    start = labels_of(task.fit, task.outputs).mean(axis=0) / scale
    shape = Architecture(task.fit.view.stored.files.patch_px, task.fit.view.form.depth, len(scale), config.width)
    network = resnet18(shape, seed=config.seed, start=start.tolist())
    network.compile(keras.optimizers.Adam(config.learning_rate), loss=keras_loss(factors))
    network.optimizer.build(network.trainable_variables)
    progress = TrainingProgress(key)
    best: Arrays = named_weights(network)
    if checkpoint.exists():
        progress, parts = read_checkpoint(checkpoint, key)
        _restore(network, parts, checkpoint)
        best = parts["best"]
        logger.info("%s: goes on after epoch %d", name, progress.epoch)
    else:  # a place that cannot be written is found now, not after an epoch
        write_checkpoint(checkpoint, progress, _state(network, best))
    spent = Spent()
    while progress.epoch < config.epochs and progress.epoch - progress.best_epoch < config.patience:
        loss = _epoch(network, task, config, scale=np.array(scale, np.float32), number=progress.epoch, spent=spent)
        held = held_loss(network, task, scale, factors, weighted=config.weights)
        progress.epoch += 1
        progress.history.append((progress.epoch, loss, held))
        if held < progress.best_loss:
            progress.best_loss, progress.best_epoch, best = held, progress.epoch, named_weights(network)
        write_checkpoint(checkpoint, progress, _state(network, best))
        _say(name, progress, config, spent)
    network.set_weights(list(best.values()))
    return Fitted(network, scale, progress, spent)


def label_scale(task: Task) -> tuple[float, ...]:
    """Return the largest label of each output among all of train: what labels are divided by."""
    labels = np.concatenate([labels_of(task.fit, task.outputs), labels_of(task.held, task.outputs)])
    return tuple(float(value) for value in labels.max(axis=0))


def predicted(network: Any, split: Split, scale: Sequence[float]) -> Floats:
    """Return what a network says of all samples of a split, in the labels' units, shape (N, outputs)."""
    found = [network.predict_on_batch(patches) for patches, _ in split.batches(256)]
    return np.concatenate([np.empty((0, len(scale)), np.float32), *found]) * np.array(scale, np.float32)


def held_loss(network: Any, task: Task, scale: Sequence[float], factors: Floats, *, weighted: bool) -> float:
    """Return the loss of the held-out fold."""
    over = np.array(scale, np.float32)
    weights = task.held.weights if weighted and len(over) == task.held.weights.shape[1] else None
    return mean_loss(
        predicted(network, task.held, scale) / over, labels_of(task.held, task.outputs) / over, factors, weights
    )


def labels_of(split: Split, outputs: Sequence[str]) -> Floats:
    """Return what a network is to predict of a split's samples, float32, shape (N, outputs)."""
    return split.column(ENERGY).astype(np.float32)[:, None] if tuple(outputs) == (ENERGY,) else split.labels


def _epoch(network: Any, task: Task, config: FitConfig, *, scale: Floats, number: int, spent: Spent) -> float:
    """Train on every sample once; return the mean loss."""
    energy = task.outputs == (ENERGY,)
    rules: dict[str, Any] = {"features": (ENERGY,)} if energy else {"weights": config.weights}
    batches = task.fit.batches(config.batch, shuffle=True, seed=config.seed, mirror=config.mirror, **rules)
    total, count, began = 0.0, 0, time.perf_counter()
    asked, feed = began, batches.epoch(number)
    while (batch := next(feed, None)) is not None:
        patches, labels = batch[0] if energy else batch[:2]
        weights = batch[2] if len(batch) == 3 else np.ones_like(labels)
        side_by_side = np.concatenate([labels / scale, weights], axis=1).astype(np.float32)
        spent.feeding_s += time.perf_counter() - asked
        total += float(network.train_on_batch(patches, side_by_side)) * len(patches)
        count += len(patches)
        asked = time.perf_counter()
    spent.total_s += time.perf_counter() - began
    spent.samples += count
    if not np.isfinite(total):
        raise ModelError(
            f"training diverged in epoch {number + 1} (the loss is {total}); try a smaller --learning-rate"
        )
    return total / max(count, 1)


def _optimizer_arrays(network: Any) -> Arrays:
    """Return the optimiser's memory: its step, and two moments a weight."""
    to_numpy = load_keras().ops.convert_to_numpy
    return {
        f"{number:04d}": np.array(to_numpy(value.value)) for number, value in enumerate(network.optimizer.variables)
    }


def _state(network: Any, best: Arrays) -> dict[str, Arrays]:
    """Return all arrays of a checkpoint."""
    return {"now": named_weights(network), "best": best, "optimizer": _optimizer_arrays(network)}


def _forms(arrays: Arrays) -> dict[str, tuple[Any, ...]]:
    return {name: (array.dtype, array.shape) for name, array in arrays.items()}


def _restore(network: Any, parts: dict[str, Arrays], checkpoint: Path) -> None:
    """Put weights and the optimiser's memory back."""
    there = _state(network, named_weights(network))
    if {part: _forms(arrays) for part, arrays in parts.items()} != {part: _forms(there[part]) for part in there}:
        raise ModelError(f"{checkpoint}: holds the weights of another network; remove it, or start anew with --fresh")
    network.set_weights([parts["now"][name] for name in there["now"]])
    network.optimizer.load_own_variables(
        {str(number): value for number, value in enumerate(parts["optimizer"].values())}
    )


def _say(name: str, progress: TrainingProgress, config: FitConfig, spent: Spent) -> None:
    epoch, loss, held = progress.history[-1]
    logger.info(
        "%s: epoch %d of at most %d: loss %.4f, held-out fold %.4f (best %.4f in epoch %d); %.0f samples/s, %.1f %% of the time feeding",
        name, epoch, config.epochs, loss, held, progress.best_loss, progress.best_epoch,
        spent.samples / max(spent.total_s, 1e-9), 100.0 * spent.feeding_share,
    )  # fmt: skip
