"""Baselines of a model, fitted on the same samples: curves, physics, boosted trees."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from tcpipe.arrays import GenericArray
from tcpipe.cost.prediction_errors import Residuals, make_residuals
from tcpipe.dataset import Dataset, Split
from tcpipe.dataset.extra_features import available_features, read_extra_features
from tcpipe.errors import ModelError
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.learning.fitting import FitConfig, ModelKind
from tcpipe.learning.metrics import FEWEST_GROUPS, LEAST, Errors, Ratio, compare_errors, compute_errors
from tcpipe.learning.models import Model
from tcpipe.learning.physics_model import MeanModel
from tcpipe.learning.predictions import Measured, Predicted
from tcpipe.learning.predictor import Job, Prediction, Predictor, Samples, find_kind, predict_samples
from tcpipe.learning.training import make_training_samples
from tcpipe.progress import logger
from tcpipe.tables.findings import Finding, Subject, make_finding

BASELINES: Mapping[str, type[Predictor]] = {
    "mean per class": MeanModel,
    "class and slope, linear": find_kind("linear"),
    "physics": find_kind("physics"),
    "gradient boosting": find_kind("boosting"),
}
"""Simplest first."""

CURVES, TREES = "class and slope, linear", "gradient boosting"

KIND_OF_BASELINE: Mapping[str, ModelKind] = {
    CURVES: "linear", "physics": "physics", TREES: "boosting"
}  # fmt: skip
"""Kind of each baseline that is also a kind of model."""

SPLITS = ("test", "unseen")

_MOST_EQUAL = 1.005  # ratio of RMSE up to which models are equal [1]: rounding changes it by less


def compare_baselines(
    ours: Model, data: Dataset, sets: Mapping[str, Measured], said: Mapping[str, Predicted], *, seed: int
) -> tuple[list[BaselineResult], list[Finding]]:
    """Return the results of every baseline, and a finding for each that cannot be fitted.

    The baselines are fitted on the training samples of ``data``, centred like the model, and evaluated on ``sets``, the
    samples of the model's predictions ``said``. ``seed``: of the bootstrap.
    """
    train = _select_fitted_samples(data["train"], ours)
    if not len(train):
        names = {"error": "the dataset has no labelled samples in split train"}
        return [], [make_finding("baseline-missing", Subject("model", "baselines"), names=names)]
    kind = ours.card.training.kind
    fitted, lacking = _fit_baselines(train, data, [name for name in BASELINES if KIND_OF_BASELINE.get(name) != kind])
    logger.info("baselines: %s, fitted on %d samples", ", ".join(fitted), len(train))
    found, block_m = list[BaselineResult](), data.card.recipe.split.block_m
    for split, part in sets.items():
        class_ids = read_extra_features(part.split).class_id
        for name, (samples, predictor, residuals) in fitted.items():
            there = replace(samples, split=part.split.with_channels(*samples.inputs.channels))
            found_there = predict_samples(predictor, there)
            if samples.inputs.is_time_alone:
                found_there = found_there.add_unknown_power()
            theirs = Predicted.centre(residuals, found_there, class_ids, ours.card.chord_m)
            if {kind, KIND_OF_BASELINE.get(name)} == {"linear", "physics"}:  # they share their curve of speed
                theirs = Predicted(
                    {quantity: costs for quantity, costs in theirs.costs.items() if quantity in "wE"}, {}
                )
            found += compare_with_baseline(name, split, part, said[split], theirs, block_m=block_m, seed=seed)
    return found, lacking


def _select_fitted_samples(train: Split, ours: Model) -> Split:
    """Return the samples that a model of this kind is fitted on: for a network without the fold that stops it."""
    labelled = train.take(np.isfinite(train.labels).all(axis=1))
    if not find_kind(ours.card.training.kind).stops_by_fold:
        return labelled
    fitted, _ = labelled.fold(ours.card.training.config.fold)
    return fitted if len(fitted) else labelled


def _fit_baselines(
    train: Split, data: Dataset, wanted: Sequence[str]
) -> tuple[dict[str, tuple[Samples, Predictor, Residuals]], list[Finding]]:
    """Return the baselines by name, with their held-out predictions, and a finding for each that cannot be fitted."""
    found, lacking = dict[str, tuple[Samples, Predictor, Residuals]](), list[Finding]()
    for name in wanted:
        try:
            samples, predictor, said = _fit_baseline(BASELINES[name], train, data)
            columns = {name: train.column(name) for name in ("run_id", "start_ns", "terrain_class", "fold")}
            found[name] = samples, predictor, columns | make_residuals(samples.labels, said.mean, said.covariance)
        except ModelError as error:
            names = {"error": error.problems[0]}
            lacking.append(make_finding("baseline-missing", Subject("model", name), names=names))
    return found, lacking


def _fit_baseline(kind: type[Predictor], train: Split, data: Dataset) -> tuple[Samples, Predictor, Prediction]:
    """Return a fitted kind and held-out predictions of each sample; NaN if folds are too few (no centring)."""
    turn = tuple(
        feature.name for feature in available_features(read_extra_features(train)) if feature.name == "turn_radpm"
    )
    if kind.features is None:  # trees take the turn, but not the commanded speed
        kind = type(kind.__name__, (kind,), {"features": turn})
    samples = make_training_samples(data, FitConfig(), kind, train)
    try:
        fitted = kind.fit_folds(samples, Job("", Path()))
    except ModelError:
        return samples, kind.fit(samples), Prediction.without_covariance(np.full(samples.labels.shape, np.nan))
    return samples, fitted.predictor, fitted.held_out


def _group_samples(split: Split, block_m: float) -> tuple[Literal["runs", "blocks"], GenericArray]:
    """Return groups of samples with correlated errors: runs where there are enough, else blocks of ground."""
    runs = split.column("run_id").astype(np.str_)
    if len(np.unique(runs)) >= FEWEST_GROUPS:
        return "runs", runs
    if split.has_coordinates:
        lon_deg, lat_deg = (split.column(f"start_{axis}_deg").astype(float) for axis in ("lon", "lat"))
        datum = float(lon_deg[0]), float(lat_deg[0]), 0.0  # one for all: x and y of a sample are in its own run's frame
        xy_m = enu_from_geodetic(lon_deg, lat_deg, 0.0, datum_deg_m=datum)[:, :2]
    else:
        xy_m = np.column_stack([split.column(f"start_{axis}_m").astype(float) for axis in "xy"])
    return "blocks", np.unique(np.floor(xy_m / block_m), axis=0, return_inverse=True)[1].reshape(-1)


def compare_with_baseline(
    name: str, split: str, part: Measured, ours: Predicted, theirs: Predicted, *, block_m: float, seed: int
) -> Iterator[BaselineResult]:
    """Yield the results of a baseline for every quantity that it predicts.

    ``ours`` and ``theirs``: predictions for the samples of ``part``; the bootstrap with ``seed`` draws runs, or blocks
    of ``block_m``.
    """
    drawn_by, groups = _group_samples(part.split, block_m)
    for quantity, measured in part.costs.items():
        if quantity not in theirs.costs:
            continue
        model_squares, other = ((said.costs[quantity] - measured) ** 2 for said in (ours, theirs))
        yield BaselineResult(
            baseline=name, split=split, quantity=quantity,
            errors=compute_errors(theirs.costs[quantity], measured, LEAST[quantity]),
            rmse_ratio=compare_errors(model_squares, other, groups, seed=seed), groups=len(np.unique(groups)), drawn_by=drawn_by,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class BaselineResult:
    """Errors of a baseline on the samples of the model, and the ratio of the model's RMSE to its."""

    baseline: str
    split: str
    quantity: str
    errors: Errors
    rmse_ratio: Ratio
    """RMSE of the model divided by that of the baseline: below 1 the model is better."""
    groups: int
    """Number of groups in the bootstrap."""
    drawn_by: Literal["runs", "blocks"]

    @property
    def is_beaten(self) -> bool:
        """Whether the model is significantly better."""
        return self.rmse_ratio.high is not None and self.rmse_ratio.high < 1.0

    @property
    def is_better(self) -> bool:
        """Whether the model is significantly worse."""
        low, value = self.rmse_ratio.low, self.rmse_ratio.value
        return low is not None and low > 1.0 and (value or 0.0) > _MOST_EQUAL


def describe_ratios(found: Sequence[BaselineResult]) -> list[str]:
    """Return the ratio of RMSE to that of the best baseline, for energy and time of each split."""
    lines = []
    for split in SPLITS:
        for quantity, called in (("E", "energy E"), ("T", "time T")):
            if (row := find_best(found, split, quantity)) is not None:
                ratio, groups = row.rmse_ratio, f"{row.groups} {row.drawn_by}"
                few = f"{groups} are too few for an interval"
                interval = few if ratio.low is None else f"95 % CI {ratio.low:.2f} to {ratio.high:.2f}, {groups}"
                best = f"RMSE ratio to '{row.baseline}', the best baseline, {ratio.value:.2f}"
                lines.append(f"{split}, {called}: {best} ({interval})")
    return lines


def find_best(found: Sequence[BaselineResult], split: str, quantity: str) -> BaselineResult | None:
    """Return the baseline with the smallest RMSE of a quantity of a split; None if no ratio is known."""
    rows = [row for row in found if (row.split, row.quantity) == (split, quantity) and row.rmse_ratio.value is not None]
    return min(rows, key=lambda row: row.errors.rmse or 0.0, default=None)
