"""Comparisons of files at a place with checksums that a document lists (ADR-36)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tcpipe.errors import StoreError
from tcpipe.formats.cache import fetch_cached
from tcpipe.formats.integrity import ALL_CHANGES, Checksum, find_wrong_checksum
from tcpipe.formats.object_storage import split_into_pieces
from tcpipe.formats.place import Place

_READS_AT_ONCE = 4
"""Files that are hashed at the same time: two cores hash 1 to 3 GB a second, more than a disk reads."""


def find_wrong_files(place: Place, checksums: Mapping[str, Checksum | None]) -> Iterator[str]:
    """Yield a line for every file at a place that differs from its checksum (None: not on record); each is read in place."""
    for name, wanted in checksums.items():
        try:
            line = _check_size(place, name, wanted)
            line = line or find_wrong_checksum(place.where(name), _compute_digest(place, name), wanted)
        except StoreError as error:
            line = error.problems[0]
        if line:
            yield line


def prove_files(directory: Path, checksums: Mapping[str, Checksum], names: Iterable[str]) -> None:
    """Compare files of a directory with their checksums; `StoreError` names the first that differs."""
    lines = list(find_wrong_files(Place(directory), {name: checksums.get(name) for name in names}))
    if lines:
        more = f", and {len(lines) - 1} more" if len(lines) > 1 else ""
        raise StoreError(f"{lines[0]}{more}{ALL_CHANGES.format(directory)}")


def find_changed_files(place: Place, checksums: Mapping[str, Checksum], names: Iterable[str]) -> list[str]:
    """Return a line for each named file that differs from its checksum; all sizes are compared before a file is read.

    The cache keeps the digest of a file under its `Place.version`: a file is hashed again only after it has changed.
    """
    names = list(names)
    sizes = [line for name in names if (line := _check_size(place, name, checksums.get(name)))]
    if sizes:
        return sizes
    with ThreadPoolExecutor(_READS_AT_ONCE) as pool:
        return [line for line in pool.map(lambda name: _check_digest(place, name, checksums[name]), names) if line]


def _check_size(place: Place, name: str, wanted: Checksum | None) -> str | None:
    size, where = place.size(name), place.where(name)
    if size is None or wanted is None:
        return find_wrong_checksum(where, None if size is None else Checksum(size, ""), wanted)
    return None if size == wanted.size_bytes else f"{where}: has {size} bytes, expected {wanted.size_bytes}"


def _check_digest(place: Place, name: str, wanted: Checksum) -> str | None:
    version = place.version(name)
    if version is not None and _read_remembered(place, name, version) == wanted.sha256:
        return None
    return find_wrong_checksum(place.where(name), _compute_digest(place, name), wanted)


def _read_remembered(place: Place, name: str, version: str) -> str | None:
    """Return the digest of a version of a file, computed if the cache has none; None if the cache cannot keep it."""

    def find(to: Path) -> None:
        checksum = _compute_digest(place, name)
        to.write_text("" if checksum is None else checksum.sha256)

    try:
        return fetch_cached(f"sha256 of {version}", find).read_text(errors="replace")
    except (OSError, StoreError):
        return None


def _compute_digest(place: Place, name: str) -> Checksum | None:
    """Return size and sha256 of a file, read in place, piece by piece; None if it does not exist."""
    size = place.size(name)
    if size is None:
        return None
    digest = hashlib.sha256()
    for start, stop in split_into_pieces(size):
        digest.update(place.read_range(name, start, stop - start))
    return Checksum(size, digest.hexdigest())
