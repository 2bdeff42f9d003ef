"""Kinds of model on few samples: RMSE of E and T on drives that were neither fitted nor used to choose.

    python benchmarks/few_samples.py DATASET [--make] [--drives 32] [--metres 250] [--site-seed 11]
                                     [--counts 150 2000 5000] [--kinds auto linear …] [--seeds 1]

With --make DATASET is made first, in its folder: drives over the small site of `tcpipe demo`, of which whole ones are
held out; settings of kinds were chosen on other sites. A subset is the first so many training samples of a drawn order,
another one for each seed; every kind is fitted to it as `tcpipe train` fits it, `auto` the one that it chooses. Another
DATASET needs --holdout run. Predictions are not centred.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from path_coverage import make_store, simulate_drives

from tcpipe.dataset import Dataset, open_dataset
from tcpipe.errors import TcpipeError
from tcpipe.learning.fitting import FitConfig, ModelKind
from tcpipe.learning.metrics import LEAST_VELOCITY_MPS, compute_costs
from tcpipe.learning.predictor import AUTOMATIC, Job, Samples, find_kind, predict_samples
from tcpipe.learning.training import choose_kind, make_training_samples, select_train
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe


def make_subset(data: Dataset, name: ModelKind | Literal["auto"], count: int, seed: int) -> tuple[ModelKind, Samples]:
    """Return the kind, chosen where it is ``auto``, and so many training samples for it."""
    config = FitConfig(model=name, seed=seed)
    train = select_train(data, config)
    train = train.take(np.sort(np.random.default_rng(seed).permutation(len(train))[:count]))
    chosen = choose_kind(data, config, train) if name == "auto" else name
    return chosen, make_training_samples(data, config, find_kind(chosen), train)


def measure(data: Dataset, name: str, count: int, seed: int) -> dict[str, tuple[float, float]]:
    """Return RMSE of E [J] and T [s] by split."""
    chosen, samples = make_subset(data, name, count, seed)
    kind = find_kind(chosen)
    if chosen != name:
        print(f"{count:>6} {name} chooses {chosen}")
    with tempfile.TemporaryDirectory() as directory:
        job = Job(name, Path(directory, "state"))
        predictor = kind.fit_folds(samples, job).predictor if kind.stops_by_fold else kind.fit(samples)
    found = {}
    for split in (split for split in ("test", "unseen") if len(data[split])):
        part = data[split].take(np.isfinite(data[split].labels).all(axis=1)).with_channels(*samples.inputs.channels)
        held = replace(samples, split=part)
        power, velocity = predict_samples(predictor, held).mean.T
        said = compute_costs(power, np.maximum(velocity, LEAST_VELOCITY_MPS), 1.0)
        true = compute_costs(*held.labels.T, 1.0)
        found[split] = tuple(float(np.sqrt(np.mean((said[cost] - true[cost]) ** 2))) for cost in ("E", "T"))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--make", action="store_true")
    parser.add_argument("--drives", type=int, default=32)
    parser.add_argument("--metres", type=float, default=250.0)
    parser.add_argument("--site-seed", type=int, default=11)
    parser.add_argument("--counts", type=int, nargs="*", default=[150, 2000, 5000])
    parser.add_argument("--kinds", nargs="*", default=["auto", *AUTOMATIC, "resnet18"])
    parser.add_argument("--seeds", type=int, default=1)
    told = parser.parse_args()
    if told.make:
        here = told.dataset.parent
        site = simulate_drives(here / "site", told.drives, told.metres, seed=told.site_seed)
        store = make_store(here, site)
        recipe = replace(Recipe(), robot="husky", split=replace(Recipe().split, holdout="run"))
        build_dataset(told.dataset, store=store, recipe=recipe)
    data = open_dataset(told.dataset)
    for count in told.counts:
        for name in told.kinds:
            try:
                found = [measure(data, name, count, seed) for seed in range(told.seeds)]
            except TcpipeError as error:
                print(f"{count:>6} {name:10}: {error}")
                continue
            for split in found[0]:
                energy, time = np.array([errors[split] for errors in found]).T
                print(
                    f"{count:>6} {name:10} {split:6}: E {energy.mean():6.2f} ± {energy.std():.2f} J, T {time.mean():.4f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
