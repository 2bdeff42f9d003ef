"""Messages of a log, gathered piece by piece: a column that never changes (a frame, most covariances) takes the room of one message."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.logs.messages import LOG_TIME
from tcpipe.stages.message_arrays import message_arrays

Arrays = dict[str, NDArray[Any]]

_PUBLISH_TIME = "publish_time_ns"


def gather_messages(
    batches: Iterable[Mapping[str, pa.Table]], played: Mapping[str, Collection[str]]
) -> tuple[dict[str, Arrays], dict[str, pa.Table]]:
    """Return the messages of a log by topic, in the order of log time.

    Parameters
    ----------
    batches : tables by topic, piece after piece, as a log gives them.
    played : topics whose messages are wanted as arrays, each with the numbers inside lists of messages (see `message_arrays`).

    Returns
    -------
    arrays : of the topics that are played; columns that never change are read-only and take the room of one row.
    tables : of the other topics.
    """
    pieces: dict[str, list[Arrays]] = {}
    others: dict[str, list[pa.Table]] = {}
    for tables in batches:
        for topic, table in tables.items():
            if topic in played:
                arrays = message_arrays(table.drop_columns(_PUBLISH_TIME), played[topic])
                pieces.setdefault(topic, []).append({name: _compact(values) for name, values in arrays.items()})
            else:
                others.setdefault(topic, []).append(table)
    joined = {topic: pa.concat_tables(tables) for topic, tables in others.items()}
    return {topic: _in_order(_joined(parts)) for topic, parts in pieces.items()}, joined


def _compact(values: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of its own of a column's values; one row for all, where every row has the same bits."""
    values = np.ascontiguousarray(values)
    row_bytes = values[:1].nbytes
    if len(values) < 2 or not row_bytes:
        return values.copy()
    bits = values.reshape(-1).view(np.uint64 if row_bytes % 8 == 0 else np.uint8).reshape(len(values), -1)
    if np.array_equal(bits[0], bits[-1]) and (bits == bits[0]).all():
        return np.broadcast_to(values[0].copy(), values.shape)
    return values.copy()


def _joined(parts: list[Arrays]) -> Arrays:
    """Return the columns of all pieces one after the other; the pieces are taken apart."""
    parts = [part for part in parts if len(part[LOG_TIME])] or parts[:1]
    return {name: _concatenated([part.pop(name) for part in parts]) for name in list(parts[0])}


def _concatenated(pieces: list[NDArray[Any]]) -> NDArray[Any]:
    """Return pieces of one column as one; rows of lists that are shorter than the longest are filled up with NaN."""
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
        pieces = [np.pad(p, f, constant_values=np.nan) if f[1][1] else p for p, f in zip(pieces, fill, strict=True)]
    return np.concatenate(pieces)


def _is_constant(values: NDArray[Any]) -> bool:
    return len(values) == 1 or values.strides[0] == 0


def _in_order(columns: Arrays) -> Arrays:
    """Return the columns in the order of log time; messages of equal times as they lie in the log."""
    log_time_ns = columns[LOG_TIME]
    if not (np.diff(log_time_ns) < 0).any():
        return columns
    order = np.argsort(log_time_ns, kind="stable")
    return {name: values if _is_constant(values) else values[order] for name, values in columns.items()}
