"""What a model says of itself, ``model.json``: what it takes and gives, what it has seen, how it was trained, what its errors are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from tcpipe.dataset.energies import EnergyName
from tcpipe.dataset.extra_features import ExtraFeature
from tcpipe.formats.integrity import Checksum
from tcpipe.formats.json_files import Json
from tcpipe.learning.architecture import Architecture
from tcpipe.learning.fitting import FitConfig
from tcpipe.tables.facts import LEFT_OUT, PhysicsFit
from tcpipe.terrain.classes import TerrainClass

KIND = "tcpipe model"

SCHEMA_VERSION, EARLIER_SCHEMA_VERSION = 3, 2
"""Of model.json and the files beside it."""


@dataclass(frozen=True, slots=True)
class TrainingRange:
    """What the training samples held: beyond it a model has no business."""

    class_counts: Mapping[int, int]
    """Samples by their terrain class."""
    pixel_classes: tuple[int, ...]
    """Class ids of which any pixel occurs."""
    ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest ``slope_rad``, ``cross_slope_rad``, ``relief_m`` (highest above lowest pixel of a patch)."""


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
    optimizer: str
    samples: Mapping[str, int]
    """``fitted``, and ``held out`` to stop by."""
    epochs: int
    best_epoch: int
    held_out_loss: float
    device: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelCard:
    """All of model.json but its seal."""

    kind: str = KIND
    schema_version: int = SCHEMA_VERSION
    architecture: Architecture
    channels: tuple[str, ...]
    outputs: tuple[str, ...]
    """Columns that it predicts, in order: w, v (or E for a baseline)."""
    extra_features: tuple[ExtraFeature, ...] = ()
    """What it takes beside a patch."""
    scale: tuple[float, ...]
    """Largest label of train in each output's unit: what the network gives is multiplied by it."""
    patch_m: float
    chord_m: float
    """d: T = d / v."""
    max_arc_to_chord: float
    """No segment that it was trained on is more curved."""
    label_velocity: str
    """ground or fused: which velocity v is."""
    label_energy: EnergyName = "total"
    """total or net: which power w is, and so which energy E."""
    label_includes: tuple[str, ...] = ()
    """What the power that was measured feeds besides the drives, as the dataset's card has it."""
    robot: str
    classes: tuple[TerrainClass, ...]
    training_range: TrainingRange
    physics: PhysicsFit | None = field(default=None, metadata=LEFT_OUT)
    """Of the robot, by the dataset: the planner takes what turns cost from it."""
    dataset: TrainedOn
    training: Training
    checksums: Mapping[str, Checksum] = field(default_factory=dict)
    """Of the files beside it, by name."""


def is_current(found: Mapping[str, Json]) -> bool:
    """Return whether a document is the card of a model of this schema."""
    return found.get("kind") == KIND and found.get("schema_version") == SCHEMA_VERSION
