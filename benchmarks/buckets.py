"""Measure the cost of a store, a dataset and a log in a bucket, as a ratio to the same on disk.

    . DIR/env && python benchmarks/buckets.py ingest s3://BUCKET DIRECTORY [TURNS]
    . DIR/env && python benchmarks/buckets.py build  s3://BUCKET DIRECTORY [SAMPLES]
    . DIR/env && python benchmarks/buckets.py camera s3://BUCKET DIRECTORY [GB]

The directory keeps logs, stores and datasets; outputs in the bucket get unique names. Disk and bucket take turns, and
the shortest time of each counts. The log with a camera is generated while it is uploaded: random images, which no codec
compresses, in chunks apart from those of a simulated drive of twelve minutes.
"""

import os
import resource
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np
import obstore
from big_store import store_of
from made_logs import CAMERA_HZ, TYPES, by_time, image, write_mcap
from scale import drive_streams, write_logs

from tcpipe import open_dataset
from tcpipe.formats.logs.writing import _sort_messages
from tcpipe.formats.object_storage import split_bucket
from tcpipe.formats.place import open_place
from tcpipe.pipeline.dataset.build import build_dataset
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.inspect import inspect
from tcpipe.recipe import Recipe

SIZE = 64
NEW = f"{time.time_ns():x}"
REQUESTS = ("get", "get_range", "put", "head", "list", "list_with_delimiter", "delete")


def timed(work):
    """Return wall and CPU seconds of a call, workers' included, and what it returned."""
    wall, cpu = time.perf_counter(), cpu_s()
    found = work()
    return time.perf_counter() - wall, cpu_s() - cpu, found


def cpu_s():
    return sum(of.ru_utime + of.ru_stime for of in map(resource.getrusage, (0, resource.RUSAGE_CHILDREN)))


def in_turns(turns, here, there):
    """Return the least wall and CPU seconds of two calls that take turns."""
    taken = [(timed(here)[:2], timed(there)[:2]) for _ in range(turns)]
    return [tuple(min(turn[side][n] for turn in taken) for n in range(2)) for side in range(2)]


def compare(what, here, there):
    walls, cpus = (
        f"{of[1]:.2f} s against {of[0]:.2f} s: {of[1] / of[0]:.2f} x" for of in zip(here, there, strict=True)
    )
    print(f"{what}: wall {walls}; CPU {cpus}", flush=True)


def compare_ingests(bucket, directory, turns=5):
    write_logs(directory, 1)
    log, number = min((directory / "hours").iterdir()), iter(range(1_000))
    shutil.rmtree(directory / "ingested", ignore_errors=True)

    def command(root):
        store = f"{root}/{NEW}-{next(number)}"
        arguments = ["ingest", log, "--store", store, "-q"]
        subprocess.run([sys.executable, "-m", "tcpipe", *arguments], check=True, stdout=subprocess.DEVNULL)

    command(directory / "ingested")
    here, there = in_turns(turns, lambda: command(directory / "ingested"), lambda: command(bucket))
    compare("ingest of twelve minutes into the bucket", here, there)
    asked = counted()
    ingest([log], store=f"{bucket}/{NEW}-counted", recipe=Recipe())
    once = asked["requests"]
    ingest(sorted((directory / "hours").iterdir())[1:3], store=f"{bucket}/{NEW}-counted", recipe=Recipe())
    print(f"requests: {once} of the first call, {(asked['requests'] - once) / 2:.1f} a log of the next, which has two")


def counted():
    """Count from now on the requests to the bucket, and the bytes that they fetch."""
    asked = Counter()

    def counting(name, function):
        def wrapped(*arguments, **keywords):
            asked["requests"] += 1
            found = function(*arguments, **keywords)
            if name.startswith("get"):
                asked["bytes"] += len(found) if name == "get_range" else found.range[1] - found.range[0]
            return found

        return wrapped

    for name in REQUESTS:
        setattr(obstore, name, counting(name, getattr(obstore, name)))
    return asked


def compare_builds(bucket, directory, samples=20_000):
    store, recipe = store_of(directory, samples).root, Recipe()
    there = f"{bucket}/{NEW}-store"
    open_place(there).put_files("", store)
    made = []

    def build(out, store):
        shutil.rmtree(out, ignore_errors=True)
        made.append(build_dataset(out, store=store, recipe=recipe, holdout="sample").path)

    numbers = iter(range(1_000))
    build(directory / "built", store)
    taken = in_turns(
        2 if samples < 500_000 else 1,
        lambda: build(directory / "built", store),
        lambda: build(f"{bucket}/{NEW}-ds-{next(numbers)}", there),
    )
    compare(f"build of {samples} samples from and to the bucket", *taken)
    local, remote = (open_dataset(path)["train"] for path in made[-2:])
    first = timed(lambda: epoch(remote))
    here, there = in_turns(3, lambda: epoch(local), lambda: epoch(remote))
    compare(f"shuffled epoch of {first[2]} samples, cached (first {first[0]:.1f} s)", here, there)


def epoch(split):
    return sum(len(batch[1]) for batch in split.batches(SIZE, shuffle=True, from_disk=True))


def ingest_camera(bucket, directory, gigabytes=1):
    drive = drive_streams()
    TYPES.update({stream.topic: stream.type_name for stream in drive})
    told = [(at, drive[index].topic, payload) for index, _, payload, at, _ in _sort_messages(drive, "cdr")]
    images = int((told[-1][0] - told[0][0]) / 1e9 * CAMERA_HZ)
    url = f"{bucket}/camera-{gigabytes}.mcap"
    bucket, name = split_bucket(url)
    store = obstore.store.from_url(bucket, client_options={"allow_http": True})
    with obstore.open_writer(store, name) as writer:
        write_mcap(
            Counting(writer),
            by_time(iter(told), random_images(told[0][0], images, gigabytes)),
            compression="zstd",
            camera_apart=True,
        )
    size, fetched, held = obstore.head(store, name)["size"], counted(), Counter()
    inspect(url, recipe=Recipe())
    looked = fetched["bytes"]
    local = directory / "of-camera"
    shutil.rmtree(local, ignore_errors=True)
    local.mkdir()
    os.environ |= {"TMPDIR": str(local), "TCPIPE_CACHE": str(local / "cache")}
    threading.Thread(target=watch, args=(local, held), daemon=True).start()
    wall, cpu, summary = timed(lambda: ingest([url], store=local / "store", recipe=Recipe()))
    (result,) = summary.results
    taken, memory = fetched["bytes"] - looked, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"log of {size / 1e9:.2f} GB with {images} images in chunks of their own: inspect fetched {looked / size:.3%} of it"
    )
    print(
        f"ingest fetched {taken / size:.2%} ({taken / 1e6:.0f} MB) in {wall:.1f} s, {cpu:.1f} s CPU: {result.run.segments} segments"
    )
    print(f"local disk at most {held['bytes'] / 1e6:.0f} MB, with the run itself; memory {memory / 1e3:.0f} MB")
    assert result.status == "done", result.problems
    obstore.delete(store, name)


def random_images(start_ns, count, gigabytes):
    rng, size = np.random.default_rng(0), int(gigabytes * 1e9 / count)
    for index in range(count):
        yield image(start_ns + index * (10**9 // CAMERA_HZ), np.frombuffer(rng.bytes(size), np.uint8))


def watch(directory, held):
    """Note the most room that files below a directory take."""
    while True:
        room = 0
        for path in directory.rglob("*"):
            try:
                room += path.stat().st_blocks * 512
            except OSError:
                continue
        held["bytes"] = max(held["bytes"], room)
        time.sleep(0.05)


class Counting:
    """A file that is written from its beginning to its end, and knows where it is."""

    def __init__(self, file):
        self.file, self.at = file, 0

    def write(self, data):
        """Write bytes."""
        self.at += len(data)
        return self.file.write(data)

    def tell(self):
        """Return how many bytes were written."""
        return self.at

    def flush(self):
        """Do nothing: parts go when they are large enough."""


if __name__ == "__main__":
    CASES = {"ingest": compare_ingests, "build": compare_builds, "camera": ingest_camera}
    CASES[sys.argv[1]](
        sys.argv[2].rstrip("/"), Path(sys.argv[3]), *map(float if sys.argv[1] == "camera" else int, sys.argv[4:])
    )
