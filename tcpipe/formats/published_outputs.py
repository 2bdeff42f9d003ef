"""Datasets, models, cost maps and evaluations at a URL: each build is a folder, and a pointer names the newest.

::

    builds/6d0c3c1b9a0e4f27/            the files of a build, in a folder with a random name
    current.2.1f0c8a3be2d94c57.json     the pointer of the second build: its folder, and the name of its card

A pointer is written after the files and never changed. The highest number counts, then the smallest digest; bytes whose
sha256 does not begin with the digest in their name are no pointer. Files at a URL without a pointer, as a copy put them
there, are read unchanged.
"""

import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import google_crc32c

from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.atomic import (
    Location,
    make_lasting_scratch,
    make_scratch_directory,
    make_unique_name,
    write_atomic_directory,
)
from tcpipe.formats.cache import fetch_cached, is_cached
from tcpipe.formats.integrity import Checksum, Checksums, FileChecksums, compute_short_digest
from tcpipe.formats.json_files import parse_json, parse_typed, parse_typed_json, to_json
from tcpipe.formats.object_storage import is_bucket, is_url
from tcpipe.formats.place import REPORT, FileEntry, Place, find_changed_files, open_place

CARDS = ("dataset.json", "model.json", "cost-map.json")
"""Documents with the checksums of all files beside them."""
BUILDS = "builds"
_BUILD = re.compile(rf"({BUILDS}/[0-9a-f]{{16}})/")
_POINTER = re.compile(r"current\.(\d+)\.([0-9a-f]{16})\.json")
_KEPT_NS = 7 * 24 * 3600 * 10**9  # time for which a build stays after its replacement, so that readers can finish [ns]


@dataclass(frozen=True, slots=True)
class _Pointer:
    folder: str
    card: str
    name: str = ""
    """Its own, which its document does not contain."""


class FoundCard(NamedTuple):
    """A card, its name, and the place of its files."""

    place: Place
    name: str
    data: bytes


def find_newest(url: str, cards: Sequence[str]) -> FoundCard | None:
    """Return the card of the newest build at a URL, in three requests; None without a build of a kind in ``cards``."""
    place = open_place(url)
    if not is_bucket(url):  # without lists
        return _find_card(place, cards)
    names = place.list()
    if (pointer := next(_iterate_pointers(place, names), None)) is None:
        return _find_card(place, [name for name in cards if name in names])
    return _find_card(place.below(pointer.folder), [pointer.card] if pointer.card in cards else [])


def require_card(url: str, cards: Sequence[str] = CARDS) -> FoundCard:
    """Return the result of `find_newest`; `UsageError` if there is no card."""
    found = find_newest(url, cards)
    if found is None:
        raise UsageError(f"{url}: there is no dataset, model or cost map here: none of {', '.join(cards)}")
    return found


def read_listed_files(card: FoundCard) -> FileChecksums:
    """Return the files that a card lists; `StoreError` if one of them is not beside it."""
    where = card.place.where(card.name)
    checksums = parse_typed(parse_json(card.data, Path(where)), Checksums, Path(where)).checksums
    if outside := [file for file in checksums if file.startswith("/") or ".." in file.split("/")]:
        raise StoreError(f"{where}: names {outside[0]!r}, which is not in its directory")
    return checksums


def check_kind(url: str, card: str) -> None:
    """Raise `UsageError` if the newest build at a URL, or a file there, is of another kind than ``card``."""
    place = open_place(url)
    names = place.list()
    pointer = next(_iterate_pointers(place, names), None)
    others = (name for name in names if name != BUILDS and not _POINTER.fullmatch(name))
    name = pointer.card if pointer else card if card in names else min(others, default=card)
    if name != card:
        raise UsageError(f"{url}: contains {name} and no {card}; it is not changed; give another place")


@contextmanager
def write_output(url: str, card: str) -> Iterator[Path]:
    """Yield a directory; its files at the end, a card among them, become the newest build at a URL.

    Builds that were replaced more than seven days ago are removed then, and folders of that age that no pointer names.

    Raises `UsageError`: something else is at the URL; `StoreError`: the place cannot be read or written.
    """
    check_kind(url, card)
    place, folder = open_place(url), f"{BUILDS}/{make_unique_name()}"
    with make_scratch_directory() as scratch:
        directory = scratch / url.rstrip("/").rpartition("/")[2]
        directory.mkdir()
        yield directory
        place.put_files(folder, directory)
    data = to_json({"folder": folder, "card": card}).encode()
    numbers = (int(found[1]) for name in place.list() if (found := _POINTER.fullmatch(name)))
    place.put(f"current.{max(numbers, default=0) + 1}.{compute_short_digest(data)}.json", data)
    entries = place.entries()
    pointers = list(_iterate_pointers(place, [entry.name for entry in entries]))
    place.map(place.delete, _find_expired(entries, pointers))


@contextmanager
def open_output(out: Location, card: str) -> Iterator[Path]:
    """Yield the directory for an output: ``out``, or, for a URL, a temporary one that becomes its newest build."""
    if not is_url(out):
        yield Path(out)
        return
    with write_output(str(out), card) as directory:
        yield directory


@contextmanager
def publish_directory(out: Location, card: str) -> Iterator[Path]:
    """Yield an empty directory whose files, including a card, become ``out``, or the newest build at a URL."""
    with (
        write_output(str(out).rstrip("/"), card)
        if is_url(out)
        else write_atomic_directory(Path(out).absolute()) as directory
    ):
        yield directory


def find_unlisted_files(url: str) -> list[str]:
    """Return the files at a URL that no card lists, without those of replaced and perhaps unfinished builds."""
    place = open_place(url)
    entries = place.entries()
    pointers = list(_iterate_pointers(place, [entry.name for entry in entries]))
    builds = [_find_card(place.below(pointer.folder), [pointer.card]) for pointer in pointers[:1]]
    cards = [card for card in (*builds, _find_card(place, CARDS)) if card is not None]
    listed = {card.place.where(name) for card in cards for name in (*read_listed_files(card), REPORT, card.name)}
    others = {pointer.name for pointer in pointers}
    unexpected = {*(pointer.folder for pointer in pointers[:1]), *_find_expired(entries, pointers)}

    def is_expected(name: str) -> bool:
        build = _BUILD.match(name)
        return name in others or bool(build and build[1] not in unexpected)

    unlisted = (name for name, *_ in entries if place.where(name) not in listed)
    return [place.where(name) for name in unlisted if not is_expected(name)]


def _find_card(place: Place, cards: Sequence[str]) -> FoundCard | None:
    found = (FoundCard(place, name, data) for name in cards if (data := place.read(name)) is not None)
    return next(found, None)


def _iterate_pointers(place: Place, names: Iterable[str]) -> Iterator[_Pointer]:
    """Yield the pointers among the names at a place, the valid one first; skip damaged ones."""
    found = [match for name in names if (match := _POINTER.fullmatch(name))]
    for match in sorted(found, key=lambda match: (-int(match[1]), match[2])):
        data = place.read(match[0])
        if data is not None and compute_short_digest(data) == match[2]:
            yield replace(parse_typed_json(data, _Pointer, place.where(match[0])), name=match[0])


def _find_expired(entries: Sequence[FileEntry], pointers: Sequence[_Pointer]) -> list[str]:
    """Return pointers and folders that were not in use for seven days, by the bucket's times of modification."""
    if not pointers:
        return []
    times, ages = {entry.name: entry.modified_ns for entry in entries}, dict[str, int]()
    earliest = times[pointers[0].name] - _KEPT_NS
    kept = [pointers[0], *(old for new, old in pairwise(pointers) if times[new.name] >= earliest)]
    in_use = {name for pointer in kept for name in (pointer.name, pointer.folder)}
    for name, _, modified_ns in entries:
        if found := _BUILD.match(name) or _POINTER.fullmatch(name):
            build = found[1] if name.startswith(BUILDS) else name
            ages[build] = max(modified_ns, ages.get(build, 0))
    return [name for name, modified_ns in ages.items() if modified_ns < earliest and name not in in_use]


_CRC_BYTES = 4


@dataclass(frozen=True, slots=True)
class FetchedShards:
    """Shards of a dataset or map in a bucket, as if they were below ``root``; pieces are fetched by range, cached."""

    place: Place
    root: Path
    checksums: FileChecksums
    proves: bool = False
    """Whether the checksum of a shard is computed before a piece of it is read: once, until its ETag changes."""
    _proved: set[str] = field(default_factory=set)

    def size(self, path: Path) -> int:
        """Return the size of a shard [byte]; `FileNotFoundError` if it is missing."""
        return self._checksum(path).size_bytes

    def read(self, path: Path, offset: int, size: int) -> bytes:
        """Return a piece of a shard that ends with the CRC-32C of the rest; a changed cached copy is fetched again."""
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


def fetch_directory(path: Location) -> Path:
    """Return a local directory: the given one, or a copy of the files in a bucket's card for this process.

    `UsageError`: there is no card at the URL; `StoreError`: it cannot be read, or a file differs from its checksum.
    """
    return fetch_directory_by_range(path, by_range=lambda _: False)[0]


def fetch_directory_by_range(path: Location, *, by_range: Callable[[str], bool]) -> tuple[Path, FetchedShards | None]:
    """Return a directory as `fetch_directory` without the files ``by_range``, and where these are; None if local."""
    if not is_url(path):
        return Path(path), None
    url = str(path).rstrip("/")
    card = require_card(url)
    root = _make_copy_directory(url, card.data)
    (root / card.name).write_bytes(card.data)
    if (page := card.place.read(REPORT)) is not None:  # which no card lists, since it is drawn from that
        (root / REPORT).write_bytes(page)
    return root, _fetch_others(card.place, root, read_listed_files(card), by_range)


def fetch_files(
    place: Place, checksums: FileChecksums, *, by_range: Callable[[str], bool]
) -> tuple[Path, FetchedShards | None]:
    """Return a local directory with a place's files except those ``by_range``, and where these are read.

    A directory has all of them: it is returned itself, with None. `StoreError`: a file is missing or differs from its
    checksum.
    """
    if place.path is not None:
        return place.path, None
    root = _make_copy_directory(place.where(), repr(sorted(checksums.items())).encode())
    return root, _fetch_others(place, root, checksums, by_range)


def _fetch_others(place: Place, root: Path, checksums: FileChecksums, by_range: Callable[[str], bool]) -> FetchedShards:
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
    """Return a directory that is removed when the process ends; its path ends with the URL, as messages need it."""
    del version
    path = make_lasting_scratch().joinpath(*(part for part in url.split("/") if part not in ("", "..")))
    path.mkdir(parents=True, exist_ok=True)
    return path
