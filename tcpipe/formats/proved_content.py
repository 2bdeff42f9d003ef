"""Files that are held against their checksums once: a digest is remembered until its file, or its object in a bucket, changes.

What is remembered lies in the cache of `tcpipe.formats.content_cache`, under what changes with the content (`Place.version`). A digest
that does not agree is always found anew before it is told.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tcpipe.errors import StoreError
from tcpipe.formats.content_cache import fetch_cached
from tcpipe.formats.integrity import Checksum, find_wrong_checksum
from tcpipe.formats.place import Place

_AT_ONCE = 4
"""Files that are read side by side: a disk gives no more, and two cores hash 1 to 3 GB a second."""


def find_wrong_files(place: Place, checksums: Mapping[str, Checksum], names: Iterable[str]) -> list[str]:
    """Return a line for each file at a place that is not what a card has of it; all sizes are compared before a file is read.

    Parameters
    ----------
    place : where the files lie.
    checksums : what the card has of them, by name.
    names : which of them.
    """
    names = list(names)
    sizes = [line for name in names if (line := _check_size(place, name, checksums.get(name)))]
    if sizes:
        return sizes
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return [line for line in pool.map(lambda name: _check_digest(place, name, checksums[name]), names) if line]


def _check_size(place: Place, name: str, wanted: Checksum | None) -> str | None:
    size, where = place.size(name), place.where(name)
    if size is None or wanted is None:
        return find_wrong_checksum(where, None if size is None else Checksum(size, ""), wanted)
    return None if size == wanted.size_bytes else f"{where}: {size} bytes, wanted {wanted.size_bytes}"


def _check_digest(place: Place, name: str, wanted: Checksum) -> str | None:
    version = place.version(name)
    if version is not None and _read_remembered(place, name, version) == wanted.sha256:
        return None
    return find_wrong_checksum(place.where(name), place.checksum(name), wanted)


def _read_remembered(place: Place, name: str, version: str) -> str | None:
    """Return the digest of a version of a file, found now where it is not remembered; None where it cannot be kept."""

    def find(to: Path) -> None:
        checksum = place.checksum(name)
        to.write_text("" if checksum is None else checksum.sha256)

    try:
        return fetch_cached(f"sha256 of {version}", find).read_text(errors="replace")
    except (OSError, StoreError):
        return None
