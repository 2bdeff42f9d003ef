"""Interface of logs to stages (`LogReader`); tables as numpy arrays and power rails; foreign poses as fixes."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.arrays import AnyArray, Floats, Ints, Texts
from tcpipe.fusion.measurements import GNSS, POSE
from tcpipe.geometry.datum import geodetic_from_enu
from tcpipe.logs.extrinsics import Transforms
from tcpipe.logs.messages import LOG_TIME, Arrays
from tcpipe.logs.topics import Topic
from tcpipe.power.rails import Rail, make_rail, make_samples
from tcpipe.tables.columns import Tables, select_rows, stack_floats, to_floats, to_integers, to_numbers, to_texts
from tcpipe.tables.levels import STREAMS, Streams

T = TypeVar("T", bound=np.generic)


class LogReader(Protocol):
    """A log: its topics by name, and their tables in one pass."""

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Every topic by name, by the log's index."""

    def tables(self, topics: Sequence[str]) -> dict[str, pa.Table]:
        """Return a table a topic, rows in log time order: ``log_time_ns``, ``publish_time_ns``, fields by dotted name.

        A topic that cannot be decoded is missing from the result.
        """

    def batches(self, topics: Sequence[str]) -> Iterator[Tables]:
        """Yield these tables in parts: the next rows of some topics; a message far behind its time comes later."""


def make_message_arrays(table: pa.Table, in_lists: Collection[str] = ()) -> Arrays:
    """Return a table's columns: numbers, texts as str, lists of numbers as (N, k) with NaN after shorter rows.

    Of lists of messages only the numbers in ``in_lists`` are read, as ``drivers[].current``, and of lists of texts
    those in it, as ``name[]`` (128 letters, "" after shorter rows): these are (N, k), too.
    """
    found: Arrays = {}
    for name in table.column_names:
        array = _combine_chunks(table.column(name))
        kind = array.type
        if pa.types.is_string(kind) or pa.types.is_large_string(kind):
            found[name] = to_texts(array)
        elif _is_number(kind):
            found[name] = to_numbers(array)
        elif _is_list(kind) and _is_number(kind.value_type):
            found[name] = _make_matrix(array)
    for path in in_lists:
        name, _, inner = path.partition("[]")
        if name not in table.column_names:
            continue
        lists = _combine_chunks(table.column(name))
        values = _read_nested(lists, inner[1:].split(".")) if inner else _read_text_lists(lists)
        if values is not None:
            found[path] = values
    return found


def _read_nested(lists: pa.Array, path: list[str]) -> Floats | None:
    """Return a number of every message in lists of messages, shape (N, k); None if there is no such number."""
    kind = lists.type.value_type if _is_list(lists.type) else pa.null()
    for name in path:
        index = kind.get_field_index(name) if pa.types.is_struct(kind) else -1
        if index < 0:
            return None
        kind = kind.field(index).type
    if not _is_number(kind):
        return None
    return _fill_nulls(
        to_numbers(pc.list_value_length(lists)).astype(np.int64), pc.struct_field(pc.list_flatten(lists), path)
    )


def _read_text_lists(lists: pa.Array) -> Texts | None:
    """Return lists of texts, shape (N, k); None if they are no texts."""
    if not _is_list(lists.type) or not pa.types.is_string(lists.type.value_type):
        return None
    lengths = to_numbers(pc.list_value_length(lists)).astype(np.int64)
    return _fill_rows(lengths, to_texts(pc.utf8_slice_codeunits(pc.list_flatten(lists), 0, 128)), "")


def _combine_chunks(column: pa.ChunkedArray) -> pa.Array:
    combined = column.combine_chunks()
    return combined if isinstance(combined, pa.Array) else pa.concat_arrays(combined.chunks)


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind))


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _make_matrix(lists: pa.Array) -> Floats:
    if pa.types.is_fixed_size_list(lists.type):
        values: Floats = to_numbers(pc.list_flatten(lists)).astype(float, copy=False)
        return values.reshape(len(lists), lists.type.list_size)
    return _fill_nulls(to_numbers(pc.list_value_length(lists)).astype(np.int64), pc.list_flatten(lists))


def _fill_nulls(lengths: Ints, flat: pa.Array) -> Floats:
    return _fill_rows(lengths, to_numbers(flat).astype(float, copy=False), np.nan)


def _fill_rows(lengths: Ints, values: NDArray[T], empty: float | str) -> NDArray[T]:
    """Return the concatenated values of lists as one row a list, shape (N, k), filled with ``empty``."""
    if len(lengths) and lengths.min() == lengths.max():
        return values.reshape(len(lengths), int(lengths[0]))
    matrix = np.full((len(lengths), int(lengths.max(initial=0))), empty, values.dtype)
    matrix[np.arange(matrix.shape[1]) < lengths[:, None]] = values
    return matrix


def read_transforms(table: pa.Table) -> Transforms:
    """Return all transforms of a tf2_msgs/TFMessage table, message after message."""
    flat = pc.list_flatten(_combine_chunks(table.column("transforms")))

    def names(*path: str) -> list[str]:
        found: list[str] = pc.struct_field(flat, list(path)).to_pylist()
        return found

    def vectors(name: str, components: str) -> Floats:
        parts = [pc.struct_field(flat, ["transform", name, component]) for component in components]
        return np.stack([to_numbers(part).astype(float) for part in parts], -1)

    return Transforms(
        names("header", "frame_id"), names("child_frame_id"), vectors("translation", "xyz"), vectors("rotation", "xyzw")
    )


_PUBLISH_TIME = "publish_time_ns"


def gather_messages(
    batches: Iterable[Tables], played: Mapping[str, Collection[str]]
) -> tuple[dict[str, Arrays], dict[str, pa.Table]]:
    """Return the messages of a log by topic, in order of log time: ``played`` topics as arrays, others as tables.

    ``batches``: tables by topic, piece after piece; ``played``: by topic, the numbers inside lists of messages (see
    `make_message_arrays`). Columns that never change are read-only and need the memory of one row.
    """
    pieces: dict[str, list[Arrays]] = {}
    others: dict[str, list[pa.Table]] = {}
    for tables in batches:
        for topic, table in tables.items():
            if topic in played:
                arrays = make_message_arrays(table.drop_columns(_PUBLISH_TIME), played[topic])
                pieces.setdefault(topic, []).append({name: _compact_column(values) for name, values in arrays.items()})
            else:
                others.setdefault(topic, []).append(table)
    joined = {topic: pa.concat_tables(tables) for topic, tables in others.items()}
    return {topic: _sort_columns(_join_columns(parts)) for topic, parts in pieces.items()}, joined


def _compact_column(values: AnyArray) -> AnyArray:
    """Return a copy of a column's values; a single row if all rows have the same bits."""
    values = np.ascontiguousarray(values)
    row_bytes = values[:1].nbytes
    if len(values) < 2 or not row_bytes:
        return values.copy()
    octets = values.reshape(-1).view(np.uint8)  # of a text of 17 letters no view as numbers of 8 bytes
    bits = octets.view(np.uint64 if row_bytes % 8 == 0 else np.uint8).reshape(len(values), -1)
    if np.array_equal(bits[0], bits[-1]) and (bits == bits[0]).all():
        return np.broadcast_to(values[0].copy(), values.shape)
    return values.copy()


def _join_columns(parts: list[Arrays]) -> Arrays:
    """Return the columns of all pieces one after the other; the pieces are taken apart."""
    parts = [part for part in parts if len(part[LOG_TIME])] or parts[:1]
    return {name: _concatenate_column([part.pop(name) for part in parts]) for name in list(parts[0])}


def _concatenate_column(pieces: list[AnyArray]) -> AnyArray:
    """Return pieces of one column as one; rows of lists that are shorter than the longest are filled up."""
    if len(pieces) == 1:
        return pieces[0]
    first = pieces[0][0]
    if all(
        _is_constant(piece) and piece.dtype == first.dtype and piece[0].tobytes() == first.tobytes() for piece in pieces
    ):
        return np.broadcast_to(first, (sum(map(len, pieces)), *first.shape))
    if first.ndim:
        widest = max(piece.shape[1] for piece in pieces)
        fill = [((0, 0), (0, widest - piece.shape[1])) for piece in pieces]
        empty = np.nan if first.dtype.kind == "f" else ""
        pieces = [np.pad(p, f, constant_values=empty) if f[1][1] else p for p, f in zip(pieces, fill, strict=True)]
    return np.concatenate(pieces)


def _is_constant(values: AnyArray) -> bool:
    return len(values) == 1 or values.strides[0] == 0


def _sort_columns(columns: Arrays) -> Arrays:
    """Return the columns in the order of log time; messages of equal times keep their order in the log."""
    log_time_ns = columns[LOG_TIME]
    if not (np.diff(log_time_ns) < 0).any():
        return columns
    order = np.argsort(log_time_ns, kind="stable")
    return {name: values if _is_constant(values) else values[order] for name, values in columns.items()}


def make_rails(streams: Streams, epoch: int) -> list[Rail]:
    """Return the drive rails of one clock epoch, for all users of power, ordered by name; none without power."""
    table = streams.tables.get("power")
    if table is None:
        return []
    # Of the whole run: a rail that is silent in an epoch is not known there.
    names = sorted(pc.unique(table["rail"]).to_pylist())
    table = select_rows(table, "clock_epoch", epoch)
    rails = []
    for name in names:
        rail_rows = select_rows(table, "rail", name)
        signals = (
            make_samples(to_integers(rail_rows, "stamp_ns"), to_floats(rail_rows, c))
            for c in ("voltage_volt", "current_amp")
        )
        rails.append(make_rail(name, *signals, averaged=streams.power_averaged))
    return rails


_ANYWHERE_DEG_M = (0.0, 45.0, 0.0)
"""Assumed longitude, latitude [deg] and height [m] of a frame without a position on the earth; east, north and up do
not change."""


def find_fixes_role(streams: Streams) -> str:
    """Return the role of the positions of a run: that of a pose of another program, or of GNSS."""
    return POSE if POSE in streams.tables else GNSS


def use_pose_as_fixes(streams: Streams) -> tuple[Streams, bool]:
    """Return the streams with a pose as fixes with an attitude, and whether its frame has no place on the earth.

    Inside of fusion its role is that of fixes; `rename_role` names it in everything that leaves the stage.
    """
    if POSE not in streams.tables:
        return streams, False
    pose, facts = streams.tables[POSE], streams.report.facts
    is_local = bool(np.isnan(to_floats(pose, "lon_deg")).any())
    if is_local:
        place = stack_floats(pose, "x_m", "y_m", "z_m")
        names = ("lon_deg", "lat_deg", "alt_m")
        geodetic = dict(zip(names, geodetic_from_enu(place, datum_deg_m=_ANYWHERE_DEG_M), strict=True))
        pose = STREAMS[POSE].table(**{name: pose[name] for name in pose.column_names} | geodetic)
    offsets_s = {GNSS if role == POSE else role: offset_s for role, offset_s in facts.time_offset_s.items()}
    report = replace(streams.report, facts=replace(facts, time_offset_s=offsets_s))
    sensors = {**streams.sensors, GNSS: streams.sensors[POSE]}
    return replace(streams, tables={**streams.tables, POSE: pose}, sensors=sensors, report=report), is_local
