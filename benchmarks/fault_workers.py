"""Kills a worker process before or after a chosen request that it makes to a bucket; counts the requests of all workers.

Processes that are started meanwhile load this: the environment leads to ``struck/sitecustomize.py``, and to a file with
the count.
"""

import fcntl
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_FILE = "FAULT_WORKERS"
"""Names the file: the step at which a worker is killed (0: at none), then a byte for each step there was."""
_HEAD = 9


@contextmanager
def lead_workers(file: Path) -> Iterator[None]:
    """Have processes that start meanwhile count their requests in a file."""
    paths = [str(Path(__file__).parent / "struck"), str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    os.environ |= {_FILE: str(file), "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    watch(0)
    try:
        yield
    finally:
        del os.environ[_FILE]
        os.environ["PYTHONPATH"] = paths[-1]


def watch(step: int) -> None:
    """Begin to count, and choose the step at which a worker is killed."""
    Path(os.environ[_FILE]).write_text(f"{step:08}\n")


def count_steps() -> int:
    """Return the number of steps; 0 if no process counts them."""
    file = os.environ.get(_FILE)
    return Path(file).stat().st_size - _HEAD if file else 0


def join_watch() -> None:
    """Count the requests of this process from now on, and die at the chosen step."""

    def step() -> None:
        with Path(os.environ[_FILE]).open("r+b") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            chosen = int(stream.readline())
            stream.write(b"." if stream.seek(0, os.SEEK_END) else b"")
            stream.flush()
            if stream.tell() - _HEAD == chosen:
                os.kill(os.getpid(), signal.SIGKILL)

    call_around_requests(step)


def call_around_requests(call: Callable[[], object]) -> None:
    """Have a function called before and after each request of this process that changes something in a bucket."""
    import obstore

    def wrap(act: Callable[..., object]) -> Callable[..., object]:
        def request(*args: object, **how: object) -> object:
            call()
            found = act(*args, **how)
            call()
            return found

        return request

    obstore.put, obstore.delete = wrap(obstore.put), wrap(obstore.delete)
