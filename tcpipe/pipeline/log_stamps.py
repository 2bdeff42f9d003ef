"""What the stamps of a topic tell, gathered piece by piece in memory that does not grow with the log."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.logs.clocks import SECOND_NS, TopicTimes

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

_MOST_ROWS = 1 << 17
"""Of a topic with more messages every second, fourth … is kept to judge its clock by: steps that last are seen all the same."""
_GAP_PERIODS, _GAP_NS = 3, 300_000_000
_STAMP = ("header.stamp.sec", "header.stamp.nanosec")
_TIMES = 2
"""Columns before the message's own: both times of the log."""


@dataclass(frozen=True, slots=True)
class StampCounts:
    """Counts over all messages of a topic; those of stamps are None where its messages have no header."""

    messages_read: int
    longest_gap_s: float | None
    longest_gap_at_ns: int | None
    """Log time before it."""
    median_period_s: float | None
    gaps: int
    """Where log time and header agree that nothing came."""
    zero_stamps: int | None
    backward_stamps: int | None
    repeated_stamps: int | None
    duplicates: int | None
    """Messages that repeat the one before exactly."""


class TopicStamps:
    """Counts over all messages of a topic, and as many of its times as its clock is judged by."""

    def __init__(self) -> None:
        self.every = 1
        """One of so many messages is among `times`."""
        self._messages = self._zero = self._backward = self._repeated = self._duplicates = 0
        self._long_steps: list[Ints] = []
        self._longest_ns, self._longest_at_ns = 0, 0
        self._last: pa.Table | None = None
        self._last_set_ns: int | None = None
        self._kept: list[tuple[Ints, Ints | None, Mask]] = []

    def add(self, table: pa.Table) -> None:
        """Add the next rows, in the order of log time."""
        if not table.num_rows:
            return
        first = table if self._last is None else pa.concat_tables([self._last, table])
        log_ns, header_ns = _log_ns(first), _header_ns(first)
        again = np.zeros(len(log_ns), bool)
        steps = np.diff(log_ns)
        if header_ns is not None:
            again[1:] = (np.diff(header_ns) == 0) & (header_ns[1:] != 0)
            steps = np.minimum(steps, np.where(header_ns[1:] != 0, np.diff(header_ns), steps))
            self._count_stamps(header_ns[len(header_ns) - table.num_rows :])
        same = again.copy()
        same[again] = _same_as_before(first, np.flatnonzero(again))
        self._repeated += int(np.count_nonzero(again & ~same))
        self._duplicates += int(np.count_nonzero(same))
        self._note_gaps(steps, log_ns)
        new = slice(len(log_ns) - table.num_rows, None)
        self._keep(log_ns[new], None if header_ns is None else header_ns[new], same[new])
        self._last = table.take(pa.array([table.num_rows - 1]))  # a slice would keep all of it

    def times(self) -> tuple[Ints, Ints | None]:
        """Return the log times and header stamps that are kept [ns]."""
        log_ns, header_ns, _ = self._joined()
        return log_ns, header_ns

    def topic_times(self) -> TopicTimes:
        """Return them for `tcpipe.logs.clocks`: what repeats a message exactly has its content."""
        log_ns, header_ns, same = self._joined()
        return TopicTimes(log_ns, header_ns, (np.cumsum(~same).astype(np.float64),))

    def counts(self) -> StampCounts:
        """Return what was counted."""
        log_ns, header_ns, _ = self._joined()
        period_ns = float(np.median(np.diff(log_ns))) / self.every if len(log_ns) > 1 else None
        steps = np.concatenate([np.zeros(0, np.int64), *self._long_steps])
        odd = (self._zero, self._backward, self._repeated, self._duplicates)
        return StampCounts(
            self._messages,
            self._longest_ns / 1e9 if self._messages > 1 else None,
            self._longest_at_ns if self._messages > 1 else None,
            None if period_ns is None else period_ns / 1e9,
            int(np.count_nonzero(steps > max(_GAP_PERIODS * (period_ns or 0), _GAP_NS))),
            *((None,) * len(odd) if header_ns is None else odd),
        )

    def _count_stamps(self, header_ns: Ints) -> None:
        self._zero += int(np.count_nonzero(header_ns == 0))
        stamps = header_ns[header_ns != 0]
        if len(stamps):
            before = stamps[0] if self._last_set_ns is None else self._last_set_ns
            self._backward += int(np.count_nonzero(np.diff(stamps, prepend=before) < 0))
            self._last_set_ns = int(stamps[-1])

    def _note_gaps(self, steps: Ints, log_ns: Ints) -> None:
        if len(steps) and steps.max() > self._longest_ns:
            self._longest_ns, self._longest_at_ns = int(steps.max()), int(log_ns[steps.argmax()])
        self._long_steps.append(steps[steps > _GAP_NS])  # of these a log of an hour has 12 000 at most

    def _keep(self, log_ns: Ints, header_ns: Ints | None, same: Mask) -> None:
        chosen = slice(-self._messages % self.every, None, self.every)
        self._kept.append(
            (log_ns[chosen].copy(), None if header_ns is None else header_ns[chosen].copy(), same[chosen])
        )
        self._messages += len(log_ns)
        while sum(len(log) for log, _, _ in self._kept) > _MOST_ROWS:
            log, header, again = self._joined()
            self._kept = [(log[::2].copy(), None if header is None else header[::2].copy(), again[::2].copy())]
            self.every *= 2

    def _joined(self) -> tuple[Ints, Ints | None, Mask]:
        if not self._kept:
            return np.zeros(0, np.int64), None, np.zeros(0, bool)
        headers = [header for _, header, _ in self._kept if header is not None]
        return (
            np.concatenate([log for log, _, _ in self._kept]),
            np.concatenate(headers) if headers else None,
            np.concatenate([same for _, _, same in self._kept]),
        )


def _log_ns(table: pa.Table) -> Ints:
    log_ns: Ints = table.column("log_time_ns").to_numpy()
    return log_ns


def _header_ns(table: pa.Table) -> Ints | None:
    if not set(_STAMP) <= set(table.column_names):
        return None
    seconds, nanoseconds = (table.column(name).to_numpy().astype(np.int64) for name in _STAMP)
    stamps: Ints = seconds * SECOND_NS + nanoseconds
    return stamps


def _same_as_before(table: pa.Table, rows: Ints) -> Mask:
    """Return which of the rows repeat the row before exactly, times of the log aside, shape (len(rows),)."""
    same = np.ones(len(rows), bool)
    for column in table.columns[_TIMES:]:
        left = np.flatnonzero(same)
        if not len(left):
            break
        own, before = (column.take(pa.array(rows[left] - back)).combine_chunks() for back in (0, 1))
        if pa.types.is_primitive(column.type) and not pa.types.is_boolean(column.type):
            values = [np.ascontiguousarray(of.to_numpy()).view(f"V{of.type.byte_width}") for of in (own, before)]
            same[left] = values[0] == values[1]  # bit by bit: a NaN equals itself
        else:
            same[left] = [own.slice(row, 1).equals(before.slice(row, 1)) for row in range(len(left))]
    return same
