"""How much the ground of a patch rises."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel
from tcpipe.terrain.layers import HEIGHT_STEP_M
from tcpipe.terrain.sampling_kernel import HEIGHT_NODATA


def compute_relief_m(height: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return the largest difference of the stored heights of patches, shape (N, px, px), without data left out [m], shape (N,)."""
    steps = np.empty(len(height), np.uint16)
    _find_relief_steps(height, steps)
    return steps.astype(np.float64) * HEIGHT_STEP_M


@compile_kernel
def _find_relief_steps(height: NDArray[np.uint16], out: NDArray[np.uint16]) -> None:
    """Write the largest stored height of each patch, shape (N, px, px), to ``out``, (N,): they are above its lowest pixel."""
    flat = height.reshape(height.shape[0], -1)
    for n in range(flat.shape[0]):
        most = np.uint16(0)
        for k in range(flat.shape[1]):
            value = flat[n, k] if flat[n, k] != HEIGHT_NODATA else np.uint16(0)
            most = max(most, value)
        out[n] = most
