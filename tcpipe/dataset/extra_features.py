"""Extra features of segments in addition to patches: numbers that are also known when a path is planned."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Floats32, Ints, Mask

if TYPE_CHECKING:
    from tcpipe.dataset.split import Split


@dataclass(frozen=True, slots=True)
class ExtraFeatures:
    """Extra features of N segments, shape (N,) each."""

    class_id: Ints
    """Terrain class under the chord; 0 if unknown."""
    slope_rad: Floats
    """Along travel, uphill positive."""
    turn_radpm: Floats
    """Turned angle per metre, both ways counted; NaN if unknown."""
    command_mps: Floats
    """Commanded speed; NaN if unknown."""

    def take(self, rows: Ints | Mask | slice) -> ExtraFeatures:
        """Return the features of some rows."""
        return ExtraFeatures(*(getattr(self, entry.name)[rows] for entry in fields(self)))


@dataclass(frozen=True, slots=True)
class ExtraFeature:
    """An input of a model in addition to the patch, with its distribution over the training samples."""

    name: Literal["turn_radpm", "command_mps"]
    mean: float
    deviation: float
    """Greater than 0."""
    usual: float
    """Value where it is unknown: the mean, unless the user gives one."""
    training_range: tuple[float, float]
    """Smallest and largest."""


COLUMNS = ("mean_abs_yaw_rate_radps", "duration_s", "arc_length_m", "commanded_velocity_mps")
"""Columns of samples.parquet that the features are computed from."""


def read_extra_features(split: Split) -> ExtraFeatures:
    """Return the extra features of a split; columns that an older dataset lacks are NaN."""
    turn, command = _form_values(split.column(name).astype(float) for name in COLUMNS)
    class_id = np.nan_to_num(split.column("terrain_class").astype(float), nan=0.0).astype(np.int64)
    return ExtraFeatures(class_id, split.column("slope_rad").astype(float), turn, command)


def empty_extra_features(count: int) -> ExtraFeatures:
    """Return unknown features of ``count`` segments."""
    unknown = np.full(count, np.nan)
    return ExtraFeatures(np.zeros(count, np.int64), unknown, unknown, unknown)


def available_features(features: ExtraFeatures) -> tuple[ExtraFeature, ...]:
    """Return the features that are known for at least one of these samples."""
    found = []
    for name in ("turn_radpm", "command_mps"):
        values = getattr(features, name)
        if (known := values[np.isfinite(values)]).size:
            mean = float(known.mean())
            found.append(
                ExtraFeature(name, mean, max(float(known.std()), 1e-3), mean, (float(known.min()), float(known.max())))
            )
    return tuple(found)


def fill_unknown(inputs: Sequence[ExtraFeature], features: ExtraFeatures) -> ExtraFeatures:
    """Return the features with a model's usual values where one that it takes is unknown."""
    known = dict[str, Any]()
    for feature in inputs:
        values = getattr(features, feature.name)
        known[feature.name] = np.where(np.isfinite(values), values, feature.usual)
    return replace(features, **known)


def standardize_features(inputs: Sequence[ExtraFeature], features: ExtraFeatures) -> Floats:
    """Return a model's features of N segments as (value - mean) / deviation, shape (N, inputs)."""
    known = fill_unknown(inputs, features)
    scaled = [(getattr(known, feature.name) - feature.mean) / feature.deviation for feature in inputs]
    return np.column_stack(scaled) if scaled else np.empty((len(features.turn_radpm), 0))


def _form_values(columns: Iterable[Floats]) -> tuple[Floats, Floats]:
    rate, duration, arc, command = columns
    return rate * duration / arc, command


def append_planes(patches: Floats32, numbers: Floats) -> Floats32:
    """Return patches, shape (N, px, px, depth), with a channel of one value for each of N rows of numbers."""
    if not numbers.shape[1]:
        return patches
    planes = np.broadcast_to(numbers[:, None, None, :].astype(np.float32), (*patches.shape[:3], numbers.shape[1]))
    return np.concatenate([patches, planes], axis=3)


def append_column_planes(inputs: Sequence[ExtraFeature], patches: Floats32, columns: NDArray[np.floating]) -> Floats32:
    """Return patches of a batch with a plane for each extra feature, from `COLUMNS` of the batch, shape (N, 4)."""
    turn, command = _form_values(columns.T.astype(float))
    features = replace(empty_extra_features(len(columns)), turn_radpm=turn, command_mps=command)
    return append_planes(patches, standardize_features(inputs, features))
