"""Any topics of a log as Parquet: useful to people who need nothing else of tcpipe."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from tcpipe.errors import LogError
from tcpipe.formats.log_file import open_log
from tcpipe.formats.parquet import parquet_rows
from tcpipe.logs.topics import Topic
from tcpipe.tables.levels import with_metadata


@dataclass(frozen=True, slots=True)
class Exported:
    """Files written: (topic, path, rows), what the log had lost, and what else is worth saying of it."""

    files: tuple[tuple[str, Path, int], ...]
    damage: tuple[str, ...]
    remarks: tuple[str, ...]


def export(
    log_path: Path | str,
    out: Path,
    *,
    topics: Sequence[str] = (),
    message_definitions: Path | None = None,
    threads: int = 1,
) -> Exported:
    """Write each topic to ``out/<topic>.parquet``: one row a message, columns by dotted field name, definition in the metadata.

    The log is read and written piece by piece: memory does not grow with it.

    Raises
    ------
    LogError
        When the log cannot be read, or a topic is not in it (all missing topics at once).

    """
    with open_log(log_path, message_definitions=message_definitions) as log, ExitStack() as files:
        missing = [topic for topic in topics if topic not in log.topics]
        if missing:
            there = ", ".join(sorted(log.topics)) or "none"
            raise LogError(*(f"{log_path}: topic {topic} is not in this log; there are: {there}" for topic in missing))
        wanted = list(topics) or sorted(log.topics)
        paths = _paths(out, wanted)
        writers: dict[str, Callable[[pa.Table], None]] = {}
        rows = dict.fromkeys(wanted, 0)
        for tables in log.batches(wanted, threads=threads):
            for name, table in tables.items():
                if name not in writers:
                    described = with_metadata(table[:0], _description(log.topics[name]))
                    writers[name] = files.enter_context(parquet_rows(paths[name], described.schema))
                writers[name](table)
                rows[name] += table.num_rows
        damage = tuple(str(damage) for damage in log.damage if damage.is_loss)
        remarks = tuple(log.remarks)
    return Exported(tuple((name, paths[name], rows[name]) for name in wanted if name in writers), damage, remarks)


def _paths(out: Path, topics: Sequence[str]) -> dict[str, Path]:
    """Return a file for each topic, named after it; where two would share a name, the later ones get a number."""
    paths: dict[str, Path] = {}
    taken: set[str] = set()
    for topic in topics:
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", topic.strip("/")) or "topic"
        names = (stem if number == 1 else f"{stem}-{number}" for number in itertools.count(1))
        name = next(name for name in names if name.lower() not in taken)
        taken.add(name.lower())
        paths[topic] = out / f"{name}.parquet"
    return paths


def _description(topic: Topic) -> dict[str, str]:
    return {"topic": topic.name, "type": topic.type_name, "definition": topic.definition}
