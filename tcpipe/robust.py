"""Scatter by medians, which outliers do not move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NORMAL_MEDIAN = 0.6744897501960817
"""Median of the absolute value of a normal variate of unit variance."""
MEDIAN_OF_SQUARES = NORMAL_MEDIAN**2
"""Median of its square."""


def estimate_robust_std(residuals: NDArray[np.float64]) -> float:
    """Return the standard deviation of residuals about zero: that of the normal variate whose median absolute value is theirs."""
    return float(np.median(np.abs(residuals))) / NORMAL_MEDIAN


def estimate_shorth(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return centre and standard deviation by the shortest half of the values: almost as many may be outliers to one side.

    The factor for few values is that of least median of squares (Rousseeuw and Leroy 1987). NaN is left out; no value: 0, 0.
    """
    rising = np.sort(values[np.isfinite(values)])
    if not rising.size:
        return 0.0, 0.0
    widths = rising[rising.size // 2 :] - rising[: rising.size - rising.size // 2]
    first = int(widths.argmin())
    factor = (1.0 + 5.0 / rising.size) / (2.0 * NORMAL_MEDIAN)
    return float(rising[first] + widths[first] / 2.0), float(widths[first] * factor)
