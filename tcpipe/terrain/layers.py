"""From stored layers to the paper's tensor: scaling and clipping (section IV-B), done only when the tensor is formed.

=========  ==========================================  =======================================
layer      stored                                      in the tensor
=========  ==========================================  =======================================
ortho      grey, one byte                              O / 255
terrain    class id, one byte, 0 = no data             (C - 1) / (c - 1)
height     0.5 mm steps above the patch's smallest     (H - min H) / 1 m, clipped to [0, 1]
=========  ==========================================  =======================================

A pixel without data is 0 in every channel; only a recipe with ``min_valid_fraction`` below 1 lets one in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LAYERS = ("ortho", "terrain", "height")
"""The paper's order of channels: O, C, H."""

HEIGHT_STEP_M = 0.0005
"""One step of a stored height [m]."""

HEIGHT_NODATA = 65535
"""A stored height without data; occurs only where a recipe allows invalid pixels."""

HEIGHT_RANGE_M = 1.0
"""Height difference that the tensor scales onto [0, 1] [m]."""

LUMA_RGB = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in grey (ITU-R BT.601)."""


def ortho_channel(ortho: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return grey in [0, 1]."""
    return ortho.astype(np.float32) / np.float32(255.0)


def terrain_channel(terrain: NDArray[np.uint8], class_count: int) -> NDArray[np.float32]:
    """Return (C - 1) / (c - 1): ids from 1 to ``class_count`` onto [0, 1]."""
    above = np.maximum(terrain.astype(np.float32) - np.float32(1.0), np.float32(0.0))
    scaled: NDArray[np.float32] = above / np.float32(max(class_count - 1, 1))
    return scaled


def height_channel(height: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Return heights above the patch's smallest over 1 m, clipped to [0, 1]."""
    scaled = height.astype(np.float32) * np.float32(HEIGHT_STEP_M / HEIGHT_RANGE_M)
    clipped: NDArray[np.float32] = np.minimum(scaled, np.float32(1.0))
    return np.where(height == HEIGHT_NODATA, np.float32(0.0), clipped)


def paper_tensor(
    ortho: NDArray[np.uint8], terrain: NDArray[np.uint8], height: NDArray[np.uint16], class_count: int
) -> NDArray[np.float32]:
    """Return the paper's M: shape (N, px, px, 3), channels ortho, terrain, height, all in [0, 1]."""
    channels = (ortho_channel(ortho), terrain_channel(terrain, class_count), height_channel(height))
    return np.stack(channels, axis=-1)
