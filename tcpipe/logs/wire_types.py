"""What a message definition says of the bytes: scalars, texts, arrays and records, as one small tree; and the text of a definition.

Both ROS 1 serialisation and CDR lay these types out field after field; how is `tcpipe.logs.wire_cursors`'s knowledge.

A .msg definition (http://wiki.ros.org/msg, and ROS 2's bounds and defaults) in a log holds the message first, then every message it is
made of, each below a line of ``=`` and ``MSG: package/Name``. Constants, defaults and comments do not matter for reading.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from tcpipe.logs.topics import normalize_type_name

MAX_COLUMNS = 20_000
"""A definition that unfolds to more leaves than this is refused (nested arrays of nested records grow exponentially)."""
MAX_FIXED_ELEMENTS = 100_000
"""A definition whose fixed arrays hold more texts or messages than this is refused."""


@dataclass(frozen=True, slots=True)
class Scalar:
    """A number or a truth value; ``code`` is numpy's, without byte order (``u1``, ``f8``, ``?``)."""

    code: str


@dataclass(frozen=True, slots=True)
class Text:
    """A length-prefixed string: so many bytes of UTF-8."""


@dataclass(frozen=True, slots=True)
class Record:
    """A message: named fields in wire order, which unfold to so many columns."""

    name: str
    fields: tuple[tuple[str, WireType], ...]
    leaves: int


@dataclass(frozen=True, slots=True)
class Array:
    """``length`` elements, or, where it is None, as many as a count before them says."""

    element: Scalar | Text | Record
    length: int | None


WireType = Scalar | Text | Record | Array


def count_leaves(wire_type: WireType) -> int:
    """Return into how many columns the type unfolds; an array counts its element once."""
    match wire_type:
        case Record():
            return wire_type.leaves
        case Array():
            return count_leaves(wire_type.element)
        case _:
            return 1


def count_fixed_elements(wire_type: WireType) -> int:
    """Return how many texts and messages the type's fixed arrays hold at least, arrays within arrays multiplied."""
    match wire_type:
        case Record():
            return sum(count_fixed_elements(field) for _, field in wire_type.fields)
        case Array(element=Text() | Record() as element, length=int() as length):
            return length * max(count_fixed_elements(element), 1)
        case Array():
            return count_fixed_elements(wire_type.element)
        case _:
            return 0


def compute_least_bytes(wire_type: WireType, *, empty_bytes: int) -> int:
    """Return how many bytes a value takes at least, alignment aside; a message without fields takes ``empty_bytes``."""
    match wire_type:
        case Scalar():
            return 1
        case Text() | Array(length=None):
            return 4
        case Record():
            if not wire_type.fields:
                return empty_bytes
            return sum(compute_least_bytes(field_type, empty_bytes=empty_bytes) for _, field_type in wire_type.fields)
        case Array():
            return (wire_type.length or 0) * compute_least_bytes(wire_type.element, empty_bytes=empty_bytes)


def is_boundless(wire_type: WireType, *, empty_bytes: int) -> bool:
    """Return whether a message could hold any number of elements in no bytes at all."""
    match wire_type:
        case Record():
            return any(is_boundless(field_type, empty_bytes=empty_bytes) for _, field_type in wire_type.fields)
        case Array():
            weightless = wire_type.length is None and not compute_least_bytes(
                wire_type.element, empty_bytes=empty_bytes
            )
            return weightless or is_boundless(wire_type.element, empty_bytes=empty_bytes)
        case _:
            return False


def make_record(name: str, fields: tuple[tuple[str, WireType], ...]) -> Record:
    """Make a record; how wide it unfolds follows from its fields."""
    return Record(name, fields, sum(count_leaves(field_type) for _, field_type in fields))


def iterate_flat_fields(record: Record, prefix: str = "") -> Iterator[tuple[str, WireType]]:
    """Yield the columns of a message: nested messages unfold into dotted names, arrays stay whole."""
    for name, wire_type in record.fields:
        if isinstance(wire_type, Record):
            yield from iterate_flat_fields(wire_type, f"{prefix}{name}.")
        else:
            yield prefix + name, wire_type


BASE_TYPES = frozenset(
    [
        *("bool", "byte", "char", "string", "wstring", "float32", "float64"),
        *("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"),
    ]
)
_KNOWN_AS = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
_SECTION = re.compile(r"(?<!=)={40,}+[ \t]*+\nMSG:[ \t]*+([\w/]++)[ \t]*+\n")
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=(?P<limit>\d+))?(?P<array>\[(?P<most><=)?(?P<size>\d*)\])?[ \t]+(?P<name>[A-Za-z]\w*)[ \t]*(?P<rest>.*)"
)


class MsgTextError(ValueError):
    """A line is no field, constant or comment."""


@dataclass(frozen=True, slots=True)
class FieldType:
    """A field's type: a base type, or the full name of a message.

    ``text_limit`` is the most characters of a text (0: any number); ``length`` is None for one value, else the number of elements:
    exactly so many where ``fixed``, at most so many otherwise (0: any number).
    """

    name: str
    text_limit: int = 0
    length: int | None = None
    fixed: bool = False


FieldTypes = tuple[tuple[str, FieldType], ...]


def parse_msg(text: str, type_name: str) -> dict[str, FieldTypes]:
    """Return the fields of each message in a definition of ``type_name``, by full name; `MsgTextError` where a line is no field."""
    pieces = _SECTION.split(text.replace("\r\n", "\n") + "\n")
    names = [type_name, *map(normalize_type_name, pieces[1::2])]
    return {
        name: _parse_fields(lines, name) for name, lines in zip(reversed(names), reversed(pieces[0::2]), strict=True)
    }


def _parse_fields(lines: str, owner: str) -> FieldTypes:
    fields = []
    for line in lines.splitlines():
        line = line.strip()  # noqa: PLW2901
        if not line or line.startswith(("#", "@")):
            continue
        found = _FIELD.fullmatch(line)
        if found is None:
            raise MsgTextError(f"{owner}: {line[:60]!r} is no field")
        if not found["rest"].startswith("="):
            fields.append((found["name"], _parse_field_type(found, owner)))
    return tuple(fields)


def _parse_field_type(found: re.Match[str], owner: str) -> FieldType:
    name = found["type"]
    if name not in BASE_TYPES:
        name = _KNOWN_AS.get(name, name)
        name = f"{owner.rsplit('/', 1)[0]}/{name}" if "/" not in name else normalize_type_name(name)
    if found["limit"] and name not in ("string", "wstring"):
        raise MsgTextError(f"{owner}: only texts are bounded, not {name}")
    limit = int(found["limit"] or 0)
    if not found["array"]:
        return FieldType(name, limit)
    if found["most"] and not found["size"]:
        raise MsgTextError(f"{owner}: {found['name']} is bounded by nothing")
    fixed = bool(found["size"]) and not found["most"]
    return FieldType(name, limit, int(found["size"] or 0), fixed)
