"""The text of a .msg definition, read line by line: http://wiki.ros.org/msg, and ROS 2's bounds and defaults.

A definition in a log holds the message first, then every message it is made of, each below a line of ``=`` and ``MSG: package/Name``.
Constants, defaults and comments do not matter for reading and are passed over.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from tcpipe.logs.topics import normalize_type_name

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
    """Return the fields of each message in a definition text, by full name.

    Parameters
    ----------
    text : the definition.
    type_name : name of the first message in it, ``package/msg/Name``.

    Raises
    ------
    MsgTextError : a line cannot be read.
    """
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
