"""Samples a second of an epoch: shuffled from disk and from memory, against a float32 .npy memmap and against decoding alone.

    python benchmarks/load_dataset.py DIRECTORY [SAMPLES]

The directory keeps the map, the store and the datasets (`big_store`). Interleaved repeats in one process, CPU time;
ratios are medians of those of each round. All files are in the page cache: a memmap then is a copy from memory, and its
worth hangs on how it is used.

held open        one mapping for the whole epoch, a sample copied out of it at a time: no batch is made
stacked          the same, and every 64 samples stacked to the batch that a trainer needs
opened           the file opened for every sample, as data sets that hold paths do
batches          64 rows gathered at once: the fastest that a memmap can be
torch            a map-style dataset over the held mapping in a DataLoader

"write alone" fills the batches with a constant: no loader that delivers float32 tensors can be faster.
"""

import importlib.util
import sys
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import zarr
from big_store import store_of

from tcpipe import open_dataset
from tcpipe.formats.dataset_files import CHUNK_ROWS, SHARD_ROWS
from tcpipe.pipeline.dataset.build import build_dataset
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


def stacked(path, order):
    stored = np.load(path, mmap_mode="r")
    for first in range(0, len(order), SIZE):
        np.stack([stored[index] for index in order[first : first + SIZE]])


def opened_per_sample(path, order):
    for index in order:
        np.array(np.load(path, mmap_mode="r")[index])


def batched(path, order):
    stored = np.load(path, mmap_mode="r")
    for first in range(0, len(order), SIZE):
        stored[order[first : first + SIZE]]


class Mapped:
    """Usual dataset class for torch: it returns a sample of a mapping and its label."""

    def __init__(self, path, labels):
        self.stored, self.labels = np.load(path, mmap_mode="r"), labels

    def __len__(self):
        return len(self.labels)

    def __getitem__(self, index):
        return np.array(self.stored[index]), self.labels[index]


def write_alone(count, shape):
    for _ in range(0, count, SIZE):
        np.empty((SIZE, *shape), np.float32).fill(1.0)


def decode(split):
    files, layers = split.view.stored.files, split.view.form.layers
    out = {
        layer: np.empty((files.piece_rows, 40, 40), np.uint16 if layer == "height" else np.uint8) for layer in layers
    }
    for piece in range(len(files.starts) - 1):
        files.read(piece, layers, out=out)


def decode_by_zarr(path, rows):
    """Decode all layers with zarr itself, ``rows`` at a call: a chunk, or a whole shard, which it decodes in one batch."""
    group = zarr.open_group(str(path), mode="r")
    for name, array in group.arrays():
        for first in range(0, array.shape[0] if name != "sample_id" else 0, rows):
            array[first : first + rows]


def epoch(batches):
    for _ in batches:
        pass


def contestants_of(zstd, lz4, path, order, patches):
    """Return what to run by name, and how many samples that is."""
    count, few = len(order), order[:5000]
    rows = zstd.view.stored.files.starts[-1]
    found = {
        "memmap held open": (lambda: per_sample(path, order), count),
        "memmap stacked": (lambda: stacked(path, order), count),
        "memmap opened": (lambda: opened_per_sample(path, few), len(few)),
        "memmap batches": (lambda: batched(path, order), count),
        "write alone": (lambda: write_alone(count, zstd[0][0].shape), count),
        "decode only, zstd": (lambda: decode(zstd), rows),
        "decode only, lz4": (lambda: decode(lz4), rows),
        "zarr a chunk, zstd": (lambda: decode_by_zarr(patches, CHUNK_ROWS), rows),
        "zarr a shard, zstd": (lambda: decode_by_zarr(patches, SHARD_ROWS), rows),
        "epoch from disk, zstd": (lambda: epoch(zstd.batches(SIZE, shuffle=True, from_disk=True)), count),
        "epoch from disk, lz4": (lambda: epoch(lz4.batches(SIZE, shuffle=True, from_disk=True)), count),
        "epoch from memory": (lambda: epoch(zstd.batches(SIZE, shuffle=True, from_disk=False)), count),
    }
    if importlib.util.find_spec("torch"):
        import torch

        torch.set_num_threads(1)
        loader = torch.utils.data.DataLoader
        mapped = loader(Mapped(path, zstd.labels), SIZE, sampler=few.tolist())
        ours = loader(zstd.torch_iterable(SIZE, shuffle=True, from_disk=False), batch_size=None)
        found["memmap torch"] = (lambda: epoch(mapped), len(few))
        found["torch iterable, memory"] = (lambda: epoch(ours), count)
    return found


def main():
    directory, samples = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 60_000
    zstd, lz4 = (dataset(directory, samples, compression) for compression in ("zstd", "lz4"))
    path = memmap_of(directory / f"patches-{samples}.npy", zstd)
    order = np.random.default_rng(0).permutation(len(zstd))
    contestants = contestants_of(zstd, lz4, path, order, directory / f"dataset-{samples}-zstd" / "patches.zarr")
    spent = {name: [] for name in contestants}
    for repeat in range(REPEATS + 1):
        for name, (run, count) in contestants.items():
            began = time.process_time()
            run()
            if repeat:  # the first round compiles and warms up
                spent[name].append((time.process_time() - began) / count)
    for name, seconds in spent.items():
        print(f"{name:24s} {1e-3 / min(seconds):8.1f} k samples/s")

    def times(ours, theirs):
        return median(there / here for here, there in zip(spent[ours], spent[theirs], strict=True))

    baselines = [name for name in spent if name.startswith("memmap")]
    for name in ("epoch from disk, zstd", "epoch from disk, lz4", "epoch from memory"):
        print(f"{name}: " + ", ".join(f"{times(name, other):.2f} x {other}" for other in baselines))
    print(f"an epoch from memory takes {1 / times('epoch from memory', 'write alone'):.2f} x write alone")
    rows = zstd.view.stored.files.starts[-1]
    print(f"train is 1/{rows / len(order):.2f} of the rows that an epoch decodes")
    for name in ("zstd", "lz4"):
        print(
            f"{name}: an epoch takes {1 / times(f'epoch from disk, {name}', f'decode only, {name}'):.2f} x decode only"
        )
        patches = directory / f"dataset-{samples}-{name}" / "patches.zarr"
        size = sum(file.stat().st_size for file in patches.rglob("*") if file.is_file())
        print(f"{name}: {size / rows:.0f} B a sample on disk")


if __name__ == "__main__":
    main()
