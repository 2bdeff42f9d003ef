"""Measure the cost of more hours of driving, and extrapolate to 100,000 hours and 10⁹ samples.

    python benchmarks/scale.py hours DIRECTORY [HOURS] [JOBS] [SCENARIO]   write that many hours of logs, and ingest them by one call
    python benchmarks/scale.py memory LOG [LOG ...]              the most memory that ingesting each log takes, and its CPU
    python benchmarks/scale.py paper                             what follows from the table of docs/internals/performance.md

One simulated drive of twelve minutes (or that of another scenario) is repeated at later times with new noise.
CPU is that of the process and its workers, memory the largest of the calling process at any time.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from tcpipe.pipeline.ingest import IngestResult, ingest
from tcpipe.recipe import Recipe

if TYPE_CHECKING:
    from tcpipe.formats.logs.writing import MessageStream

HOURS, SAMPLES, CORES, MEMORY_GB = 100_000, 10**9, 64, 256
LOGS_PER_HOUR = 5
NAME = "drive_{:04d}.mcap"
MOST_HZ = 50
SCENARIO = "hills12"
"""Drive that is repeated by default: twelve minutes over hills."""
SMALL = 1e-4
"""Noise of a repeated value over its spread [1]: another measurement of the same drive."""


def write_logs(directory: Path, hours: int, scenario: str = SCENARIO) -> list[Path]:
    """Return logs of so many hours; those that are not there yet are written, at ten CPU seconds an hour."""
    from tcpipe.formats.logs.writing import write_mcap

    paths = [directory / "hours" / NAME.format(number) for number in range(hours * LOGS_PER_HOUR)]
    paths[0].parent.mkdir(parents=True, exist_ok=True)
    drive = [] if all(path.exists() for path in paths) else drive_streams(scenario)
    for number, path in enumerate(paths):
        if not path.exists():
            write_mcap(path, [later(stream, 1_800 * number, seed=number) for stream in drive])
    return paths


def drive_streams(scenario: str = SCENARIO) -> list[MessageStream]:
    """Return what is recorded of the drive, at most `MOST_HZ` of each topic: hours are to be had in minutes."""
    from tcpipe.simulation.scenarios import find_scenario
    from tcpipe.simulation.site_files import simulate_messages

    return [thinned(stream) for stream in simulate_messages(find_scenario(scenario))[1]]


def thinned(stream: MessageStream) -> MessageStream:
    at = stream.log_time_ns
    each = slice(None, None, max(round(at.size / np.ptp(at) * 1e9 / MOST_HZ), 1) if at.size > 1 else 1)
    said = None if stream.publish_time_ns is None else stream.publish_time_ns[each]
    columns = {name: values[each] for name, values in stream.columns.items()}
    return replace(stream, log_time_ns=at[each], publish_time_ns=said, columns=columns)


def later(stream: MessageStream, seconds: int, *, seed: int) -> MessageStream:
    """Return a stream as it would be said later, with noise of its own."""
    rng, columns = np.random.default_rng(seed), dict(stream.columns)
    for name, values in columns.items():
        if name.endswith("stamp.sec"):
            columns[name] = (values + seconds).astype(values.dtype)
        elif values.dtype.kind == "f":
            columns[name] = values + SMALL * np.nanstd(values) * rng.standard_normal(values.shape).astype(values.dtype)
    at = stream.log_time_ns + seconds * 10**9
    said = None if stream.publish_time_ns is None else stream.publish_time_ns + seconds * 10**9
    return replace(stream, columns=columns, log_time_ns=at, publish_time_ns=said)


def ingest_hours(directory: Path, hours: int = 20, jobs: int = 2, scenario: str = SCENARIO) -> None:
    """Ingest that many hours, and print what each took."""
    with ProcessPoolExecutor(
        1, mp_context=get_context("spawn")
    ) as other:  # whose memory is not that of the process that is measured
        paths, store = (
            other.submit(write_logs, directory, hours, scenario).result(),
            directory / f"store-of-{hours}-hours",
        )
    shutil.rmtree(store, ignore_errors=True)
    results, marks = list[IngestResult](), list[float]()

    def ended(result: IngestResult) -> None:
        results.append(result)
        if len(results) % LOGS_PER_HOUR == 0:
            marks.append(cpu_s())

    began, cpu = time.perf_counter(), cpu_s()
    summary = ingest(paths, store=store, recipe=Recipe(), jobs=jobs, on_result=ended)
    assert {result.status for result in summary.results} == {"done"}, summary.results[0].problems
    assert len({result.run.run_id for result in results}) == len(paths)
    each, wall = np.diff(marks), time.perf_counter() - began
    middle, half = median(each), len(each) // 2
    flat = f"{each.min() / middle - 1:+.1%} to {each.max() / middle - 1:+.1%}"
    room = sum(path.stat().st_size for path in store.rglob("*") if path.is_file())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"{hours} h in {len(paths)} logs by one call with {jobs} workers: {middle:.2f} s CPU an hour, {flat}")
    print(f"the last half against the first: {each[half:].mean() / each[:half].mean():.3f} x; wall {wall:.0f} s")
    print(
        f"the first hour, with the workers' start, {marks[0] - cpu:.2f} s; what follows the last log {cpu_s() - marks[-1]:.2f} s"
    )
    print(
        f"memory of the calling process {memory / 1e3:.0f} MB; an hour takes {room / hours / 1e6:.1f} MB of the store"
    )
    print(f"an hour has {sum(result.run.segments for result in results) / hours:.0f} segments")


def print_memory(logs: Sequence[str]) -> None:
    """Ingest each log by a command of its own, and print the most memory that it took and its CPU seconds."""
    for log in logs:
        with tempfile.TemporaryDirectory() as store:
            command = [sys.executable, "-m", "tcpipe", "ingest", log, "--store", f"{store}/store", "--quiet"]
            child = subprocess.Popen(command)
            _, status, used = os.wait4(child.pid, 0)
        assert not status, f"{log}: the command failed"
        print(f"{log}: {used.ru_maxrss / 1024:.0f} MiB at most, {used.ru_utime + used.ru_stime:.1f} s CPU")


def cpu_s() -> float:
    """Return CPU seconds of this process and of its children that live or were waited for."""
    ticks = 0
    for task in Path("/proc/self/task").iterdir():
        for child in (task / "children").read_text().split():
            ticks += sum(map(int, Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[11:13]))
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime + ticks / os.sysconf("SC_CLK_TCK")


def on_paper(of: Mapping[str, float]) -> list[tuple[str, str, str]]:
    """Return what each step takes at `HOURS` and `SAMPLES`, and where a machine of `CORES` and `MEMORY_GB` ends, from measured figures."""
    logs = HOURS * of["logs_an_hour"]
    night_s = logs * (of["night_ms"] + of["names_a_log"] / 1_000 * of["listing_ms"]) / 1e3
    state_gb, build_gb = logs * of["state_kb_a_log"] / 1e6, SAMPLES * of["build_bytes_a_sample"] / 1e9
    ingest_h, build_h = HOURS * of["ingest_s_an_hour"] / 3_600, SAMPLES * of["build_us_a_sample"] / 3.6e9
    dataset_tb, epoch_s = SAMPLES * of["dataset_bytes_a_sample"] / 1e12, SAMPLES / of["epoch_a_core"]
    return [
        (
            "ingest",
            f"{ingest_h:,.0f} core hours, {ingest_h / CORES:,.0f} h on {CORES} cores",
            "no end: a log is a task",
        ),
        ("the store", f"{HOURS * of['store_mb_an_hour'] / 1e6:.1f} TB", "no end: a bucket"),
        (
            "a night with nothing new",
            f"{night_s / 60:,.0f} min for {logs:,.0f} logs",
            f"an hour at {HOURS * 3_600 / night_s:,.0f} hours",
        ),
        (
            "the state of the store in memory",
            f"{state_gb:.1f} GB",
            f"{MEMORY_GB} GB at {HOURS * MEMORY_GB / state_gb:,.0f} hours",
        ),
        (
            "build: CPU",
            f"{build_h:,.0f} core hours, {build_h / CORES:,.1f} h on {CORES} cores",
            f"a day at {SAMPLES * 24 * CORES / build_h:,.0f} samples",
        ),
        (
            "build: memory of the caller",
            f"{build_gb:,.0f} GB",
            f"{MEMORY_GB} GB at {SAMPLES * MEMORY_GB / build_gb:,.0f} samples",
        ),
        ("build: local disk", f"{dataset_tb:.1f} TB", "its disk"),
        (
            "a shuffled epoch",
            f"{epoch_s / 3_600:.1f} core hours, {epoch_s / 60 / CORES:.0f} min on {CORES} cores",
            "no end: parts",
        ),
    ]


def print_extrapolation(page: Path) -> None:
    """Print what follows from the figures in the first table of the page."""
    found = re.findall(r"(?m)^\| `(\w+)` \| ([\d.,]+) \|", page.read_text())
    print(f"{'step':<34} {'at 100,000 hours and 10⁹ samples':<36} one machine ends")
    for step, size, end in on_paper({name: float(value.replace(",", "")) for name, value in found}):
        print(f"{step:<34} {size:<36} {end}")


def main(what: str, arguments: Sequence[str]) -> None:
    if what == "hours":
        ingest_hours(Path(arguments[0]), *map(int, arguments[1:3]), *arguments[3:])
    elif what == "memory":
        print_memory(arguments)
    else:
        print_extrapolation(Path(__file__).parents[1] / "docs" / "internals" / "performance.md")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
