"""Conversion of the serialised messages of one topic to Arrow columns.

`tcpipe.logs.wire_types` parses thousands of payloads in one pass. If all payloads have the same length, each field is
read as a strided view.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Bytes, Ints, Mask, gather_values
from tcpipe.formats.logs.log_part import MessageBlock, gather_integers
from tcpipe.formats.logs.ros_types import MessageType
from tcpipe.logs.wire_types import (
    CDR,
    ROS1,
    Array,
    Fields,
    Grid,
    Lists,
    Record,
    Runs,
    Scalar,
    Scalars,
    Text,
    Values,
    WireType,
    iterate_flat_fields,
    walk,
)
from tcpipe.tables.columns import number_column

FLUSH_BYTES = 1 << 21
"""Size of the payloads that are converted to columns together [byte]; they fit into the processor's cache."""
MAX_CONTIGUOUS_BYTES = 1 << 30
"""A larger table stays in pieces: Arrow's lists and strings count their values in 31 bits."""

_TIMES_BYTES, _HEAD_BYTES = 24, 4
_CDR_HEAD = 0x0100  # first two bytes of a message in plain CDR, as an integer: little-endian, version 1
_BEFORE_ALL = -(2**63)

LOG_TIME = "log_time_ns"
PUBLISH_TIME = "publish_time_ns"

_Int64 = Ints


def make_arrow_schema(message: Record) -> pa.Schema:
    """Return the schema of a topic's table: both times, then the message's fields by dotted name.

    A message field that has the name of a time column gets ``_`` appended to its name.
    """
    fields = [pa.field(name, pa.int64()) for name in (LOG_TIME, PUBLISH_TIME)]
    taken = {LOG_TIME, PUBLISH_TIME}
    for name, wire_type in iterate_flat_fields(message):
        column = name
        while column in taken:
            column += "_"
        taken.add(column)
        fields.append(pa.field(column, find_arrow_type(wire_type)))
    return pa.schema(fields)


class TopicTable:
    """Collects the messages of one topic and one definition, and returns them as tables in the order of log time."""

    def __init__(self, message_type: MessageType, encoding: str) -> None:
        self.schema = make_arrow_schema(message_type.wire)
        self._fields = pa.schema(list(self.schema)[2:])
        self.undecodable, self.undecodable_reason = 0, ""
        """Number of messages left out, and the reason for the first one."""
        self.replaced_texts = 0
        self.late = 0
        """Number of messages that arrived after the table of later times was returned."""
        self.held_bytes = 0
        """Approximate memory of the messages that are not in a returned table yet [byte]."""
        self._wire, self._dialect = message_type.wire, ROS1 if encoding == "ros1" else CDR
        self._gathered: list[tuple[_Int64, Bytes, _Int64]] = []
        """Row numbers, concatenated payloads and payload lengths [byte] of each block."""
        self._gathered_bytes = 0
        self._times: list[tuple[_Int64, _Int64, _Int64]] = []
        self._parts: list[tuple[_Int64, pa.Table]] = []
        self._rows = 0
        self._taken_until = _BEFORE_ALL

    def add(self, block: MessageBlock) -> None:
        """Add the messages of a block; its buffer is not needed afterwards."""
        count, lengths = len(block.offsets), block.lengths
        if not count:
            return
        self._times.append((block.log_time_ns, block.publish_time_ns, block.ordinal))
        if (lengths == lengths[0]).all():
            payloads = _gather_payloads(block.buffer, block.offsets, int(lengths[0]))
        else:
            pieces = zip(block.offsets.tolist(), lengths.tolist(), strict=True)
            payloads = np.frombuffer(b"".join(block.buffer[at : at + length] for at, length in pieces), np.uint8)
        self._gathered.append((np.arange(self._rows, self._rows + count), payloads, lengths))
        self._rows += count
        self._gathered_bytes += len(payloads)
        self.held_bytes += len(payloads) + _TIMES_BYTES * count
        if self._gathered_bytes > FLUSH_BYTES:
            self._flush()

    def take(self, *, share: float = 1.0) -> pa.Table:
        """Return and remove the collected messages, sorted by log time (equal times in the order of the log).

        With a ``share`` below 1, return about this share, the earliest ones. The other rows stay, because a
        message that arrives later may precede them.
        """
        self._flush()
        if not self._parts:
            self._forget()
            return self.schema.empty_table()
        rows = np.concatenate([part_rows for part_rows, _ in self._parts])
        times = [np.concatenate(kind)[rows] for kind in zip(*self._times, strict=True)]
        table = self._joined(times)
        log, publish, ordinal = times
        order = np.lexsort((ordinal, log))
        if (np.diff(order) < 0).any():
            table = table.combine_chunks() if table.nbytes < MAX_CONTIGUOUS_BYTES else table
            table = table.take(number_column(order))
            log, publish, ordinal = log[order], publish[order], ordinal[order]
        count = len(log) if share >= 1 else int(np.searchsorted(log, log[int(share * (len(log) - 1))], "right"))
        self._hold(table, (log, publish, ordinal), count)
        self.late += int(np.searchsorted(log[:count], self._taken_until))
        self._taken_until = max(self._taken_until, int(log[count - 1]))
        return table[:count]

    def _joined(self, times: Sequence[_Int64]) -> pa.Table:
        """Concatenate all parts into one table, with both times before the fields."""
        log, publish, _ = times
        fields = pa.concat_tables([table for _, table in self._parts])
        arrays = [[number_column(log)], [number_column(publish)], *(column.chunks for column in fields.columns)]
        return pa.Table.from_arrays(
            [pa.chunked_array(chunks, field.type) for chunks, field in zip(arrays, self.schema, strict=True)],
            schema=self.schema,
        )

    def _hold(self, table: pa.Table, times: tuple[_Int64, ...], count: int) -> None:
        """Keep the rows from ``count`` on for later tables."""
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
        """Decode the gathered messages into a part of the table."""
        if not self._gathered:
            return
        rows, lengths = (np.concatenate([piece[at] for piece in self._gathered]) for at in (0, 2))
        data = np.concatenate([payloads for _, payloads, _ in self._gathered])
        self._gathered, self._gathered_bytes = [], 0
        ends = np.cumsum(lengths)
        starts = ends - lengths
        fits = self._has_head(data, starts, lengths)
        if fits.all():
            self._decode(rows, data, starts, ends)
        else:
            head = data[starts[~fits][0] : ends[~fits][0]][:_HEAD_BYTES].tobytes().hex(" ")
            self._leave_out(f"CDR header {head} is none that ROS 2 writes (00 01)", int((~fits).sum()))
            if fits.any():
                self._decode(rows[fits], data, starts[fits], ends[fits])

    def _has_head(self, data: Bytes, starts: _Int64, lengths: _Int64) -> Mask:
        """Mark the messages that begin with the header of their encoding, shape (N,)."""
        fits = lengths >= self._dialect.origin
        if self._dialect is CDR and fits.any():
            fits[fits] = gather_integers(data.data, starts[fits], "u2") == _CDR_HEAD
        return fits

    def _decode(self, rows: _Int64, data: Bytes, starts: _Int64, ends: _Int64) -> None:
        """Decode messages into columns; count and exclude messages that do not fit their definition."""
        walked = walk(self._wire, data, starts, ends, self._dialect)
        if walked.root:
            walked_columns = WalkedColumns(data)
            columns = list(walked_columns.columns(walked.root, self._wire))
            self._parts.append((rows[walked.fits], pa.Table.from_arrays(columns, schema=self._fields)))
            self.replaced_texts += walked_columns.replaced_texts
        if lost := int((~walked.fits).sum()):
            self._leave_out("its lengths contradict its size, or a list of texts or messages is too long", lost)

    def _leave_out(self, reason: str, count: int) -> None:
        self.undecodable += count
        self.undecodable_reason = self.undecodable_reason or reason


def _gather_payloads(buffer: memoryview, offsets: _Int64, length: int) -> Bytes:
    """Return the payloads of messages of equal length [byte], concatenated."""
    if not length:
        return np.zeros(0, np.uint8)
    return gather_values(buffer, offsets, np.dtype(f"V{length}")).view(np.uint8)


def find_arrow_type(wire_type: WireType) -> pa.DataType:
    """Return the Arrow type: arrays become lists (fixed-size ones where the definition fixes it), messages structs."""
    match wire_type:
        case Scalar():
            return pa.bool_() if wire_type.code == "?" else pa.from_numpy_dtype(np.dtype(wire_type.code))
        case Text():
            return pa.string()
        case Record():
            return pa.struct([pa.field(name, find_arrow_type(field)) for name, field in wire_type.fields])
        case Array():
            return pa.list_(find_arrow_type(wire_type.element), wire_type.length or -1)


def make_texts(count: int, offsets: pa.Buffer, raw: pa.Buffer) -> tuple[pa.StringArray, int]:
    """Return texts from Arrow's offsets and bytes, and the number of invalid UTF-8 texts; bad bytes are replaced."""
    texts = pa.StringArray.from_buffers(count, offsets, raw)
    if not (np.frombuffer(raw, np.uint8) & 0x80).any():
        return texts, 0
    try:
        texts.validate(full=True)
    except pa.ArrowInvalid:
        pieces = texts.cast(pa.binary()).to_pylist()
        decoded = [piece.decode(errors="replace") for piece in pieces]
        replaced = sum(text.encode() != piece for text, piece in zip(decoded, pieces, strict=True))
        return pa.array(decoded, pa.string()), replaced
    return texts, 0


def make_lists(values: pa.Array, counts: _Int64, length: int | None) -> pa.Array:
    """Return lists of ``counts`` elements each; ``length`` is their common length if the definition fixes it."""
    if length:
        return pa.FixedSizeListArray.from_arrays(values, length)
    offsets = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=offsets[1:])
    return pa.Array.from_buffers(pa.list_(values.type), len(counts), [None, pa.py_buffer(offsets)], children=[values])


class WalkedColumns:
    """Builder of the columns of messages that `tcpipe.logs.wire_types` has parsed; ``data`` are their bytes."""

    def __init__(self, data: Bytes) -> None:
        self.replaced_texts = 0
        self._data = data

    def columns(self, root: Fields, record: Record) -> Iterator[pa.Array]:
        """Yield the columns in the order of the definition; nested messages unfold, arrays stay whole."""
        for values, (_, field) in zip(root.fields, record.fields, strict=True):
            if isinstance(values, Fields) and isinstance(field, Record):
                yield from self.columns(values, field)
            else:
                yield self._array(values, field)

    def _array(self, values: Values, wire_type: WireType) -> pa.Array:
        """Return the Arrow array of one field of all messages."""
        match values, wire_type:
            case Fields(), Record():
                children = [
                    self._array(child, field) for child, (_, field) in zip(values.fields, wire_type.fields, strict=True)
                ]
                return pa.Array.from_buffers(find_arrow_type(wire_type), values.count, [None], children=children)
            case Lists(), Array():
                return make_lists(self._array(values.elements, wire_type.element), values.counts, wire_type.length)
            case Runs(dtype=np.dtype() as dtype), Array():
                elements = number_column(np.frombuffer(self._compact(values)[1], dtype))
                return make_lists(elements, values.lengths // dtype.itemsize, wire_type.length)
            case Runs(), Text():
                texts, replaced = make_texts(len(values.lengths), *self._compact(values))
                self.replaced_texts += replaced
                return texts
            case Scalars(places=Grid() as grid, dtype=dtype), Scalar():
                return number_column(grid.view(self._data, dtype))
            case Scalars(places=np.ndarray() as offsets, dtype=dtype), Scalar():
                return number_column(gather_values(self._data, offsets, dtype))
        raise TypeError(f"{type(values).__name__} are no values of {wire_type}")

    def _compact(self, runs: Runs) -> tuple[pa.Buffer, pa.Buffer]:
        """Concatenate runs of bytes; return Arrow's offsets and the bytes.

        Runs are sorted by offset. Their bounds therefore describe an Arrow array in which every other element is the
        gap between two runs; `take` skips the gaps.
        """
        count = len(runs.lengths)
        if isinstance(runs.places, Grid):
            length = int(runs.lengths[0])
            copied = runs.places.view(self._data, np.dtype(np.uint8), length)
            return pa.py_buffer((np.arange(count + 1) * length).astype(np.int32)), pa.py_buffer(copied)
        bounds = np.empty(2 * count, np.int32)
        bounds[0::2], bounds[1::2] = runs.places, runs.places + runs.lengths
        if not count:
            return pa.py_buffer(np.zeros(1, np.int32)), pa.py_buffer(b"")
        buffers = [None, pa.py_buffer(bounds), pa.py_buffer(self._data)]
        everything = pa.Array.from_buffers(pa.binary(), 2 * count - 1, buffers)
        _, offsets, raw = everything.take(number_column(np.arange(0, 2 * count, 2))).buffers()
        return offsets, raw
