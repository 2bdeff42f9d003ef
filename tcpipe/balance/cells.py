"""Cells of class, slope and speed, and how much a dataset knows of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.balance.correlation import Correlation, compute_effective_size
from tcpipe.tables.catalogue import read_threshold

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SLOPE_EDGES_DEG = (-15.0, -10.0, -5.0, -2.0, 2.0, 5.0, 10.0, 15.0)
"""Between the ranges of slope along travel [deg]; the paper's robot climbs 22.5°."""

SLOPE_NAMES = (
    *("below -15°", "-15° to -10°", "-10° to -5°", "-5° to -2°", "-2° to 2°"),
    *("2° to 5°", "5° to 10°", "10° to 15°", "above 15°"),
)

_SPEEDS = 5
"""Ranges of speed that hold all but the fastest hundredth."""


@dataclass(frozen=True, slots=True)
class Cell:
    """Samples of one class and range of slope, and of speed where ``speed`` says which.

    ``effective`` is to how many independent samples they are worth, None where that cannot be told.
    """

    terrain_class: int
    """0 without a terrain layer."""
    slope: int
    """Number of the range in `SLOPE_NAMES`."""
    speed: int | None
    samples: Mapping[str, int]
    """By split."""
    effective: float | None
    effective_train: float | None

    @property
    def rare(self) -> bool:
        """Whether it is worth few independent samples: with 30, its mean is known to 1/√30, a fifth, of its standard deviation."""
        known = self.effective if self.effective is not None else sum(self.samples.values())
        return known < read_threshold("thin-ground", "enough_count")


def find_slope_ranges(slope_rad: Floats) -> Ints:
    """Return the range of `SLOPE_NAMES` that each slope [rad] lies in, shape (N,)."""
    return np.searchsorted(np.radians(SLOPE_EDGES_DEG), slope_rad, side="right").astype(np.int64)


def choose_speed_edges(velocity_mps: Floats) -> tuple[float, ...]:
    """Return the borders between ranges of speed [m/s]: round steps, about five of them up to the fastest hundredth."""
    top = float(np.quantile(velocity_mps, 0.99)) if len(velocity_mps) else 0.0
    if not top > 0.0:
        return ()
    power = 10.0 ** np.floor(np.log10(top / _SPEEDS))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power * _SPEEDS >= top * (1 - 1e-9))
    return tuple(round(step * number, 9) for number in range(1, _SPEEDS) if step * number < top)


def count_cells(
    keys: Sequence[Ints],
    split: NDArray[np.str_],
    xy_m: Floats,
    correlations: Sequence[Correlation],
    *,
    splits: Sequence[str],
) -> list[Cell]:
    """Return every cell that holds a sample, by class, slope and speed.

    Parameters
    ----------
    keys : class ids and ranges of slope, and of speed where cells are to be cut by it too, each of shape (N,).
    split : split of every sample, shape (N,).
    xy_m : centres of the footprints [m], shape (N, 2).
    correlations : of the labels; the one that leaves least counts.
    splits : the splits that count, ``train`` among them.
    """
    counted = np.flatnonzero(np.isin(split, splits))
    if not len(counted):
        return []
    names, member = np.unique(np.stack(keys)[:, counted], axis=1, return_inverse=True)
    order = np.argsort(member.reshape(-1), kind="stable")
    parts = np.split(counted[order], np.flatnonzero(np.diff(member.reshape(-1)[order])) + 1)
    cells = []
    for (terrain, slope, *speed), rows in zip(names.T.tolist(), parts, strict=True):
        train = rows[split[rows] == "train"]
        cells.append(
            Cell(
                terrain,
                slope,
                speed[0] if speed else None,
                {name: int((split[rows] == name).sum()) for name in splits},
                compute_effective_size(xy_m[rows], *correlations) if correlations else None,
                compute_effective_size(xy_m[train], *correlations) if correlations else None,
            )
        )
    return cells
