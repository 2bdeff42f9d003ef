"""What a model says of itself, ``model.json``: what it takes and gives, what it has seen, how it was trained, what its errors are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from tcpipe.errors import ModelError
from tcpipe.formats.maps.class_table import table_from_json, table_to_json
from tcpipe.learning.network import Architecture
from tcpipe.terrain.classes import ClassTable

KIND = "tcpipe model"

SCHEMA_VERSION = 2
"""Of model.json and the files beside it."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What the training samples held: beyond it a model has no business."""

    class_counts: Mapping[int, int]
    """Samples by their terrain class."""
    pixel_classes: tuple[int, ...]
    """Class ids of which any pixel occurs."""
    ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest ``slope_rad``, ``cross_slope_rad``, ``relief_m`` (highest above lowest pixel of a patch)."""


@dataclass(frozen=True, slots=True)
class ModelCard:
    """All of model.json but its checksums."""

    architecture: Architecture
    channels: tuple[str, ...]
    outputs: tuple[str, ...]
    """Columns that it predicts, in order: w, v (or E for a baseline)."""
    scale: tuple[float, ...]
    """Largest label of train in each output's unit: what the network gives is multiplied by it."""
    patch_m: float
    chord_m: float
    """d: T = d / v."""
    max_arc_to_chord: float
    """No segment that it was trained on is more curved."""
    label_velocity: str
    """ground or fused: which velocity v is."""
    robot: str
    classes: ClassTable
    seen: Seen
    dataset: Mapping[str, Any]
    """Name, checksum, data-model version and number of samples of what it was trained on."""
    training: Mapping[str, Any]
    """Loss, optimiser, seed, fold, epochs: how it was trained."""


_PLAIN = ("patch_m", "chord_m", "max_arc_to_chord", "label_velocity", "robot", "dataset", "training")


def card_to_json(card: ModelCard) -> dict[str, Any]:
    """Return the card as JSON values."""
    values = {name: getattr(card, name) for name in ModelCard.__slots__}
    values |= {
        "architecture": asdict(card.architecture),
        "classes": table_to_json(card.classes),
        "seen": asdict(card.seen),
    }
    return {"kind": KIND, "schema_version": SCHEMA_VERSION, **values}


def is_current(found: Mapping[str, Any]) -> bool:
    """Return whether a document is the card of a model of this schema."""
    return found.get("kind") == KIND and found.get("schema_version") == SCHEMA_VERSION


def card_from_json(found: Mapping[str, Any], where: str) -> ModelCard:
    """Return the card that `card_to_json` wrote.

    Raises
    ------
    ModelError
        It is none, of another schema, or incomplete.

    """
    if found.get("kind") != KIND:
        raise ModelError(f"{where}: not the card of a tcpipe model (kind is {found.get('kind')!r})")
    if found.get("schema_version") != SCHEMA_VERSION:
        version = found.get("schema_version")
        raise ModelError(f"{where}: written by model schema {version}, wanted {SCHEMA_VERSION}; train the model again")
    try:
        seen = found["seen"]
        plain = {name: found[name] for name in _PLAIN}
        return ModelCard(
            architecture=Architecture(**found["architecture"]),
            channels=tuple(found["channels"]),
            outputs=tuple(found["outputs"]),
            scale=tuple(float(value) for value in found["scale"]),
            classes=table_from_json(found["classes"]),
            seen=Seen(
                {int(class_id): int(count) for class_id, count in seen["class_counts"].items()},
                tuple(seen["pixel_classes"]),
                {name: (float(low), float(high)) for name, (low, high) in seen["ranges"].items()},
            ),
            **plain,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ModelError(f"{where}: incomplete ({type(error).__name__}: {error}); train the model again") from None
