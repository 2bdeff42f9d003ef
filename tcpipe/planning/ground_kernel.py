"""One pass over the pixels of patches: relief, classes that training has not met, obstacles in the robot's lane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import kernel
from tcpipe.terrain.sampling_kernel import HEIGHT_NODATA


@kernel
def relief_steps(height: NDArray[np.uint16], out: NDArray[np.uint16]) -> None:
    """Write the largest stored height of each patch, shape (N, px, px), to ``out``, (N,); 65535 is no data."""
    flat = height.reshape(height.shape[0], -1)
    for n in range(flat.shape[0]):
        most = np.uint16(0)
        for k in range(flat.shape[1]):
            value = flat[n, k] if flat[n, k] != HEIGHT_NODATA else np.uint16(0)
            most = max(most, value)
        out[n] = most


@kernel
def class_facts(  # noqa: PLR0917
    terrain: NDArray[np.uint8],
    known: NDArray[np.uint8],
    blocked: NDArray[np.uint8],
    lane_first: int,
    lane_last: int,
    out_unknown: NDArray[np.bool_],
    out_blocked: NDArray[np.float64],
) -> None:
    """Tell whether a patch has a pixel of a class that is not ``known``, and which share of its lane is ``blocked``.

    Parameters
    ----------
    terrain
        Class ids, shape (N, px, px).
    known, blocked
        1 or 0 by class id, shape (256,).
    lane_first, lane_last
        First row of the lane, and the one after its last.
    out_unknown, out_blocked
        Shape (N,).
    """
    px = terrain.shape[1]
    for n in range(terrain.shape[0]):
        count = 0
        for r in range(px):
            for c in range(px):
                count += known[terrain[n, r, c]]
        out_unknown[n] = count < px * px
        shut = 0
        for r in range(lane_first, lane_last):
            for c in range(px):
                shut += blocked[terrain[n, r, c]]
        out_blocked[n] = shut / ((lane_last - lane_first) * px)
