"""The paper's network as a model, stopped by a fold of train; a checkpoint resumes an interrupted training exactly."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from tcpipe.arrays import Floats32, NamedArrays
from tcpipe.dataset.extra_features import (
    COLUMNS,
    ExtraFeatures,
    append_column_planes,
    append_planes,
    standardize_features,
)
from tcpipe.errors import ModelError
from tcpipe.formats.atomic import write_atomic_file
from tcpipe.learning.fitting import FitConfig, TrainingTimes, compute_loss_factors
from tcpipe.learning.predictor import (
    Fitted,
    Inputs,
    Job,
    Prediction,
    Predictor,
    Samples,
    compute_held_loss,
    predict_samples,
)
from tcpipe.progress import logger

if TYPE_CHECKING:
    from tcpipe.learning.network import ResNet18, Trainer


BLOCK, _MOST_WIDTH, _MOST_INPUTS = 16, 512, 1024
"""Channels combined by CPU convolutions: with fewer, oneDNN, which PyTorch uses there, writes beyond its memory in the
gradient of a 1 × 1 convolution with a stride (its issue 6035); it crashed with 4 and 8 filters."""

_SLOWER = 0.1  # factor of the learning rate when the loss stops falling

# Training that a crash loses at most, beyond an epoch [s]; an interruption loses only the epoch in which it occurs.
_SECONDS_BETWEEN = 60.0

_LAST = 0.8  # share of the maximum of epochs after which the rate is smaller in any case


def check_trainable(depth: int, outputs: int, width: int) -> None:
    """Raise `ModelError` if torch is not installed or the sizes are not possible."""
    if find_spec("torch") is None:
        raise ModelError("torch not installed, required to train or use a network: pip install 'tcpipe[train]'")
    if width % BLOCK or not BLOCK <= width <= _MOST_WIDTH:
        raise ModelError(f"a network of width {width}: expected a multiple of {BLOCK}, from {BLOCK} to {_MOST_WIDTH}")
    if not (0 < depth <= _MOST_INPUTS and 0 < outputs <= _MOST_INPUTS):
        raise ModelError(f"a network of {depth} channels and {outputs} outputs: expected 1 to {_MOST_INPUTS} of each")


@dataclass(slots=True)
class TrainingProgress:
    """Losses so far; ``best_epoch`` counts from 1, as does ``epoch``."""

    epoch: int = 0
    best_epoch: int = 0
    best_loss: float = float("inf")
    history: list[tuple[int, float, float]] = field(default_factory=list)
    """Epoch, loss, loss of the held-out fold."""


@dataclass(slots=True)
class _State:
    """All that a killed training continues from."""

    trainer: Trainer
    progress: TrainingProgress
    best: dict[str, Any]
    """Weights of the best epoch."""
    packed: bytes = b""
    """The state at the end of the last epoch."""
    written_s: float = float("-inf")

    def keep(self, path: Path) -> None:
        """Pack the state; write it if the last one was written long ago."""
        self.packed = self.trainer.pack_state({"progress": asdict(self.progress), "best": self.best})
        if time.monotonic() - self.written_s > _SECONDS_BETWEEN:
            self.write(path)

    def write(self, path: Path) -> None:
        """Write the packed state, whole or not at all."""
        with write_atomic_file(path) as temporary:
            temporary.write_bytes(self.packed)
        self.written_s = time.monotonic()

    def read(self, path: Path) -> None:
        """Continue from a file of `write`; `ModelError` if it is damaged."""
        parts = self.trainer.read_state(path)
        self.progress, self.best = TrainingProgress(**parts["progress"]), parts["best"]


@dataclass(frozen=True, slots=True)
class NetworkModel(Predictor):
    """ResNet-18 on patches and planes of features; its outputs are multiplied by the largest labels."""

    network: ResNet18
    inputs: Inputs

    stops_by_fold: ClassVar[bool] = True

    def predict(self, patches: Floats32, features: ExtraFeatures) -> Floats32:
        """Return the outputs."""
        numbers = standardize_features(self.inputs.extra_features, features)
        return self.network.predict(append_planes(patches, numbers)) * np.array(self.inputs.scale, np.float32)

    def to_arrays(self) -> NamedArrays:
        """Return every weight by its path in the network."""
        return self.network.arrays()

    @classmethod
    def from_arrays(cls, arrays: NamedArrays, inputs: Inputs) -> NetworkModel:
        """Return the network with these weights; its width is that of the first ones."""
        sizes = inputs.depth, len(inputs.outputs), arrays.get("stem.convolution.weight", np.empty(1)).shape[0]
        check_trainable(*sizes)
        from tcpipe.learning.network import ResNet18  # noqa: PLC0415  torch takes seconds and half a gigabyte

        return cls(ResNet18.from_arrays(*sizes, arrays=arrays), inputs)

    @classmethod
    def fit_folds(cls, samples: Samples, job: Job) -> Fitted:
        """Train until the loss of the held-out fold stops falling, and return the network with the smallest.

        ``job.checkpoint``, from which training continues, is the state at the end of an epoch. It is written before the
        first epoch, on interruption, and every `_SECONDS_BETWEEN`.
        """
        is_held = samples.folds == samples.config.fold
        fit, held = samples.take(~is_held), samples.take(is_held)
        trainer, device = _make_trainer(fit)
        model, times = cls(trainer.network, samples.inputs), TrainingTimes()
        state = _State(trainer, TrainingProgress(), trainer.copy_weights())
        logger.info("%s: %d samples to fit, %d for early stopping, on %s", job.name, len(fit), len(held), device)
        if job.checkpoint.exists():
            state.read(job.checkpoint)
            logger.info("%s: resumes after epoch %d", job.name, state.progress.epoch)
        state.keep(job.checkpoint)  # a place that cannot be written is found now, not after an epoch
        try:
            cls._fit_until_best(model, state, fit, held, job, times)
            state.write(job.checkpoint)  # later steps may fail
        except BaseException as error:
            if not isinstance(error, Exception):  # the user, or a signal
                state.write(job.checkpoint)
            raise
        trainer.network.load_state_dict(state.best)
        progress, held_out = state.progress, Prediction.without_covariance(np.full(samples.labels.shape, np.nan))
        held_out.mean[is_held] = predict_samples(model, held).mean
        return Fitted(model, held_out, progress.epoch, progress.best_epoch, progress.history, times, device)

    @classmethod
    def _fit_until_best(  # noqa: PLR0917
        cls, model: NetworkModel, state: _State, fit: Samples, held: Samples, job: Job, times: TrainingTimes
    ) -> None:
        """Train until the loss of ``held`` stops falling."""
        config, progress = fit.config, state.progress
        while progress.epoch < config.epochs and progress.epoch - progress.best_epoch < config.patience:
            loss = cls._train_epoch(state.trainer, fit, progress, times)
            held_loss = compute_held_loss(held, predict_samples(model, held).mean)
            progress.epoch += 1
            progress.history.append((progress.epoch, loss, held_loss))
            if held_loss < progress.best_loss:
                progress.best_loss, progress.best_epoch = held_loss, progress.epoch
                state.best = state.trainer.copy_weights()
            state.keep(job.checkpoint)
            _log_epoch(job.name, progress, config, times)

    @staticmethod
    def iterate_batches(fit: Samples, epoch: int) -> Iterator[tuple[Floats32, Floats32]]:
        """Yield patches (N, px, px, depth) and labels (N, outputs) of every sample once."""
        config, inputs = fit.config, fit.inputs
        rules: dict[str, Any] = {"features": COLUMNS} if inputs.extra_features else {}
        batches = fit.split.batches(config.batch_size, shuffle=True, seed=config.seed, mirror=config.mirror, **rules)
        feed: Iterator[Any] = batches.epoch(epoch)
        for patches, labels in feed:
            planes = append_column_planes(inputs.extra_features, *patches) if inputs.extra_features else patches
            yield planes, labels

    @classmethod
    def _train_epoch(cls, trainer: Trainer, fit: Samples, progress: TrainingProgress, times: TrainingTimes) -> float:
        """Train on every sample once; return the mean loss."""
        scale, rate = np.array(fit.inputs.scale, np.float32), compute_learning_rate(fit.config, progress)
        total, count, began = 0.0, 0, time.perf_counter()
        for patches, labels in cls.iterate_batches(fit, progress.epoch):
            total += trainer.step(patches, labels / scale, rate) * len(patches)
            count += len(patches)
        times.total_s += time.perf_counter() - began
        times.samples += count
        if not np.isfinite(total):
            raise ModelError(
                f"training diverged in epoch {progress.epoch + 1} (the loss is {total}); try a smaller --learning-rate"
            )
        return total / max(count, 1)


def _make_trainer(fit: Samples) -> tuple[Trainer, str]:
    """Return an untrained network with its optimiser, and its device."""
    config, scale = fit.config, fit.inputs.scale
    start = fit.labels.astype(np.float32).mean(axis=0) / scale
    sizes = fit.inputs.depth, len(fit.inputs.outputs), config.width
    check_trainable(*sizes)
    from tcpipe.learning.network import Trainer, find_device_name, make_resnet18  # noqa: PLC0415

    network = make_resnet18(*sizes, seed=config.seed, start=start.tolist())
    return Trainer(network, compute_loss_factors(config.loss, scale)), find_device_name()


def compute_learning_rate(config: FitConfig, progress: TrainingProgress) -> float:
    """Return the next epoch's rate: a tenth after half the patience without progress; in the last, a tenth of that.

    Constant steps end beside the minimum, and the moving means of the batch normalisation behind the weights:
    predictions of either have a bias.
    """
    rate, best, waited = config.learning_rate, float("inf"), 0
    for _, _, held in progress.history:
        waited = 0 if held < best else waited + 1
        best = min(best, held)
        if waited >= max(config.patience // 2, 1):
            rate, waited = rate * _SLOWER, 0
    return rate * (_SLOWER if progress.epoch >= _LAST * config.epochs else 1.0)


def _log_epoch(name: str, progress: TrainingProgress, config: FitConfig, times: TrainingTimes) -> None:
    epoch, loss, held = progress.history[-1]
    logger.info(
        "%s: epoch %d of at most %d: loss %.4f, held-out fold %.4f (best %.4f in epoch %d); %.0f samples/s",
        name, epoch, config.epochs, loss, held, progress.best_loss, progress.best_epoch,
        times.samples / max(times.total_s, 1e-9),
    )  # fmt: skip
