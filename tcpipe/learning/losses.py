"""What training minimises (the paper's equation 4), and its two readings.

``nrmse``
    sqrt(((ŵ - w*) / max w*)² + ((v̂ - v*) / max v*)²): both errors without dimension, the normalised error that the paper names.
``paper_eq4``
    sqrt((ŵ - w*)² / max w* + (v̂ - v*)² / max v*): the equation as it is printed; in it power outweighs velocity about 270 : 1.

Both are means over samples, with maxima of train. Here labels and predictions are over these maxima already.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Loss = Literal["nrmse", "paper_eq4"]
Floats = NDArray[np.float32]

_SMALLEST = 1e-12
"""Under the root, so that a perfect sample has a slope."""


def compute_loss_factors(loss: Loss, scale: Sequence[float]) -> Floats:
    """Return the factor of each output's squared error over its maximum, shape (outputs,)."""
    return np.array(scale, np.float32) if loss == "paper_eq4" else np.ones(len(scale), np.float32)


def mean_loss(predicted: Any, labels: Any, factors: Any, weights: Any) -> Any:
    """Return the loss of predictions, arrays or torch's tensors of shape (N, outputs), but for ``factors``, (outputs,)."""
    return ((((predicted - labels) ** 2 * factors * weights).sum(1) + _SMALLEST) ** 0.5).mean()
