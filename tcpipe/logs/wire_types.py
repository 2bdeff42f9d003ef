"""What a message definition says of the bytes: scalars, texts, arrays and records, as one small tree.

Both ROS 1 serialisation and CDR lay these types out field after field; how is `tcpipe.logs.wire_layout`'s knowledge.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

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
    """A length-prefixed string: ``count`` bytes of UTF-8 (``wide`` None), or wide characters."""

    wide: Wide | None = None


@dataclass(frozen=True, slots=True)
class Wide:
    """How wide characters are laid out: ``step`` bytes for each unit of the length before them, ``width`` bytes a character."""

    step: int
    width: int

    def codec(self, byte_order: str) -> str:
        """Return Python's name of the encoding; ``byte_order`` is ``<`` or ``>``."""
        return f"utf-{8 * self.width}-{'le' if byte_order == '<' else 'be'}"


WIDE_FORMS = (Wide(4, 4), Wide(2, 2), Wide(1, 2))
"""Forms of a wide string in CDR: in ROS 2 up to Iron a count and 32 bits a character; later 16 bits; in XTypes the length is in bytes."""


@dataclass(frozen=True, slots=True)
class Record:
    """A message: named fields in wire order; ``fixed`` when every message of the type has the same size."""

    name: str
    fields: tuple[tuple[str, WireType], ...]
    fixed: bool
    leaves: int


@dataclass(frozen=True, slots=True)
class Array:
    """``length`` elements, or, where it is None, as many as a count before them says."""

    element: Scalar | Text | Record
    length: int | None


WireType = Scalar | Text | Record | Array


def is_fixed(wire_type: WireType) -> bool:
    """Return whether all values of the type occupy the same number of bytes (but for alignment)."""
    match wire_type:
        case Scalar():
            return True
        case Text():
            return False
        case Record():
            return wire_type.fixed
        case Array():
            return wire_type.length is not None and is_fixed(wire_type.element)


def leaf_count(wire_type: WireType) -> int:
    """Return into how many columns the type unfolds; an array counts its element once."""
    match wire_type:
        case Record():
            return wire_type.leaves
        case Array():
            return leaf_count(wire_type.element)
        case _:
            return 1


def fixed_elements(wire_type: WireType) -> int:
    """Return how many texts and messages the type's fixed arrays hold at least, arrays within arrays multiplied."""
    match wire_type:
        case Record():
            return sum(fixed_elements(field) for _, field in wire_type.fields)
        case Array(element=Text() | Record() as element, length=int() as length):
            return length * max(fixed_elements(element), 1)
        case Array():
            return fixed_elements(wire_type.element)
        case _:
            return 0


def least_bytes(wire_type: WireType, *, empty_bytes: int) -> int:
    """Return how many bytes a value takes at least, alignment aside; a message without fields takes ``empty_bytes``."""
    match wire_type:
        case Scalar():
            return 1
        case Text() | Array(length=None):
            return 4
        case Record():
            if not wire_type.fields:
                return empty_bytes
            return sum(least_bytes(of, empty_bytes=empty_bytes) for _, of in wire_type.fields)
        case Array():
            return (wire_type.length or 0) * least_bytes(wire_type.element, empty_bytes=empty_bytes)


def is_boundless(wire_type: WireType, *, empty_bytes: int) -> bool:
    """Return whether a message could hold any number of elements in no bytes at all."""
    match wire_type:
        case Record():
            return any(is_boundless(of, empty_bytes=empty_bytes) for _, of in wire_type.fields)
        case Array():
            weightless = wire_type.length is None and not least_bytes(wire_type.element, empty_bytes=empty_bytes)
            return weightless or is_boundless(wire_type.element, empty_bytes=empty_bytes)
        case _:
            return False


def record(name: str, fields: tuple[tuple[str, WireType], ...]) -> Record:
    """Make a record; whether it is fixed and how wide it unfolds follow from its fields."""
    return Record(name, fields, all(is_fixed(of) for _, of in fields), sum(leaf_count(of) for _, of in fields))


def wide_texts(of: WireType) -> bool:
    """Return whether there are wide strings in the type."""
    match of:
        case Text():
            return of.wide is not None
        case Record():
            return any(wide_texts(field) for _, field in of.fields)
        case Array():
            return wide_texts(of.element)
        case _:
            return False


def in_form(of: Record, form: Wide) -> Record:
    """Return the type with its wide strings in another form."""
    fields = tuple((name, _in_form(field, form)) for name, field in of.fields)
    return Record(of.name, fields, of.fixed, of.leaves)


def _in_form(of: WireType, form: Wide) -> WireType:
    match of:
        case Text(wide=Wide()):
            return Text(form)
        case Record():
            return in_form(of, form)
        case Array(element=Text(wide=Wide())):
            return Array(Text(form), of.length)
        case Array(element=Record() as element):
            return Array(in_form(element, form), of.length)
        case _:
            return of


def flat_fields(of: Record, prefix: str = "") -> Iterator[tuple[str, WireType]]:
    """Yield the columns of a message: nested messages unfold into dotted names, arrays stay whole."""
    for name, wire_type in of.fields:
        if isinstance(wire_type, Record):
            yield from flat_fields(wire_type, f"{prefix}{name}.")
        else:
            yield prefix + name, wire_type
