"""Seals: what lets `tcpipe verify` find one changed byte in files that no list of checksums can name (ADR 18).

A JSON document holds the sha256 of the rest of itself, a page that of all before its last line; a PNG brings its own checksums. What
a sealed document lists, by path, size and sha256, is proved by it in turn.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tcpipe.formats.dataset_files import checksums_to_json, file_checksum
from tcpipe.formats.json_files import digest, plain, to_json, write_json

SEAL = "document_sha256"
"""Key of a sealed document that holds the sha256 (hex) of its canonical JSON without this key."""

CHECKSUMS = "checksums.json"
"""In a directory whose files cannot be listed elsewhere: a sealed document with the key ``checksums``."""

_PAGE_SEAL = "<!-- sha256 of the lines above: {} -->\n"
_PNG_START = b"\x89PNG\r\n\x1a\n"


def write_sealed(path: Path, value: Mapping[str, Any]) -> None:
    """Write a JSON object with a seal, whole or not at all."""
    bare = {key: item for key, item in plain(value).items() if key != SEAL}
    write_json(path, {**bare, SEAL: digest(bare)})


def write_checksums(directory: Path) -> None:
    """Write ``checksums.json`` into a directory that is otherwise complete: every file below it."""
    write_sealed(directory / CHECKSUMS, {"checksums": checksums_to_json(directory)})


def sealed_page(html: str) -> str:
    """Return a page with its seal as the last line."""
    text = html if html.endswith("\n") else f"{html}\n"
    return text + _PAGE_SEAL.format(hashlib.sha256(text.encode()).hexdigest())


def broken_seal(path: Path) -> str | None:
    """Return in one line why a sealed file (``.json``, ``.html``) or a ``.png`` is not as it was written, None if it is."""
    try:
        data = path.read_bytes()
    except OSError as error:
        return f"{path}: cannot be read ({error.strerror})"
    whole = {".html": _page_is_whole, ".png": _png_is_whole}.get(path.suffix, _document_is_whole)
    return None if whole(data) else f"{path}: is not as it was written: its checksum does not agree"


def broken_checksums(directory: Path, checksums: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for every file below ``directory`` that is not what ``checksums`` has of it, ``size_bytes`` and ``sha256`` by path."""
    for name, entry in checksums.items():
        path = directory / name
        if not path.is_file():
            yield f"{path}: is gone"
            continue
        try:
            size_bytes, sha256 = file_checksum(path)
        except OSError as error:
            yield f"{path}: cannot be read ({error.strerror})"
            continue
        if (size_bytes, sha256) != (entry["size_bytes"], entry["sha256"]):
            size = "" if size_bytes == entry["size_bytes"] else f" ({size_bytes} bytes, wanted {entry['size_bytes']})"
            yield f"{path}: its sha256 is {sha256[:12]}…, wanted {entry['sha256'][:12]}…{size}"


def _document_is_whole(data: bytes) -> bool:
    try:
        value = json.loads(data)
    except ValueError:
        return False
    if not isinstance(value, dict) or SEAL not in value:
        return False
    bare = {key: item for key, item in value.items() if key != SEAL}
    return to_json({**bare, SEAL: digest(bare)}).encode() == data


def _page_is_whole(data: bytes) -> bool:
    end = data.rstrip(b"\n").rfind(b"\n") + 1
    return data[end:] == _PAGE_SEAL.format(hashlib.sha256(data[:end]).hexdigest()).encode()


def _png_is_whole(data: bytes) -> bool:
    """Walk the chunks (RFC 2083, section 3.2): length, type, data, CRC of type and data; the last is IEND."""
    at, kind = len(_PNG_START), b""
    while data.startswith(_PNG_START) and kind != b"IEND" and at + 12 <= len(data):
        size, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        end = at + 8 + size
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        at = end + 4
    return kind == b"IEND" and at == len(data)
