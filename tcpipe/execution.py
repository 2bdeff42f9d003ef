"""Independent tasks side by side, behind one ``concurrent.futures.Executor``; a worker that dies costs only its own task.

What workers log is said here. They end with this process, and at once when it is interrupted.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Generic, TypeVar

T = TypeVar("T")
R = TypeVar("R")

logger = logging.getLogger("tcpipe")

_LONGEST_SAYING_BYTES = 3000
"""Less than what a pipe takes in one piece: nothing is cut or mixed, whoever dies."""


@dataclass(frozen=True, slots=True)
class Outcome(Generic[R]):
    """What became of task ``index``: its result, or, when ``died``, nothing because its worker was killed."""

    index: int
    result: R | None
    died: bool = False


def run_all(function: Callable[[T], R], tasks: Sequence[T], *, jobs: int) -> Generator[Outcome[R]]:
    """Yield the outcome of ``function(task)`` for every task, as each ends; ``jobs`` processes, or this one for 1.

    ``function`` and tasks are picklable (workers are spawned); ``function`` returns its errors rather than raising them.
    Use it within ``contextlib.closing``: workers end when the iterator is closed.
    """
    if jobs <= 1 or len(tasks) <= 1:
        for index, task in enumerate(tasks):
            yield Outcome(index, function(task))
        return
    waiting = list(range(len(tasks)))
    while waiting:
        suspects: list[int] = []
        yield from _run_until_broken(function, tasks, waiting, suspects, workers=min(jobs, len(waiting)))
        if suspects:
            logger.warning("a worker process died; what ran beside it runs again, one by one")
        for index in suspects:  # one of those that ran when the pool broke killed it: each again, alone
            yield _run_alone(function, tasks[index], index)


def _run_until_broken(
    function: Callable[[T], R], tasks: Sequence[T], waiting: list[int], suspects: list[int], *, workers: int
) -> Iterator[Outcome[R]]:
    """Run the waiting tasks; on a broken pool leave what ran then in ``suspects`` and what had not begun in ``waiting``."""
    running: dict[Future[R], int] = {}
    with _pool(workers) as pool:
        while waiting or running:
            while waiting and len(running) < workers:
                try:
                    running[pool.submit(function, tasks[waiting[0]])] = waiting[0]
                except BrokenProcessPool:
                    if not running:
                        return
                    break
                del waiting[0]
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                index = running.pop(future)
                try:
                    yield Outcome(index, future.result())
                except BrokenProcessPool:
                    suspects.append(index)
            if suspects:
                suspects.extend(running.values())
                suspects.sort()
                return


def _run_alone(function: Callable[[T], R], task: T, index: int) -> Outcome[R]:
    with _pool(1) as pool:
        try:
            return Outcome(index, pool.submit(function, task).result())
        except BrokenProcessPool:
            return Outcome(index, None, died=True)


@contextmanager
def _pool(workers: int) -> Iterator[Executor]:
    """Yield worker processes that say here what they log and live no longer than this process wants them to."""
    context = multiprocessing.get_context("spawn")
    heard, saying = context.Pipe(duplex=False)
    life, alive = context.Pipe(duplex=False)
    listener = threading.Thread(target=_repeat, args=(heard,), daemon=True)
    listener.start()
    pool = ProcessPoolExecutor(
        workers, mp_context=context, initializer=_begin_worker, initargs=(life, saying, logger.getEffectiveLevel())
    )
    try:
        yield pool
    except BaseException:
        alive.close()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        for end in (saying, alive, life):
            end.close()
        listener.join()
        heard.close()


def _repeat(heard: Connection) -> None:
    """Log here what workers say, until the last of them is gone."""
    with suppress(EOFError):
        while True:
            level, text = heard.recv()
            logger.log(level, "%s", text)


def _begin_worker(life: Connection, saying: Connection, level: int) -> None:
    """Prepare a worker: an interrupt is its parent's business, what it logs goes to its parent, and so does its life."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logger.addHandler(_Saying(saying))
    logger.setLevel(level)
    logger.propagate = False
    threading.Thread(target=_end_with, args=(life,), daemon=True).start()


def _end_with(life: Connection) -> None:
    with suppress(EOFError, OSError):
        life.recv_bytes()
    os._exit(1)


class _Saying(logging.Handler):
    """Hands what a worker logs to its parent."""

    def __init__(self, saying: Connection) -> None:
        super().__init__()
        self._saying = saying

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage().encode(errors="backslashreplace")[:_LONGEST_SAYING_BYTES].decode(errors="ignore")
        with suppress(OSError):
            self._saying.send((record.levelno, text))
