"""What planning needs of a trained model; `tcpipe.learning.models.Model` satisfies the protocol, and planning imports no trainer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset.extra_features import ExtraFeatures
from tcpipe.dataset.tensor import TensorLayout
from tcpipe.errors import ModelError
from tcpipe.tables.facts import PhysicsFit
from tcpipe.terrain.classes import ClassTable
from tcpipe.terrain.layers import PAPER_LAYERS, make_paper_layers
from tcpipe.terrain.sampling import Patches
from tcpipe.terrain.tiles import MapReader

Floats = NDArray[np.float64]

BATCH_PATCHES = 2_048
"""Patches whose tensors exist at once: 40 MB."""


class CostModel(Protocol):
    """A model of power [W] and velocity [m/s] of a patch; which velocity, ``label_velocity`` says."""

    @property
    def name(self) -> str:
        """What the user calls it, for messages."""

    @property
    def checksum(self) -> str:
        """Hex digest of all that rules its predictions."""

    @property
    def robot(self) -> str:
        """The robot that it was trained on."""

    @property
    def classes(self) -> ClassTable:
        """The class table that it was trained with."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of the tensor, in order (`tcpipe.dataset.tensor`)."""

    @property
    def patch_m(self) -> float:
        """Side of a patch on the ground [m]."""

    @property
    def patch_px(self) -> int:
        """Side of a patch in pixels."""

    @property
    def chord_m(self) -> float:
        """Length of the segments that it was trained on [m]."""

    @property
    def max_arc_to_chord(self) -> float:
        """Arc over chord above which no segment was trained on."""

    @property
    def label_velocity(self) -> str:
        """``ground``: chord over duration; ``fused``: forward velocity along the surface (ADR-10)."""

    @property
    def label_energy(self) -> str:
        """``total``: all that the power source measured; ``net``: less what the robot draws while it stands."""

    @property
    def class_counts(self) -> Mapping[int, int]:
        """How many training samples each class had under its chord."""

    @property
    def pixel_classes(self) -> tuple[int, ...]:
        """Classes of which any pixel occurred in training."""

    @property
    def training_range(self) -> Mapping[str, tuple[float, float]]:
        """Smallest and largest ``slope_rad``, ``cross_slope_rad`` [rad] and ``relief_m`` [m] of the training patches."""

    @property
    def physics(self) -> PhysicsFit | None:
        """What turning costs the robot, beside all else; None where no physics could be fitted."""

    @property
    def residuals(self) -> Mapping[str, NDArray[np.generic]]:
        """Held-out samples, one row each.

        ``run_id``, ``start_ns``, ``terrain_class``, labels ``power_watt`` and ``velocity_mps``, and what the model said of them:
        ``power_predicted_watt``, ``velocity_predicted_mps``.
        """

    @property
    def takes_turns(self) -> bool:
        """Whether it is told how far a metre turns: its predictions hold what that costs."""

    def predict(self, patches: NDArray[np.float32], extra_features: ExtraFeatures) -> NDArray[np.float32]:
        """Return power [W] and velocity [m/s], shape (N, 2), of tensors of shape (N, px, px, channels), and what is known beside them."""


@dataclass(frozen=True, slots=True)
class Predicted:
    """Power [W] and velocity [m/s] of N patches, shape (N,); NaN where the model was not asked or answered no velocity."""

    power_watt: Floats
    velocity_mps: Floats


def _make_layout(model: CostModel) -> TensorLayout:
    return TensorLayout(model.channels, make_paper_layers(PAPER_LAYERS, model.classes))


def check_model(model: CostModel, source: MapReader) -> None:
    """Raise `ModelError` if a map cannot give the model what it was trained on; all differences at once."""
    problems = []
    needed = _make_layout(model).layers
    missing = [layer for layer in needed if layer not in source.layers]
    if missing:
        problems.append(
            f"map {source.name}: has no {', '.join(missing)}, which model {model.name} needs; add the map with --{missing[0]}"
        )
    if "terrain" in needed and "terrain" in source.layers and model.classes != source.classes:
        different = "; ".join(source.classes.differences(model.classes))
        problems.append(
            f"map {source.name}: its classes are not those that model {model.name} was trained with: {different}; "
            "train on a dataset of this class table, or add the map with the model's"
        )
    if problems:
        raise ModelError(*problems)


def predict_patches(
    model: CostModel, patches: Patches, asked: NDArray[np.bool_], turn_radpm: Floats | None = None
) -> Predicted:
    """Return what the model says of the patches that it is asked about, shape (N,); tensors are formed batch by batch.

    ``turn_radpm`` is how far a metre of each turns; NaN, or nothing, is as usual, and so is the speed that is commanded.

    Raises
    ------
    ModelError : it gives something else than power and velocity.
    """
    form = _make_layout(model)
    pixels = {layer: patches.pixels[layer] for layer in form.layers}
    out, unknown = np.full((asked.size, 2), np.nan), np.full(asked.size, np.nan)
    turns = unknown if turn_radpm is None else turn_radpm
    extra_features = ExtraFeatures(patches.terrain_class.astype(np.int64), patches.slope_rad, turns, unknown)
    for rows in _iterate_batches(np.flatnonzero(asked)):
        said = model.predict(form.form(pixels, rows), extra_features.take(rows))
        if said.shape != (rows.size, 2):
            raise ModelError(
                f"{model.name}: gives {said.shape[-1]} numbers a patch, expected two: power and velocity; train it on both labels"
            )
        out[rows] = said
    out[~(np.isfinite(out).all(axis=1) & (out[:, 1] > 0.0))] = np.nan
    return Predicted(out[:, 0].copy(), out[:, 1].copy())


def _iterate_batches(rows: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    yield from (rows[first : first + BATCH_PATCHES] for first in range(0, rows.size, BATCH_PATCHES))
