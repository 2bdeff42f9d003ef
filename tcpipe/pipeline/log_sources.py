"""Logs as they lie on disk: which files are one run, what they are called, and which hold the same recording."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tcpipe.errors import LogError, TcpipeError, plain_line
from tcpipe.formats.joined_log import open_logs
from tcpipe.formats.log_file import LOG_SUFFIXES, belongs_to_a_log, find_logs
from tcpipe.formats.object_storage import copied, is_url, stand_ins

_LONGEST_STEM_BYTES = 200


@dataclass(frozen=True, slots=True)
class LogSource:
    """One log (several files of one drive with ``--as-one``): real paths, and size [byte] and modification time [ns] of every file."""

    paths: tuple[Path, ...]
    files: tuple[tuple[int, int], ...]
    sha256: str | None = None
    """None where it has yet to be computed."""
    urls: tuple[str, ...] = ()
    """Where the files lie, if one lies in object storage; ``paths`` then are stand-ins until `on_this_machine` has copied them."""

    @property
    def name(self) -> str:
        """What the log is called in messages."""
        return plain_line(" + ".join(self.origins))

    @property
    def origins(self) -> tuple[str, ...]:
        """Where the files are, or were copied from."""
        return self.urls or tuple(str(path) for path in self.paths)

    @property
    def stem(self) -> str:
        """What the run is called after: the first name without its suffix, as text that can be printed and be a file name."""
        path = self.paths[0]
        suffix = next((end for end in sorted(LOG_SUFFIXES, key=len, reverse=True) if path.name.endswith(end)), "")
        stem = path.name if path.is_dir() else path.name.removesuffix(suffix)
        return plain_line(stem).encode()[:_LONGEST_STEM_BYTES].decode(errors="ignore")

    @property
    def key(self) -> str:
        """What the log is remembered by, with ``files``."""
        return "|".join(self.origins)

    def has_changed(self) -> bool:
        """Tell whether a file was written since."""
        return _files(self.paths) != self.files


def find_sources(logs: Iterable[str | Path], *, as_one: bool, staging: Path) -> list[LogSource]:
    """Return the logs at or below the given paths, each once, in the order given; `LogError` where there is none.

    With ``as_one`` they are all parts of one. For what lies in object storage there are stand-ins in ``staging``.
    """
    paths: dict[Path, None] = {}
    urls: dict[Path, str] = {}
    problems: list[str] = []
    for number, entry in enumerate(logs):
        try:
            if is_url(entry):
                remote = _remote(str(entry), staging / str(number))
                urls.update(remote)
                paths.update(dict.fromkeys(remote))
            else:
                paths.update(dict.fromkeys(_real(path) for path in find_logs(Path(entry))))
        except LogError as error:
            problems += error.problems
    if problems:
        raise LogError(*problems)
    if not paths:
        raise LogError("no logs given; wanted .mcap, .bag or .db3 files, ROS 2 bag directories, or folders of them")
    groups = [tuple(sorted(paths))] if as_one else [(path,) for path in paths]
    return [
        LogSource(group, _files(group), urls=tuple(urls.get(path, str(path)) for path in group if urls))
        for group in groups
    ]


def definitions_key(directory: Path | None) -> str:
    """Return a short hash of the definition files that the user gives; "" where none are given."""
    if directory is None:
        return ""
    digest = hashlib.sha256()
    for path in sorted([*directory.rglob("*.idl"), *directory.rglob("*.msg")]):
        digest.update(f"{path.relative_to(directory)}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()[:8]


def _remote(url: str, directory: Path) -> dict[Path, str]:
    """Return stand-ins for the logs at or below a URL, and the URL of each."""
    directory.mkdir(parents=True)
    place = stand_ins(url, directory, wanted=belongs_to_a_log)
    return {_real(path): "/".join((url.rstrip("/"), *path.relative_to(place).parts)) for path in find_logs(place)}


@contextmanager
def on_this_machine(source: LogSource) -> Iterator[LogSource]:
    """Yield the source with its files here: what lies in object storage is copied, and the copy removed in the end."""
    if not source.urls:
        yield source
        return
    with ExitStack() as stack:
        paths = [
            stack.enter_context(copied(origin, wanted=belongs_to_a_log)) if is_url(origin) else Path(origin)
            for origin in source.urls
        ]
        yield replace(source, paths=tuple(paths))


def with_hashes(sources: Sequence[LogSource], remembered: Mapping[str, Any]) -> list[LogSource]:
    """Return the sources with the hashes that are remembered, and computed where two of one size may be the same recording."""
    known = [_remembered(source, remembered) for source in sources]
    sizes = Counter(_size(source) for source in known)
    return [source if source.sha256 or sizes[_size(source)] == 1 else _hashed(source) for source in known]


def in_turns(sources: Sequence[LogSource]) -> list[list[int]]:
    """Return the indices of what can be ingested side by side, and then of what holds the same recording as one of those."""
    seen: set[str] = set()
    turns: list[list[int]] = [[], []]
    for index, source in enumerate(sources):
        turns[source.sha256 in seen].append(index)
        seen |= {source.sha256} if source.sha256 else set()
    return turns


def _real(path: Path) -> Path:
    """Return where a log really lies; a link that leads nowhere is named itself."""
    return path.resolve() if path.exists() else path.absolute()


def _files(paths: Sequence[Path]) -> tuple[tuple[int, int], ...]:
    files = [file for path in paths for file in (sorted(path.rglob("*")) if path.is_dir() else [path])]
    found = [os.stat(file) for file in files if file.is_file()]  # noqa: PTH116
    return tuple((stat.st_size, stat.st_mtime_ns) for stat in found)


def _size(source: LogSource) -> int:
    return sum(size for size, _ in source.files)


def _remembered(source: LogSource, remembered: Mapping[str, Any]) -> LogSource:
    entry = remembered.get(source.key)
    same = entry is not None and entry["size_and_time"] == [list(file) for file in source.files]
    return replace(source, sha256=entry["sha256"]) if entry is not None and same else source


def _hashed(source: LogSource) -> LogSource:
    if source.urls:  # it is hashed when it is copied
        return source
    try:
        with open_logs(source.paths) as log:
            return replace(source, sha256=log.sha256())
    except (TcpipeError, OSError):  # told when it is ingested
        return source
