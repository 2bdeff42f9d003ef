"""Where a gate on the normalised innovation squared stands."""

from __future__ import annotations

import math


def find_chi_square_threshold(freedom: int, probability: float) -> float:
    """Return what a chi-square variate of ``freedom`` degrees stays below with this probability, [1].

    scipy.special has it too, and is what the tests compare with; it takes a third of a second to load.
    """
    low, high = 0.0, 4096.0
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if _compute_chi_square_tail(freedom, middle) > 1.0 - probability else (low, middle)
    return high


def _compute_chi_square_tail(freedom: int, value: float) -> float:
    """Return how likely a chi-square variate is larger (Abramowitz and Stegun, 26.4.4 and 26.4.5)."""
    half, odd = 0.5 * value, freedom % 2
    total = math.erfc(math.sqrt(half)) if odd else 0.0
    term = math.exp(-half) * (2.0 * math.sqrt(half / math.pi) if odd else 1.0)
    for k in range(freedom // 2):
        total += term
        term *= half / (k + 1 + 0.5 * odd)
    return total
