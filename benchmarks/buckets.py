"""What is fetched of a camera log in a bucket, and what datasets in a bucket cost against those on disk.

    . DIR/env && python benchmarks/buckets.py s3://BUCKET DIRECTORY [CAMERA_SECONDS] [SAMPLES]

The bucket is empty but for what this wrote before; the directory keeps log, store and datasets. Times are wall clock, interleaved, the
smaller of two rounds; the cache of this machine is emptied before a first epoch.
"""

import shutil
import sys
import time
from pathlib import Path

import obstore
from big_store import store_of
from made_logs import NAVIGATION, by_time, camera, navigation, repeated, write_mcap

from tcpipe import open_dataset
from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.object_storage import connected
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.recipe import Recipe

SECONDS = 20
SIZE = 64


def timed(work):
    start = time.perf_counter()
    found = work()
    return time.perf_counter() - start, found


def log_in(bucket, directory, seconds):
    path = directory / f"camera-{seconds}.mcap"
    if not path.exists():
        of = (repeated(part(SECONDS / 60), SECONDS, seconds // SECONDS) for part in (navigation, camera))
        write_mcap(path, by_time(*of), compression="zstd", camera_apart=True)
    store, _ = connected(f"{bucket}/any")
    obstore.put(store, path.name, path)
    return path, f"{bucket}/{path.name}"


def read(where):
    with open_log(where) as log:
        opened = log.fetched_bytes
        rows = sum(table.num_rows for table in log.tables(NAVIGATION).values())
        return log.size_bytes, opened, log.fetched_bytes, rows


def epoch(split):
    return sum(len(batch[1]) for batch in split.batches(SIZE, shuffle=True, from_disk=True))


def main(bucket, directory, seconds=400, samples=20_000):
    directory.mkdir(parents=True, exist_ok=True)
    here, there = log_in(bucket, directory, seconds)
    times = {where: min(timed(lambda where=where: read(where))[0] for _ in range(2)) for where in (here, there)}
    size, opened, fetched, rows = read(there)
    assert rows == read(here)[3]
    print(
        f"log of {size / 1e6:.0f} MB, camera in chunks of its own: index {opened / size:.3%}, navigation {fetched / size:.2%} fetched"
    )
    print(f"reading its navigation topics: {times[there]:.2f} s from the bucket, {times[here]:.2f} s from disk")

    store, recipe = store_of(directory, samples).root, Recipe()
    built = {}
    for number in range(2):
        for out in (str(directory / f"ds-{number}"), f"{bucket}/ds-{time.time_ns()}"):
            shutil.rmtree(out, ignore_errors=True)
            taken, result = timed(lambda out=out: build_dataset(out, store=store, recipe=recipe, holdout="sample"))
            built.setdefault("://" in out, []).append((taken, result))
    ratio = min(taken for taken, _ in built[True]) / min(taken for taken, _ in built[False])
    print(f"build of {built[True][0][1].samples} samples: {ratio:.2f} x as long into the bucket")
    local, remote = (open_dataset(built[far][0][1].path)["train"] for far in (False, True))
    first, count = timed(lambda: epoch(remote))
    disk, bucket_s = (min(timed(lambda split=split: epoch(split))[0] for _ in range(3)) for split in (local, remote))
    print(
        f"shuffled epoch of {count} samples: first {first:.2f} s from the bucket, then {bucket_s:.2f} s, from disk {disk:.2f} s"
    )
    print(f"an epoch from the bucket, cached: {disk / bucket_s:.2f} of the speed from disk")


if __name__ == "__main__":
    main(sys.argv[1].rstrip("/"), Path(sys.argv[2]), *map(int, sys.argv[3:]))
