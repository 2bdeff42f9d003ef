"""What training minimises (the paper's equation 4), and its two readings.

``nrmse``
    sqrt(((ŵ - w*) / max w*)² + ((v̂ - v*) / max v*)²): both errors without dimension, the normalised error that the paper names.
``paper_eq4``
    sqrt((ŵ - w*)² / max w* + (v̂ - v*)² / max v*): the equation as it is printed; in it power outweighs velocity about 270 : 1.

Both are means over samples, with maxima of train. Here labels and predictions are over these maxima already.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.learning.keras_backend import load_keras

Loss = Literal["nrmse", "paper_eq4"]
Floats = NDArray[np.float32]

_SMALLEST = 1e-12
"""Under the root, so that a perfect sample has a slope."""


def loss_factors(loss: Loss, scale: Sequence[float]) -> Floats:
    """Return the factor of each output's squared error over its maximum, shape (outputs,)."""
    return np.array(scale, np.float32) if loss == "paper_eq4" else np.ones(len(scale), np.float32)


def mean_loss(predicted: Floats, labels: Floats, factors: Floats, weights: Floats | None = None) -> float:
    """Return the loss of predictions, all of shape (N, outputs) but ``factors``, (outputs,)."""
    squares = factors * (predicted.astype(np.float64) - labels) ** 2
    return float(np.mean(np.sqrt(np.sum(squares if weights is None else squares * weights, axis=1))))


def keras_loss(factors: Floats) -> Callable[[Any, Any], Any]:
    """Return the same for Keras; its labels are labels and weights side by side, shape (N, 2 outputs)."""
    ops, count = load_keras().ops, len(factors)

    def loss(labels_and_weights: Any, predicted: Any) -> Any:
        labels, weights = labels_and_weights[:, :count], labels_and_weights[:, count:]
        squares = ops.sum(ops.convert_to_tensor(factors) * weights * ops.square(predicted - labels), axis=1)
        return ops.mean(ops.sqrt(squares + _SMALLEST))

    return loss
