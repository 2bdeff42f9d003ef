"""Logs on disk: which files are one run, their names, the share of a task, and duplicate logs."""

from __future__ import annotations

import hashlib
import os
import shlex
import sqlite3
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from tcpipe.errors import LogError, StoreError, clean_line
from tcpipe.formats.atomic import Location
from tcpipe.formats.json_files import digest
from tcpipe.formats.logs.log_file import find_logs, list_logs_below
from tcpipe.formats.logs.rosbag2 import STORAGE_SUFFIXES, is_one_bag, list_storage_files
from tcpipe.formats.logs.table_folders import (
    Mappings,
    find_log_suffix,
    find_table_logs,
    is_log_file,
    is_table,
    list_table_files,
    walk_folders,
)
from tcpipe.formats.object_storage import format_path, is_url, make_stand_ins, split_url
from tcpipe.formats.runs import LogSnapshot
from tcpipe.logs.topics import Topic
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding

_LONGEST_STEM_BYTES = 200


@dataclass(frozen=True, slots=True)
class LogSource:
    """One log (several files of a drive with ``--as-one``): paths, size [byte] and modification time [ns] of each file.

    A link has the name that the user gives: tcpipe uses the name of the link, not of its target.
    """

    paths: tuple[Path, ...]
    files: tuple[tuple[int, int], ...]
    sha256: str | None = None
    """None if it has yet to be computed."""
    urls: tuple[str, ...] = ()
    """Locations of the files, if one is in object storage; ``paths`` are then placeholders of equal names and sizes."""
    queries: tuple[str, ...] = field(default=(), repr=False)
    """Queries of presigned URLs, in the order of ``urls``; they are not printed or stored."""
    place: str = ""
    """Path of the log in the folder that was given, which does not depend on where that is mounted."""

    @property
    def name(self) -> str:
        """Name of the log in messages."""
        return clean_line(" + ".join(self.origins))

    @property
    def origins(self) -> tuple[str, ...]:
        """Where the files are."""
        return self.urls or tuple(str(path) for path in self.paths)

    def locations(self) -> tuple[Location, ...]:
        """Return the paths and URLs by which the files are opened, including queries of presigned URLs."""
        queries = self.queries or ("",) * len(self.origins)
        whole = (f"{at}?{query}" if query else at for at, query in zip(self.origins, queries, strict=True))
        return tuple(at if is_url(at) else Path(at) for at in whole)

    @property
    def stem(self) -> str:
        """First part of the run's id: the first name without its suffix, as printable text that can be a file name."""
        path = self.paths[0]
        if path.is_dir():
            stem = path.name
        elif is_table(path.name):
            stem = f"{path.parent.name}_{path.stem}"
        else:
            stem = path.name[: len(path.name) - len(find_log_suffix(path.name))]
        return clean_line(stem).encode()[:_LONGEST_STEM_BYTES].decode(errors="ignore")

    @property
    def files_digest(self) -> str:
        """Substitute for the log's hash if the log cannot be read: a hash (hex) over names, sizes and times."""
        return digest({"log": self.origins, "files": self.files})

    @property
    def size_bytes(self) -> int:
        """The size of all files."""
        return sum(size for size, _ in self.files)

    def now(self) -> LogSource:
        """Return the log as it is now, since a file may have changed; object storage is not listed again."""
        if self.urls:
            return self
        files = _list_file_states(self.paths)
        return self if files == self.files else replace(self, files=files, sha256=None)

    def has_changed(self) -> bool:
        """Return whether a file was written since; changed objects are detected when they are read."""
        return not self.urls and _list_file_states(self.paths) != self.files


@dataclass(frozen=True, slots=True)
class FoundLogs:
    """The logs at or below the given paths, each once and in that order, and a line for each path without a log."""

    sources: tuple[LogSource, ...]
    problems: Mapping[str, tuple[str, ...]]
    """By path as it was given."""
    transient: bool = False
    """Whether the problem of a path may be temporary, such as a network that is down."""


def list_log_sources(
    logs: Iterable[Location], *, as_one: bool, staging: Path, tables: Mappings | None = None
) -> FoundLogs:
    """Return the logs at or below the given paths.

    With ``as_one``, all of them are parts of one log. Logs in object storage get placeholders in ``staging``. A folder
    with one of the files of ``tables`` is a log; if their names have a ``*``, the files of each run are one log.
    """
    paths: dict[str, list[tuple[Path, str]]] = {}
    urls: dict[Path, str] = {}
    queries: dict[Path, str] = {}
    problems: dict[str, tuple[str, ...]] = {}
    transient = False
    for number, entry in enumerate(logs):
        try:
            if is_url(entry):
                above_url, query = split_url(str(entry), one_object=True)
                remote = find_remote_logs(str(entry), staging / str(number))
                urls.update(remote)
                queries.update(dict.fromkeys(remote, query))
                for path, url in remote.items():
                    place = url.removeprefix(above_url.rstrip("/")).lstrip("/") or url
                    paths.setdefault(str(path), [(path, place)])
            else:
                above = Path(entry)
                for files in find_logs_at(above, tables or {}):
                    found = [(_as_named(path), _place_in(path, above)) for path in files]
                    paths.setdefault(os.path.realpath(files[0]), found)
        except LogError as error:
            problems[format_path(entry)] = error.problems
            transient |= is_transient(error)
    for part, line in _find_lone_parts([found[0][0] for found in paths.values()], together=as_one):
        problems[str(part)] = (line,)
        paths = {real: found for real, found in paths.items() if found[0][0] != part}
    groups = [sorted(part for found in paths.values() for part in found)] if as_one and paths else [*paths.values()]
    sources = tuple(
        LogSource(
            tuple(path for path, _ in group),
            _list_file_states([path for path, _ in group]),
            urls=tuple(urls.get(path, str(path)) for path, _ in group if urls),
            queries=tuple(queries.get(path, "") for path, _ in group if urls),
            place="|".join(place for _, place in group),
        )
        for group in groups
    )
    return FoundLogs(sources, problems, transient)


def find_logs_at(path: Path, tables: Mappings) -> list[tuple[Path, ...]]:
    """Return the files of each log at or below a path, mapped tables among them; `LogError` without any."""
    if of_tables := find_table_logs(path, tables) if tables else []:
        return [*((log,) for log in (list_logs_below(path) if path.is_dir() else ())), *of_tables]
    try:
        return [(log,) for log in find_logs(path)]
    except LogError as error:
        if tables and path.is_dir():
            files = ", ".join(mapping.file for mapping in tables.values())
            raise LogError(
                *error.problems, f"{path}: it contains none of the files that the recipe's tables name: {files}"
            ) from None
        if path.is_dir() and (held := list_table_files(path)):
            init = f"tcpipe init --from {shlex.quote(str(path))}"
            hint = f"{path}: it contains {len(held)} tables ({held[0].name}, …): '{init}' writes a recipe for them"
            raise LogError(*error.problems, hint) from None
        raise


def _find_lone_parts(paths: Iterable[Path], *, together: bool) -> Iterator[tuple[Path, str]]:
    """Yield ROS 2 bag files that are given without the rest of their bag: only the first has static transforms."""
    folders: dict[str, list[Path]] = {}
    for path in paths:
        if str(path).endswith(STORAGE_SUFFIXES):
            folders.setdefault(os.path.dirname(path), []).append(path)  # noqa: PTH120  of thousands
    for bag, given_parts in sorted(folders.items()):
        parts = frozenset(list_storage_files(Path(bag)) if is_one_bag(Path(bag)) else ())
        if len(parts) > 1 and not (together and parts.issubset(given_parts)):
            for path in sorted(parts.intersection(given_parts)):
                what = f"{path}: is one of the {len(parts)} parts of the ROS 2 bag {bag}"
                yield path, f"{what}, and only the first part has the static transforms; give the directory"


def select_shard(sources: Sequence[LogSource], shard: tuple[int, int]) -> list[int]:
    """Return the logs of share ``(i, n)``, i from 1, by a hash of their names in the given folder, at any mount."""
    index, count = shard
    return [at for at, source in enumerate(sources) if int(digest(source.place)[:8], 16) % count == index - 1]


def make_definitions_key(directory: Path | None) -> str:
    """Return a short hash of the definition files that the user gives; "" if none are given."""
    if directory is None:
        return ""
    digest = hashlib.sha256()
    for path in sorted([*directory.rglob("*.idl"), *directory.rglob("*.msg")]):
        digest.update(f"{path.relative_to(directory)}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()[:8]


def find_remote_logs(url: str, directory: Path) -> dict[Path, str]:
    """Return placeholders for the logs at or below a URL, and the URL of each."""
    directory.mkdir(parents=True)
    place = make_stand_ins(url, directory, wanted=is_log_file)
    return {
        path.resolve(): "/".join((format_path(url).rstrip("/"), *path.relative_to(place).parts))
        for path in find_logs(place)
    }


def _as_named(path: Path) -> Path:
    """Return a log's full path with links as the user wrote them; only links before a ``..`` are followed."""
    if ".." not in path.parts:
        return path.absolute()
    return path.resolve() if path.name == ".." else path.parent.resolve() / path.name


def _place_in(path: Path, entry: Path) -> str:
    """Return the path of a log in the folder that the user gave; tables of a run may be next to its first one."""
    if path == entry:
        return path.name or path.resolve().name
    return str(path).removeprefix(f"{entry}/").lstrip("/")


def _list_file_states(paths: Sequence[Path]) -> tuple[tuple[int, int], ...]:
    return tuple((status.st_size, status.st_mtime_ns) for path in paths for status in _stat_files(path))


def _stat_files(path: Path) -> list[os.stat_result]:
    """Return the status of a file, or of all regular files below a directory, without unreadable ones."""
    try:
        status_of_path = os.stat(path)  # noqa: PTH116
    except OSError:
        return []
    if stat.S_ISDIR(status_of_path.st_mode):
        names = (f"{place}/{name}" for place, _, names_in_folder in walk_folders(path) for name in names_in_folder)
        return [status for file in sorted(names) if stat.S_ISREG((status := os.stat(file)).st_mode)]  # noqa: PTH116
    return [status_of_path] if stat.S_ISREG(status_of_path.st_mode) else []


def recall_hash(source: LogSource, seen: LogSnapshot | None) -> LogSource:
    """Return the source with its hash if ``seen`` has the same sizes and times of its files."""
    dated = bool(source.files) and all(time_ns for _, time_ns in source.files)  # some servers give no time
    is_same = dated and seen is not None and seen.size_and_time == source.files
    return replace(source, sha256=seen.sha256) if is_same and seen is not None else source


def find_damaged_log(damage: Sequence[Finding], subject: Subject) -> Findings:
    """Return the finding that a log is damaged, which decides exit codes and can be acknowledged."""
    places = sum(finding.numbers.get("places_count", 1) for finding in damage)
    return (make_finding("log-damaged", subject, damage_count=places),) if damage else ()


def find_total_loss(topics: Iterable[Topic], damage: Sequence[Finding]) -> tuple[str, ...]:
    """Return the problem that damage leaves no message, if so: then no sensor is missing, but the file is cut."""
    is_lost = damage and all(topic.message_count == 0 for topic in topics)
    return ("the log is damaged, and no message can be read",) if is_lost else ()


def find_failure(log: str, error: str) -> Findings:
    """Return the finding that a log gave no run; ``error`` is the class of the error."""
    return (make_finding("log-failed", Subject("log", log), names={"error": error}),)


def is_transient(error: BaseException) -> bool:
    """Return whether an error, or its cause, may be temporary."""
    causes = [error]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
        causes.append(cause)
    return any(map(_is_transient, causes))


def _is_transient(error: BaseException) -> bool:
    if isinstance(error, MemoryError | StoreError | ImportError):
        return True
    if isinstance(error, OSError):  # decompressors raise it, too, without a number
        return error.errno is not None
    if isinstance(error, sqlite3.OperationalError):  # locked, read-only, full …; of a damaged file a table lacks
        return getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) != sqlite3.SQLITE_ERROR
    # The network, credentials; its home loads it when it is needed.
    return type(error).__module__.partition(".")[0] == "obstore"
