"""Negative currents that were read as unsigned numbers: a signed number of 16 bits is told by its grid and by the hole in its middle.

A Warthog's motor controllers send a signed number of 1/16 A as unsigned (norlab-ulaval/warthog_sevcon_fix), AgileX's did with 0.1 A until
2024 (agilexrobotics/ugv_sdk, 7769abf): -2 A reads as 4094 A, or as 6551.6 A.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_VALUES = 65536
_STEPS_AMP = (*(2.0**-bits for bits in range(9)), 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
_OFF_GRID = 0.02
_FEWEST = 20


def find_wrap(current_amp: Floats) -> float | None:
    """Return what is to be subtracted from the upper values of a current [A], None where it never wrapped.

    It did where all values lie on the grid of a number of 16 bits, some in its upper quarter, and none in the two quarters between: no
    current passes from one to the other without a value there.

    Parameters
    ----------
    current_amp : [A], shape (N,), NaN where there is none.
    """
    known = current_amp[np.isfinite(current_amp)]
    if known.size < _FEWEST or known.min() < 0.0:
        return None
    top = float(known.max())
    for step_amp in _STEPS_AMP:
        wraps_amp = _VALUES * step_amp
        if not 0.75 * wraps_amp < top < wraps_amp or np.any((known > wraps_amp / 4) & (known < 0.75 * wraps_amp)):
            continue
        if np.all(np.abs(known / step_amp - np.rint(known / step_amp)) < _OFF_GRID):
            return wraps_amp
    return None
