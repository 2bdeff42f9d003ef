"""Export topics of a log as Parquet, also for users who need no other part of tcpipe."""

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pyarrow as pa

from tcpipe import __version__
from tcpipe.errors import LogError, StoreError, UsageError, clean_lines
from tcpipe.formats.atomic import Location, clear
from tcpipe.formats.json_files import read_as, write_json
from tcpipe.formats.logs.log_file import Log
from tcpipe.formats.logs.log_joining import AnyLog, open_single_log
from tcpipe.formats.object_storage import format_path, is_url
from tcpipe.formats.parquet import make_storable, read_schema, write_parquet_rows
from tcpipe.logs.topics import split_notes
from tcpipe.pipeline.log_sources import make_definitions_key
from tcpipe.store import is_store
from tcpipe.tables.findings import Findings
from tcpipe.tables.levels import add_metadata, read_metadata

INDEX = "export.json"
"""File that lists the exported topics and their log, so that a second call does nothing."""
_LONGEST_STEM = 200


@dataclass(frozen=True, slots=True)
class ExportOrigin:
    """Inputs of an export."""

    log: str
    """Its path or URL."""
    size_and_time: tuple[tuple[int, int], ...]
    """Size and modification time of each of its files [byte, ns]."""
    message_definitions: str
    tcpipe_version: str


@dataclass(frozen=True, slots=True)
class IndexEntry:
    """A topic's file; None if the topic cannot be read."""

    file: str | None
    bytes: int
    type: str
    rows: int


@dataclass(frozen=True, slots=True)
class ExportIndex:
    """All of export.json."""

    made_from: ExportOrigin
    topics: Mapping[str, IndexEntry]
    damage: Findings
    notes: Findings


@dataclass(frozen=True, slots=True)
class ExportedTopic:
    """One topic's file."""

    topic: str
    type: str
    path: Path
    messages: int


@dataclass(frozen=True, slots=True)
class Exported:
    """The files, losses of the log, and further notes; ``unchanged`` if all files existed already."""

    log: str
    out: Path
    status: Literal["done", "unchanged"]
    topics: tuple[ExportedTopic, ...]
    damage: Findings
    notes: Findings
    exit_code: int
    """3 where the log had lost something."""

    def __str__(self) -> str:
        """Return a line for each topic."""
        count = len(self.topics)
        lines = [f"{topic.messages:>9} messages  {topic.topic}  {topic.path}" for topic in self.topics]
        if self.status == "unchanged":
            lines = [f"nothing to do: {count} of {count} topics of {self.log} are in {self.out} already"]
        elif not self.topics:
            lines = [f"nothing to export: {self.log} has no topics"]
        return clean_lines(lines)


def export(
    log_path: Location, out: Path, *, topics: Sequence[str] = (), message_definitions: Path | None = None
) -> Exported:
    """Write each topic to ``out/<topic>.parquet``: a row per message, columns by dotted field name, its definition.

    The log, or that at a URL, is read once and written piece by piece: memory does not grow with it. Topics of the same
    log that ``out`` has are not written again. Without ``topics`` all are written; one text may name several, divided
    by commas. ``message_definitions`` is a directory of .msg or .idl files for types that the log does not define.

    `LogError`: the log cannot be read, none of the topics can, one is not in it (all missing topics at once), a file
    belongs to another log or to no export, or ``out`` is a dataset, run, map, model, cost map or store.
    """
    _refuse_own_output(out)
    clear(out)
    shown = format_path(log_path)
    with open_single_log(log_path, message_definitions=message_definitions) as log:
        wanted = _select_topics(log, shown, topics)
        made_from = ExportOrigin(
            log=shown if is_url(shown) else str(Path(shown).resolve()),
            size_and_time=tuple((size, time_ns) for size, time_ns in log.size_and_time),
            message_definitions=make_definitions_key(message_definitions),
            tcpipe_version=__version__,
        )
        paths = _make_paths(out, sorted(log.topics))
        index = _read_index(out)
        _refuse_others_files(index, made_from, {name: paths[name] for name in wanted})
        exported = index.topics if index is not None and index.made_from == made_from else {}
        if index is not None and wanted and all(_is_there(exported.get(name), out) for name in wanted):
            return _make_exported("unchanged", index, wanted, shown, out)
        rows = _write(log, {name: paths[name] for name in wanted})
        if wanted and not any(count is not None for count in rows.values()):
            raise LogError(f"{shown}: nothing to export: no topic can be read", findings=log.findings)
        entries = {
            name: IndexEntry(
                file=None if count is None else paths[name].name,
                bytes=0 if count is None else paths[name].stat().st_size,
                type=log.topics[name].type_name,
                rows=count or 0,
            )
            for name, count in rows.items()
        }
        index = ExportIndex(made_from, {**exported, **entries}, *split_notes(log.findings))
    if wanted:
        write_json(out / INDEX, index)
    return _make_exported("done", index, wanted, shown, out)


def _select_topics(log: AnyLog, log_path: str, topics: Sequence[str]) -> list[str]:
    """Return the requested topics, each once, or all; a text that names no topic is split at its commas."""
    parts = (part.strip() for text in topics for part in ([text] if text in log.topics else text.split(",")))
    split = list(dict.fromkeys(part for part in parts if part))
    missing = [name for name in split if name not in log.topics]
    known_topics = ", ".join(sorted(log.topics)) or "none"
    if missing:
        raise LogError(*(f"{log_path}: topic {name} is not in this log; there are: {known_topics}" for name in missing))
    if topics and not split:
        raise LogError(f"{log_path}: no topic is named; there are: {known_topics}")
    return split or sorted(log.topics)


def _read_index(out: Path) -> ExportIndex | None:
    """Return the index of ``out``; an index of another version is ignored."""
    if (out / INDEX).is_file():
        with suppress(StoreError):
            return read_as(out / INDEX, ExportIndex)
    return None


def _refuse_own_output(out: Path) -> None:
    """Reject a directory of a store, dataset, map or model, whose files have checksums."""
    signs = {
        "dataset": "dataset.json", "map": "zarr.json", "model": "model.json", "cost map": "cost-map.json",
    }  # fmt: skip
    kind_of_output = "store" if is_store(out) else None
    kind = kind_of_output or next((kind for kind, sign in signs.items() if (out / sign).is_file()), None)
    if kind:
        raise UsageError(f"{out}: is a {kind}; give another directory for the topics")


def _refuse_others_files(index: ExportIndex | None, made_from: ExportOrigin, paths: Mapping[str, Path]) -> None:
    """Reject a directory with exported topics of another log, or with files that no export wrote."""
    own = set[str | None]()
    if index is not None:
        own = {entry.file for entry in index.topics.values()}
        if index.made_from.log != made_from.log:
            out = next(iter(paths.values())).parent
            raise UsageError(f"{out}: contains topics of {index.made_from.log}; give another directory")
    foreign = [path for path in paths.values() if path.exists() and path.name not in own and not _is_a_topics(path)]
    if foreign:
        raise UsageError(*(f"{path}: exists and is not an exported topic; give another directory" for path in foreign))


def _is_a_topics(path: Path) -> bool:
    """Return whether `export` wrote a file, perhaps in a call that was interrupted before it wrote its index."""
    with suppress(StoreError):
        return "topic" in read_metadata(read_schema(path).empty_table())
    return False


def _is_there(entry: IndexEntry | None, out: Path) -> bool:
    path = None if entry is None or entry.file is None else out / entry.file
    return entry is not None and (path is None or (path.is_file() and path.stat().st_size == entry.bytes))


def _make_exported(
    status: Literal["done", "unchanged"], index: ExportIndex, wanted: Sequence[str], log: str, out: Path
) -> Exported:
    entries = {name: index.topics[name] for name in wanted}
    files = tuple(
        ExportedTopic(name, topic.type, out / topic.file, topic.rows) for name, topic in entries.items() if topic.file
    )
    return Exported(log, out, status, files, index.damage, index.notes, 3 if index.damage else 0)


def _write(log: AnyLog, paths: Mapping[str, Path]) -> dict[str, int | None]:
    """Write the topics in one pass; return the rows of each, None of one that cannot be read."""
    rows = dict.fromkeys(paths, 0)
    writers: dict[str, Callable[[pa.Table], None]] = {}
    with ExitStack() as files:
        for tables in log.batches(list(paths)):
            for name, table in tables.items():
                if name not in writers:
                    writers[name] = files.enter_context(write_parquet_rows(paths[name], _make_schema(log, name, table)))
                writers[name](make_storable(table))
                rows[name] += table.num_rows
    return {name: count if name in writers else None for name, count in rows.items()}


def _make_schema(log: AnyLog, name: str, table: pa.Table) -> pa.Schema:
    """Return the schema of a topic's file: the table's, with the topic, its type and definition."""
    topic, (definition, source) = log.topics[name], log.definition(name) if isinstance(log, Log) else ("", "")
    schema = make_storable(table[:0]).schema
    described = {"topic": name, "type": topic.type_name, "definition": definition, "definition_from": source}
    return add_metadata(schema.empty_table(), described).schema


def _make_paths(out: Path, topics: Sequence[str]) -> dict[str, Path]:
    """Return a file for each topic, named after it; where two would share a name, the later ones get a number."""
    paths: dict[str, Path] = {}
    taken: set[str] = set()
    for topic in topics:
        stem = re.sub(r"[^A-Za-z0-9_.-]+|^\.", "_", topic.strip("/"))[:_LONGEST_STEM] or "topic"
        names = (stem if number == 1 else f"{stem}-{number}" for number in itertools.count(1))
        name = next(name for name in names if name.lower() not in taken)
        taken.add(name.lower())
        paths[topic] = out / f"{name}.parquet"
    return paths
