"""A store, a map or a dataset of an earlier data model, brought to this one, in place or to another place; and any store copied.

Tables, maps and pixels stay as and where they are. Documents of a store of data model 1 had fixed names and were replaced; each becomes the
first of its numbered ones, which says where its files lie (ADR 85). The mark that makes a place a store of this layout comes last. So a
migration that was killed is gone on with by calling it again, and one that is done does nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from tcpipe.errors import StoreError, TcpipeError, UsageError, plain_lines
from tcpipe.formats.bucket import open_place
from tcpipe.formats.dataset_files import CARD, read_card
from tcpipe.formats.json_files import to_json, typed
from tcpipe.formats.maps.map_files import open_map
from tcpipe.formats.numbered import name_of, read_as_at, read_sealed_at, stem_and_number
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.parquet import read_table
from tcpipe.formats.place import Place
from tcpipe.formats.run_documents import Manifest, MapDocument, RunJson
from tcpipe.formats.seals import CHECKSUMS, Checksums, read_sealed, sealed, write_sealed
from tcpipe.formats.store_mark import MARK, is_outdated, mark_store
from tcpipe.pipeline.supersession import remember_earlier
from tcpipe.store import Store
from tcpipe.tables.levels import DATA_MODEL_VERSION, READ_VERSIONS, metadata_of

Document = Mapping[str, Any]


_STEPS: Mapping[str, str] = dict(pairwise(READ_VERSIONS))
"""The version after each. Whatever came with one says nothing where it is absent, so nothing but the number changes."""

_RUN, _MANIFEST = "run.json", "manifest.json"
"""Names of documents before data model 2."""


@dataclass(frozen=True, slots=True)
class Migrated:
    """What became of each document; ``str`` of it is what the command prints."""

    path: str
    migrated: tuple[str, ...]
    current: int
    """Documents that were of this data model, and maps outside of stores, which are read as they are."""
    problems: tuple[str, ...]
    """Documents that are left as they are, and why."""
    copied: int = 0
    """Files that were put to another place."""

    @property
    def exit_code(self) -> int:
        """Return 0, 3 if some documents could not be migrated, 1 if none could."""
        return (3 if self.migrated or self.current else 1) if self.problems else 0

    def __str__(self) -> str:
        """Return what was done, one line a document, and what was not."""
        count = f"{len(self.migrated)} documents brought to data model {DATA_MODEL_VERSION}, {self.current} left as they are"
        if not self.migrated and not self.problems and not self.copied:
            count = f"nothing to do: {self.current} documents are current"
        head = f"{count}; {self.copied} files copied" if self.copied else count
        done = (f"migrated: {path}" for path in self.migrated)
        return plain_lines((f"{self.path}: {head}", *done, *(f"problem: {problem}" for problem in self.problems)))


def migrate(path: Path | str, to: Path | str | None = None) -> Migrated:
    """Bring the documents of a store, or the card of a dataset, to this data model; maps are read as they are.

    Parameters
    ----------
    path : the store, map (``.zarr``) or dataset; a store also by its URL.
    to : where a store is brought to, a directory or URL; what is there of it already is not copied again. None: where it is.

    Raises
    ------
    UsageError : the path is none of these, or no store and to be brought elsewhere.
    """
    source = open_place(path)
    if source.size(MARK) is not None or is_outdated(source):
        return _store(source, source if to is None else open_place(to))
    if is_url(path) or to is not None:
        raise UsageError(f"{path}: is no store; only stores are brought elsewhere")
    path = Path(path)
    if (path / CARD).is_file():
        return _one(path, path / CARD)
    if path.resolve().suffix == ".zarr":
        return _one(path, path)
    raise UsageError(f"{path}: is no store, map (.zarr) or dataset; give one of these directories")


def _one(path: Path, document: Path) -> Migrated:
    try:
        brought = _brought(document)
    except TcpipeError as error:
        return Migrated(str(path), (), 0, error.problems)
    return Migrated(str(path), (str(document),) if brought else (), 0 if brought else 1, ())


def _store(source: Place, target: Place) -> Migrated:
    """Bring a store to this layout; ``target`` is ``source``, or where it is copied to."""
    migrated, problems = list[str](), list[str]()
    names = [entry.name for entry in source.entries()]
    numbered = [name for name in names if stem_and_number(name.rpartition("/")[2]) and not name.startswith("records/")]
    current, copied = len(numbered), 0
    outdated = list(_outdated(source, names))
    if target != source:
        copied = _copy(source, target, numbered, without={name for old in outdated for name in old.replaces})
    for old in outdated:
        try:
            data = to_json(sealed(old.brought())).encode()
        except TcpipeError as error:
            problems += error.problems
            continue
        if target.put_new(old.name, data):
            migrated.append(target.where(old.name))
        elif target != source:
            current += 1
        for name in old.replaces if target == source else ():
            source.delete(name)
    if target == source:
        source.delete("sources.json")
    marked = target.size(MARK) is not None
    remember_earlier(Store(target.where()))
    mark_store(target, found=marked)
    return Migrated(target.where(), tuple(migrated), current, tuple(problems), copied)


def _copy(source: Place, target: Place, documents: Sequence[str], *, without: set[str]) -> int:
    """Copy what a store holds, its documents last, so that each finds its files; what is there already in its size is not copied again.

    Returns the number of files that were copied.
    """
    there = {entry.name: entry.size_bytes for entry in target.entries()}
    apart = {*documents, *without, MARK, "sources.json", *(name for name in there if name.startswith("index/"))}
    absent = [of for of in source.entries() if of.name not in apart and there.get(of.name) != of.size_bytes]
    for entry in absent:
        target.put(entry.name, source.read(entry.name) or b"")
    return len(absent) + sum(target.put_new(name, source.read(name) or b"") for name in documents)


@dataclass(frozen=True, slots=True)
class _Old:
    """A document before data model 2, or a map that had none."""

    name: str
    """Of the document that takes its place."""
    brought: Callable[[], object]
    replaces: tuple[str, ...] = ()


def _outdated(place: Place, names: Sequence[str]) -> Iterator[_Old]:
    """Yield what a store has of an earlier data model."""
    for name in names:
        folder, _, last = name.rpartition("/")
        if last == _RUN and folder.count("/") == 1 and folder.startswith("runs/"):
            checksums = f"{folder}/streams/{CHECKSUMS}"
            replaces = (name, *([checksums] if checksums in names else ()))
            yield _Old(f"{folder}/{name_of('run', 1)}", partial(_run, place.below(folder)), replaces)
        elif last == _MANIFEST and folder.count("/") == 2 and folder.startswith("runs/"):
            yield _Old(f"{folder}/{name_of('manifest', 1)}", partial(_manifest, place.below(folder)), (name,))
        elif last == CHECKSUMS and folder.endswith(".zarr") and folder.count("/") == 1:
            stem = folder.removeprefix("maps/").removesuffix(".zarr")
            yield _Old(f"maps/{name_of(stem, 1)}", partial(_map, place.below("maps"), stem))


def _run(place: Place) -> RunJson:
    """Return what was known of a log, with its streams where they are as they were written."""
    known = read_as_at(place, _RUN, RunJson)
    with suppress(StoreError):
        listed = read_as_at(place, f"streams/{CHECKSUMS}", Checksums).checksums
        streams = {f"streams/{name}": of for name, of in listed.items()}
        first = next(iter(sorted(streams)), None)
        if first is not None:
            told = metadata_of(read_table(place.local(first, streams[first]), []))
            return replace(known, streams=streams, streams_key=str(told.get("key", "")))
    return known


def _manifest(place: Place) -> Document:
    found = read_sealed_at(place, _MANIFEST)
    brought = _stepped(found, place.where(_MANIFEST))
    typed(brought, Manifest, place.where(_MANIFEST))
    return brought


def _map(place: Place, name: str) -> MapDocument:
    zarr, picture = f"{name}.zarr", f"{name}.png"
    listed = read_as_at(place, f"{zarr}/{CHECKSUMS}", Checksums).checksums
    checksums = {f"{zarr}/{file}": of for file, of in listed.items()}
    for file in (f"{zarr}/{CHECKSUMS}", picture):
        if (found := place.checksum(file)) is not None:
            checksums[file] = found
    return MapDocument(DATA_MODEL_VERSION, zarr, picture, checksums)


def _brought(place: Path) -> bool:
    """Bring a dataset's card to this data model and return True; False where it was, and for maps."""
    if place.suffix == ".zarr":
        open_map(place)
        return False
    read_card(place.parent)
    found = read_sealed(place)
    document = _stepped(found, str(place))
    if document is not found:
        write_sealed(place, document)
    return document is not found


def _stepped(found: Document, where: str) -> Document:
    """Return a document of this data model; `StoreError` where it is of none that is known."""
    document = found
    while (version := document.get("data_model_version", "")) != DATA_MODEL_VERSION:
        if version not in _STEPS:
            raise StoreError(
                f"{where}: of data model {version}, this version knows {', '.join(READ_VERSIONS)}; left as it is"
            )
        document = {**document, "data_model_version": _STEPS[version]}
    return document
