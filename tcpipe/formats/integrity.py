"""Checksums inside documents, by which `tcpipe verify` finds a changed byte without a separate list (ADR-36).

A JSON document contains the sha256 of the rest of itself; a page, of all text before its last line. What a sealed
document lists, by path, size and sha256, is proved by it in turn.
"""

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from tcpipe.errors import StoreError
from tcpipe.formats.atomic import Location
from tcpipe.formats.json_files import Json, digest, parse_json, parse_typed, read_document, to_plain, write_json

T = TypeVar("T")

SEAL = "document_sha256"
"""Key of a sealed document that holds the sha256 (hex) of its canonical JSON without this key."""

CHECKSUMS = "checksums.json"
"""In a directory whose files cannot be listed elsewhere: a sealed document with the key ``checksums``."""

# The seal in canonical JSON; its hash is that of the text without this line.
_SEAL_LINE = re.compile(rb'^  "document_sha256": "([0-9a-f]{64})"(,?)\n', re.MULTILINE)

ALL_CHANGES = "; 'tcpipe verify {}' lists all changed files"
"""End of a message on one changed file."""

_PAGE_SEAL = "<!-- sha256 of the lines above: {} -->\n"


@dataclass(frozen=True, slots=True)
class Checksum:
    """Size and hash of a file in a sealed document."""

    size_bytes: int
    sha256: str


FileChecksums = Mapping[str, Checksum]


@dataclass(frozen=True, slots=True)
class Checksums:
    """The document ``checksums.json``: every file of its directory, by path."""

    checksums: FileChecksums


def compute_short_digest(data: bytes) -> str:
    """Return the first 16 hexadecimal digits of the sha256, which file names contain for readers to check."""
    return hashlib.sha256(data).hexdigest()[:16]


def write_sealed(path: Path, value: object) -> None:
    """Write a JSON object with a seal, whole or not at all."""
    write_json(path, seal_document(value))


def seal_document(value: object) -> dict[str, Json]:
    """Return a dataclass or a mapping as a JSON object with its seal."""
    bare = {key: item for key, item in to_plain(value).items() if key != SEAL}
    return {**bare, SEAL: digest(bare)}


def read_sealed(path: Path, *, ours: Callable[[Mapping[str, Json]], bool] = lambda _: True) -> dict[str, Json]:
    """Read a JSON object that `write_sealed` wrote, and prove it.

    What is not ``ours``, by kind and version, is returned unproved, for the caller to refuse.
    """
    return verify_document(read_document(path), path, ours=ours)


def verify_document(
    data: bytes, where: Location, *, ours: Callable[[Mapping[str, Json]], bool] = lambda _: True
) -> dict[str, Json]:
    """Return the verified JSON object in the bytes of the document at ``where``; see `read_sealed`."""
    remedy = ALL_CHANGES.format(str(where).rpartition("/")[0])
    found = parse_json(data, where, remedy=remedy)
    if not ours(found):
        return found
    if not _is_whole_document(data):
        raise StoreError(f"{describe_broken(where)}{remedy}")
    return found


def read_sealed_as(path: Path, cls: type[T]) -> T:
    """Read and prove a sealed JSON object, as a dataclass; `StoreError` as `read_sealed`."""
    return parse_typed(read_sealed(path), cls, path)


def write_checksums(directory: Path) -> None:
    """Write ``checksums.json`` into a directory that is otherwise complete: every file below it."""
    write_sealed(directory / CHECKSUMS, Checksums(compute_checksums(directory)))


def read_checksums(directory: Path) -> FileChecksums:
    """Return the checksum of every file in ``checksums.json``; `StoreError` as `read_sealed`."""
    return read_sealed_as(directory / CHECKSUMS, Checksums).checksums


def seal_page(html: str) -> str:
    """Return a page with its seal as the last line."""
    text = html if html.endswith("\n") else f"{html}\n"
    return text + _PAGE_SEAL.format(hashlib.sha256(text.encode()).hexdigest())


def describe_broken(path: Location) -> str:
    """Return the line about a file that differs from its seal or checksum."""
    return f"{path}: has changed since it was written: its checksum differs"


def find_broken_seal(data: bytes | None, where: Location) -> str | None:
    """Return in one line how a sealed file (``.json``, ``.html``) at ``where`` differs from its seal; or None."""
    if data is None:
        return f"{where}: is missing"
    is_whole = _is_whole_page(data) if Path(where).suffix == ".html" else _is_whole_document(data)
    return None if is_whole else describe_broken(where)


def find_wrong_checksum(where: Location, found: Checksum | None, wanted: Checksum | None) -> str | None:
    """Return one line on how a file differs from its record in a document (None: no record); None if it is equal."""
    if found is None:
        return f"{where}: is missing"
    if wanted is None:
        return f"{where}: its sha256 is not on record"
    if found == wanted:
        return None
    size = "" if found.size_bytes == wanted.size_bytes else f" ({found.size_bytes} bytes, expected {wanted.size_bytes})"
    return f"{where}: its sha256 is {found.sha256[:12]}…, expected {wanted.sha256[:12]}…{size}"


def compute_checksum(path: Path) -> Checksum:
    """Return size and sha256 of a file."""
    with path.open("rb") as stream:
        return Checksum(path.stat().st_size, hashlib.file_digest(stream, "sha256").hexdigest())


def compute_checksums(directory: Path) -> dict[str, Checksum]:
    """Return size and sha256 of every file below ``directory``, by its path inside it."""
    files = sorted(entry for entry in directory.rglob("*") if entry.is_file())
    return {path.relative_to(directory).as_posix(): compute_checksum(path) for path in files}


def _is_whole_document(data: bytes) -> bool:
    seal = _SEAL_LINE.search(data)
    if seal is None:
        return False
    before, after = data[: seal.start()], data[seal.end() :]
    if not seal[2]:  # the last key: without it the one before has no comma
        if not before.endswith(b",\n"):
            return False
        before = before[:-2] + b"\n"
    return hashlib.sha256(before + after).hexdigest().encode() == seal[1]


def _is_whole_page(data: bytes) -> bool:
    end = data.rstrip(b"\n").rfind(b"\n") + 1
    return data[end:] == _PAGE_SEAL.format(hashlib.sha256(data[:end]).hexdigest()).encode()
