"""Every error a user can meet, as one tree.

::

    TcpipeError                exit 1   something the user gave could not be used
    ├── UsageError             exit 2   the command line asks for something impossible
    │   └── RecipeError        exit 2   the recipe is wrong (all its errors at once)
    ├── LogError               exit 1   a file is not a log, or nothing in it can be used
    │   └── RoleError          exit 1   a role cannot be decided, or nothing plays it
    ├── FusionError            exit 1   the sensors do not determine a track
    ├── MapError               exit 1   a raster cannot be placed, or a map cannot be read
    ├── RegionError            exit 1   a split region cannot be used
    ├── StoreError             exit 1   the store cannot be read or written
    ├── DatasetError           exit 1   a dataset cannot be built or read
    ├── ModelError             exit 1   a trained model cannot be read, or does not fit what it is asked about
    ├── PathError              exit 1   a path cannot be used, or there is none
    └── TableError             exit 1   a table breaks its contract (tcpipe.tables)

Each carries one or more *problems*: plain lines that say what, where, got, wanted and what to do.
The command line prints them; a traceback is a bug.
"""

from __future__ import annotations

from collections.abc import Iterable


def plain_line(text: str) -> str:
    """Return ``text`` as one line that every terminal can show: control characters and bytes that are no text as escapes."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def plain_lines(lines: Iterable[str]) -> str:
    """Return lines as one text, a `plain_line` each: no name in them makes a line of its own."""
    return "\n".join(map(plain_line, lines))


class TcpipeError(Exception):
    """Base of everything tcpipe raises on purpose; ``problems`` holds one plain line each."""

    exit_code = 1

    def __init__(self, *problems: str) -> None:
        self.problems: tuple[str, ...] = tuple(plain_line(problem) for problem in problems)
        super().__init__("\n".join(self.problems))

    def __reduce__(self) -> tuple[type[TcpipeError], tuple[str, ...]]:
        """Pickle through worker processes with every problem kept."""
        return type(self), self.problems


class UsageError(TcpipeError):
    """The call asks for something impossible: an option, a path where nothing or something else is."""

    exit_code = 2


class RecipeError(UsageError):
    """The recipe is wrong; every wrong key is one problem."""


class LogError(TcpipeError):
    """A file is not a log, or nothing in it can be used."""


class RoleError(LogError):
    """A role cannot be decided among several topics, or no topic plays it."""


class FusionError(TcpipeError):
    """The sensors do not determine a track."""


class MapError(TcpipeError):
    """A raster cannot be placed on the ground, or a map cannot be read."""


class RegionError(TcpipeError):
    """A split region cannot be used."""


class StoreError(TcpipeError):
    """The store cannot be read or written."""


class DatasetError(TcpipeError):
    """A dataset cannot be built or read."""


class ModelError(TcpipeError):
    """A trained model cannot be read, or does not fit what it is asked about."""


class PathError(TcpipeError):
    """A path cannot be used, or there is none."""


class TableError(TcpipeError):
    """A table breaks its contract; every wrong column is one problem."""
