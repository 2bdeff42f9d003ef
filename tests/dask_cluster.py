"""A Dask cluster for tests: its scheduler and workers, each a process of its own, as the commands start them."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from distributed import Client

from tcpipe.formats.json_files import read_json
from tcpipe.progress import set_task, step

_LONGEST_S = 300.0
"""A machine that others use takes its time to start a process."""


@dataclass(slots=True)
class DaskCluster:
    """A scheduler's address, file and process, and its workers."""

    address: str
    file: Path
    scheduler: subprocess.Popen[bytes]
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start_worker(self, *, threads: int = 1) -> None:
        """Start one more worker, and wait until it is there."""
        how = ("--nthreads", str(threads), "--no-dashboard", "--local-directory", str(self.file.parent))
        self.workers.append(_started("worker", "--scheduler-file", str(self.file), *how))
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(sum(worker.poll() is None for worker in self.workers), timeout=_LONGEST_S)


def _started(*arguments: str) -> subprocess.Popen[bytes]:
    said, path = subprocess.DEVNULL, [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    malloc = {
        "MALLOC_MMAP_THRESHOLD_": "33554432",
        "MALLOC_TRIM_THRESHOLD_": "134217728",
    }  # docs/how-to/run-unattended.md#dask
    env = {**os.environ, **malloc, "PYTHONPATH": os.pathsep.join(filter(None, path))}  # the tasks below
    return subprocess.Popen([sys.executable, "-m", "dask", *arguments], stdout=said, stderr=said, env=env)


@contextmanager
def dask_cluster(directory: Path, *, workers: int = 2) -> Iterator[DaskCluster]:
    """Yield a running cluster; it is gone when the block ends."""
    file = directory / "scheduler.json"
    with ExitStack() as stack:
        local = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
        scheduler = _started("scheduler", *local)
        stack.callback(_ended, scheduler)
        end = time.monotonic() + _LONGEST_S
        while not file.exists() or not file.read_bytes().endswith(b"}"):
            assert scheduler.poll() is None
            assert time.monotonic() < end
            time.sleep(0.05)
        cluster = DaskCluster(read_json(file)["address"], file, scheduler)
        stack.callback(lambda: [_ended(worker) for worker in cluster.workers])
        for _ in range(workers):
            cluster.start_worker()
        yield cluster


def _ended(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def where(value: int) -> tuple[int, int]:
    """Return the square, and which process it is from."""
    with set_task(f"log {value}"):
        step("squaring")
    logging.getLogger("tcpipe").info("task %d", value)
    return value * value, os.getpid()


def die_once(mark: Path) -> int:
    """Kill the worker that comes first."""
    try:
        mark.touch(exist_ok=False)
    except FileExistsError:
        return os.getpid()
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def die(_: int) -> None:
    """Kill the worker."""
    os.kill(os.getpid(), signal.SIGKILL)


def wants_more(value: int) -> int:
    """Want a module that no worker has."""
    import nowhere_to_be_had  # type: ignore[import-not-found]

    return nowhere_to_be_had.task(value)  # type: ignore[no-any-return]


def spend(cpu_s: float) -> None:
    """Compute for so long."""
    end = time.process_time() + cpu_s
    while time.process_time() < end:
        pass
