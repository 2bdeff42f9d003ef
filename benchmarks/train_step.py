"""Benchmark: what training costs beside a bare torch loop, and feeding the network beside training it, in CPU time on one thread.

    OMP_NUM_THREADS=1 python benchmarks/train_step.py DATASET [WIDTH]

Prints the least microseconds a sample of batching (shuffled, mirrored, formed), of one training step as `tcpipe train`
does it, and of a forward pass; and the throughput of both first as a share of that of a loop of a few lines on ready
tensors, which alternates with them.
"""

from __future__ import annotations

import sys
import time

import torch

from tcpipe.dataset import open_dataset
from tcpipe.learning.fitting import FitConfig, compute_loss_factors
from tcpipe.learning.network import Trainer, make_resnet18
from tcpipe.learning.network_model import NetworkModel
from tcpipe.learning.training import make_training_samples

STEPS, BATCH = 10, 64
WANTED = 0.9


def main() -> None:
    samples = make_training_samples(open_dataset(sys.argv[1]), FitConfig(), NetworkModel)
    fit = samples.split.take(samples.folds != 0)
    width = int(sys.argv[2]) if len(sys.argv) > 2 else 64
    batches = fit.batches(BATCH, shuffle=True, mirror=True, drop_last=True)
    list(batches)  # reads the split, loads the kernels
    sizes, px = (samples.inputs.depth, 2, width), samples.inputs.patch_px
    trainer = Trainer(make_resnet18(*sizes, seed=0, start=(0.4, 0.8)), compute_loss_factors("nrmse", (1.0, 1.0)))
    bare = make_resnet18(*sizes, seed=0, start=(0.4, 0.8)).train().to(memory_format=torch.contiguous_format)
    optimizer = torch.optim.Adam(bare.parameters(), 1e-4)
    images, wanted = torch.rand(BATCH, sizes[0], px, px), torch.rand(BATCH, 2)
    spent: dict[str, list[float]] = {"feeding": [], "training": [], "predicting": [], "bare training": []}
    endless = batches.forever()
    for _ in range(STEPS):
        began = time.process_time()
        patches, labels = next(endless)
        fed = time.process_time()
        trainer.step(patches, labels, 1e-4)
        trained = time.process_time()
        trainer.network.predict(patches)
        predicted = time.process_time()
        optimizer.zero_grad()
        torch.linalg.vector_norm(bare(images) - wanted, dim=1).mean().backward()
        optimizer.step()
        ends = (fed - began, trained - fed, predicted - trained, time.process_time() - predicted)
        for name, seconds in zip(spent, ends, strict=True):
            spent[name].append(seconds / BATCH * 1e6)
    least = {name: min(values[1:]) for name, values in spent.items()}
    both = least["feeding"] + least["training"]
    print(", ".join(f"{name} {value:.1f} µs a sample" for name, value in least.items()))
    print(f"feeding is {100.0 * least['feeding'] / both:.2f} % of the two")
    print(f"throughput {least['bare training'] / both:.2f} x the bare loop's (goal at least {WANTED})")


if __name__ == "__main__":
    main()
