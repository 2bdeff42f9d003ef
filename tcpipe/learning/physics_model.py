"""A model of a few coefficients: how fast the robot drives a slope of a class, and what physics says that takes (`tcpipe.cost.physics`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.physics import ALL, FEWEST, Metres, Physics, fit_physics
from tcpipe.dataset import Split
from tcpipe.dataset.beside import Beside
from tcpipe.dataset.energies import ENERGIES
from tcpipe.errors import ModelError
from tcpipe.learning.curves import Curves, curves_of, fit_curves
from tcpipe.learning.metrics import LEAST_VELOCITY_MPS

Floats = NDArray[np.float64]

_CLASSES = 256
_NO_LOAD_QUANTILES = (0.01, 0.03, 0.1, 0.2, 0.3, 0.5)
"""Of the power, that are tried for what is drawn without any load."""


@dataclass(frozen=True, slots=True)
class PhysicsModel:
    """P = P0 + g(F v + N v tan(s) + M v |turn|), and v as a curve over the slope s."""

    speed: Curves
    """One output [m/s], straight in each third of the slopes."""
    no_load_watt: Floats
    """P0, shape ()."""
    grade_newton: Floats
    """N, shape ()."""
    recovered: Floats
    """Share of negative work that comes back, shape ()."""
    usual_turn_radpm: Floats
    """Of the training samples: what a metre is taken to turn where nothing is known of it, shape ()."""
    rolling_newton: Floats
    """F by class id, shape (256,)."""
    turning_joule_per_rad: Floats
    """M by class id, shape (256,)."""

    def predict(self, beside: Beside) -> Floats:
        """Return power [W] and velocity [m/s], shape (N, 2)."""
        velocity = np.maximum(self.speed.predict(beside.slope_rad, beside.class_id)[:, 0], LEAST_VELOCITY_MPS)
        turn = np.where(np.isfinite(beside.turn_radpm), beside.turn_radpm, self.usual_turn_radpm)
        force = self.rolling_newton[beside.class_id] + self.grade_newton * np.tan(beside.slope_rad)
        work = velocity * (force + self.turning_joule_per_rad[beside.class_id] * turn)
        return np.column_stack([self.no_load_watt + np.where(work > 0.0, 1.0, self.recovered) * work, velocity])

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return everything by name, as `physics_model_of` takes it."""
        return {**{name: getattr(self, name) for name in _NUMBERS}, **self.speed.arrays()}


_NUMBERS = tuple(of.name for of in fields(PhysicsModel) if of.name != "speed")


def physics_model_of(arrays: Mapping[str, NDArray[Any]], where: str) -> PhysicsModel:
    """Return the model that `PhysicsModel.arrays` told of; `ModelError` if these are another's."""
    speed, rest = curves_of("linear", arrays, where)
    if rest.keys() != set(_NUMBERS):
        raise ModelError(f"{where}: holds the weights of another model; train the model again")
    return PhysicsModel(speed, **rest)


def fit_physics_model(beside: Beside, labels: Floats, *, standing_watt: float | None) -> PhysicsModel:
    """Fit it to samples.

    Parameters
    ----------
    beside
        Of N samples; without any turn it has no term for turning.
    labels
        Power [W] and velocity [m/s], finite, shape (N, 2).
    standing_watt
        What the robot was seen to draw while it stood; None where it was not. Drives that turn may draw more without any load, and
        where speeds hardly vary nothing tells that from rolling but the ground that is driven down: of this and some of the smaller
        powers, that one is P0 which leaves the least error.

    Raises
    ------
    ModelError
        There are fewer than 20 samples.

    """
    names = np.where(beside.class_id > 0, beside.class_id.astype(np.str_), ALL)
    power, velocity = labels.T
    metres = Metres(power, velocity, np.tan(beside.slope_rad), beside.turn_radpm * velocity, names)
    found = _best(metres, [standing_watt, *np.quantile(power, _NO_LOAD_QUANTILES).tolist()])
    if found is None:
        raise ModelError(f"{len(labels)} samples to fit physics to, wanted at least {FEWEST} that move")
    known = beside.turn_radpm[np.isfinite(beside.turn_radpm)]
    return PhysicsModel(
        speed=fit_curves("linear", beside.slope_rad, beside.class_id, labels[:, 1:]),
        no_load_watt=_of_all(found, "standing"),
        grade_newton=_of_all(found, "grade"),
        recovered=np.array(found.recovered),
        usual_turn_radpm=np.array(float(known.mean()) if known.size else 0.0),
        rolling_newton=_by_class(found, "rolling"),
        turning_joule_per_rad=_by_class(found, "turning"),
    )


def _best(metres: Metres, candidates_watt: Sequence[float | None]) -> Physics | None:
    """Return the fit of the least mean error among those with each of these powers at no load."""
    fits = [fit_physics(metres, standing_watt=None if watt is None else max(watt, 0.0)) for watt in candidates_watt]
    found = [fit for fit in fits if fit is not None]
    return min(
        found, key=lambda fit: float(np.nanmean(np.abs(metres.power_watt - fit.power_watt(metres)))), default=None
    )


def standing_of(split: Split) -> float | None:
    """Return what the robot draws while it stands, of the power that a split's labels are of [W]; None where no run of it stood."""
    if split.energy is not ENERGIES["total"]:
        return 0.0
    watt = split.column("standing_power_watt").astype(np.float64)
    return float(np.nanmean(watt)) if np.isfinite(watt).any() else None


def _of_all(found: Physics, term: str) -> Floats:
    told = found.of(term)
    return np.array(0.0 if told is None else told[0])


def _by_class(found: Physics, term: str) -> Floats:
    """Return a coefficient by class id, shape (256,); a class that the fit does not name has that of the others, or their mean."""
    own = {name: found.value[at] for at, (kind, name) in enumerate(found.terms) if kind == term}
    rest = own.get(ALL, np.mean(list(own.values())) if own else 0.0)
    return np.array([own.get(str(class_id), rest) for class_id in range(_CLASSES)])
