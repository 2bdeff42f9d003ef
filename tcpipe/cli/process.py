"""A process that is safe to schedule: standard files that are closed, signals that ask it to end."""

from __future__ import annotations

import gc
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from tcpipe.cli.output import print_failure

NOTHING_HALF = "nothing is half-written; run the same command again"
_LATEST_S = 4.0
"""So long a process has to end in order: a library that waits for a network or computes lets no signal through to Python."""


class Terminated(BaseException):
    """A signal asks this process to end; raised where it runs, so that workers and temporary files are cleaned up."""

    def __init__(self, number: int) -> None:
        super().__init__(f"ended by {signal.Signals(number).name}")
        self.exit_code = 128 + number


def prepare_process() -> None:
    """Open standard files that are closed, print what is no text as escapes, and end in order on SIGTERM and SIGHUP.

    Linear algebra gets one thread, unless the environment says otherwise: matrices here are small, more threads only wait for each other,
    and bytes would depend on their number. Objects that refer to each other are looked for a seventieth as often as Python does by itself:
    while numba compiles, that was a tenth of the time.
    """
    gc.set_threshold(50_000)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    while (opened := os.open(os.devnull, os.O_RDWR)) <= 2:  # else a data file could become standard error
        pass
    os.close(opened)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123
        getattr(sys, name).reconfigure(errors="backslashreplace")
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup
            signal.signal(number, _end)
    sys.unraisablehook = _raise_again


@contextmanager
def terminate_on_signal() -> Iterator[None]:
    """End this process on a signal even inside a library that ignores it; the next call removes what remains."""
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    before = signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(read_end,), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(write_end)


def _watch(read_end: int) -> None:
    """Wait for a signal, and then for the other end to be closed, but not too long."""
    end, ending, left_s = 0.0, 0, None
    while select.select([read_end], [], [], left_s)[0]:
        if not (received := os.read(read_end, 1)):
            os.close(read_end)
            return
        if not ending and received[0] in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            end, ending = time.monotonic() + _LATEST_S, received[0]
        left_s = max(0.0, end - time.monotonic()) if ending else None
    print_failure([f"{Terminated(ending)}; {NOTHING_HALF}"], 128 + ending, as_json="--json" in sys.argv)
    os._exit(128 + ending)


def _end(number: int, _: object) -> None:
    raise Terminated(number)


def _raise_again(unraisable: sys.UnraisableHookArgs) -> None:
    """Where a signal came in a place that swallows errors (a destructor, a callback), let it come again."""
    error = unraisable.exc_value
    if not isinstance(error, Terminated | KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return

    def raise_it(_: int, __: object) -> None:
        raise error

    signal.signal(signal.SIGALRM, raise_it)
    signal.setitimer(signal.ITIMER_REAL, 0.01)
