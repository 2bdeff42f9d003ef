"""Message definitions: the home of rosbags on the reading side.

A definition comes, in this order, from the log itself, from a directory of .msg files the user names, from the
definitions tcpipe bundles for its robots, or from the standard sets that rosbags bundles (ROS 1 Noetic, ROS 2 Humble).
Types are kept by definition text, never by name alone: two logs, or two topics, may mean different things by one name.
"""

from __future__ import annotations

import functools
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from tcpipe.errors import LogError
from tcpipe.logs.topics import normalize_type_name
from tcpipe.logs.wire_types import (
    BASE_TYPES,
    MAX_COLUMNS,
    MAX_FIXED_ELEMENTS,
    Array,
    FieldType,
    MsgTextError,
    Record,
    Scalar,
    Text,
    WireType,
    count_fixed_elements,
    is_boundless,
    make_record,
    parse_msg,
)

Source = Literal["log", "given", "bundled"]

_Definitions = dict[str, tuple[Any, list[tuple[str, Any]]]]

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
_TYPE_NAME, _FIELD_NAME = re.compile(r"[A-Za-z0-9_]+(/[A-Za-z0-9_]+)*"), re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_PLACEHOLDER = "structure_needs_at_least_one_member"
_IDL_SEPARATOR = "=" * 80 + "\n"


class DefinitionError(ValueError):
    """A type has no usable definition; the text says why, plainly."""


class RowError(ValueError):
    """A message does not fit its definition."""


@dataclass(frozen=True, slots=True)
class MessageType:
    """A type ready for decoding: its fields, and the row-by-row decoder.

    ``source`` is where its definition comes from: ``log``, ``given`` (by the user's directory) or ``bundled``.
    """

    wire: Record
    source: Source
    definitions: _Definitions

    def row_decoder(self, encoding: str) -> Callable[[bytes], dict[str, Any]]:
        """Return a function from one serialised message to its fields by dotted name, by rosbags; it raises `RowError`.

        `DefinitionError`: rosbags makes no type of the definition.
        """
        store = _make_typestore(self.definitions)
        name = self.wire.name
        deserialize = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr

        def decode(payload: bytes) -> dict[str, Any]:
            try:
                message = deserialize(payload, name)
            except (SerdeError, ValueError, IndexError, OverflowError, AssertionError, struct.error) as error:
                raise RowError(str(error)) from None
            return dict(_iterate_flat_values(message, self.wire, ""))

        return decode

    def text(self, *, ros1: bool) -> str:
        """Return the definition as text, without comments: for where the log holds none."""
        store = _make_typestore(self.definitions)
        return store.generate_msgdef(self.wire.name, ros_version=1 if ros1 else 2)[0]


def _make_typestore(definitions: _Definitions) -> Typestore:
    """Return rosbags' store of types; it runs Python code made of their names, so only plain names may reach it."""
    odd = [name for name in definitions if not _TYPE_NAME.fullmatch(name)]
    odd += [field for _, fields in definitions.values() for field, _ in fields if not _FIELD_NAME.fullmatch(field)]
    if odd:
        raise DefinitionError(f"{odd[0]!r} is no name that ROS allows")
    store = Typestore()
    try:
        store.register({name: ([], fields) for name, (_, fields) in definitions.items()})  # constants take no bytes
    except TypesysError as error:
        raise DefinitionError(str(error)) from None
    return store


class TypeLibrary:
    """Finds and parses message definitions; one per log."""

    def __init__(self, message_definitions: Path | None = None) -> None:
        self._own = _read_definitions_of_directory(message_definitions) if message_definitions else {}
        self._types: dict[tuple[str, str, str, bool], MessageType | DefinitionError] = {}

    def find_type(
        self, type_name: str, *, definition: str, schema_encoding: str, ros1: bool
    ) -> MessageType | DefinitionError:
        """Return the type for a definition text ("" where the log has none).

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
        known, source = self._known(type_name, definition, schema_encoding)
        fallback = functools.partial(self._fallback, ros1=ros1)
        if type_name not in known and fallback(type_name) is None:
            where = (
                "the log contains no definition of it" if not definition.strip() else "its definition names other types"
            )
            raise DefinitionError(
                f"type {type_name} is unknown: {where}, and none is bundled; give its .msg files with --msgdef DIR"
            )
        definitions: _Definitions = {}
        wire = _Unfold(known, fallback, definitions).record(type_name, ())
        if wire.leaves > MAX_COLUMNS:
            raise DefinitionError(f"type {type_name} unfolds to {wire.leaves} columns, more than {MAX_COLUMNS}")
        elements = count_fixed_elements(wire)
        if elements > MAX_FIXED_ELEMENTS:
            what = f"contains {elements} texts or messages in arrays of fixed length, more than {MAX_FIXED_ELEMENTS}"
            raise DefinitionError(f"type {type_name} {what}")
        if is_boundless(wire, empty_bytes=0 if ros1 else 1):
            raise DefinitionError(
                f"type {type_name} contains an array of messages that take no bytes: nothing bounds its length"
            )
        return MessageType(wire, source, definitions)

    def _known(self, type_name: str, definition: str, schema_encoding: str) -> tuple[_Definitions, Source]:
        """Return the log's own definitions; none if it has none, or if they are invalid and the user gives the type."""
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

    def _fallback(self, type_name: str, *, ros1: bool) -> Any | None:
        for known in (self._own, _load_own_definitions()):
            if type_name in known:
                return known[type_name]
        for edition in (ros1, not ros1):
            if type_name in _load_rosbags_definitions(ros1=edition):
                return _load_rosbags_definitions(ros1=edition)[type_name]
        return None


class _Unfold:
    """Turns parsed definitions into one `Record`, looking up missing types and refusing recursion."""

    def __init__(self, known: _Definitions, fallback: Callable[[str], Any | None], used: _Definitions) -> None:
        self._known, self._fallback, self._used = known, fallback, used
        self._records: dict[str, Record] = {}

    def record(self, name: str, within: tuple[str, ...]) -> Record:
        if name in within:
            raise DefinitionError(f"type {name} contains itself: {' > '.join((*within, name))}")
        if len(within) > _MAX_DEPTH:
            raise DefinitionError(f"type {within[0]} nests more than {_MAX_DEPTH} messages in one another")
        if name not in self._records:
            entry = self._known.get(name) or self._fallback(name)
            if entry is None:
                raise DefinitionError(f"type {name}, a part of {within[0]}, is defined neither in the log nor bundled")
            fields = tuple(
                (field, self.wire_type(described, (*within, name)))
                for field, described in entry[1]
                if field != _PLACEHOLDER
            )
            self._used[name] = entry
            twice = sorted(field for field, count in Counter(field for field, _ in fields).items() if count > 1)
            if twice:
                raise DefinitionError(f"type {name} defines {', '.join(twice)} more than once")
            self._records[name] = make_record(name, fields)
        return self._records[name]

    def wire_type(self, described: Any, within: tuple[str, ...]) -> WireType:
        kind, argument = described
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            inner, length = argument
            if length > _MAX_LENGTH:
                raise DefinitionError(f"type {within[-1]}: an array of {length} elements is longer than any message")
            element = self.wire_type(inner, within)
            if isinstance(element, Array):
                raise DefinitionError(f"type {within[-1]}: arrays of arrays are not supported")
            return Array(element, length if kind == Nodetype.ARRAY else None)
        if kind == Nodetype.NAME:
            return self.record(argument, within)
        if argument[0] == "string":
            return Text()
        if argument[0] not in _CODES:
            raise DefinitionError(f"type {within[-1]}: fields of type {argument[0]} are not supported")
        return Scalar(_CODES[argument[0]])


def _parse_definitions(type_name: str, definition: str, schema_encoding: str) -> _Definitions:
    try:
        if schema_encoding == "ros2idl" or definition.startswith(_IDL_SEPARATOR + "IDL: "):
            return _parse_idl(definition)
        return _parse_msg(type_name, definition)
    except (TypesysError, RecursionError, ValueError, KeyError, IndexError) as error:
        if "\n---\n" in definition:
            raise DefinitionError(f"type {type_name}: its definition is that of a service, not of a message") from None
        stopped_at = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise DefinitionError(f"type {type_name}: its definition cannot be parsed ({stopped_at[:80]})") from None


def _parse_msg(type_name: str, definition: str) -> _Definitions:
    try:
        parsed = parse_msg(definition, type_name)
    except MsgTextError:  # rosbags may know better, and says what is wrong
        return get_types_from_msg(definition.replace("\r\n", "\n"), type_name)
    return {
        name: ([], [(field, _describe_field_type(field_type)) for field, field_type in fields])
        for name, fields in parsed.items()
    }


def _describe_field_type(field_type: FieldType) -> Any:
    """Return a field's type as rosbags describes it."""
    one: Any = (
        (Nodetype.BASE, (field_type.name, field_type.text_limit))
        if field_type.name in BASE_TYPES
        else (Nodetype.NAME, field_type.name)
    )
    if field_type.length is None:
        return one
    return (Nodetype.ARRAY if field_type.fixed else Nodetype.SEQUENCE, (one, field_type.length))


def _parse_idl(definition: str) -> _Definitions:
    if not definition.startswith(_IDL_SEPARATOR):
        return get_types_from_idl(definition)
    found: _Definitions = {}
    for section in definition.split(_IDL_SEPARATOR)[1:]:
        found.update(get_types_from_idl(section.split("\n", 1)[1]))
    return found


@functools.cache
def _load_rosbags_definitions(*, ros1: bool) -> _Definitions:
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
    found: _Definitions = {}
    problems = []
    for path in sorted([*directory.rglob("*.idl"), *directory.rglob("*.msg")]):
        package = path.parent.parent.name if path.parent.name == "msg" else path.parent.name
        name = normalize_type_name(str(PurePosixPath(package, path.stem)))
        try:
            found.update(_parse_definitions(name, path.read_text(errors="replace"), f"ros2{path.suffix[1:]}"))
        except DefinitionError as error:
            problems.append(f"{path}: {error}")
    if problems:
        raise LogError(*problems)
    if not found:
        raise LogError(f"{directory}: no .msg or .idl file below it; expected package/msg/Name.msg")
    return found


def _iterate_flat_values(message: object, record: Record, prefix: str) -> Iterable[tuple[str, Any]]:
    for name, wire_type in record.fields:
        value = getattr(message, normalize_fieldname(name))
        if isinstance(wire_type, Record):
            yield from _iterate_flat_values(value, wire_type, f"{prefix}{name}.")
        else:
            yield prefix + name, _to_plain(value, wire_type)


def _to_plain(value: Any, wire_type: WireType) -> Any:
    match wire_type:
        case Record():
            return {
                name: _to_plain(getattr(value, normalize_fieldname(name)), field) for name, field in wire_type.fields
            }
        case Array() if not isinstance(wire_type.element, Scalar):
            return [_to_plain(item, wire_type.element) for item in value]
        case _:
            return value


@cache
def load_shipped_definitions() -> Mapping[str, str]:
    """Return the robots' own definitions by type; what they use (std_msgs/Header, duration) is in every type store.

    They are the packages' files without constants and comments, which change no byte; NOTICE names packages and
    licences.
    """
    packages = sorted(files("tcpipe.logs").joinpath("definitions").iterdir(), key=lambda package: package.name)
    return {
        f"{package.name}/msg/{file.name.removesuffix('.msg')}": file.read_text(encoding="utf-8")
        for package in packages
        for file in sorted(package.joinpath("msg").iterdir(), key=lambda file: file.name)
    }
