"""What a robot draws while it stands, and how far that differs from one second to another: no ground has a part in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FEWEST_ROWS = 40
"""Rows of a standing robot that tell its power."""
_QUARTERS = 4
_UNSEEN_SHARE = 0.1
"""Of the power: how far one second of standing may lie from the rest of the run, which only further seconds tell. The pack of FoMo's robot,
which stands once for seconds, gives 12 % of that more while driving than the drives take (docs/explanation/real-data.md)."""


@dataclass(frozen=True, slots=True)
class IdlePower:
    """Power of the standing robot over a run.

    Attributes
    ----------
    watt : median of the means of seconds [W]; NaN where the robot hardly stood.
    std_watt : how far it may lie from what the robot would draw standing, over any second of the run [W]; NaN likewise.
    """

    watt: float
    std_watt: float


def estimate_idle_power(
    power_watt: Floats, halt: NDArray[np.int64], *, window_rows: int, step_watt: float
) -> IdlePower:
    """Return the power while standing. A second is about as long as a segment takes, and its mean is finer than the record's step.

    Parameters
    ----------
    power_watt : [W], shape (N,), while the robot stands, in order of time; NaN where it is not known.
    halt : shape (N,), which halt a row is of, increasing; negative at the edges of a halt, where motors still or already draw.
    window_rows : rows of a second.
    step_watt : [W], step in which power is told; while it stays on one level, nothing else tells how far that is off.
    """
    known = np.isfinite(power_watt)
    if np.count_nonzero(known) < FEWEST_ROWS:
        return IdlePower(np.nan, np.nan)
    settled = known & (halt >= 0)
    used = settled if settled.any() else known
    halts = [power_watt[used & (halt == number)] for number in np.unique(halt[used]).tolist()]
    seconds = _split_halts(halts, window_rows)
    means = np.array([each.mean() for each in seconds])
    watt = float(np.median(means))
    scatter = float(np.mean((means - watt) ** 2))
    lasting = max(scatter - _estimate_noise_variance(seconds), 0.0)
    levels = 1 + np.count_nonzero(np.diff(power_watt[used]))
    unseen = _UNSEEN_SHARE * watt / means.size
    return IdlePower(watt, float(np.sqrt(lasting + scatter / means.size + step_watt**2 / 12.0 / levels + unseen**2)))


def _split_halts(halts: list[Floats], rows: int) -> list[Floats]:
    """Return halts in parts of so many rows or somewhat more; those of less than half are left out where there are others."""
    parts = [part for each in halts for part in np.array_split(each, max(each.size // rows, 1))]
    return [part for part in parts if 2 * part.size >= rows] or parts


def _estimate_noise_variance(seconds: list[Floats]) -> float:
    """Return the variance [W²] that noise gives the mean of a second: the means of its quarters tell, however rows hang together."""
    found = [
        float(np.var([quarter.mean() for quarter in np.array_split(each, _QUARTERS)], ddof=1)) / _QUARTERS
        for each in seconds
        if each.size >= _QUARTERS
    ]
    return float(np.mean(found)) if found else 0.0
