"""What a dataset's samples, splits and ground show: the findings of its card beside those of its runs and maps."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
import pyarrow as pa

from tcpipe.formats.dataset_card import DatasetCard, Doubtful
from tcpipe.recipe.suggestions import suggest
from tcpipe.splits.audit import HeldOut
from tcpipe.tables.bits import Quality, name_of
from tcpipe.tables.catalogue import Severity, threshold
from tcpipe.tables.findings import Finding, Remedy, Subject, make_finding


def count_flagged(quality: pa.ChunkedArray) -> Doubtful:
    """Return how many samples carry a quality bit that not all of them carry, and how many each; ``quality`` is their column."""
    bits = quality.to_numpy().astype(np.int64)
    counts = {name_of(bit): int(np.count_nonzero(bits & int(bit))) for bit in Quality}
    common = int(np.bitwise_and.reduce(bits)) if len(bits) > 1 else 0
    count = int(np.count_nonzero(bits & ~common))
    return Doubtful(count, count / max(len(bits), 1), {name: of for name, of in counts.items() if of})


def find_in_samples(card: DatasetCard) -> Iterator[Finding]:
    """Yield what the samples of a dataset show: too few, flagged ones, empty splits, leakage, thin ground, no repetitions."""
    dataset = Subject("dataset", card.name)
    if card.samples < threshold("few-samples", "min_sample_count"):
        yield make_finding("few-samples", dataset, sample_count=card.samples)
    yield from _find_flagged(card, dataset)
    yield from _find_empty_splits(card)
    yield from (_find_leakage(part, card) for part in card.split.audit if part.overlapping_samples)
    yield from _find_thin_ground(card)
    if not any(card.balance.repeatability.values()):
        yield make_finding("no-repeated-places", dataset)


def _find_flagged(card: DatasetCard, dataset: Subject) -> Iterator[Finding]:
    flagged = card.doubtful
    if flagged is None or not flagged.samples:
        return
    by_bit = {name: count for name, count in flagged.by_bit.items() if count < card.samples} or flagged.by_bit
    most = max(by_bit, key=lambda name: by_bit[name])
    severity: Severity = "warning" if flagged.share > threshold("samples-flagged", "max_flagged_fraction") else "note"
    yield make_finding(
        "samples-flagged", dataset, severity=severity, names={"flag": most}, flagged_fraction=flagged.share
    )


def _find_empty_splits(card: DatasetCard) -> Iterator[Finding]:
    """Yield a finding for each split that was asked for and holds no sample."""
    rules = card.recipe.split
    if not card.splits["train"]:
        yield make_finding(
            "split-empty", Subject("split", "train"), severity="error", names={"reason": "region_too_small"}
        )
    if not card.splits["test"] and rules.test_fraction > 0:
        reasons = {"run": "one_run", "block": "one_block", "tag": "one_value_of_tag"}
        remedies = (
            *(suggest("sample", {"split": {"holdout": "sample"}}) if card.splits["train"] > 1 else ()),
            *suggest("none", {"split": {"test_fraction": 0.0}}),
        )
        names = {"reason": reasons.get(rules.holdout, "too_few_samples")}
        yield make_finding("split-empty", Subject("split", "test"), names=names, remedies=remedies)
    if not card.splits["unseen"] and card.split.region is not None:
        yield make_finding("split-empty", Subject("split", "unseen"), names={"reason": "all_inside_region"})


def _find_leakage(part: HeldOut, card: DatasetCard) -> Finding:
    """Return the finding that samples of a held-out split share ground with train."""
    remedies: tuple[Remedy, ...] = ()
    holdout = card.recipe.split.holdout if part.split == "test" else ""
    if holdout == "sample":
        remedies = suggest("block", {"split": {"holdout": "block"}})
    elif holdout == "block":
        remedies = (
            *suggest("larger_blocks", {"split": {"block_m": 2 * card.recipe.split.block_m}}),
            *suggest("run", {"split": {"holdout": "run"}}),
        )
    return make_finding(
        "split-leakage",
        Subject("split", part.split),
        remedies=remedies,
        overlapping_count=part.overlapping_samples,
        sample_count=part.samples,
    )


def _find_thin_ground(card: DatasetCard) -> Iterator[Finding]:
    """Yield a finding for each class of terrain with ranges of slope that hold few independent samples."""
    is_thin = defaultdict[str, list[bool]](list)
    for cell in card.balance.by_class_and_slope:
        is_thin[cell["class"] or "any ground"].append(cell["rare"])
    for name, thin in is_thin.items():
        if any(thin):
            yield make_finding(
                "thin-ground",
                Subject("class", name),
                thin_count=sum(thin),
                cell_count=len(thin),
                enough_count=card.balance.enough_effective,
            )
