"""The shape of a network, and whether networks can be made here: what is known of them without torch."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

from tcpipe.errors import ModelError

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
    beside: int = 0
    """Numbers that it takes beside a patch, each as a channel of one value."""


def check_trainable(shape: Architecture) -> None:
    """Raise `ModelError` if torch is not installed or the width is no multiple of `BLOCK`."""
    if find_spec("torch") is None:
        raise ModelError("torch not installed, wanted to train or use a network: pip install 'tcpipe[train]'")
    if shape.width % BLOCK:
        raise ModelError(f"a network of width {shape.width}: wanted a multiple of {BLOCK}, from {BLOCK} to 512")
