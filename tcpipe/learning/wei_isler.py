"""Table IV: E by this model and by the height-only networks of Wei and Isler, one of grass and one a class, all on the same samples."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from tcpipe.dataset import Dataset
from tcpipe.errors import DatasetError
from tcpipe.learning.baselines import compare_with_baseline
from tcpipe.learning.evaluation_facts import BaselineResult
from tcpipe.learning.metrics import ALL, Array, Errors, Spread, compute_errors_by_class
from tcpipe.learning.models import Model
from tcpipe.learning.predictions import Measured, predict_costs, predict_spreads
from tcpipe.learning.training import Variant

logger = logging.getLogger("tcpipe")

OURS, GRASS_ONLY, PER_CLASS = "ours", "Wei & Isler, grass only", "Wei & Isler, a net per class"

FEWEST = 20
"""Samples of a class in train that a network of its own needs."""

Trained = Callable[[str, Variant], Model]


@dataclass(slots=True)
class EnergyTable:
    """Errors of E by predictor and split, and the model's over theirs."""

    errors: dict[str, dict[str, Errors]] = field(default_factory=dict)
    compared: list[BaselineResult] = field(default_factory=list)


def make_energy_table(
    ours: Model,
    data: Dataset,
    sets: Mapping[str, Measured],
    said: Mapping[str, Mapping[str, Array]],
    trained: Trained | None,
    *,
    seed: int,
) -> EnergyTable:
    """Return table IV, of the samples whose class has a network of its own; of all where none is trained (``trained`` is None)."""
    networks = {} if trained is None or "height" not in data.card.layers else _fit_networks(ours, trained)
    grass = next((entry.id for entry in ours.classes.classes if entry.name == "grass" and entry.id in networks), None)
    found, block_m = EnergyTable(), data.card.recipe.split.block_m
    for split, part in sets.items():
        rows = np.flatnonzero(np.isin(part.class_ids, list(networks)) | (not networks))
        same, mine = part.take(rows), {"E": said[split]["E"][rows]}
        found.errors.setdefault(OURS, {})[split] = _compute_error(
            mine, same, predict_spreads(ours, mine, same.class_ids)
        )
        if not networks or not len(rows):
            continue
        theirs = {PER_CLASS: _predict_by_class_network(networks, same)}
        if grass is not None:
            theirs[GRASS_ONLY] = predict_costs(networks[grass], same.split)["E"]
        for name, energy in theirs.items():
            found.errors.setdefault(name, {})[split] = _compute_error({"E": energy}, same)
            found.compared += compare_with_baseline(name, split, same, mine, {"E": energy}, block_m=block_m, seed=seed)
    return found


def _fit_networks(ours: Model, trained: Trained) -> dict[int, Model]:
    """Return a network for every class with enough samples, by class id."""
    found = {}
    for class_id in (class_id for class_id, count in ours.card.seen.class_counts.items() if count >= FEWEST):
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
