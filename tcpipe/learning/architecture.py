"""What is known of networks without torch: their shape, whether they can be trained here, and their loss (the paper's equation 4).

``nrmse``
    sqrt(((ŵ - w*) / max w*)² + ((v̂ - v*) / max v*)²): both errors without dimension, the normalised error that the paper names.
``paper_eq4``
    sqrt((ŵ - w*)² / max w* + (v̂ - v*)² / max v*): the equation as printed; power outweighs velocity about 270 : 1.

Both are means over samples, with the maxima of train; the functions here take labels and predictions divided by these maxima.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import ModelError
from tcpipe.formats.weights import ArrayForm

BLOCK = 16
"""Channels that CPU convolutions hold together: of fewer, oneDNN, by which PyTorch convolves there, writes beyond its memory in the
gradient of a 1 × 1 convolution with a stride (its issue 6035); seen to crash with 4 and 8 filters."""


@dataclass(frozen=True, slots=True)
class Architecture:
    """What decides the shape of every weight."""

    patch_px: int
    depth: int
    """Channels of a patch."""
    outputs: int = 2
    width: int = 64
    """Filters of the first stage, a multiple of `BLOCK`; 64 is ResNet-18, less is a narrower copy for quick runs, 0 no network."""
    extra_features: int = 0
    """Numbers that it takes beside a patch, each as a channel of one value."""


_MOST_WIDTH = 512
_MOST_INPUTS = 1024
"""Channels, numbers beside them, and outputs."""


def list_weight_forms(shape: Architecture) -> dict[str, ArrayForm]:
    """Return names, types and shapes of the weights of a network in a file, without making it (`tcpipe.learning.network`)."""
    forms: dict[str, tuple[int, ...]] = {}

    def add(name: str, depth: int, filters: int, size: int) -> None:
        forms[f"{name}_convolution/kernel"] = size, size, depth, filters
        forms.update({f"{name}_norm/{of}": (filters,) for of in ("gamma", "beta", "moving_mean", "moving_variance")})

    add("stem", shape.depth + shape.extra_features, shape.width, 7)
    depth = shape.width
    for stage in range(4):
        for block in range(2):
            name, filters = f"stage{stage + 1}_block{block + 1}", shape.width << stage
            add(f"{name}_first", depth, filters, 3)
            add(f"{name}_second", filters, filters, 3)
            if depth != filters:
                add(f"{name}_shortcut", depth, filters, 1)
            depth = filters
    forms |= {"head/kernel": (depth, shape.outputs), "head/bias": (shape.outputs,)}
    return {name: ("float32", of) for name, of in forms.items()}


def require_torch() -> None:
    """Raise `ModelError` if torch is not installed."""
    if find_spec("torch") is None:
        raise ModelError("torch not installed, required to train or use a network: pip install 'tcpipe[train]'")


def check_trainable(shape: Architecture) -> None:
    """Raise `ModelError` if torch is not installed or the width is no multiple of `BLOCK`."""
    require_torch()
    if shape.width % BLOCK or not BLOCK <= shape.width <= _MOST_WIDTH:
        raise ModelError(
            f"a network of width {shape.width}: expected a multiple of {BLOCK}, from {BLOCK} to {_MOST_WIDTH}"
        )
    if not (0 < shape.depth + shape.extra_features <= _MOST_INPUTS and 0 < shape.outputs <= _MOST_INPUTS):
        raise ModelError(
            f"a network of {shape.depth} channels, {shape.extra_features} numbers and {shape.outputs} outputs"
        )


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
