"""How models are trained: options, samples and labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset import Split
from tcpipe.dataset.energies import EnergyName
from tcpipe.learning.architecture import Loss
from tcpipe.recipe import TrainConfig
from tcpipe.tables.bounds import Bounds

Floats = NDArray[np.float32]

ModelKind = Literal["mean", "linear", "spline", "physics", "boosting", "residual", "resnet18", "onnx", "own"]
"""Curves of class and slope, physics, a curve and boosted trees or a small network, the paper's network, a graph, or own code."""

Seed = Annotated[int, Bounds(ge=0, le=2**32 - 1)]
"""What every generator of random numbers takes."""


@dataclass(frozen=True, slots=True)
class FitConfig(TrainConfig):
    """How a model is trained: the settings of the recipe, and the choices of a call."""

    model: ModelKind | Literal["auto"] = "resnet18"
    """``auto``: chosen by cross-validation over runs."""
    loss: Loss = "nrmse"
    seed: Seed = 0
    """Of weights, shuffles and mirrors."""
    fold: Annotated[int, Bounds(ge=0, le=99)] = 0
    """Of train, for early stopping; the rest is fitted."""
    inverse_variance_weights: bool = False
    """Weigh each label by its inverse variance."""
    label: EnergyName = "total"
    """Energy to train on: total, or net of idle power (less the idle power)."""
    extra_features: bool = False
    """Whether turn and commanded speed of each segment are inputs, too."""
    layers: tuple[str, ...] = ()
    """Channels of the patch; empty: the paper's, as far as the dataset has them."""
    predictor: str = ""
    """Digest of the user's own code."""


@dataclass(frozen=True, slots=True)
class Task:
    """Samples to fit and to stop by, and what is learned of them."""

    train: Split
    """``fit`` and ``held`` together."""
    fit: Split
    held: Split
    outputs: tuple[str, ...]
    """The split's label columns, or its energy alone."""


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


def collect_labels(split: Split, outputs: Sequence[str]) -> Floats:
    """Return what a network is to predict of a split's samples, float32, shape (N, outputs)."""
    return split.column(outputs[0]).astype(np.float32)[:, None] if len(outputs) == 1 else split.labels
