"""Baselines of a model, fitted on the same samples: curves, physics, boosted trees, and the networks of Wei and Isler (table IV)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset import Dataset, Split
from tcpipe.dataset.extra_features import read_extra_features
from tcpipe.errors import DatasetError, ModelError
from tcpipe.geometry.datum import enu_from_geodetic
from tcpipe.learning.evaluation_facts import SPLITS, BaselineResult
from tcpipe.learning.metrics import (
    ALL,
    LEAST,
    LEAST_VELOCITY_MPS,
    Array,
    Costs,
    Errors,
    Spread,
    compare_errors,
    compute_costs,
    compute_errors,
    compute_errors_by_class,
)
from tcpipe.learning.models import Model
from tcpipe.learning.physics_model import Curves, Form, find_idle_power, fit_curves, fit_physics_model
from tcpipe.learning.predictions import Measured, predict_costs, predict_spreads
from tcpipe.learning.predictor import find_kind
from tcpipe.learning.training import Variant
from tcpipe.tables.findings import Finding, Subject, make_finding

logger = logging.getLogger("tcpipe")

CURVES: Mapping[Form, str] = {
    "mean": "mean per class",
    "linear": "class and slope, linear",
    "spline": "class and slope, spline",
}
PHYSICS, TREES = "physics", "gradient boosting"
SIMPLEST_FIRST = (*CURVES.values(), PHYSICS, TREES)
BASELINE_OF_KIND = {"boosting": TREES, "physics": PHYSICS}
"""What a baseline is called that would be the model itself."""

_FEWEST_RUNS = 10
"""Runs of a split that are drawn as wholes; of fewer, blocks of ground are."""

_ALIKE = 1.005
"""Ratio up to which errors are the same: by digits of rounding nobody is better."""

Predictor = Callable[[Split], Array]
"""Power [W] and velocity [m/s] of the samples of a split, shape (N, 2)."""


def compare_baselines(
    ours: Model, data: Dataset, sets: Mapping[str, Measured], said: Mapping[str, Costs], *, seed: int
) -> tuple[list[BaselineResult], list[Finding]]:
    """Return the results of every baseline, and a finding for each that cannot be fitted.

    The baselines are fitted on the training samples of ``data`` and evaluated on ``sets``, the same samples as the predictions ``said`` of
    the model. ``seed`` is that of the bootstrap.
    """
    own = BASELINE_OF_KIND.get(ours.card.training.config.model)
    train = _select_fitted_samples(data["train"], ours)
    if not len(train):
        names = {"error": "the dataset has no labelled samples in split train"}
        return [], [make_finding("baseline-missing", Subject("model", "baselines"), names=names)]
    predictors, lacking = _fit_baselines(train, ours, [name for name in SIMPLEST_FIRST if name != own])
    logger.info("baselines: %s, fitted on %d samples", ", ".join(predictors), len(train))
    found: list[BaselineResult] = []
    for split, part in sets.items():
        for name, predict in predictors.items():
            power, velocity = predict(part.split).T
            theirs = compute_costs(power, np.maximum(velocity, LEAST_VELOCITY_MPS), ours.chord_m)
            found += compare_with_baseline(
                name, split, part, said[split], theirs, block_m=data.card.recipe.split.block_m, seed=seed
            )
    return found, lacking


def _select_fitted_samples(train: Split, ours: Model) -> Split:
    """Return the samples that a model of this kind is fitted on: for a network without the fold that stops it."""
    labelled = train.take(np.isfinite(train.labels).all(axis=1))
    if not find_kind(ours.card.training.config.model).stops_by_fold:
        return labelled
    fitted, _ = labelled.fold(ours.card.training.config.fold)
    return fitted if len(fitted) else labelled


def _fit_baselines(train: Split, ours: Model, wanted: Sequence[str]) -> tuple[dict[str, Predictor], list[Finding]]:
    """Return the baselines by name, and a finding for each that cannot be fitted."""
    found, lacking = dict(_fit_curves(train)), list[Finding]()
    for name, fit in ((PHYSICS, _fit_physics), (TREES, _fit_trees)):
        if name in wanted:
            try:
                found[name] = fit(train, ours)
            except ModelError as error:
                names = {"error": error.problems[0]}
                lacking.append(make_finding("baseline-missing", Subject("model", name), names=names))
    return found, lacking


def _fit_curves(train: Split) -> Iterator[tuple[str, Predictor]]:
    labels, extra_features = train.labels.astype(np.float64), read_extra_features(train)
    for form, name in CURVES.items():
        curves = fit_curves(form, extra_features.slope_rad, extra_features.class_id, labels)

        def predict(split: Split, curves: Curves = curves) -> Array:
            there = read_extra_features(split)
            return curves.predict(there.slope_rad, there.class_id)

        yield name, predict


def _fit_physics(train: Split, ours: Model) -> Predictor:
    del ours
    fitted = fit_physics_model(
        read_extra_features(train), train.labels.astype(np.float64), idle_watt=find_idle_power(train)
    )
    return lambda split: fitted.predict(np.empty(0, np.float32), read_extra_features(split))


def _fit_trees(train: Split, ours: Model) -> Predictor:
    """Return trees over features of all layers, and of the turn."""
    from tcpipe.learning.table_model import compute_features, fit_table  # noqa: PLC0415  numba loads with it

    folds, labels = train.column("fold"), train.labels.astype(np.float64)
    if len(np.unique(folds)) < 2:
        raise ModelError(
            f"{len(train)} training samples are in one fold, expected two or more, to choose the number of trees"
        )

    def features(split: Split) -> Array:
        return np.column_stack(
            [
                compute_features(split, ours.patch_m, ours.classes.count),
                np.nan_to_num(read_extra_features(split).turn_radpm),
            ]
        )

    model, _ = fit_table(
        features(train), labels, np.ones_like(labels), folds, channels=train.channels, class_count=ours.classes.count
    )
    return lambda split: model.predict(features(split))


def _group_samples(split: Split, block_m: float) -> tuple[Literal["runs", "blocks"], NDArray[np.generic]]:
    """Return groups of samples with correlated errors: runs where there are enough, else blocks of ground."""
    runs = split.column("run_id").astype(np.str_)
    if len(np.unique(runs)) >= _FEWEST_RUNS:
        return "runs", runs
    lon_deg, lat_deg = (split.column(f"start_{axis}_deg").astype(np.float64) for axis in ("lon", "lat"))
    datum = float(lon_deg[0]), float(lat_deg[0]), 0.0  # one for all: x and y of a sample are in its own run's frame
    places = np.floor(enu_from_geodetic(lon_deg, lat_deg, 0.0, datum_deg_m=datum)[:, :2] / block_m)
    return "blocks", np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)


def compare_with_baseline(
    name: str, split: str, part: Measured, ours: Costs, theirs: Costs, *, block_m: float, seed: int
) -> Iterator[BaselineResult]:
    """Yield the results of a baseline for every quantity that it predicts.

    ``ours`` and ``theirs`` are predictions for the samples of ``part``; the bootstrap with ``seed`` draws runs, or blocks of ``block_m``.
    """
    drawn_by, groups = _group_samples(part.split, block_m)
    for quantity in theirs:
        measured = part.costs[quantity]
        large = measured >= LEAST[quantity]
        off, other = (np.abs(costs_of[quantity] - measured) for costs_of in (ours, theirs))
        over = np.where(large, measured, 1.0)
        yield BaselineResult(
            baseline=name, split=split, quantity=quantity,
            errors=compute_errors(theirs[quantity], measured, LEAST[quantity]),
            rmse_ratio=compare_errors(off**2, other**2, groups, power=0.5, seed=seed),
            mape_ratio=compare_errors(off[large] / over[large], other[large] / over[large], groups[large], power=1.0, seed=seed),
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
            if (of := rank_model(found, split, quantity)) is not None:
                ratio, groups = of.best.rmse_ratio, f"{of.best.groups} {of.best.drawn_by}"
                few = f"{groups} are too few for an interval"
                interval = few if ratio.low is None else f"95 % CI {ratio.low:.2f} to {ratio.high:.2f}, {groups}"
                best = f"RMSE ratio to '{of.best.baseline}', the best baseline, {ratio.value:.2f}"
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

FEWEST = 20
"""Samples of a class in train that a network of its own needs."""

Trained = Callable[[str, Variant], Model]


def make_energy_table(
    ours: Model,
    data: Dataset,
    sets: Mapping[str, Measured],
    said: Mapping[str, Mapping[str, Array]],
    trained: Trained | None,
    *,
    seed: int,
) -> tuple[dict[str, dict[str, Errors]], list[BaselineResult]]:
    """Return errors of E by predictor and split, and the baselines' results (table IV).

    They are of the samples whose class has a network of its own; of all samples where ``trained`` is None.
    """
    networks = {} if trained is None or "height" not in data.card.layers else _fit_networks(ours, trained)
    grass = next((entry.id for entry in ours.classes.classes if entry.name == "grass" and entry.id in networks), None)
    errors, results = dict[str, dict[str, Errors]](), list[BaselineResult]()
    for split, part in sets.items():
        rows = np.flatnonzero(np.isin(part.class_ids, list(networks)) | (not networks))
        same, mine = part.take(rows), {"E": said[split]["E"][rows]}
        errors.setdefault(OURS, {})[split] = _compute_error(mine, same, predict_spreads(ours, mine, same.class_ids))
        if not networks or not len(rows):
            continue
        theirs = {PER_CLASS: _predict_by_class_network(networks, same)}
        if grass is not None:
            theirs[GRASS_ONLY] = predict_costs(networks[grass], same.split)["E"]
        for name, energy in theirs.items():
            errors.setdefault(name, {})[split] = _compute_error({"E": energy}, same)
            block_m = data.card.recipe.split.block_m
            results += compare_with_baseline(name, split, same, mine, {"E": energy}, block_m=block_m, seed=seed)
    return errors, results


def _fit_networks(ours: Model, trained: Trained) -> dict[int, Model]:
    """Return a network for every class with enough samples, by class id."""
    found = {}
    for class_id in (class_id for class_id, count in ours.card.training_range.class_counts.items() if count >= FEWEST):
        try:
            variant = Variant(channels=("height",), classes=(class_id,), energy_only=True)
            found[class_id] = trained(f"wei_isler_class_{class_id}", variant)
        except DatasetError as error:
            logger.info("no network for class %d alone: %s", class_id, error.problems[0])
    return found


def _predict_by_class_network(networks: Mapping[int, Model], found: Measured) -> Array:
    energy = np.empty(len(found.split))
    for class_id, network in networks.items():
        here = np.flatnonzero(found.class_ids == class_id)
        if len(here):
            energy[here] = predict_costs(network, found.split.take(here))["E"]
    return energy


def _compute_error(energy: Mapping[str, Array], found: Measured, spreads: Mapping[str, Spread] | None = None) -> Errors:
    return compute_errors_by_class(energy, found.costs, found.class_ids, found.names, spreads)["E"][ALL]
