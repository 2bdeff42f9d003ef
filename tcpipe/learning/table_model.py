"""A table model: curves over slope and class, and boosted trees over all features of what these leave.

Trees alone are flat beyond what they have seen, and with few samples coarse: the curves go on straight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.weights import ArrayForm
from tcpipe.learning.curves import Curves, fit_curves, list_curve_arrays, read_curves
from tcpipe.learning.forest import FOREST_FORMS, Forest, grow, read_forest
from tcpipe.learning.patch_features import find_slope_and_class

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TableModel:
    """Curves and trees; ``channels`` and ``class_count`` say where slope and class stand in the features."""

    curves: Curves
    forest: Forest
    channels: tuple[str, ...]
    class_count: int

    def predict(self, features: Floats) -> Floats:
        """Return outputs, shape (N, outputs), of features, shape (N, features)."""
        slope_rad, class_id = find_slope_and_class(features, self.channels, self.class_count)
        return self.curves.predict(slope_rad, class_id) + self.forest.predict(features)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return curves and trees by name."""
        return {**self.forest.arrays(), **self.curves.arrays()}


def list_table_arrays(outputs: int) -> dict[str, ArrayForm]:
    """Return types and shapes of the arrays of a table model of so many outputs."""
    return {**FOREST_FORMS, **list_curve_arrays(outputs)}


def read_table_model(
    arrays: Mapping[str, NDArray[Any]], where: str, channels: Sequence[str], class_count: int
) -> TableModel:
    """Return the model that `TableModel.arrays` told of; `ModelError` if these are another's."""
    curves, rest = read_curves("linear", arrays, where)
    return TableModel(curves, read_forest(rest, where), tuple(channels), class_count)


def fit_table(
    features: Floats,
    labels: Floats,
    weights: Floats,
    folds: NDArray[np.generic],
    *,
    channels: Sequence[str],
    class_count: int,
) -> tuple[TableModel, Floats]:
    """Fit curves, and trees to what the curves of the other folds leave of each sample; return what the others said of it, too.

    Parameters
    ----------
    features : finite, shape (N, features): those of the channels, then any others.
    labels, weights : shape (N, outputs).
    folds : of each sample, shape (N,); at least two.
    channels, class_count : what the features are of.

    Raises
    ------
    ModelError : LightGBM is not installed, or cannot be loaded.
    """
    slope_rad, class_id = find_slope_and_class(features, channels, class_count)
    told = np.empty_like(labels)
    for fold in np.unique(folds):
        held = folds == fold
        others = fit_curves("linear", slope_rad[~held], class_id[~held], labels[~held])
        told[held] = others.predict(slope_rad[held], class_id[held])
    grown = grow(features, labels - told, weights, folds)
    curves = fit_curves("linear", slope_rad, class_id, labels)
    return TableModel(curves, grown.forest, tuple(channels), class_count), told + grown.held_out
