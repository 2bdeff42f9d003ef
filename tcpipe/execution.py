"""Independent tasks in this process, local processes or on a cluster; a worker that dies loses only its own task.

This process logs the messages of its workers. Local workers end with it, and at once on interruption; a cluster's
finish their tasks.
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
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass, field
from itertools import chain, islice
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext, SpawnProcess
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar, cast

from tcpipe import __version__
from tcpipe.errors import TcpipeError, UsageError, clean_line
from tcpipe.progress import STEP, logger, step_of

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")
R = TypeVar("R")

Said: TypeAlias = tuple[Any, ...]
"""Arguments of `Logger.log`."""

_LONGEST_SAYING_BYTES = 3000  # longest message [byte]: a pipe writes it in one piece, even if a process dies


@dataclass(frozen=True, slots=True)
class Outcome(Generic[R]):
    """Outcome of task ``index``: its result; None if its worker was killed (``died``)."""

    index: int
    result: R | None
    died: bool = False


def unwrap_result(outcome: Outcome[R | TcpipeError]) -> R:
    """Return the result of a task; raise the error that it returned, or that its worker died."""
    if isinstance(outcome.result, TcpipeError):
        raise outcome.result
    if outcome.died:
        raise TcpipeError("a worker process died (killed, or out of memory); try fewer workers (--jobs)")
    return cast("R", outcome.result)


def run_all(
    function: Callable[[T], R], tasks: Iterable[T], *, jobs: int, cluster: str | None = None
) -> Generator[Outcome[R]]:
    """Yield each outcome of ``function(task)`` as it ends; a task is requested when a worker is free for it.

    ``function`` and tasks are picklable (workers are spawned); ``function`` returns errors instead of raising them.
    Use it within ``contextlib.closing``: workers end when the iterator is closed.

    With ``cluster``, the address of a Dask scheduler, its workers replace ``jobs`` processes. They see the same files
    under the same names. `UsageError`: there is no such scheduler, it has no workers, or one of them has several
    threads or another tcpipe.
    """
    refuse_import_of_script(jobs)
    todo = enumerate(tasks)
    first = list(islice(todo, 1 + (jobs > 1)))
    if first and cluster is not None:
        yield from _run_elsewhere(function, chain(first, todo), cluster)
    elif jobs > 1 and len(first) > 1:
        yield from _run_in_pools(function, chain(first, todo), jobs)
    else:
        for index, task in chain(first, todo):
            yield Outcome(index, function(task))


_WORKER = "tcpipe worker"
_UNGUARDED_EXIT = 78  # exit code of a worker that ran the calls of its script again, EX_CONFIG of sysexits.h
_UNGUARDED = (
    "a script that uses several workers needs a main guard, because each worker imports the script: "
    "put its calls below "
    "'if __name__ == \"__main__\":', or use jobs=1"
)


def refuse_import_of_script(jobs: int) -> None:
    """Raise an error in a process that imports its parent's script and so repeats the parent's call with ``jobs``.

    A worker of tcpipe ends silently: its parent raises the `UsageError`.
    """
    process = multiprocessing.current_process()
    if jobs > 1 and getattr(process, "_inheriting", False):  # as multiprocessing itself finds out
        raise SystemExit(_UNGUARDED_EXIT) if process.name == _WORKER else UsageError(_UNGUARDED)


class _WorkerContext(SpawnContext):
    """Context that spawns workers named after this process; `workers` are all of them."""

    def __init__(self) -> None:
        self.workers = list[SpawnProcess]()

    def Process(self, **options: Any) -> SpawnProcess:  # type: ignore[override]  # noqa: N802  a class there
        self.workers.append(SpawnProcess(name=_WORKER, **options))
        return self.workers[-1]


def _run_in_pools(function: Callable[[T], R], todo: Iterator[tuple[int, T]], jobs: int) -> Iterator[Outcome[R]]:
    """Run tasks in local processes; those of a broken pool run again, one by one, before another pool continues."""
    while first := next(todo, None):
        todo, running, suspects = chain([first], todo), dict[Future[R], tuple[int, T]](), list[tuple[int, T]]()
        with _pool(jobs) as pool:
            while not suspects:
                for new in islice(todo, jobs - len(running)):
                    try:
                        running[pool.submit(function, new[1])] = new
                    except BrokenProcessPool:
                        todo = chain([new], todo)
                        break
                if not running:
                    break
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    ended = running.pop(future)
                    try:
                        yield Outcome(ended[0], future.result())
                    except BrokenProcessPool:
                        suspects.append(ended)
        if suspects:
            logger.warning("a worker process died; the tasks that ran at the same time run again, one by one")
        for index, task in sorted([*suspects, *running.values()], key=itemgetter(0)):  # one of these tasks killed it
            yield _run_alone(function, task, index)


def _run_alone(function: Callable[[T], R], task: T, index: int) -> Outcome[R]:
    with _pool(1) as pool:
        try:
            return Outcome(index, pool.submit(function, task).result())
        except BrokenProcessPool:
            return Outcome(index, None, died=True)


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Yield worker processes that send their log lines here and end with this block."""
    context = _WorkerContext()
    log_in, log_out = context.Pipe(duplex=False)
    child, parent = context.Pipe(duplex=False)
    listener = threading.Thread(target=_repeat, args=(log_in,), daemon=True)
    listener.start()
    pool = ProcessPoolExecutor(
        workers, mp_context=context, initializer=_begin_worker, initargs=(child, log_out, logger.getEffectiveLevel())
    )
    try:
        yield pool
    except BaseException:
        parent.close()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        for end in (log_out, parent, child):
            end.close()
        listener.join()
        log_in.close()
    if any(worker.exitcode == _UNGUARDED_EXIT for worker in context.workers):
        raise UsageError(_UNGUARDED)


def _repeat(log_in: Connection) -> None:
    """Log the messages of workers here, until the last worker ends."""
    with suppress(EOFError):
        while True:
            logger.log(*log_in.recv())


def _begin_worker(child: Connection, log_out: Connection, level: int) -> None:
    """Prepare a worker: it ignores interrupts, ends with its parent, and sends its log messages to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logger.addHandler(_LogForwarder(log_out.send))
    logger.setLevel(level)
    logger.propagate = False
    threading.Thread(target=_end_with, args=(child,), daemon=True).start()


def _end_with(child: Connection) -> None:
    with suppress(EOFError, OSError):
        child.recv_bytes()
    os._exit(1)


class _LogForwarder(logging.Handler):
    """Handler that passes a worker's records to ``send`` as plain values for `Logger.log`, the message as text."""

    def __init__(self, send: Callable[[Said], None]) -> None:
        super().__init__()
        self._send = send

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage().encode(errors="backslashreplace")[:_LONGEST_SAYING_BYTES].decode(errors="ignore")
        step = step_of(record)
        with suppress(OSError):
            self._send((record.levelno, "%s", text) if step is None else (STEP, str(record.msg), *astuple(step)))


_spent = {"cpu_s": 0.0}


def read_cluster_cpu_s() -> float:
    """Return CPU seconds of cluster workers on tasks of this process, as `resource.RUSAGE_CHILDREN` for local ones."""
    return _spent["cpu_s"]


_ANSWER_S = 10  # longest wait for an answer of a scheduler, and for the first worker of a cluster [s]
_ALONE_S = 300  # longest time for which a cluster may have no workers [s]
_ADDRESS = re.compile(r"(tcp|tls)://[^/@]+:\d+")
_AHEAD = 2  # tasks that a worker gets at the same time: one runs, the next one waits


@dataclass(slots=True)
class _Workers:
    """The workers of a Dask scheduler, its address, and the number of tasks in flight."""

    client: Client
    address: str
    at_once: int
    alone_s: float = 0.0

    def wait_for_first(self, running: Iterable[Future[R]]) -> set[Future[R]]:
        """Return the tasks that have ended, when the first has; `TcpipeError` if all workers stay away."""
        while not (ended := wait(running, timeout=_ANSWER_S, return_when=FIRST_COMPLETED).done):
            self._check_workers()
        return ended

    def _check_workers(self) -> None:
        if self.client.nthreads():
            self.alone_s = 0.0
        elif self.alone_s >= _ALONE_S:
            raise TcpipeError(
                f"{self.address}: had no workers for {_ALONE_S} s; start workers and run the same command again"
            )
        else:
            if not self.alone_s:
                logger.warning(
                    "%s: lost all its workers; waiting for one (dask worker ADDRESS --nthreads 1)", self.address
                )
            self.alone_s += _ANSWER_S


def _run_elsewhere(function: Callable[[T], R], todo: Iterator[tuple[int, T]], cluster: str) -> Generator[Outcome[R]]:
    """Run tasks on a cluster, which runs that of a killed worker again on another, three times."""
    running = dict[Future[_Answer[R]], int]()
    with _connect_client(cluster) as client:
        workers, executor = _Workers(client, cluster, _AHEAD * _count_workers(client, cluster)), client.get_executor()
        level = logger.getEffectiveLevel()
        try:
            while True:
                for index, task in islice(todo, workers.at_once - len(running)):
                    running[executor.submit(_run_on_worker, function, task, level, __version__)] = index
                if not running:
                    return
                for future in workers.wait_for_first(running):
                    yield _get_outcome(future, running.pop(future), cluster)
        finally:
            for future in running:  # cancel tasks that have not begun
                future.cancel()


def _get_outcome(future: Future[_Answer[R]], index: int, name: str) -> Outcome[R]:
    """Return the outcome of a task after logging its messages; `UsageError` for workers that do not qualify."""
    try:
        answer = future.result()
    except (TcpipeError, CancelledError):
        raise
    except ModuleNotFoundError as error:
        raise UsageError(f"{name}: a worker lacks {error.name}; install the same packages there as here") from None
    except Exception as error:  # noqa: BLE001  tasks return their errors: this one is the executor's
        if "deserialization" in str(error):
            raise UsageError(f"{name}: the scheduler lacks tcpipe; install the same packages there as here") from None
        reason = clean_line(f"{type(error).__name__}: {'; '.join(str(error).splitlines())}")
        logger.warning("%s: a task ended without a result (%s)", name, reason[:_LONGEST_SAYING_BYTES])
        return Outcome(index, None, died=True)
    for said in answer.said:
        logger.log(*said)
    _spent["cpu_s"] += answer.cpu_s
    return Outcome(index, answer.result)


@contextmanager
def _convert_stop(name: str) -> Iterator[None]:
    try:
        yield
    except (OSError, CancelledError):
        raise TcpipeError(f"{name}: the scheduler stopped; start it and run the same command again") from None


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
        with _convert_stop(address), client:
            yield client


@contextmanager
def _mute_loggers(*names: str) -> Iterator[None]:
    """Silence loggers, which report a lost connection by a traceback."""
    levels = {name: logging.getLogger(name).level for name in names}
    try:
        for name in names:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


def _count_workers(client: Client, address: str) -> int:
    """Return the number of workers; `UsageError` without any, or with several threads, no tcpipe or another version."""
    start = f"dask worker {address} --nthreads 1"
    try:
        client.wait_for_workers(1, timeout=_ANSWER_S)
    except TimeoutError:
        raise UsageError(f"{address}: the scheduler has no workers after {_ANSWER_S} s; start one: {start}") from None
    threads = client.nthreads()
    if many := [worker for worker, count in threads.items() if count != 1]:
        raise UsageError(f"{many[0]}: has {threads[many[0]]} threads; expected one thread per worker: {start}")
    # Not a function of tcpipe: a worker that lacks it would end when it is handed one.
    for worker, version in client.run(eval, "__import__('tcpipe').__version__", on_error="return").items():
        if isinstance(version, ImportError):
            raise UsageError(f"{worker}: a worker lacks tcpipe ({version}); install the same packages there as here")
        if version != __version__ and isinstance(version, str):  # otherwise the scheduler forgets it
            raise _make_cluster_error(worker, version, wanted=__version__)
    return len(threads)


def _make_cluster_error(worker: str, version: str, *, wanted: str) -> UsageError:
    return UsageError(f"{worker}: a worker has tcpipe {version}, expected {wanted} as here; install that")


@dataclass(frozen=True, slots=True)
class _Answer(Generic[R]):
    """Result of a task, its CPU seconds, and its log records."""

    result: R
    cpu_s: float = 0.0
    said: list[Said] = field(default_factory=list)


def _run_on_worker(function: Callable[[T], R], task: T, level: int, version: str) -> _Answer[R]:
    """Run a task on a worker, which must have the caller's version, and forward its log messages above a level."""
    if version != __version__:
        raise _make_cluster_error(os.uname().nodename, __version__, wanted=version)
    said, began_s, before = list[Said](), time.process_time(), (logger.handlers, logger.level)
    logger.handlers = [_LogForwarder(said.append)]
    logger.setLevel(level)
    try:
        result = function(task)
    finally:
        logger.handlers = before[0]
        logger.setLevel(before[1])
    return _Answer(result, time.process_time() - began_s, said)
