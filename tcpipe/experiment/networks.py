"""Networks of table IV: one per class with all layers, and Wei and Isler's, which predict E from heights alone.

Each takes as many steps as the one network, and is centred by class by the same rule.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from tcpipe.arrays import Floats, Floats32, Ints
from tcpipe.cost.prediction_errors import make_residuals
from tcpipe.dataset import Split, open_dataset
from tcpipe.formats.json_files import read_as, write_json
from tcpipe.learning.baselines import SPLITS, BaselineResult, compare_with_baseline
from tcpipe.learning.models import load_model
from tcpipe.learning.network_model import NetworkModel
from tcpipe.learning.predictions import Predicted, collect_measured, predict_costs
from tcpipe.learning.predictor import Fitted, Job, Prediction, Samples, find_held_out, predict_samples
from tcpipe.learning.training import make_training_samples
from tcpipe.progress import logger

Batch = tuple[Floats32, Floats32]

ALL_LAYERS, HEIGHTS, GRASS = "a net per class, all layers", "Wei & Isler, a net per class", "Wei & Isler, grass only"

FEWEST = 20
"""Fewest training samples of a class for a network of this class alone."""


class EnergySamples(Samples):
    """Samples with energy as their only label."""

    @cached_property
    def labels(self) -> Floats:
        """Energy [J], shape (N, 1)."""
        return self.split.column(self.inputs.outputs[0]).astype(float)[:, None]


class EnergyNetwork(NetworkModel):
    """ResNet-18 of one output, the energy of a metre."""

    @staticmethod
    def iterate_batches(fit: Samples, epoch: int) -> Iterator[Batch]:
        """Yield patches and energies [J]."""
        config = fit.config
        batches = fit.split.batches(
            config.batch_size, shuffle=True, seed=config.seed, mirror=config.mirror, features=fit.inputs.outputs
        )
        for (patches, energies), _ in batches.epoch(epoch):
            yield patches, energies


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkResults:
    """All of networks.json."""

    kind: str = "tcpipe networks"
    model: str
    """Checksum of the one network."""
    results: tuple[BaselineResult, ...]


def compare_networks(model: Path, dataset: Path, place: Path, *, seed: int) -> tuple[BaselineResult, ...]:
    """Train the networks beside a model below ``place``, and return their errors of E; a second call reads them."""
    own_model, where = load_model(model), place / "networks.json"
    if where.is_file() and (known := read_as(where, NetworkResults)).model == own_model.checksum:
        return known.results
    place.mkdir(parents=True, exist_ok=True)
    data, fitted = open_dataset(dataset, label=own_model.card.label_energy), own_model.card.training.samples["fitted"]
    train = make_training_samples(data, own_model.card.training.config, NetworkModel)
    heights = make_training_samples(data, replace(own_model.card.training.config, layers=("height",)), NetworkModel)
    energy = replace(heights.inputs, outputs=(heights.split.energy.energy,))
    of_energy = EnergySamples(heights.split, energy, heights.config, heights.idle_watt)
    names = {entry.id: entry.name for entry in own_model.card.class_table.classes}
    by_class = {
        ALL_LAYERS: _fit_by_class(NetworkModel, train, place / "class", fitted),
        HEIGHTS: _fit_by_class(EnergyNetwork, of_energy, place / "height", fitted),
    }
    by_class[GRASS] = {number: each for number, each in by_class[HEIGHTS].items() if names[number] == "grass"}
    known_classes = [number for number in by_class[ALL_LAYERS] if number in by_class[HEIGHTS]]
    results = list[BaselineResult]()
    for split in SPLITS:
        whole = collect_measured(data[split], names)
        same = collect_measured(whole.split.take(np.isin(whole.class_ids, known_classes)), names)
        if not len(same.split):
            continue
        predicted = predict_costs(own_model, same.split)
        for name, networks in by_class.items():
            joule, block_m = np.empty(len(same.split)), data.card.recipe.split.block_m
            for number, (samples, trained) in networks.items():
                here = np.flatnonzero((same.class_ids == number) | (name == GRASS))
                if here.size:
                    ground = same.split.take(here), same.class_ids[here]
                    joule[here] = _predict_energy(samples, trained, *ground, own_model.card.chord_m)
            if networks:
                theirs = Predicted({"E": joule}, {})
                results += compare_with_baseline(name, split, same, predicted, theirs, block_m=block_m, seed=seed)
    write_json(where, NetworkResults(model=own_model.checksum, results=tuple(results)))
    return tuple(results)


Networks = Mapping[int, tuple[Samples, Fitted]]


def _fit_by_class(kind: type[NetworkModel], samples: Samples, place: Path, fitted: int) -> Networks:
    """Return a network for each class with enough samples, by class id, with as many steps as ``fitted`` samples."""
    found, class_id, config = dict[int, tuple[Samples, Fitted]](), samples.features.class_id, samples.config
    for number in np.unique(class_id[class_id > 0]).tolist():
        own = samples.take(class_id == number)
        few = int((own.folds != config.fold).sum())
        if len(own) < FEWEST or few in {0, len(own)}:
            logger.info("no network for class %d alone: %d samples, %d of them to fit", number, len(own), few)
            continue
        longer = np.ceil(fitted / config.batch_size) / np.ceil(few / config.batch_size)
        rules = replace(config, epochs=round(longer * config.epochs), patience=round(longer * config.patience))
        scale = tuple(map(float, own.labels.max(axis=0)))
        own = replace(own, config=rules, inputs=replace(own.inputs, scale=scale))
        name = f"{place.name}_{number}"
        found[number] = own, kind.fit_folds(own, Job(name, place.with_name(f"{name}.checkpoint")))
    return found


def _predict_energy(samples: Samples, fitted: Fitted, split: Split, class_id: Ints, chord_m: float) -> Floats:
    """Return centred energies [J]; of a network of energy alone as of a power at 1 m/s."""
    there = replace(samples, split=split.with_channels(*samples.inputs.channels))
    is_held, alone = find_held_out(fitted.held_out), len(samples.inputs.outputs) == 1
    labels, held, prediction = (
        samples.labels[is_held],
        fitted.held_out.mean[is_held],
        predict_samples(fitted.predictor, there),
    )
    if alone:
        labels, held, mean = (
            np.column_stack([values, np.ones(len(values))]) for values in (labels, held, prediction.mean)
        )
        prediction, chord_m = Prediction.without_covariance(mean), 1.0
    rows = samples.split.take(is_held)
    columns = {name: rows.column(name) for name in ("run_id", "start_ns", "terrain_class", "fold")}
    residuals = columns | make_residuals(labels, held, np.zeros((len(labels), 2, 2)))
    return Predicted.centre(residuals, prediction, class_id, chord_m).costs["E"]
