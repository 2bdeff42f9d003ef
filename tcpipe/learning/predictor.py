"""Protocol of a model of the cost of a metre, and the kinds of models.

The kinds in tcpipe implement `Predictor` and nothing else, so that your own model has the same abilities. A kind is a
class; only ``predict`` is needed, ``fit`` for training, and ``to_arrays`` with ``from_arrays`` for a model folder::

    class MeanOfClass:
        @classmethod
        def fit(cls, samples): ...                     # Samples: patches, features, labels, folds
        def predict(self, patches, features): ...  # power [W], velocity [m/s], (N, 2), or with covariances (N, 2, 2)
        def to_arrays(self): ...                       # dict of numpy arrays
        @classmethod
        def from_arrays(cls, arrays, inputs): ...      # Inputs: channels, size of a patch, classes

``patches`` are float32 (N, px, px, channels) in [0, 1], travel to the right; ``features``
(`tcpipe.dataset.extra_features.ExtraFeatures`) has slope, terrain class, turn and commanded speed of each. Intervals
come from predictions of samples that a model was not fitted to: ``fit`` is called without each fold, unless the class
has ``fit_folds``, and without each fifth of the runs. Their errors are the covariance of a model that returns none, and
scale that of one that does (`tcpipe.cost.prediction_errors`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import ClassVar, Protocol, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Floats32, GenericArray, Ints, Mask, NamedArrays
from tcpipe.dataset import Split
from tcpipe.dataset.extra_features import ExtraFeature, ExtraFeatures, read_extra_features
from tcpipe.errors import ModelError
from tcpipe.learning.fitting import FitConfig, ModelKind, TrainingTimes, compute_loss_factors, mean_loss

Patches: TypeAlias = Floats32
Labels: TypeAlias = NDArray[np.floating]


@dataclass(frozen=True, slots=True)
class Inputs:
    """Inputs and outputs of a model."""

    channels: tuple[str, ...]
    """Layers of the patches."""
    patch_px: int
    planes: tuple[str, ...]
    """Names along the last axis of patches: a channel, or ``name[1]``, ``name[2]`` … of one with several planes."""
    patch_m: float
    class_count: int
    """Largest class id of the table by which the terrain channel is scaled."""
    extra_features: tuple[ExtraFeature, ...]
    """Known features other than slope and class, with their distribution over the training samples."""
    outputs: tuple[str, ...]
    """Columns: power and velocity, or velocity alone (a dataset without power)."""
    scale: tuple[float, ...]
    """Largest label of each output in train."""

    @property
    def is_time_alone(self) -> bool:
        """Whether it predicts velocity and so time, but no power."""
        return len(self.outputs) == 1

    @property
    def depth(self) -> int:
        """Return the number of planes of a network's input: the planes of a patch, and one for each extra feature."""
        return len(self.planes) + len(self.extra_features)


@dataclass(frozen=True, slots=True)
class Prediction:
    """Outputs of N metres of ground, power [W] and velocity [m/s], and the covariances of their errors."""

    mean: Floats
    """Shape (N, outputs)."""
    covariance: Floats
    """Shape (N, outputs, outputs); 0 if a model states none."""

    @classmethod
    def without_covariance(cls, mean: Labels) -> Prediction:
        """Return a prediction of a model that states no covariances."""
        return cls(np.asarray(mean, float), np.zeros((*mean.shape, mean.shape[-1])))

    @classmethod
    def concatenate(cls, parts: Sequence[Prediction]) -> Prediction:
        """Return predictions one after another."""
        return cls(np.concatenate([part.mean for part in parts]), np.concatenate([part.covariance for part in parts]))

    def add_unknown_power(self) -> Prediction:
        """Return predictions of velocity alone as predictions of power and velocity; the power is NaN."""
        mean, covariance = np.full((len(self.mean), 2), np.nan), np.zeros((len(self.mean), 2, 2))
        mean[:, 1], covariance[:, 1, 1] = self.mean[:, 0], self.covariance[:, 0, 0]
        return Prediction(mean, covariance)

    def take(self, rows: Mask) -> Prediction:
        """Return some of them."""
        return Prediction(self.mean[rows], self.covariance[rows])


@dataclass(frozen=True)
class Samples:
    """Labelled samples that a model is fitted to."""

    split: Split
    """Samples of the dataset: every column of samples.parquet, and patches batch by batch."""
    inputs: Inputs
    config: FitConfig
    idle_watt: float | None
    """Idle power [W]; None if no run measures it."""

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.split)

    def take(self, rows: Ints | Mask) -> Samples:
        """Return some of them."""
        return replace(self, split=self.split.take(rows))

    @property
    def patches(self) -> Patches:
        """All patches in one array, shape (N, px, px, channels)."""
        return self.split.patches

    @cached_property
    def features(self) -> ExtraFeatures:
        """Slope, class, turn and commanded speed."""
        return read_extra_features(self.split)

    @cached_property
    def labels(self) -> Floats:
        """Labels, shape (N, outputs)."""
        return self.split.labels.astype(float)

    @property
    def folds(self) -> GenericArray:
        """Fold of each sample for cross-validation; a fold is a set of blocks of ground, or of runs."""
        return self.split.column("fold")


@dataclass(frozen=True, slots=True)
class Job:
    """A training: its name in messages, and the file of its state."""

    name: str
    checkpoint: Path


@dataclass(frozen=True, slots=True)
class Fitted:
    """A fitted model, and held-out predictions by it or by models of the other folds."""

    predictor: Predictor
    held_out: Prediction
    """NaN for samples that the model was fitted to."""
    epochs: int = 1
    best_epoch: int = 1
    """Or the number of trees of an output."""
    history: Sequence[tuple[int, float, float]] = ()
    """Epoch, loss, held-out loss."""
    training_times_s: TrainingTimes = field(default_factory=TrainingTimes)
    device: str = "cpu"


class Predictor(Protocol):
    """A kind of model. Everything but ``predict`` has a default."""

    channels: ClassVar[tuple[str, ...]] = ()
    """Channels that it uses; empty: all of the dataset."""
    features: ClassVar[tuple[str, ...] | None] = None
    """Extra features that it takes: ``turn_radpm``, ``command_mps``; None: both, with --extra-features."""
    stops_by_fold: ClassVar[bool] = False
    """Whether one fold of train stops its training, and the others alone are fitted."""

    def predict(self, patches: Patches, features: ExtraFeatures) -> Labels | tuple[Labels, Labels]:
        """Return outputs of N metres of ground, shape (N, outputs): power [W] and velocity [m/s].

        Or these and the covariances of their errors, shape (N, outputs, outputs), in squares and products of these
        units.
        """

    @classmethod
    def fit(cls, samples: Samples) -> Predictor:
        """Return the model fitted to samples; the default returns an unfitted one."""
        del samples
        return cls()

    @classmethod
    def fit_folds(cls, samples: Samples, job: Job) -> Fitted:
        """Return the model fitted to all samples, and predictions of each by a model of the other folds."""
        del job
        began, held_out = time.perf_counter(), cross_predict(cls, samples, samples.folds)
        whole = cls.fit(samples)
        return Fitted(whole, held_out, training_times_s=TrainingTimes(time.perf_counter() - began, len(samples)))

    def to_arrays(self) -> NamedArrays:
        """Return all that `from_arrays` needs."""
        return {}

    @classmethod
    def from_arrays(cls, arrays: NamedArrays, inputs: Inputs) -> Predictor:
        """Return the model that `to_arrays` stored; `ModelError` if the arrays belong to another kind."""
        del arrays, inputs
        return cls()


KINDS: Mapping[ModelKind, str] = {
    "linear": "tcpipe.learning.physics_model:CurveModel",
    "physics": "tcpipe.learning.physics_model:PhysicsModel",
    "boosting": "tcpipe.learning.table_model:BoostingModel",
    "resnet18": "tcpipe.learning.network_model:NetworkModel",
    "own": "tcpipe.learning.predictor:Predictor",
}
"""Class of each kind, simplest first; a class is imported when it is needed."""


AUTOMATIC: tuple[ModelKind, ...] = ("linear", "physics", "boosting")
"""Kinds from which the default is chosen, simplest first."""


def find_kind(name: ModelKind) -> type[Predictor]:
    """Return the class of a kind."""
    module, _, attribute = KINDS[name].partition(":")
    return cast("type[Predictor]", getattr(import_module(module), attribute))


def cross_predict(kind: type[Predictor], samples: Samples, parts: GenericArray) -> Prediction:
    """Return predictions of each part of the samples by a model of the others."""
    require_folds(parts)
    out = Prediction.without_covariance(np.empty_like(samples.labels))
    for part in np.unique(parts):
        held = parts == part
        prediction = predict_samples(kind.fit(samples.take(~held)), samples.take(held))
        out.mean[held], out.covariance[held] = prediction.mean, prediction.covariance
    return out


def require_folds(folds: GenericArray) -> None:
    """Raise `ModelError` unless there are two folds or more."""
    if len(np.unique(folds)) < 2:
        raise ModelError(f"{len(folds)} training samples are in one fold, expected two or more")


def predict_samples(predictor: Predictor, samples: Samples) -> Prediction:
    """Return predictions of samples; their patches are formed some at a time."""
    parts, together = list[Prediction](), samples.split.view.form.batch_rows
    for first in range(0, len(samples), together):
        rows = np.arange(first, min(first + together, len(samples)))
        patches = samples.split.batch(rows)[0]
        parts.append(ask_predictor(predictor, patches, samples.features.take(rows), samples.inputs.outputs))
    nothing = np.empty((0, len(samples.inputs.outputs)))
    return Prediction.concatenate([Prediction.without_covariance(nothing), *parts])


_ROUNDING = 1e-6  # negative share of the largest eigenvalue up to which a covariance counts as one


def ask_predictor(
    predictor: Predictor, patches: Patches, features: ExtraFeatures, outputs: Sequence[str]
) -> Prediction:
    """Return predictions of patches; `ModelError` if a model gives something else."""
    prediction, count, named = predictor.predict(patches, features), len(outputs), " and ".join(outputs)
    name = type(predictor).__name__
    who = name if name == "predict" else f"{name}.predict"
    is_pair = isinstance(prediction, tuple) and len(prediction) == 2
    mean: Floats = np.array(prediction[0] if is_pair else prediction, float)
    if mean.shape != (len(patches), count):
        raise ModelError(
            f"{who} returned shape {mean.shape}, expected {(len(patches), count)}: {named} of {len(patches)} patches"
        )
    if not is_pair:
        return Prediction.without_covariance(mean)
    covariance: Floats = np.array(prediction[1], float)
    if covariance.shape != (*mean.shape, count):
        raise ModelError(
            f"{who} returned covariances of shape {covariance.shape}, expected {(*mean.shape, count)}: those of {named}"
        )
    transposed = covariance.transpose(0, 2, 1)
    eigenvalues = np.linalg.eigvalsh(np.where(np.isfinite(covariance + transposed), covariance, -np.eye(count)))
    wrong = eigenvalues.min(axis=1) < -_ROUNDING * np.abs(eigenvalues).max(axis=1)
    wrong |= ~np.isclose(covariance, transposed, rtol=1e-4, atol=0.0).all(axis=(1, 2))
    if wrong.any():
        raise ModelError(
            f"{who} returned {int(wrong.sum())} of {len(mean)} covariances that are invalid: "
            "expected finite symmetric matrices "
            "without negative eigenvalues"
        )
    return Prediction(mean, covariance)


def find_held_out(held_out: Prediction) -> Mask:
    """Return which samples have a held-out prediction, shape (N,)."""
    return np.asarray(np.isfinite(held_out.mean).all(axis=1))


def compute_held_loss(held: Samples, predicted: Labels) -> float:
    """Return the loss of predictions of held-out samples, by the loss of the options."""
    scale = np.array(held.inputs.scale, np.float32)
    labels, predicted = (values.astype(np.float32) / scale for values in (held.labels, predicted))
    return float(mean_loss(predicted, labels, compute_loss_factors(held.config.loss, held.inputs.scale)))
