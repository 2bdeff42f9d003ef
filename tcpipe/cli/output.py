"""Output of commands: progress on stderr, results on stdout. Only this module of `tcpipe` prints, and escapes names."""

from __future__ import annotations

import json
import logging
import sys
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

import click

from tcpipe.errors import clean_line, hide_secrets
from tcpipe.progress import STEP, Step, step_of

if TYPE_CHECKING:
    import rich.progress
    from rich.console import Console


def find_recipe_with_source(explicit: str | None) -> tuple[Path | None, str]:
    """Return the file of the active recipe, None for the defaults, and the recipe's source, for printing."""
    from tcpipe.formats.recipe_toml import find_recipe

    path = find_recipe(None if explicit is None else Path(explicit), Path.cwd())
    return path, "built-in defaults" if path is None else str(path)


@contextmanager
def show_progress(what: str, *, quiet: bool, as_json: bool = False) -> Iterator[Progress]:
    """Show progress on stderr: bars on a terminal, else lines, none with ``quiet``; with ``--debug`` only its log."""
    debugging = logging.getLogger("tcpipe").isEnabledFor(logging.DEBUG)
    shown = Progress(what, quiet=quiet, console=None if quiet or debugging else _open_terminal(as_json=as_json))
    with nullcontext() if debugging else _listen(_Lines(shown), logging.ERROR if quiet else STEP), shown:
        yield shown


@contextmanager
def _listen(handler: logging.Handler, level: int) -> Iterator[None]:
    """Give a handler the messages of the package from ``level`` on."""
    logger = logging.getLogger("tcpipe")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def _open_terminal(*, as_json: bool) -> Console | None:
    """Return stderr where it is a terminal that can draw bars, and no JSON goes to it."""
    if not sys.stderr.isatty() or (as_json and sys.stdout.isatty()):
        return None
    from rich.console import Console

    console = Console(stderr=True)
    return console if console.is_terminal and not console.is_dumb_terminal else None


NEXT_STEP = "tcpipe.next_step"
"""Key in click's context of the advice after a command, if it depends on the result."""

_LONGEST_NAME = 40


class Progress:
    """Lines on stderr; on a terminal ``console`` also a bar of all logs and the last reported step, until the end."""

    def __init__(self, what: str, *, quiet: bool, console: Console | None) -> None:
        self._what = what
        self._quiet = quiet
        self._stages: dict[str, str] = {}
        self._sizes: Mapping[str, int] = {}
        self._waiting, self._done, self._begun_s = 0, 0, time.monotonic()
        self._part: int | None = None
        self._stage_begun = 0.0
        self._bars: rich.progress.Progress | None = None
        if console is None:
            return
        from rich import progress as bars

        texts = (bars.TextColumn(f"{{task.{name}}}", markup=False) for name in ("description", "fields[said]"))
        columns = (next(texts), bars.BarColumn(24), *texts)
        self._bars = bars.Progress(
            *columns, console=console, transient=True, redirect_stdout=False, refresh_per_second=4
        )
        self._all = self._bars.add_task(clean_line(what), total=None, said="")

    def __enter__(self) -> Self:
        """Show the bars."""
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bars."""
        if self._bars is not None:
            self._bars.stop()

    def line(self, text: str) -> None:
        """Print one line."""
        if not self._quiet:
            self._print(text)

    def problem(self, *lines: str) -> None:
        """Print an error, also if progress is off."""
        for text in lines:
            self._print(f"tcpipe: {text}")

    def result(self, text: str) -> None:
        """Print a line of the result on stdout, above the bars where both are on one terminal."""
        if self._bars is not None and sys.stdout.isatty():
            self._print(text)
        else:
            print_line(text)

    def note(self, text: str, *, as_json: bool) -> None:
        """Print a line that is no result, with JSON on stderr; continue if the reader has ended."""
        with suppress(OSError):
            (self.line if as_json else self.result)(text)

    def _print(self, text: str) -> None:
        with suppress(OSError):  # continue without a reader
            if self._bars is not None:
                self._bars.console.print(clean_line(text), markup=False, highlight=False, soft_wrap=True)
            else:
                print_line(text, err=True)

    def expect(self, sizes: Mapping[str, int]) -> None:
        """Begin with logs of these sizes [byte]."""
        if self._bars is not None:
            self._sizes, self._waiting = sizes, sum(sizes.values())
            self._bars.update(self._all, total=len(sizes), said=f"0/{len(sizes)}")

    def begin_part(self, number: int, total: int, text: str) -> None:
        """Fill the bar to part ``number`` of ``total``; each stage fills half of its rest. Without bars, a line."""
        if self._bars is None:
            self.line(text)
        else:
            self._part = number
            self._stages.clear()
            self._bars.update(self._all, total=total, completed=number, said=text)

    def step(self, step: Step) -> None:
        """Show how far a log or the command is; without bars a line at each stage of a log, or tenth of the command."""
        if self._bars is not None and self._part is not None:
            if self._stages.get("") != step.stage:
                self._stages[""], self._stage_begun = step.stage, self._bars.tasks[0].completed
            share = 0.5 * step.done / step.total if step.total else 0.0
            completed = self._stage_begun + share * (self._part + 1 - self._stage_begun)
            self._bars.update(self._all, completed=completed, said=step.stage)
        elif self._bars is not None and step.task:
            name = clean_line(step.task.rsplit("/", 1)[-1])[-_LONGEST_NAME:]
            size = f" {_format_megabytes(step.done)} of {_format_megabytes(step.total)} MB" if step.total else ""
            self._draw(self._bars, f"; {name}: {step.stage}{size}")
        elif self._bars is not None and step.total:
            said = f"{step.stage} {100 * step.done // step.total} %"
            self._bars.update(self._all, total=step.total, completed=step.done, said=said)
        elif self._bars is None and (step.task or 10 * step.done >= step.total > 0):
            name, tenths = step.task or self._what, 10 * step.done // max(step.total, 1)
            stage = step.stage if step.task else f"{step.stage} {10 * tenths} %"
            if self._stages.get(name) != stage:
                self._stages[name] = stage
                self.line(f"{name}: {stage}")

    def end(self, task: str, *, worked: bool) -> None:
        """Count a log that is done; one that needed no work does not count for the rate."""
        if self._bars is not None:
            size = self._sizes.get(task, 0)
            self._waiting -= size
            self._done += size if worked else 0
            self._bars.advance(self._all)
            self._draw(self._bars)

    def _draw(self, bars: rich.progress.Progress, more: str = "") -> None:
        """Show how many logs are done, how fast, and how long the others will take at that."""
        text, took_s = f"{round(bars.tasks[0].completed)}/{len(self._sizes)}", time.monotonic() - self._begun_s
        if self._done and took_s > 0:
            remaining = divmod(round(self._waiting / self._done * took_s), 60)
            text += f", {_format_megabytes(self._done / took_s)} MB/s, {remaining[0]}:{remaining[1]:02d} left"
        bars.update(self._all, said=text + more)


def _format_megabytes(size_bytes: float) -> str:
    return f"{size_bytes / 1e6:.1f}"


class _Lines(logging.Handler):
    """Sends messages of the pipeline to the progress display."""

    def __init__(self, shown: Progress) -> None:
        super().__init__()
        self._shown = shown

    def emit(self, record: logging.LogRecord) -> None:
        if step := step_of(record):
            self._shown.step(step)
        elif record.levelno >= logging.ERROR:
            self._shown.problem(record.getMessage())
        else:
            self._shown.line(record.getMessage())


def write_debug_log() -> AbstractContextManager[None]:
    """Log every step with its time to stderr, and the cause of each error."""
    return _listen(_DebugLog(), logging.DEBUG)


class _DebugLog(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        step = step_of(record)
        if step is not None and (step.done or not step.task):
            return
        text = record.getMessage() if step is None else f"{step.task}: {step.stage}"
        when = datetime.fromtimestamp(record.created, UTC).strftime("%H:%M:%S.%f")[:-3]
        with suppress(OSError):
            print_line(f"{when} {text}", err=True)


def print_line(text: str, *, err: bool = False) -> None:
    """Print one line on stdout, or on stderr."""
    click.echo(clean_line(text), err=err)


def print_lines(result: object) -> None:
    """Print the text of a result on stdout."""
    for line in str(result).split("\n"):
        print_line(line)


def print_result(result: object, *, as_json: bool) -> None:
    """Print a result on stdout, as one JSON object or as text."""
    if as_json:
        print_json(result)
    else:
        print_lines(result)


def print_json(value: object) -> None:
    """Print one JSON object on stdout, with unprintable characters as JSON escapes."""
    from tcpipe.formats.json_files import to_json

    click.echo(_format_value(to_json(value)), nl=False)


def print_json_line(value: object) -> None:
    """Print one JSON object on one line of stdout, as `print_json` does."""
    from tcpipe.formats.json_files import to_json_line

    click.echo(_format_value(to_json_line(value)))


def _format_value(text: str) -> str:
    return "".join(c if c.isprintable() or c == "\n" else json.dumps(c)[1:-1] for c in text)


def print_traceback() -> None:
    """Print where the error was raised that is being handled."""
    click.echo(hide_secrets(traceback.format_exc()), err=True, nl=False)


@dataclass(frozen=True, slots=True)
class Failure:
    """The answer of a command that failed."""

    exit_code: int
    problems: tuple[str, ...]
    transient: bool
    """Whether the same call may succeed later: the disk was full, the network or a worker failed, a signal ended it."""
    kind: Literal["failure"] = "failure"


def print_failure(failure: Failure, *, as_json: bool) -> None:
    """Print the problems on stderr, and on stdout one line of JSON if that is requested."""
    with suppress(OSError):
        for problem in failure.problems:
            print_line(f"tcpipe: {problem}", err=True)
    if as_json:
        click.echo(json.dumps({**asdict(failure), "problems": [*map(hide_secrets, failure.problems)]}))
