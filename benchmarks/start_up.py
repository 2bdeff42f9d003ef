"""Measure the start-up cost of a command, and the gain by a second worker.

Run by hand, on idle cores: ``python benchmarks/start_up.py [--quick]``. Each line is CPU time of a process (and of what
it starts) beside that of ``import numpy, pyarrow, numba`` in the same run, the least of some times: the floor that
nothing can go below. ``kernel`` is that floor with one cached kernel called, for which numba loads much more.
``ingest`` is a process that ingests half a minute of driving twice, less twice what the second time takes: what comes
before and beside the stages. Bytecode is kept, as installations do. The last lines are wall times of two logs of an
hour of driving, the least of some turns: with one worker against two, by two processes that are started at once, which
is what two cores of this machine can do, and by two workers of a Dask cluster, which were there before; ``--quick``
leaves them out.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
from dask_cluster import dask_cluster  # beside the tests
from scale import LOGS_PER_HOUR, drive_streams, later

from tcpipe.formats.logs.writing import MessageStream, write_mcap

KERNEL = """
import numpy as np, pyarrow
from tcpipe.geometry import polyline
polyline._compute_distance_m(np.zeros((2, 3)), np.ones((2, 3)), 0.05, 0.5, (0.0, 0.0))
"""
TWICE = """
import shutil, sys, time
from pathlib import Path
import tcpipe.cli
from tcpipe.pipeline.ingest import ingest
spent = []
for turn in "ab":
    began = time.process_time()
    assert ingest([sys.argv[1]], store=Path(sys.argv[2], turn)).exit_code == 0
    spent.append(time.process_time() - began)
    shutil.rmtree(Path(sys.argv[2], turn))
print(time.process_time() - 2 * spent[1])
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--turns", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        here = Path(name)
        log = simulated(here / "tiny", "tiny", 1)
        run("-m", "tcpipe", "ingest", log, "--store", here / "warm", "-q")  # compiles the kernels
        floor = min(cpu_s("-c", "import numpy, pyarrow, numba") for _ in range(options.turns))
        print(f"floor    {floor:5.2f} s  (import numpy, pyarrow, numba)")
        run("-c", KERNEL)
        cases = {
            "kernel": ("-c", KERNEL),
            "--help": ("-m", "tcpipe", "--help"),
            "inspect": ("-m", "tcpipe", "inspect", log),
            "nothing": ("-m", "tcpipe", "ingest", log, "--store", here / "warm", "-q"),
        }
        for case, command in cases.items():
            told(case, min(cpu_s(*command) for _ in range(options.turns)), floor)
        told("ingest", min(float(run("-c", TWICE, log, here / "again")) for _ in range(options.turns)), floor)
        if not options.quick:
            second_worker(here, options.turns)


def second_worker(here: Path, turns: int) -> None:
    logs = [long_log(here / f"hour-{number}.mcap", number) for number in range(2)]
    with dask_cluster(here) as cluster:
        ways = {"one": [[*logs, "--jobs", 1]], "two": [[*logs, "--jobs", 2]], "apart": [[log] for log in logs]}
        ways["dask"] = [[*logs, "--cluster", cluster.address]]
        wall_s: dict[str, list[float]] = {way: [] for way in ways}
        for turn in range(turns):
            for way, shares in ways.items():
                wall_s[way].append(wall_of(shares, here / f"{way}-{turn}"))
    one, two, apart, dask = (min(seconds) for seconds in wall_s.values())
    print(f"workers  {one:5.2f} s with one, {two:.2f} s with two: {one / two:.2f} x")
    print(f"apart    {apart:5.2f} s by two processes started at once: two workers take {two / apart:.2f} x that")
    turn_by_turn = ", ".join(f"{local / far:.2f}" for local, far in zip(wall_s["two"], wall_s["dask"], strict=True))
    print(
        f"dask     {dask:5.2f} s by two workers of a cluster: {two / dask:.2f} of the speed of two here; by turn {turn_by_turn}"
    )


def wall_of(shares: list[list[object]], here: Path) -> float:
    """Return the wall time of ingests that begin at once, each into a store of its own."""
    began = time.perf_counter()
    running = [
        subprocess.Popen(
            [sys.executable, "-m", "tcpipe", "ingest", *map(str, share), "--store", here / str(number), "-q"],
            stdout=subprocess.DEVNULL,
        )
        for number, share in enumerate(shares)
    ]
    codes = [process.wait() for process in running]
    assert codes == [0] * len(shares), codes
    return time.perf_counter() - began


def long_log(path: Path, number: int) -> Path:
    """Return a log of an hour of driving, half an hour between its parts: a task that takes long beside what is around it."""
    parts = [
        [later(stream, 1_800 * part, seed=LOGS_PER_HOUR * number + part) for part in range(LOGS_PER_HOUR)]
        for stream in drive_streams()
    ]
    write_mcap(path, [_joined(of) for of in parts])
    return path


def _joined(parts: list[MessageStream]) -> MessageStream:
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns}
    said = [part.publish_time_ns for part in parts if part.publish_time_ns is not None]
    at = np.concatenate([part.log_time_ns for part in parts])
    return replace(parts[0], columns=columns, log_time_ns=at, publish_time_ns=np.concatenate(said) if said else None)


def simulated(place: Path, scenario: str, seed: int) -> Path:
    run("-m", "tcpipe", "simulate", place, "--scenario", scenario, "--seed", seed, "-q")
    log = next((place / "logs").iterdir())
    return log.rename(log.with_stem(f"{log.stem}-{seed}"))


def told(case: str, seconds: float, floor: float) -> None:
    print(f"{case:<8} {seconds:5.2f} s  {seconds / floor:.2f} x the floor")


def cpu_s(*arguments: object) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run(*arguments)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run(*arguments: object) -> str:
    command = [sys.executable, *map(str, arguments)]
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return subprocess.run(command, capture_output=True, text=True, check=True, env=kept).stdout


if __name__ == "__main__":
    main()
