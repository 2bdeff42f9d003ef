"""What an evaluation's page says first, in plain words: whether the model is of use, what it is beside the simplest, what to do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

from tcpipe.learning.baselines import CURVES, PHYSICS, TREES, standing
from tcpipe.learning.evaluation_facts import Evaluation
from tcpipe.learning.metrics import ALL, Errors

_NO_USE_PERCENT = 50.0
"""MAPE from which a model is of no use: half of every metre's energy is another."""
_HELD_PERCENT = (85.0, 95.0)
"""Of labels, by intervals of 90 %, that are neither too narrow nor too wide."""
_NEAR_PERCENT = 50.0
"""Of a split, beside training: its figures are of ground that is known."""
_FEW = 100
_WEAK = 2.0
"""How many times the MAPE of all a class has that is pointed at, with so many labels or more:"""
_FEWEST_OF_CLASS = 20
_AS_GOOD_AS_LABELS = 0.7
"""Share of the RMSE that the labels' own noise makes, from which on no better model can be told."""


class Statement(NamedTuple):
    """One sentence of what a reader has to know first."""

    kind: Literal["doubtful", "thin", "do", "good"]
    text: str


def verdict(found: Evaluation) -> list[Statement]:
    """Return the sentences, the worst first."""
    told = [line for split in found.ordered_splits for line in _of_split(found, split)]
    return worst_first([*told, *_to_do(found)])


def worst_first(lines: Sequence[Statement]) -> list[Statement]:
    """Return sentences in the order in which they are read: doubtful, thin, what to do, good."""
    order = ("doubtful", "thin", "do", "good")
    return sorted(lines, key=lambda line: order.index(line.kind))


def is_of_no_use(found: Evaluation) -> bool:
    """Return whether the energies of any split are off by half and more on average."""
    return any((part.errors["E"][ALL].mape_percent or 0.0) >= _NO_USE_PERCENT for part in found.splits.values())


def _of_split(found: Evaluation, split: str) -> Iterator[Statement]:
    part, where = found.splits[split], "test" if split == "test" else "the unseen area"
    off = [
        f"{called} is off by {of.mape_percent:.0f} %"
        for quantity, called in (("E", "energy"), ("T", "time"))
        if ((of := part.errors[quantity][ALL]).mape_percent or 0.0) >= _NO_USE_PERCENT
    ]
    if off:
        yield Statement("doubtful", f"Of no use: on {where} {' and '.join(off)} on average (MAPE).")
    yield from _beside_the_simplest(found, split, where)
    yield from _sureness(part.errors["E"][ALL], where)
    yield from _weak_classes(part.errors["E"], where)
    floor, rmse = part.label_floor["E"][ALL].rmse, part.errors["E"][ALL].rmse
    if floor and rmse and floor >= _AS_GOOD_AS_LABELS * rmse:
        yield Statement(
            "good", f"On {where} it errs hardly more than the labels of E themselves: no better model could be told."
        )
    if part.samples < _FEW:
        yield Statement("thin", f"Only {part.samples} samples of {where}: what they say may be chance.")
    if split == "test" and part.leakage is not None and part.leakage.near_percent >= _NEAR_PERCENT:
        yield Statement(
            "thin",
            f"{part.leakage.near_percent:.0f} % of test lie within {part.leakage.within_m:.2f} m of what trained: known ground.",
        )


def _beside_the_simplest(found: Evaluation, split: str, where: str) -> Iterator[Statement]:
    for quantity, called in (("E", "energy"), ("T", "time")):
        of = standing(found.baselines, split, quantity)
        if of is not None and of.beats_curves is False:
            yield Statement(
                "doubtful", f"It does not beat a curve over class and slope on {where}, {called}: {of.text}."
            )
        elif of is not None and quantity == "E":
            yield Statement("good" if of.beats_all else "thin", f"On {where}, {called}: {of.text}.")


def _sureness(error: Errors, where: str) -> Iterator[Statement]:
    if error.held_percent is None:
        yield Statement("thin", f"It states no errors on {where}: too few samples were held out.")
        return
    low, high = _HELD_PERCENT
    held = f"its 90 % intervals hold {error.held_percent:.0f} % of E on {where}"
    if error.held_percent < low:
        yield Statement("doubtful", f"It is too sure of itself: {held}.")
    elif error.held_percent > high:
        yield Statement("thin", f"It is less sure than it could be: {held}.")
    else:
        yield Statement("good", f"It knows how wrong it is: {held}.")


def _weak_classes(errors: Mapping[str, Errors], where: str) -> Iterator[Statement]:
    every = errors[ALL].mape_percent
    weak = [
        f"{name} ({of.mape_percent:.0f} % of {of.mape_count} labels)"
        for name, of in errors.items()
        if name != ALL
        and every
        and of.mape_percent
        and of.mape_count >= _FEWEST_OF_CLASS
        and of.mape_percent > _WEAK * every
    ]
    if weak:
        yield Statement("thin", f"On {where} E is furthest off on {', '.join(weak)}, against {every:.0f} % of all.")


def _to_do(found: Evaluation) -> Iterator[Statement]:
    if is_of_no_use(found):
        yield Statement(
            "do",
            "Look at the worst metres below, and train on more ground or longer before anything is planned with it.",
        )
    standings = [standing(found.baselines, split, "E") for split in found.ordered_splits]
    better = [of.best for of in standings if of is not None and of.is_worse]
    kind = {TREES: "table", PHYSICS: "physics", **dict.fromkeys(CURVES.values(), "table")}
    if better and kind[better[-1]] == found.model.training.config.model:
        yield Statement(
            "do",
            f"Drive more of this ground: '{better[-1]}' is better on the same samples, so few are they to learn more from.",
        )
    elif better:
        yield Statement(
            "do",
            f"Try 'tcpipe train DATASET --model {kind[better[-1]]}': '{better[-1]}' is better on the same samples.",
        )
    if "unseen" not in found.splits:
        yield Statement("do", "Keep an area apart with --split REGION, or nothing tells how it does on new ground.")
