"""Several files of one drive read as one log: ROS 1 splits, power logged apart."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pyarrow as pa

from tcpipe.errors import LogError
from tcpipe.formats.logs.log_file import Log, open_log
from tcpipe.formats.logs.split_bag import PartOfDrive, open_part
from tcpipe.logs.topics import Topic


class JoinedLog:
    """Logs behind one face: topics merged, tables concatenated in log-time order."""

    def __init__(self, logs: Sequence[Log], stack: ExitStack) -> None:
        self._logs = logs
        self._stack = stack
        self.topics = _merged_topics(logs)

    @property
    def damage(self) -> list[Any]:
        """Damage of every file."""
        return [damage for log in self._logs for damage in log.damage]

    @property
    def remarks(self) -> list[str]:
        """What is worth saying of every file, and costs nothing."""
        return [remark for log in self._logs for remark in log.remarks]

    @property
    def size_bytes(self) -> int:
        """Size of all files together."""
        return sum(log.size_bytes for log in self._logs)

    def sha256(self) -> str:
        """Return the hash of the files' hashes, in their order; `LogError` when two files are the same recording."""
        digests: dict[str, Log] = {}
        for log in self._logs:
            twin = digests.setdefault(log.sha256(), log)
            if twin is not log:
                raise LogError(f"{log.path}: the same recording as {twin.path}; give each part once")
        return hashlib.sha256("".join(digests).encode()).hexdigest()

    def tables(self, topics: Sequence[str]) -> dict[str, pa.Table]:
        """Return each topic's table over all files, in log-time order."""
        parts: dict[str, list[pa.Table]] = {}
        for log in self._logs:
            for name, table in log.tables([topic for topic in topics if topic in log.topics]).items():
                parts.setdefault(name, []).append(table)
        return {name: _joined(name, tables).sort_by("log_time_ns") for name, tables in parts.items()}

    def __enter__(self) -> Self:
        """Return self; the files are open already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close every file."""
        self._stack.close()


def _joined(topic: str, tables: Sequence[pa.Table]) -> pa.Table:
    try:
        return pa.concat_tables(tables)
    except pa.ArrowInvalid:
        columns = [set(table.schema) for table in tables]
        odd = sorted({field.name for fields in columns for field in fields ^ columns[0]})
        raise LogError(
            f"topic {topic}: its messages have other fields in one of the files given with --as-one ({', '.join(odd)}); "
            "ingest them apart"
        ) from None


def open_logs(paths: Sequence[Path], *, message_definitions: Path | None = None) -> Log | PartOfDrive | JoinedLog:
    """Open one log, or several as one; `LogError` when a topic has different types in two of them."""
    if len(paths) == 1:
        return open_part(paths[0], message_definitions=message_definitions)
    with ExitStack() as stack:
        logs = [stack.enter_context(open_log(path, message_definitions=message_definitions)) for path in sorted(paths)]
        return JoinedLog(logs, stack.pop_all())


def _merged_topics(logs: Sequence[Log]) -> dict[str, Topic]:
    merged: dict[str, Topic] = {}
    for log in logs:
        for name, topic in log.topics.items():
            before = merged.get(name)
            if before is not None and before.type_name != topic.type_name:
                raise LogError(
                    f"{log.path}: topic {name} is {topic.type_name} here and {before.type_name} in another of the files "
                    f"given with --as-one; ingest them apart"
                )
            merged[name] = topic if before is None else before.joined(topic)
    return merged
