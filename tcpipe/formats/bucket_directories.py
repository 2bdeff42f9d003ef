"""Directories with a sealed card (datasets, models, cost maps) in a bucket, fetched to this machine (ADR-36)."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import google_crc32c

from tcpipe.errors import StoreError
from tcpipe.formats.atomic import make_lasting_scratch
from tcpipe.formats.cache import fetch_cached, is_cached
from tcpipe.formats.file_checks import find_changed_files
from tcpipe.formats.integrity import Checksum
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import Place
from tcpipe.formats.published_outputs import UNLISTED, read_listed_files, require_card

_CRC_BYTES = 4


@dataclass(frozen=True, slots=True)
class FetchedShards:
    """Shards in a bucket, of a dataset or a map, below ``root`` as if they were there; pieces are fetched by range, and cached."""

    place: Place
    root: Path
    checksums: Mapping[str, Checksum]
    proves: bool = False
    """Whether the checksum of a shard is computed before a piece of it is read: once, until its ETag changes."""
    _proved: set[str] = field(default_factory=set)

    def size(self, path: Path) -> int:
        """Return the size of a shard [byte]; `FileNotFoundError` if it is missing."""
        return self._checksum(path).size_bytes

    def read(self, path: Path, offset: int, size: int) -> bytes:
        """Return a piece of a shard that ends with the CRC-32C of the rest; an altered copy in the cache is fetched again."""
        self._prove({self._name(path)})
        for _ in range(2):
            held = self._held(path, offset, size)
            data = held.read_bytes()
            if google_crc32c.value(data[:-_CRC_BYTES]).to_bytes(_CRC_BYTES, "little") == data[-_CRC_BYTES:]:
                break
            held.unlink(missing_ok=True)
        return data

    def prefetch(self, pieces: Iterable[tuple[Path, int, int]]) -> None:
        """Fetch pieces (shard, offset, size) that are read soon into the cache, side by side."""
        pieces = list(pieces)
        self._prove({self._name(path) for path, *_ in pieces})
        absent = [piece for piece in pieces if not is_cached(self._key(*piece))]
        self.place.map(lambda piece: self._held(*piece), absent)

    def fetch_file(self, path: Path) -> Path:
        """Return a cached copy of a whole file."""
        return self.place.fetch(self._name(path), self._checksum(path), proved=False)

    def is_complete(self) -> bool:
        """Return whether each file exists with its size."""
        sizes = {entry.name: entry.size_bytes for entry in self.place.entries()}
        return all(sizes.get(name) == checksum.size_bytes for name, checksum in self.checksums.items())

    def _prove(self, names: set[str]) -> None:
        """Raise `StoreError` if a shard differs from its checksum."""
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
    """Return a directory of this machine: the one that is named, or a copy, for this process, of the files that a card in a bucket lists.

    `UsageError`: there is no card at the URL; `StoreError`: it cannot be read, or a file differs from its checksum.
    """
    return fetch_directory_by_range(path, by_range=lambda _: False)[0]


def fetch_directory_by_range(path: str | Path, *, by_range: Callable[[str], bool]) -> tuple[Path, FetchedShards | None]:
    """Return a directory as `fetch_directory`, without the files that are ``by_range``, and where these are read; None on this machine."""
    if not is_url(path):
        return Path(path), None
    url = str(path).rstrip("/")
    card = require_card(url)
    root = _make_copy_directory(url, card.data)
    (root / card.name).write_bytes(card.data)
    for unlisted in UNLISTED:
        if (page := card.place.read(unlisted)) is not None:
            (root / unlisted).write_bytes(page)
    return root, _fetch_others(card.place, root, read_listed_files(card), by_range)


def fetch_files(
    place: Place, checksums: Mapping[str, Checksum], *, by_range: Callable[[str], bool]
) -> tuple[Path, FetchedShards | None]:
    """Return a directory of this machine with the files of a place but those that are ``by_range``, and where these are read.

    A directory has all of them: it is returned itself, with None. `StoreError`: a file is missing or differs from its checksum.
    """
    if place.path is not None:
        return place.path, None
    root = _make_copy_directory(place.where(), repr(sorted(checksums.items())).encode())
    return root, _fetch_others(place, root, checksums, by_range)


def _fetch_others(
    place: Place, root: Path, checksums: Mapping[str, Checksum], by_range: Callable[[str], bool]
) -> FetchedShards:
    """Copy the files of a place that are not ``by_range`` to ``root``; return where the others are read."""

    def fetch(name: str) -> None:
        held, path = place.fetch(name, checksums[name]), root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            path.hardlink_to(held)
        except OSError:
            shutil.copyfile(held, path)

    place.map(fetch, [name for name in checksums if not (by_range(name) or (root / name).exists())])
    return FetchedShards(place, root, checksums)


@cache
def _make_copy_directory(url: str, version: bytes) -> Path:
    """Return a directory that is removed when the process ends; its path ends with the URL, for messages about its files."""
    del version
    path = make_lasting_scratch().joinpath(*(part for part in url.split("/") if part not in ("", "..")))
    path.mkdir(parents=True, exist_ok=True)
    return path
