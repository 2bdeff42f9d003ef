"""Evaluation as in the paper's section V for any model and dataset: tables I to III and V, with the noise floor."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, TypeAlias

import numpy as np
import pyarrow as pa

from tcpipe import __version__
from tcpipe.cost.coverage import Coverage, find_miscalibration, measure_coverage
from tcpipe.dataset import Dataset, Split, open_dataset
from tcpipe.dataset.energies import EnergyName
from tcpipe.errors import DatasetError
from tcpipe.formats.atomic import Location
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.learning.baselines import KIND_OF_BASELINE, SPLITS, BaselineResult, compare_baselines, find_best
from tcpipe.learning.fitting import Seed
from tcpipe.learning.metrics import (
    ALL,
    LEAST,
    Errors,
    Spread,
    average_draws,
    compute_errors,
    compute_errors_by_class,
    compute_label_floor,
    compute_path_error,
)
from tcpipe.learning.model_card import Training
from tcpipe.learning.models import Model, load_model
from tcpipe.learning.predictions import (
    Measured,
    Predicted,
    check_fit,
    collect_measured,
    make_predictions_table,
    predict_costs,
    predict_spreads,
)
from tcpipe.learning.training import compute_dataset_checksum
from tcpipe.progress import logger
from tcpipe.robots import Robot
from tcpipe.splits.audit import CLOSE, LOCAL_PLACES, PLACES, are_near, compute_middles
from tcpipe.tables.bounds import Bounds
from tcpipe.tables.findings import (
    PREDICTED,
    Affected,
    Finding,
    Findings,
    Remedy,
    Severity,
    Subject,
    Verdict,
    judge,
    make_finding,
    omit,
    read_threshold,
)
from tcpipe.terrain.layers import NODATA_ID

KIND = "tcpipe evaluation"

ErrorsByClass: TypeAlias = Mapping[str, Mapping[str, Errors]]
"""By quantity, then by the name of a class, or `tcpipe.learning.metrics.ALL`."""


@dataclass(frozen=True, slots=True)
class EvaluateConfig:
    """Size of an evaluation."""

    noise_draws: Annotated[int, Bounds(ge=1, le=1000)] = 5
    """Draws of noise that each ablated input set is the mean of."""
    seed: Seed = 0
    """Seed of the noise."""


@dataclass(frozen=True, slots=True)
class EvaluatedModel:
    """The evaluated model."""

    name: str
    checksum: str
    training: Training
    label_energy: EnergyName = "total"
    """Kind of power and energy that it predicts."""


@dataclass(frozen=True, slots=True)
class EvaluatedDataset:
    """The dataset of an evaluation."""

    name: str
    sha256: str
    """Over the checksums of its files."""
    samples: Mapping[str, int]
    """By split."""


@dataclass(frozen=True, slots=True)
class Leakage:
    """Nearness of a split to the training samples of the dataset."""

    holdout: str
    """Holdout of the test split: sample, as in the paper, block, run or tag."""
    within_m: float
    near_percent: float
    """Share of samples whose middle is within ``within_m`` of that of a training sample [%]."""
    sharing_percent: float | None
    """Share of samples whose footprint overlaps that of a training sample, by the dataset's audit [%]."""

    def __str__(self) -> str:
        """Return the distance of a split from training samples, as text."""
        sharing = "" if self.sharing_percent is None else f"; {self.sharing_percent:.0f} % share ground with one"
        return (
            f"Audit (test held out by {self.holdout}): the middles of {self.near_percent:.0f} % of these samples are "
            "within "
            f"{self.within_m:.2f} m of a training sample's{sharing}."
        )


@dataclass(frozen=True, slots=True)
class SplitErrors:
    """Tables I and II of one split, and the noise floor of its labels."""

    samples: int
    classes: Mapping[str, int]
    """Samples by the name of their class."""
    class_order: tuple[str, ...]
    errors: ErrorsByClass
    coverage: Mapping[str, Coverage]
    """By quantity, of all classes; empty where the model states no intervals."""
    path_error_percent: Mapping[str, float]
    """Error of the sums of `PATH_M` m of a run, by quantity (T, E)."""
    label_floor: ErrorsByClass
    leakage: Leakage | None = omit()
    """Nearness to training; None without training samples or places."""


@dataclass(frozen=True, slots=True)
class AblationRow:
    """A row of table III: the layers that are not replaced by noise, and the errors by split and quantity."""

    layers: tuple[str, ...]
    errors: Mapping[str, Mapping[str, Errors]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """All of evaluation.json."""

    kind: str = KIND
    schema_version: int = 5
    tcpipe_version: str
    key: str
    """Hash of model, dataset and options: the same key, the same evaluation."""
    model: EvaluatedModel
    dataset: EvaluatedDataset
    config: EvaluateConfig
    splits: Mapping[str, SplitErrors]
    ablation: tuple[AblationRow, ...]
    time: Mapping[str, Mapping[str, Errors]]
    """Table V: errors of T by predictor and split."""
    baselines: tuple[BaselineResult, ...] = ()
    """Comparisons with baselines over all classes, by split, baseline and quantity."""
    findings: Findings = ()
    verdict: Verdict = field(default_factory=Verdict)

    @property
    def costs(self) -> tuple[Literal["E", "T"], ...]:
        """Return which of energy and time were evaluated."""
        known = {quantity for part in self.splits.values() for quantity in part.errors}
        both: tuple[Literal["E", "T"], ...] = ("E", "T")
        return tuple(quantity for quantity in both if quantity in known)

    @property
    def judged(self) -> tuple[Affected, ...]:
        """Return the labels of the verdict."""
        return PREDICTED if "E" in self.costs else ("time",)

    @property
    def ordered_splits(self) -> list[str]:
        """Return the splits that were evaluated, in the paper's order."""
        return [split for split in SPLITS if split in self.splits]


INPUT_SETS = (("O", "C", "H"), ("C", "H"), ("O", "H"), ("O", "C"), ("O",), ("C",), ("H",))
"""Layers that are not replaced, in the order of table III."""

LETTERS = {"O": "ortho", "C": "terrain", "H": "height"}

OURS, EXPECTED = "ours", "expected time"
UNKNOWN_DISTANCE = "Its distance from training is unknown."

Sets = dict[str, Measured]
Said = Mapping[str, Predicted]
"""Predictions of each split."""


def evaluate(
    model: Location, dataset: Location, config: EvaluateConfig, *, key: str, predictor: str | None = None
) -> tuple[Evaluation, pa.Table]:
    """Measure a model on a dataset; return the evaluation, with the hash ``key``, and the table of all predictions."""
    evaluated = load_model(model, predictor)
    data = open_dataset(dataset, label=evaluated.card.label_energy)
    check_fit(evaluated.card, data, str(model))
    names = {entry.id: entry.name for entry in evaluated.card.class_table.classes}
    sets = {name: found for name in SPLITS if len((found := collect_measured(data[name], names)).split)}
    if not sets:
        raise DatasetError(
            f"{data.path}: no labelled samples in test nor unseen: nothing to evaluate on; build it with a --split"
        )
    predictions = {name: predict_costs(evaluated, found.split) for name, found in sets.items()}
    spreads = {name: predict_spreads(evaluated, predictions[name], found) for name, found in sets.items()}
    for name, found in sets.items():
        logger.info("%s: %d samples of %s", name, len(found.split), ", ".join(found.names.values()))

    baselines, lacking = compare_baselines(evaluated, data, sets, predictions, seed=config.seed)
    known = {**load_shipped_profiles().robots, **data.card.recipe.robots}
    evaluation = Evaluation(
        tcpipe_version=__version__,
        key=key,
        model=EvaluatedModel(evaluated.name, evaluated.checksum, evaluated.card.training, evaluated.card.label_energy),
        dataset=EvaluatedDataset(data.card.name, compute_dataset_checksum(data.card), data.card.splits),
        config=config,
        splits={name: _measure_split(data, part, predictions[name], spreads[name]) for name, part in sets.items()},
        ablation=tuple(_iterate_ablation(evaluated, sets, config)),
        time=_compare_times(
            evaluated, sets, predictions, max_velocity_mps=known.get(evaluated.card.robot, Robot()).max_velocity_mps
        ),
        baselines=tuple(baselines),
    )
    findings = (*lacking, *_find_mismatches(evaluated, data, sets), *find_weaknesses(evaluation))
    evaluation = replace(evaluation, findings=findings, verdict=judge(findings))
    return evaluation, make_predictions_table(
        sets, {name: predicted.costs for name, predicted in predictions.items()}, spreads
    )


def _measure_split(data: Dataset, found: Measured, predicted: Predicted, spreads: Mapping[str, Spread]) -> SplitErrors:
    runs, start_ns = found.split.column("run_id"), found.split.column("start_ns")
    counts = {name: int((found.class_ids == class_id).sum()) for class_id, name in found.names.items()}
    return SplitErrors(
        samples=len(found.split),
        classes=counts,
        class_order=tuple(counts),
        errors=compute_errors_by_class(predicted.costs, found.costs, found.class_ids, found.names, spreads),
        coverage={
            quantity: measure_coverage(
                (spread.low <= found.costs[quantity]) & (found.costs[quantity] <= spread.high), runs
            )
            for quantity, spread in spreads.items()
        },
        path_error_percent={
            quantity: compute_path_error(predicted.costs[quantity], found.costs[quantity], runs, start_ns)
            for quantity in "TE"
            if quantity in predicted.costs
        },
        leakage=measure_leakage(data, found.split),
        label_floor=compute_label_floor(found.own_deviations, found.costs, found.class_ids, found.names),
    )


def _iterate_ablation(ours: Model, sets: Sets, config: EvaluateConfig) -> Iterator[AblationRow]:
    """Yield table III, row by row: the model with layers replaced by noise."""
    has = {letter for letter, layer in LETTERS.items() if layer in ours.card.inputs.channels}
    known = dict.fromkeys(tuple(letter for letter in letters if letter in has) for letters in INPUT_SETS)
    for number, letters in enumerate(filter(None, known)):
        left = tuple(LETTERS[letter] for letter in letters)
        noise = [channel for channel in ours.card.inputs.channels if channel not in left]
        logger.info("ablation: {%s}", ",".join(letters))
        by_split = {}
        for at, (name, found) in enumerate(sets.items()):
            draws = [
                _compute_errors(
                    predict_costs(ours, found.split, noise=noise, seed=(config.seed, number, at, draw)), found, ours
                )
                for draw in range(config.noise_draws if noise else 1)
            ]
            by_split[name] = {quantity: average_draws(draw[quantity] for draw in draws) for quantity in draws[0]}
        yield AblationRow(letters, by_split)


def _compute_errors(predicted: Predicted, found: Measured, by: Model) -> dict[str, Errors]:
    """Return the errors of all classes, with the scores of the stated errors."""
    spreads = predict_spreads(by, predicted, found)
    by_class = compute_errors_by_class(predicted.costs, found.costs, found.class_ids, found.names, spreads)
    return {quantity: by_class[quantity][ALL] for quantity in by_class}


def _compare_times(
    ours: Model, sets: Sets, said: Said, *, max_velocity_mps: float | None
) -> dict[str, dict[str, Errors]]:
    """Return table V: T by this model, and T_e = d / v_e at the robot's maximum speed."""
    found = {OURS: {name: _compute_errors(said[name], part, ours)["T"] for name, part in sets.items()}}
    if max_velocity_mps is not None:
        found[EXPECTED] = {
            name: compute_errors(
                np.full(len(part.split), ours.card.chord_m / max_velocity_mps), part.costs["T"], LEAST["T"]
            )
            for name, part in sets.items()
        }
    return found


def _find_mismatches(ours: Model, data: Dataset, sets: Sets) -> Iterator[Finding]:
    """Yield mismatches of model and dataset, and the samples without a label."""
    if compute_dataset_checksum(data.card) != ours.card.dataset.sha256:
        names = {"dataset": ours.card.dataset.name}
        yield make_finding("model-of-another-dataset", Subject("model", ours.name), names=names)
    for name, found in sets.items():
        subject, total = Subject("split", name), len(data[name])
        for class_id, called in found.names.items():
            if class_id not in {NODATA_ID, *ours.card.training_range.class_counts}:
                count = int((found.class_ids == class_id).sum())
                unseen = Subject("class", called)
                yield make_finding("class-not-in-training", unseen, names={"split": name}, sample_count=count)
        if unlabelled := total - len(found.split):
            yield make_finding("samples-without-label", subject, unlabelled_count=unlabelled, sample_count=total)


def measure_leakage(data: Dataset, held: Split) -> Leakage | None:
    """Return distances of the samples of a split from training samples; None if either has no positions."""
    names = PLACES if held.has_coordinates else LOCAL_PLACES
    held_middles, train_middles = (
        compute_middles([part.column(name) for name in names]) for part in (held, data["train"])
    )
    within_m = CLOSE * data.card.recipe.segment.chord_m
    near = are_near(held_middles, train_middles, within_m=within_m, in_degrees=held.has_coordinates)
    if not len(near) or not len(train_middles):
        return None
    audit = next((part for part in data.card.split.audit if part.split == held.name and part.samples), None)
    sharing = None if audit is None else 100.0 * audit.overlapping_samples / audit.samples
    return Leakage(data.card.recipe.split.holdout, within_m, 100.0 * float(near.mean()), sharing)


_QUANTITIES = {"energy": "E", "time": "T"}


def find_large_error(error: float, name: str, subject: Subject) -> Iterator[Finding]:
    """Yield that the error of a sum of ``time`` or ``energy`` needs care, or makes it unusable."""
    code = f"{name}-far-off"
    if error >= read_threshold(code, "max_usable_fraction"):
        severity: Severity = "error" if error >= read_threshold(code, "max_error_fraction") else "warning"
        yield make_finding(code, subject, severity=severity, error_fraction=error)


def find_weaknesses(found: Evaluation) -> Iterator[Finding]:
    """Yield the findings on the errors of each split, and on a missing unseen split."""
    for split in found.ordered_splits:
        part, subject = found.splits[split], Subject("split", split)
        yield from _find_large_errors(part, subject)
        yield from _find_baselines(found, subject)
        yield from _find_coverage(part, subject)
        if part.samples < read_threshold("few-samples", "min_sample_count"):
            yield make_finding("few-samples", subject, sample_count=part.samples)
        near = 0.0 if part.leakage is None else part.leakage.near_percent / 100.0
        if split == "test" and near >= read_threshold("split-leakage", "max_near_fraction"):
            count = round(near * part.samples)
            yield make_finding("split-leakage", subject, overlapping_count=count, sample_count=part.samples)
    if "unseen" not in found.splits:
        yield make_finding("split-empty", Subject("split", "unseen"), severity="note", names={"reason": "no_region"})


def _find_large_errors(part: SplitErrors, subject: Subject) -> Iterator[Finding]:
    for name, quantity in _QUANTITIES.items():
        yield from find_large_error(part.path_error_percent.get(quantity, 0.0) / 100.0, name, subject)
    energy = part.errors.get("E")
    if energy is None:
        return
    overall = (energy[ALL].mape_percent or 0.0) / 100.0
    for class_name, scores in energy.items():
        error, names = (scores.mape_percent or 0.0) / 100.0, {"split": subject.name}
        is_counted = class_name != ALL and scores.mape_count >= read_threshold("class-far-off", "min_sample_count")
        if is_counted and error > read_threshold("class-far-off", "min_error_ratio") * overall > 0.0:
            of_class = Subject("class", class_name)
            yield make_finding("class-far-off", of_class, names=names, error_fraction=error, overall_fraction=overall)


def _find_baselines(found: Evaluation, subject: Subject) -> Iterator[Finding]:
    """Yield that the model does not beat the best baseline in energy."""
    best = find_best(found.baselines, subject.name, "E")
    if best is None or best.is_beaten:
        return
    names, kind = {"baseline": best.baseline}, KIND_OF_BASELINE.get(best.baseline)
    is_other = best.is_better and kind not in {None, found.model.training.kind}
    remedies = [Remedy("train", command=f"tcpipe train DATASET --model {kind}")] if is_other else []
    ratio = best.rmse_ratio.value or 0.0
    yield make_finding("baseline-not-beaten", subject, names=names, remedies=remedies, rmse_fraction=ratio)


def _find_coverage(part: SplitErrors, subject: Subject) -> Iterator[Finding]:
    if not part.coverage:
        yield make_finding("no-intervals", subject)
        return
    for name, quantity in _QUANTITIES.items():
        if quantity in part.coverage:
            yield from find_miscalibration(part.coverage[quantity], name, subject)
