"""How models are trained: options, and the loss of networks (the paper's equation 4).

``nrmse``
    sqrt(((ŵ - w*) / max w*)² + ((v̂ - v*) / max v*)²): both errors without dimension, the normalised error that the paper names.
``paper_eq4``
    sqrt((ŵ - w*)² / max w* + (v̂ - v*)² / max v*): the equation as printed; power outweighs velocity about 270 : 1.

Both are means over samples, with the maxima of train; the functions here take labels and predictions divided by these maxima.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset.energies import EnergyName
from tcpipe.recipe import TrainConfig
from tcpipe.tables.bounds import Bounds

Floats = NDArray[np.float32]

ModelKind = Literal["linear", "physics", "boosting", "resnet18", "own"]
"""Curves of class and slope, physics, a curve and boosted trees, the paper's network, or own code."""

Loss = Literal["nrmse", "paper_eq4"]

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


_SMALLEST = 1e-12
"""Under the root, so that a perfect sample has a slope."""


def compute_loss_factors(loss: Loss, scale: Sequence[float]) -> Floats:
    """Return the factor of each output's squared error over its maximum, shape (outputs,)."""
    return np.array(scale, np.float32) if loss == "paper_eq4" else np.ones(len(scale), np.float32)


def mean_loss(predicted: Any, labels: Any, factors: Any, weights: Any) -> Any:
    """Return the loss of predictions, arrays or torch's tensors of shape (N, outputs), but for ``factors``, (outputs,)."""
    return ((((predicted - labels) ** 2 * factors * weights).sum(1) + _SMALLEST) ** 0.5).mean()
