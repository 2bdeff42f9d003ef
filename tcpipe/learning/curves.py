"""Curves over the slope, one a terrain class: the model of a metre's cost with the fewest parameters.

A curve is a sum of few functions of the slope; its numbers are found by least squares, in closed form. Where a class has few samples its
curve lies near that of all ground: the difference counts as if as many samples as it has numbers had told that there is none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tcpipe.errors import ModelError
from tcpipe.formats.weights import ArrayForm

Floats = NDArray[np.float64]
Form: TypeAlias = Literal["mean", "linear", "spline"]

_KNOTS: dict[Form, tuple[float, ...]] = {
    "mean": (), "linear": (1 / 3, 2 / 3), "spline": (0.05, 0.23, 0.41, 0.59, 0.77, 0.95),
}  # fmt: skip
"""Quantiles of the slopes: a straight line in each third, of four numbers, and six knots, of six.

Those of the spline are Harrell's (Regression Modeling Strategies, 2015, 2.4.6)."""


@dataclass(frozen=True, slots=True)
class Curves:
    """Fitted curves, as arrays."""

    form: Form
    knots_rad: Floats
    pooled: Floats
    """Of all ground, and of classes that are not known, shape (J, outputs)."""
    class_id: NDArray[np.int64]
    own: Floats
    """Of each of these classes, shape (classes, J, outputs)."""

    def predict(self, slope_rad: Floats, class_id: NDArray[np.int64]) -> Floats:
        """Return outputs, shape (N, outputs), of metres of ground."""
        made = _evaluate_functions(self.form, self.knots_rad, slope_rad)
        out = made @ self.pooled
        for known, numbers in zip(self.class_id.tolist(), self.own, strict=True):
            out[class_id == known] = made[class_id == known] @ numbers
        return out

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return everything but the form by name, as `read_curves` takes it."""
        return {f"{_STORED}{name}": getattr(self, name) for name in _ARRAYS}


_MOST_KNOTS, _MOST_CLASSES = 6, 256
_ARRAYS, _STORED = ("knots_rad", "pooled", "class_id", "own"), "curve_"


def list_curve_arrays(outputs: int) -> dict[str, ArrayForm]:
    """Return types and shapes of the arrays of curves of so many outputs."""
    forms: dict[str, ArrayForm] = {
        "knots_rad": ("float64", ("knots",)),
        "pooled": ("float64", ("functions", outputs)),
        "class_id": ("int64", ("classes",)),
        "own": ("float64", ("classes", "functions", outputs)),
    }
    return {f"{_STORED}{name}": form for name, form in forms.items()}


def read_curves(form: Form, arrays: Mapping[str, NDArray[Any]], where: str) -> tuple[Curves, dict[str, NDArray[Any]]]:
    """Return the curves of `Curves.arrays` and the other arrays; `ModelError` without valid curves."""
    rest = dict(arrays)
    try:
        curves = Curves(form, *(rest.pop(f"{_STORED}{name}") for name in _ARRAYS))
    except KeyError:
        raise ModelError(
            f"{where}: contains the weights of another model, or of an older kind; train the model again"
        ) from None
    functions = (
        _evaluate_functions(form, curves.knots_rad, np.zeros(1)).shape[1] if curves.knots_rad.size <= _MOST_KNOTS else 0
    )
    finite = all(np.isfinite(of).all() for of in (curves.knots_rad, curves.pooled, curves.own))
    if len(curves.pooled) != functions or not finite or len(curves.class_id) > _MOST_CLASSES:
        raise ModelError(f"{where}: contains curves that no training makes; train the model again")
    return curves, rest


def fit_curves(form: Form, slope_rad: Floats, class_id: NDArray[np.int64], labels: Floats) -> Curves:
    """Fit a curve of every class.

    Parameters
    ----------
    form : ``mean``: one number; ``linear``: straight in each third of the slopes; ``spline``: natural cubic.
    slope_rad, class_id : of the samples, finite, shape (N,), N at least 1.
    labels : finite, shape (N, outputs).
    """
    knots = np.unique(np.quantile(slope_rad, _KNOTS[form])) if _KNOTS[form] else np.empty(0)
    made = _evaluate_functions(form, knots, slope_rad)
    pooled = np.asarray(np.linalg.lstsq(made, labels, rcond=None)[0], np.float64)
    drawn = made.T @ made * (made.shape[1] / len(made))
    classes = np.unique(class_id[class_id > 0])
    own = np.empty((len(classes), *pooled.shape))
    for at, known in enumerate(classes):
        mine, off = made[class_id == known], (labels - made @ pooled)[class_id == known]
        own[at] = pooled + np.linalg.pinv(mine.T @ mine + drawn, hermitian=True) @ (mine.T @ off)
    return Curves(form, knots, pooled, classes, own)


def _evaluate_functions(form: Form, knots_rad: Floats, slope_rad: Floats) -> Floats:
    """Return the functions of a form at these slopes, shape (N, J); all of order one, so that none is lost beside another."""
    one = np.ones_like(slope_rad)
    if form == "mean" or not knots_rad.size:
        return one[:, None]
    width = max(float(np.ptp(knots_rad)), 1e-6)
    slope, knots = (slope_rad - knots_rad[0]) / width, (knots_rad - knots_rad[0]) / width
    beyond = np.maximum(slope[:, None] - knots, 0.0)
    if form == "linear" or knots.size < 3:
        return np.column_stack([one, slope, beyond])
    cubes = beyond**3  # natural: what bends beyond the last knot is taken out (Harrell, eq. 2.25)
    last = knots[-1] - knots[-2]
    bent = cubes[:, :-2] - np.outer(cubes[:, -2], knots[-1] - knots[:-2]) / last
    return np.column_stack([one, slope, bent + np.outer(cubes[:, -1], knots[-2] - knots[:-2]) / last])
