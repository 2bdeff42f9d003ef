"""JSON documents (manifests, cards): sorted keys, no clock, so that the same content is the same bytes."""

import hashlib
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import msgspec

from tcpipe.errors import StoreError
from tcpipe.formats.atomic import Location, write_text

T = TypeVar("T")
Json = str | float | bool | None | Sequence["Json"] | Mapping[str, "Json"]
"""A value in a format of another standard (JSON-LD, CF attributes); documents of tcpipe are dataclasses."""

_CONVERTING = Lock()  # lock: msgspec (0.22) crashes if two threads use a new dataclass at the same time

MOST_BYTES = 32 << 20
"""A document is at most so large [byte], written and read: the card of ten thousand runs."""


def to_plain(value: Any) -> Any:
    """Return ``value`` as JSON values: dataclasses become objects, numpy values numbers or lists, NaN and inf null."""
    if is_dataclass(value) and not isinstance(value, type):
        entries = ((entry.name, getattr(value, entry.name), entry.metadata.get("json", ())) for entry in fields(value))
        value = {name: item for name, item, left_out in entries if not (left_out and item in left_out)}
    elif isinstance(value, Enum):
        value = value.value
    elif hasattr(value, "tolist"):  # numpy scalars and arrays
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def convert_record(record: object, cls: Callable[..., T], **more: object) -> T:
    """Return a record of another dataclass, with the fields that ``record`` shares with it; ``more`` has priority."""
    names = (entry.name for entry in fields(cls) if entry.name not in more)  # type: ignore[arg-type]
    return cls(**{name: getattr(record, name) for name in names if hasattr(record, name)}, **more)


def to_compact_json(value: object) -> bytes:
    """Return the JSON of dataclasses with finite numbers, for `parse_typed_json`; faster than `to_json_line`."""
    try:
        return msgspec.json.encode(value)
    except UnicodeEncodeError:  # the name of a file is no text
        return to_json_line(value).encode()


def to_json(value: Any) -> str:
    """Return canonical JSON text: sorted keys, two-space indent, final newline; undecodable file names as escapes."""
    text = json.dumps(to_plain(value), sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def to_json_line(value: Any) -> str:
    """Return the same JSON on one line, without a line break at the end."""
    text = json.dumps(to_plain(value), sort_keys=True, ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as canonical JSON, whole or not at all; `StoreError` if it is too large to be read again."""
    text = to_json(value)
    if len(text) > MOST_BYTES // 4 and len(text.encode()) > MOST_BYTES:
        raise StoreError(f"{path}: would be more than {MOST_BYTES >> 20} MB, the most that tcpipe reads")
    write_text(path, text)


def read_json(path: Path) -> dict[str, Json]:
    """Read one JSON object; `StoreError` names a file that cannot be read."""
    return parse_json(read_document(path), path)


def read_document(path: Path) -> bytes:
    """Return the bytes of a JSON file; `StoreError` if it is unreadable, no file, or larger than `MOST_BYTES`."""
    try:
        if path.exists() and not path.is_file():
            raise StoreError(f"{path}: is no file; remove it and run the command again")
        with path.open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
    except OSError as error:
        raise StoreError(f"{path}: cannot be read ({error.strerror}); run the command again that writes it") from None
    if len(data) > MOST_BYTES:
        raise StoreError(f"{path}: is larger than {MOST_BYTES >> 20} MB, the most that tcpipe writes; remove it")
    return data


def parse_json(
    data: bytes, path: Location, *, remedy: str = "; remove it and run the command again"
) -> dict[str, Json]:
    """Return the JSON object in the bytes of a file; `StoreError` if they are no JSON object."""
    try:
        found = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not a readable JSON file ({error}){remedy}") from None
    if not isinstance(found, dict):
        raise StoreError(f"{path}: contains {type(found).__name__}, expected a JSON object{remedy}")
    return found


def read_as(path: Path, cls: type[T]) -> T:
    """Read one JSON object as a dataclass; `StoreError` names a file that cannot be read, or the wrong key in it."""
    return parse_typed(read_json(path), cls, path)


def parse_typed(value: object, cls: type[T], path: Location) -> T:
    """Return a JSON object as a dataclass: missing keys have their defaults, and unknown keys are ignored.

    `StoreError`: a value is missing, or of another type; the line names ``path`` and the key.
    """
    try:
        with _CONVERTING:
            return msgspec.convert(value, cls, str_keys=True, dec_hook=_from_text)
    except msgspec.ValidationError as error:
        raise StoreError(
            f"{path}: does not have the format of this version: {_format_validation_error(str(error))}"
        ) from None


def parse_typed_json(text: str | bytes | memoryview, cls: type[T], path: Location) -> T:
    """Return JSON text as a dataclass, or as a container of dataclasses; see `parse_typed`."""
    try:
        with _CONVERTING:
            return msgspec.json.decode(text, type=cls)
    except msgspec.DecodeError as error:
        if "surrogate" in str(error):  # the name of a file is no text: only the standard library reads it
            return parse_typed(json.loads(text if isinstance(text, str) else bytes(text)), cls, path)
        raise StoreError(
            f"{path}: does not have the format of this version: {_format_validation_error(str(error))}"
        ) from None


def _format_validation_error(message: str) -> str:
    """Return msgspec's error, the key first; it reports ``Expected `int`, got `str` - at `$.counts.segments```."""
    what, _, place = message.partition(" - at ")
    key = re.sub(r"^key in ", "", place.strip("`")).removeprefix("$").removeprefix(".")
    if missing := re.fullmatch(r"Object missing required field `(.+)`", what):
        return f"{key}.{missing[1]} is missing".removeprefix(".")
    plain_names = re.sub(
        r"`(.+?)`", lambda name: " or ".join(_JSON_NAMES.get(n, n) for n in name[1].split(" | ")), what
    )
    return f"{key}: {plain_names.replace('Expected', 'expected')}".removeprefix(": ")


_JSON_NAMES = {
    "object": "an object", "array": "a list", "str": "a text", "int": "a whole number", "float": "a number", "bool": "true or false",
}  # fmt: skip


def _from_text(kind: type, text: str) -> Path:
    if kind is not Path:
        raise NotImplementedError(kind)
    return Path(text)


def digest(value: Any) -> str:
    """Return the sha256 (hex) of the canonical JSON of ``value``."""
    return hashlib.sha256(to_json(value).encode()).hexdigest()
