"""How wrong the sum over a path may be, from how wrong the model was on held-out metres (docs/adr, Intervals of a path).

The relative errors of one metre are taken from the held-out samples as they are: their mean, and their 5 % and 95 % quantiles, by
terrain class. The errors of two metres of one drive are correlated: a soft day, a full battery, a stretch of grass that is longer than it
looks. How strongly is measured on pairs of held-out samples of one run, by their distance; with rho(s) that correlation and a_i the
half-width of piece i::

    half-width of the sum = sqrt(sum_ij a_i a_j rho(s_ij))

Independent errors (rho = 0) would shrink with the root of the length; nobody who drives twice sees that. Beyond the longest distance with
enough pairs the last correlation is held: no more averaging is claimed than was seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

COVERAGE = 0.9
"""Share of drives that an interval is to hold."""

FEWEST = 20
"""Held-out samples without which nothing is said of errors."""

_FEWEST_OF_CLASS = 50
_FEWEST_PAIRS = 100
_LAGS_M: Floats = 2.0 ** np.arange(13.0)
"""Edges of the distances by which pairs are sorted: 1 m to 4 km."""


@dataclass(frozen=True, slots=True)
class RelativeErrors:
    """Relative errors of one quantity: truth over prediction, less one.

    Attributes
    ----------
    mean, low, high : by class id, 5 % and 95 % quantiles beside the mean; shape (256,).
    lag_m, correlation : correlation of two metres so far apart, from each lag to the next; it never rises.
    """

    mean: Floats
    low: Floats
    high: Floats
    lag_m: Floats
    correlation: Floats

    def of_pieces(self, predicted: Floats, class_id: NDArray[np.uint8]) -> tuple[Floats, Floats]:
        """Return the interval of each piece, shape (N,) each."""
        one, other = predicted * (1.0 + self.low[class_id]), predicted * (1.0 + self.high[class_id])
        return np.minimum(one, other), np.maximum(one, other)

    def of_sum(self, predicted: Floats, class_id: NDArray[np.uint8]) -> tuple[float, float]:
        """Return the interval of the sum over pieces of about a metre, in order along the path; shape (N,), NaN counts as none."""
        known = np.nan_to_num(predicted)
        middle = float((known * (1.0 + self.mean[class_id])).sum())
        widths = [np.abs(known * (edge - self.mean)[class_id]) for edge in (self.low, self.high)]
        below, above = (self._half_width(width) for width in widths)
        return middle - below, middle + above

    def _half_width(self, width: Floats) -> float:
        if not width.size:
            return 0.0
        spectrum = np.fft.rfft(width, 2 * width.size)
        pairs = np.fft.irfft(np.abs(spectrum) ** 2, 2 * width.size)[: width.size]  # sums of a_i a_j by lag
        lag = np.arange(width.size, dtype=np.float64)
        correlation = self.correlation[np.clip(np.searchsorted(self.lag_m, lag, side="right") - 1, 0, None)]
        return float(np.sqrt(max(pairs[0] + 2.0 * float(pairs[1:] @ correlation[1:]), 0.0)))


def errors_of(residuals: Mapping[str, NDArray[np.generic]]) -> dict[str, RelativeErrors] | None:
    """Return the errors of ``duration`` and ``energy`` a metre; None with fewer than `FEWEST` held-out samples.

    Parameters
    ----------
    residuals : held-out samples, as in `cost_model.CostModel`.
    """
    power, velocity = (residuals[name].astype(np.float64) for name in ("power_watt", "velocity_mps"))
    said_power = residuals["power_predicted_watt"].astype(np.float64)
    said_velocity = residuals["velocity_predicted_mps"].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = {"duration": said_velocity / velocity, "energy": (power / velocity) / (said_power / said_velocity)}
        usable = (
            np.isfinite(ratios["energy"]) & np.isfinite(ratios["duration"]) & (said_power > 0.0) & (said_velocity > 0.0)
        )
    if np.count_nonzero(usable) < FEWEST:
        return None
    class_id = residuals["terrain_class"][usable].astype(np.int64)
    first, second, lag_m = _pairs(
        residuals["run_id"][usable], residuals["start_ns"][usable].astype(np.int64), velocity[usable]
    )
    return {name: _errors(ratio[usable] - 1.0, class_id, first, second, lag_m) for name, ratio in ratios.items()}


def _errors(
    error: Floats, class_id: NDArray[np.int64], first: NDArray[np.int64], second: NDArray[np.int64], lag_m: Floats
) -> RelativeErrors:
    tails = (1.0 - COVERAGE) / 2.0
    mean, low, high = (np.full(256, value) for value in (error.mean(), *np.quantile(error, (tails, 1.0 - tails))))
    spread = np.full(256, error.std())
    for number in np.unique(class_id).tolist():
        own = error[class_id == number]
        if own.size >= _FEWEST_OF_CLASS:
            mean[number], spread[number] = own.mean(), own.std()
            low[number], high[number] = np.quantile(own, (tails, 1.0 - tails))
    low, high = np.minimum(low, mean), np.maximum(high, mean)
    standard = (error - mean[class_id]) / np.where(spread[class_id] > 0.0, spread[class_id], 1.0)
    return RelativeErrors(mean, low, high, _LAGS_M, _correlation(standard[first] * standard[second], lag_m))


def _correlation(products: Floats, lag_m: Floats) -> Floats:
    """Return the mean product of standardised errors by lag; bins with few pairs take the one before (the first: fully correlated)."""
    found, bins = np.ones(_LAGS_M.size), np.searchsorted(_LAGS_M, lag_m, side="right") - 1
    for number in range(_LAGS_M.size):
        own = products[bins == number]
        if own.size >= _FEWEST_PAIRS:
            found[number] = min(max(float(own.mean()), 0.0), 1.0)
        elif number:
            found[number] = found[number - 1]
    return np.asarray(np.maximum.accumulate(found[::-1])[::-1])


def _pairs(
    run_id: NDArray[np.generic], start_ns: NDArray[np.int64], velocity_mps: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Return pairs of rows of one run, and how far apart they were driven [m]; so many neighbours of each row that bins fill."""
    order = np.lexsort((start_ns, run_id))
    pace = float(np.median(velocity_mps))
    first, second = [], []
    for step in _STEPS[order.size > _STEPS]:
        a, b = order[:-step], order[step:]
        same = run_id[a] == run_id[b]
        first.append(a[same])
        second.append(b[same])
    if not first:
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    one, other = np.concatenate(first), np.concatenate(second)
    return one, other, np.maximum((start_ns[other] - start_ns[one]) * 1e-9 * pace, 1.0)


_STEPS = np.unique(np.round(2.0 ** np.arange(0.0, 12.0, 0.5)).astype(np.int64))
"""How many rows further the other of a pair stands: all distances are met, pairs grow with the rows, not with their square."""
