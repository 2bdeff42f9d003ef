"""Numbered documents, ``<stem>-<n>.json``: none ever changes, and the one of the highest number holds (ADR-28).

A writer first puts the files that its document names, each under a name that follows from its content, then the document under the next
number, where there is none. So a reader sees a whole generation or the one before, and of two writers one is told that it came second.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

from tcpipe.errors import StoreError
from tcpipe.formats.integrity import Checksum, seal_document, verify_document
from tcpipe.formats.json_files import Json, digest, parse_typed, to_json
from tcpipe.formats.place import Place

T = TypeVar("T")

_NUMBERED = re.compile(r"(.+)-([1-9]\d*)\.json")
_DIGEST_HEX = 16


def name_document(stem: str, number: int) -> str:
    """Return the name of a document."""
    return f"{stem}-{number}.json"


def split_number(name: str) -> tuple[str, int] | None:
    """Return what a document's name says; None for any other name."""
    found = _NUMBERED.fullmatch(name)
    return (found[1], int(found[2])) if found else None


def find_highest_numbers(names: Iterable[str]) -> dict[str, int]:
    """Return, by stem, the highest number among names."""
    found: dict[str, int] = {}
    documents = (split_number(name) for name in names if name.endswith(".json"))
    for stem, number in filter(None, documents):
        found[stem] = max(number, found.get(stem, 0))
    return found


def read_sealed_at(
    place: Place, name: str, *, ours: Callable[[Mapping[str, Json]], bool] = lambda _: True
) -> dict[str, Json]:
    """Read and prove a sealed document; `StoreError` where it is gone, or not as it was written."""
    data = place.read(name)
    if data is None:
        raise StoreError(f"{place.where(name)}: is gone")
    return verify_document(data, place.where(name), ours=ours)


def read_as_at(place: Place, name: str, cls: type[T]) -> T:
    """Read and prove a sealed document as a dataclass; `StoreError` as `read_sealed_at`."""
    return parse_typed(read_sealed_at(place, name), cls, place.where(name))


def put_next(place: Place, stem: str, value: T, *, after: int, settled: Callable[[T], bool] = lambda _: False) -> T:
    """Write a document under the first free number from ``after`` + 1 on, and return it.

    The one of number ``after`` is returned instead if it has the same bytes, and so is one that others put there meanwhile if it is
    ``settled``: what this call would write. One that is not as it was written is passed over.
    """
    data = to_json(seal_document(value)).encode()
    number = max(after, 1)
    while True:
        name = name_document(stem, number)
        if number > after and place.put_new(name, data):
            return value
        try:
            found = read_as_at(place, name, type(value))
        except StoreError:
            found = None
        if found is not None and (place.read(name) == data or (number > after and settled(found))):
            return found
        number += 1


def name_folder(checksums: Mapping[str, Checksum]) -> str:
    """Return the name of a directory with these files."""
    return digest(dict(checksums))[:_DIGEST_HEX]
