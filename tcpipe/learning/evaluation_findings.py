"""Findings on a model from the figures of its evaluation."""

from __future__ import annotations

from collections.abc import Iterator

from tcpipe.learning.baselines import CURVES, PHYSICS, TREES, rank_model
from tcpipe.learning.evaluation_facts import Evaluation, SplitErrors
from tcpipe.learning.metrics import ALL
from tcpipe.tables.catalogue import read_threshold
from tcpipe.tables.findings import Finding, Remedy, Subject, make_finding

_QUANTITIES = {"energy": "E", "time": "T"}


def find_weaknesses(found: Evaluation) -> Iterator[Finding]:
    """Yield what the errors of each split show, and that there is no unseen split."""
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
        error = (part.errors[quantity][ALL].mape_percent or 0.0) / 100.0
        if error >= read_threshold(f"{name}-far-off", "max_error_fraction"):
            yield make_finding(f"{name}-far-off", subject, error_fraction=error)
    overall = (part.errors["E"][ALL].mape_percent or 0.0) / 100.0
    for class_name, of in part.errors["E"].items():
        error, names = (of.mape_percent or 0.0) / 100.0, {"split": subject.name}
        is_counted = class_name != ALL and of.mape_count >= read_threshold("class-far-off", "min_sample_count")
        if is_counted and error > read_threshold("class-far-off", "min_error_ratio") * overall > 0.0:
            of_class = Subject("class", class_name)
            yield make_finding("class-far-off", of_class, names=names, error_fraction=error, overall_fraction=overall)


def _find_baselines(found: Evaluation, subject: Subject) -> Iterator[Finding]:
    """Yield that the model does not beat curves over class and slope, and of energy that it does not beat the best baseline."""
    for name, quantity in _QUANTITIES.items():
        of = rank_model(found.baselines, subject.name, quantity)
        if of is None:
            continue
        if of.beats_curves is False:
            yield make_finding(f"{name}-no-better-than-curves", subject)
        if quantity == "E" and not of.beats_all:
            best, ratio = of.best.baseline, of.best.rmse_ratio.value or 0.0
            kind = {TREES: "table", PHYSICS: "physics", **dict.fromkeys(CURVES.values(), "table")}[best]
            is_other = of.is_worse and kind != found.model.training.config.model
            remedies = [Remedy("train", command=f"tcpipe train DATASET --model {kind}")] if is_other else []
            names = {"baseline": best}
            yield make_finding("baseline-not-beaten", subject, names=names, remedies=remedies, rmse_fraction=ratio)


def _find_coverage(part: SplitErrors, subject: Subject) -> Iterator[Finding]:
    percent = part.errors["E"][ALL].coverage_percent
    if percent is None:
        yield make_finding("no-intervals", subject)
    elif percent / 100.0 < read_threshold("energy-overconfident", "min_coverage_fraction"):
        yield make_finding("energy-overconfident", subject, coverage_fraction=percent / 100.0)
    elif percent / 100.0 > read_threshold("underconfident", "max_coverage_fraction"):
        yield make_finding("underconfident", subject, coverage_fraction=percent / 100.0)
