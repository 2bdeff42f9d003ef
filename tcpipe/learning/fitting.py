"""Fitting a network with early stopping on a held-out fold; checkpoints (one file) let a killed training continue unchanged."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset import Split
from tcpipe.dataset.energies import EnergyName
from tcpipe.dataset.extra_features import (
    COLUMNS,
    ExtraFeature,
    append_planes,
    read_extra_features,
    standardize_columns,
    standardize_features,
)
from tcpipe.errors import ModelError
from tcpipe.formats.weights import read_arrays, write_arrays
from tcpipe.learning.architecture import Architecture, Loss, check_trainable, compute_loss_factors, mean_loss
from tcpipe.tables.bounds import Bounds

if TYPE_CHECKING:
    from tcpipe.learning.network import ResNet18, Trainer

Arrays = Mapping[str, NDArray[np.generic]]

_STATE = "state"


@dataclass(slots=True)
class TrainingProgress:
    """Losses so far; ``best_epoch`` counts from 1, as does ``epoch``."""

    key: str
    """Of dataset and options: a checkpoint of others is not gone on from."""
    epoch: int = 0
    best_epoch: int = 0
    best_loss: float = float("inf")
    history: list[tuple[int, float, float]] = field(default_factory=list)
    """Epoch, loss, loss of the held-out fold."""


def write_checkpoint(
    path: Path, progress: TrainingProgress, parts: Mapping[str, Mapping[str, NDArray[np.generic]]]
) -> None:
    """Write where training stands and its weights, whole or not at all."""
    state = np.frombuffer(json.dumps(asdict(progress)).encode(), np.uint8)  # keeps what is infinite or not a number
    arrays = {f"{part}/{name}": array for part, named in parts.items() for name, array in named.items()}
    write_arrays(path, {_STATE: state, **arrays})


def read_checkpoint(path: Path, key: str) -> tuple[TrainingProgress, dict[str, Arrays]]:
    """Return what `write_checkpoint` wrote. `ModelError`: it is cut short, or of another dataset or other options."""
    try:
        arrays = read_arrays(path)
        progress = _read_progress(json.loads(arrays.pop(_STATE).tobytes()))
    except (ModelError, KeyError, TypeError, ValueError) as error:
        reason = error.problems[0].removeprefix(f"{path}: ") if isinstance(error, ModelError) else "not a checkpoint"
        raise ModelError(f"{path}: {reason}; remove it, or start again with --no-resume") from None
    if progress.key != key:
        raise ModelError(f"{path}: of another dataset or other options; remove it, or start again with --no-resume")
    parts: dict[str, dict[str, NDArray[np.generic]]] = {}
    for name, array in arrays.items():
        part, _, rest = name.partition("/")
        parts.setdefault(part, {})[rest] = array
    return progress, dict(parts)


def _read_progress(found: Any) -> TrainingProgress:
    """Return what was saved of a `TrainingProgress`; ValueError, TypeError or KeyError where it is none."""
    history = [(int(epoch), float(loss), float(held)) for epoch, loss, held in found["history"]]
    made = TrainingProgress(**{**found, "best_loss": float(found["best_loss"]), "history": history})
    if [row[0] for row in history] != list(range(1, made.epoch + 1)) or made.best_epoch not in range(made.epoch + 1):
        raise ValueError(made)
    return made


logger = logging.getLogger("tcpipe")

ModelKind = Literal["resnet18", "boosting", "physics"]
"""The paper's network on patches, boosted trees on features of them, or coefficients of physics."""

Seed = Annotated[int, Bounds(ge=0, le=2**32 - 1)]
"""What every generator of random numbers takes."""

Floats = NDArray[np.float32]

_SLOWER = 0.1
"""Factor of the learning rate when the loss stops falling."""

_TOGETHER = 256

_STEPS_BETWEEN = 32
"""Steps that a stop loses at most, unless an epoch has more: a state has 180 MB."""

_LAST = 0.8
"""Share of the maximum of epochs after which the rate is smaller in any case."""


@dataclass(frozen=True, slots=True)
class FitConfig:
    """How a model is trained; ResNet-18, equation 4 and the learning rate are the paper's.

    A table and physics use only loss, weights, label and beside.
    """

    model: ModelKind = "resnet18"
    loss: Loss = "nrmse"
    epochs: Annotated[int, Bounds(ge=1, le=100_000)] = 100
    """At most."""
    patience: Annotated[int, Bounds(ge=1, le=100_000)] = 12
    """Epochs without a better loss of the held-out fold before training stops."""
    batch_size: Annotated[int, Bounds(ge=1, le=65_536)] = 64
    learning_rate: Annotated[float, Bounds(gt=0, le=1)] = 1e-4
    seed: Seed = 0
    """Of weights, shuffles and mirrors."""
    fold: Annotated[int, Bounds(ge=0, le=99)] = 0
    """Of train, for early stopping; the rest is fitted."""
    mirror: bool = True
    """Mirror every other patch across its direction of travel."""
    inverse_variance_weights: bool = False
    """Weigh each label by its inverse variance."""
    width: Annotated[int, Bounds(ge=16, le=512)] = 64
    """Filters of the first stage, a multiple of 16."""
    label: EnergyName = "total"
    """Energy to train on: total, or net of idle power (less the idle power)."""
    extra_features: bool = False
    """Whether turn and commanded speed of each segment are inputs, too."""


@dataclass(frozen=True, slots=True)
class Task:
    """Samples to fit and to stop by, and what is learned of them."""

    train: Split
    """``fit`` and ``held`` together."""
    fit: Split
    held: Split
    outputs: tuple[str, ...]
    """The split's label columns, or its energy alone."""
    extra_features: tuple[ExtraFeature, ...] = ()
    """Inputs besides the patch."""


@dataclass(slots=True)
class TrainingTimes:
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
    """A trained model: its best weights, the factors of its outputs, and its predictions of held-out samples."""

    weights: Arrays
    scale: tuple[float, ...]
    held: Split
    """Samples that it was not trained on when it predicted them."""
    said: NDArray[np.floating]
    """What it predicted of them, in the labels' units, shape (N, outputs)."""
    progress: TrainingProgress
    training_times_s: TrainingTimes
    device: str


def fit(task: Task, config: FitConfig, *, name: str, key: str, checkpoint: Path) -> Fitted:
    """Train until the loss of the held-out fold stops falling, and return the network with the smallest.

    ``name`` is for progress messages. ``key``, of dataset and options, is kept in ``checkpoint``, from which training continues; it is
    written before the first epoch and then at least every `_STEPS_BETWEEN` steps.
    """
    scale = find_label_scale(task)
    factors = compute_loss_factors(config.loss, scale)
    trainer, device = _make_trainer(task, config, scale, factors)
    network = trainer.network
    logger.info("%s: %d samples to fit, %d to stop by, on %s", name, len(task.fit), len(task.held), device)
    progress = TrainingProgress(key)
    best: Arrays = network.arrays()
    if checkpoint.exists():
        progress, parts = read_checkpoint(checkpoint, key)
        _restore(trainer, parts, str(checkpoint))
        best = parts["best"]
        logger.info("%s: resumes after epoch %d", name, progress.epoch)
    else:  # a place that cannot be written is found now, not after an epoch
        write_checkpoint(checkpoint, progress, _state(trainer, best))
    training_times_s = TrainingTimes()
    while progress.epoch < config.epochs and progress.epoch - progress.best_epoch < config.patience:
        loss = _train_epoch(
            trainer,
            task,
            config,
            scale=np.array(scale, np.float32),
            progress=progress,
            training_times_s=training_times_s,
        )
        held = compute_held_loss(network, task, scale, factors, weighted=config.inverse_variance_weights)
        progress.epoch += 1
        progress.history.append((progress.epoch, loss, held))
        if held < progress.best_loss:
            progress.best_loss, progress.best_epoch, best = held, progress.epoch, network.arrays()
        if progress.epoch % max(_STEPS_BETWEEN * config.batch_size // len(task.fit), 1) == 0:
            write_checkpoint(checkpoint, progress, _state(trainer, best))
        _say(name, progress, config, training_times_s)
    network.set_arrays(best, str(checkpoint))
    return Fitted(
        best, scale, task.held, predict_split(network, task, task.held, scale), progress, training_times_s, device
    )


def _make_trainer(task: Task, config: FitConfig, scale: Sequence[float], factors: Floats) -> tuple[Trainer, str]:
    """Return an untrained network with its optimiser, and what it runs on."""
    start = collect_labels(task.fit, task.outputs).mean(axis=0) / scale
    shape = Architecture(
        task.fit.view.stored.files.patch_px,
        task.fit.view.form.depth,
        len(scale),
        config.width,
        len(task.extra_features),
    )
    check_trainable(shape)
    from tcpipe.learning.network import (  # noqa: PLC0415  torch takes seconds and half a gigabyte
        Trainer,
        find_device_name,
        make_resnet18,
    )

    return Trainer(make_resnet18(shape, seed=config.seed, start=start.tolist()), factors), find_device_name()


def find_label_scale(task: Task) -> tuple[float, ...]:
    """Return the largest label of each output among all of train: what labels are divided by."""
    return tuple(float(value) for value in collect_labels(task.train, task.outputs).max(axis=0))


def predict_split(network: ResNet18, task: Task, split: Split, scale: Sequence[float]) -> Floats:
    """Return what a network says of all samples of a split, in the labels' units, shape (N, outputs)."""
    numbers, found, first = (
        standardize_features(task.extra_features, read_extra_features(split)),
        [np.empty((0, len(scale)), np.float32)],
        0,
    )
    batches: Iterable[Any] = split.batches(_TOGETHER)
    for patches, _ in batches:
        found.append(network.predict(append_planes(patches, numbers[first : first + len(patches)])))
        first += len(patches)
    return np.concatenate(found) * np.array(scale, np.float32)


def compute_held_loss(
    network: ResNet18, task: Task, scale: Sequence[float], factors: Floats, *, weighted: bool
) -> float:
    """Return the loss of the held-out fold."""
    over = np.array(scale, np.float32)
    labels = collect_labels(task.held, task.outputs) / over
    weights = task.held.weights if weighted and len(over) == task.held.weights.shape[1] else np.ones_like(labels)
    return float(mean_loss(predict_split(network, task, task.held, scale) / over, labels, factors, weights))


def compute_learning_rate(config: FitConfig, progress: TrainingProgress) -> float:
    """Return the rate of the next epoch: a tenth each time that half the patience brings nothing better, and a tenth of that at the end.

    Steps of one length end beside the minimum, and the moving means of the batch normalisation behind the weights: predictions of
    either are off on average.
    """
    rate, best, waited = config.learning_rate, float("inf"), 0
    for _, _, held in progress.history:
        waited = 0 if held < best else waited + 1
        best = min(best, held)
        if waited >= max(config.patience // 2, 1):
            rate, waited = rate * _SLOWER, 0
    return rate * (_SLOWER if progress.epoch >= _LAST * config.epochs else 1.0)


def collect_labels(split: Split, outputs: Sequence[str]) -> Floats:
    """Return what a network is to predict of a split's samples, float32, shape (N, outputs)."""
    return split.column(outputs[0]).astype(np.float32)[:, None] if len(outputs) == 1 else split.labels


def _train_epoch(
    trainer: Trainer,
    task: Task,
    config: FitConfig,
    *,
    scale: Floats,
    progress: TrainingProgress,
    training_times_s: TrainingTimes,
) -> float:
    """Train on every sample once; return the mean loss."""
    energy = len(task.outputs) == 1
    rules: dict[str, Any] = {"features": task.outputs} if energy else {"weights": config.inverse_variance_weights}
    if task.extra_features:
        rules["features"] = COLUMNS
    batches = task.fit.batches(config.batch_size, shuffle=True, seed=config.seed, mirror=config.mirror, **rules)
    rate = compute_learning_rate(config, progress)
    total, count, began = 0.0, 0, time.perf_counter()
    feed: Iterator[Any] = batches.epoch(progress.epoch)
    asked = began
    while (batch := next(feed, None)) is not None:
        patches, labels = batch[0] if energy else batch[:2]
        if task.extra_features:
            patches = append_planes(patches[0], standardize_columns(task.extra_features, patches[1]))
        weights = batch[2] if len(batch) == 3 else np.ones_like(labels)
        training_times_s.feeding_s += time.perf_counter() - asked
        total += trainer.step(patches, labels / scale, weights, rate) * len(patches)
        count += len(patches)
        asked = time.perf_counter()
    training_times_s.total_s += time.perf_counter() - began
    training_times_s.samples += count
    if not np.isfinite(total):
        raise ModelError(
            f"training diverged in epoch {progress.epoch + 1} (the loss is {total}); try a smaller --learning-rate"
        )
    return total / max(count, 1)


def _state(trainer: Trainer, best: Arrays) -> dict[str, Arrays]:
    """Return all arrays of a checkpoint."""
    return {"now": trainer.network.arrays(), "best": best, "optimizer": trainer.copy_optimizer_state()}


def _restore(trainer: Trainer, parts: dict[str, Arrays], where: str) -> None:
    """Put weights, the best ones for a look, and the optimiser's memory back."""
    if parts.keys() != {"now", "best", "optimizer"}:
        raise ModelError(f"{where}: not a checkpoint; remove it, or start again with --no-resume")
    for part in ("best", "now"):
        trainer.network.set_arrays(parts[part], where)
    trainer.load_optimizer_state(parts["optimizer"], where)


def _say(name: str, progress: TrainingProgress, config: FitConfig, training_times_s: TrainingTimes) -> None:
    epoch, loss, held = progress.history[-1]
    logger.info(
        "%s: epoch %d of at most %d: loss %.4f, held-out fold %.4f (best %.4f in epoch %d); %.0f samples/s, %.1f %% of the time feeding",
        name, epoch, config.epochs, loss, held, progress.best_loss, progress.best_epoch,
        training_times_s.samples / max(training_times_s.total_s, 1e-9), 100.0 * training_times_s.feeding_share,
    )  # fmt: skip
