"""A residual network: a curve of class and slope, and a small convolutional network on what it leaves.

The curve says how cost goes on outside the training range; from few samples the network learns little, and the model is nearly the curve.
The number of steps follows from the number of samples, so that no fold is held out to stop it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset.extra_features import (
    COLUMNS,
    ExtraFeatures,
    append_column_planes,
    append_planes,
    standardize_features,
)
from tcpipe.formats.weights import check_arrays
from tcpipe.learning.network_model import require_torch
from tcpipe.learning.physics_model import Curves, cross_fit_curves, fit_curves, list_curve_arrays, read_curves
from tcpipe.learning.predictor import Inputs, Patches, Predictor, Samples

if TYPE_CHECKING:
    from tcpipe.learning.network import SmallNetwork

Floats = NDArray[np.float64]

_BATCH, _FEWEST_STEPS, _MOST_STEPS = 64, 300, 5000
"""Samples of a step, and limits of the steps."""


@dataclass(frozen=True, slots=True)
class ResidualModel(Predictor):
    """Curves and a network, whose outputs are multiplied by ``scale``, shape (outputs,)."""

    curves: Curves
    network: SmallNetwork
    scale: Floats
    inputs: Inputs

    about: ClassVar[str] = "a curve over the slope of each class, and a small convolutional network on what it leaves"
    optimizer: ClassVar[str] = "AdamW"

    def predict(self, patches: Patches, features: ExtraFeatures) -> Floats:
        """Return outputs, shape (N, outputs)."""
        planes = append_planes(patches, standardize_features(self.inputs.extra_features, features))
        curve = self.curves.predict(features.slope_rad, features.class_id)
        return np.asarray(curve + self.scale * self.network.predict(planes))

    @classmethod
    def fit(cls, samples: Samples) -> ResidualModel:
        """Fit the curves, and the network to the residuals of curves of the other folds."""
        require_torch()
        from tcpipe.learning.network import SmallNetwork  # noqa: PLC0415  torch takes seconds and half a gigabyte

        inputs, config = samples.inputs, samples.config
        ground = samples.features.slope_rad, samples.features.class_id
        residuals = samples.labels - cross_fit_curves(*ground, samples.labels, samples.folds)
        scale = np.maximum(residuals.std(axis=0), 1e-9)
        rules: dict[str, Any] = {"features": COLUMNS} if inputs.extra_features else {}
        batches = samples.split.batches(_BATCH, shuffle=True, seed=config.seed, mirror=config.mirror, **rules)
        batches = replace(
            batches, labels=(residuals / scale).astype(np.float32), weights=samples.weights.astype(np.float32)
        )
        steps = int(np.clip(config.residual_passes * len(samples) / _BATCH, _FEWEST_STEPS, _MOST_STEPS))
        network = SmallNetwork.make(inputs.depth, len(inputs.outputs), seed=config.seed)
        network.fit((_add_planes(inputs, *batch) for batch in batches.forever()), steps, config)
        return cls(fit_curves("linear", *ground, samples.labels), network, scale, inputs)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return curves, scale and weights by name."""
        return {**self.curves.arrays(), "scale": self.scale, **self.network.arrays()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], inputs: Inputs) -> ResidualModel:
        """Return the model of these arrays."""
        require_torch()
        from tcpipe.learning.network import SmallNetwork  # noqa: PLC0415

        outputs = len(inputs.outputs)
        forms = {**list_curve_arrays(outputs), "scale": ("float64", (outputs,))}
        weights = {name: array for name, array in arrays.items() if name not in forms}
        network = SmallNetwork.from_arrays(inputs.depth, outputs, arrays=weights)
        rest = {name: array for name, array in arrays.items() if name in forms}
        check_arrays(rest, forms)
        curves, rest = read_curves("linear", rest)
        return cls(curves, network, rest["scale"], inputs)


def _add_planes(inputs: Inputs, patches: Any, labels: Any, weights: Any) -> tuple[Patches, Patches, Patches]:
    """Return a batch whose patches have a plane for each extra feature."""
    if inputs.extra_features:
        patches = append_column_planes(inputs.extra_features, *patches)
    return patches, labels, weights
