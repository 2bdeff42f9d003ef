"""Models of few coefficients: curves over slope by terrain class, and the physics of power (`tcpipe.cost.physics`).

A curve is a polyline over the slope, fitted by least squares. The curve of a class with few samples stays near that of
all ground: its difference is penalised like J samples without one, J being a curve's number of coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np

from tcpipe.arrays import AnyArray, Floats, GenericArray, Ints, NamedArrays
from tcpipe.cost.physics import ALL, FEWEST, FitSamples, Physics, fit_physics
from tcpipe.dataset import Split
from tcpipe.dataset.energies import ENERGIES
from tcpipe.dataset.extra_features import ExtraFeatures
from tcpipe.errors import ModelError
from tcpipe.formats.weights import ArrayForm, check_arrays
from tcpipe.learning.metrics import LEAST_VELOCITY_MPS
from tcpipe.learning.predictor import Inputs, Patches, Predictor, Samples

_CLASSES = 256


@dataclass(frozen=True, slots=True)
class PhysicsModel(Predictor):
    """P = P0 + D v / cos(s) + g(F v + N v tan(s) + M v |turn|), and v as a curve over the slope s."""

    channels: ClassVar[tuple[str, ...]] = ("height",)
    features: ClassVar[tuple[str, ...] | None] = ("turn_radpm",)

    speed: Curves
    """One output [m/s], straight in each third of the slopes."""
    no_load_watt: Floats
    """P0, shape ()."""
    drivetrain_newton: Floats
    """D, shape ()."""
    grade_newton: Floats
    """N, shape ()."""
    recovered: Floats
    """Fraction of negative work that is recovered, shape ()."""
    usual_turn_radpm: Floats
    """Usual turn of a metre of the training samples, for metres with an unknown turn, shape ()."""
    rolling_newton: Floats
    """F by class id, shape (256,)."""
    turning_joule_per_rad: Floats
    """M by class id, shape (256,)."""

    def predict(self, patches: Patches, features: ExtraFeatures) -> Floats:
        """Return power [W] and velocity [m/s], shape (N, 2)."""
        del patches
        if len(features.slope_rad) and np.isnan(features.slope_rad).all():
            raise ModelError("physics needs the slope and class of each patch: predict(patches, features)")
        velocity = np.maximum(self.speed.predict(features.slope_rad, features.class_id)[:, 0], LEAST_VELOCITY_MPS)
        turn = np.where(np.isfinite(features.turn_radpm), features.turn_radpm, self.usual_turn_radpm)
        force = self.rolling_newton[features.class_id] + self.grade_newton * np.tan(features.slope_rad)
        work = velocity * (force + self.turning_joule_per_rad[features.class_id] * turn)
        always = self.no_load_watt + self.drivetrain_newton * velocity / np.cos(features.slope_rad)
        return np.column_stack([always + np.where(work > 0.0, 1.0, self.recovered) * work, velocity])

    @classmethod
    def fit(cls, samples: Samples) -> PhysicsModel:
        """Fit it to samples."""
        return fit_physics_model(samples.features, samples.labels, idle_watt=samples.idle_watt)

    def to_arrays(self) -> dict[str, GenericArray]:
        """Return everything by name."""
        return {**{name: getattr(self, name) for name in _NUMBERS}, **self.speed.arrays()}

    @classmethod
    def from_arrays(cls, arrays: NamedArrays, inputs: Inputs) -> PhysicsModel:
        """Return the model of these arrays."""
        del inputs
        check_arrays(arrays, {**_FORMS, **list_curve_arrays(1)})
        speed, rest = read_curves(arrays)
        if not all(np.isfinite(values).all() for values in rest.values()):
            raise ModelError("contains coefficients that are not finite; train the model again")
        return cls(speed, **rest)


_NUMBERS = tuple(entry.name for entry in fields(PhysicsModel) if entry.name != "speed")


_FORMS: Mapping[str, ArrayForm] = {
    name: ("float64", (_CLASSES,) if name in {"rolling_newton", "turning_joule_per_rad"} else ()) for name in _NUMBERS
}


def fit_physics_model(extra_features: ExtraFeatures, labels: Floats, *, idle_watt: float | None) -> PhysicsModel:
    """Fit it to samples.

    Parameters
    ----------
    extra_features : of N samples; without any turn it has no term for turning.
    labels : power [W] and velocity [m/s], finite, shape (N, 2).
    idle_watt : measured idle power; None if the robot was never stationary.
    """
    if labels.shape[1] < 2:
        raise ModelError("a model of physics needs the label energy, which the dataset does not have")
    names = np.where(extra_features.class_id > 0, extra_features.class_id.astype(np.str_), ALL)
    power, velocity = labels.T
    metres = FitSamples(power, velocity, np.tan(extra_features.slope_rad), extra_features.turn_radpm * velocity, names)
    found = fit_physics(metres, idle_watt=idle_watt)
    if found is None:
        raise ModelError(f"{len(labels)} samples to fit physics to, expected at least {FEWEST} that move")
    known = extra_features.turn_radpm[np.isfinite(extra_features.turn_radpm)]
    return PhysicsModel(
        speed=fit_curves(extra_features.slope_rad, extra_features.class_id, labels[:, 1:]),
        no_load_watt=_evaluate_all(found, "idle"),
        drivetrain_newton=_evaluate_all(found, "drivetrain"),
        grade_newton=_evaluate_all(found, "grade"),
        recovered=np.array(found.recovered),
        usual_turn_radpm=np.array(float(known.mean()) if known.size else 0.0),
        rolling_newton=_collect_by_class(found, "rolling"),
        turning_joule_per_rad=_collect_by_class(found, "turning"),
    )


def compute_idle_power(split: Split) -> float | None:
    """Return the idle power contained in a split's power labels [W]; None if no run of it was stationary."""
    if split.energy is not ENERGIES["total"]:
        return 0.0
    watt = split.column("idle_power_watt").astype(float)
    return float(np.nanmean(watt)) if np.isfinite(watt).any() else None


def _evaluate_all(found: Physics, term: str) -> Floats:
    coefficient = found.of(term)
    return np.array(0.0 if coefficient is None else coefficient[0])


def _collect_by_class(found: Physics, term: str) -> Floats:
    """Return a coefficient by class id, shape (256,); missing classes have that of all ground, or the mean."""
    own = {name: found.value[at] for at, (kind, name) in enumerate(found.terms) if kind == term}
    rest = own.get(ALL, np.mean(list(own.values())) if own else 0.0)
    return np.array([own.get(str(class_id), rest) for class_id in range(_CLASSES)])


_KNOTS = 1 / 3, 2 / 3  # quantiles of the slopes where a curve bends


@dataclass(frozen=True, slots=True)
class Curves:
    """Fitted curves, as arrays."""

    knots_rad: Floats
    """Slopes where the curves bend; none: a mean of each class."""
    pooled: Floats
    """Coefficients of all ground, and of unknown classes, shape (J, outputs)."""
    class_id: Ints
    own: Floats
    """Coefficients of each of these classes, shape (classes, J, outputs)."""

    def predict(self, slope_rad: Floats, class_id: Ints) -> Floats:
        """Return outputs, shape (N, outputs), of segments of one metre by slope and class."""
        design = _evaluate_functions(self.knots_rad, slope_rad)
        out = design @ self.pooled
        for known, numbers in zip(self.class_id.tolist(), self.own, strict=True):
            out[class_id == known] = design[class_id == known] @ numbers
        return out

    def arrays(self) -> dict[str, GenericArray]:
        """Return the arrays by name, as `read_curves` takes them."""
        return {f"{_STORED}{name}": getattr(self, name) for name in _ARRAYS}


_MOST_KNOTS, _MOST_CLASSES = 2, 256
_ARRAYS, _STORED = ("knots_rad", "pooled", "class_id", "own"), "curve_"


def list_curve_arrays(outputs: int) -> dict[str, ArrayForm]:
    """Return types and shapes of the arrays of curves with this number of outputs."""
    forms: dict[str, ArrayForm] = {
        "knots_rad": ("float64", ("knots",)),
        "pooled": ("float64", ("functions", outputs)),
        "class_id": ("int64", ("classes",)),
        "own": ("float64", ("classes", "functions", outputs)),
    }
    return {f"{_STORED}{name}": form for name, form in forms.items()}


def read_curves(arrays: NamedArrays) -> tuple[Curves, dict[str, AnyArray]]:
    """Return the curves of `Curves.arrays` and the other arrays; `ModelError` without valid curves."""
    rest = dict(arrays)
    curves = Curves(*(rest.pop(f"{_STORED}{name}") for name in _ARRAYS))
    functions = _evaluate_functions(curves.knots_rad[: _MOST_KNOTS + 1], np.zeros(1)).shape[1]
    is_plausible = curves.knots_rad.size <= _MOST_KNOTS and len(curves.class_id) <= _MOST_CLASSES
    finite = all(np.isfinite(values).all() for values in (curves.knots_rad, curves.pooled, curves.own))
    if len(curves.pooled) != functions or not finite or not is_plausible:
        raise ModelError("contains curves that training cannot produce; train the model again")
    return curves, rest


class CurveModel(Predictor):
    """Power and velocity by class and slope alone."""

    channels: ClassVar[tuple[str, ...]] = ("height",)
    features: ClassVar[tuple[str, ...] | None] = ()
    quantiles: ClassVar[tuple[float, ...]] = _KNOTS

    def __init__(self, curves: Curves) -> None:
        self.curves = curves

    def predict(self, patches: Patches, features: ExtraFeatures) -> Floats:
        """Return outputs, shape (N, outputs)."""
        del patches
        return self.curves.predict(features.slope_rad, features.class_id)

    @classmethod
    def fit(cls, samples: Samples) -> CurveModel:
        """Fit a curve of every class."""
        features = samples.features
        return cls(fit_curves(features.slope_rad, features.class_id, samples.labels, quantiles=cls.quantiles))

    def to_arrays(self) -> dict[str, GenericArray]:
        """Return the curves by name."""
        return self.curves.arrays()

    @classmethod
    def from_arrays(cls, arrays: NamedArrays, inputs: Inputs) -> CurveModel:
        """Return the model of these curves."""
        check_arrays(arrays, list_curve_arrays(len(inputs.outputs)))
        return cls(read_curves(arrays)[0])


class MeanModel(CurveModel):
    """A mean of each class."""

    quantiles: ClassVar[tuple[float, ...]] = ()


def fit_curves(slope_rad: Floats, class_id: Ints, labels: Floats, *, quantiles: Sequence[float] = _KNOTS) -> Curves:
    """Fit one curve for each class.

    Parameters
    ----------
    slope_rad, class_id : of the samples, finite, shape (N,), N at least 1.
    labels : finite, shape (N, outputs).
    quantiles : quantiles of the slopes at which the curves bend; none: one mean for each class.
    """
    knots = np.unique(np.quantile(slope_rad, quantiles)) if quantiles else np.empty(0)
    design = _evaluate_functions(knots, slope_rad)
    pooled = np.asarray(np.linalg.lstsq(design, labels, rcond=None)[0], float)
    prior = design.T @ design * (design.shape[1] / len(design))
    classes = np.unique(class_id[class_id > 0])
    own = np.empty((len(classes), *pooled.shape))
    for at, known in enumerate(classes):
        own_design, residual = design[class_id == known], (labels - design @ pooled)[class_id == known]
        own[at] = pooled + np.linalg.pinv(own_design.T @ own_design + prior, hermitian=True) @ (own_design.T @ residual)
    return Curves(knots, pooled, classes, own)


def _evaluate_functions(knots_rad: Floats, slope_rad: Floats) -> Floats:
    """Return a curve's basis functions at these slopes, shape (N, J), scaled to order one against rounding."""
    one = np.ones_like(slope_rad)
    if not knots_rad.size:
        return one[:, None]
    width = max(float(np.ptp(knots_rad)), 1e-6)
    slope, knots = (slope_rad - knots_rad[0]) / width, (knots_rad - knots_rad[0]) / width
    return np.column_stack([one, slope, np.maximum(slope[:, None] - knots, 0.0)])
