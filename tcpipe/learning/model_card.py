"""The card of a model, ``model.json``: inputs, outputs, training range and training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from tcpipe.arrays import Floats
from tcpipe.dataset.energies import EnergyName
from tcpipe.dataset.tensor import TensorLayout, make_tensor_layout
from tcpipe.formats.integrity import FileChecksums
from tcpipe.formats.json_files import Json
from tcpipe.formats.maps.map_facts import Description, read_layers
from tcpipe.learning.fitting import FitConfig, ModelKind
from tcpipe.learning.predictor import Inputs
from tcpipe.tables.facts import PhysicsFit
from tcpipe.tables.findings import omit
from tcpipe.terrain.layers import PAPER_LAYERS, ClassTable, TerrainClass, make_paper_layers

KIND = "tcpipe model"

SCHEMA_VERSION = 6
"""Version of model.json and the files next to it."""


@dataclass(frozen=True, slots=True)
class LayerRange:
    """Range of a user's layer in training patches: the means of its bands, or shares of its classes."""

    mean: tuple[float, ...]
    std: tuple[float, ...]
    largest: float
    """Largest distance from the mean of all training samples and bands, in standard deviations."""

    @classmethod
    def estimate(cls, values: Floats) -> LayerRange:
        """Return the range of patches, shape (N, bands)."""
        mean, std = values.mean(axis=0), values.std(axis=0)
        plain = cls(tuple(mean.tolist()), tuple(np.maximum(std, _LEAST_SHARE * np.abs(mean) + 1e-9).tolist()), 0.0)
        return replace(plain, largest=float(plain.compute_distance(values).max()))

    def compute_distance(self, values: Floats) -> Floats:
        """Return how far the farthest band of each patch is from the mean, in standard deviations, shape (N,)."""
        return np.asarray((np.abs(values - np.array(self.mean)) / np.array(self.std)).max(axis=1))


_LEAST_SHARE = 1e-3  # least variation of a band, as a share of its mean: rounding is not outside the training range


@dataclass(frozen=True, slots=True)
class TrainingRange:
    """Range of the training samples; predictions beyond it are extrapolations."""

    class_counts: Mapping[int, int]
    """Samples by their terrain class."""
    pixel_classes: tuple[int, ...]
    """Ids of the classes that occur in any pixel."""
    ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest ``slope_rad``, ``cross_slope_rad``, ``relief_m`` (highest above lowest pixel of a patch)."""
    layers: Mapping[str, LayerRange] = omit({})
    """Ranges of the user's layers that the model uses."""


@dataclass(frozen=True, slots=True)
class TrainedOn:
    """The dataset that a model was trained on."""

    name: str
    sha256: str
    """Over the checksums of its files."""
    data_model_version: str
    samples: Mapping[str, int]
    """By split."""


@dataclass(frozen=True, slots=True)
class Training:
    """How a model was trained."""

    key: str
    """Hash of dataset and options: the same key, the same training."""
    config: FitConfig
    kind: ModelKind
    """Kind of the model: stated by the options, or chosen."""
    samples: Mapping[str, int]
    """``fitted``, and ``held out`` to stop by."""
    epochs: int
    best_epoch: int
    held_out_loss: float
    device: str


@dataclass(frozen=True, kw_only=True)
class ModelCard:
    """All of model.json but its seal."""

    kind: str = KIND
    schema_version: int = SCHEMA_VERSION
    inputs: Inputs
    layers: Mapping[str, Description] = omit({})
    """Descriptions of channels that are not the paper's, from its dataset."""
    chord_m: float
    """d: T = d / v."""
    max_arc_to_chord: float
    """No segment that it was trained on is more curved."""
    label_velocity: str
    """ground or fused: which velocity v is."""
    label_energy: EnergyName = "total"
    """total or net: which power w is, and so which energy E."""
    label_includes: tuple[str, ...] = ()
    """Loads other than the drives in the measured power, from the card of the dataset."""
    robot: str
    classes: tuple[TerrainClass, ...]
    training_range: TrainingRange
    physics: PhysicsFit | None = omit()
    """Physics of the robot, by the dataset: the planner takes the cost of turns from it."""
    dataset: TrainedOn
    training: Training
    checksums: FileChecksums = field(default_factory=dict)
    """Checksums of the files next to it, by name."""

    @cached_property
    def class_table(self) -> ClassTable:
        """Return the class table that the terrain channel is scaled by."""
        return ClassTable(self.classes)

    @cached_property
    def layout(self) -> TensorLayout:
        """Return how its tensors are formed: by the ranges of the dataset that it was trained on."""
        paper = make_paper_layers(PAPER_LAYERS, self.class_table)
        known = {**paper, **read_layers(self.layers, self.classes, Path("model.json"))}
        return make_tensor_layout(self.inputs.channels, known, self.inputs.patch_px)


def is_current(found: Mapping[str, Json]) -> bool:
    """Return whether a document is the card of a model of this schema."""
    return found.get("kind") == KIND and found.get("schema_version") == SCHEMA_VERSION
