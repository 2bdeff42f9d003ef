"""Simulated time: where it is counted, its headers rule, and what the wall clock does meanwhile means nothing.

A simulation runs slower than the wall clock, or faster, and may pause; ROS publishes its time on /clock, and stamps of before September
2001 are no wall clock's. Where most topics count such a time, and it runs forward, what happened at a log time is told by the headers that
were received then: topics without a usable header are put on that clock, not moved by a constant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.tables.catalogue import read_threshold
from tcpipe.tables.findings import Finding, Subject, make_finding

Ints = NDArray[np.int64]

SIMULATED_NS = 10**18
"""Times before this (September 2001) are not the wall clock's: simulated time begins near 0."""
CLOCK = "rosgraph_msgs/msg/Clock"
"""The type of the topic that publishes simulated time."""

_BACK_NS = 1_000_000_000
_MOST_BACK = 0.01
_MOST_UNSET = 0.5
_FEWEST = 3
LOG_CLOCK = Subject("log", "clock")


@dataclass(frozen=True, slots=True)
class SimulatedClock:
    """What the simulation's clock told at which log time: both [ns], shape (N,), both rising; and which topics count it."""

    log_time_ns: Ints
    clock_ns: Ints
    topics: frozenset[str]

    def at(self, log_time_ns: Ints) -> Ints:
        """Return the simulation's time [ns] at each log time; before the first and after the last at the wall clock's rate."""
        log, clock = self.log_time_ns, self.clock_ns
        found = clock[0] + np.rint(np.interp(log_time_ns - log[0], log - log[0], clock - clock[0])).astype(np.int64)
        outside = np.minimum(log_time_ns - log[0], 0) + np.maximum(log_time_ns - log[-1], 0)
        there: Ints = found + outside
        return there

    @property
    def rate(self) -> float:
        """Seconds of the simulation in a second of the log."""
        return float(self.clock_ns[-1] - self.clock_ns[0]) / float(self.log_time_ns[-1] - self.log_time_ns[0])

    def find_simulated_time(self) -> tuple[Finding, ...]:
        """Return the finding that durations are those of the simulation; none where the log's own clock is the simulation's."""
        least = read_threshold("simulated-time", "min_rate_difference_fraction")
        if abs(self.rate - 1.0) < least and self.log_time_ns[0] < SIMULATED_NS:
            return ()
        names = {"topics": ", ".join(sorted(self.topics))}
        return (make_finding("simulated-time", LOG_CLOCK, names=names, rate_fraction=self.rate),)


def find_simulated_clock(stamps: Mapping[str, tuple[Ints, Ints]], *, published: bool) -> SimulatedClock | None:
    """Return the clock of the simulation that a log is of, None where it is of none.

    Parameters
    ----------
    stamps : by topic, log times and header stamps [ns], each of shape (N,), a header's 0 where it is unset.
    published : whether the log holds a /clock topic; without, stamps must be no wall clock's.
    """
    told = {name: (log[header > 0], header[header > 0]) for name, (log, header) in stamps.items() if _is_told(header)}
    counting = [name for name, (_, header) in told.items() if _is_counting_clock(header, published=published)]
    if not counting or 2 * len(counting) <= len(told):
        return None
    log, clock = max((told[name] for name in counting), key=lambda of: len(of[0]))
    ahead = np.concatenate(([True], clock[1:] > np.maximum.accumulate(clock)[:-1]))
    log, first = np.unique(log[ahead], return_index=True)
    return SimulatedClock(log, clock[ahead][first], frozenset(counting)) if len(log) > 1 else None


def _is_told(header_ns: Ints) -> bool:
    known = int(np.count_nonzero(header_ns > 0))
    return known >= _FEWEST and known > _MOST_UNSET * len(header_ns)


def _is_counting_clock(header_ns: Ints, *, published: bool) -> bool:
    """Whether headers count simulated time that runs forward."""
    back = np.maximum.accumulate(header_ns) - header_ns > _BACK_NS
    return bool(np.mean(back) <= _MOST_BACK and (published or np.median(header_ns) < SIMULATED_NS))
