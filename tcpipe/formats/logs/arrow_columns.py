"""Serialised messages of one topic, gathered by shape, to Arrow columns.

Payloads of equal length are gathered into one array of raw bytes; `tcpipe.logs.wire_layout` finds the layout on one of them and
proves it for the others; columns are strided views of the bytes. What is too irregular for that is walked side by side
(`tcpipe.logs.wire_cursors`); only what that cannot do goes message by message.
"""

from __future__ import annotations

import itertools
import json
import math
import mmap
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.formats.logs.arrow_values import IrregularColumns, find_arrow_type, make_texts
from tcpipe.formats.logs.log_part import MessageBlock, gather_integers
from tcpipe.formats.logs.ros_types import DefinitionError, MessageType, RowError
from tcpipe.logs.wire_cursors import WalkResult, walk
from tcpipe.logs.wire_layout import (
    Dialect,
    ElementsAt,
    Layout,
    LayoutError,
    Node,
    RaggedError,
    RecordAt,
    RepeatAt,
    ScalarAt,
    ScalarsAt,
    TextAt,
    find_dialect,
    has_layout,
    view_field,
    walk_layout,
)
from tcpipe.logs.wire_types import (
    WIDE_FORMS,
    Array,
    Record,
    WireType,
    convert_wide_texts,
    find_field_units,
    has_wide_texts,
    iterate_flat_fields,
)
from tcpipe.tables.arrays import number_column

FLUSH_BYTES = 1 << 20
"""Payloads are turned into columns when about this much has gathered: it still lies in the cache."""
MAX_SHAPES = 64
"""Shapes remembered per payload length; a topic with more counts as ragged."""
MIN_GROUP = 8
"""A smaller group of equal shape is not worth a layout."""
MAX_MISSES = 3
"""After so many shapes that fitted few messages, the rest of a group counts as ragged."""
MAX_REFUSED = 20_000
"""Of a topic's messages that neither a layout nor a walk fits, so many are refused one by one."""
RAGGED_BYTES = 1 << 21
"""Ragged messages are walked side by side when about this much of them has gathered."""

MAX_SHAPE_BYTES = 1 << 27
"""What messages of one shape hold is made a part of the table when it is more than about this."""
MAX_CONTIGUOUS_BYTES = 1 << 30
"""A larger table stays in pieces: Arrow's lists and strings count their values in 31 bits."""

_TIMES_BYTES = 24
_ALIGNED_BYTES = 64
_OWN_BYTES = 1 << 17
_FEW = 32
_PADDING = [bytes(-length % 8) for length in range(8)]
_BEFORE_ALL = -(2**63)

LOG_TIME = "log_time_ns"
PUBLISH_TIME = "publish_time_ns"

_Repeats = tuple[tuple[int, int], ...]
_Int64 = NDArray[np.int64]


def make_arrow_schema(message: Record) -> pa.Schema:
    """Return the schema of a topic's table: both times, then the message's fields by dotted name.

    The metadata of a field says its ``unit`` where that is known; of an array of messages, ``units`` of their fields as JSON.
    A field of the message that is called like one of the times gets ``_`` behind its name.
    """
    units = find_field_units(message)
    fields = [pa.field(name, pa.int64(), metadata={"unit": "ns"}) for name in (LOG_TIME, PUBLISH_TIME)]
    taken = {LOG_TIME, PUBLISH_TIME}
    for name, of in iterate_flat_fields(message):
        column = name
        while column in taken:
            column += "_"
        taken.add(column)
        fields.append(pa.field(column, find_arrow_type(of), metadata=_make_unit_metadata(name, units)))
    return pa.schema(fields)


def _make_unit_metadata(name: str, units: Mapping[str, str]) -> dict[str, str] | None:
    if name in units:
        return {"unit": units[name]}
    inner = {path.removeprefix(f"{name}."): unit for path, unit in units.items() if path.startswith(f"{name}.")}
    return {"units": json.dumps(inner)} if inner else None


class TopicTable:
    """Collects the messages of one topic and one definition, and gives them as tables in the order of log time.

    ``expected_rows`` is about how many there will be: if it is right, values are copied into their place at once. With ``in_pieces``
    tables will be taken again and again.
    """

    def __init__(
        self, message_type: MessageType, encoding: str, *, expected_rows: int = 0, in_pieces: bool = False
    ) -> None:
        self.schema = make_arrow_schema(message_type.wire)
        self._in_pieces = in_pieces
        self._fields = pa.schema(list(self.schema)[2:])
        self.undecodable, self.undecodable_reason = 0, ""
        """How many messages were left out, and why the first was."""
        self.replaced_texts = 0
        self.late = 0
        """Messages that came after a table for later times was taken."""
        self.held_bytes = 0
        """About how much memory the messages take that no table was taken of yet."""
        self._type, self._encoding = message_type, encoding
        self._wire = message_type.wire
        self._wide_open = has_wide_texts(message_type.wire)
        self._groups: dict[int, list[tuple[_Int64, NDArray[np.void]]]] = {}
        self._shapes: dict[int, list[_Shape]] = {}
        self._expected_rows = expected_rows
        self._times: list[tuple[_Int64, _Int64, _Int64]] = []
        self._parts: list[tuple[_Int64, pa.Table]] = []
        self._ragged = _Ragged(encoding)
        self._rows = self._seen = 0
        self._gathered_bytes = 0
        self._taken_until = _BEFORE_ALL
        self._side_by_side = True
        self._refused = 0
        self._decode_row: Callable[[bytes], dict[str, Any]] | None = None

    def add(self, block: MessageBlock) -> None:
        """Add the messages of a block; its buffer is not needed afterwards."""
        count = len(block.offsets)
        rows = np.arange(self._rows, self._rows + count)
        self._rows += count
        self._seen += count
        self._times.append((block.log_time_ns, block.publish_time_ns, block.ordinal))
        if self._wide_open:
            self._settle_wide_texts(block)
        if block.length is not None:
            self._add_alike(rows, block.buffer, block.offsets, block.length)
        else:
            self._add_mixed(rows, block.buffer, block.offsets, block.lengths)
        if self._gathered_bytes > FLUSH_BYTES:
            self._flush()

    def _settle_wide_texts(self, block: MessageBlock) -> None:
        """Find out in which form wide strings are written: the one that the messages fit; those without such a string tell nothing."""
        places = zip(block.offsets[:_FEW].tolist(), block.lengths[:_FEW].tolist(), strict=True)
        payloads = [bytes(block.buffer[start : start + length]) for start, length in places]
        forms = {form: convert_wide_texts(self._type.wire, form) for form in WIDE_FORMS}
        fitting = {
            form: sum(self._find_layout(of, payload) is not None for payload in payloads) for form, of in forms.items()
        }
        best = max(fitting, key=fitting.__getitem__)
        self._wire = forms[best]
        self._wide_open = len(set(fitting.values())) == 1

    def _add_alike(self, rows: _Int64, buffer: memoryview, offsets: _Int64, length: int) -> None:
        """Add messages of equal length."""
        if not len(rows):
            return
        self._groups.setdefault(length, []).append((rows, _gather(buffer, offsets, length)))
        self._gathered_bytes += length * len(rows)
        self.held_bytes += (length + _TIMES_BYTES) * len(rows)

    def _add_mixed(self, rows: _Int64, buffer: memoryview, offsets: _Int64, lengths: _Int64) -> None:
        """Add messages of several lengths: by length, or, where few are equally long, as ragged ones."""
        distinct = np.unique(lengths).tolist()
        if len(distinct) * MIN_GROUP > max(len(lengths), _FEW):
            self.held_bytes += int(lengths.sum()) + _TIMES_BYTES * len(rows)
            self._add_ragged(rows, buffer, offsets, lengths)
            return
        for length in distinct:
            chosen = lengths == length
            self._add_alike(rows[chosen], buffer, offsets[chosen], length)

    def take(self, *, share: float = 1.0) -> pa.Table:
        """Return the messages held, sorted by log time (those of equal time in the order of the log), and forget them.

        With a ``share`` below 1, about so much of them, the earlier ones: the rest stays, for what comes later but belongs before it.
        """
        self._flush()
        self._decode_ragged()
        for shape in (shape for shapes in self._shapes.values() for shape in shapes):
            self._close(shape)
        if not self._parts:
            self._forget()
            return self.schema.empty_table()
        rows = np.concatenate([part_rows for part_rows, _ in self._parts])
        times = [np.concatenate(kind)[rows] for kind in zip(*self._times, strict=True)]
        table = self._joined(times)
        log, publish, ordinal = times
        order = np.lexsort((ordinal, log))
        if (np.diff(order) < 0).any():
            table = _make_contiguous(table).take(number_column(order))
            log, publish, ordinal = log[order], publish[order], ordinal[order]
        count = len(log) if share >= 1 else int(np.searchsorted(log, log[int(share * (len(log) - 1))], "right"))
        self._expected_rows = len(log)
        self._hold(table, (log, publish, ordinal), count)
        self.late += int(np.searchsorted(log[:count], self._taken_until))
        self._taken_until = max(self._taken_until, int(log[count - 1]))
        return _make_contiguous(table[:count])

    def _joined(self, times: Sequence[_Int64]) -> pa.Table:
        """Return all parts as one table of many pieces, both times before the fields."""
        log, publish, _ = times
        fields = pa.concat_tables([table for _, table in self._parts])
        arrays = [[number_column(log)], [number_column(publish)], *(column.chunks for column in fields.columns)]
        return pa.Table.from_arrays(
            [pa.chunked_array(chunks, field.type) for chunks, field in zip(arrays, self.schema, strict=True)],
            schema=self.schema,
        )

    def _hold(self, table: pa.Table, times: tuple[_Int64, ...], count: int) -> None:
        """Keep all rows from ``count`` on."""
        total = len(times[0])
        held_bytes = self.held_bytes * (total - count) // total
        self._forget()
        if count < total:
            self._rows, self.held_bytes = total - count, held_bytes
            self._times = [(times[0][count:], times[1][count:], times[2][count:])]
            self._parts = [(np.arange(self._rows), table[count:].select(range(2, table.num_columns)))]

    def _forget(self) -> None:
        self._rows = self.held_bytes = 0
        self._times, self._parts = [], []

    def _flush(self) -> None:
        for length, group in self._groups.items():
            rows, payloads = (
                np.concatenate(parts) if len(group) > 1 else parts[0] for parts in zip(*group, strict=True)
            )
            self._decode(length, rows, payloads)
        self._groups = {}
        self._gathered_bytes = 0

    def _decode(self, length: int, rows: _Int64, payloads: NDArray[np.void]) -> None:
        """Split payloads of equal length into shapes; known shapes first, then new ones, then row by row."""
        known = self._shapes.setdefault(length, [])
        for shape in known:
            fits = has_layout(shape.layout, payloads)
            if fits.all():
                self._keep(shape, rows, payloads)
                return
            if fits.any():
                self._keep(shape, rows[fits], payloads[fits])
                rows, payloads = rows[~fits], payloads[~fits]
        misses = 0
        while len(rows):
            worthwhile = len(rows) >= MIN_GROUP or self._seen < MIN_GROUP
            fresh = (
                self._find_layout(self._wire, payloads[0].tobytes()) if worthwhile and len(known) < MAX_SHAPES else None
            )
            if fresh is None or misses > MAX_MISSES:
                self._add_ragged(rows, *_join_payloads(payloads))
                return
            fits = has_layout(fresh, payloads)
            if fits.sum() >= MIN_GROUP or self._seen < MIN_GROUP:
                known.append(_Shape(fresh, self._wire, in_pieces=self._in_pieces))
                self._keep(known[-1], rows[fits], payloads[fits])
            else:
                misses += 1
                self._add_ragged(rows[fits], *_join_payloads(payloads[fits]))
            rows, payloads = rows[~fits], payloads[~fits]

    def _find_layout(self, of: Record, payload: bytes) -> Layout | None:
        try:
            return walk_layout(of, payload, encoding=self._encoding)
        except (LayoutError, RaggedError):
            return None

    def _keep(self, shape: _Shape, rows: _Int64, payloads: NDArray[np.void]) -> None:
        shape.add(rows, payloads, self._expected_rows * len(rows) // max(self._rows, 1))
        if shape.held_bytes > MAX_SHAPE_BYTES:
            self._close(shape)

    def _close(self, shape: _Shape) -> None:
        """Turn what a shape holds into a part of the table."""
        rows, leaves = shape.take()
        if len(rows):
            columns = [self._column(node, of, len(rows), leaves) for node, of in shape.nodes]
            self._add_part(rows, columns)

    def _column(self, node: Node, of: WireType, count: int, leaves: Iterator[NDArray[np.generic]]) -> pa.Array:
        """Build one column of ``count`` elements from its leaves, which come in the order of `_iterate_leaves`."""
        match node:
            case ScalarAt():
                return number_column(next(leaves).reshape(-1))
            case ScalarsAt():
                return _make_lists(number_column(next(leaves).reshape(-1)), count, node.array)
            case TextAt():
                raw = pa.py_buffer(next(leaves).reshape(-1).view(np.uint8) if node.length else b"")
                found, replaced = make_texts(count, _make_offsets(count, node.length), raw, node.codec)
                self.replaced_texts += replaced
                return found
            case RecordAt():
                children = [
                    self._column(child, field, count, leaves)
                    for (_, child), (_, field) in zip(node.fields, _list_fields(of), strict=True)
                ]
                return pa.Array.from_buffers(find_arrow_type(of), count, [None], children=children)
            case RepeatAt():
                element = self._column(node.element, node.array.element, count * node.count, leaves)
                return _make_lists(element, count, node.array)
            case ElementsAt():
                return self._elements(node, count, leaves)

    def _elements(self, node: ElementsAt, count: int, leaves: Iterator[NDArray[np.generic]]) -> pa.Array:
        each = len(node.elements)
        if not each:
            return _make_lists(pa.array([], find_arrow_type(node.array.element)), count, node.array)
        columns = [self._column(element, node.array.element, count, leaves) for element in node.elements]
        in_turn = (np.arange(each) * count + np.arange(count)[:, None]).ravel()
        return _make_lists(pa.concat_arrays(columns).take(number_column(in_turn)), count, node.array)

    def _add_ragged(self, rows: _Int64, buffer: memoryview, offsets: _Int64, lengths: _Int64) -> None:
        self._ragged.add(rows, buffer, offsets, lengths)
        if self._ragged.held_bytes > RAGGED_BYTES:
            self._decode_ragged()

    def _decode_ragged(self) -> None:
        """Decode what no layout fits: side by side, and what that cannot do message by message."""
        for rows, data, starts, ends in self._ragged.take():
            try:
                dialect = find_dialect(data[starts[0] : ends[0]][:4].tobytes(), self._encoding)
            except LayoutError as error:
                self._leave_out(str(error), len(rows))
                continue
            walked = self._walked(data, starts, ends, dialect)
            if walked.root:
                irregular = IrregularColumns(data)
                self._add_part(rows[walked.fits], list(irregular.columns(walked.root, self._wire)))
                self.replaced_texts += irregular.replaced_texts
            left = ~walked.fits
            if left.any() and dialect.known_to_rosbags and not has_wide_texts(self._wire):
                self._row_by_row(rows[left], data, starts[left], ends[left])
            elif left.any():
                self._leave_out("its lengths contradict its size", int(left.sum()))

    def _walked(self, data: NDArray[np.uint8], starts: _Int64, ends: _Int64, dialect: Dialect) -> WalkResult:
        if self._side_by_side:
            try:
                return walk(self._wire, data, starts, ends, dialect)
            except RaggedError:
                self._side_by_side = False
        return WalkResult(None, np.zeros(len(starts), np.bool_))

    def _row_by_row(self, rows: _Int64, data: NDArray[np.uint8], starts: _Int64, ends: _Int64) -> None:
        """Decode message by message; one that does not fit its definition is counted and left out."""
        try:
            decode = self._decode_row = self._decode_row or self._type.row_decoder(self._encoding)
        except DefinitionError as error:
            self._leave_out(str(error), len(rows))
            return
        kept, values = [], []
        for number, (row, start, end) in enumerate(zip(rows.tolist(), starts.tolist(), ends.tolist(), strict=True)):
            if self._refused > MAX_REFUSED:
                self._leave_out("so many of the topic's do not fit that the rest is not tried", len(rows) - number)
                break
            try:
                values.append(decode(data[start:end].tobytes()))
            except RowError as error:
                self._leave_out(str(error), 1)
                self._refused += 1
            else:
                kept.append(row)
        names = [name for name, _ in iterate_flat_fields(self._type.wire)]
        columns = [
            pa.array([value[name] for value in values], of) for name, of in zip(names, self._fields.types, strict=True)
        ]
        self._add_part(np.array(kept, np.int64), columns)

    def _leave_out(self, reason: str, count: int) -> None:
        self.undecodable += count
        self.undecodable_reason = self.undecodable_reason or reason

    def _add_part(self, rows: _Int64, columns: list[pa.Array]) -> None:
        if len(rows):
            self._parts.append((rows, pa.Table.from_arrays(columns, schema=self._fields)))


def _make_contiguous(table: pa.Table) -> pa.Table:
    return table.combine_chunks() if table.nbytes < MAX_CONTIGUOUS_BYTES else table


class _Shape:
    """The messages of one layout: the values of each field side by side, in arrays that grow.

    ``nodes`` are the columns, each with its type.
    """

    def __init__(self, layout: Layout, wire: Record, *, in_pieces: bool) -> None:
        self.layout = layout
        self._in_pieces = in_pieces
        self.nodes = list(_iterate_flat_nodes(layout.root, wire))
        self.held_bytes = 0
        self._leaves = [leaf for node, _ in self.nodes for leaf in _iterate_leaves(node)]
        self._row_bytes = sum(dtype.itemsize * math.prod(n for n, _ in repeats) for _, dtype, repeats in self._leaves)
        self._values: list[NDArray[np.generic]] = []
        self._rows: list[_Int64] = []
        self._count = self._room = 0

    def add(self, rows: _Int64, payloads: NDArray[np.void], expected: int) -> None:
        """Add messages, of which there are expected to be so many in the end."""
        end = self._count + len(rows)
        if end > self._room:
            self._grow(end, expected)
        for values, (offset, dtype, repeats) in zip(self._values, self._leaves, strict=True):
            values[self._count : end] = view_field(payloads, offset, dtype, repeats)
        self._rows.append(rows)
        self._count = end
        self.held_bytes += len(rows) * self._row_bytes

    def take(self) -> tuple[_Int64, Iterator[NDArray[np.generic]]]:
        """Return the rows held and, in the order of `_iterate_leaves`, the arrays of their values, and forget them."""
        rows = np.concatenate([np.zeros(0, np.int64), *self._rows])
        held = iter([values[: self._count] for values in self._values])
        self._values, self._rows, self._count, self._room, self.held_bytes = [], [], 0, 0, 0
        return rows, held

    def _grow(self, least: int, expected: int) -> None:
        """Make room; memory that is not written to is none that is used."""
        most = least + MAX_SHAPE_BYTES // max(self._row_bytes, 1)
        self._room = max(least, 2 * self._room, min(expected, most))
        before = self._values
        self._values = _allocate_arrays(
            [((self._room, *(n for n, _ in repeats)), dtype.newbyteorder("=")) for _, dtype, repeats in self._leaves],
            own=self._in_pieces and self._room * self._row_bytes > _OWN_BYTES,
        )
        for old, new in zip(before, self._values, strict=False):
            new[: self._count] = old[: self._count]


def _allocate_arrays(
    kinds: Sequence[tuple[tuple[int, ...], np.dtype[np.generic]]], *, own: bool
) -> list[NDArray[np.generic]]:
    """Return an array to be filled of each shape and type.

    With ``own`` their memory goes back to the system with the last of them: the heap would be left full of holes, and grow with the log.
    """
    sizes = [-(-math.prod(shape) * dtype.itemsize // _ALIGNED_BYTES) * _ALIGNED_BYTES for shape, dtype in kinds]
    memory = mmap.mmap(-1, sum(sizes)) if own else np.empty(sum(sizes), np.uint8)
    starts = itertools.accumulate(sizes, initial=0)
    return [np.ndarray(shape, dtype, memory, start) for (shape, dtype), start in zip(kinds, starts, strict=False)]


class _Ragged:
    """Messages without a shape in common, laid one after the other so that what CDR aligns is aligned in memory."""

    def __init__(self, encoding: str) -> None:
        self.held_bytes = 0
        self._first = 4 if encoding == "cdr" else 0  # behind CDR's header of 4 bytes, fields begin at a multiple of 8
        self._cdr = encoding == "cdr"
        self._pieces: list[bytes] = []
        self._rows: list[_Int64] = []
        self._lengths: list[_Int64] = []

    def add(self, rows: _Int64, buffer: memoryview, offsets: _Int64, lengths: _Int64) -> None:
        """Add messages that lie in ``buffer`` at ``offsets``."""
        pieces: list[bytes | memoryview] = []
        for start, length in zip(offsets.tolist(), lengths.tolist(), strict=True):
            pieces += (buffer[start : start + length], _PADDING[length % 8])
        self._pieces.append(b"".join(pieces))
        self._rows.append(rows)
        self._lengths.append(lengths)
        self.held_bytes += int(lengths.sum())

    def take(self) -> Iterator[tuple[_Int64, NDArray[np.uint8], _Int64, _Int64]]:
        """Yield (rows, bytes, starts, ends) of the messages of each dialect, and forget them."""
        if not self._rows:
            return
        rows, lengths = np.concatenate(self._rows), np.concatenate(self._lengths)
        data = np.frombuffer(b"".join((bytes(self._first), *self._pieces)), np.uint8)
        self._rows, self._lengths, self._pieces, self.held_bytes = [], [], [], 0
        room = -(-lengths // 8) * 8
        starts = np.cumsum(room) - room + self._first
        kinds = np.zeros(len(rows), np.int64)
        if self._cdr:
            kinds[lengths < 4] = -1
            kinds[lengths >= 4] = gather_integers(data.data, starts[lengths >= 4], "u2")
        for kind in np.unique(kinds).tolist():
            of = kinds == kind
            yield rows[of], data, starts[of], starts[of] + lengths[of]


def _join_payloads(payloads: NDArray[np.void]) -> tuple[memoryview, _Int64, _Int64]:
    """Return payloads of equal length as one buffer, with offsets and lengths."""
    count, length = len(payloads), payloads.dtype.itemsize
    raw = memoryview(payloads.tobytes())
    return raw, np.arange(count, dtype=np.int64) * length, np.full(count, length, np.int64)


def _gather(buffer: memoryview, offsets: _Int64, length: int) -> NDArray[np.void]:
    """Copy payloads of equal length out of a buffer, shape (N,), items of ``length`` bytes."""
    if not length:
        return np.zeros(len(offsets), np.dtype("V0"))
    windows: NDArray[np.void] = np.ndarray((len(buffer) - length + 1,), f"V{length}", buffer, 0, (1,))
    return windows[offsets]


def _iterate_flat_nodes(node: RecordAt, of: WireType) -> Iterator[tuple[Node, WireType]]:
    for (_, child), (_, field) in zip(node.fields, _list_fields(of), strict=True):
        if isinstance(child, RecordAt):
            yield from _iterate_flat_nodes(child, field)
        else:
            yield child, field


def _iterate_leaves(node: Node, repeats: _Repeats = ()) -> Iterator[tuple[int, np.dtype[np.generic], _Repeats]]:
    """Yield the values a node consists of: offset, type, and (count, stride in bytes) of the arrays they are in."""
    match node:
        case ScalarAt():
            yield node.offset, node.dtype, repeats
        case ScalarsAt():
            yield node.offset, node.dtype, (*repeats, (node.count, node.dtype.itemsize))
        case TextAt():
            if node.length:
                yield node.offset, np.dtype(f"V{node.length}"), repeats
        case RecordAt():
            for _, child in node.fields:
                yield from _iterate_leaves(child, repeats)
        case RepeatAt():
            yield from _iterate_leaves(node.element, (*repeats, (node.count, node.stride)))
        case ElementsAt():
            for element in node.elements:
                yield from _iterate_leaves(element, repeats)


def _make_offsets(count: int, length: int) -> pa.Buffer:
    return pa.py_buffer((np.arange(count + 1, dtype=np.int64) * length).astype(np.int32))


def _make_lists(values: pa.Array, count: int, of: Array) -> pa.Array:
    """Return ``values`` as ``count`` lists of equal length."""
    if of.length:
        return pa.FixedSizeListArray.from_arrays(values, of.length)
    length = len(values) // count if count else 0
    return pa.Array.from_buffers(pa.list_(values.type), count, [None, _make_offsets(count, length)], children=[values])


def _list_fields(of: WireType) -> tuple[tuple[str, WireType], ...]:
    return of.fields if isinstance(of, Record) else ()
