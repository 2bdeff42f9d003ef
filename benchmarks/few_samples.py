"""Kinds of model on few samples: RMSE of E and T on drives that were neither fitted nor used to choose.

    python benchmarks/few_samples.py DATASET [--counts 150 2000 5000] [--kinds mean linear …] [--seeds 1]

A subset is the first so many training samples of a drawn order, another one for each seed; every kind is fitted to it as `tcpipe train`
fits it. Build DATASET with --holdout run: its split `test` is of whole drives. Predictions are not centred.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from tcpipe.dataset import Dataset, open_dataset
from tcpipe.errors import TcpipeError
from tcpipe.learning.fitting import FitConfig
from tcpipe.learning.metrics import LEAST_VELOCITY_MPS, compute_costs
from tcpipe.learning.predictor import KINDS, Job, Samples, find_kind, predict_samples
from tcpipe.learning.training import Variant, make_samples


def make_subset(data: Dataset, name: str, count: int, seed: int) -> Samples:
    """Return so many training samples for a kind."""
    kind, config = find_kind(name), FitConfig(model=name, seed=seed)
    samples = make_samples(data, config, Variant(), kind)
    rows = np.sort(np.random.default_rng(seed).permutation(len(samples))[:count])
    return samples.take(rows)


def measure(data: Dataset, name: str, count: int, seed: int) -> dict[str, tuple[float, float]]:
    """Return RMSE of E [J] and T [s] by split."""
    samples, kind = make_subset(data, name, count, seed), find_kind(name)
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
        found[split] = tuple(float(np.sqrt(np.mean((said[of] - true[of]) ** 2))) for of in ("E", "T"))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--counts", type=int, nargs="*", default=[150, 2000, 5000])
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--seeds", type=int, default=1)
    told = parser.parse_args()
    data = open_dataset(told.dataset)
    for count in told.counts:
        for name in told.kinds:
            try:
                found = [measure(data, name, count, seed) for seed in range(told.seeds)]
            except TcpipeError as error:
                print(f"{count:>6} {name:10}: {error}")
                continue
            for split in found[0]:
                energy, time = np.array([of[split] for of in found]).T
                print(
                    f"{count:>6} {name:10} {split:6}: E {energy.mean():6.2f} ± {energy.std():.2f} J, T {time.mean():.4f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
