"""Building a dataset against the sum of its floors: decode each map tile once, gather nearest pixels, encode and write each chunk.

    python benchmarks/build_dataset.py DIRECTORY [SAMPLES …]

Default 10,886 samples (the paper's) and 1,000,000. The directory keeps map and stores (`big_store`). CPU time of one process after a
first small build (kernels loaded); memory as sampled 20 times a second: anonymous, and with mapped files that the system can drop.
"""

import os
import shutil
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np
from big_store import store_of
from sample_patches import gather

from tcpipe.formats.dataset_files import CHUNK_ROWS
from tcpipe.formats.map_files import open_map
from tcpipe.formats.shards import open_sharded
from tcpipe.pipeline import build, dataset_content
from tcpipe.recipe import Recipe

LAYERS = ("ortho", "terrain", "height")
FEW = 40
"""Chunks by which the codec's floor is measured."""

spent = Counter()
peak = Counter()


def timed(module, name):
    function = getattr(module, name)

    def wrapped(*arguments, **keywords):
        began = time.process_time()
        try:
            return function(*arguments, **keywords)
        finally:
            spent[name] += time.process_time() - began

    setattr(module, name, wrapped)


def watch():
    while True:
        lines = Path("/proc/self/status").read_text().splitlines()
        values = {line.split(":")[0]: int(line.split()[1]) for line in lines if line.startswith(("RssAnon", "VmRSS"))}
        for name, kilobytes in values.items():
            peak[name] = max(peak[name], kilobytes)
        time.sleep(0.05)


def best(function, repeats=3):
    times = []
    for _ in range(repeats):
        began = time.process_time()
        function()
        times.append(time.process_time() - began)
    return min(times)


def decode_floor(path):
    """Seconds to decode every tile of the map once, bytes at hand."""
    seconds = 0.0
    for layer in LAYERS:
        array = open_sharded(path / layer)
        tiles = [
            encoded
            for shard in sorted((path / layer / "c").rglob("*"))
            if shard.is_file()
            for encoded in _chunks(shard, array)
        ]
        out = np.empty(array.chunk_shape, array.dtype)
        seconds += best(lambda tiles=tiles, array=array, out=out: [array.codec.decode(tile, out=out) for tile in tiles])
    return seconds


def _chunks(shard, array):
    data = shard.read_bytes()
    count = int(np.prod(array.per_shard))
    index = np.frombuffer(data[-16 * count - 4 : -4], "<u8").reshape(-1, 2)
    return [data[int(at) : int(at + size) - 4] for at, size in index if at != 2**64 - 1]


def gather_floor(path, count):
    """Seconds to gather the nearest pixels of so many patches from arrays in memory."""
    source = open_map(path)
    grid = source.grid
    arrays = [source.read(layer, 0, grid.rows, 0, grid.cols) for layer in ("height", "ortho", "terrain")]
    arrays[0] = np.nan_to_num(arrays[0])
    rng = np.random.default_rng(0)
    course = rng.uniform(-np.pi, np.pi, count)
    at = rng.uniform([60, 60], [grid.cols - 60, grid.rows - 60], (count, 2))
    at = at[np.lexsort((at[:, 0], at[:, 1] // 512))]  # by rows of tiles, as the sampler does
    cos, sin = np.cos(course) / 2, np.sin(course) / 2
    frames = np.column_stack([at, cos, sin, -sin, cos])
    outs = [np.empty((count, 40, 40), dtype) for dtype in (np.uint16, np.uint8, np.uint8)]
    flat = [array.reshape(-1) for array in arrays]
    gather(*flat, grid.cols, frames[:2], *(out[:2] for out in outs))
    return best(lambda: gather(*flat, grid.cols, frames, *outs))


def encode_floor(out, samples):
    """Seconds to encode every chunk of the patches and to write the bytes."""
    seconds = 0.0
    for layer in LAYERS:
        array = open_sharded(out / "patches.zarr" / layer)
        chunks = [array.chunk((number, 0, 0)) for number in range(min(FEW, samples // CHUNK_ROWS))]
        encoded = []
        seconds += best(
            lambda chunks=chunks, array=array, encoded=encoded: encoded.extend(map(array.codec.encode, chunks))
        ) * (samples / CHUNK_ROWS / len(chunks))
        path = out.with_suffix(".floor")
        data = b"".join(encoded[: len(chunks)])
        seconds += best(lambda data=data, path=path: path.write_bytes(data)) * (samples / CHUNK_ROWS / len(chunks))
        path.unlink()
    return seconds


def measure(directory, samples):
    store, out = store_of(directory, samples), directory / f"built-{samples}"
    shutil.rmtree(out, ignore_errors=True)
    spent.clear()
    peak.clear()
    began = time.process_time()
    result = build.build_dataset(out, store=store.root, recipe=Recipe())
    total = time.process_time() - began
    if samples < 5_000:
        return
    memory = dict(peak)
    work = spent["sample_all_segments"] + spent["_write_patches"]
    path = store.map_path("site")
    floors = {
        "decode": decode_floor(path),
        "gather": gather_floor(path, min(samples, 50_000)) * samples / min(samples, 50_000),
        "encode and write": encode_floor(out, result.samples),
    }
    floor = sum(floors.values())
    print(f"{result.samples} samples: decode + sample + write {work:.2f} s = {work / samples * 1e6:.1f} us each")
    print(
        "  floors: "
        + ", ".join(f"{name} {seconds:.2f} s" for name, seconds in floors.items())
        + f": {work / floor:.2f} x"
    )
    print(
        f"  sampling {spent['sample_all_segments']:.2f} s, writing {spent['_write_patches']:.2f} s, all of the build {total:.2f} s"
    )
    print(
        f"  peak memory: anonymous {memory['RssAnon'] / 1e6:.2f} GB, with mapped files {memory['VmRSS'] / 1e6:.2f} GB"
    )
    shutil.rmtree(out)


def main():
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    timed(dataset_content, "sample_all_segments")
    timed(build, "_write_patches")
    threading.Thread(target=watch, daemon=True).start()
    directory = Path(sys.argv[1])
    for samples in (1_000, *map(int, sys.argv[2:] or ("10886", "1000000"))):
        measure(directory, samples)


if __name__ == "__main__":
    main()
