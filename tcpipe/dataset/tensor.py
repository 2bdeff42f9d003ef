"""Which channels a tensor has, and how they are formed from the stored layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import DatasetError
from tcpipe.terrain.layers import HEIGHT_RANGE_M, HEIGHT_STEP_M, LAYERS, ortho_channel, terrain_channel

Floats = NDArray[np.float32]
Pixels = Mapping[str, NDArray[Any]]

ONE_HOT = "terrain_one_hot"
"""A channel for each class of the table, 1 where the pixel is of it."""

_BYTES = np.arange(256, dtype=np.uint8)


@dataclass(frozen=True)
class TensorForm:
    """Channels in their order: ``ortho``, ``terrain``, ``height`` as in the paper, or `ONE_HOT`."""

    channels: tuple[str, ...]
    class_count: int

    @cached_property
    def layers(self) -> tuple[str, ...]:
        """Stored layers that are needed."""
        needed = {"terrain" if channel == ONE_HOT else channel for channel in self.channels}
        return tuple(layer for layer in LAYERS if layer in needed)

    @cached_property
    def depth(self) -> int:
        """Length of the tensor's last axis."""
        return sum(self.class_count if channel == ONE_HOT else 1 for channel in self.channels)

    def form(self, pixels: Pixels, rows: NDArray[np.int64], mirrored: NDArray[np.bool_] | None = None) -> Floats:
        """Return the tensor of ``rows`` of the stored layers, float32, shape (B, px, px, depth).

        Parameters
        ----------
        pixels
            Stored layers, each of shape (N, px, px).
        rows
            Which of them, shape (B,).
        mirrored
            Whether each is mirrored across its direction of travel, shape (B,).

        """
        from tcpipe.dataset.tensor_kernel import form_bytes, form_height, form_paper_tensor  # noqa: PLC0415  numba loads with the first batch

        flips = np.zeros(len(rows), np.bool_) if mirrored is None else mirrored
        px = next(iter(pixels.values())).shape[1]
        out = np.empty((len(rows), px, px, self.depth), np.float32)
        step = np.float32(HEIGHT_STEP_M / HEIGHT_RANGE_M)
        if self.channels == LAYERS:
            most = np.float32(255.0), np.float32(max(self.class_count - 1, 1))
            form_paper_tensor(*(pixels[layer] for layer in LAYERS), rows, flips, *most, step, out)
            return out
        grey, scaled = ortho_channel(_BYTES), terrain_channel(_BYTES, self.class_count)
        at = 0
        for channel in self.channels:
            if channel == "height":
                form_height(pixels["height"], rows, flips, step, at, out)
            elif channel == ONE_HOT:
                for class_id in range(1, self.class_count + 1):
                    is_it = np.equal(_BYTES, class_id).astype(np.float32)
                    form_bytes(pixels["terrain"], rows, flips, is_it, at + class_id - 1, out)
            else:
                form_bytes(pixels[channel], rows, flips, grey if channel == "ortho" else scaled, at, out)
            at += self.class_count if channel == ONE_HOT else 1
        return out


def tensor_form(channels: Sequence[str], stored: Sequence[str], class_count: int) -> TensorForm:
    """Return the form with these channels; `DatasetError` names those that the stored layers cannot give."""
    possible = [*stored, *([ONE_HOT] if "terrain" in stored else [])]
    unknown = [channel for channel in channels if channel not in possible]
    if unknown or not channels:
        named = ", ".join(unknown) or "none"
        raise DatasetError(f"channels asked for: {named}; this dataset can give {', '.join(possible)}")
    return TensorForm(tuple(channels), class_count)
