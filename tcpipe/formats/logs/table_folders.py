"""Folders of tables that the recipe maps, and the files in them; polars is loaded only when a table is read."""

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from tcpipe.formats.atomic import Location
from tcpipe.formats.documents import parse_name
from tcpipe.formats.logs.rosbag2 import METADATA
from tcpipe.recipe import TableMapping

TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".tum", ".pos", ".parquet")
"""Suffixes of tables."""

_DATASET = {"dataset.json", "samples.parquet"}  # files that identify a folder as a dataset

Mappings = Mapping[str, TableMapping]
"""The recipe's tables, by name."""


def list_table_files(folder: Path) -> list[Path]:
    """Return the tables in a folder and below it, by name, without hidden ones."""
    return sorted(Path(place) / name for place, _, names in walk_folders(folder) for name in names if is_table(name))


@dataclass(frozen=True, slots=True)
class TableRun:
    """The tables of one run: files of a folder in whose names the recipe's ``*`` is the same text."""

    folder: Path
    mappings: dict[str, TableMapping]
    """The recipe's mappings, with the names of this run's files."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The tables that are there, by name."""
        return tuple(
            sorted({path for mapping in self.mappings.values() if (path := self.folder / mapping.file).is_file()})
        )


def find_table_logs(path: Path, mappings: Mappings) -> list[tuple[Path, ...]]:
    """Return the logs at or below a path that are tables, in order of their names.

    A log is a folder with a mapped file and all below it, or the files of a `TableRun`.
    """
    if path.is_file():
        return [run.files] if (run := find_table_run(path, mappings)) else []
    numbered = [mapping.file for mapping in mappings.values() if "*" in mapping.file]
    fixed = [mapping.file for mapping in mappings.values() if mapping.file and "*" not in mapping.file]
    logs = list[tuple[Path, ...]]()
    for directory, folders, _ in walk_folders(path):
        folder = Path(directory)
        files = sorted(file for pattern in numbered for file in folder.glob(pattern))
        runs = (run for file in files if (run := find_table_run(file, mappings)))
        if grouped := dict.fromkeys(run.files for run in runs):
            logs += grouped
        elif any((folder / file).is_file() for file in fixed):
            logs.append((folder,))
        else:
            continue
        folders.clear()
    return logs


def find_table_run(path: Location, mappings: Mappings) -> TableRun | None:
    """Return the run that a table belongs to by its name, None if the recipe maps no file of such a name.

    The tables of a run are in one folder; the text of a ``*`` is the same in the names of all of them.
    """
    path = Path(path)
    for mapping in mappings.values():
        parts = mapping.file.split("/")
        if len(path.parts) < len(parts):
            continue
        pattern = "([^/]+)".join(map(re.escape, mapping.file.split("*")))
        if named := re.fullmatch(pattern, "/".join(path.parts[-len(parts) :])):
            text = named[1] if "*" in mapping.file else "*"
            names = {name: mapping.file.replace("*", text) for name, mapping in mappings.items()}
            of_run = {name: replace(mapping, file=names[name]) for name, mapping in mappings.items()}
            return TableRun(path.parents[len(parts) - 1], of_run)
    return None


def walk_folders(folder: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yield each folder, its folders (which the caller may remove) and its files; links to folders are not followed.

    Unlike `os.walk` on Python 3.11, it does not recurse. It skips stores and datasets, so that results in a log's
    folder do not change the log.
    """
    waiting = [str(folder)]
    while waiting:
        directory = waiting.pop()
        folders, names = list[str](), list[str]()
        with suppress(OSError), os.scandir(directory) as entries:
            for entry in entries:
                if not entry.is_dir(follow_symlinks=False):
                    names.append(entry.name)
                elif not entry.name.startswith((".", "~")):
                    folders.append(entry.name)
        folders.sort()
        if {*names} >= _DATASET or ("calls" in folders and _is_store(directory)):
            continue
        yield directory, folders, names
        waiting += (f"{directory}/{name}" for name in reversed(folders))


def _is_store(place: str) -> bool:
    """Return whether a folder has records of calls; each call on a store writes one before it searches for logs."""
    with suppress(OSError):
        return any(parse_name("calls", file.name) for file in Path(place, "calls").iterdir())
    return False


def is_table(name: str) -> bool:
    """Return whether a file of this name is a table."""
    return name.lower().endswith(TABLE_SUFFIXES) and not name.startswith((".", "~"))


AUTOPILOT_SUFFIXES = (".ulg", ".bin")
LOG_SUFFIXES = (".mcap", ".bag", ".bag.active", ".db3", ".mcap.zstd", ".db3.zstd", *AUTOPILOT_SUFFIXES)


def is_log_file(name: str) -> bool:
    """Return whether a file of this name is a log or part of one."""
    return name.lower().endswith(".db3-wal") or name == METADATA or bool(find_log_suffix(name))


def find_log_suffix(name: str) -> str:
    """Return the suffix that makes a file a log; "" for other files."""
    return max((suffix for suffix in LOG_SUFFIXES if name.lower().endswith(suffix)), key=len, default="")
