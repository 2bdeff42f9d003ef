"""Training of models: options, and the loss of networks (the paper's equation 4).

``nrmse``
    sqrt(((ŵ - w*) / max w*)² + ((v̂ - v*) / max v*)²): both errors without dimension, the paper's normalised error.
``paper_eq4``
    sqrt((ŵ - w*)² / max w* + (v̂ - v*)² / max v*): the equation as printed; power outweighs velocity about 270 : 1.

Both are means over samples, with the maxima of train; functions here take labels and predictions divided by these.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from tcpipe.arrays import Floats32
from tcpipe.dataset.energies import EnergyName
from tcpipe.recipe import TrainConfig
from tcpipe.tables.bounds import Bounds

ModelKind = Literal["linear", "physics", "boosting", "resnet18", "own"]
"""Curves of class and slope, physics, a curve and boosted trees, the paper's network, or own code."""

Loss = Literal["nrmse", "paper_eq4"]

Seed = Annotated[int, Bounds(ge=0, le=2**32 - 1)]
"""Seed of a random number generator."""


@dataclass(frozen=True, slots=True)
class FitConfig(TrainConfig):
    """Settings of a training, from the recipe and from the call."""

    model: ModelKind | Literal["auto"] = "resnet18"
    """``auto``: chosen by cross-validation over runs."""
    loss: Loss = "nrmse"
    seed: Seed = 0
    """Seed of weights, shuffles and mirrors."""
    fold: Annotated[int, Bounds(ge=0, le=99)] = 0
    """Fold of train for early stopping; the others are fitted."""
    label: EnergyName = "total"
    """Energy to train on: total, or net of idle power (less the idle power)."""
    extra_features: bool = False
    """Whether turn and commanded speed of each segment are inputs, too."""
    layers: tuple[str, ...] = ()
    """Channels of the patch; empty: the paper's, as far as the dataset has them."""
    predictor: str = ""
    """Digest of the user's own code."""


@dataclass(slots=True)
class TrainingTimes:
    """Time of training in this process [s], and the samples that it processed."""

    total_s: float = 0.0
    samples: int = 0


_SMALLEST = 1e-12  # added under the root [1]; without it the loss has no gradient at a perfect prediction


def compute_loss_factors(loss: Loss, scale: Sequence[float]) -> Floats32:
    """Return the factor of each output's squared error over its maximum, shape (outputs,)."""
    return np.array(scale, np.float32) if loss == "paper_eq4" else np.ones(len(scale), np.float32)


def mean_loss(predicted: Any, labels: Any, factors: Any) -> Any:
    """Return the loss of predictions, arrays or tensors (N, outputs), without the ``factors``, (outputs,)."""
    return ((((predicted - labels) ** 2 * factors).sum(1) + _SMALLEST) ** 0.5).mean()
