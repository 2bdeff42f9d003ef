"""Scatter by medians, which outliers do not move."""

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
