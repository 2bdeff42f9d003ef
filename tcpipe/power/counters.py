"""Counters of energy, as a VESC's watt-hours: what they counted, over their wraps and resets, and the mean current that makes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Counter:
    """A counter row by row: energy since the first row [J], shape (N,), NaN where a row tells none, and how often it was reset before."""

    energy_joule: Floats
    resets: NDArray[np.int64]

    def times(self, factor: int) -> Counter:
        """Return the counter with its energy multiplied."""
        return replace(self, energy_joule=factor * self.energy_joule)

    def mean_amp(self, stamp_ns: Stamps, voltage_volt: Floats) -> Floats:
        """Return the mean current since the row before [A], at the row's voltage [V], shape (N,).

        So voltage times current, held backwards from each stamp as of any source that averages, is what was counted. NaN on the first row,
        after a reset (what was drawn across it nobody knows), and where time stands still.

        Parameters
        ----------
        stamp_ns : [ns], shape (N,).
        """
        amp = np.full(len(stamp_ns), np.nan)
        row = np.flatnonzero(np.isfinite(self.energy_joule) & (voltage_volt > 0.0))
        passed_s = np.diff(stamp_ns[row]) / 1e9
        whole = (np.diff(self.resets[row]) == 0) & (passed_s > 0.0)
        joule = np.diff(self.energy_joule[row])
        amp[row[1:][whole]] = joule[whole] / passed_s[whole] / voltage_volt[row[1:]][whole]
        return amp


def count_energy(parts: Sequence[tuple[float, Floats]], *, wraps: float | None) -> Counter:
    """Return what counters that only rise counted together.

    Parameters
    ----------
    parts : of each the energy of its unit [J], negative where it is subtracted, and its readings, shape (N,).
    wraps : where each begins at zero again, in its own unit; None where it never does. A fall that no wrap explains is a reset.
    """
    energy = np.zeros(len(parts[0][1]))
    resets = np.zeros(len(energy), np.int64)
    for unit_joule, reading in parts:
        row = np.flatnonzero(np.isfinite(reading))
        rise = np.diff(reading[row])
        if wraps is not None:
            rise = np.where((rise < 0.0) & (rise + wraps < wraps / 2), rise + wraps, rise)
        fell = rise < 0.0
        energy[np.setdiff1d(np.arange(len(energy)), row)] = np.nan
        energy[row[1:]] += unit_joule * np.cumsum(np.where(fell, 0.0, rise))
        resets[row[1:]] += np.cumsum(fell)
    return Counter(energy, resets)
