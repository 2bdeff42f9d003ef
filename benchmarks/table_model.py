"""Benchmark: growing the trees of a table model, and asking them, in CPU time on one thread.

    python benchmarks/table_model.py [SAMPLES]

Patches are noise, labels depend on four features of sixteen and noise: as many trees and leaves as real ones have.
SAMPLES is 10,000.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from tcpipe.learning.predictor import Inputs
from tcpipe.learning.table_model import compute_patch_features, fit_table

WANTED_S, WANTED_A_SECOND = 20.0, 100_000
TOGETHER, TOLD = 1_000, 100_000
CHANNELS, CLASSES = ("ortho", "terrain", "height"), 7


def main() -> None:
    count, rng = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000, np.random.default_rng(0)
    patches = rng.random((TOGETHER, 40, 40, 3), np.float32)
    patches[..., 1] = np.rint(patches[..., 1] * 6.0) / 6.0
    began = time.process_time()
    for _ in range(0, count, TOGETHER):
        compute_patch_features(patches, channels=CHANNELS, class_count=CLASSES, patch_m=1.0)
    seen_s = time.process_time() - began
    features = rng.normal(size=(count, 16))
    ground = np.column_stack(
        [features[:, 0] + 0.5 * np.sin(3.0 * features[:, 1]), np.tanh(features[:, 2] * features[:, 3])]
    )
    labels = [100.0, 0.8] + [20.0, 0.1] * ground + rng.normal(size=ground.shape) * [5.0, 0.02]
    began = time.process_time()
    inputs = Inputs(CHANNELS, 40, CHANNELS, 1.0, CLASSES, (), ("power_watt", "velocity_mps"), (1.0, 1.0))
    model, _, count_of_trees = fit_table(features, labels, rng.integers(0, 5, count), inputs)
    grown_s = time.process_time() - began
    many = np.resize(features, (TOLD, 16))
    model.predict_table(many[:10])
    began = time.process_time()
    model.predict_table(many)
    rate = TOLD / (time.process_time() - began)
    print(
        f"{count} samples: {seen_s:.1f} s for features, {grown_s:.1f} s for trees (goal together at most {WANTED_S:.0f} s of 10,000)"
    )
    print(
        f"at most {count_of_trees} trees an output, {rate:,.0f} predictions/s given the features (goal at least {WANTED_A_SECOND:,})"
    )


if __name__ == "__main__":
    main()
