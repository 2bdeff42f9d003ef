"""What commands print: progress on stderr, results on stdout. Nothing else in `tcpipe` prints, so that every name is escaped here."""

from __future__ import annotations

import json
import logging
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import click

from tcpipe.errors import clean_line, hide_secrets
from tcpipe.progress import STEP, Step, step_of

if TYPE_CHECKING:
    from tcpipe.cli.bars import Bars
    from tcpipe.recipe import Recipe


def resolve_recipe_with_source(explicit: str | None) -> tuple[Recipe, str]:
    """Return the recipe that rules here and where it comes from, for printing."""
    from tcpipe.formats.recipe_toml import find_recipe, load_recipe

    path = find_recipe(None if explicit is None else Path(explicit), Path.cwd())
    return load_recipe(path), "built-in defaults" if path is None else str(path)


@contextmanager
def show_progress(what: str, *, quiet: bool, as_json: bool = False) -> Iterator[Progress]:
    """Show progress on stderr: bars on a terminal, else plain lines, nothing with ``quiet``; with ``--debug`` its log says all."""
    logger = logging.getLogger("tcpipe")
    debugging = logger.isEnabledFor(logging.DEBUG)
    shown = Progress(what, quiet=quiet, bars=None if quiet or debugging else _make_bars(what, as_json=as_json))
    handler = _Lines(shown)
    before = logger.level
    if not debugging:
        logger.setLevel(logging.ERROR if quiet else STEP)
        logger.addHandler(handler)
    try:
        with shown:
            yield shown
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def _make_bars(what: str, *, as_json: bool) -> Bars | None:
    """Return bars where stderr is a terminal that can draw them, and no JSON goes to it."""
    if not sys.stderr.isatty() or (as_json and sys.stdout.isatty()):
        return None
    from rich.console import Console

    from tcpipe.cli.bars import Bars

    console = Console(stderr=True)
    return Bars(what, console) if console.is_terminal and not console.is_dumb_terminal else None


class Progress:
    """Bars, lines, or silence; ``line`` says something on stderr, ``result`` on stdout."""

    def __init__(self, what: str, *, quiet: bool, bars: Bars | None) -> None:
        self._what = what
        self._quiet = quiet
        self._bars = bars
        self._stages: dict[str, str] = {}

    def __enter__(self) -> Self:
        """Start the bars."""
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bars."""
        if self._bars is not None:
            self._bars.stop()

    def line(self, text: str) -> None:
        """Say one line."""
        if not self._quiet:
            self._say(text)

    def problem(self, *lines: str) -> None:
        """Say what went wrong, also where progress is not wanted."""
        for text in lines:
            self._say(f"tcpipe: {text}")

    def result(self, text: str) -> None:
        """Say a line of the result on stdout, above the bars where both are on one terminal."""
        if self._bars is not None and sys.stdout.isatty():
            self._bars.print(clean_line(text))
        else:
            print_line(text)

    def _say(self, text: str) -> None:
        with suppress(OSError):  # nobody listening is no reason to stop
            if self._bars is not None:
                self._bars.print(clean_line(text))
            else:
                print_line(text, err=True)

    def expect(self, sizes: Mapping[str, int]) -> None:
        """Begin with logs of these sizes [byte]."""
        if self._bars is not None:
            self._bars.expect(sizes)

    def end(self, task: str, *, worked: bool) -> None:
        """Count a log that is done, and whether there was something to do."""
        if self._bars is not None:
            self._bars.end(task, worked=worked)

    def count(self, done: int, total: int) -> None:
        """Say how many of how many are done: lines come at every tenth."""
        if self._bars is not None:
            self._bars.count(done, total)
        elif done * 10 // total > (done - 1) * 10 // total:
            self.line(f"{self._what}: {100 * done // total} %")

    def step(self, step: Step) -> None:
        """Show how far a task is; without bars a line at each stage of a log."""
        if self._bars is not None:
            self._bars.step(step)
        elif step.task and self._stages.get(step.task) != step.stage:
            self._stages[step.task] = step.stage
            self.line(f"{step.task}: {step.stage}")


class _Lines(logging.Handler):
    """Sends what the pipeline says to the progress display."""

    def __init__(self, shown: Progress) -> None:
        super().__init__()
        self._shown = shown

    def emit(self, record: logging.LogRecord) -> None:
        if step := step_of(record):
            self._shown.step(step)
        else:
            said = self._shown.problem if record.levelno >= logging.ERROR else self._shown.line
            said(record.getMessage())


@contextmanager
def write_debug_log() -> Iterator[None]:
    """Say on stderr what is done and when, and what is behind each error."""
    logger, handler = logging.getLogger("tcpipe"), _DebugLog()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


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
    """Print a result that tells itself in lines of text on stdout."""
    for line in str(result).split("\n"):
        print_line(line)


def print_result(result: object, *, as_json: bool) -> None:
    """Print a result on stdout: one JSON object, or the lines that it tells itself in."""
    if as_json:
        print_json(result)
    else:
        print_lines(result)


def print_json(value: Any) -> None:
    """Print one JSON object on stdout, what no terminal should see as escapes of JSON."""
    from tcpipe.formats.json_files import to_json

    click.echo(_format_value(to_json(value)), nl=False)


def print_json_line(value: Any) -> None:
    """Print one JSON object on one line of stdout, as `print_json` does."""
    from tcpipe.formats.json_files import to_json_line

    click.echo(_format_value(to_json_line(value)))


def _format_value(text: str) -> str:
    return "".join(c if c.isprintable() or c == "\n" else json.dumps(c)[1:-1] for c in text)


def print_traceback() -> None:
    """Print where the error was raised that is being handled."""
    click.echo(hide_secrets(traceback.format_exc()), err=True, nl=False)


def print_failure(problems: Sequence[str], exit_code: int, *, as_json: bool) -> None:
    """Say on stderr what went wrong, and print it on stdout as a JSON object if that is wanted."""
    with suppress(OSError):
        for problem in problems:
            print_line(f"tcpipe: {problem}", err=True)
    if as_json:
        click.echo(json.dumps({"exit_code": exit_code, "problems": [hide_secrets(problem) for problem in problems]}))
