"""When a network begins to be worth it: table and network trained on nested subsets of a dataset, RMSE of E on test and unseen.

    python benchmarks/few_samples.py DATASET [--counts 500 1500] [--steps 3000] [--width 64] [--model MODEL]

A subset is the first so many training samples of one drawn order. The table is fitted to all of them, the network stopped by fold 0; it
is given so many steps of 64 samples at most, whatever the subset. MODEL, a network that was trained on all of DATASET, is compared with a
table of all. Ratios are network over table, of the same samples, with 95 % intervals (paired bootstrap, as `tcpipe evaluate`); neither is
centred.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tcpipe.dataset import Dataset, Split, open_dataset
from tcpipe.learning.architecture import Architecture
from tcpipe.learning.baselines import compare_with_baseline
from tcpipe.learning.fitting import FitConfig, Task, fit, predict_split
from tcpipe.learning.models import load_model
from tcpipe.learning.network import make_resnet18
from tcpipe.learning.predictions import Predicted, collect_measured
from tcpipe.learning.table_model import compute_features, fit_table
from tcpipe.learning.training import Variant, make_training_task, read_class_table

Predict = Callable[[Split], NDArray[np.floating]]


def subset(task: Task, count: int) -> Task:
    """Return the task of the first so many samples of one drawn order."""
    rows = np.sort(np.random.default_rng(0).permutation(len(task.train))[:count])
    train = task.train.take(rows)
    return Task(train, *train.fold(0), task.outputs)


def table_of(data: Dataset, train: Split) -> Predict:
    """Return a table of samples."""
    labels, classes = train.labels.astype(np.float64), read_class_table(data.card).count
    features = compute_features(train, data.card.patch_m, classes)
    folds, rules = train.column("fold"), {"channels": train.channels, "class_count": classes}
    table, _ = fit_table(features, labels, np.ones_like(labels), folds, **rules)
    return lambda split: table.predict(compute_features(split, data.card.patch_m, classes))


def network_of(task: Task, *, steps: int, width: int) -> Predict:
    """Return a network of samples, as it was best in so many steps."""
    config = FitConfig(width=width, epochs=-(-steps * 64 // len(task.fit)), patience=steps)
    with tempfile.TemporaryDirectory() as name:
        made = fit(task, config, name=f"{len(task.train)} samples", key="", checkpoint=Path(name, "state"))
    network = make_resnet18(
        Architecture(40, len(task.train.channels), len(made.scale), width), seed=0, start=made.scale
    )
    network.set_arrays(made.weights, "")
    return lambda split: predict_split(network, task, split, made.scale)


def compare(data: Dataset, network: Predict, table: Predict, called: str) -> None:
    """Print RMSE of E of both on test and unseen, and their ratio."""
    for name in (name for name in ("test", "unseen") if len(data[name])):
        part = collect_measured(data[name], {})
        ours, theirs = (
            Predicted.centre({}, predict(part.split).astype(np.float64), part.class_ids, 1.0)
            for predict in (network, table)
        )
        rules = {"block_m": data.card.recipe.split.block_m, "seed": 0}
        row = next(
            of for of in compare_with_baseline("boosting", name, part, ours, theirs, **rules) if of.quantity == "E"
        )
        rmse = float(np.sqrt(np.mean(np.square(ours.costs["E"] - part.costs["E"]))))
        print(
            f"{called:>12} {name:6}: network {rmse:6.2f} J, table {row.errors.rmse:6.2f} J, ratio {row.rmse_ratio}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--counts", type=int, nargs="*", default=[500, 1500])
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--model", type=Path)
    told = parser.parse_args()
    data = open_dataset(told.dataset)
    whole = make_training_task(data, 0, Variant())
    if told.model is not None:
        compare(data, lambda split: load_model(told.model).predict(split.patches), table_of(data, whole.train), "all")
    for count in told.counts:
        task = subset(whole, count)
        network = network_of(task, steps=told.steps, width=told.width)
        compare(data, network, table_of(data, task.train), f"{count}")


if __name__ == "__main__":
    main()
