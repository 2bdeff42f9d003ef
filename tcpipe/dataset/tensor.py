"""Which channels a tensor has, and how they are formed from the stored layers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Bytes, Floats32, Ints, Mask
from tcpipe.compiled import compile_kernel
from tcpipe.errors import DatasetError
from tcpipe.terrain.layers import LayerPixels, Layers, sort_layers


@compile_kernel
def form_bytes(  # noqa: PLR0917
    layer: Bytes, rows: Ints, mirrored: Mask, value: Floats32, channel: int, out: Floats32
) -> None:
    """Write ``value`` of each byte of ``rows`` to one channel of ``out``, (B, px, px, C)."""
    px = out.shape[1]
    for b in range(rows.size):
        n = rows[b]
        for r in range(px):
            source = px - 1 - r if mirrored[b] else r
            stored, line = layer[n, source], out[b, r]
            for c in range(px):
                line[c, channel] = value[stored[c]]


@compile_kernel
def form_numbers(  # noqa: PLR0917
    layer: NDArray[np.uint16 | np.float32],
    rows: Ints,
    mirrored: Mask,
    nodata: np.uint16 | np.float32,
    scale: np.float32,
    offset: np.float32,
    channel: int,
    out: Floats32,
) -> None:
    """Write ``rows``, scaled and clipped to [0, 1], to a channel of ``out``, (B, px, px, C); NaN, ``nodata``: 0."""
    px, none, whole = out.shape[1], np.float32(0.0), np.float32(1.0)
    for b in range(rows.size):
        n = rows[b]
        for r in range(px):
            source = px - 1 - r if mirrored[b] else r
            stored, line = layer[n, source], out[b, r]
            for c in range(px):
                value = min(max(np.float32(stored[c]) * scale + offset, none), whole)
                line[c, channel] = value if stored[c] == stored[c] and stored[c] != nodata else none


Pixels = Mapping[str, LayerPixels]

ONE_HOT = "_one_hot"
"""Ending of a categorical layer's name: a channel for each of its classes, 1 where the pixel is of it."""

_BATCH_ROWS, _BATCH_BYTES = 2_048, 40_000_000

_BYTES = np.arange(256, dtype=np.uint8)


@dataclass(frozen=True)
class TensorLayout:
    """Channels in their order: names of layers, or of a categorical one with `ONE_HOT`.

    ``known`` are all layers.
    """

    channels: tuple[str, ...]
    known: Layers
    patch_px: int

    @cached_property
    def layers(self) -> tuple[str, ...]:
        """Stored layers that are needed."""
        return tuple(sort_layers({name: self.known[name] for name in map(self._name_layer, self.channels)}))

    @cached_property
    def planes(self) -> tuple[str, ...]:
        """Names along the tensor's last axis: channels, those of several planes as ``name[1]``, ``name[2]`` …."""
        widths = ((channel, self._count_planes(channel)) for channel in self.channels)
        return tuple(
            f"{channel}[{place + 1}]" if width > 1 else channel for channel, width in widths for place in range(width)
        )

    @property
    def depth(self) -> int:
        """Length of the tensor's last axis."""
        return len(self.planes)

    @property
    def batch_rows(self) -> int:
        """Most samples in one batch of tensors if all samples are read in order: 40 MB, at most 2,048."""
        return max(min(_BATCH_BYTES // (4 * self.depth * self.patch_px**2), _BATCH_ROWS), 1)

    def _name_layer(self, channel: str) -> str:
        return channel if channel in self.known else channel.removesuffix(ONE_HOT)

    def _count_planes(self, channel: str) -> int:
        layer = self.known[self._name_layer(channel)]
        return 1 if layer.name == channel else round(layer.high)

    def form(self, pixels: Pixels, rows: Ints, mirrored: Mask | None = None) -> Floats32:
        """Return the tensor of ``rows``, shape (B,), of stored layers: float32, shape (B, px, px, depth).

        ``mirrored`` marks those that are mirrored across their direction of travel, shape (B,).
        """
        flips = np.zeros(len(rows), np.bool_) if mirrored is None else mirrored
        px = self.patch_px
        out = np.empty((len(rows), px, px, self.depth), np.float32)
        at = 0
        for channel in self.channels:
            layer = self.known[self._name_layer(channel)]
            if layer.name != channel:
                for place in range(self._count_planes(channel)):
                    is_it = np.equal(_BYTES, place + 1).astype(np.float32)
                    form_bytes(pixels[layer.name], rows, flips, is_it, at + place, out)
            elif layer.stored == np.uint8:
                form_bytes(pixels[channel], rows, flips, layer.channel_of_bytes, at, out)
            else:
                scaling = (np.float32(number) for number in layer.scaling)
                form_numbers(pixels[channel], rows, flips, layer.stored.type(layer.nodata), *scaling, at, out)
            at += self._count_planes(channel)
        return out


def make_tensor_layout(channels: Sequence[str], known: Layers, patch_px: int) -> TensorLayout:
    """Return the layout with these channels; `DatasetError` names those that the stored layers cannot give."""
    possible = [*known, *(f"{name}{ONE_HOT}" for name, layer in known.items() if layer.kind == "categorical")]
    unknown = [channel for channel in channels if channel not in possible]
    if unknown or not channels:
        named = ", ".join(unknown) or "none"
        raise DatasetError(f"requested channels: {named}; this dataset has {', '.join(possible)}")
    return TensorLayout(tuple(channels), known, patch_px)
