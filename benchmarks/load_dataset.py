"""Samples a second of an epoch: shuffled from disk and from memory, against a float32 .npy memmap and against decoding alone.

    python benchmarks/load_dataset.py DIRECTORY [SAMPLES]

The directory keeps the map, the store and the datasets (`big_store`). Interleaved repeats in one process, CPU time, page cache warm.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from big_store import store_of

from tcpipe import open_dataset
from tcpipe.pipeline.build import build_dataset
from tcpipe.recipe import DatasetConfig, Recipe

SIZE = 64
REPEATS = 5


def dataset(directory, samples, compression):
    out = directory / f"dataset-{samples}-{compression}"
    recipe = replace(Recipe(), dataset=DatasetConfig(compression=compression))
    build_dataset(out, store=store_of(directory, samples).root, recipe=recipe, holdout="sample")
    return open_dataset(out)["train"]


def memmap_of(path, split):
    if not path.exists():
        out = np.lib.format.open_memmap(path, "w+", np.float32, (len(split), *split[0][0].shape))
        at = 0
        for patches, _ in split.batches(1024, from_disk=True):
            out[at : at + len(patches)] = patches
            at += len(patches)
        out.flush()
    return path


def per_sample(path, order):
    stored = np.load(path, mmap_mode="r")
    for index in order:
        np.array(stored[index])


def opened_per_sample(path, order):
    for index in order:
        np.array(np.load(path, mmap_mode="r")[index])


def batched(path, order):
    stored = np.load(path, mmap_mode="r")
    for first in range(0, len(order), SIZE):
        stored[order[first : first + SIZE]]


def decode(split):
    files, layers = split.view.stored.files, split.view.form.layers
    out = {
        layer: np.empty((files.piece_rows, 40, 40), np.uint16 if layer == "height" else np.uint8) for layer in layers
    }
    for piece in range(len(files.starts) - 1):
        files.read(piece, layers, out=out)


def epoch(batches):
    for _ in batches:
        pass


def main():
    directory, samples = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 60_000
    zstd, lz4 = (dataset(directory, samples, compression) for compression in ("zstd", "lz4"))
    path = memmap_of(directory / f"patches-{samples}.npy", zstd)
    order = np.random.default_rng(0).permutation(len(zstd))
    all_rows = zstd.view.stored.files.starts[-1]
    contestants = {
        "memmap, sample by sample": (lambda: per_sample(path, order), len(order)),
        "memmap opened each time": (lambda: opened_per_sample(path, order[:5000]), 5000),
        "memmap, by batches": (lambda: batched(path, order), len(order)),
        "decode only, zstd": (lambda: decode(zstd), all_rows),
        "decode only, lz4": (lambda: decode(lz4), all_rows),
        "epoch from disk, zstd": (lambda: epoch(zstd.batches(SIZE, shuffle=True, from_disk=True)), len(order)),
        "epoch from disk, lz4": (lambda: epoch(lz4.batches(SIZE, shuffle=True, from_disk=True)), len(order)),
        "epoch from memory": (lambda: epoch(zstd.batches(SIZE, shuffle=True, from_disk=False)), len(order)),
    }
    spent = {name: [] for name in contestants}
    for repeat in range(REPEATS + 1):
        for name, (run, _) in contestants.items():
            began = time.process_time()
            run()
            if repeat:  # the first round compiles and warms up
                spent[name].append(time.process_time() - began)
    rate = {name: count / min(spent[name]) for name, (_, count) in contestants.items()}
    for name, value in rate.items():
        print(f"{name:26s} {value / 1000:8.1f} k samples/s")
    for name in ("epoch from disk, zstd", "epoch from disk, lz4", "epoch from memory"):
        against = ", ".join(f"{rate[name] / rate[other]:.2f} x {other}" for other in list(contestants)[:3])
        print(f"{name}: {against}")
    share = all_rows / len(order)  # an epoch of train decodes the other splits' samples too
    print(f"train is 1/{share:.2f} of the rows that an epoch decodes")
    for name in ("zstd", "lz4"):
        print(
            f"{name}: an epoch takes {rate[f'decode only, {name}'] / rate[f'epoch from disk, {name}']:.2f} x decode only"
        )
        patches = directory / f"dataset-{samples}-{name}" / "patches.zarr"
        size = sum(file.stat().st_size for file in patches.rglob("*") if file.is_file())
        print(f"{name}: {size / all_rows:.0f} B a sample on disk")


if __name__ == "__main__":
    main()
