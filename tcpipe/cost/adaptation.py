"""Adapt a model to another run, robot, payload or season by the first metres of it.

The trained model is the prior. With p what it predicts of the metres of the new run, and y what was measured there::

    y = p + X b + e,   b ~ N(0, s² Q),   e ~ N(0, s² S R S)

The columns of X are the spread of a metre (the error of the run, as large as runs differed in training), p (scale), predicted duration
(idle power), rise (payload; 10 % count as a metre) and turn (0.3 rad count as a metre), all in the unit of y. S are the spreads that the
model states of a metre, R the correlation of near metres. How far the robot has changed is not known: Q has the relative variance q² of
the last four for each q of a grid, and the answers are averaged, each with its evidence (Gelman et al., Bayesian Data Analysis, 2013,
7.4). A point of the grid is q = 0: nothing has changed. s² has an inverse-gamma prior of mean about 1, so that all that is stated has
Student's t (ibid., 14.2).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import stdtrit

from tcpipe.cost.prediction_errors import COVERAGE, NORMAL_HALF_WIDTH, Errors, SumDistribution

Floats = NDArray[np.float64]

_CHANGES = {0.0: 0.7, 0.1: 0.15, 0.3: 0.15}
"""Prior probability of each standard deviation q of a relative change."""
_RISE_M, _TURN_RAD = 0.1, 0.3
"""Rise and turn that cost about as much as a metre."""
_FREEDOM = 20.0
"""Metres that the prior of s² counts as."""
_PLACE_SHARE, _PLACE_M = 0.2, 30.0
"""Share of the variance of errors that metres within about this distance have in common [m], beyond what held-out samples show."""
_UPPER_END = (1.0 + COVERAGE) / 2.0
"""Probability below the upper end of an interval."""


@dataclass(frozen=True, slots=True)
class Metres:
    """N metres of one run in order, shape (N,): one quantity as it was predicted and, where it is known, measured."""

    predicted: Floats
    measured: Floats
    class_id: NDArray[np.integer]
    distance_m: Floats
    """Where each begins, along the run."""
    length_m: Floats
    duration_s: Floats
    """Predicted."""
    rise_m: Floats
    """Over each, uphill positive."""
    turn_rad: Floats
    """Over each, both ways counted."""
    stated_std: Floats | None = None
    """Of the prediction, by the model itself; None: as usual."""
    is_near: NDArray[np.bool_] | None = None
    """Whether each is near training ground; None: none is."""

    def take(self, rows: NDArray[np.bool_]) -> Metres:
        """Return some of them."""
        values: dict[str, Any] = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        values = {name: None if value is None else value[rows] for name, value in values.items()}
        return Metres(**values)

    @property
    def ground(self) -> tuple[Floats, NDArray[np.integer], Floats | None, NDArray[np.bool_] | None]:
        """Return what `Errors` are asked about."""
        return self.predicted, self.class_id, self.stated_std, self.is_near


@dataclass(frozen=True, slots=True)
class Adapted:
    """What a model, adapted or not, says of metres, shape (N,), with the ends of their intervals, and of their sum."""

    value: Floats
    low: Floats
    high: Floats
    total: SumDistribution


def predict(errors: Errors, there: Metres) -> Adapted:
    """Return what a model says of metres as it is."""
    low, high = errors.compute_intervals(*there.ground)
    return Adapted(there.predicted, low, high, errors.compute_sum(*there.ground))


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
    spread, spread_there = errors.compute_std(*known.ground), errors.compute_std(*there.ground)
    design, design_there = _make_design(known, spread, *usual), _make_design(there, spread_there, *usual)
    residual, apart_m = known.measured - known.predicted, np.abs(known.distance_m[:, None] - known.distance_m)
    likeness = _find_neighbour(errors) ** apart_m + _PLACE_SHARE * np.exp(-apart_m / _PLACE_M)
    factor = cho_factor(spread[:, None] * (likeness + 1e-9 * np.eye(len(residual))) * spread, lower=True)
    solved = cho_solve(factor, np.column_stack([design, residual]))
    gram, cross, square = design.T @ solved[:, :-1], design.T @ solved[:, -1], float(residual @ solved[:, -1])
    freedom, sums = _FREEDOM + len(residual), design_there.sum(axis=0)
    of_sum = errors.compute_variance(spread_there, 0.0)
    evidences, values, variances, totals = [], [], [], []
    for change, prior in _CHANGES.items():
        root = np.sqrt(np.array([errors.of_run, *[change**2] * (design.shape[1] - 1)]))
        inner = np.eye(root.size) + root[:, None] * gram * root
        covariance = root[:, None] * np.linalg.inv(inner) * root
        shift = covariance @ cross
        misfit = max(square - float(cross @ shift), 0.0)
        evidence = -0.5 * float(np.linalg.slogdet(inner)[1]) - freedom / 2.0 * float(np.log1p(misfit / _FREEDOM))
        scale = (_FREEDOM + misfit) / freedom
        evidences.append(np.log(prior) + evidence)
        values.append(there.predicted + design_there @ shift)
        variances.append(scale * (spread_there**2 + ((design_there @ covariance) * design_there).sum(axis=1)))
        totals.append(scale * (of_sum + float(sums @ covariance @ sums)))
    weights = np.exp(np.array(evidences) - max(evidences))
    weights /= weights.sum()
    mean, variance = _mix(weights, np.array(values), np.array(variances))
    total, total_variance = _mix(weights, np.array(values).sum(axis=1), np.array(totals))
    wider = float(stdtrit(freedom, _UPPER_END)) / NORMAL_HALF_WIDTH
    low, high = (end * wider * np.sqrt(variance) for end in (errors.low, errors.high))
    std = wider * float(np.sqrt(total_variance))
    common_std = errors.common_share * float(np.abs(mean).sum())
    return Adapted(mean, mean + low, mean + high, SumDistribution(float(total), std, std, common_std))


def _make_design(metres: Metres, spread: Floats, per_metre: float, per_second: float) -> Floats:
    """Return what each coefficient is multiplied with, shape (N, 5)."""
    as_metres = np.column_stack([metres.rise_m / _RISE_M, np.abs(metres.turn_rad) / _TURN_RAD])
    idle = per_second * metres.duration_s
    return np.column_stack([spread, metres.predicted, idle, per_metre * np.nan_to_num(as_metres)])


def _find_neighbour(errors: Errors) -> float:
    """Return the correlation of neighbours beyond that of their run."""
    at = int(np.searchsorted(errors.lag_m, 1.0, side="right")) - 1
    return float(np.clip(errors.correlation[at] - errors.correlation[-1], 0.0, 0.95))


def _mix(weights: Floats, values: Floats, variances: Floats) -> tuple[Floats, Floats]:
    """Return mean and variance of a mixture, over the first axis."""
    mean = np.tensordot(weights, values, 1)
    return mean, np.tensordot(weights, variances + (values - mean) ** 2, 1)


@dataclass(frozen=True, slots=True)
class Run:
    """Measured metres of a run, by quantity (``duration``, ``energy``), in order."""

    name: str
    metres: Mapping[str, Metres]

    def checksum(self) -> str:
        """Return a hash of what adapts a model."""
        arrays = [getattr(metres, field.name) for metres in self.metres.values() for field in fields(metres)]
        known = [np.ascontiguousarray(values).tobytes() for values in arrays if values is not None]
        return sha256(b"".join(known)).hexdigest()


@dataclass(frozen=True, slots=True)
class AdaptedErrors:
    """Errors of one quantity on the rest of runs, after the first ``metres`` of each are known."""

    quantity: str
    metres: float
    runs: int
    samples: int
    rmse: float
    coverage_percent: float
    """Of single metres, by 90 % intervals."""
    total_error_percent: float
    """Mean absolute error of the sums over the rests of runs."""
    totals_inside: int
    """Runs whose sum is inside its 90 % interval."""

    def __str__(self) -> str:
        """Return them as one line."""
        unit, digits = ("s", 3) if self.quantity == "duration" else ("J", 1)
        return (
            f"{self.quantity} after {self.metres:g} m: RMSE {self.rmse:.{digits}f} {unit}, 90 % intervals cover "
            f"{self.coverage_percent:.1f} % of {self.samples} metres; sums off by {self.total_error_percent:.1f} %, "
            f"{self.totals_inside} of {self.runs} inside"
        )


_LEAST_REST = 10
"""Metres that are left to predict, at least, of a run."""


def compare_adaptations(
    errors: Mapping[str, Errors], runs: Sequence[Run], known_m: Sequence[float]
) -> Iterator[AdaptedErrors]:
    """Yield errors on the rest of each run after so many metres of it are known.

    The rest begins after the most metres, so that all rows are of the same metres; a run too short for some ``known_m`` is in none.
    """
    for quantity, error in errors.items():
        parts = [(run.metres[quantity], np.cumsum(run.metres[quantity].length_m)) for run in runs]
        parts = [(metres, ends_m) for metres, ends_m in parts if (ends_m > max(known_m)).sum() >= _LEAST_REST]
        for metres_m in sorted(known_m) if parts else ():
            found = [
                (rest, adapt(error, known, rest) if len(known.predicted) else predict(error, rest))
                for metres, ends_m in parts
                for known, rest in [(metres.take(ends_m <= metres_m), metres.take(ends_m > max(known_m)))]
            ]
            off = np.concatenate([said.value - rest.measured for rest, said in found])
            inside = [(said.low <= rest.measured) & (rest.measured <= said.high) for rest, said in found]
            sums = np.array([rest.measured.sum() for rest, _ in found])
            middle, low, high = np.array([[said.total.middle, *said.total.interval] for _, said in found]).T
            yield AdaptedErrors(
                quantity=quantity, metres=metres_m, runs=len(found), samples=len(off),
                rmse=float(np.sqrt(np.mean(off**2))), coverage_percent=100.0 * float(np.concatenate(inside).mean()),
                total_error_percent=100.0 * float(np.mean(np.abs(middle / sums - 1.0))),
                totals_inside=int(((low <= sums) & (sums <= high)).sum()),
            )  # fmt: skip
