"""Stored layers to float tensors, gathered, shuffled and mirrored on the way: one pass over the pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import kernel

Floats = NDArray[np.float32]


@kernel
def form_paper_tensor(  # noqa: PLR0917
    ortho: Any,
    terrain: Any,
    height: Any,
    rows: Any,
    mirrored: Any,
    grey: Floats,
    scaled: Floats,
    step: Any,
    out: Floats,
) -> None:
    """Form ``rows`` of all three layers into ``out``, (B, px, px, 3).

    ``grey`` and ``scaled`` say what each byte of ortho and terrain becomes, (256,); ``step`` is a stored height over 1 m, float32.
    """
    px = out.shape[1]
    for b in range(rows.size):
        n = rows[b]
        for r in range(px):
            source = px - 1 - r if mirrored[b] else r
            o, t, h, line = ortho[n, source], terrain[n, source], height[n, source], out[b, r]
            for c in range(px):
                line[c, 0] = grey[o[c]]
                line[c, 1] = scaled[t[c]]
                line[c, 2] = min(np.float32(h[c]) * step, np.float32(1.0))


@kernel
def form_bytes(layer: Any, rows: Any, mirrored: Any, value: Floats, channel: int, out: Floats) -> None:  # noqa: PLR0917
    """Write ``value`` of each byte of ``rows`` to one channel of ``out``, (B, px, px, C)."""
    px = out.shape[1]
    for b in range(rows.size):
        n = rows[b]
        for r in range(px):
            source = px - 1 - r if mirrored[b] else r
            stored, line = layer[n, source], out[b, r]
            for c in range(px):
                line[c, channel] = value[stored[c]]


@kernel
def form_height(layer: Any, rows: Any, mirrored: Any, step: Any, channel: int, out: Floats) -> None:  # noqa: PLR0917
    """Write heights of ``rows`` over 1 m, at most 1, to one channel of ``out``, (B, px, px, C)."""
    px = out.shape[1]
    for b in range(rows.size):
        n = rows[b]
        for r in range(px):
            source = px - 1 - r if mirrored[b] else r
            stored, line = layer[n, source], out[b, r]
            for c in range(px):
                line[c, channel] = min(np.float32(stored[c]) * step, np.float32(1.0))
