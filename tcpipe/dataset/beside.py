"""What is known of metres of ground beside their patches: numbers that a model may take, and that a planner knows, too."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from tcpipe.dataset.split import Split

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Beside:
    """Of N metres, shape (N,) each."""

    class_id: NDArray[np.int64]
    """Terrain class under the chord; 0 where it is not known."""
    slope_rad: Floats
    """Along travel, uphill positive."""
    turn_radpm: Floats
    """How far a metre of them turns, both ways counted; NaN where it is not known."""
    command_mps: Floats
    """Commanded speed; NaN where it is not known."""

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_] | slice) -> Beside:
        """Return some of them."""
        return Beside(*(getattr(self, of.name)[rows] for of in fields(self)))


def beside_of(split: Split) -> Beside:
    """Return what the samples of a split have beside their patches; columns that an older dataset lacks are NaN."""
    turned_rad = _numbers(split, "turn_rate_radps") * _numbers(split, "duration_s")
    return Beside(
        np.nan_to_num(_numbers(split, "terrain_class"), nan=0.0).astype(np.int64),
        _numbers(split, "slope_rad"),
        turned_rad / _numbers(split, "arc_length_m"),
        _numbers(split, "commanded_velocity_mps"),
    )


def _numbers(split: Split, name: str) -> Floats:
    return split.column(name).astype(np.float64)
