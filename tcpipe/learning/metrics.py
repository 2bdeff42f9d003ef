"""The paper's two measures (section IV-A): RMSE and MAPE of power w, velocity v, time T and energy E.

T̂ = d / v̂ and Ê = ŵ d / v̂ follow from what the network says (equation 5); T* and E* are measured. A percentage needs a label that is
well above nothing: where the robot gives back or hardly takes power the MAPE leaves a sample out, and says so; the RMSE counts it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

QUANTITIES = ("w", "v", "T", "E")
UNITS = {"w": "W", "v": "m/s", "T": "s", "E": "J"}

LEAST = {"w": 10.0, "v": 0.05, "T": 0.05, "E": 10.0}
"""Labels below are in no percentage: 10 W is less than a Husky's drivers take at rest."""

LEAST_VELOCITY_MPS = 0.05
"""A predicted velocity is never below it, so that T = d / v stays finite: slower is standing."""

ALL = "all"

Costs = Mapping[str, Array]
"""Quantity to values, each of shape (N,)."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of some samples; None where there is nothing to average."""

    count: int
    rmse: float | None
    mape_percent: float | None
    mape_count: int
    """Samples whose label is large enough for a percentage."""


def errors(predicted: Array, measured: Array, least: float = 0.0) -> Errors:
    """Return the errors of predictions, both of shape (N,)."""
    difference = np.asarray(predicted, np.float64) - measured
    large = measured >= least
    rmse = float(np.sqrt(np.mean(difference**2))) if len(difference) else None
    mape = 100.0 * float(np.mean(np.abs(difference[large]) / measured[large])) if large.any() else None
    return Errors(len(difference), rmse, mape, int(large.sum()))


def combined(parts: Iterable[Errors]) -> Errors:
    """Return the errors of all parts together: RMSE in quadrature, MAPE weighted by count."""
    found = [part for part in parts if part.count]
    count, mape_count = sum(part.count for part in found), sum(part.mape_count for part in found)
    squares = sum(part.count * part.rmse**2 for part in found if part.rmse is not None)
    shares = sum(part.mape_count * part.mape_percent for part in found if part.mape_percent is not None)
    rmse = float(np.sqrt(squares / count)) if count else None
    return Errors(count, rmse, shares / mape_count if mape_count else None, mape_count)


def mean_of_draws(draws: Iterable[Errors]) -> Errors:
    """Return the mean errors of the same samples under several draws of noise."""
    found = list(draws)
    rmse, mape = _mean(draw.rmse for draw in found), _mean(draw.mape_percent for draw in found)
    return Errors(found[0].count, rmse, mape, found[0].mape_count)


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def errors_by_class(
    predicted: Costs, measured: Costs, class_ids: NDArray[np.int64], names: Mapping[int, str]
) -> dict[str, dict[str, Errors]]:
    """Return the errors of each quantity by class name, and of `ALL`: the classes combined.

    Parameters
    ----------
    predicted, measured
        The same quantities, each of shape (N,).
    class_ids
        Terrain class of each sample, shape (N,).
    names
        Of the ids that occur.

    """
    found = {}
    for quantity in predicted:
        by_class = {
            name: errors(predicted[quantity][here], measured[quantity][here], LEAST[quantity])
            for class_id, name in names.items()
            if (here := class_ids == class_id).any()
        }
        found[quantity] = {**by_class, ALL: combined(by_class.values())}
    return found


def label_floor(
    deviations: Costs, measured: Costs, class_ids: NDArray[np.int64], names: Mapping[int, str]
) -> dict[str, dict[str, Errors]]:
    """Return the errors that a perfect prediction would have for the labels' own deviations, shape (N,) each.

    The labels' errors are taken as Gaussian: a mean absolute error of sqrt(2 / pi) deviations.
    """
    found = {}
    for quantity, sigma in deviations.items():
        by_class = {}
        for class_id, name in names.items():
            here = class_ids == class_id
            if not here.any():
                continue
            label, std = measured[quantity][here], sigma[here]
            large = label >= LEAST[quantity]
            mape = 100.0 * np.sqrt(2.0 / np.pi) * float(np.mean(std[large] / label[large])) if large.any() else None
            by_class[name] = Errors(int(here.sum()), float(np.sqrt(np.mean(std**2))), mape, int(large.sum()))
        found[quantity] = {**by_class, ALL: combined(by_class.values())}
    return found


def costs(power_watt: Array, velocity_mps: Array, chord_m: float) -> dict[str, Array]:
    """Return w, v, T = d / v and E = w d / v."""
    w, v = np.asarray(power_watt, np.float64), np.asarray(velocity_mps, np.float64)
    return {"w": w, "v": v, "T": chord_m / v, "E": w * chord_m / v}
