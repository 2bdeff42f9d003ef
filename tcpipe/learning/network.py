"""The paper's network (section III-D): ResNet-18 with a head of two outputs, for patches of any size and depth.

He et al., Deep Residual Learning for Image Recognition, 2016, table 1: a 7 × 7 convolution and a pooling, both with stride 2, then two
basic blocks each of 64, 128, 256 and 512 filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import ModelError
from tcpipe.learning.keras_backend import load_keras


@dataclass(frozen=True, slots=True)
class Architecture:
    """What decides the shape of every weight."""

    patch_px: int
    depth: int
    """Channels of a patch."""
    outputs: int = 2
    width: int = 64
    """Filters of the first stage, a multiple of `BLOCK`; 64 is ResNet-18, less is a narrower copy for quick runs."""


BLOCK = 16
"""Channels that CPU convolutions hold together: of fewer, oneDNN, by which PyTorch convolves there, writes beyond its memory in the
gradient of a 1 × 1 convolution with a stride (its issue 6035); seen to crash with 4 and 8 filters."""


def resnet18(shape: Architecture, *, seed: int, start: Sequence[float]) -> Any:
    """Return the untrained network, float32 (N, px, px, depth) to (N, outputs); the same seed gives the same weights.

    Parameters
    ----------
    shape
        Sizes.
    seed
        Of the weights.
    start
        What it predicts on average before training: the head's biases.

    Raises
    ------
    ModelError
        The width is no multiple of `BLOCK`.

    """
    if shape.width % BLOCK:
        raise ModelError(f"a network of width {shape.width}: wanted a multiple of {BLOCK}, from {BLOCK} to 512")
    keras = load_keras()
    keras.utils.set_random_seed(seed)
    layers = keras.layers
    patches = keras.Input((shape.patch_px, shape.patch_px, shape.depth), name="patches")
    values = layers.ReLU()(_normed(layers, patches, "stem", (shape.width, 7, 2)))
    values = layers.MaxPooling2D(3, 2, padding="same")(values)
    for stage in range(4):
        for block in range(2):
            name = f"stage{stage + 1}_block{block + 1}"
            values = _basic_block(layers, values, name, shape.width << stage, 2 if stage and not block else 1)
    values = layers.GlobalAveragePooling2D()(values)
    small, biases = keras.initializers.RandomNormal(stddev=0.01), keras.initializers.Constant(list(start))
    head = layers.Dense(shape.outputs, kernel_initializer=small, bias_initializer=biases, name="head")
    return keras.Model(patches, head(values), name="resnet18")


def _normed(layers: Any, values: Any, name: str, form: tuple[int, int, int]) -> Any:
    """Convolve by ``form``, filters, size and stride, and normalise."""
    filters, size, stride = form
    convolve = layers.Conv2D(
        filters, size, stride, "same", use_bias=False, kernel_initializer="he_normal", name=f"{name}_convolution"
    )
    return layers.BatchNormalization(momentum=0.9, epsilon=1e-5, name=f"{name}_norm")(convolve(values))


def _basic_block(layers: Any, values: Any, name: str, filters: int, stride: int) -> Any:
    made = layers.ReLU()(_normed(layers, values, f"{name}_first", (filters, 3, stride)))
    made = _normed(layers, made, f"{name}_second", (filters, 3, 1))
    if stride != 1 or values.shape[-1] != filters:
        values = _normed(layers, values, f"{name}_shortcut", (filters, 1, stride))
    return layers.ReLU()(layers.Add()([made, values]))


def named_weights(network: Any) -> dict[str, NDArray[np.float32]]:
    """Return every weight by its path in the network, in the network's order."""
    to_numpy = load_keras().ops.convert_to_numpy
    return {variable.path: np.array(to_numpy(variable.value)) for variable in network.weights}
