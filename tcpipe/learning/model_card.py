"""The card of a model: ``model.json`` with inputs, outputs, training range, training and errors, and ``MODEL.md`` for people."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined
from numpy.typing import NDArray

from tcpipe.dataset.energies import ENERGIES, EnergyName
from tcpipe.dataset.tensor import TensorLayout, make_tensor_layout
from tcpipe.errors import clean_line
from tcpipe.formats.integrity import Checksum
from tcpipe.formats.json_files import Json
from tcpipe.formats.maps.map_facts import Description, read_layers
from tcpipe.learning.fitting import FitConfig, ModelKind
from tcpipe.learning.predictor import Inputs, find_kind
from tcpipe.tables.facts import LEFT_OUT, PhysicsFit
from tcpipe.terrain.layers import PAPER_LAYERS, ClassTable, TerrainClass, make_paper_layers

KIND = "tcpipe model"

SCHEMA_VERSION = 5
"""Version of model.json and the files next to it."""


@dataclass(frozen=True, slots=True)
class LayerRange:
    """Range of a user's layer in training patches: the means of its bands, or shares of its classes."""

    mean: tuple[float, ...]
    std: tuple[float, ...]
    largest: float
    """Largest distance from the mean of all training samples and bands, in standard deviations."""

    @classmethod
    def estimate(cls, values: NDArray[np.float64]) -> LayerRange:
        """Return the range of patches, shape (N, bands)."""
        mean, std = values.mean(axis=0), values.std(axis=0)
        plain = cls(tuple(mean.tolist()), tuple(np.maximum(std, _LEAST_SHARE * np.abs(mean) + 1e-9).tolist()), 0.0)
        return replace(plain, largest=float(plain.compute_distance(values).max()))

    def compute_distance(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far the farthest band of each patch is from the mean, in standard deviations, shape (N,)."""
        return np.asarray((np.abs(values - np.array(self.mean)) / np.array(self.std)).max(axis=1))


_LEAST_SHARE = 1e-3
"""Least variation of a band, as a share of its mean: rounding is not outside the training range."""


@dataclass(frozen=True, slots=True)
class TrainingRange:
    """Range of the training samples; predictions beyond it are extrapolations."""

    class_counts: Mapping[int, int]
    """Samples by their terrain class."""
    pixel_classes: tuple[int, ...]
    """Class ids of which any pixel occurs."""
    ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest ``slope_rad``, ``cross_slope_rad``, ``relief_m`` (highest above lowest pixel of a patch)."""
    layers: Mapping[str, LayerRange] = field(default_factory=dict, metadata=LEFT_OUT)
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
    """Kind of the model: that of the options, or the one that was chosen."""
    optimizer: str
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
    layers: Mapping[str, Description] = field(default_factory=dict, metadata=LEFT_OUT)
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
    """Loads besides the drives in the measured power, from the card of the dataset."""
    robot: str
    classes: tuple[TerrainClass, ...]
    training_range: TrainingRange
    physics: PhysicsFit | None = field(default=None, metadata=LEFT_OUT)
    """Physics of the robot, by the dataset: the planner takes the cost of turns from it."""
    dataset: TrainedOn
    training: Training
    checksums: Mapping[str, Checksum] = field(default_factory=dict)
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


_README = """# Terrain-cost model

Predicts {{ outputs }} of {{ chord }} m of ground ahead of the robot from a patch of map:
mean power w [W] and velocity v [m/s] give T = d / v and E = w d / v with d = {{ chord }} m.

- Takes float32 (N, {{ px }}, {{ px }}, {{ depth }}) in [0, 1]: {{ channels }}; a patch is {{ patch }} m wide, travel to the right.
{% if extra_features -%}
- Also takes: {{ extra_features }}.
{% endif -%}
- Velocity is the {{ velocity }} one; power is {{ energy }}; robot {{ robot }}.
{%- if includes %}
  The measured power also feeds {{ includes }}.
{%- endif %}
- Kind {{ told.kind }}: {{ about }}.
  Best {{ told.best_epoch }} of {{ told.epochs }} epochs or trees.
  The loss {{ config.loss }} of {{ told.samples["held out"] }} samples that were held out is {{ "%.4f" | format(told.held_out_loss) }}.
- Trained on {{ told.samples["fitted"] }} samples of {{ dataset.name }}, checksum {{ dataset.sha256 }}.
- Training range: {{ classes }}; slope {{ slope }}; relief of a patch {{ relief }}. Do not use the model outside of these ranges.

```python
from tcpipe.learning.models import load_model

load_model("model").predict(patches)
```
"""


def format_readme(card: ModelCard) -> str:
    """Return the text of MODEL.md, the model card for people."""
    names = {entry.id: entry.name for entry in card.classes}
    counts = (
        f"{_escape_markdown(str(names.get(class_id, class_id)))} {count}"
        for class_id, count in card.training_range.class_counts.items()
    )
    dataset = replace(card.dataset, name=_escape_markdown(card.dataset.name))
    return Environment(autoescape=False, undefined=StrictUndefined, keep_trailing_newline=True).from_string(_README).render(  # noqa: S701  Markdown
        outputs=", ".join(card.inputs.outputs), chord=f"{card.chord_m:g}", px=card.inputs.patch_px,
        depth=len(card.inputs.planes), channels=", ".join(card.inputs.channels), patch=f"{card.inputs.patch_m:g}",
        velocity=card.label_velocity, energy=ENERGIES[card.label_energy].words,
        extra_features=", ".join(f"{feature.name} (usually {feature.usual:.3g})" for feature in card.inputs.extra_features),
        includes="; ".join(map(_escape_markdown, card.label_includes)), robot=card.robot,
        config=card.training.config, about=find_kind(card.training.kind).about, told=card.training,
        dataset=dataset, classes=", ".join(counts),
        slope=" to ".join(f"{np.degrees(value):.1f}°" for value in card.training_range.ranges["slope_rad"]),
        relief=" to ".join(f"{value:.2f} m" for value in card.training_range.ranges.get("relief_m", ())) or "not looked at",
    )  # fmt: skip


def _escape_markdown(name: str) -> str:
    """Return a name as text that Markdown takes for nothing else."""
    return re.sub(r"([\\`*_\[\]<>|#~])", r"\\\1", clean_line(name))
