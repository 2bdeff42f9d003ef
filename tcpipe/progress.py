"""Progress as log records, so that worker processes and clusters forward it with their other records."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

STEP = 15
"""Level of progress records: below INFO, so that only a display shows them."""

_LONGEST_NAME = 200
_TEXT = "%s: %s, %d of %d"

logger = logging.getLogger("tcpipe")
_task: ContextVar[str] = ContextVar("task", default="")


@dataclass(frozen=True, slots=True)
class Step:
    """Progress of a task ("" is the command itself): its stage, and how much of that is done (bytes of a log)."""

    task: str
    stage: str
    done: int
    total: int
    """0 if unknown."""


@contextmanager
def set_task(task: str) -> Iterator[None]:
    """Attribute progress inside the context to this task."""
    before = _task.set(task[-_LONGEST_NAME:])
    try:
        yield
    finally:
        _task.reset(before)


def step(stage: str, done: int = 0, total: int = 0) -> None:
    """Log the progress of this thread's task."""
    logger.log(STEP, _TEXT, _task.get(), stage, done, total)


def step_of(record: logging.LogRecord) -> Step | None:
    """Return the progress in a record, None in any other."""
    if record.levelno == STEP and isinstance(record.args, tuple):
        return Step(*record.args)  # type: ignore[arg-type]
    return None


@dataclass(slots=True)
class Meter:
    """Logs the progress of one stage, percent by percent."""

    stage: str
    total: int
    _done: float = field(default=0.0, init=False)
    _told: float = field(default=0.0, init=False)

    def add(self, count: float) -> None:
        """Count finished work."""
        self._done += count
        if self._done - self._told >= self.total / 100:
            self._told = self._done
            step(self.stage, min(round(self._done), self.total), self.total)
