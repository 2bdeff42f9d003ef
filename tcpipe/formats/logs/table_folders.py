"""Where tables lie: the folders that the recipe maps, and the files in them; polars is loaded only where one is read."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from tcpipe.recipe import TableMapping

TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".tum", ".pos", ".parquet")
"""What a file of a table is called."""

Mappings = Mapping[str, TableMapping]
"""The recipe's tables, by name."""


def list_table_files(folder: Path) -> list[Path]:
    """Return the tables in a folder and below it, by name; hidden ones are passed over."""
    return sorted(Path(place) / name for place, _, names in _walk_folders(folder) for name in names if is_table(name))


def find_table_folders(path: Path, mappings: Mappings) -> list[Path]:
    """Return the folders at or below a path that hold a mapped file, in order of their names; what lies below one is its own."""
    wanted = [mapping.file for mapping in mappings.values() if mapping.file]
    found = list[Path]()
    for place, folders, _ in _walk_folders(path):
        if any((Path(place) / file).is_file() for file in wanted):
            found.append(Path(place))
            folders.clear()
    return found


def _walk_folders(folder: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yield each folder with the names of folders in it, which the caller may take out, and of files; links to folders are not followed.

    As `os.walk`, which on Python 3.11 calls itself as deep as folders are nested.
    """
    waiting = [str(folder)]
    while waiting:
        place = waiting.pop()
        folders, names = list[str](), list[str]()
        with suppress(OSError), os.scandir(place) as entries:
            for entry in entries:
                if not entry.is_dir(follow_symlinks=False):
                    names.append(entry.name)
                elif not entry.name.startswith((".", "~")):
                    folders.append(entry.name)
        folders.sort()
        yield place, folders, names
        waiting += (f"{place}/{name}" for name in reversed(folders))


def is_table(name: str) -> bool:
    """Return whether a file of this name is a table."""
    return name.lower().endswith(TABLE_SUFFIXES) and not name.startswith((".", "~"))
