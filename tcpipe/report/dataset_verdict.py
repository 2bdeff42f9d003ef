"""What a dataset's page says first, in plain words: what is good, thin and doubtful, and what to do."""

from __future__ import annotations

from collections.abc import Iterator

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.recipe.suggestions import recipe_key
from tcpipe.report.page import Verdict

_FEW_SAMPLES = 100
_MANY_DOUBTFUL = 0.1
_NOISY = 0.05


def verdict(card: DatasetCard, lost: list[str]) -> list[Verdict]:
    """Return the sentences; ``lost`` is what of the dataset the page could not read."""
    if not card.samples:
        return [Verdict("doubtful", "No sample: every metre was lost on the way; the waterfall below says to what.")]
    return [*_good(card), *_thin(card), *_doubtful(card, lost), *_to_do(card)]


def _size(card: DatasetCard) -> str:
    classes = sum(
        any(part.get(name) for part in card.terrain.values()) for name in {n for p in card.terrain.values() for n in p}
    )
    ground = f" on {classes} terrain {'class' if classes == 1 else 'classes'}" if classes else ""
    runs = f"{len(card.runs)} {'run' if len(card.runs) == 1 else 'runs'}"
    return f"{card.samples} {'sample' if card.samples == 1 else 'samples'} of {runs}{ground}"


def _good(card: DatasetCard) -> Iterator[Verdict]:
    if card.samples >= _FEW_SAMPLES:
        yield Verdict("good", f"{_size(card)}.")
    if card.energy_budget is not None and card.energy_budget.total < _NOISY:
        yield Verdict("good", f"Labels are sharp: the noise floor of E is {100 * card.energy_budget.total:.1f} %.")
    tested = [part for part in card.split.audit if part.samples]
    if tested and card.splits.get("train") and not any(part.overlapping_samples for part in tested):
        yield Verdict("good", "No held-out footprint shares ground with one that trains.")


def _thin(card: DatasetCard) -> Iterator[Verdict]:
    if card.samples < _FEW_SAMPLES:
        yield Verdict("thin", f"Only {_size(card)}.")
    empty = [name for name in ("train", "test", "unseen") if not card.splits.get(name)]
    if empty:
        yield Verdict("thin", f"Nothing is in {' and '.join(empty)}.")
    cells = card.balance.by_class_and_slope
    rare = [cell for cell in cells if cell["rare"]]
    if rare:
        names = [
            f"{cell['class'] or 'any ground'} at {cell['slope']}" for cell in rare if any(cell["samples"].values())
        ]
        some = f", among them {'; '.join(names[:3])}" if names else ""
        enough = f"{card.balance.enough_effective:g}"
        yield Verdict(
            "thin",
            f"{len(rare)} of {len(cells)} cells of class and slope hold fewer than {enough} independent samples{some}.",
        )
    if not any(card.balance.repeatability.values()):
        yield Verdict("thin", "No place was driven twice: how well a label repeats itself is not known.")


def _doubtful(card: DatasetCard, lost: list[str]) -> Iterator[Verdict]:
    for text in lost:
        yield Verdict("doubtful", f"{text[:1].upper()}{text[1:]}.")
    if card.problems:
        yield Verdict(
            "doubtful", f"{len(card.problems)} of the runs that were wanted are missing or damaged (listed below)."
        )
    if card.doubtful is not None and card.doubtful.share > _MANY_DOUBTFUL:
        yield Verdict("doubtful", f"{100 * card.doubtful.share:.1f} % of the labels carry a quality flag.")
    for part in card.split.audit:
        if part.overlapping_samples:
            share = 100 * part.overlapping_samples / part.samples
            yield Verdict(
                "doubtful",
                f"{share:.0f} % of {part.split} ({part.overlapping_samples} samples) share ground with train.",
            )
    if card.energy_budget is not None and card.energy_budget.total >= _NOISY:
        yield Verdict("doubtful", f"Labels are noisy: the noise floor of E is {100 * card.energy_budget.total:.1f} %.")


def _to_do(card: DatasetCard) -> Iterator[Verdict]:
    offered = [cell for cell in card.balance.by_class_and_slope if cell["rare"] and cell.get("offered_m2", 0.0) > 0]
    if offered:
        yield Verdict("do", "Drive what is thin: tick “drive here next” on the map; drive-next.geojson opens in a GIS.")
    if not card.splits.get("unseen"):
        yield Verdict("do", "Keep an area apart with --split REGION, or nothing tells how a model does on new ground.")
    if not any(card.balance.repeatability.values()):
        yield Verdict("do", "Drive some ten metres twice in the same direction.")
    if any(part.overlapping_samples for part in card.split.audit):
        if card.split.holdout == "sample":
            yield Verdict("do", "Hold out by block or by run (--holdout): single samples lie beside what trains.")
        else:
            yield Verdict(
                "do", f"Larger blocks ({recipe_key('split.block_m')}) or --holdout run leave less of test beside train."
            )
