"""Errors of a model's time and energy for a metre and for a path, estimated from held-out samples (ADR-25).

They are, in this order:

* the **bias** of each terrain class: the ratio of its metres' true and predicted sums, minus one, where it is
  beyond chance. With b the ratio of a class, b0 that of all and s its standard error over blocks of the drives: b0 + (b
  - b0) max(0, 1 - s² / (b - b0)²) (James and Stein's positive part; Efron and Morris, JASA 70, 1975), and no larger
  than without any single fold of the cross-validation. Predictions are multiplied by it, so that they are centred.
* the **spread** of one metre, a + c |prediction| + e s, with a factor of the class, which is close to 1 for few
  samples. s is the standard deviation that the model itself predicts, 0 without one: it counts as far as held-out
  errors follow it. Errors of a single fold vary from fold to fold (by 31 % for networks): spreads are then as much
  wider as Student's t of 5 degrees of freedom.
* the **correlation** of two metres of one run by their distance, from the products of errors over their spread. A
  segment's end is the next one's beginning, so that the correlation of neighbours may be negative; beyond, it never
  rises, and distances with few pairs are combined.
* the **variance of a run's own error**: variance of the means of runs beyond the correlated errors of their metres,
  widened by Student's t for few runs.
* the **common error** of the labels (gain and zero of the power sensor, scale of a single odometry): held-out samples
  contain it, so that no residual shows it. Its share of the labels' sum comes from the columns of their standard
  deviations.

Ground near training samples has separate spreads, correlations and runs if enough held-out samples are on such ground.

With spreads a_i and errors s_i of the biases, the error of a robot's own measurements on a path of costs p_i is z
sqrt(sum_ij a_i a_j rho_ij + (sum_i s_i)²): relatively smaller on longer paths, but never less than the difference
between runs. Sensors with the same errors as in training do not change it. Against the true cost, as for a budget,
their c sum_i |p_i| is added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import isotonic_regression, nnls
from scipy.special import ndtr, ndtri, stdtrit

from tcpipe.arrays import AnyInts, Floats, Ints, Mask, NamedArrays, accumulate

Stated = Floats | float | None
Near = Mask | None
Residuals = NamedArrays

COVERAGE = 0.9
"""Share of drives that an interval is to cover."""

FEWEST = 20
"""Fewest held-out samples to estimate errors, and fewest of a class to estimate its bias."""

_TAIL = (1.0 - COVERAGE) / 2.0
NORMAL_HALF_WIDTH = 1.6448536269514722
"""Half-width of a normal interval of `COVERAGE`, in standard deviations."""
_CLASSES = 256
_HALFWAY = 20.0  # samples of a class for which its spread is the geometric mean of its own and that of all
_ENOUGH_RUNS, _BLOCK = 10, 20
"""Fewest runs that are the clusters of a bias; with fewer, clusters are this many consecutive held-out samples."""
_MOST_BIAS = 0.5
_LAGS_M: Floats = np.concatenate([[0.0, 1.5], 2.0 ** np.arange(1.5, 13.0)])
"""Edges of the distances by which pairs are sorted: neighbours, and doubling to 6 km."""
_FEWEST_PAIRS = 100
_STEPS = np.unique(np.round(2.0 ** np.arange(0.0, 12.0, 0.5)).astype(np.int64))
"""Distances of the two rows of a pair [rows]: the number of pairs grows with the rows, not with their square."""


@dataclass(frozen=True, slots=True)
class Bias:
    """Factors, less one, of a quantity by class id, and their standard errors, shape (256,) each."""

    value: Floats
    std: Floats


@dataclass(frozen=True, slots=True)
class SumDistribution:
    """Two half normal distributions that meet at the prediction: of a path's time or energy as the sensors measure it.

    ``common_std``: standard deviation of the sensors' measurement against the truth.
    """

    middle: float
    std_below: float
    std_above: float
    common_std: float = 0.0

    @property
    def std(self) -> float:
        """Return the standard deviation of the true sum, the mean of both sides."""
        return float(np.hypot(0.5 * (self.std_below + self.std_above), self.common_std))

    @property
    def interval(self) -> tuple[float, float]:
        """Return the ends of the interval of `COVERAGE` for values that the robot's sensors will measure."""
        return self.middle - NORMAL_HALF_WIDTH * self.std_below, self.middle + NORMAL_HALF_WIDTH * self.std_above

    def compute_quantile(self, probability: float) -> float:
        """Return the value that the true sum does not exceed with a probability."""
        z = float(ndtri(probability))
        return self.middle + z * float(np.hypot(self.std_above if z > 0.0 else self.std_below, self.common_std))

    def compute_probability(self, limit: float) -> float:
        """Return the probability that the true sum does not exceed a limit."""
        std = float(np.hypot(self.std_above if limit > self.middle else self.std_below, self.common_std))
        return float(ndtr((limit - self.middle) / std)) if std else float(limit >= self.middle)


@dataclass(frozen=True, slots=True)
class QuantityErrors:
    """Errors of one quantity's centred predictions.

    Attributes
    ----------
    floor, share : the spread of a metre of all ground is ``floor`` + ``share`` |prediction|.
    of_class : factor of each class, by class id, shape (256,).
    low, high : 5 % and 95 % quantiles of the errors over their spread.
    bias_std : standard error of the class's bias, of the prediction, shape (256,).
    common_share : standard deviation of the labels' common error, of the prediction; 0 if the labels state none.
    stated_share, usual_stated : share of the model's standard deviation in the spread, and its mean over held-out
        samples.
    lag_m, correlation : of two metres so far apart on one run, from each lag to the next.
    of_run : variance of a run's own error over its spread, raised for the small number of runs.
    runs, samples : that were held out.
    """

    floor: float
    share: float
    of_class: Floats
    low: float
    high: float
    bias_std: Floats
    lag_m: Floats
    correlation: Floats
    of_run: float
    runs: int
    samples: int
    common_share: float = 0.0
    stated_share: float = 0.0
    usual_stated: float = 0.0
    near: QuantityErrors | None = None
    """Errors near training ground, the outer ones being for other ground; None with too few such held-out samples."""

    def compute_std(self, predicted: Floats, class_id: AnyInts, stated: Stated = None, is_near: Near = None) -> Floats:
        """Return the standard deviation of each prediction, shape (N,).

        ``stated``: the model's standard deviation, None: as usual; ``is_near``: near training ground, shape (N,), None:
        none is.
        """
        own = self.stated_share * (self.usual_stated if stated is None else stated)
        std = (self.floor + self.share * np.abs(predicted) + own) * self.of_class[class_id]
        if self.near is None or is_near is None:
            return std
        return np.where(is_near, self.near.compute_std(predicted, class_id, stated), std)

    def compute_intervals(
        self, predicted: Floats, class_id: AnyInts, stated: Stated = None, is_near: Near = None
    ) -> tuple[Floats, Floats]:
        """Return the interval of each path segment, shape (N,) each."""
        spread, near = self.compute_std(predicted, class_id, stated, is_near), self.near or self
        flags = np.zeros(len(predicted), bool) if is_near is None else is_near
        low, high = np.where(flags, near.low, self.low), np.where(flags, near.high, self.high)
        return predicted + low * spread, predicted + high * spread

    def compute_sum(
        self, predicted: Floats, class_id: AnyInts, stated: Stated = None, is_near: Near = None
    ) -> SumDistribution:
        """Return the distribution of a path's sum over segments of about 1 m in order; shape (N,), NaN counts as 0."""
        known = np.isfinite(predicted)
        values = np.where(known, predicted, 0.0)
        spread = np.where(known, self.compute_std(values, class_id, stated, is_near), 0.0)
        middle, alone = float(values.sum()), float((spread**2).sum())
        if not alone:
            return SumDistribution(middle, 0.0, 0.0)
        size, parts = np.abs(values), [(1.0, self)]
        if self.near is not None and is_near is not None:  # correlations of the ground under most of the path
            share = float(is_near[known].mean())
            parts = [(1.0 - share, self), (share, self.near)]
        below = above = 0.0
        for share, errors in parts:
            variance = max(errors.compute_variance(spread, errors.of_run), alone / spread.size)
            # Errors of sums are nearly normal, those of a metre are not.
            like_one = min(variance / float(spread.sum()) ** 2, 1.0)
            std = float(np.hypot(np.sqrt(variance), (size * errors.bias_std[class_id]).sum()))
            below += share * std * (like_one * -errors.low / NORMAL_HALF_WIDTH + 1.0 - like_one)
            above += share * std * (like_one * errors.high / NORMAL_HALF_WIDTH + 1.0 - like_one)
        return SumDistribution(middle, below, above, self.common_share * float(size.sum()))

    def compute_variance(self, spread: Floats, of_run: float) -> float:
        """Return a path sum's variance sum_ij a_i a_j rho_ij by spreads of path segments of about 1 m, shape (N,).

        ``of_run``: variance of a run's own error; correlation beyond the least one, that of a run, belongs to the
        metres.
        """
        spectrum = np.fft.rfft(spread, 2 * spread.size)
        pairs = np.fft.irfft(np.abs(spectrum) ** 2, 2 * spread.size)[: spread.size]  # sums of a_i a_j by lag
        at = np.searchsorted(self.lag_m, np.arange(1.0, spread.size), side="right") - 1
        least = float(self.correlation[-1])
        of_metres = (1.0 - least) * pairs[0] + 2.0 * (pairs[1:] @ (self.correlation[at] - least))
        return float(of_metres) + of_run * float(spread.sum()) ** 2


@dataclass(frozen=True, slots=True)
class BiasCorrection:
    """Correction of power and velocity, so that time and energy of a class are unbiased."""

    duration: Bias
    energy: Bias

    def apply(self, power_watt: Floats, velocity_mps: Floats, class_id: AnyInts) -> tuple[Floats, Floats]:
        """Return centred power [W] and velocity [m/s], shape (N,) each."""
        slower, more = 1.0 + self.duration.value[class_id], 1.0 + self.energy.value[class_id]
        return power_watt * more / slower, velocity_mps / slower


_NO_BIAS = Bias(np.zeros(_CLASSES), np.zeros(_CLASSES))


def fit_bias_correction(residuals: Residuals) -> BiasCorrection:
    """Return the correction of a model's power and velocity: none with fewer than `FEWEST` held-out samples of both."""
    held = _Held.collect(residuals)
    return BiasCorrection(_NO_BIAS, _NO_BIAS) if held is None else _fit_bias_correction(held)


def _fit_bias_correction(held: _Held) -> BiasCorrection:
    return BiasCorrection(*(_fit_bias(held.predicted[name], held.true[name], held) for name in ("duration", "energy")))


def fit_errors(residuals: Residuals) -> dict[str, QuantityErrors] | None:
    """Return the errors of power, velocity, duration and energy of a metre; None with under `FEWEST` held-out samples.

    ``residuals`` has a row for each of them: run_id, start_ns, terrain_class, power_watt, velocity_mps, and both as
    predicted; if known also fold, duration_s of its segment, duration_common_std_s and energy_common_std_joule, the
    stated errors (`make_residuals`), and the predictions `NEAR` by models of other runs, of samples on ground that
    these drove.
    Without columns of power the errors are those of velocity and duration.
    """
    held = _Held.collect(residuals)
    if held is None:
        return None
    away, by_runs = _fit_quantities(residuals, held), {name: residuals[name] for name in NEAR if name in residuals}
    if not by_runs:
        return away
    rows = np.isfinite(by_runs[NEAR[1]].astype(float))
    close = {name: values[rows] for name, values in residuals.items() if name not in _STATED}
    close |= {name.replace("_near", ""): values[rows] for name, values in by_runs.items()}
    held_near = _Held.collect(close)
    if held_near is None:
        return away
    near = _fit_quantities(close, held_near)
    return {name: replace(errors, near=near[name]) for name, errors in away.items()}


def _fit_quantities(residuals: Residuals, held: _Held) -> dict[str, QuantityErrors]:
    """Return the errors of each quantity, centred by their own bias."""
    correction = _fit_bias_correction(held)
    power, velocity = correction.apply(held.predicted["power"], held.predicted["velocity"], held.class_id)
    predicted = {"power": power, "velocity": velocity, "duration": 1.0 / velocity, "energy": power / velocity}
    std = {"duration": correction.duration.std, "energy": correction.energy.std}
    nothing = np.zeros(_CLASSES)
    return {
        name: replace(
            _fit_class_errors(values, held.true[name], held, std.get(name, nothing), held.stated[name]),
            common_share=_find_common_share(residuals, name),
        )
        for name, values in predicted.items()
        if held.has_power or name in ("velocity", "duration")
    }


def estimate_correlation(residuals: Residuals) -> float:
    """Return the correlation of the errors of power and velocity of held-out samples; 0 of too few."""
    held = _Held.collect(residuals)
    if held is None:
        return 0.0
    power, velocity = (held.true[name] - held.predicted[name] for name in ("power", "velocity"))
    both = float(np.sqrt(power.var() * velocity.var()))
    return float(np.mean((power - power.mean()) * (velocity - velocity.mean()))) / both if both else 0.0


NEAR = "power_near_predicted_watt", "velocity_near_predicted_mps"
"""Columns of predictions of samples on ground that other runs drove, by models of these; else NaN."""

_STATED = "power_predicted_std_watt", "velocity_predicted_std_mps", "power_velocity_predicted_covariance"


def make_residuals(labels: Floats, mean: Floats, covariance: Floats) -> dict[str, Floats]:
    """Return columns of labels and predictions (power, velocity), (N, 2), and of nonzero covariances, (N, 2, 2).

    For velocity alone the shapes are (N, 1) and (N, 1, 1).
    """
    if labels.shape[1] == 1:
        of_velocity = {_STATED[1]: np.sqrt(covariance[:, 0, 0])} if covariance.any() else {}
        return {"velocity_mps": labels[:, 0], "velocity_predicted_mps": mean[:, 0]} | of_velocity
    columns = {
        "power_watt": labels[:, 0], "velocity_mps": labels[:, 1],
        "power_predicted_watt": mean[:, 0], "velocity_predicted_mps": mean[:, 1],
    }  # fmt: skip
    stated = np.sqrt(covariance[:, 0, 0]), np.sqrt(covariance[:, 1, 1]), covariance[:, 0, 1]
    return columns | (dict(zip(_STATED, stated, strict=True)) if covariance.any() else {})


def propagate_stated(mean: Floats, covariance: Floats) -> dict[str, Floats]:
    """Return first-order σ of power, velocity, and time and energy of a metre, by the model's own covariances."""
    (power, velocity), (of_power, both), (_, of_velocity) = mean.T, *covariance.transpose(1, 2, 0)
    energy = of_power - 2.0 * both * power / velocity + of_velocity * (power / velocity) ** 2
    variances = {
        "power": of_power, "velocity": of_velocity,
        "duration": of_velocity / velocity**4, "energy": np.maximum(energy, 0.0) / velocity**2,
    }  # fmt: skip
    return {name: np.sqrt(variance) for name, variance in variances.items()}


_COMMON = {"duration": "duration_common_std_s", "energy": "energy_common_std_joule"}


def _find_common_share(residuals: Residuals, name: str) -> float:
    """Return the standard deviation of the labels' common error as a share of their sum; 0 if it is not stated."""
    if not {_COMMON.get(name, name), "duration_s"} <= residuals.keys():
        return 0.0
    std, label = residuals[_COMMON[name]].astype(float), residuals["duration_s"].astype(float)
    label = label if name == "duration" else np.abs(residuals["power_watt"].astype(float) * label)
    known = np.isfinite(std + label)
    return float(std[known].sum() / label[known].sum()) if label[known].any() else 0.0


@dataclass(frozen=True, slots=True)
class _Held:
    """Held-out samples in the order of driving: label and prediction of each quantity, shape (N,), and their place."""

    true: Mapping[str, Floats]
    predicted: Mapping[str, Floats]
    class_id: Ints
    run: Ints
    way_m: Floats
    """Along its run."""
    fold: Ints
    """Fold that was held out with it."""
    is_one_fold: bool
    stated: Mapping[str, Floats]
    """Standard deviations by the model; 0 if it states none."""
    has_power: bool
    """Whether power is known; else it is 0."""

    @classmethod
    def collect(cls, residuals: Residuals) -> _Held | None:
        names = ("power_watt", "velocity_mps", "power_predicted_watt", "velocity_predicted_mps")
        has_power = names[0] in residuals
        if not set(names) - residuals.keys() <= (set() if has_power else {names[0], names[2]}):
            return None
        nothing = np.zeros(len(residuals["velocity_mps"]))
        power, velocity, predicted_power, predicted_velocity = (
            residuals.get(name, nothing).astype(float) for name in names
        )
        usable = np.isfinite(power + predicted_power) & (velocity > 0.0) & (predicted_velocity > 0.0)
        if np.count_nonzero(usable) < FEWEST:
            return None
        run = np.unique(residuals["run_id"], return_inverse=True)[1].reshape(-1)
        start_ns = residuals["start_ns"].astype(np.int64)
        rows = np.lexsort((start_ns, run))
        rows = rows[usable[rows]]
        pace, of_run = velocity[rows], run[rows]
        # Velocity is chord over time, so that neighbours are a chord apart.
        step_m = pace[:-1] * np.diff(start_ns[rows]) * 1e-9
        way_m = accumulate(np.where(np.diff(of_run) == 0, step_m, 0.0))
        true, predicted = (
            {"power": p[rows], "velocity": v[rows], "duration": 1.0 / v[rows], "energy": p[rows] / v[rows]}
            for p, v in ((power, velocity), (predicted_power, predicted_velocity))
        )
        class_id = np.nan_to_num(residuals["terrain_class"][rows].astype(float)).astype(np.int64)
        fold = residuals["fold"][rows].astype(np.int64) if "fold" in residuals else np.zeros(rows.size, np.int64)
        is_one_fold = "fold" in residuals and np.unique(fold).size == 1
        covariance = np.zeros((rows.size, 2, 2))
        if _STATED[1] in residuals:
            of_power, of_velocity, both = (residuals.get(name, nothing)[rows].astype(float) for name in _STATED)
            covariance = np.array([[of_power**2, both], [both, of_velocity**2]]).transpose(2, 0, 1)
        mean = np.column_stack([predicted["power"], predicted["velocity"]])
        stated = propagate_stated(mean, covariance)
        return cls(true, predicted, class_id, of_run, way_m, fold, is_one_fold, stated, has_power)


def _fit_bias(predicted: Floats, true: Floats, held: _Held) -> Bias:
    """Return the bias of all ground, and of each class if it is significant."""
    block = held.run
    if np.unique(block).size < _ENOUGH_RUNS:
        block = np.cumsum(np.r_[True, np.diff(held.run) != 0] | (np.arange(predicted.size) % _BLOCK == 0)) - 1
    everywhere, error = _estimate_ratio(predicted, true, block)
    everywhere = _drop_bias_of_a_fold(everywhere, 0.0, predicted, true, held.fold)
    everywhere *= max(0.0, 1.0 - (error / everywhere) ** 2) if everywhere else 0.0
    value, std = np.full(_CLASSES, everywhere), np.full(_CLASSES, error)
    numbers, counts = np.unique(held.class_id, return_counts=True)
    for number in numbers[counts >= FEWEST].tolist():  # fewer samples are in one or two blocks, which show no variation
        own = held.class_id == number
        found, chance = _estimate_ratio(predicted[own], true[own], block[own])
        beyond = _drop_bias_of_a_fold(found, everywhere, predicted[own], true[own], held.fold[own]) - everywhere
        kept = max(0.0, 1.0 - (chance / beyond) ** 2) if beyond else 0.0
        value[number] = everywhere + kept * beyond
        std[number] = np.sqrt(kept * chance**2 + (1.0 - kept) * error**2)
    return Bias(np.clip(value, -_MOST_BIAS, _MOST_BIAS), std)


def _drop_bias_of_a_fold(found: float, usual: float, predicted: Floats, true: Floats, fold: Ints) -> float:
    """Return the usual bias plus the difference from it that remains without any single fold.

    A fold of ground that is rare in the others is predicted by a model that lacks it; the model of all samples does not
    have that bias.
    """
    folds = np.unique(fold)
    if folds.size < 2:
        return found
    others = [fold != other for other in folds]
    if min(map(np.count_nonzero, others)) < FEWEST:
        return usual
    parts = [found, *(_estimate_ratio(predicted[rows], true[rows], fold[rows])[0] for rows in others)]
    low, high = min(parts) - usual, max(parts) - usual
    return usual + (low if low > 0.0 else min(0.0, high))


def _estimate_ratio(predicted: Floats, true: Floats, block: Ints) -> tuple[float, float]:
    """Return the ratio of true to predicted sums, minus one, and its standard error over blocks (one: the ratio)."""
    whole = float(np.abs(predicted).sum())
    if not whole:
        return 0.0, 0.0
    found = float((true - predicted).sum()) / whole
    of_block = np.bincount(
        np.unique(block, return_inverse=True)[1], weights=true - predicted - found * np.abs(predicted)
    )
    several = of_block.size
    if several < 2:
        return found, abs(found)
    return found, float(np.sqrt((of_block**2).sum() * several / (several - 1.0))) / whole


_ONE_FOLD_FREEDOM = 5.0  # degrees of freedom of the spread of errors of one fold


def _fit_class_errors(predicted: Floats, true: Floats, held: _Held, bias_std: Floats, stated: Floats) -> QuantityErrors:
    error = true - predicted
    design = np.column_stack([np.ones_like(predicted), np.abs(predicted), stated])
    shares, _ = nnls(design, np.abs(error))
    plain = np.maximum(design @ shares, 1e-12)
    scale = max(float(np.sqrt(np.mean((error / plain) ** 2))), 1e-9)
    standard, of_class = error / (scale * plain), np.ones(_CLASSES)
    for number in np.unique(held.class_id).tolist():
        own = standard[held.class_id == number]
        of_class[number] = max(float(np.mean(own**2)), 1e-4) ** (0.5 * own.size / (own.size + _HALFWAY))
    standard = standard / of_class[held.class_id]
    low, high = np.quantile(standard, (_TAIL, 1.0 - _TAIL)).tolist()
    lag_m, correlation = _estimate_correlation(standard, held)
    runs = int(np.unique(held.run).size)
    wider = float(stdtrit(_ONE_FOLD_FREEDOM, 1.0 - _TAIL)) / NORMAL_HALF_WIDTH if held.is_one_fold else 1.0
    floor, share, stated_share = (float(part) * scale * wider for part in shares)
    found = QuantityErrors(
        floor, share, of_class, min(low, 0.0), max(high, 0.0), bias_std, lag_m, correlation, 0.0, runs, standard.size,
        stated_share=stated_share, usual_stated=float(stated.mean()),
    )  # fmt: skip
    return replace(
        found, of_run=_estimate_run_variance(found, error, scale * plain * of_class[held.class_id], held.run)
    )


def _estimate_run_variance(errors: QuantityErrors, error: Floats, spread: Floats, run: Ints) -> float:
    """Return the variance of a run's own error over its spread, beyond the mean of the errors of its metres.

    It is raised so that a normal interval of the mean error of a new run is as wide as that of Student's t. Runs count
    by their length (DerSimonian and Laird, Controlled Clinical Trials 7, 1986).
    """
    runs = np.unique(run)
    if runs.size < 2:  # only the farthest metres determine it
        return max(float(errors.correlation[-1]), 0.0)
    weight = np.array([spread[run == number].sum() for number in runs])
    means = np.array([error[run == number].sum() for number in runs]) / weight
    of_metres = np.array([errors.compute_variance(spread[run == number], 0.0) for number in runs]) / weight**2
    share = weight / weight.sum()
    wider = float(stdtrit(runs.size - 1.0, 1.0 - _TAIL)) / NORMAL_HALF_WIDTH
    beyond = float(share @ (means - share @ means) ** 2) - float((share * (1.0 - share)) @ of_metres)
    return wider**2 * max(beyond, 0.0) / (1.0 - float(share @ share))


def _estimate_correlation(standard: Floats, held: _Held) -> tuple[Floats, Floats]:
    """Return lags and the correlation from each on; the farther half of pairs share one, since runs end somewhere."""
    products, far_m = _pair_errors(standard, held)
    order = np.argsort(far_m, kind="stable")
    products, far_m, far_pairs = products[order], far_m[order], max(far_m.size // 2, _FEWEST_PAIRS)
    edges, starts = [0.0], [0]
    for edge, start in zip(_LAGS_M[1:].tolist(), np.searchsorted(far_m, _LAGS_M[1:]).tolist(), strict=True):
        if start - starts[-1] >= _FEWEST_PAIRS and far_m.size - start >= far_pairs:
            edges, starts = [*edges, edge], [*starts, start]
    pairs = np.diff([*starts, far_m.size]).astype(float)
    if not far_m.size:
        return np.zeros(1), np.zeros(1)
    rho = np.add.reduceat(products, starts) / pairs / max(float(np.mean(standard**2)), 1e-12)
    if rho.size > 1:
        rho[1:] = np.maximum(isotonic_regression(rho[1:], weights=pairs[1:], increasing=False).x, 0.0)
    return np.array(edges), np.clip(rho, -0.5, 1.0)


def _pair_errors(standard: Floats, held: _Held) -> tuple[Floats, Floats]:
    """Return the products of rows of one run, and how far apart they were driven [m]."""
    products, far_m = [np.empty(0)], [np.empty(0)]
    for step in _STEPS[standard.size > _STEPS]:
        same = held.run[step:] == held.run[:-step]
        products.append((standard[step:] * standard[:-step])[same])
        far_m.append((held.way_m[step:] - held.way_m[:-step])[same])
    return np.concatenate(products), np.concatenate(far_m)
