"""The paper's network as a model: fitted in epochs, stopped by a fold of train; a checkpoint lets a killed training continue unchanged."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset.extra_features import (
    COLUMNS,
    ExtraFeatures,
    append_column_planes,
    append_planes,
    standardize_features,
)
from tcpipe.errors import ModelError
from tcpipe.formats.weights import check_arrays, read_arrays, write_arrays
from tcpipe.learning.architecture import Architecture, check_trainable, compute_loss_factors, list_weight_forms
from tcpipe.learning.fitting import FitConfig, TrainingTimes
from tcpipe.learning.predictor import Fitted, Inputs, Job, Predictor, Samples, compute_held_loss, predict_samples

if TYPE_CHECKING:
    from tcpipe.learning.network import ResNet18, Trainer

Arrays = Mapping[str, NDArray[np.generic]]
Floats = NDArray[np.float32]

logger = logging.getLogger("tcpipe")

_STATE = "state"

_SLOWER = 0.1
"""Factor of the learning rate when the loss stops falling."""

_STEPS_BETWEEN = 32
"""Steps that a stop loses at most, unless an epoch has more: a state has 180 MB."""

_LAST = 0.8
"""Share of the maximum of epochs after which the rate is smaller in any case."""


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


@dataclass(frozen=True, slots=True)
class NetworkModel(Predictor):
    """ResNet-18 on patches and planes of features; its outputs are multiplied by the largest labels."""

    network: ResNet18
    inputs: Inputs

    about: ClassVar[str] = (
        "ResNet-18, stopped by one fold of train; its intervals rest on its errors on that fold, slightly too small, "
        "or with train.cross_fit on those of networks without each fold"
    )
    optimizer: ClassVar[str] = "Adam"
    stops_by_fold: ClassVar[bool] = True

    def predict(self, patches: Floats, features: ExtraFeatures) -> Floats:
        """Return the outputs."""
        numbers = standardize_features(self.inputs.extra_features, features)
        return self.network.predict(append_planes(patches, numbers)) * np.array(self.inputs.scale, np.float32)

    def to_arrays(self) -> Arrays:
        """Return every weight by its path in the network."""
        return self.network.arrays()

    @classmethod
    def from_arrays(cls, arrays: Arrays, inputs: Inputs) -> NetworkModel:
        """Return the network with these weights; its width is that of the first ones."""
        stem = arrays.get("stem_convolution/kernel", np.empty(0))
        shape = make_architecture(inputs, stem.shape[-1])
        check_arrays(arrays, list_weight_forms(shape))
        check_trainable(shape)
        from tcpipe.learning.network import make_resnet18  # noqa: PLC0415  torch takes seconds and half a gigabyte

        network = make_resnet18(shape, seed=0, start=[0.0] * shape.outputs)
        network.set_arrays(arrays)
        return cls(network, inputs)

    @classmethod
    def fit_folds(cls, samples: Samples, job: Job) -> Fitted:
        """Train until the loss of the held-out fold stops falling, and return the network with the smallest.

        ``job.checkpoint``, from which training continues, is written before the first epoch and then at least every `_STEPS_BETWEEN` steps.
        """
        config, is_held = samples.config, samples.folds == samples.config.fold
        fit, held = samples.take(~is_held), samples.take(is_held)
        trainer, device = _make_trainer(fit)
        model = cls(trainer.network, samples.inputs)
        best: Arrays = trainer.network.arrays()
        logger.info("%s: %d samples to fit, %d to stop by, on %s", job.name, len(fit), len(held), device)
        progress = TrainingProgress(job.key)
        if job.checkpoint.exists():
            progress, parts = read_checkpoint(job.checkpoint, job.key)
            _restore(trainer, parts, job.checkpoint)
            best = parts["best"]
            logger.info("%s: resumes after epoch %d", job.name, progress.epoch)
        else:  # a place that cannot be written is found now, not after an epoch
            write_checkpoint(job.checkpoint, progress, _state(trainer, best))
        times = TrainingTimes()
        while progress.epoch < config.epochs and progress.epoch - progress.best_epoch < config.patience:
            loss = _train_epoch(trainer, fit, progress, times)
            held_loss = compute_held_loss(held, predict_samples(model, held))
            progress.epoch += 1
            progress.history.append((progress.epoch, loss, held_loss))
            if held_loss < progress.best_loss:
                progress.best_loss, progress.best_epoch, best = held_loss, progress.epoch, trainer.network.arrays()
            if progress.epoch % max(_STEPS_BETWEEN * config.batch_size // len(fit), 1) == 0:
                write_checkpoint(job.checkpoint, progress, _state(trainer, best))
            _log_epoch(job.name, progress, config, times)
        trainer.network.set_arrays(best)
        held_out = np.full(samples.labels.shape, np.nan)
        held_out[is_held] = predict_samples(model, held)
        for fold in np.setdiff1d(np.unique(samples.folds), [config.fold]) if config.cross_fit else ():
            rows = samples.folds == fold
            logger.info("%s: a network without fold %d, for intervals", job.name, fold)
            held_out[rows] = predict_samples(
                cls._fit_best_epochs(samples.take(~rows), progress, times), samples.take(rows)
            )
        return Fitted(model, held_out, progress.epoch, progress.best_epoch, progress.history, times, device)

    @classmethod
    def _fit_best_epochs(cls, fit: Samples, like: TrainingProgress, times: TrainingTimes) -> NetworkModel:
        """Return a network of other samples after as many epochs as were best, at the same rates."""
        trainer, _ = _make_trainer(fit)
        for epoch in range(like.best_epoch):
            _train_epoch(trainer, fit, TrainingProgress(like.key, epoch=epoch, history=like.history[:epoch]), times)
        return cls(trainer.network, fit.inputs)


def make_architecture(inputs: Inputs, width: int) -> Architecture:
    """Return the sizes of a network with these inputs and outputs."""
    return Architecture(inputs.patch_px, len(inputs.planes), len(inputs.outputs), width, len(inputs.extra_features))


def _make_trainer(fit: Samples) -> tuple[Trainer, str]:
    """Return an untrained network with its optimiser, and what it runs on."""
    config, scale = fit.config, fit.inputs.scale
    start = fit.labels.astype(np.float32).mean(axis=0) / scale
    shape = make_architecture(fit.inputs, config.width)
    check_trainable(shape)
    from tcpipe.learning.network import (  # noqa: PLC0415  torch takes seconds and half a gigabyte
        Trainer,
        find_device_name,
        make_resnet18,
    )

    network = make_resnet18(shape, seed=config.seed, start=start.tolist())
    return Trainer(network, compute_loss_factors(config.loss, scale)), find_device_name()


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


def _train_epoch(trainer: Trainer, fit: Samples, progress: TrainingProgress, times: TrainingTimes) -> float:
    """Train on every sample once; return the mean loss."""
    inputs, config, scale = fit.inputs, fit.config, np.array(fit.inputs.scale, np.float32)
    energy = len(inputs.outputs) == 1
    rules: dict[str, Any] = {"features": inputs.outputs} if energy else {"weights": config.inverse_variance_weights}
    if inputs.extra_features:
        rules["features"] = COLUMNS
    batches = fit.split.batches(config.batch_size, shuffle=True, seed=config.seed, mirror=config.mirror, **rules)
    rate = compute_learning_rate(config, progress)
    total, count, began = 0.0, 0, time.perf_counter()
    feed: Iterator[Any] = batches.epoch(progress.epoch)
    asked = began
    while (batch := next(feed, None)) is not None:
        patches, labels = batch[0] if energy else batch[:2]
        if inputs.extra_features:
            patches = append_column_planes(inputs.extra_features, *patches)
        weights = batch[2] if len(batch) == 3 else np.ones_like(labels)
        times.feeding_s += time.perf_counter() - asked
        total += trainer.step(patches, labels / scale, weights, rate) * len(patches)
        count += len(patches)
        asked = time.perf_counter()
    times.total_s += time.perf_counter() - began
    times.samples += count
    if not np.isfinite(total):
        raise ModelError(
            f"training diverged in epoch {progress.epoch + 1} (the loss is {total}); try a smaller --learning-rate"
        )
    return total / max(count, 1)


def _state(trainer: Trainer, best: Arrays) -> dict[str, Arrays]:
    """Return all arrays of a checkpoint."""
    return {"now": trainer.network.arrays(), "best": best, "optimizer": trainer.copy_optimizer_state()}


def _restore(trainer: Trainer, parts: dict[str, Arrays], checkpoint: Path) -> None:
    """Put weights, the best ones for a look, and the optimiser's memory back."""
    if parts.keys() != {"now", "best", "optimizer"}:
        raise ModelError(f"{checkpoint}: not a checkpoint; remove it, or start again with --no-resume")
    try:
        for part in ("best", "now"):
            trainer.network.set_arrays(parts[part])
        trainer.load_optimizer_state(parts["optimizer"])
    except ModelError as error:
        raise ModelError(f"{checkpoint}: {error.problems[0]}") from None


def _log_epoch(name: str, progress: TrainingProgress, config: FitConfig, times: TrainingTimes) -> None:
    epoch, loss, held = progress.history[-1]
    logger.info(
        "%s: epoch %d of at most %d: loss %.4f, held-out fold %.4f (best %.4f in epoch %d); %.0f samples/s, %.1f %% of the time feeding",
        name, epoch, config.epochs, loss, held, progress.best_loss, progress.best_epoch,
        times.samples / max(times.total_s, 1e-9), 100.0 * times.feeding_share,
    )  # fmt: skip
