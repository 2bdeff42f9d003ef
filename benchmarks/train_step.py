"""Benchmark: what feeding the network costs beside training it, in CPU time on one thread.

    OMP_NUM_THREADS=1 python benchmarks/train_step.py DATASET [WIDTH]

Prints microseconds a sample of batching (shuffled, mirrored, formed) and of one training step, their ratio, and of a forward pass.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from tcpipe.dataset import open_dataset
from tcpipe.learning.keras_backend import load_keras
from tcpipe.learning.losses import keras_loss, loss_factors
from tcpipe.learning.network import Architecture, resnet18
from tcpipe.learning.training import Variant, training_task

STEPS, BATCH = 6, 64


def main() -> None:
    task = training_task(open_dataset(sys.argv[1]), 0, Variant())
    width = int(sys.argv[2]) if len(sys.argv) > 2 else 64
    batches = task.fit.batches(BATCH, shuffle=True, mirror=True, drop_last=True)
    list(batches)  # reads the split, loads the kernels
    shape = Architecture(task.fit.view.stored.files.patch_px, task.fit.view.form.depth, 2, width)
    network = resnet18(shape, seed=0, start=(0.4, 0.8))
    network.compile(load_keras().optimizers.Adam(1e-4), loss=keras_loss(loss_factors("nrmse", (1.0, 1.0))))
    spent: dict[str, list[float]] = {"feeding": [], "training": [], "predicting": []}
    endless = batches.forever()
    for _ in range(STEPS):
        began = time.process_time()
        patches, labels = next(endless)
        fed = time.process_time()
        network.train_on_batch(patches, np.concatenate([labels, np.ones_like(labels)], axis=1))
        trained = time.process_time()
        network.predict_on_batch(patches)
        for name, seconds in zip(spent, (fed - began, trained - fed, time.process_time() - trained), strict=True):
            spent[name].append(seconds / BATCH * 1e6)
    middle = {name: float(np.median(values[1:])) for name, values in spent.items()}
    print(", ".join(f"{name} {value:.1f} µs a sample" for name, value in middle.items()))
    print(f"feeding is {100.0 * middle['feeding'] / (middle['feeding'] + middle['training']):.2f} % of the two")


if __name__ == "__main__":
    main()
