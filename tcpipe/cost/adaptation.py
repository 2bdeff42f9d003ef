"""Adapt a model to another run, robot, payload or season by its first metres.

The trained model is the prior. With predictions p and measurements y of the metres of the new run::

    y = p + X b + e,   b ~ N(0, s² Q),   e ~ N(0, s² S R S)

The columns of X are the spread of a metre (error of a run), p (scale), predicted duration (idle power), rise (payload;
10 % count as a metre) and turn (0.3 rad count as a metre), all in the unit of y. S are the stated spreads of a metre, R
the correlation of near metres. Q has the relative variance q² of the last four for each q of a grid, of which q = 0
means no change; the results are averaged by their evidence (Gelman et al., Bayesian Data Analysis, 2013, 7.4). s² has
an inverse-gamma prior of mean about 1, so that predictions have Student's t (ibid., 14.2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import stdtrit

from tcpipe.arrays import AnyInts, Floats, Mask
from tcpipe.cost.prediction_errors import COVERAGE, NORMAL_HALF_WIDTH, QuantityErrors, SumDistribution

_CHANGES = {0.0: 0.7, 0.1: 0.15, 0.3: 0.15}  # prior probability of each standard deviation q of a relative change
_RISE_M, _TURN_RAD = 0.1, 0.3
"""Rise and turn that cost about as much as a metre."""
_FREEDOM = 20.0  # weight of the prior of s² [metres]
_PLACE_SHARE, _PLACE_M = 0.2, 30.0
"""Share of the variance of errors that metres within a distance have in common [1], and that distance [m]; held-out
samples show a smaller share."""


@dataclass(frozen=True, slots=True)
class Metres:
    """N metres of one run in order, shape (N,): predictions and, if known, measurements of one quantity."""

    predicted: Floats
    measured: Floats
    class_id: AnyInts
    distance_m: Floats
    """Distance of the start of each metre along the run."""
    length_m: Floats
    duration_s: Floats
    """Predicted duration of each metre."""
    rise_m: Floats
    """Rise over each metre, uphill positive."""
    turn_rad: Floats
    """Sum of absolute turns over each metre."""
    stated_std: Floats | None = None
    """Standard deviation that the model states; None: the usual one."""
    is_near: Mask | None = None
    """Whether each metre is near training ground; None: no metre is."""

    def take(self, rows: Mask) -> Metres:
        """Return the metres in ``rows``."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return replace(self, **{name: value[rows] for name, value in values.items() if value is not None})

    @property
    def ground(self) -> tuple[Floats, AnyInts, Floats | None, Mask | None]:
        """Return the arguments of the methods of `QuantityErrors`."""
        return self.predicted, self.class_id, self.stated_std, self.is_near


@dataclass(frozen=True, slots=True)
class Adapted:
    """Predictions of metres with their intervals, shape (N,), and of their sum."""

    value: Floats
    low: Floats
    high: Floats
    total: SumDistribution


def predict(errors: QuantityErrors, metres: Metres) -> Adapted:
    """Return the predictions of metres without adaptation."""
    low, high = errors.compute_intervals(*metres.ground)
    return Adapted(metres.predicted, low, high, errors.compute_sum(*metres.ground))


def adapt(errors: QuantityErrors, known: Metres, metres: Metres) -> Adapted:
    """Return the predictions of metres, adapted by one or more measured metres of the same run or robot.

    Metres without a prediction are NaN and in no sum.
    """
    has_cost = np.isfinite(metres.predicted)
    if not has_cost.all():
        part, columns = adapt(errors, known, metres.take(has_cost)), np.full((3, has_cost.size), np.nan)
        columns[:, has_cost] = part.value, part.low, part.high
        return Adapted(columns[0], columns[1], columns[2], part.total)
    whole = float(np.abs(known.predicted).sum())
    usual = whole / float(known.length_m.sum()), whole / float(known.duration_s.sum())
    spread, spread_there = errors.compute_std(*known.ground), errors.compute_std(*metres.ground)
    design, design_there = _make_design(known, spread, *usual), _make_design(metres, spread_there, *usual)
    residual, apart_m = known.measured - known.predicted, np.abs(known.distance_m[:, None] - known.distance_m)
    at = int(np.searchsorted(errors.lag_m, 1.0, side="right")) - 1
    neighbour = float(np.clip(errors.correlation[at] - errors.correlation[-1], 0.0, 0.95))  # beyond that of a run
    likeness = neighbour**apart_m + _PLACE_SHARE * np.exp(-apart_m / _PLACE_M)
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
        values.append(metres.predicted + design_there @ shift)
        variances.append(scale * (spread_there**2 + ((design_there @ covariance) * design_there).sum(axis=1)))
        totals.append(scale * (of_sum + float(sums @ covariance @ sums)))
    weights = np.exp(np.array(evidences) - max(evidences))
    weights /= weights.sum()
    mean, variance = _mix(weights, np.array(values), np.array(variances))
    total, total_variance = _mix(weights, np.array(values).sum(axis=1), np.array(totals))
    wider = float(stdtrit(freedom, (1.0 + COVERAGE) / 2.0)) / NORMAL_HALF_WIDTH
    low, high = (end * wider * np.sqrt(variance) for end in (errors.low, errors.high))
    std = wider * float(np.sqrt(total_variance))
    common_std = errors.common_share * float(np.abs(mean).sum())
    return Adapted(mean, mean + low, mean + high, SumDistribution(float(total), std, std, common_std))


def _make_design(metres: Metres, spread: Floats, per_metre: float, per_second: float) -> Floats:
    """Return the design matrix X, shape (N, 5)."""
    as_metres = np.nan_to_num(np.column_stack([metres.rise_m / _RISE_M, np.abs(metres.turn_rad) / _TURN_RAD]))
    return np.column_stack([spread, metres.predicted, per_second * metres.duration_s, per_metre * as_metres])


def _mix(weights: Floats, values: Floats, variances: Floats) -> tuple[Floats, Floats]:
    """Return mean and variance of a mixture, over the first axis."""
    mean = np.tensordot(weights, values, 1)
    return mean, np.tensordot(weights, variances + (values - mean) ** 2, 1)


@dataclass(frozen=True, slots=True)
class MeasuredRun:
    """Measured metres of a run, by quantity (``duration``, ``energy``), in order."""

    name: str
    metres: Mapping[str, Metres]
