"""Directories with a sealed card (datasets, models, cost maps) in a bucket: fetched to this machine, and put there, card last (ADR-30).

The card lists every other file with its checksum. So a reader sees all of one attempt or none, what is cached is told by its content, and
whoever else puts the same content helps.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import google_crc32c

from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.atomic import lasting_scratch, scratch_directory
from tcpipe.formats.bucket import open_place, side_by_side
from tcpipe.formats.content_cache import cached, is_cached
from tcpipe.formats.json_files import parse_json, typed
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.place import DirectoryPlace, Place
from tcpipe.formats.proved_content import wrong_files
from tcpipe.formats.seals import Checksum, Checksums, broken_checksums

logger = logging.getLogger("tcpipe")

CARDS = ("dataset.json", "model.json", "cost-map.json")
"""Documents that prove all files beside them."""
_UNLISTED = ("report.html",)
"""What lies beside a card that does not list it, since it is made of it."""
REPORT_PATCHES = "report-patches"
"""Folder beside a dataset's page, of pictures that it shows: unlisted too."""
CLAIM = "writing.json"
"""The card of who puts a directory there, as long as that goes on."""
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
        """Return the size of a shard [byte]; `FileNotFoundError` where there is none."""
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

    def expect(self, pieces: Iterable[tuple[Path, int, int]]) -> None:
        """Have pieces (shard, offset, size) cached that are read soon, fetched side by side."""
        pieces = list(pieces)
        self._prove({self._name(path) for path, *_ in pieces})
        absent = [piece for piece in pieces if not is_cached(self._key(*piece))]
        side_by_side(self.place.where(), lambda piece: self._held(*piece), absent)

    def whole(self, path: Path) -> Path:
        """Return a cached copy of a whole file."""
        return self.place.local(self._name(path), self._checksum(path))

    def _prove(self, names: set[str]) -> None:
        """Raise `StoreError` where a shard is not what its card says."""
        if not self.proves or names <= self._proved:
            return
        if wrong := wrong_files(self.place, self.checksums, sorted(names - self._proved)):
            raise StoreError(*wrong)
        self._proved.update(names)

    def _held(self, path: Path, offset: int, size: int) -> Path:
        key, name = self._key(path, offset, size), self._name(path)
        return cached(key, lambda to: to.write_bytes(self.place.read_range(name, offset, size)))

    def _key(self, path: Path, offset: int, size: int) -> str:
        return f"{self._checksum(path).sha256} {offset} {size}"

    def _name(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()

    def _checksum(self, path: Path) -> Checksum:
        found = self.checksums.get(self._name(path))
        if found is None:
            raise FileNotFoundError(str(path))
        return found


def here(path: str | Path) -> Path:
    """Return a directory of this machine: the one that is named, or a copy of what a card in a bucket lists while this process runs.

    Raises
    ------
    UsageError : there is no card at the URL.
    StoreError : it cannot be read, or a file is not as the card says.
    """
    return Path(path) if not is_url(path) else _mirrored(str(path).rstrip("/"), lambda _: True)[0]


@contextmanager
def anew(url: str) -> Iterator[Path]:
    """Yield a copy of what a card in a bucket lists, as it lies there now: nothing is taken from the cache, and nothing proved.

    Raises
    ------
    UsageError : there is no card at the URL.
    StoreError : it cannot be read.
    """
    place = open_place(url)
    with scratch_directory() as held:
        root = _below(held, url)

        def bring(name: str) -> None:
            if (data := place.read(name)) is not None:
                (root / name).parent.mkdir(parents=True, exist_ok=True)
                (root / name).write_bytes(data)

        _, checksums, _ = _card_of(place, url)
        side_by_side(url, bring, [*checksums, *CARDS, *_UNLISTED])
        yield root


def here_by_range(path: str | Path, *, by_range: Callable[[str], bool]) -> tuple[Path, FetchedShards | None]:
    """Return a directory as `here`, without the files whose names are ``by_range``, and where these are read; None on this machine."""
    return (Path(path), None) if not is_url(path) else _mirrored(str(path).rstrip("/"), lambda name: not by_range(name))


def has_card(url: str) -> bool:
    """Tell whether a directory with a card lies at a URL."""
    return _card_at(open_place(url)) is not None


def others_beside(url: str) -> list[str]:
    """Return what lies at a URL and is not listed by the card there."""
    place = open_place(url)
    name, data = _card_at(place) or ("", b"{}")
    listed = typed(parse_json(data, Path(place.where(name))), Checksums, Path(place.where(name))).checksums
    names = {entry.name for entry in place.entries() if not entry.name.startswith(f"{REPORT_PATCHES}/")}
    return [place.where(other) for other in sorted(names - {*listed, *_UNLISTED, name})]


def _card_at(place: Place) -> tuple[str, bytes] | None:
    return next(((name, data) for name in CARDS if (data := place.read(name)) is not None), None)


def _card_of(place: Place, url: str) -> tuple[str, Mapping[str, Checksum], bytes]:
    """Return the name of the card at a place, what it lists, and the card."""
    found = _card_at(place)
    if found is None:
        raise UsageError(f"{url}: there is no dataset, model or cost map here: none of {', '.join(CARDS)}")
    name, data = found
    where = place.where(name)
    checksums = typed(parse_json(data, Path(where)), Checksums, Path(where)).checksums
    if outside := [file for file in checksums if file.startswith("/") or ".." in file.split("/")]:
        raise StoreError(f"{where}: names {outside[0]!r}, which is no file beside it")
    return name, checksums, data


def _mirrored(url: str, wanted: Callable[[str], bool]) -> tuple[Path, FetchedShards]:
    place = open_place(url)
    name, checksums, data = _card_of(place, url)
    root = _below(_kept(url, data), url)
    (root / name).write_bytes(data)
    for unlisted in _UNLISTED:
        if (page := place.read(unlisted)) is not None:
            (root / unlisted).write_bytes(page)
    return root, _brought(place, root, checksums, wanted)


def files_here(
    place: Place, checksums: Mapping[str, Checksum], *, by_range: Callable[[str], bool]
) -> tuple[Path, FetchedShards | None]:
    """Return a directory of this machine in which files of a place lie but those that are ``by_range``, and where these are read.

    A directory holds all of them: it is returned itself, with None. `StoreError` where a file cannot be had as its checksum says.
    """
    if isinstance(place, DirectoryPlace):
        return place.root, None
    root = _below(_kept(place.where(), repr(sorted(checksums.items())).encode()), place.where())
    return root, _brought(place, root, checksums, lambda name: not by_range(name))


def _brought(
    place: Place, root: Path, checksums: Mapping[str, Checksum], wanted: Callable[[str], bool]
) -> FetchedShards:
    """Bring what is wanted of a place's files below ``root``; return where the others are read."""
    absent = [(file, checksum) for file, checksum in checksums.items() if wanted(file) and not (root / file).exists()]
    side_by_side(place.where(), lambda of: _bring(place, *of, root / of[0]), absent)
    return FetchedShards(place, root, checksums)


@cache
def _kept(url: str, card: bytes) -> Path:
    """Return a directory for a card at a URL, which goes when the process ends."""
    del url, card
    return lasting_scratch()


def _below(directory: Path, url: str) -> Path:
    """Return where a copy of what lies at a URL lies in a directory: so that lines about its files show where they are from."""
    path = directory.joinpath(*(part for part in url.split("/") if part not in ("", "..")))
    path.mkdir(parents=True, exist_ok=True)
    return path


def _bring(place: Place, name: str, checksum: Checksum, to: Path) -> None:
    """Link or copy the cached content of a file to where it is wanted; a cached copy that is not as it was goes and is fetched anew."""
    to.parent.mkdir(parents=True, exist_ok=True)
    for _ in range(2):
        held = place.local(name, checksum)
        with suppress(FileExistsError):
            try:
                os.link(held, to)
            except OSError:
                shutil.copyfile(held, to)
        if not list(broken_checksums(to.parent, {to.name: checksum})):
            return
        held.unlink(missing_ok=True)
        to.unlink()
    raise StoreError(f"{place.where(name)}: is not as its card says, {checksum.sha256[:12]}…")


@contextmanager
def published(url: str, card: str) -> Iterator[Path]:
    """Yield a directory; what lies in it at the end, with a card, is put to a URL: the card last, and only where there is none.

    Of two that put the same there, either completes it, and a killed one is completed by the next call. Two whose contents differ are never
    mixed: the second is refused.

    Raises
    ------
    StoreError : another one puts something else there, something lies there already, or the place cannot be written.
    """
    place = open_place(url)
    refuse_others(place, card)
    with scratch_directory() as held:
        directory = held / (url.rstrip("/").rpartition("/")[2])
        directory.mkdir()
        yield directory
        document = (directory / card).read_bytes()
        claim = place.read(CLAIM) if not place.put_new(CLAIM, document) else document
        if claim != document:
            raise StoreError(
                f"{url}: another one writes something else there since ({CLAIM}); wait for it, or give another place; "
                "if it was killed, remove what lies there"
            )
        there = place.read(card)
        if there is None:
            (directory / card).rename(held / card)
            place.put_files("", directory)
            there = document if place.put_new(card, document) else place.read(card)
        place.delete(CLAIM)
        if there != document:
            raise StoreError(f"{url}: another one has written it meanwhile; what lies in a bucket is not replaced")


def settle(url: str) -> None:
    """Remove the claim of a killed call whose card is there."""
    if open_place(url).size(CLAIM) is not None:
        open_place(url).delete(CLAIM)


def refuse_others(place: Place, card: str) -> None:
    """Raise `UsageError` where something lies that is no directory of this card and was not left by one that was being put there."""
    names = {entry.name for entry in place.entries()}
    if names and not names & {card, CLAIM}:
        raise UsageError(f"{place.where()}: holds {min(names)} and no {card}; it is left alone; give another place")
    if card in names:
        settle(place.where())
        raise UsageError(
            f"{place.where()}: is there already; what lies in a bucket is not replaced: give another place"
        )
