"""Stored layers to float tensors, gathered, shuffled and mirrored on the way: one pass over the pixels.

Layers and tensor are walked as flat arrays with unsigned indices, which the compiler vectorises; a pixel without data becomes 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


@compile_kernel
def form_bytes(layer: NDArray[np.uint8], rows: Ints, mirrored: Mask, value: Floats, channel: int, out: Floats) -> None:  # noqa: PLR0917
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
    out: Floats,
) -> None:
    """Write numbers of ``rows``, scaled and clipped to [0, 1], to one channel of ``out``, (B, px, px, C); NaN and ``nodata`` become 0."""
    px, none, whole = out.shape[1], np.float32(0.0), np.float32(1.0)
    for b in range(rows.size):
        n = rows[b]
        for r in range(px):
            source = px - 1 - r if mirrored[b] else r
            stored, line = layer[n, source], out[b, r]
            for c in range(px):
                value = min(max(np.float32(stored[c]) * scale + offset, none), whole)
                line[c, channel] = value if stored[c] == stored[c] and stored[c] != nodata else none
