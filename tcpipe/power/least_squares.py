"""Least squares with sizes that cannot be negative.

scipy.optimize has it too, and is what the tests compare with; to load that takes longer than all fits of a run.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def solve_non_negative(made: Floats, seen: Floats) -> Floats:
    """Return the sizes, none negative, shape (J,), with which the columns of ``made`` (S, J) add up nearest to ``seen`` (S,).

    Lawson and Hanson, Solving Least Squares Problems (1974), algorithm 23.10 (NNLS): columns that would lessen the residual most become
    free one by one; what would become negative stops at zero.
    """
    size, free, vain = np.zeros(made.shape[1]), np.zeros(made.shape[1], np.bool_), np.zeros(made.shape[1], np.bool_)
    rounding = 10.0 * np.finfo(np.float64).eps * np.linalg.norm(made, axis=0) * np.linalg.norm(seen)
    for _ in range(3 * made.shape[1]):
        gain = np.where(free | vain, -np.inf, made.T @ (seen - made @ size))
        best = int(np.argmax(gain))
        if gain[best] <= rounding[best] or free.sum() == len(seen):
            break
        free[best] = True
        tried = _solve_subset(made, seen, free)
        if tried[best] <= 0.0:  # its gain was rounding
            free[best], vain[best] = False, True
            continue
        while (negative := free & (tried <= 0.0)).any():
            share = size[negative] / (size[negative] - tried[negative])
            size = size + share.min() * (tried - size)
            size[np.flatnonzero(negative)[share == share.min()]] = 0.0
            free &= size > 0.0
            tried = _solve_subset(made, seen, free)
        size, vain = tried, np.zeros_like(vain)
    return size


def _solve_subset(made: Floats, seen: Floats, free: NDArray[np.bool_]) -> Floats:
    sizes = np.zeros(made.shape[1])
    sizes[free] = np.linalg.lstsq(made[:, free], seen, rcond=None)[0]
    return sizes
