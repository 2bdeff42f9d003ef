"""Datasets, models, cost maps and evaluations at a URL: each build is a folder, and one pointer names the newest (ADR-36).

::

    builds/6d0c3c1b9a0e4f27/            the files of a build, in a folder with a random name
    current.2.1f0c8a3be2d94c57.json     the pointer of the second build: its folder, and the name of its card

A pointer is written after the files and never changed. The highest number counts, then the smallest digest; bytes whose sha256 does not
begin with the digest in their name are no pointer. Files at a URL without a pointer, as a copy put them there, are read as they are.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from tcpipe.errors import StoreError, UsageError
from tcpipe.formats.atomic import make_scratch_directory, make_unique_name
from tcpipe.formats.integrity import Checksum, Checksums, compute_short_digest
from tcpipe.formats.json_files import parse_json, parse_typed, parse_typed_json, to_json
from tcpipe.formats.object_storage import is_bucket, is_url
from tcpipe.formats.place import Entry, Place, open_place

CARDS = ("dataset.json", "model.json", "cost-map.json")
"""Documents with the checksums of all files beside them."""
UNLISTED = ("report.html",)
"""Files next to a card that does not list them, since they are written from it."""
REPORT_PATCHES = "report-patches"
"""Folder of pictures that a dataset's page shows; no card lists them."""
BUILDS = "builds"
_BUILD = re.compile(rf"({BUILDS}/[0-9a-f]{{16}})/")
_POINTER = re.compile(r"current\.(\d+)\.([0-9a-f]{16})\.json")
_KEPT_NS = 7 * 24 * 3600 * 10**9
"""Time for which a build stays after its replacement, so that readers can finish [ns]."""


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
    """Return the card of the newest build at a URL, in three requests; None for another kind than ``cards``, or without a build."""
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


def read_listed_files(card: FoundCard) -> Mapping[str, Checksum]:
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
def open_output(out: str | Path, card: str) -> Iterator[Path]:
    """Yield the directory to write an output into: ``out`` itself, or of a URL one whose files become its newest build."""
    if not is_url(out):
        yield Path(out)
        return
    with write_output(str(out), card) as directory:
        yield directory


def find_unlisted_files(url: str) -> list[str]:
    """Return the files at a URL that no card there lists, without those of replaced builds and of builds that may be going on."""
    place = open_place(url)
    entries = place.entries()
    pointers = list(_iterate_pointers(place, [entry.name for entry in entries]))
    builds = [_find_card(place.below(pointer.folder), [pointer.card]) for pointer in pointers[:1]]
    cards = [card for card in (*builds, _find_card(place, CARDS)) if card is not None]
    listed = {card.place.where(name) for card in cards for name in (*read_listed_files(card), *UNLISTED, card.name)}
    others = {pointer.name for pointer in pointers}
    unexpected = {*(pointer.folder for pointer in pointers[:1]), *_find_expired(entries, pointers)}

    def is_expected(name: str) -> bool:
        build = _BUILD.match(name)
        return name in others or f"/{REPORT_PATCHES}/" in f"/{name}" or bool(build and build[1] not in unexpected)

    unlisted = (name for name, *_ in entries if place.where(name) not in listed)
    return [place.where(name) for name in unlisted if not is_expected(name)]


def _find_card(place: Place, cards: Sequence[str]) -> FoundCard | None:
    found = (FoundCard(place, name, data) for name in cards if (data := place.read(name)) is not None)
    return next(found, None)


def _iterate_pointers(place: Place, names: Iterable[str]) -> Iterator[_Pointer]:
    """Yield the pointers among the names at a place, the one that counts first; damaged ones are skipped."""
    found = [match for name in names if (match := _POINTER.fullmatch(name))]
    for match in sorted(found, key=lambda match: (-int(match[1]), match[2])):
        data = place.read(match[0])
        if data is not None and compute_short_digest(data) == match[2]:
            yield replace(parse_typed_json(data, _Pointer, place.where(match[0])), name=match[0])


def _find_expired(entries: Sequence[Entry], pointers: Sequence[_Pointer]) -> list[str]:
    """Return pointers and folders that have not been in use for seven days; the bucket's own times of modification decide."""
    if not pointers:
        return []
    times, ages = {entry.name: entry.modified_ns for entry in entries}, dict[str, int]()
    earliest = times[pointers[0].name] - _KEPT_NS
    kept = [pointers[0], *(old for new, old in pairwise(pointers) if times[new.name] >= earliest)]
    in_use = {name for pointer in kept for name in (pointer.name, pointer.folder)}
    for name, _, modified_ns in entries:
        if found := _BUILD.match(name) or _POINTER.fullmatch(name):
            of = found[1] if name.startswith(BUILDS) else name
            ages[of] = max(modified_ns, ages.get(of, 0))
    return [name for name, modified_ns in ages.items() if modified_ns < earliest and name not in in_use]
