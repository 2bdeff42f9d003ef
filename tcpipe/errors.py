"""Every error a user can meet: subclasses of `TcpipeError`, exit code 1, or 2 of `UsageError` and `RecipeError`.

Each has one or more *problems*: lines that state what happened, where, got and expected values, and what to do.
The command line prints them; a traceback is a bug.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

_URL = re.compile(r"(?<![a-z0-9+.-])([a-z][a-z0-9+.-]+:/{1,2})(\S+)", re.IGNORECASE)
_CLOSING = ")]}'\",;:."  # characters that may follow a URL in a sentence


def hide_secrets(text: str) -> str:
    """Return ``text`` without the user info, query and fragment of each URL in it."""

    def hide(url: re.Match[str]) -> str:
        public, query = split_secrets(url[1], url[2])
        return url[1] + public + query[len(query.rstrip(_CLOSING)) :]

    return _URL.sub(hide, text) if ":/" in text else text


def split_secrets(scheme: str, rest: str) -> tuple[str, str]:
    """Return the printable part of a URL after its scheme (``http://``), and its query or fragment, without user info.

    An unescaped password may contain any character, even ``/``.
    """
    host = re.split(r"[/?#]", rest, maxsplit=1)[0]
    is_http = scheme.lower().startswith("http")
    if "@" in host:
        rest = rest[host.rindex("@") + 1 :]
    elif "@" in rest and ":" in host and not host.startswith("["):
        is_port = is_http and re.fullmatch(r"\d{0,5}\W*", host.partition(":")[2])
        rest = rest if is_port else rest.rpartition("@")[2]
    public = re.split(r"[?#]" if is_http else r"\?", rest, maxsplit=1)[0]
    query = rest[len(public) :]
    return (public, query) if is_http or "=" in query else (rest, "")  # names of objects may contain question marks


def clean_line(text: str) -> str:
    """Return ``text`` as one line without secrets, with escapes for unprintable characters."""
    text = hide_secrets(text)
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def list_first(names: Sequence[str], most: int = 1) -> str:
    """Return the first names, and the number of the others."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


def align_columns(rows: Sequence[Sequence[str]], align: Callable[[str, int], str] = str.ljust) -> list[str]:
    """Return the rows of a table, its header first, as lines with columns of one width."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(align, row, widths)).rstrip() for row in rows]


def clean_lines(lines: Iterable[str]) -> str:
    """Join lines, each cleaned by `clean_line`, so that no name adds a line break."""
    return "\n".join(map(clean_line, lines))


class TcpipeError(Exception):
    """Base class of all errors that tcpipe raises on purpose; ``problems`` has one line for each.

    ``findings`` are those that were made before (`tcpipe.tables.findings.Finding`), which the command line prints, too.
    """

    exit_code = 1

    def __init__(self, *problems: str, findings: Iterable[Any] = ()) -> None:
        self.problems: tuple[str, ...] = tuple(clean_line(problem) for problem in problems)
        self.findings = tuple(findings)
        super().__init__("\n".join(self.problems))

    def __reduce__(self) -> tuple[type[TcpipeError], tuple[str, ...], dict[str, tuple[Any, ...]]]:
        """Pickle through worker processes with every problem and finding kept."""
        return type(self), self.problems, {"findings": self.findings}


class UsageError(TcpipeError):
    """The call is impossible: a wrong option, or a path that is missing or of another kind."""

    exit_code = 2


class RecipeError(UsageError):
    """The recipe is wrong; every wrong key is one problem."""


class LogError(TcpipeError):
    """A file is not a log, or has no usable content."""


class RoleError(LogError):
    """A role cannot be decided among several topics, or no topic has it."""


class FusionError(TcpipeError):
    """The sensors do not determine a track."""


class MapError(TcpipeError):
    """A raster cannot be placed on the ground, or a map cannot be read."""


class RegionError(TcpipeError):
    """A split region cannot be used."""


class StoreError(TcpipeError):
    """The store cannot be read or written."""


class MissingFileError(StoreError):
    """A file of the store is missing."""


class DatasetError(TcpipeError):
    """A dataset cannot be built or read."""


class ModelError(TcpipeError):
    """A trained model cannot be read, or does not fit the question."""


class PathError(TcpipeError):
    """A planned path cannot be used, or no path exists."""


class TableError(TcpipeError):
    """A table breaks its contract; every wrong column is one problem."""
