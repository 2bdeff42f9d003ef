"""A store, a map or a dataset of an earlier data model, brought to this one: document by document, each whole by one rename.

Every step goes from one version to the next, and a document takes those that it needs; tables, maps and pixels are read as they are. So a
migration that was killed is gone on with by calling it again, and one that is done does nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from tcpipe.errors import StoreError, TcpipeError, UsageError, plain_lines
from tcpipe.formats.dataset_files import CARD, read_card
from tcpipe.formats.maps.map_files import open_map
from tcpipe.formats.seals import read_sealed, write_sealed
from tcpipe.store import Store, is_store
from tcpipe.tables.levels import DATA_MODEL_VERSION, READ_VERSIONS

Document = Mapping[str, Any]


_STEPS: Mapping[str, str] = dict(pairwise(READ_VERSIONS))
"""The version after each. Whatever came with one says nothing where it is absent, so nothing but the number changes."""


@dataclass(frozen=True, slots=True)
class Migrated:
    """What became of each document; ``str`` of it is what the command prints."""

    path: Path
    migrated: tuple[Path, ...]
    current: int
    """Documents and maps that were of this data model, or are read as they are."""
    problems: tuple[str, ...]
    """Documents that are left as they are, and why."""

    @property
    def exit_code(self) -> int:
        """Return 0, 3 if some documents could not be migrated, 1 if none could."""
        return (3 if self.migrated or self.current else 1) if self.problems else 0

    def __str__(self) -> str:
        """Return what was done, one line a document, and what was not."""
        count = f"{len(self.migrated)} documents brought to data model {DATA_MODEL_VERSION}, {self.current} left as they are"
        head = (
            count if self.migrated or self.problems else f"nothing to do: {self.current} documents and maps are current"
        )
        done = (f"migrated: {path}" for path in self.migrated)
        return plain_lines((f"{self.path}: {head}", *done, *(f"problem: {problem}" for problem in self.problems)))


def migrate(path: Path) -> Migrated:
    """Bring the documents of a store, or the card of a dataset, to this data model; maps are read as they are.

    Raises
    ------
    UsageError
        The path is none of these.
    """
    if (path / CARD).is_file():
        documents, maps = [path / CARD], []
    elif path.resolve().suffix == ".zarr":
        documents, maps = [], [path]
    elif path.is_dir() and is_store(path):
        store = Store(path)
        documents = sorted(
            place for run_id in store.run_ids() for place in (store.runs_path / run_id).glob("[!.]*/manifest.json")
        )
        maps = [store.map_path(name) for name in store.maps()]
    else:
        raise UsageError(f"{path}: is no store, map (.zarr) or dataset; give one of these directories")
    migrated, current, problems = list[Path](), 0, list[str]()
    for place in (*documents, *maps):
        try:
            if _brought(place):
                migrated.append(place)
            else:
                current += 1
        except TcpipeError as error:
            problems += error.problems
    return Migrated(path, tuple(migrated), current, tuple(problems))


def _brought(place: Path) -> bool:
    """Bring a document to this data model and return True; False where it was, and for maps."""
    if place.suffix == ".zarr":
        open_map(place)
        return False
    if place.name == CARD:
        read_card(place.parent)
    found: Document = read_sealed(place)
    document = found
    while (version := document.get("data_model_version", "")) != DATA_MODEL_VERSION:
        if version not in _STEPS:
            raise StoreError(
                f"{place}: of data model {version}, this version knows {', '.join(READ_VERSIONS)}; left as it is"
            )
        document = {**document, "data_model_version": _STEPS[version]}
    if document is not found:
        write_sealed(place, document)
    return document is not found
