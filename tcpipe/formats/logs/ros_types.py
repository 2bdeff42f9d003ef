"""Message definitions: the home of rosbags on the reading side.

A definition comes, in this order, from the log itself, from a directory of .msg files the user names, from the
definitions tcpipe bundles for its robots, or from the standard sets that rosbags bundles (ROS 1 Noetic, ROS 2 Humble).
Types are kept by definition text, never by name alone: two logs, or two topics, may mean different things by one name.
"""

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from tcpipe.errors import LogError
from tcpipe.logs.topics import normalize_type_name
from tcpipe.logs.wire_types import (
    BASE_TYPES,
    MAX_COLUMNS,
    Array,
    FieldType,
    FieldTypes,
    MsgTextError,
    Record,
    Scalar,
    Text,
    WireType,
    make_record,
    parse_msg,
)

Source = Literal["log", "given", "bundled"]

_Definitions = dict[str, FieldTypes]

_CODES = {
    "bool": "?",
    "byte": "i1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
MAX_DEFINITION_BYTES = 1 << 20
"""Longest definition that is read [byte]; those of ROS's largest messages, with all their parts, have some 20 KB."""
_MAX_LENGTH = 1 << 31
_MAX_DEPTH = 64
_PLACEHOLDER = "structure_needs_at_least_one_member"
_SEPARATOR = "=" * 80 + "\n"
_ROS1_NAMES = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}


class DefinitionError(ValueError):
    """A type has no usable definition; the text states the reason."""


@dataclass(frozen=True, slots=True)
class MessageType:
    """A type ready for decoding: its fields, and the definitions of it and its parts.

    ``source`` is where its definition comes from: ``log``, ``given`` (by the user's directory) or ``bundled``.
    """

    wire: Record
    source: Source
    definitions: _Definitions

    def text(self, *, ros1: bool) -> str:
        """Return the definition as text, without comments, for logs without definitions."""
        texts = dict[str, str]()
        self._add_text(self.wire.name, texts, _ROS1_NAMES if ros1 else {})
        parts = (f"{_SEPARATOR}MSG: {_shorten(name)}\n{text}" for name, text in list(texts.items())[1:])
        return "".join((texts[self.wire.name], *parts))

    def _add_text(self, name: str, texts: dict[str, str], built_in: Mapping[str, str]) -> None:
        """Add the lines of a message, then those of its parts."""
        texts[name], lines = "", list[str]()
        for field, kind in self.definitions[name]:
            if kind.name not in {*BASE_TYPES, *built_in, *texts}:
                self._add_text(kind.name, texts, built_in)
            limit = f"<={kind.text_limit}" if kind.text_limit else ""
            count = "" if not kind.length else f"{'' if kind.fixed else '<='}{kind.length}"
            array = "" if kind.length is None else f"[{count}]"
            lines.append(f"{built_in.get(kind.name) or _shorten(kind.name)}{limit}{array} {field}\n")
        texts[name] = "".join(lines)


def _shorten(name: str) -> str:
    return name.replace("/msg/", "/")


class TypeLibrary:
    """Finds and parses message definitions; one per log."""

    def __init__(self, message_definitions: Path | None = None) -> None:
        self._own = _read_definitions_of_directory(message_definitions) if message_definitions else {}
        self._types: dict[tuple[str, str, str, bool], MessageType | DefinitionError] = {}

    def find_type(
        self, type_name: str, *, definition: str, schema_encoding: str, ros1: bool
    ) -> MessageType | DefinitionError:
        """Return the type for a definition text ("" if the log has none).

        An error is returned, not raised, where no definition is known, or it cannot be parsed, is recursive, or uses a
        type no reader supports.
        """
        key = (type_name, definition, schema_encoding, ros1)
        if key not in self._types:
            try:
                self._types[key] = self._resolve(type_name, definition, schema_encoding, ros1=ros1)
            except DefinitionError as error:
                self._types[key] = error
        return self._types[key]

    def _resolve(self, type_name: str, definition: str, schema_encoding: str, *, ros1: bool) -> MessageType:
        """Return a type with all its parts; `DefinitionError` if one is unknown, or if they have too many columns."""
        log_definitions, source = self._read_definitions(type_name, definition, schema_encoding)
        fallback = functools.partial(self._fallback, ros1=ros1)
        if type_name not in log_definitions and fallback(type_name) is None:
            where = (
                "the log contains no definition of it" if not definition.strip() else "its definition names other types"
            )
            raise DefinitionError(
                f"type {type_name} is unknown: {where}, and none is bundled; give its .msg files with --msgdef DIR"
            )
        definitions: _Definitions = {}
        wire = _Unfold(log_definitions, fallback, definitions).record(type_name, ())
        if wire.leaves > MAX_COLUMNS:
            raise DefinitionError(f"type {type_name} expands to {wire.leaves} columns, more than {MAX_COLUMNS}")
        return MessageType(wire, source, definitions)

    def _read_definitions(self, type_name: str, definition: str, schema_encoding: str) -> tuple[_Definitions, Source]:
        """Return the definitions of the log; {} without any, or if they are invalid and the user gives the type."""
        given: Source = "given" if type_name in self._own else "bundled"
        if not definition.strip():
            return {}, given
        if len(definition) > MAX_DEFINITION_BYTES:
            what = f"its definition has {len(definition)} bytes, more than {MAX_DEFINITION_BYTES}"
            raise DefinitionError(f"type {type_name}: {what}")
        try:
            return _parse_definitions(type_name, definition, schema_encoding), "log"
        except DefinitionError:
            if given == "given":
                return {}, given
            raise

    def _fallback(self, type_name: str, *, ros1: bool) -> FieldTypes | None:
        """Return the fields of a type by the user's, tcpipe's or rosbags' definitions; None if all lack it."""
        for known in (self._own, _load_own_definitions()):
            if type_name in known:
                return known[type_name]
        for edition in (ros1, not ros1):
            if type_name in (known_to_rosbags := _load_rosbags_definitions(ros1=edition)):
                return _read_rosbags_fields(*known_to_rosbags[type_name])
        return None


class _Unfold:
    """Turns parsed definitions into one `Record`, looking up missing types and refusing recursion."""

    def __init__(self, known: _Definitions, fallback: Callable[[str], FieldTypes | None], used: _Definitions) -> None:
        self._read_definitions, self._fallback, self._used = known, fallback, used
        self._records: dict[str, Record] = {}

    def record(self, name: str, within: tuple[str, ...]) -> Record:
        """Return a message type with its fields; `DefinitionError` if it is unknown, recursive or repeats a field."""
        if name in within:
            raise DefinitionError(f"type {name} contains itself: {' > '.join((*within, name))}")
        if len(within) > _MAX_DEPTH:
            raise DefinitionError(f"type {within[0]} nests more than {_MAX_DEPTH} messages in one another")
        if name not in self._records:
            entry = self._read_definitions[name] if name in self._read_definitions else self._fallback(name)
            if entry is None:
                raise DefinitionError(f"type {name}, a part of {within[0]}, is defined neither in the log nor bundled")
            entry = tuple((field, kind) for field, kind in entry if field != _PLACEHOLDER)
            fields = tuple((field, self.wire_type(kind, (*within, name))) for field, kind in entry)
            self._used[name] = entry
            twice = sorted(field for field, count in Counter(field for field, _ in fields).items() if count > 1)
            if twice:
                raise DefinitionError(f"type {name} defines {', '.join(twice)} more than once")
            self._records[name] = make_record(name, fields)
        return self._records[name]

    def wire_type(self, kind: FieldType, within: tuple[str, ...]) -> WireType:
        if kind.length is not None and kind.length > _MAX_LENGTH:
            raise DefinitionError(f"type {within[-1]}: an array of {kind.length} elements is longer than any message")
        element = self._element(kind.name, within)
        return element if kind.length is None else Array(element, kind.length if kind.fixed else None)

    def _element(self, name: str, within: tuple[str, ...]) -> Scalar | Text | Record:
        """Return the type of a single value of a field."""
        if name == "string":
            return Text()
        if name in _CODES:
            return Scalar(_CODES[name])
        if name in BASE_TYPES:
            raise DefinitionError(f"type {within[-1]}: fields of type {name} are not supported")
        return self.record(name, within)


def _parse_definitions(type_name: str, definition: str, schema_encoding: str) -> _Definitions:
    """Parse a definition text of any encoding; `DefinitionError` with the reason of the parser."""
    try:
        if schema_encoding == "ros2idl" or definition.startswith(_SEPARATOR + "IDL: "):
            return _parse_idl(definition)
        return _parse_msg(type_name, definition)
    except (TypesysError, RecursionError, ValueError, KeyError, IndexError) as error:
        if "\n---\n" in definition:
            raise DefinitionError(f"type {type_name}: its definition is that of a service, not of a message") from None
        stopped_at = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise DefinitionError(f"type {type_name}: its definition cannot be parsed ({stopped_at[:80]})") from None


def _parse_msg(type_name: str, definition: str) -> _Definitions:
    try:
        return parse_msg(definition, type_name)
    except MsgTextError:  # rosbags may support it, or states the problem
        found = get_types_from_msg(definition.replace("\r\n", "\n"), type_name)
        return {name: _read_rosbags_fields(*described) for name, described in found.items()}


def _parse_idl(definition: str) -> _Definitions:
    texts = [section.split("\n", 1)[1] for section in definition.split(_SEPARATOR)[1:]] or [definition]
    found = {name: described for text in texts for name, described in get_types_from_idl(text).items()}
    return {name: _read_rosbags_fields(*described) for name, described in found.items()}


def _read_rosbags_fields(_constants: Any, fields: list[tuple[str, Any]]) -> FieldTypes:
    """Return the fields of a message as rosbags describes them; `ValueError` for types that ROS does not have."""
    return tuple((name, _read_rosbags_type(*described)) for name, described in fields)


def _read_rosbags_type(kind: Nodetype, argument: Any) -> FieldType:
    """Return the type of a field that rosbags parsed; `ValueError` if ROS has no such type."""
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        (inner, length), fixed = argument, kind == Nodetype.ARRAY
        if inner[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            raise ValueError("arrays of arrays are not supported")
        return replace(_read_rosbags_type(*inner), length=length, fixed=fixed)
    if kind == Nodetype.NAME:
        return FieldType(argument)
    if argument[0] not in BASE_TYPES:
        raise ValueError(f"fields of type {argument[0]} are not supported")
    return FieldType(*argument)


@functools.cache
def _load_rosbags_definitions(*, ros1: bool) -> dict[str, Any]:
    return dict(get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE).fielddefs)


@functools.cache
def _load_own_definitions() -> _Definitions:
    return _read_definitions(load_shipped_definitions().items())


def _read_definitions(texts: Iterable[tuple[str, str]]) -> _Definitions:
    found: _Definitions = {}
    for name, text in texts:
        found.update(_parse_definitions(name, text, "ros2msg"))
    return found


def _read_definitions_of_directory(directory: Path) -> _Definitions:
    """Parse ``package/msg/Name.msg`` or ``package/Name.msg`` files below a directory, and .idl files."""
    if not directory.is_dir():
        raise LogError(
            f"{directory}: there is no such directory; expected one with package/msg/Name.msg files below it"
        )
    definitions: _Definitions = {}
    problems = []
    for path in sorted([*directory.rglob("*.idl"), *directory.rglob("*.msg")]):
        package = path.parent.parent.name if path.parent.name == "msg" else path.parent.name
        name = normalize_type_name(str(PurePosixPath(package, path.stem)))
        try:
            definitions.update(_parse_definitions(name, path.read_text(errors="replace"), f"ros2{path.suffix[1:]}"))
        except DefinitionError as error:
            problems.append(f"{path}: {error}")
    if problems:
        raise LogError(*problems)
    if not definitions:
        raise LogError(f"{directory}: no .msg or .idl file below it; expected package/msg/Name.msg")
    return definitions


@cache
def load_shipped_definitions() -> Mapping[str, str]:
    """Return the bundled definitions of robots by type; types that they use (std_msgs/Header) are in every type store.

    They are the packages' files without constants and comments, which change no byte; NOTICE names packages and
    licences.
    """
    packages = sorted(files("tcpipe.logs").joinpath("definitions").iterdir(), key=lambda package: package.name)
    return {
        f"{package.name}/msg/{file.name.removesuffix('.msg')}": file.read_text(encoding="utf-8")
        for package in packages
        for file in sorted(package.joinpath("msg").iterdir(), key=lambda file: file.name)
    }
