"""A part of a split ROS 1 recording: what is recorded once, at the beginning, stands in an earlier part beside it.

`rosbag record --split` writes ``drive_0.bag``, ``drive_1.bag``, … (with the time of each before the number, unless that is left out), and
latched messages only into the part in which they came.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import pyarrow as pa

from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import Log, open_log
from tcpipe.logs.topics import Damage, Topic

_PART = re.compile(r"(?P<name>.+)_(?P<number>[0-9]{1,6})\.bag(\.active)?")
_DATE = re.compile(r"[0-9]{4}(-[0-9]{2}){5}")
_STATIC = "tf_static"
_GAP_NS = 5_000_000_000
"""Parts of one recording follow one another within so much."""


class PartOfDrive:
    """A log with the static transforms of an earlier part; its content, damage and size are its own."""

    def __init__(self, log: Log, earlier: Log, stack: ExitStack) -> None:
        self._log, self._earlier, self._stack = log, earlier, stack
        self.topics: dict[str, Topic] = {**_static_topics(earlier), **log.topics}
        self.sha256 = log.sha256
        self.size_bytes = log.size_bytes

    @property
    def damage(self) -> list[Damage]:
        """Damage of the log itself."""
        return self._log.damage

    @property
    def remarks(self) -> list[str]:
        """What is worth saying and costs nothing."""
        taken = f"{self._log.path.name}: goes on where {self._earlier.path.name} ends, whose static transforms are taken: it has none"
        return [*self._log.remarks, taken]

    def tables(self, topics: Sequence[str]) -> dict[str, pa.Table]:
        """Return the tables of its own topics, and of the static transforms."""
        mine = [topic for topic in topics if topic in self._log.topics]
        theirs = [topic for topic in topics if topic not in mine]
        return {**self._log.tables(mine), **(self._earlier.tables(theirs) if theirs else {})}

    def __enter__(self) -> Self:
        """Return self; the files are open already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close both files."""
        self._stack.close()


def open_part(path: Path, *, message_definitions: Path | None = None) -> Log | PartOfDrive:
    """Open a log; where it goes on an earlier part of a split recording and lacks static transforms, with those of that part."""
    log = open_log(path, message_definitions=message_definitions)
    with ExitStack() as stack:
        stack.callback(log.close)
        with ExitStack() as parts:
            earlier = None if _static_topics(log) else _first_part(log, parts)
            if earlier is not None:
                stack.push(parts.pop_all())
        both = stack.pop_all()
    return log if earlier is None else PartOfDrive(log, earlier, both)


def _first_part(log: Log, stack: ExitStack) -> Log | None:
    """Return the nearest earlier part that has static transforms, open; None where the chain of parts breaks before."""
    part: Log | None = log
    while part is not None:
        part = _part_before(part, stack)
        if part is not None and _static_topics(part):
            return part
    return None


def _part_before(log: Log, stack: ExitStack) -> Log | None:
    mine = _PART.fullmatch(log.path.name)
    starts = [topic.start_ns for topic in log.topics.values() if topic.start_ns is not None]
    if mine is None or not starts or log.path.is_dir():
        return None
    for path in sorted(log.path.parent.iterdir()):
        other = _PART.fullmatch(path.name)
        if (
            other
            and int(other["number"]) == int(mine["number"]) - 1
            and _DATE.sub("", other["name"]) == _DATE.sub("", mine["name"])
        ):
            try:
                found = open_log(path)
            except (LogError, OSError):
                continue
            ends = [topic.end_ns for topic in found.topics.values() if topic.end_ns is not None]
            if ends and abs(min(starts) - max(ends)) <= _GAP_NS:
                return stack.enter_context(found)
            found.close()
    return None


def _static_topics(log: Log) -> dict[str, Topic]:
    return {name: topic for name, topic in log.topics.items() if name.endswith(_STATIC)}
