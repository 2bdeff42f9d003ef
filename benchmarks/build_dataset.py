"""Building a dataset against the sum of its floors: decode each map tile once, gather nearest pixels, encode and write each chunk.

    python benchmarks/build_dataset.py DIRECTORY [SAMPLES …]
    python benchmarks/build_dataset.py DIRECTORY memory [SAMPLES …]    builds of patches of 4 x 4 pixels: memory that each sample adds

Default 10,886 samples (the paper's) and 1,000,000. The directory keeps map and stores (`big_store`). CPU time of one
process after a first small build (kernels loaded), the best of `REPEATS` builds of a small dataset, one of a large;
memory as sampled 20 times a second: anonymous, and with mapped files that the system can drop. Tiles are counted as
they are decoded, each of three layers.
"""

import os
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from big_store import SMALL, find_site, store_of
from sample_patches import gather

from tcpipe.formats.dataset_files import CHUNK_ROWS, open_patches, read_card
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.pipeline.dataset import build, content, writing
from tcpipe.recipe import Recipe, SampleConfig

LAYERS = ("ortho", "terrain", "height")
FEW = 40
"""Chunks by which the codec's floor is measured."""

REPEATS = 5
LARGE = 100_000

spent = Counter()
peak = Counter()
tiles = Counter()


def timed(module, name):
    function = getattr(module, name)

    def wrapped(*arguments, **keywords):
        began = time.process_time()
        try:
            return function(*arguments, **keywords)
        finally:
            spent[name] += time.process_time() - began

    setattr(module, name, wrapped)


def counted():
    """Count the tiles that are decoded."""
    function = MapFile.read_tile

    def wrapped(self, layer, i, j, out):
        tiles[layer, i, j] += 1
        function(self, layer, i, j, out)

    MapFile.read_tile = wrapped


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


def decode_floor(path, decoded):
    """Seconds to decode every tile once that samples lie on, bytes at hand."""
    seconds = 0.0
    levels = open_map(path)._levels[1]  # noqa: SLF001  what is measured lies below the map
    for layer in LAYERS:
        array = levels[layer]
        encoded = [found for name, *index in decoded if name == layer and (found := _encoded(array, index))]
        out = np.empty(array.chunk_shape, array.dtype)
        seconds += best(lambda e=encoded, array=array, out=out: [array.codec.decode(tile, out=out) for tile in e])
    return seconds


def _encoded(array, index):
    per_shard = np.array(array.per_shard)
    data = array.path.joinpath("c", *map(str, index // per_shard)).read_bytes()
    table = np.frombuffer(data[-16 * int(per_shard.prod()) - 4 : -4], "<u8").reshape(*per_shard, 2)
    offset, size = table[tuple(index % per_shard)].tolist()
    return data[offset : offset + size - 4]  # nothing of a tile that is all no data


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
    arrays = open_patches(out, read_card(out)).arrays
    for layer in LAYERS:
        array = arrays[layer]
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


def built(store, out):
    """Build once; return the result and the seconds of sampling, of writing, of all."""
    shutil.rmtree(out, ignore_errors=True)
    for counter in (spent, peak, tiles):
        counter.clear()
    began = time.process_time()
    result = build.build_dataset(out, store=store.root, recipe=Recipe())
    return result, spent["sample_all_segments"], spent["write_patches"], time.process_time() - began


def floors_of(store, out, result, decoded):
    """Seconds that decoding, gathering and encoding take at least."""
    path, count = find_site(store), result.card.samples
    few = min(count, 50_000)
    return {
        "decode": decode_floor(path, decoded),
        "gather": gather_floor(path, few) * count / few,
        "encode and write": encode_floor(out, count),
    }


def measure(directory, samples):
    store, out = store_of(directory, samples), directory / f"built-{samples}"
    rounds = []
    for _ in range(REPEATS if samples < LARGE else 1):
        result, *seconds = built(store, out)
        memory, decoded = dict(peak), dict(tiles)
        rounds.append((*seconds, floors_of(store, out, result, decoded)))
    sampling, writing, total = (min(found[n] for found in rounds) for n in range(3))
    floors = {name: min(found[3][name] for found in rounds) for name in rounds[0][3]}
    floor, work = sum(floors.values()), sampling + writing
    ratios = sorted((found[0] + found[1]) / sum(found[3].values()) for found in rounds)
    named = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in floors.items())
    print(f"{result.card.samples} samples: decode + sample + write {work:.2f} s = {work / samples * 1e6:.1f} us each")
    print(f"  floors: {named}: {work / floor:.2f} x; round by round {', '.join(f'{ratio:.2f}' for ratio in ratios)}")
    print(f"  sampling {sampling:.2f} s, writing {writing:.2f} s, all of the build {total:.2f} s")
    print(f"  tiles decoded: {sum(decoded.values())} of {len(decoded)} that samples lie on")
    print(
        f"  peak memory: anonymous {memory['RssAnon'] / 1e6:.2f} GB, with mapped files {memory['VmRSS'] / 1e6:.2f} GB"
    )
    shutil.rmtree(out)


def measure_memory(directory, counts):
    """Print the largest anonymous memory of builds, each in a process of its own, and what each sample between two of them adds."""
    peaks = []
    for count in counts:
        store_of(directory, count)
        command = [sys.executable, __file__, str(directory), "one", str(count)]
        said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        peaks.append((count, int(said.split()[-1])))
        print(f"{count} samples: {peaks[-1][1] / 1e6:.1f} MB at most", flush=True)
    for (fewer, before), (more, after) in pairwise(peaks):
        print(f"from {fewer} to {more} samples: {(after - before) / (more - fewer):.0f} bytes a sample")


def build_one(directory, count):
    """Build once, and print the largest anonymous memory [byte]."""
    out, recipe = directory / f"built-{count}", replace(Recipe(), sample=SampleConfig(patch_px=4))
    threading.Thread(target=watch, daemon=True).start()
    build.build_dataset(out, store=store_of(directory, count).root, recipe=recipe)
    shutil.rmtree(out)
    print(peak["RssAnon"] * 1024)


def main():
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    directory, what = Path(sys.argv[1]), sys.argv[2:3]
    if what == ["memory"]:
        measure_memory(directory, [int(count) for count in sys.argv[3:] or ("200000", "1000000")])
        return
    if what == ["one"]:
        build_one(directory, int(sys.argv[3]))
        return
    timed(content, "sample_all_segments")
    timed(writing, "write_patches")
    counted()
    threading.Thread(target=watch, daemon=True).start()
    built(store_of(directory, SMALL), directory / "first")
    for samples in map(int, sys.argv[2:] or ("10886", "1000000")):
        measure(directory, samples)


if __name__ == "__main__":
    main()
