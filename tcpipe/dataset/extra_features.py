"""What is known of metres of ground beside their patches: numbers that a model may take, and that a planner knows, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from tcpipe.dataset.split import Split

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ExtraFeatures:
    """Of N metres, shape (N,) each."""

    class_id: NDArray[np.int64]
    """Terrain class under the chord; 0 where it is not known."""
    slope_rad: Floats
    """Along travel, uphill positive."""
    turn_radpm: Floats
    """How far a metre of them turns, both ways counted; NaN where it is not known."""
    command_mps: Floats
    """Commanded speed; NaN where it is not known."""

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_] | slice) -> ExtraFeatures:
        """Return some of them."""
        return ExtraFeatures(*(getattr(self, of.name)[rows] for of in fields(self)))


@dataclass(frozen=True, slots=True)
class ExtraFeature:
    """A number that a model takes beside a patch, and what it was among the training samples."""

    name: Literal["turn_radpm", "command_mps"]
    mean: float
    deviation: float
    """Greater than 0."""
    usual: float
    """What a metre has of which it is not known: the mean, unless the user says what."""
    training_range: tuple[float, float]
    """Smallest and largest."""


COLUMNS = ("mean_abs_yaw_rate_radps", "duration_s", "arc_length_m", "commanded_velocity_mps")
"""Of samples.parquet, that the inputs are formed of."""


def read_extra_features(split: Split) -> ExtraFeatures:
    """Return what the samples of a split have beside their patches; what an older dataset lacks is NaN."""
    turn, command = _form_values([split.column(name).astype(np.float64) for name in COLUMNS])
    class_id = np.nan_to_num(split.column("terrain_class").astype(np.float64), nan=0.0).astype(np.int64)
    return ExtraFeatures(class_id, split.column("slope_rad").astype(np.float64), turn, command)


def empty_extra_features(count: int) -> ExtraFeatures:
    """Return that nothing is known of so many metres."""
    unknown = np.full(count, np.nan)
    return ExtraFeatures(np.zeros(count, np.int64), unknown, unknown, unknown)


def available_features(extra_features: ExtraFeatures) -> tuple[ExtraFeature, ...]:
    """Return the inputs that these samples tell: those that are known of any of them."""
    found = []
    for name in ("turn_radpm", "command_mps"):
        values = getattr(extra_features, name)
        if (known := values[np.isfinite(values)]).size:
            mean = float(known.mean())
            found.append(
                ExtraFeature(name, mean, max(float(known.std()), 1e-3), mean, (float(known.min()), float(known.max())))
            )
    return tuple(found)


def standardize_features(inputs: Sequence[ExtraFeature], extra_features: ExtraFeatures) -> Floats:
    """Return what a model takes beside N patches, in units of its deviation from its mean, shape (N, inputs)."""
    return _scale_values(inputs, {"turn_radpm": extra_features.turn_radpm, "command_mps": extra_features.command_mps})


def standardize_columns(inputs: Sequence[ExtraFeature], columns: NDArray[np.floating]) -> Floats:
    """Return the same of `COLUMNS`, shape (N, 4)."""
    turn, command = _form_values(list(columns.T.astype(np.float64)))
    return _scale_values(inputs, {"turn_radpm": turn, "command_mps": command})


def _form_values(columns: Sequence[Floats]) -> tuple[Floats, Floats]:
    rate, duration, arc, command = columns
    return rate * duration / arc, command


def _scale_values(inputs: Sequence[ExtraFeature], values: dict[str, Floats]) -> Floats:
    columns = [np.where(np.isfinite(values[of.name]), values[of.name], of.usual) for of in inputs]
    scaled = [(column - of.mean) / of.deviation for of, column in zip(inputs, columns, strict=True)]
    return np.column_stack(scaled) if scaled else np.empty((len(next(iter(values.values()))), 0))


def append_planes(patches: NDArray[np.float32], numbers: Floats) -> NDArray[np.float32]:
    """Return patches, shape (N, px, px, depth), with a channel of one value for each of N rows of numbers."""
    if not numbers.shape[1]:
        return patches
    planes = np.broadcast_to(numbers[:, None, None, :].astype(np.float32), (*patches.shape[:3], numbers.shape[1]))
    return np.concatenate([patches, planes], axis=3)
