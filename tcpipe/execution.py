"""Independent tasks side by side, in this process, local processes or a Dask cluster; a worker that dies costs only its own task.

What workers log is said here. Local ones end with this process, and at once when it is interrupted; a cluster's finish what they began.
The home of dask.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar, cast

from tcpipe import __version__
from tcpipe.errors import TcpipeError, UsageError
from tcpipe.progress import STEP, step_of

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")
R = TypeVar("R")

logger = logging.getLogger("tcpipe")

Said: TypeAlias = tuple[Any, ...]
"""Arguments of `Logger.log`."""

_LONGEST_SAYING_BYTES = 3000
"""Less than what a pipe takes in one piece: nothing is cut or mixed, whoever dies."""


@dataclass(frozen=True, slots=True)
class Outcome(Generic[R]):
    """What became of task ``index``: its result, or, when ``died``, nothing because its worker was killed."""

    index: int
    result: R | None
    died: bool = False


def unwrap_result(outcome: Outcome[R | TcpipeError]) -> R:
    """Return what a task gave that returns its error; raise that, or that its worker died."""
    if isinstance(outcome.result, TcpipeError):
        raise outcome.result
    if outcome.died:
        raise TcpipeError("a worker process died (killed, or out of memory); try fewer workers (--jobs)")
    return cast("R", outcome.result)


def run_all(
    function: Callable[[T], R], tasks: Sequence[T], *, jobs: int, cluster: str | None = None
) -> Generator[Outcome[R]]:
    """Yield the outcome of ``function(task)`` for every task, as each ends.

    ``function`` and tasks are picklable (workers are spawned); ``function`` returns its errors rather than raising them.
    Use it within ``contextlib.closing``: workers end when the iterator is closed.

    Parameters
    ----------
    jobs : processes; this one for 1.
    cluster : address of a Dask scheduler (``tcp://host:8786``), whose workers do it instead. They see the same files under the same names.

    Raises
    ------
    UsageError : there is no such scheduler, it has no workers, or they are not as they have to be.
    """
    if cluster is not None and tasks:
        yield from _run_on_cluster(function, tasks, cluster)
        return
    if jobs <= 1 or len(tasks) <= 1:
        for index, task in enumerate(tasks):
            yield Outcome(index, function(task))
        return
    waiting = list(range(len(tasks)))
    while waiting:
        suspects: list[int] = []
        yield from _run_until_broken(function, tasks, waiting, suspects, workers=min(jobs, len(waiting)))
        if suspects:
            logger.warning("a worker process died; the tasks that ran at the same time run again, one by one")
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
            logger.log(*heard.recv())


def _begin_worker(life: Connection, saying: Connection, level: int) -> None:
    """Prepare a worker: an interrupt is its parent's business, what it logs goes to its parent, and so does its life."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logger.addHandler(_LogForwarder(saying.send))
    logger.setLevel(level)
    logger.propagate = False
    threading.Thread(target=_end_with, args=(life,), daemon=True).start()


def _end_with(life: Connection) -> None:
    with suppress(EOFError, OSError):
        life.recv_bytes()
    os._exit(1)


class _LogForwarder(logging.Handler):
    """Hands what a worker logs to ``send``, as arguments of `Logger.log`: plain values, what is said as text of one argument."""

    def __init__(self, send: Callable[[Said], object]) -> None:
        super().__init__()
        self._send = send

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage().encode(errors="backslashreplace")[:_LONGEST_SAYING_BYTES].decode(errors="ignore")
        told = step_of(record)
        with suppress(OSError):
            self._send((record.levelno, "%s", text) if told is None else (STEP, str(record.msg), *astuple(told)))


_spent = {"cpu_s": 0.0}


def read_cluster_cpu_s() -> float:
    """Return the CPU seconds that clusters' workers spent on tasks of this process, as `resource.RUSAGE_CHILDREN` counts local ones."""
    return _spent["cpu_s"]


_ANSWER_S = 10
"""So long a scheduler has to answer."""
_ALONE_S = 300
"""So long it may be without a worker."""
_ADDRESS = re.compile(r"(tcp|tls)://[^/@]+:\d+")
_AHEAD = 2
"""Tasks that a worker is handed at once: the next waits beside it."""


def _run_on_cluster(function: Callable[[T], R], tasks: Sequence[T], address: str) -> Generator[Outcome[R]]:
    """Run the tasks on a cluster's workers; one that is killed has its task run again on another, three times."""
    from distributed import KilledWorker  # noqa: PLC0415  most calls stay on this machine

    with _connect_client(address) as client:
        channel, todo = _Channel(f"tcpipe-{client.id}", logger.getEffectiveLevel()), iter(range(len(tasks)))
        client.subscribe_topic(channel.topic, lambda event: logger.log(*event[1]))

        def submit(count: int) -> dict[Any, int]:
            at_once = islice(todo, count)
            return {
                client.submit(_run_on_worker, function, tasks[at], __version__, channel, pure=False): at
                for at in at_once
            }

        running = submit(_AHEAD * _count_workers(client, address))
        while running:
            for future in _wait_for_first(client, running, address):
                index = running.pop(future)
                try:
                    result, cpu_s = future.result()
                except KilledWorker:
                    yield Outcome(index, None, died=True)
                except ModuleNotFoundError as error:
                    raise UsageError(
                        f"{address}: a worker lacks {error.name}; install the same packages there as here"
                    ) from None
                except RuntimeError as error:
                    if "deserialization" not in str(error):
                        raise
                    raise UsageError(
                        f"{address}: the scheduler lacks tcpipe; install the same packages there as here"
                    ) from None
                else:
                    _spent["cpu_s"] += cpu_s
                    yield Outcome(index, result)
                running |= submit(1)


def _wait_for_first(client: Client, running: Iterable[Any], address: str) -> Sequence[Any]:
    """Return the tasks that have ended, when the first has; `TcpipeError` where the scheduler goes, or workers stay away."""
    from distributed import wait as wait_for  # noqa: PLC0415  as above

    said, alone_s = False, 0.0
    while alone_s < _ALONE_S:
        try:
            with client.as_current():
                return list(wait_for(list(running), timeout=_ANSWER_S, return_when=FIRST_COMPLETED).done)
        except TimeoutError:
            alone_s = 0.0 if client.nthreads() else alone_s + _ANSWER_S
        if alone_s and not said:
            logger.warning("%s: lost all its workers; waiting for one", address)
            said = True
    raise TcpipeError(f"{address}: had no workers for {_ALONE_S} s; start workers and run the same command again")


@contextmanager
def _connect_client(address: str) -> Iterator[Client]:
    try:
        from distributed import Client  # noqa: PLC0415  most calls stay on this machine
    except ImportError:
        raise UsageError("dask not installed, required for --cluster: pip install 'tcpipe[cluster]'") from None
    if not _ADDRESS.fullmatch(address):
        raise UsageError(f"{address!r}: no address of a scheduler; expected tcp://host:port or tls://host:port")
    with _mute_loggers("distributed", "distributed.client"):
        try:
            client = Client(address, timeout=_ANSWER_S, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise UsageError(f"{address}: no Dask scheduler answers ({reason}); start one: dask scheduler") from None
        try:
            with client:
                yield client
        except (OSError, CancelledError):
            raise TcpipeError(f"{address}: the scheduler stopped; start it and run the same command again") from None


@contextmanager
def _mute_loggers(*names: str) -> Iterator[None]:
    """Silence loggers, which tell a lost connection by a traceback."""
    levels = {name: logging.getLogger(name).level for name in names}
    try:
        for name in names:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


def _count_workers(client: Client, address: str) -> int:
    """Return the number of workers; `UsageError` where there is none, or one has several threads, no tcpipe, or another."""
    try:
        with suppress(TimeoutError):
            client.wait_for_workers(1, timeout=_ANSWER_S)
        if not client.nthreads():  # a cluster may be starting
            logger.warning("%s: has no workers yet; waiting for one", address)
        client.wait_for_workers(1, timeout=_ALONE_S)
    except TimeoutError:
        raise UsageError(
            f"{address}: the scheduler has no workers; start one: dask worker {address} --nthreads 1"
        ) from None
    threads = client.nthreads()
    if many := [worker for worker, count in threads.items() if count != 1]:
        raise UsageError(
            f"{many[0]}: has {threads[many[0]]} threads; expected one a worker: dask worker {address} --nthreads 1"
        )
    # Not a function of tcpipe: a worker that lacks it would end when it is handed one.
    for worker, version in client.run(eval, "__import__('tcpipe').__version__", on_error="return").items():
        if isinstance(version, ImportError):
            raise UsageError(f"{worker}: a worker lacks tcpipe ({version}); install the same packages there as here")
        if version != __version__ and isinstance(version, str):  # else it is gone again
            raise _make_cluster_error(worker, version, wanted=__version__)
    return len(threads)


def _make_cluster_error(worker: str, version: str, *, wanted: str) -> UsageError:
    return UsageError(f"{worker}: a worker has tcpipe {version}, expected {wanted} as here; install that")


@dataclass(frozen=True, slots=True)
class _Channel:
    """Where a cluster's workers say what they log, and from which level on."""

    topic: str
    level: int


def _run_on_worker(function: Callable[[T], R], task: T, version: str, channel: _Channel) -> tuple[R, float]:
    """Run a task on a cluster's worker; return its result and the CPU seconds that it took; what it logs goes to the client before."""
    from distributed import get_worker  # noqa: PLC0415  most calls stay on this machine

    if version != __version__:
        raise _make_cluster_error(os.uname().nodename, __version__, wanted=version)
    saying, began_s = _LogForwarder(partial(get_worker().log_event, channel.topic)), time.process_time()
    logger.addHandler(saying)
    logger.setLevel(channel.level)
    try:
        result = function(task)
        return result, time.process_time() - began_s
    finally:
        logger.removeHandler(saying)
