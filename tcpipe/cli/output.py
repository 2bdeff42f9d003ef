"""What commands print: progress on stderr, results on stdout. Nothing else in `tcpipe` prints, so that every name is escaped here."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import click

from tcpipe.errors import plain_line

if TYPE_CHECKING:
    from tcpipe.recipe import Recipe


def ruling_recipe(explicit: str | None) -> tuple[Recipe, str]:
    """Return the recipe that rules here and where it comes from, for printing."""
    from tcpipe.formats.recipe_toml import find_recipe, load_recipe

    path = find_recipe(None if explicit is None else Path(explicit), Path.cwd())
    return load_recipe(path), "built-in defaults" if path is None else str(path)


@contextmanager
def progress(what: str, total: int, *, quiet: bool) -> Iterator[Progress]:
    """Show progress on stderr: a bar on a terminal, plain lines otherwise, nothing with ``quiet``."""
    shown = Progress(what, total, quiet=quiet)
    handler = _Lines(shown)
    logger = logging.getLogger("tcpipe")
    before = logger.level
    logger.setLevel(logging.ERROR if quiet else logging.INFO)
    logger.addHandler(handler)
    try:
        with shown:
            yield shown
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


class Progress:
    """A bar, lines, or silence; ``line`` says something, ``step`` counts one done."""

    def __init__(self, what: str, total: int, *, quiet: bool) -> None:
        self._what = what
        self._quiet = quiet
        self._bar: Any = None
        if not quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.markup import escape
            from rich.progress import Progress as Bar

            self._bar = Bar(console=Console(stderr=True), transient=True, redirect_stdout=sys.stdout.isatty())
            self._task = self._bar.add_task(escape(plain_line(what)), total=total)

    def __enter__(self) -> Self:
        """Start the bar."""
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()

    def line(self, text: str) -> None:
        """Say one line."""
        if not self._quiet:
            self._say(text)

    def problem(self, *lines: str) -> None:
        """Say what went wrong, also where progress is not wanted."""
        for text in lines:
            self._say(f"tcpipe: {text}")

    def _say(self, text: str) -> None:
        with suppress(OSError):  # nobody listening is no reason to stop
            if self._bar is not None:
                self._bar.console.print(plain_line(text), markup=False, highlight=False)
            else:
                say(text, err=True)

    def expect(self, total: int) -> None:
        """Say how many there are."""
        if self._bar is not None:
            self._bar.update(self._task, total=total)

    def count(self, done: int, total: int) -> None:
        """Say how many of how many are done: lines come at every tenth."""
        if self._bar is not None:
            self._bar.update(self._task, total=total, completed=done)
        elif done * 10 // total > (done - 1) * 10 // total:
            self.line(f"{self._what}: {100 * done // total} %")

    def step(self) -> None:
        """Count one done."""
        if self._bar is not None:
            self._bar.advance(self._task)


class _Lines(logging.Handler):
    """Sends what the pipeline says to the progress display."""

    def __init__(self, shown: Progress) -> None:
        super().__init__()
        self._shown = shown

    def emit(self, record: logging.LogRecord) -> None:
        said = self._shown.problem if record.levelno >= logging.ERROR else self._shown.line
        said(record.getMessage())


def say(text: str, *, err: bool = False) -> None:
    """Print one line on stdout, or on stderr."""
    click.echo(plain_line(text), err=err)


def say_lines(result: object) -> None:
    """Print a result that tells itself in lines of text on stdout."""
    for line in str(result).split("\n"):
        say(line)


def say_result(result: object, *, as_json: bool) -> None:
    """Print a result on stdout: one JSON object, or the lines that it tells itself in."""
    if as_json:
        print_json(result)
    else:
        say_lines(result)


def print_json(value: Any) -> None:
    """Print one JSON object on stdout, what no terminal should see as escapes of JSON."""
    from tcpipe.formats.json_files import to_json

    click.echo(_shown(to_json(value)), nl=False)


def print_json_line(value: Any) -> None:
    """Print one JSON object on one line of stdout, as `print_json` does."""
    from tcpipe.formats.json_files import to_json_line

    click.echo(_shown(to_json_line(value)))


def _shown(text: str) -> str:
    return "".join(c if c.isprintable() or c == "\n" else json.dumps(c)[1:-1] for c in text)


def say_failure(problems: Sequence[str], exit_code: int, *, as_json: bool) -> None:
    """Say on stderr what went wrong, and print it on stdout as a JSON object if that is wanted."""
    with suppress(OSError):
        for problem in problems:
            say(f"tcpipe: {problem}", err=True)
    if as_json:
        click.echo(json.dumps({"exit_code": exit_code, "problems": list(problems)}))
