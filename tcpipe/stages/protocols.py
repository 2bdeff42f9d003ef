"""What the first and the last stage need of files, so that no stage has to know one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol

import pyarrow as pa

from tcpipe.logs.topics import Topic


class LogReader(Protocol):
    """A log: its topics by name, and their tables in one pass."""

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Every topic by name, as the log's index tells."""

    def tables(self, topics: Sequence[str]) -> dict[str, pa.Table]:
        """Return a table a topic: one row a message in the order of log time, ``log_time_ns``, ``publish_time_ns``, fields by dotted name.

        A topic that cannot be decoded is missing from the result.
        """

    def batches(self, topics: Sequence[str]) -> Iterator[Mapping[str, pa.Table]]:
        """Yield the same piece by piece: each the next rows of some topics; a message that lies far behind its time comes later."""
