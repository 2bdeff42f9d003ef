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
from tcpipe.tables.bounds import Bounds

Floats = NDArray[np.float32]

ModelKind = Literal["resnet18", "boosting", "physics"]
"""The paper's network on patches, boosted trees on features of them, or coefficients of physics."""

Seed = Annotated[int, Bounds(ge=0, le=2**32 - 1)]
"""What every generator of random numbers takes."""


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
    layers: tuple[str, ...] = ()
    """Channels of the patch; empty: the paper's, as far as the dataset has them."""


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
