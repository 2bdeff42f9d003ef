"""How much of what tests was met in training, and what errors are where blocks of ground are held out instead."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tcpipe.cost.prediction_errors import centring_of
from tcpipe.dataset import Dataset, Split
from tcpipe.learning.evaluation_facts import ErrorsByClass, Leakage
from tcpipe.learning.metrics import costs, errors_by_class
from tcpipe.learning.models import Model
from tcpipe.splits.neighbours import CLOSE, PLACES, are_near, middles_deg

_UNKNOWN = {0: "unknown"}


def leakage_of(data: Dataset, held: Split) -> Leakage | None:
    """Return how near the samples of a split are to those of train; None where either has no samples with a place."""
    ours, theirs = (middles_deg({name: part.column(name) for name in PLACES}) for part in (held, data["train"]))
    within_m = CLOSE * data.card.recipe.segment.chord_m
    near = are_near(ours, theirs, within_m=within_m)
    if not len(near) or not len(theirs):
        return None
    audit = next((part for part in data.card.split.audit if part.split == held.name and part.samples), None)
    sharing = None if audit is None else 100.0 * audit.overlapping_samples / audit.samples
    return Leakage(data.card.recipe.split.holdout, within_m, 100.0 * float(near.mean()), sharing)


def by_blocks(model: Model, names: Mapping[int, str]) -> ErrorsByClass | None:
    """Return the errors on the samples that a model keeps as held out, by class; None if it keeps none of power and velocity.

    Folds are blocks of ground, so that this is what the errors are where blocks are held out. A network was stopped by its fold, and
    of a table the folds told how many trees are best: both are a little too small.
    """
    found: Mapping[str, NDArray[np.generic]] = model.residuals
    if "power_predicted_watt" not in found or not len(found["power_predicted_watt"]):
        return None
    power, velocity, said_power, said_velocity = (
        found[name].astype(np.float64)
        for name in ("power_watt", "velocity_mps", "power_predicted_watt", "velocity_predicted_mps")
    )
    class_ids = np.nan_to_num(found["terrain_class"].astype(np.float64)).astype(np.int64)
    centred = centring_of(found).apply(said_power, said_velocity, class_ids)
    known = {**_UNKNOWN, **names}
    own = {number: known.get(number, str(number)) for number in np.unique(class_ids).tolist()}
    return errors_by_class(costs(*centred, model.chord_m), costs(power, velocity, model.chord_m), class_ids, own)
