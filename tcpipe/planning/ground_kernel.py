"""One pass over the pixels of patches: classes that training has not met, obstacles in the robot's lane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel


@compile_kernel
def find_class_facts(  # noqa: PLR0917
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
