"""What a log holds: topics and roles from its index; with everything read, also gaps, clocks and damage, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.formats.log_file import Log
from tcpipe.logs.clocks import SECOND_NS, TopicTimes, settle_clocks
from tcpipe.logs.roles import assign_roles
from tcpipe.logs.topics import Topic
from tcpipe.recipe import Recipe

Ints = NDArray[np.int64]

_MOST_ROWS = 1 << 19
"""Of a topic with more messages every second, fourth … is kept to judge its clock by: steps that last are seen all the same."""
_SIMULATED_NS = 10**9 * SECOND_NS
"""Times before this (September 2001) are not the wall clock's: simulated time begins near 0."""
_GAP_PERIODS, _GAP_NS = 3, 300_000_000
_STAMP = ("header.stamp.sec", "header.stamp.nanosec")


def inspect_log(log: Log, recipe: Recipe, robot: str | None, *, full: bool) -> dict[str, Any]:
    """Return what a log holds as JSON values.

    Parameters
    ----------
    full
        Read every message: counts, gaps, stamps, clock steps and damage, not the index alone.
    """
    config = recipe.read
    cast = assign_roles(log.topics.values(), config.topics, config.ignore_topics, robot, namespace=config.namespace)
    playing = {topic: (name, role.why) for name, role in cast.roles.items() for topic in role.topics}
    playing |= dict.fromkeys(cast.transforms, ("transforms", "places the sensors"))
    read, clocks = _read(log) if full else ({}, {})
    starts = [topic.start_ns for topic in log.topics.values() if topic.start_ns is not None]
    ends = [topic.end_ns for topic in log.topics.values() if topic.end_ns is not None]
    return {
        "kind": "log",
        "path": str(log.path),
        "container": log.container,
        "size_bytes": log.size_bytes,
        "start_ns": min(starts, default=None),
        "duration_s": (max(ends) - min(starts)) / 1e9 if starts and ends else None,
        "robot": cast.robot.name,
        "robot_why": cast.robot_why,
        "topics": [
            {
                "name": topic.name,
                "type": topic.type_name,
                "messages": topic.message_count,
                "rate_hz": _rate_hz(topic),
                "role": playing.get(topic.name, (None, None))[0],
                "why": playing.get(topic.name, (None, cast.left_out.get(topic.name) or topic.problem))[1],
                **read.get(topic.name, {}),
            }
            for topic in sorted(log.topics.values(), key=lambda topic: topic.name)
        ],
        **clocks,
        "problems": list(cast.problems),
        "warnings": [*cast.warnings, *_simulated(log.topics.values(), starts)],
        "damage": [str(damage) for damage in log.damage if damage.is_loss],
        "remarks": log.remarks,
    }


class _TopicStamps:
    """What the stamps of one topic tell, piece by piece."""

    def __init__(self) -> None:
        self.messages = self.zero = self.backward = self.repeated = 0
        self._long_steps: list[Ints] = []
        self._last_log_ns: int | None = None
        self._last_header_ns: int | None = None
        self._every = 1
        self._kept: list[tuple[Ints, Ints | None]] = []

    def add(self, table: pa.Table) -> None:
        """Add the next rows."""
        log_ns = table.column("log_time_ns").to_numpy()
        header_ns = _header_ns(table)
        if not len(log_ns):
            return
        steps = np.diff(log_ns, prepend=log_ns[0] if self._last_log_ns is None else self._last_log_ns)
        self._long_steps.append(steps[steps > min(_GAP_NS, int(steps.max()) - 1)])
        if header_ns is not None:
            before = [] if self._last_header_ns is None else [self._last_header_ns]
            steps = np.diff(np.concatenate([np.array(before, np.int64), header_ns]))
            self.zero += int(np.count_nonzero(header_ns == 0))
            self.backward += int(np.count_nonzero(steps < 0))
            self.repeated += int(np.count_nonzero(steps == 0))
            self._last_header_ns = int(header_ns[-1])
        first = -self.messages % self._every
        chosen = slice(first, None, self._every)
        self._kept.append((log_ns[chosen].copy(), None if header_ns is None else header_ns[chosen].copy()))
        self.messages += len(log_ns)
        self._last_log_ns = int(log_ns[-1])
        self._thin_out()

    def times(self) -> tuple[Ints, Ints | None]:
        """Return the log times and header stamps that are kept."""
        log_ns = np.concatenate([log for log, _ in self._kept]) if self._kept else np.zeros(0, np.int64)
        headers = [header for _, header in self._kept if header is not None]
        return log_ns, np.concatenate(headers) if headers else None

    def facts(self) -> dict[str, Any]:
        """Return counts, the longest gap and the usual period, in log time."""
        log_ns, header_ns = self.times()
        period_ns = float(np.median(np.diff(log_ns))) / self._every if len(log_ns) > 1 else None
        steps = np.concatenate([np.zeros(1, np.int64), *self._long_steps])
        stamps = {"zero_stamps": self.zero, "backward_stamps": self.backward, "repeated_stamps": self.repeated}
        return {
            "messages_read": self.messages,
            "longest_gap_s": float(steps.max()) / 1e9 if self.messages > 1 else None,
            "median_period_s": None if period_ns is None else period_ns / 1e9,
            "gaps": int(np.count_nonzero(steps > max(_GAP_PERIODS * (period_ns or 0), _GAP_NS))),
            **({} if header_ns is None else stamps),
        }

    def _thin_out(self) -> None:
        if sum(len(log) for log, _ in self._kept) <= _MOST_ROWS:
            return
        log_ns, header_ns = self.times()
        self._kept = [(log_ns[::2].copy(), None if header_ns is None else header_ns[::2].copy())]
        self._every *= 2


def _read(log: Log) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Read every message; return facts by topic, and what the clocks did."""
    found: dict[str, _TopicStamps] = {}
    for tables in log.batches(sorted(log.topics)):
        for name, table in tables.items():
            found.setdefault(name, _TopicStamps()).add(table)
    facts = {name: stamps.facts() for name, stamps in found.items()}
    times = {name: stamps.times() for name, stamps in found.items()}
    clocks = {
        name: TopicTimes(log_ns, header_ns, np.arange(len(log_ns), dtype=np.float64)[:, None])
        for name, (log_ns, header_ns) in times.items()
        if header_ns is not None and len(log_ns)
    }
    timelines, steps = settle_clocks(clocks)
    for name, timeline in timelines.items():
        facts[name] |= {"time": timeline.source, "time_why": timeline.why, "header_minus_log_s": timeline.offset_s}
    return facts, {
        "clock_epochs": len(steps) + 1,
        "clock_steps": [
            {"log_time_ns": step.log_time_ns, "step_s": step.step_s, "topics": list(step.topics)} for step in steps
        ],
        "simulated_headers": _simulated_headers(times),
    }


def _header_ns(table: pa.Table) -> Ints | None:
    if not set(_STAMP) <= set(table.column_names):
        return None
    seconds, nanoseconds = (table.column(name).to_numpy().astype(np.int64) for name in _STAMP)
    stamps: Ints = seconds * SECOND_NS + nanoseconds
    return stamps


def _simulated_headers(times: Mapping[str, tuple[Ints, Ints | None]]) -> list[str]:
    """Return the topics whose headers count simulated time while the log counts the wall clock's."""
    return sorted(
        name
        for name, (log_ns, header_ns) in times.items()
        if header_ns is not None
        and (header_ns > 0).any()
        and np.median(header_ns[header_ns > 0]) < _SIMULATED_NS < np.median(log_ns)
    )


def _simulated(topics: Iterable[Topic], starts_ns: list[int]) -> list[str]:
    """Return what the index tells of simulated time."""
    said = []
    if starts_ns and max(starts_ns) < _SIMULATED_NS:
        said.append(f"the log's own times are simulated: they begin {min(starts_ns) / 1e9:.3f} s after 0")
    said += [
        f"{topic.name} publishes simulated time ({topic.type_name})"
        for topic in topics
        if topic.type_name == "rosgraph_msgs/msg/Clock"
    ]
    return said


def _rate_hz(topic: Topic) -> float | None:
    if topic.message_count is None or topic.start_ns is None or topic.end_ns is None or topic.end_ns <= topic.start_ns:
        return None
    return round((topic.message_count - 1) / ((topic.end_ns - topic.start_ns) / 1e9), 2)
