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
