"""Adapt a model to another run, robot, payload or season by the first metres of it.

The trained model is the prior. With p what it predicts of the metres of the new run, and y what was measured there::

    y = p + X b + e,   b ~ N(0, s² q² (t² + f² L)),   e ~ N(0, s² S R S)

The columns of X are in the unit of y: p itself (scale), and what a usual metre or second of the run costs times its length (offset),
predicted duration (idle power), slope (payload; 10 % count as a metre) and turn (0.3 rad count as a metre). b is relative to them, and
has a part that lasts and one of the place, warmth or wear, whose correlation L falls over tens or hundreds of metres: what the known
metres show of it counts less far away, and nothing on another way. Were only errors of metres allowed to fade, the same misfit would be
taken for a lasting property of the robot, because b reaches further. S are the spreads that the model states of a metre, R the
correlation of neighbours. s² has an inverse-gamma prior of mean about 1, so that all that is stated has Student's t (Gelman et al.,
Bayesian Data Analysis, 2013, 14.2). How far both parts reach, t and f, and L are not known: all of a small grid are averaged, each with
the evidence that the metres give it (ibid., 7.4). It is a Gaussian process (Rasmussen and Williams, 2006, 2.2).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from hashlib import sha256
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import stdtrit

from tcpipe.cost.prediction_errors import COVERAGE, NORMAL_HALF_WIDTH, Errors, SumDistribution

Floats = NDArray[np.float64]

_PRIOR = 0.05
"""q: standard deviation of a coefficient at the least reach, of what it multiplies."""
_REACHES = (1.0, 4.0, 16.0)
"""t and f, of which one may also be 0."""
_FADES_M = (20.0, 200.0)
"""Distances over which L falls."""
_RISE_M, _TURN_RAD = 0.1, 0.3
"""What costs about as much as a metre."""
_FREEDOM = 4.0
"""Of the prior of s²: as many metres as it counts."""
_NEIGHBOUR_M, _MOST_NEIGHBOUR = 1.5, 0.45
_UPPER_END = (1.0 + COVERAGE) / 2.0
"""Probability below the upper end of an interval."""

ELSEWHERE_M = 1e6
"""From here on, distances along a run mean another way: nothing of the run is near."""


@dataclass(frozen=True, slots=True)
class Metres:
    """N metres of one run in order, shape (N,): one quantity as it was predicted and, where it is known, measured."""

    predicted: Floats
    measured: Floats
    class_id: NDArray[np.integer]
    distance_m: Floats
    """Where each begins, along the run; `ELSEWHERE_M` and more on another way."""
    length_m: Floats
    duration_s: Floats
    """Predicted."""
    rise_m: Floats
    """Over each, uphill positive."""
    turn_rad: Floats
    """Over each, both ways counted."""
    stated_std: Floats | None = None
    """Of the prediction, by the model itself; None: as usual."""

    def take(self, rows: NDArray[np.bool_]) -> Metres:
        """Return some of them."""
        values: dict[str, Any] = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        values = {name: None if value is None else value[rows] for name, value in values.items()}
        return Metres(**values)


@dataclass(frozen=True, slots=True)
class Adapted:
    """What a model, adapted or not, says of metres, shape (N,), with the ends of their intervals, and of their sum."""

    value: Floats
    low: Floats
    high: Floats
    total: SumDistribution


def predict(errors: Errors, there: Metres) -> Adapted:
    """Return what a model says of metres as it is."""
    low, high = errors.compute_intervals(there.predicted, there.class_id, there.stated_std)
    return Adapted(there.predicted, low, high, errors.compute_sum(there.predicted, there.class_id, there.stated_std))


def adapt(errors: Errors, known: Metres, there: Metres) -> Adapted:
    """Return what a model says of metres, adapted by others of the same run or robot that were measured; at least one.

    Where it predicts nothing, the value is NaN, which is in no sum.
    """
    has_cost = np.isfinite(there.predicted)
    if not has_cost.all():
        part, columns = adapt(errors, known, there.take(has_cost)), np.full((3, has_cost.size), np.nan)
        columns[:, has_cost] = part.value, part.low, part.high
        return Adapted(columns[0], columns[1], columns[2], part.total)
    whole = float(np.abs(known.predicted).sum())
    usual = whole / float(known.length_m.sum()), whole / float(known.duration_s.sum())
    design, design_there, residual = (
        _make_design(known, *usual),
        _make_design(there, *usual),
        known.measured - known.predicted,
    )
    spread, spread_there = (
        errors.compute_std(metres.predicted, metres.class_id, metres.stated_std) for metres in (known, there)
    )
    neighbour, apart_m = _find_neighbour(errors), np.abs(known.distance_m[:, None] - known.distance_m)
    beside = np.eye(len(residual)) + neighbour * ((apart_m > 0.0) & (apart_m < _NEIGHBOUR_M))
    noise = spread[:, None] * beside * spread
    gram, cross = design @ design.T, design @ design_there.T
    far_m, alone = np.abs(known.distance_m[:, None] - there.distance_m), (design_there**2).sum(axis=1)
    noise_sum, lasting = _sum_neighbours(spread_there, there, neighbour), float((design_there.sum(axis=0) ** 2).sum())
    fading_sums = {fade_m: sum(_sum_fading(column, there, fade_m) for column in design_there.T) for fade_m in _FADES_M}
    freedom, evidences, values, variances, sums = _FREEDOM + len(residual), [], [], [], []
    grid = [(_FADES_M[0], reach, 0.0) for reach in _REACHES] + [*product(_FADES_M, (0.0, *_REACHES), _REACHES)]
    for fade_m, reach, fading in grid:
        lasts, fades = (_PRIOR * reach) ** 2, (_PRIOR * fading) ** 2
        factor = cho_factor(noise + gram * (lasts + fades * np.exp(-apart_m / fade_m)), lower=True)
        common = cross * (lasts + fades * np.exp(-far_m / fade_m))
        solved, shares = cho_solve(factor, residual), cho_solve(factor, common)
        misfit, log_det = float(residual @ solved), 2.0 * float(np.log(np.diag(factor[0])).sum())
        evidences.append(-0.5 * log_det - freedom / 2.0 * float(np.log1p(misfit / _FREEDOM)))
        scale = (_FREEDOM + misfit) / freedom
        values.append(there.predicted + common.T @ solved)
        variances.append(scale * (spread_there**2 + (lasts + fades) * alone - np.einsum("ij,ij->j", common, shares)))
        of_sum = (
            noise_sum + lasts * lasting + fades * fading_sums[fade_m] - float(common.sum(axis=1) @ shares.sum(axis=1))
        )
        sums.append(scale * of_sum)
    weights = np.exp(np.array(evidences) - max(evidences))
    weights /= weights.sum()
    mean, variance = _mix(weights, np.array(values), np.array(variances))
    total, total_variance = _mix(weights, np.array(values).sum(axis=1), np.array(sums))
    wider = float(stdtrit(freedom, _UPPER_END))
    low, high = (end * wider / NORMAL_HALF_WIDTH * np.sqrt(variance) for end in (errors.low, errors.high))
    half_sum = wider * float(np.sqrt(total_variance))
    common_std = errors.common_share * float(np.abs(mean).sum())
    return Adapted(mean, mean + low, mean + high, _make_sum(float(total), half_sum, common_std))


def _make_design(metres: Metres, per_metre: float, per_second: float) -> Floats:
    alike_m = np.column_stack([metres.length_m, metres.rise_m / _RISE_M, np.abs(metres.turn_rad) / _TURN_RAD])
    return np.column_stack([metres.predicted, per_second * metres.duration_s, per_metre * np.nan_to_num(alike_m)])


def _find_neighbour(errors: Errors) -> float:
    """Return the correlation of neighbours beyond that of their run, which the regression takes up."""
    at = int(np.searchsorted(errors.lag_m, 1.0, side="right")) - 1
    return float(np.clip(errors.correlation[at] - errors.correlation[-1], -_MOST_NEIGHBOUR, _MOST_NEIGHBOUR))


def _sum_neighbours(spread: Floats, metres: Metres, neighbour: float) -> float:
    """Return sum_ij of a_i a_j times the correlation R."""
    products = (spread[1:] * spread[:-1])[np.diff(metres.distance_m) < _NEIGHBOUR_M]
    return float((spread**2).sum() + 2.0 * neighbour * products.sum())


def _sum_fading(values: Floats, metres: Metres, fade_m: float) -> float:
    """Return sum_ij of a_i a_j times the correlation L."""
    total, carried = float((values**2).sum()), 0.0
    for fades, before, here in zip(np.exp(-np.diff(metres.distance_m) / fade_m), values[:-1], values[1:], strict=True):
        carried = fades * (carried + before)
        total += 2.0 * here * carried
    return total


def _mix(weights: Floats, values: Floats, variances: Floats) -> tuple[Floats, Floats]:
    """Return mean and variance of a mixture, over the first axis."""
    mean = np.tensordot(weights, values, 1)
    return mean, np.tensordot(weights, variances + (values - mean) ** 2, 1)


def _make_sum(middle: float, half: float, common_std: float = 0.0) -> SumDistribution:
    """Return the distribution of a sum whose 90 % interval has this half-width."""
    return SumDistribution(middle, half / NORMAL_HALF_WIDTH, half / NORMAL_HALF_WIDTH, common_std)


@dataclass(frozen=True, slots=True)
class Run:
    """Measured metres of a run, by quantity (``duration``, ``energy``), in order."""

    name: str
    metres: Mapping[str, Metres]

    def checksum(self) -> str:
        """Return a hash of what adapts a model."""
        arrays = [getattr(metres, field.name) for metres in self.metres.values() for field in fields(metres)]
        return sha256(b"".join(np.ascontiguousarray(values).tobytes() for values in arrays)).hexdigest()


@dataclass(frozen=True, slots=True)
class AdaptedErrors:
    """Errors of one predictor on the rest of runs, after the first ``metres`` of each are known."""

    quantity: str
    metres: float
    predictor: str
    """``model``, adapted where metres are known, or the mean of these metres."""
    runs: int
    samples: int
    rmse: float
    coverage_percent: float
    """Of single metres, by 90 % intervals."""
    total_error_percent: float
    """Mean absolute error of the sums over the rests of runs."""
    totals_inside: int
    """Runs whose sum is inside its 90 % interval."""


MODEL, MEAN = "model", "mean of the metres"

_LEAST_REST = 10
"""Metres that are left to predict, at least, of a run."""


def compare_adaptations(
    errors: Mapping[str, Errors], runs: Sequence[Run], known_m: Sequence[float]
) -> Iterator[AdaptedErrors]:
    """Yield errors on the rest of each run after so many metres of it are known, beside the mean of these metres.

    The rest begins after the most metres, so that all rows are of the same metres; a run too short for some ``known_m`` is in none.
    """
    first_m = max(known_m)
    for quantity, error in errors.items():
        parts = [(run.metres[quantity], _find_driven(run.metres[quantity])) for run in runs]
        parts = [(metres, driven) for metres, driven in parts if (driven > first_m).sum() >= _LEAST_REST]
        if not parts:
            continue
        for metres_m in sorted(known_m):
            for predictor in (MODEL, MEAN) if metres_m else (MODEL,):
                found = [
                    (rest, _predict_rest(error, metres.take(driven <= metres_m), rest, predictor))
                    for metres, driven in parts
                    for rest in [metres.take(driven > first_m)]
                ]
                yield _measure(quantity, metres_m, predictor, found)


def _find_driven(metres: Metres) -> Floats:
    """Return the metres with labels up to the end of each."""
    return np.asarray(np.cumsum(metres.length_m))


def _predict_rest(errors: Errors, known: Metres, rest: Metres, predictor: str) -> Adapted:
    if predictor == MEAN:
        return _predict_mean(known, rest)
    return adapt(errors, known, rest) if len(known.predicted) else predict(errors, rest)


def _predict_mean(known: Metres, rest: Metres) -> Adapted:
    """Return the mean of known metres for all others, with the intervals of independent normal ones."""
    per_metre = known.measured / known.length_m
    count, mean = len(per_metre), float(per_metre.mean())
    std = float(per_metre.std(ddof=1)) if count > 1 else np.inf
    wider = float(stdtrit(max(count - 1.0, 1.0), _UPPER_END))
    value, length_m = mean * rest.length_m, float(rest.length_m.sum())
    half = wider * std * np.sqrt(1.0 + 1.0 / count) * rest.length_m
    whole = wider * std * float(np.sqrt((rest.length_m**2).sum() + length_m**2 / count))
    return Adapted(value, value - half, value + half, _make_sum(mean * length_m, whole))


def _measure(quantity: str, metres_m: float, predictor: str, found: Sequence[tuple[Metres, Adapted]]) -> AdaptedErrors:
    error = np.concatenate([said.value - rest.measured for rest, said in found])
    inside = np.concatenate([(said.low <= rest.measured) & (rest.measured <= said.high) for rest, said in found])
    sums = np.array([rest.measured.sum() for rest, _ in found])
    totals = np.array([[said.total.middle, *said.total.interval] for _, said in found])
    return AdaptedErrors(
        quantity=quantity, metres=metres_m, predictor=predictor, runs=len(found), samples=len(error),
        rmse=float(np.sqrt(np.mean(error**2))), coverage_percent=100.0 * float(inside.mean()),
        total_error_percent=100.0 * float(np.mean(np.abs(totals[:, 0] / sums - 1.0))),
        totals_inside=int(((totals[:, 1] <= sums) & (sums <= totals[:, 2])).sum()),
    )  # fmt: skip


def format_adaptations(found: Sequence[AdaptedErrors]) -> Iterator[str]:
    """Yield errors on the rest of runs as plain lines, a table by metres."""
    for row in found:
        unit, digits = ("s", 3) if row.quantity == "duration" else ("J", 1)
        yield (
            f"{row.quantity} after {row.metres:g} m, {row.predictor}: RMSE {row.rmse:.{digits}f} {unit}, 90 % intervals cover "
            f"{row.coverage_percent:.1f} % of {row.samples} metres; sums off by {row.total_error_percent:.1f} %, "
            f"{row.totals_inside} of {row.runs} inside"
        )
