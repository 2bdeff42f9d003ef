"""Baselines of a model, fitted on the same samples: curves, physics, boosted trees, and the networks of Wei and Isler (table IV)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.prediction_errors import Residuals, make_residuals
from tcpipe.dataset import Dataset, Split
from tcpipe.dataset.extra_features import available_features, read_extra_features
from tcpipe.errors import DatasetError, ModelError
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.learning.evaluation_facts import SPLITS, BaselineResult
from tcpipe.learning.fitting import FitConfig, ModelKind
from tcpipe.learning.metrics import (
    ALL,
    FEWEST_GROUPS,
    LEAST,
    Errors,
    Spread,
    compare_errors,
    compute_errors,
    compute_errors_by_class,
)
from tcpipe.learning.models import Model
from tcpipe.learning.physics_model import Form
from tcpipe.learning.predictions import Measured, Predicted, predict_costs, predict_spreads
from tcpipe.learning.predictor import AUTOMATIC, Job, Prediction, Predictor, Samples, find_kind, predict_samples
from tcpipe.learning.training import Variant, make_samples
from tcpipe.tables.findings import Finding, Subject, make_finding

logger = logging.getLogger("tcpipe")

CURVES: Mapping[Form, str] = {
    "mean": "mean per class",
    "linear": "class and slope, linear",
    "spline": "class and slope, spline",
}
PHYSICS, TREES = "physics", "gradient boosting"
SIMPLEST_FIRST = (*CURVES.values(), PHYSICS, TREES)
BASELINE_OF_KIND: Mapping[ModelKind, str] = dict(zip(AUTOMATIC, SIMPLEST_FIRST, strict=True))
"""What a baseline is called that would be the model itself."""

_ALIKE = 1.005
"""Ratio up to which errors are the same: by digits of rounding nobody is better."""


def compare_baselines(
    ours: Model, data: Dataset, sets: Mapping[str, Measured], said: Mapping[str, Predicted], *, seed: int
) -> tuple[list[BaselineResult], list[Finding]]:
    """Return the results of every baseline, and a finding for each that cannot be fitted.

    The baselines are fitted on the training samples of ``data``, centred as the model is, and evaluated on ``sets``, the same samples as
    the predictions ``said`` of the model. ``seed`` is that of the bootstrap.
    """
    own = BASELINE_OF_KIND.get(ours.card.training.kind)
    train = _select_fitted_samples(data["train"], ours)
    if not len(train):
        names = {"error": "the dataset has no labelled samples in split train"}
        return [], [make_finding("baseline-missing", Subject("model", "baselines"), names=names)]
    fitted, lacking = _fit_baselines(train, data, [name for name in SIMPLEST_FIRST if name != own])
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
    for kind, name in ((kind, name) for kind, name in BASELINE_OF_KIND.items() if name in wanted):
        try:
            samples, predictor, said = _fit_baseline(find_kind(kind), train, data)
            columns = {name: train.column(name) for name in ("run_id", "start_ns", "terrain_class", "fold")}
            found[name] = samples, predictor, columns | make_residuals(samples.labels, said.mean, said.covariance)
        except ModelError as error:
            names = {"error": error.problems[0]}
            lacking.append(make_finding("baseline-missing", Subject("model", name), names=names))
    return found, lacking


def _fit_baseline(kind: type[Predictor], train: Split, data: Dataset) -> tuple[Samples, Predictor, Prediction]:
    """Return a fitted kind, and what the other folds say of each sample; NaN where these are too few, which centres nothing."""
    turn = tuple(
        feature.name for feature in available_features(read_extra_features(train)) if feature.name == "turn_radpm"
    )
    if kind.features is None:  # trees take the turn, but not the commanded speed
        kind = type(kind.__name__, (kind,), {"features": turn})
    samples = make_samples(data, FitConfig(), Variant(), kind, train)
    try:
        fitted = kind.fit_folds(samples, Job("", Path()))
    except ModelError:
        return samples, kind.fit(samples), Prediction.without_covariance(np.full(samples.labels.shape, np.nan))
    return samples, fitted.predictor, fitted.held_out


def _group_samples(split: Split, block_m: float) -> tuple[Literal["runs", "blocks"], NDArray[np.generic]]:
    """Return groups of samples with correlated errors: runs where there are enough, else blocks of ground."""
    runs = split.column("run_id").astype(np.str_)
    if len(np.unique(runs)) >= FEWEST_GROUPS:
        return "runs", runs
    if split.has_coordinates:
        lon_deg, lat_deg = (split.column(f"start_{axis}_deg").astype(np.float64) for axis in ("lon", "lat"))
        datum = float(lon_deg[0]), float(lat_deg[0]), 0.0  # one for all: x and y of a sample are in its own run's frame
        xy_m = enu_from_geodetic(lon_deg, lat_deg, 0.0, datum_deg_m=datum)[:, :2]
    else:
        xy_m = np.column_stack([split.column(f"start_{axis}_m").astype(np.float64) for axis in "xy"])
    return "blocks", np.unique(np.floor(xy_m / block_m), axis=0, return_inverse=True)[1].reshape(-1)


def compare_with_baseline(
    name: str, split: str, part: Measured, ours: Predicted, theirs: Predicted, *, block_m: float, seed: int
) -> Iterator[BaselineResult]:
    """Yield the results of a baseline for every quantity that it predicts.

    ``ours`` and ``theirs`` are predictions for the samples of ``part``; the bootstrap with ``seed`` draws runs, or blocks of ``block_m``.
    """
    drawn_by, groups = _group_samples(part.split, block_m)
    for quantity, measured in part.costs.items():
        if quantity not in theirs.costs:
            continue
        ratios = [
            compare_errors((mine[quantity] - measured) ** 2, (other[quantity] - measured) ** 2, groups, seed=seed)
            for mine, other in ((ours.costs, theirs.costs), (ours.uncentred, theirs.uncentred))
        ]
        yield BaselineResult(
            baseline=name, split=split, quantity=quantity,
            errors=compute_errors(theirs.costs[quantity], measured, LEAST[quantity]), rmse_ratio=ratios[0],
            uncentred=compute_errors(theirs.uncentred[quantity], measured, LEAST[quantity]), uncentred_rmse_ratio=ratios[1],
            groups=len(np.unique(groups)), drawn_by=drawn_by,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class ModelRank:
    """How a model compares with the baselines, of which ``best`` has the smallest RMSE."""

    best: BaselineResult
    beats_all: bool
    beats_curves: bool | None
    """Whether it is significantly better than every curve over class and slope; None of too few groups."""
    is_worse: bool


def describe_ratios(found: Sequence[BaselineResult]) -> list[str]:
    """Return the ratio of RMSE to that of the best baseline, for energy and time of each split."""
    lines = []
    for split in SPLITS:
        for quantity, called in (("E", "energy E"), ("T", "time T")):
            if (rank := rank_model(found, split, quantity)) is not None:
                ratio, groups = rank.best.rmse_ratio, f"{rank.best.groups} {rank.best.drawn_by}"
                few = f"{groups} are too few for an interval"
                interval = few if ratio.low is None else f"95 % CI {ratio.low:.2f} to {ratio.high:.2f}, {groups}"
                best = f"RMSE ratio to '{rank.best.baseline}', the best baseline, {ratio.value:.2f}"
                lines.append(f"{split}, {called}: {best} ({interval})")
    return lines


def rank_model(found: Sequence[BaselineResult], split: str, quantity: str) -> ModelRank | None:
    """Return how the model compares in a quantity of a split; None where no ratio is known."""
    rows = [row for row in found if (row.split, row.quantity) == (split, quantity) and row.rmse_ratio.value is not None]
    if not rows:
        return None
    best = min(rows, key=lambda row: row.errors.rmse or 0.0)
    ratio = best.rmse_ratio
    worse = ratio.low is not None and ratio.low > 1.0 and (ratio.value or 0.0) > _ALIKE
    curves = [row for row in rows if row.baseline in CURVES.values()]
    beats = None if ratio.high is None else all(map(_is_better, curves))
    return ModelRank(best, _is_better(best), beats, worse)


def _is_better(row: BaselineResult) -> bool:
    return row.rmse_ratio.high is not None and row.rmse_ratio.high < 1.0


OURS, GRASS_ONLY, PER_CLASS = "ours", "Wei & Isler, grass only", "Wei & Isler, a net per class"
ALL_LAYERS_PER_CLASS = "a net per class, all layers"

FEWEST = 20
"""Samples of a class in train that a network of its own needs."""

Trained = Callable[[str, Variant], Model]


def make_energy_table(
    ours: Model,
    data: Dataset,
    sets: Mapping[str, Measured],
    said: Mapping[str, Predicted],
    trained: Trained | None,
    *,
    seed: int,
) -> tuple[dict[str, dict[str, Errors]], list[BaselineResult]]:
    """Return errors of E by predictor and split, and the results of the networks beside it (table IV).

    They are of the samples whose class has a network of its own; of all samples where ``trained`` is None. Nothing without energy.
    """
    if ours.card.inputs.is_time_alone:
        return {}, []
    networks: dict[str, dict[int, Model]] = {}
    if trained is not None:
        networks[ALL_LAYERS_PER_CLASS] = _train_by_class(ours, trained, "class", Variant())
        if "height" in data.card.layers:
            of_height = Variant(channels=("height",), energy_only=True)
            per_class = _train_by_class(ours, trained, "wei_isler_class", of_height)
            grass = {entry.id for entry in ours.card.class_table.classes if entry.name == "grass"}
            networks[PER_CLASS] = per_class
            networks[GRASS_ONLY] = {class_id: network for class_id, network in per_class.items() if class_id in grass}
    own = [set(by_class) for name, by_class in networks.items() if name != GRASS_ONLY]
    known = set.intersection(*own) if own else set()
    errors, results = dict[str, dict[str, Errors]](), list[BaselineResult]()
    for split, part in sets.items():
        rows = np.flatnonzero(np.isin(part.class_ids, list(known)) | (not known))
        same, mine = part.take(rows), said[split].take(rows)
        errors.setdefault(OURS, {})[split] = _compute_error(mine, same, predict_spreads(ours, mine, same.class_ids))
        for name, by_class in networks.items():
            if not by_class or not known or not len(rows):
                continue
            theirs = _predict_by_class(by_class, same, of_all=name == GRASS_ONLY)
            errors.setdefault(name, {})[split] = _compute_error(theirs, same)
            block_m = data.card.recipe.split.block_m
            results += compare_with_baseline(name, split, same, mine, theirs, block_m=block_m, seed=seed)
    return errors, results


def _train_by_class(ours: Model, trained: Trained, name: str, variant: Variant) -> dict[int, Model]:
    """Return a network for every class with enough samples, by class id."""
    found = {}
    for class_id in (class_id for class_id, count in ours.card.training_range.class_counts.items() if count >= FEWEST):
        try:
            found[class_id] = trained(f"{name}_{class_id}", replace(variant, classes=(class_id,)))
        except DatasetError as error:
            logger.info("no network for class %d alone: %s", class_id, error.problems[0])
    return found


def _predict_by_class(networks: Mapping[int, Model], found: Measured, *, of_all: bool) -> Predicted:
    """Return E of each sample by the network of its class, or of all samples by the only network."""
    costs, uncentred = np.empty(len(found.split)), np.empty(len(found.split))
    for class_id, network in networks.items():
        here = np.flatnonzero((found.class_ids == class_id) | of_all)
        if len(here):
            said = predict_costs(network, found.split.take(here))
            costs[here], uncentred[here] = said.costs["E"], said.uncentred["E"]
    return Predicted({"E": costs}, {"E": uncentred}, {"E": np.zeros(len(costs))})


def _compute_error(said: Predicted, found: Measured, spreads: Mapping[str, Spread] | None = None) -> Errors:
    energy = {"E": said.costs["E"]}
    return compute_errors_by_class(energy, found.costs, found.class_ids, found.names, spreads)["E"][ALL]
