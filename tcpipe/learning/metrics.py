"""The paper's two measures (section IV-A): RMSE and MAPE of power w, velocity v, time T and energy E.

T̂ = d / v̂ and Ê = ŵ d / v̂ follow from the network's outputs (equation 5); T* and E* are measured. A percentage needs
a label well above zero: the MAPE excludes samples where the robot gives back or hardly takes power, and reports it; the
RMSE includes them.

A model with uncertainties (`tcpipe.cost.prediction_errors`) is also scored by them (Gneiting and Raftery, *Strictly
proper scoring rules, prediction, and estimation*, JASA 102, 2007): by the share of labels in its 90 % intervals, and,
for a normal prediction of mean m and standard deviation s, z = (label - m) / s, by ::

    NLL  = ln(s) + z²/2 + ln(2 pi)/2                                 (their section 4.1, of the negative sign)
    CRPS = s (z (2 Phi(z) - 1) + 2 phi(z) - 1/sqrt(pi))            (equation 5 in closed form; in the label's unit)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from scipy.special import ndtr, stdtrit

from tcpipe.arrays import Floats, GenericArray, Ints, Mask
from tcpipe.tables.findings import omit

QUANTITIES = ("w", "v", "T", "E")
UNITS = {"w": "W", "v": "m/s", "T": "s", "E": "J"}

LEAST = {"w": 10.0, "v": 0.05, "T": 0.05, "E": 10.0}
"""Smallest label in a MAPE, by quantity: 10 W is less than the idle power of a Husky's drivers."""

LEAST_VELOCITY_MPS = 0.05
"""Smallest predicted velocity [m/s], so that T = d / v is finite."""

ALL = "all"

Costs = Mapping[str, Floats]
"""Quantity to values, each of shape (N,)."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of some samples; None without samples to average."""

    count: int
    rmse: float | None
    mape_percent: float | None
    mape_count: int
    """Samples whose label is large enough for a percentage."""
    coverage_percent: float | None = omit()
    """Coverage of 90 % intervals [%]; None, as the next two, without stated deviations."""
    nll: float | None = omit()
    """Mean negative log-likelihood, of labels in their unit."""
    crps: float | None = omit()
    """Mean continuous ranked probability score, in the label's unit."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Stated errors of predictions, shape (N,) each: standard deviation, and the ends of 90 % intervals."""

    std: Floats
    low: Floats
    high: Floats

    def take(self, rows: Mask) -> Spread:
        """Return the spread of some rows."""
        return Spread(self.std[rows], self.low[rows], self.high[rows])


def compute_errors(predicted: Floats, measured: Floats, least: float = 0.0, spread: Spread | None = None) -> Errors:
    """Return the errors of predictions, both of shape (N,), and their scores where a spread is stated."""
    difference = np.asarray(predicted, float) - measured
    large = measured >= least
    rmse = float(np.sqrt(np.mean(difference**2))) if len(difference) else None
    mape = 100.0 * float(np.mean(np.abs(difference[large]) / measured[large])) if large.any() else None
    scores = (
        (None, None, None) if spread is None or not len(difference) else _compute_scores(-difference, measured, spread)
    )
    return Errors(len(difference), rmse, mape, int(large.sum()), *scores)


_LEAST_STD = 1e-9  # least standard deviation; labels that are all equal have none


def _compute_scores(error: Floats, measured: Floats, spread: Spread) -> tuple[float, float, float]:
    std = np.maximum(spread.std, _LEAST_STD)
    z = error / std
    density = np.exp(-(z**2) / 2.0) / np.sqrt(2.0 * np.pi)
    crps = std * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi))
    nll = np.log(std) + z**2 / 2.0 + np.log(2.0 * np.pi) / 2.0
    held = (measured >= spread.low) & (measured <= spread.high)
    return 100.0 * float(held.mean()), float(nll.mean()), float(crps.mean())


_SCORES = tuple(entry.name for entry in fields(Errors))[4:]


def average_draws(draws: Iterable[Errors]) -> Errors:
    """Return the mean errors of the same samples under several draws of noise."""
    found = list(draws)
    rmse, mape = mean_known(draw.rmse for draw in found), mean_known(draw.mape_percent for draw in found)
    scores = (mean_known(getattr(draw, name) for draw in found) for name in _SCORES)
    return Errors(found[0].count, rmse, mape, found[0].mape_count, *scores)


def mean_known(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are known; None of none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def compute_errors_by_class(
    predicted: Costs,
    measured: Costs,
    class_ids: Ints,
    names: Mapping[int, str],
    spreads: Mapping[str, Spread] | None = None,
) -> dict[str, dict[str, Errors]]:
    """Return the errors of each quantity by class name, and of `ALL` samples.

    Parameters
    ----------
    predicted, measured : the same quantities, each of shape (N,).
    class_ids : terrain class of each sample, shape (N,).
    names : of the ids that occur.
    spreads : stated errors of the predictions, by quantity.
    """

    def compute_rows(quantity: str, rows: Mask) -> Errors:
        spread = (spreads or {}).get(quantity)
        said, true = predicted[quantity][rows], measured[quantity][rows]
        return compute_errors(said, true, LEAST[quantity], spread and spread.take(rows))

    return {quantity: _group_by_class(partial(compute_rows, quantity), class_ids, names) for quantity in predicted}


def _group_by_class(compute: Callable[[Mask], Errors], class_ids: Ints, names: Mapping[int, str]) -> dict[str, Errors]:
    """Return the result of a function for the rows of each class, by its name, and for `ALL`."""
    rows = {name: class_ids == class_id for class_id, name in names.items()} | {ALL: np.ones(len(class_ids), bool)}
    return {name: compute(here) for name, here in rows.items() if here.any() or name == ALL}


def compute_label_floor(
    deviations: Costs, measured: Costs, class_ids: Ints, names: Mapping[int, str]
) -> dict[str, dict[str, Errors]]:
    """Return the errors that a perfect prediction would have for the labels' own deviations, shape (N,) each.

    The labels' errors are taken as Gaussian: a mean absolute error of sqrt(2 / pi) deviations.
    """

    def compute_rows(quantity: str, rows: Mask) -> Errors:
        label, std = measured[quantity][rows], deviations[quantity][rows]
        large = label >= LEAST[quantity]
        mape = 100.0 * np.sqrt(2.0 / np.pi) * float(np.mean(std[large] / label[large])) if large.any() else None
        return Errors(len(std), float(np.sqrt(np.mean(std**2))) if len(std) else None, mape, int(large.sum()))

    return {quantity: _group_by_class(partial(compute_rows, quantity), class_ids, names) for quantity in deviations}


PATH_M = 30
"""Length of the paths whose sums are evaluated, in samples of about a metre."""


def compute_path_error(predicted: Floats, measured: Floats, runs: GenericArray, start_ns: GenericArray) -> float:
    """Return the error of sums over consecutive paths of `PATH_M` samples of a run [%]: RMS over the mean sum.

    All arrays have shape (N,); the rest of a run counts as a path if it is its only one.
    """
    order, sums = np.lexsort((start_ns, runs)), list[tuple[float, float]]()
    for rows in np.split(order, np.flatnonzero(runs[order][1:] != runs[order][:-1]) + 1):
        for path in np.array_split(rows, max(len(rows) // PATH_M, 1)):
            sums.append((float(predicted[path].sum()), float(measured[path].sum())))
    predicted_sums, true = np.array(sums).T
    size = float(np.abs(true).mean())
    return 100.0 * float(np.sqrt(np.mean((predicted_sums - true) ** 2))) / size if size else 0.0


def compute_costs(power_watt: Floats, velocity_mps: Floats, chord_m: float) -> dict[str, Floats]:
    """Return w, v, T = d / v and E = w d / v."""
    w, v = np.asarray(power_watt, float), np.asarray(velocity_mps, float)
    return {"w": w, "v": v, "T": chord_m / v, "E": w * chord_m / v}


_DRAWS = 2000
_TAILS = (0.025, 0.975)
_NORMAL = 1.959964

FEWEST_GROUPS = 10
"""Fewest groups for the interval of a ratio: a bootstrap of fewer is overconfident."""


@dataclass(frozen=True, slots=True)
class Ratio:
    """Ratio of errors with its 95 % interval; None if the divisor is zero, or there are too few groups."""

    value: float | None
    low: float | None
    high: float | None

    def __str__(self) -> str:
        """Return the ratio with its interval."""
        if self.value is None:
            return "–"
        return f"{self.value:.2f}" + ("" if self.low is None else f" ({self.low:.2f} to {self.high:.2f})")


def compare_errors(ours: Floats, theirs: Floats, groups: GenericArray, *, seed: int) -> Ratio:
    """Return the ratio of two RMSE over the same samples with its interval.

    Groups are drawn anew with all of their samples, the same ones for both sides. Quantiles of the logarithm are
    widened by the ratio of Student's t to the normal, and for the share of the scatter that the mean takes up: with few
    groups plain quantiles are overconfident (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, 13). If
    groups differ much, such an interval contains the truth in 92 of 100 cases (tested); a studentised one does no
    better, and is at times many times as wide.

    Parameters
    ----------
    ours, theirs : squared errors, shape (N,).
    groups : of each sample, shape (N,): its run, or its block of ground.
    seed : of the draws.
    """
    _, at = np.unique(groups, return_inverse=True)
    sums = np.stack([np.bincount(at, losses) for losses in (ours, theirs)], axis=1)
    if not len(sums) or not (total := sums.sum(axis=0)).all() or not np.isfinite(total).all():
        return Ratio(None, None, None)
    value, count = float(np.sqrt(total[0] / total[1])), len(sums)
    if count < FEWEST_GROUPS:
        return Ratio(value, None, None)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), _DRAWS) @ sums
    drawn = drawn[(drawn > 0.0).all(axis=1)]
    logs = 0.5 * np.log(drawn[:, 0] / drawn[:, 1]) - np.log(value)
    wider = float(stdtrit(count - 1, _TAILS[1])) / _NORMAL * np.sqrt(count / (count - 1))
    low, high = (value * np.exp(wider * np.quantile(logs, _TAILS))).tolist()
    return Ratio(value, low, high)
