"""Where the fields of a message lie: one example is walked, and all messages of the same shape are strided views.

Two messages have the same *shape* when all their string and sequence lengths agree; then every field lies at the same offset in
both. A definition is therefore walked once on one example (`walk_layout`), which notes each length it met; `has_layout` proves for all
other messages of equal size, by comparing just these lengths, that they have the same layout; `view_field` reads a field of all of them at
once. Nothing here touches a message in Python.

Serialisations: ROS 1 (no alignment, little-endian) and CDR as ROS 2 writes it (4 bytes of header, then fields aligned to their
size from there; plain XCDR2 aligns 8-byte fields to 4; both byte orders).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.logs.wire_types import Array, Record, Scalar, Text, WireType, is_fixed

MAX_NODES = 4096
"""A message whose layout has more parts than this is cheaper to read row by row."""

_CDR_BYTE_ORDER = {0: ">", 1: "<", 6: ">", 7: "<"}
_PLAIN_XCDR2 = (6, 7)
_XCDR2_ALIGNMENT = 4
_CDR_HEADER = 4
_CDR_PADDING = 3


class LayoutError(ValueError):
    """A message does not fit its definition: a length runs past its end, or bytes are left over."""


class RaggedError(ValueError):
    """A message is too irregular to be read by columns."""


@dataclass(frozen=True, slots=True)
class Dialect:
    """How messages are serialised.

    Fields begin ``origin`` bytes into a message, are aligned from there to at most ``max_alignment``; texts end in ``terminator`` bytes
    that are no text; a message without fields takes ``empty_record_bytes``; up to ``padding`` bytes may follow the last field.
    """

    byte_order: str
    origin: int
    max_alignment: int
    terminator: int
    empty_record_bytes: int
    padding: int

    @property
    def known_to_rosbags(self) -> bool:
        """Whether rosbags reads it, too (all but XCDR2)."""
        return self.max_alignment != _XCDR2_ALIGNMENT


ROS1 = Dialect("<", 0, 1, 0, 0, 0)


def find_dialect(payload: bytes, encoding: str) -> Dialect:
    """Return the dialect of a message, in CDR by its first bytes; `LayoutError` where these are none of CDR's plain ones."""
    if encoding == "ros1":
        return ROS1
    if len(payload) < _CDR_HEADER or payload[0] != 0 or payload[1] not in _CDR_BYTE_ORDER:
        raise LayoutError(f"CDR header {payload[:_CDR_HEADER].hex(' ')} is invalid in ROS 2")
    max_alignment = _XCDR2_ALIGNMENT if payload[1] in _PLAIN_XCDR2 else 8
    return Dialect(_CDR_BYTE_ORDER[payload[1]], _CDR_HEADER, max_alignment, 1, 1, _CDR_PADDING)


@dataclass(frozen=True, slots=True)
class ScalarAt:
    """A scalar at ``offset``."""

    offset: int
    dtype: np.dtype[np.generic]


@dataclass(frozen=True, slots=True)
class TextAt:
    """``length`` bytes of text at ``offset``, in an encoding by Python's name."""

    offset: int
    length: int
    codec: str = "utf-8"


@dataclass(frozen=True, slots=True)
class ScalarsAt:
    """``count`` scalars side by side."""

    offset: int
    dtype: np.dtype[np.generic]
    count: int
    array: Array


@dataclass(frozen=True, slots=True)
class RecordAt:
    """A nested message."""

    fields: tuple[tuple[str, Node], ...]


@dataclass(frozen=True, slots=True)
class RepeatAt:
    """``count`` elements that lie ``stride`` bytes apart; ``element`` is the first."""

    element: Node
    stride: int
    count: int
    array: Array


@dataclass(frozen=True, slots=True)
class ElementsAt:
    """Elements that lie irregularly, each with its own offsets."""

    elements: tuple[Node, ...]
    array: Array


Node = ScalarAt | TextAt | ScalarsAt | RecordAt | RepeatAt | ElementsAt


@dataclass(frozen=True, slots=True)
class Layout:
    """Where everything lies in messages of one shape: the tree of fields, and each length field's offset and value."""

    root: RecordAt
    lengths: tuple[tuple[int, int], ...]
    length_dtype: np.dtype[np.generic]


def walk_layout(message: Record, payload: bytes, *, encoding: str) -> Layout:
    """Walk one example message.

    Raises
    ------
    LayoutError : the payload does not fit the definition.
    RaggedError : the payload is too irregular to be worth a layout.
    """
    walk = _Walk(payload, encoding)
    root = walk.record(message)
    left = len(payload) - walk.position
    if not 0 <= left <= walk.dialect.padding:
        raise LayoutError(f"{message.name}: {left} bytes are left over after the last field")
    return Layout(root, tuple(walk.lengths), np.dtype(walk.dialect.byte_order + "u4"))


def has_layout(layout: Layout, payloads: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return which of the payloads (equal in size) have the layout, shape (N,)."""
    same = np.ones(len(payloads), np.bool_)
    for offset, value in layout.lengths:
        same &= view_field(payloads, offset, layout.length_dtype) == value
    return same


def view_field(
    payloads: NDArray[np.void], offset: int, dtype: np.dtype[np.generic], repeats: tuple[tuple[int, int], ...] = ()
) -> NDArray[np.generic]:
    """View one field of all payloads, shape (N, *counts); ``repeats`` are (count, stride in bytes) of enclosing arrays."""
    shape = (len(payloads), *(count for count, _ in repeats))
    strides = (payloads.itemsize, *(stride for _, stride in repeats))
    return np.ndarray(shape, dtype, payloads.data if payloads.size else b"", offset if payloads.size else 0, strides)


class _Walk:
    """One pass over an example payload, in wire order."""

    def __init__(self, payload: bytes, encoding: str) -> None:
        self.payload = payload
        self.lengths: list[tuple[int, int]] = []
        self.nodes = 0
        self.dialect = find_dialect(payload, encoding)
        self.position = self.dialect.origin
        self._count = struct.Struct(self.dialect.byte_order + "I")
        if self.dialect.origin:
            self.lengths.append((0, self._count.unpack_from(payload)[0]))

    def record(self, of: Record) -> RecordAt:
        if not of.fields:
            self.position += self.dialect.empty_record_bytes  # CDR has no empty structures: rosidl puts one byte there
        return RecordAt(tuple((name, self.node(wire_type)) for name, wire_type in of.fields))

    def node(self, of: WireType) -> Node:
        self.nodes += 1
        if self.nodes > MAX_NODES:
            raise RaggedError(f"more than {MAX_NODES} parts in one message")
        match of:
            case Scalar():
                dtype = np.dtype(self.dialect.byte_order + of.code)
                return ScalarAt(self.take(dtype.itemsize, dtype.itemsize), dtype)
            case Text():
                length = self.count()
                if of.wide:
                    length *= of.wide.step
                    return TextAt(self.take(length, 1), length, of.wide.codec(self.dialect.byte_order))
                return TextAt(self.take(length, 1), max(length - self.dialect.terminator, 0))
            case Record():
                return self.record(of)
            case Array():
                return self.array(of)

    def array(self, of: Array) -> Node:
        count = self.count() if of.length is None else of.length
        if isinstance(of.element, Scalar):
            dtype = np.dtype(self.dialect.byte_order + of.element.code)
            offset = self.take(count * dtype.itemsize, dtype.itemsize) if count else self.position
            return ScalarsAt(offset, dtype, count, of)
        if count > len(self.payload) - self.position:
            raise LayoutError(f"{count} elements cannot fit in {len(self.payload) - self.position} bytes")
        if count > 3 and is_fixed(of.element):
            regular = self.regular(of, count)
            if regular:
                return regular
        return ElementsAt(tuple(self.node(of.element) for _ in range(count)), of)

    def regular(self, of: Array, count: int) -> RepeatAt | None:
        """Walk three elements; when both strides and the alignment agree, all others follow."""
        start, nodes = self.position, self.nodes
        elements, ends = [], []
        for _ in range(3):
            elements.append(self.node(of.element))
            ends.append(self.position)
        first, second, third = (np.array(list(_iterate_offsets(element))) for element in elements)
        strides = np.concatenate([second - first, third - second])
        stride = ends[2] - ends[1]
        if stride % min(_find_alignment(of.element), self.dialect.max_alignment) or (strides != stride).any():
            self.position, self.nodes = start, nodes
            return None
        self.position = start
        self.nodes = nodes
        element = self.node(of.element)
        self.position = ends[2]
        self.take((count - 3) * stride, 1)
        return RepeatAt(element, stride, count, of)

    def count(self) -> int:
        offset = self.take(4, 4)
        value: int = self._count.unpack_from(self.payload, offset)[0]
        self.lengths.append((offset, value))
        return value

    def take(self, size: int, alignment: int) -> int:
        """Step over ``size`` bytes after alignment; return where they begin."""
        alignment = min(alignment, self.dialect.max_alignment)
        start = self.position + -(self.position - self.dialect.origin) % alignment
        if start + size > len(self.payload):
            raise LayoutError(f"byte {start + size} is beyond the end of a message of {len(self.payload)}")
        self.position = start + size
        return start


def _iterate_offsets(node: Node) -> Iterator[int]:
    match node:
        case ScalarAt() | TextAt() | ScalarsAt():
            yield node.offset
        case RecordAt():
            for _, field in node.fields:
                yield from _iterate_offsets(field)
        case RepeatAt():
            for offset in _iterate_offsets(node.element):
                yield offset
                yield offset + node.stride * (node.count - 1)
        case ElementsAt():
            for element in node.elements:
                yield from _iterate_offsets(element)


def _find_alignment(of: WireType) -> int:
    """Return the largest scalar in the type: elements that start in the same phase of it lie alike."""
    match of:
        case Scalar():
            return np.dtype(of.code).itemsize
        case Text():
            return 4
        case Record():
            return max((_find_alignment(field) for _, field in of.fields), default=1)
        case Array():
            return max(_find_alignment(of.element), 1 if of.length is not None else 4)
