"""Directories with a sealed card (datasets, models, cost maps) in a bucket, fetched to this machine (ADR-36).

What is built to a URL lies in folders, one for each build; a log of commits says which is the newest (ADR-36)::

    log/0000000002.json                         the commit of the second build
    generations/0000000002-1f0c8a3be2d94c57/    its files: the number of its commit, and the digest of its card

What lies at a URL without a log, as a copy put it there, is read as it is.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

import google_crc32c

from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.atomic import make_lasting_scratch
from tcpipe.formats.cache import fetch_cached, is_cached
from tcpipe.formats.file_checks import find_changed_files
from tcpipe.formats.integrity import Checksum, Checksums
from tcpipe.formats.json_files import parse_json, parse_typed
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import Place, open_place

LOG, State = "log", object
CARDS = ("dataset.json", "model.json", "cost-map.json")
"""Documents that prove all files beside them."""
_UNLISTED = ("report.html",)
"""Files next to a card that does not list them, since they are written from it."""
REPORT_PATCHES = "report-patches"
"""Folder beside a dataset's page, of pictures that it shows: unlisted too."""
GENERATIONS = "generations"
"""Folder of the builds at a URL."""
_DIGEST_HEX = 16
_GENERATION = re.compile(rf"({GENERATIONS}/(\d{{10}})-[0-9a-f]{{{_DIGEST_HEX}}})/")
_CRC_BYTES = 4


@dataclass(frozen=True, slots=True)
class FetchedShards:
    """Shards in a bucket, of a dataset or a map, below ``root`` as if they were there; pieces are fetched by range, and cached."""

    place: Place
    root: Path
    checksums: Mapping[str, Checksum]
    proves: bool = False
    """Whether a shard is held against its checksum before a piece of it is read: each is read whole once, until its ETag changes."""
    _proved: set[str] = field(default_factory=set)

    def size(self, path: Path) -> int:
        """Return the size of a shard [byte]; `FileNotFoundError` if it is missing."""
        return self._checksum(path).size_bytes

    def read(self, path: Path, offset: int, size: int) -> bytes:
        """Return a piece of a shard that ends with the CRC-32C of the rest; of which the cache holds another it is fetched anew."""
        self._prove({self._name(path)})
        for _ in range(2):
            held = self._held(path, offset, size)
            data = held.read_bytes()
            if google_crc32c.value(data[:-_CRC_BYTES]).to_bytes(_CRC_BYTES, "little") == data[-_CRC_BYTES:]:
                break
            held.unlink(missing_ok=True)
        return data

    def prefetch(self, pieces: Iterable[tuple[Path, int, int]]) -> None:
        """Have pieces (shard, offset, size) cached that are read soon, fetched side by side."""
        pieces = list(pieces)
        self._prove({self._name(path) for path, *_ in pieces})
        absent = [piece for piece in pieces if not is_cached(self._key(*piece))]
        self.place.map(lambda piece: self._held(*piece), absent)

    def fetch_file(self, path: Path) -> Path:
        """Return a cached copy of a whole file."""
        return self.place.fetch(self._name(path), self._checksum(path), proved=False)

    def is_complete(self) -> bool:
        """Return whether each file is there, and as large as it was."""
        sizes = {entry.name: entry.size_bytes for entry in self.place.entries()}
        return all(sizes.get(name) == checksum.size_bytes for name, checksum in self.checksums.items())

    def _prove(self, names: set[str]) -> None:
        """Raise `StoreError` where a shard is not what its card says."""
        if not self.proves or names <= self._proved:
            return
        if wrong := find_changed_files(self.place, self.checksums, sorted(names - self._proved)):
            raise StoreError(*wrong)
        self._proved.update(names)

    def _held(self, path: Path, offset: int, size: int) -> Path:
        key, name = self._key(path, offset, size), self._name(path)
        return fetch_cached(key, lambda to: to.write_bytes(self.place.read_range(name, offset, size)))

    def _key(self, path: Path, offset: int, size: int) -> str:
        return f"{self._checksum(path).sha256} {offset} {size}"

    def _name(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()

    def _checksum(self, path: Path) -> Checksum:
        found = self.checksums.get(self._name(path))
        if found is None:
            raise FileNotFoundError(str(path))
        return found


def fetch_directory(path: str | Path) -> Path:
    """Return a directory of this machine: the one that is named, or a copy of what a card in a bucket lists while this process runs.

    `UsageError`: there is no card at the URL; `StoreError`: it cannot be read, or a file is not as the card says.
    """
    return fetch_directory_by_range(path, by_range=lambda _: False)[0]


def fetch_directory_by_range(path: str | Path, *, by_range: Callable[[str], bool]) -> tuple[Path, FetchedShards | None]:
    """Return a directory as `fetch_directory`, without the files that are ``by_range``, and where these are read; None on this machine."""
    if not is_url(path):
        return Path(path), None
    url = str(path).rstrip("/")
    card = require_card(url)
    root = _make_subdirectory(_make_copy_directory(url, card.data), url)
    (root / card.name).write_bytes(card.data)
    for unlisted in _UNLISTED:
        if (page := card.place.read(unlisted)) is not None:
            (root / unlisted).write_bytes(page)
    return root, _fetch_others(card.place, root, _read_checksums(card), by_range)


def has_card(url: str) -> bool:
    """Return whether a directory with a card lies at a URL."""
    return find_newest(url, CARDS) is not None


class FoundCard(NamedTuple):
    """A card, its name, and the place of its files."""

    place: Place
    name: str
    data: bytes


def find_newest(url: str, cards: Sequence[str]) -> FoundCard | None:
    """Return the card of the newest generation at a URL; None for another kind than ``cards``, or without a build.

    The number of requests does not depend on the number of generations.
    """
    return _find_at(open_place(url), cards)


def _find_at(place: Place, cards: Sequence[str]) -> FoundCard | None:
    found = (FoundCard(place, name, data) for name in cards if (data := place.read(name)) is not None)
    return next(found, None)


def find_unlisted_files(url: str) -> list[str]:
    """Return what lies at a URL and is listed by no card there, but for what earlier generations and builds that go on may hold."""
    place = open_place(url)
    state = read_state(place)
    cards = [card for card in (find_newest(url, CARDS), _find_at(place, CARDS)) if card is not None]
    listed = {card.place.where(name) for card in cards for name in (*_read_checksums(card), *_UNLISTED, card.name)}
    others = [entry.name for entry in place.entries() if place.where(entry.name) not in listed]
    return [place.where(name) for name in others if not _is_expected(name, state)]


def _is_expected(name: str, state: State) -> bool:
    newest = state.generations[-1].folder if state.generations else None
    found = _GENERATION.match(name)
    is_of_others = found is not None and found[1] != newest and not is_left_over(name, state)
    return is_of_others or f"/{REPORT_PATCHES}/" in f"/{name}" or (name.startswith(f"{LOG}/") and state.number > 0)


def name_generation(number: int, card: bytes) -> str:
    """Return the folder of the generation of a commit: of two calls only those that put the same card share one."""
    return f"{GENERATIONS}/{number:010}-{hashlib.sha256(card).hexdigest()[:_DIGEST_HEX]}"


def is_left_over(name: str, state: State) -> bool:
    """Return whether a file is of a generation that is not kept, and that no commit to come can name; none is while a commit is damaged."""
    found = _GENERATION.match(name)
    if found is None or state.problems:
        return False
    return int(found[2]) <= state.number and found[1] not in {generation.folder for generation in state.generations}


def require_card(url: str, cards: Sequence[str] = CARDS) -> FoundCard:
    """Return what `find_newest` does; `UsageError` where there is no card."""
    found = find_newest(url, cards)
    if found is None:
        raise UsageError(f"{url}: there is no dataset, model or cost map here: none of {', '.join(cards)}")
    return found


def _read_checksums(card: FoundCard) -> Mapping[str, Checksum]:
    """Return the files that a card lists; `StoreError` where one of them is not beside it."""
    where = card.place.where(card.name)
    checksums = parse_typed(parse_json(card.data, Path(where)), Checksums, Path(where)).checksums
    if outside := [file for file in checksums if file.startswith("/") or ".." in file.split("/")]:
        raise StoreError(f"{where}: names {outside[0]!r}, which is not in its directory")
    return checksums


def fetch_files(
    place: Place, checksums: Mapping[str, Checksum], *, by_range: Callable[[str], bool]
) -> tuple[Path, FetchedShards | None]:
    """Return a directory of this machine in which files of a place lie but those that are ``by_range``, and where these are read.

    A directory holds all of them: it is returned itself, with None. `StoreError` where a file cannot be had as its checksum says.
    """
    if place.path is not None:
        return place.path, None
    copies = _make_copy_directory(place.where(), repr(sorted(checksums.items())).encode())
    root = _make_subdirectory(copies, place.where())
    return root, _fetch_others(place, root, checksums, by_range)


def _fetch_others(
    place: Place, root: Path, checksums: Mapping[str, Checksum], by_range: Callable[[str], bool]
) -> FetchedShards:
    """Bring what is not read ``by_range`` of a place's files below ``root``; return where the others are read."""
    absent = [
        (name, checksum) for name, checksum in checksums.items() if not (by_range(name) or (root / name).exists())
    ]
    place.map(lambda arguments: _fetch_one(place, *arguments, root / arguments[0]), absent)
    return FetchedShards(place, root, checksums)


@cache
def _make_copy_directory(url: str, card: bytes) -> Path:
    """Return a directory for a card at a URL, which goes when the process ends."""
    del url, card
    return make_lasting_scratch()


def _make_subdirectory(directory: Path, url: str) -> Path:
    """Return the folder for a copy of a URL in a directory, named so that messages about its files show their origin."""
    path = directory.joinpath(*(part for part in url.split("/") if part not in ("", "..")))
    path.mkdir(parents=True, exist_ok=True)
    return path


def _fetch_one(place: Place, name: str, checksum: Checksum, to: Path) -> None:
    """Link or copy the cached content of a file to where it is wanted."""
    to.parent.mkdir(parents=True, exist_ok=True)
    held = place.fetch(name, checksum)
    with suppress(FileExistsError):
        try:
            os.link(held, to)
        except OSError:
            shutil.copyfile(held, to)
