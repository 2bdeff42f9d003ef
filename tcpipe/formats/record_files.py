"""Records: small sealed facts, each a JSON file that is written once, where there was none, and never changed (ADR 50).

The name of a record follows from the fact, so that the same fact is one file whoever writes it, and however often.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tcpipe.errors import StoreError
from tcpipe.formats.atomic import TEMPORARY_PREFIX, clear, put_file
from tcpipe.formats.json_files import to_json
from tcpipe.formats.seals import read_sealed, sealed, write_sealed

logger = logging.getLogger("tcpipe")

_NAME_DIGITS = 32

_TROUBLE = {"content": str, "lines": [str], "log": [str]}
_FORMS: Mapping[str, Any] = {
    "logs": {"log": [str], "size_and_time": list, "sha256": str},
    "failed": _TROUBLE,
    "damaged": _TROUBLE,
    "accepted": _TROUBLE,
    "superseded": {"run_id": str, "number": int},
}
"""What a record of each kind must hold to be used."""


def record_name(digest: str) -> str:
    """Return the name of the record of a fact whose digest (hex) this is."""
    return digest[:_NAME_DIGITS]


def put_record(root: Path, name: str, value: Mapping[str, Any]) -> bool:
    """Write a record below ``root`` unless it is there already, whole; return whether this call did.

    Raises
    ------
    StoreError
        It cannot be written.

    """
    path = root / f"{name}.json"
    clear(root)
    if read_record(root, name) is not None:
        return False
    if put_file(path, to_json(sealed(value)), staging=root):
        return True
    if read_record(root, name) is not None:  # another process was faster
        return False
    write_sealed(path, value)
    return True


def read_record(root: Path, name: str) -> dict[str, Any] | None:
    """Return a record; None where there is none, and where it is not as it was written, which is said."""
    path = root / f"{name}.json"
    return _whole(path, name) if path.is_file() else None


def read_records(root: Path, kind: str) -> Iterator[dict[str, Any]]:
    """Yield the records in a directory below ``root``, by name; those that are not as they were written are named and left out."""
    for path in sorted((root / kind).glob("*.json")):
        if not path.name.startswith(TEMPORARY_PREFIX) and (found := _whole(path, kind)) is not None:
            yield found


def _whole(path: Path, name: str) -> dict[str, Any] | None:
    try:
        return read_sealed(path, _FORMS.get(name.partition("/")[0]))
    except StoreError as error:
        logger.error("%s; this record is ignored", error)  # noqa: TRY400  one line
        return None
