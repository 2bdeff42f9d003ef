"""Several files of one drive read as one log: parts of a ROS 1 split, or power in a separate file.

`rosbag record --split` writes ``drive_0.bag``, ``drive_1.bag``, … (often with a time before the number), and static
transforms only into the part in which they came: a later part that is read alone takes them from the nearest earlier
part in its folder.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import pyarrow as pa

from tcpipe.errors import LogError
from tcpipe.formats.atomic import Location
from tcpipe.formats.integrity import Checksum
from tcpipe.formats.logs.log_file import Log, OpenLog, find_autopilot, open_log
from tcpipe.formats.logs.log_part import join_hashes
from tcpipe.formats.logs.message_tables import TableLog
from tcpipe.formats.logs.rosbag2 import is_one_bag
from tcpipe.formats.logs.table_folders import AUTOPILOT_SUFFIXES, Mappings, find_table_run, is_log_file, is_table
from tcpipe.formats.object_storage import format_path, is_url, lay_out_objects
from tcpipe.logs.topics import Topic
from tcpipe.tables.findings import Finding, Subject, make_finding

_PART = re.compile(r"(?P<name>.+)_(?P<number>[0-9]{1,6})\.bag(\.active)?")
_DATE = re.compile(r"[0-9]{4}(-[0-9]{2}){5}")
_STATIC = "tf_static"
_GAP_NS = 5_000_000_000  # longest time between two parts of one log [ns]


class JoinedLog(OpenLog):
    """Several logs by the interface of one: merged topics, tables in log-time order, static transforms of the first."""

    def __init__(
        self, logs: Sequence[Log | TableLog], earlier: Log | None, topics: Mapping[str, Topic], stack: ExitStack
    ) -> None:
        super().__init__(stack, [file for log in logs for file in log.files])
        self._logs, self._earlier, self.topics = logs, earlier, topics

    @property
    def findings(self) -> list[Finding]:
        """Damage and notes of every file."""
        found = [finding for log in self._logs for finding in log.findings]
        if self._earlier:
            subject, names = Subject("file", self._logs[0].path.name), {"earlier": self._earlier.path.name}
            found.append(make_finding("static-transforms-borrowed", subject, names=names))
        return found

    @property
    def outline(self) -> str:
        """A hash of the indexes of all files; "" if one has none."""
        outlines = [log.outline for log in self._logs]
        return join_hashes(outlines) if all(outlines) else ""

    @property
    def is_known_by_outline(self) -> bool:
        """Whether `sha256` is an outline instead of a hash."""
        return any(log.is_known_by_outline for log in self._logs)

    @cached_property
    def parts(self) -> tuple[Checksum, ...]:
        """Size and hash of each log, in order. `LogError`: two logs are the same recording."""
        digests: dict[str, Log | TableLog] = {}
        for log in self._logs:
            duplicate = digests.setdefault(log.sha256(), log)
            if duplicate is not log:
                raise LogError(f"{log.path}: the same recording as {duplicate.path}; give each part once")
        return tuple(Checksum(log.size_bytes, sha256) for sha256, log in digests.items())

    def sha256(self) -> str:
        """Return the hash of a single log, or the hash of the hashes of several logs, in order."""
        return join_hashes([part.sha256 for part in self.parts])

    def tables(self, topics: Sequence[str]) -> dict[str, pa.Table]:
        """Return each topic's table over all files, in log-time order."""
        parts: dict[str, list[pa.Table]] = {}
        for tables in self.batches(topics):
            for name, table in tables.items():
                parts.setdefault(name, []).append(table)
        return {name: pa.concat_tables(of_topic).sort_by("log_time_ns") for name, of_topic in parts.items()}

    def batches(self, topics: Sequence[str]) -> Iterator[dict[str, pa.Table]]:
        """Yield each topic's tables piece by piece, file after file."""
        schemas: dict[str, pa.Schema] = {}
        for log in self._logs:
            for tables in log.batches([topic for topic in topics if topic in log.topics]):
                for name, table in tables.items():
                    _require_same_fields(name, schemas.setdefault(name, table.schema), table.schema)
                yield tables
        borrowed = [topic for topic in topics if not any(topic in log.topics for log in self._logs)]
        if self._earlier and borrowed:
            yield from self._earlier.batches(borrowed)


def _require_same_fields(topic: str, first: pa.Schema, other: pa.Schema) -> None:
    """Raise `LogError` if the messages of a topic have other fields in another file."""
    if first != other:
        differing = sorted({field.name for field in set(first) ^ set(other)})
        raise LogError(
            f"topic {topic}: its messages have other fields in one of the files given with --as-one ({', '.join(differing)}); "
            "ingest them apart"
        )


AnyLog: TypeAlias = "Log | JoinedLog | TableLog"


def open_logs(
    paths: Sequence[Location], *, message_definitions: Path | None = None, tables: Mappings | None = None
) -> AnyLog:
    """Open one log as `open_single_log`, or several as one; `LogError` if a topic's types differ between them."""
    firsts: dict[tuple[Location, ...], Location] = {}
    for path in sorted(paths, key=Path):
        run = find_table_run(path, tables or {})
        firsts.setdefault(run.files if run else (path,), path)
    with ExitStack() as stack:
        logs: list[Log | TableLog] = []
        for path in firsts.values():
            logs.append(open_single_log(path, message_definitions=message_definitions, tables=tables))
            stack.push(logs[-1])
        alone = logs[0] if len(logs) == 1 else None
        earlier = _find_earlier_part(alone) if isinstance(alone, Log) and not _find_static_topics(alone) else None
        if earlier:
            stack.enter_context(earlier)
        topics = (_find_static_topics(earlier) if earlier else {}) | _merge_topics(logs)
        opened = stack.pop_all()
    return JoinedLog(logs, earlier, topics, opened) if earlier or len(logs) > 1 else logs[0]


def open_single_log(
    path: Location, *, message_definitions: Path | None = None, tables: Mappings | None = None
) -> Log | TableLog:
    """Open an autopilot log, a table or folder of tables that ``tables`` maps, or a log that `open_log` reads."""
    with ExitStack() as stack:
        local_path, name = path, format_path(path)
        if is_url(path) and name.lower().endswith(AUTOPILOT_SUFFIXES):
            local_path, _ = stack.enter_context(lay_out_objects(str(path), wanted=is_log_file, by_range=()))
        if not is_url(local_path) and (kind := find_autopilot(Path(local_path))):
            from tcpipe.formats.logs.autopilot_log import open_autopilot_log  # noqa: PLC0415  only where one is read

            return open_autopilot_log(Path(local_path), kind, stack.pop_all())
    if tables and isinstance(path, Path):
        run = find_table_run(path, tables) if path.is_file() else None
        if run or (path.is_dir() and not is_one_bag(path)):
            from tcpipe.formats.logs.table_log import open_tables  # noqa: PLC0415  polars only where a table is read

            return open_tables(run.folder, run.mappings, run.files) if run else open_tables(path, tables)
        if path.is_file() and is_table(path.name):
            files = ", ".join(dict.fromkeys(mapping.file for mapping in tables.values()))
            raise LogError(
                f"{path}: the recipe's tables are called {files}; write a * for the part of a name that differs by run"
            )
    return open_log(path, message_definitions=message_definitions)


def _find_earlier_part(log: Log) -> Log | None:
    """Return the nearest earlier part that has static transforms, open; None if a part between is missing."""
    part: Log | None = log
    while part is not None:
        before = _find_part_before(part)
        if part is not log:
            part.close()
        if before is not None and _find_static_topics(before):
            return before
        part = before
    return None


def _find_part_before(log: Log) -> Log | None:
    """Return the part of the same recording that ends where this one begins, open."""
    own_name = _PART.fullmatch(log.path.name)
    starts = [topic.start_ns for topic in log.topics.values() if topic.start_ns is not None]
    if own_name is None or not starts or log.path.is_dir():
        return None
    for path in sorted(log.path.parent.iterdir()):
        other_name = _PART.fullmatch(path.name)
        if (
            other_name
            and int(other_name["number"]) == int(own_name["number"]) - 1
            and _DATE.sub("", other_name["name"]) == _DATE.sub("", own_name["name"])
        ):
            try:
                candidate = open_log(path)
            except (LogError, OSError):
                continue
            ends = [topic.end_ns for topic in candidate.topics.values() if topic.end_ns is not None]
            if ends and abs(min(starts) - max(ends)) <= _GAP_NS:
                return candidate
            candidate.close()
    return None


def _merge_topics(logs: Sequence[Log | TableLog]) -> dict[str, Topic]:
    """Return the topics of all logs by name; `LogError` if a topic has different types."""
    merged: dict[str, Topic] = {}
    for log in logs:
        for name, topic in log.topics.items():
            earlier = merged.get(name)
            if earlier is not None and earlier.type_name != topic.type_name:
                raise LogError(
                    f"{log.path}: topic {name} is {topic.type_name} here and {earlier.type_name} in another of the files "
                    f"given with --as-one; ingest them apart"
                )
            merged[name] = topic if earlier is None else earlier.joined(topic)
    return merged


def _find_static_topics(log: Log) -> dict[str, Topic]:
    return {name: topic for name, topic in log.topics.items() if name.endswith(_STATIC)}
