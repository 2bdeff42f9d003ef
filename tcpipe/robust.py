"""Scatter by medians, which outliers do not move, and non-negative least squares.

scipy.optimize has the latter, too, and tests compare with it; importing it would take 0.3 s in each process that fuses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NORMAL_MEDIAN = 0.6744897501960817
"""Median of the absolute value of a normal variate of unit variance."""
MIN_SIGMAS = 4.0
"""Standard deviations beyond which a difference is certain: by chance once in 16,000 times."""
MEDIAN_OF_SQUARES = NORMAL_MEDIAN**2
"""Median of its square."""


def estimate_robust_std(residuals: NDArray[np.float64]) -> float:
    """Return σ of residuals about zero: that of the normal distribution with the same median absolute value."""
    return float(np.median(np.abs(residuals))) / NORMAL_MEDIAN


def estimate_shorth(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return centre and σ of finite values by their shortest half, for few: Rousseeuw and Leroy (1987); none: 0, 0."""
    rising = np.sort(values[np.isfinite(values)])
    if not rising.size:
        return 0.0, 0.0
    widths = rising[rising.size // 2 :] - rising[: rising.size - rising.size // 2]
    first, factor = int(widths.argmin()), (1.0 + 5.0 / rising.size) / NORMAL_MEDIAN
    return float(rising[first] + widths[first] / 2.0), float(factor * widths[first] / 2.0)


def solve_non_negative(columns: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the factors, none negative, shape (J,), by which the columns (S, J) add up nearest to the target (S,).

    Lawson and Hanson, Solving Least Squares Problems (1974), algorithm 23.10 (NNLS): the column that reduces the
    residual most becomes free, one after the other; a factor that would become negative is fixed at zero.
    """
    factors, free, vain = np.zeros(columns.shape[1]), *np.zeros((2, columns.shape[1]), np.bool_)
    rounding = 10.0 * np.finfo(np.float64).eps * np.linalg.norm(columns, axis=0) * np.linalg.norm(target)
    for _ in range(3 * columns.shape[1]):
        gain = np.where(free | vain, -np.inf, columns.T @ (target - columns @ factors))
        best = int(np.argmax(gain))
        if gain[best] <= rounding[best] or free.sum() == len(target):
            break
        free[best] = True
        tried = _solve_subset(columns, target, free)
        if tried[best] <= 0.0:  # its gain was rounding
            free[best], vain[best] = False, True
            continue
        while (negative := free & (tried <= 0.0)).any():
            share = factors[negative] / (factors[negative] - tried[negative])
            factors = factors + share.min() * (tried - factors)
            factors[np.flatnonzero(negative)[share == share.min()]] = 0.0
            free &= factors > 0.0
            tried = _solve_subset(columns, target, free)
        factors, vain = tried, np.zeros_like(vain)
    return factors


def _solve_subset(
    columns: NDArray[np.float64], target: NDArray[np.float64], free: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the factors of the free columns by least squares, and 0 for all others."""
    factors = np.zeros(columns.shape[1])
    factors[free] = np.linalg.lstsq(columns[:, free], target, rcond=None)[0]
    return factors
