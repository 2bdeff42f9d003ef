"""A process that is safe to schedule: standard files that are closed, signals that ask it to end."""

from __future__ import annotations

import os
import signal
import sys


class Ended(BaseException):
    """A signal asks this process to end; raised where it runs, so that workers end and temporaries go."""

    def __init__(self, number: int) -> None:
        super().__init__(f"ended by {signal.Signals(number).name}")
        self.exit_code = 128 + number


def prepare_process() -> None:
    """Open standard files that are closed, print what is no text as escapes, and end in order on SIGTERM and SIGHUP."""
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


def _end(number: int, _: object) -> None:
    raise Ended(number)


def _raise_again(unraisable: sys.UnraisableHookArgs) -> None:
    """Where a signal came in a place that swallows errors (a destructor, a callback), let it come again."""
    error = unraisable.exc_value
    if not isinstance(error, Ended | KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return

    def raise_it(_: int, __: object) -> None:
        raise error

    signal.signal(signal.SIGALRM, raise_it)
    signal.setitimer(signal.ITIMER_REAL, 0.01)
