"""Any topics of a log as Parquet: useful to people who need nothing else of tcpipe."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa

from tcpipe import __version__
from tcpipe.errors import LogError, StoreError, UsageError
from tcpipe.formats.atomic import clear
from tcpipe.formats.json_files import read_json, write_json
from tcpipe.formats.logs.log_file import Log, open_log
from tcpipe.formats.parquet import parquet_rows, read_schema, storable
from tcpipe.pipeline.log_sources import definitions_key
from tcpipe.power.sources import bare_unit
from tcpipe.store import is_store
from tcpipe.tables.levels import metadata_of, with_metadata

INDEX = "export.json"
"""What a directory of exported topics holds, and of which log: a second call finds it done."""
_ENTRY = {"file", "bytes", "type", "rows", "made_from", "damage", "remarks"}
_LONGEST_STEM = 200


@dataclass(frozen=True, slots=True)
class ExportedTopic:
    """One topic's file."""

    topic: str
    type: str
    path: Path
    messages: int


@dataclass(frozen=True, slots=True)
class Exported:
    """The files, what the log had lost, and what else is worth saying of it; ``unchanged`` where all was there already."""

    log: str
    out: Path
    status: Literal["done", "unchanged"]
    topics: tuple[ExportedTopic, ...]
    damage: tuple[str, ...]
    remarks: tuple[str, ...]
    exit_code: int
    """3 where the log had lost something."""


def export(
    log_path: Path | str,
    out: Path,
    *,
    topics: Sequence[str] = (),
    message_definitions: Path | None = None,
    threads: int = 1,
) -> Exported:
    """Write each topic to ``out/<topic>.parquet``: one row a message, columns by dotted field name, units and definition in the metadata.

    The log is read once and written piece by piece: memory does not grow with it. What ``out`` holds already of the same log is left
    alone.

    Parameters
    ----------
    log_path
        A log of any container, or the URL of one.
    out
        A directory; it is made where it does not exist.
    topics
        Names of topics; none given means all. One text may name several, divided by commas.
    message_definitions
        A directory of .msg or .idl files for types that the log does not define.
    threads
        How many threads read and decompress.

    Raises
    ------
    LogError
        The log cannot be read, none of the topics can, one is not in it (all missing topics at once), a file belongs to another log
        or is none of an export, or ``out`` is a dataset, run, map, model, cost map or store.

    """
    _refuse_what_is_ours(out)
    clear(out)
    with open_log(log_path, message_definitions=message_definitions) as log:
        wanted = _wanted(log, log_path, topics)
        made_from = _identity(log, log_path, message_definitions)
        paths = _paths(out, sorted(log.topics))
        index = _index(out)
        _refuse_others_files(index, made_from, {name: paths[name] for name in wanted})
        known = {name for name in wanted if _is_there(index["topics"].get(name), made_from, out)}
        if wanted and known == set(wanted):
            return _exported("unchanged", index["topics"], wanted, str(log_path), out)
        written = _write(log, {name: paths[name] for name in wanted}, threads)
        if wanted and not any(entry["file"] for entry in written.values()):
            raise LogError(f"{log_path}: nothing to export: no topic can be read", *map(str, log.damage))
        damage = [str(damage) for damage in log.damage if damage.is_loss]
        if not wanted:
            return Exported(str(log_path), out, "done", (), tuple(damage), tuple(log.remarks), 3 if damage else 0)
        said = {"made_from": made_from, "damage": damage, "remarks": log.remarks}
        entries = {name: {**said, **entry} for name, entry in written.items()}
    write_json(out / INDEX, {**index, "topics": {**index["topics"], **entries}})
    return _exported("done", entries, wanted, str(log_path), out)


def _wanted(log: Log, log_path: Path | str, topics: Sequence[str]) -> list[str]:
    """Return the topics asked for, each once, or all; a text that is no topic's name is taken for several with commas between."""
    parts = (part.strip() for text in topics for part in ([text] if text in log.topics else text.split(",")))
    split = list(dict.fromkeys(part for part in parts if part))
    missing = [name for name in split if name not in log.topics]
    there = ", ".join(sorted(log.topics)) or "none"
    if missing:
        raise LogError(*(f"{log_path}: topic {name} is not in this log; there are: {there}" for name in missing))
    if topics and not split:
        raise LogError(f"{log_path}: no topic is named; there are: {there}")
    return split or sorted(log.topics)


def _identity(log: Log, log_path: Path | str, message_definitions: Path | None) -> dict[str, Any]:
    """Return what an export depends on, in JSON values."""
    return {
        "log": str(log_path) if "://" in str(log_path) else str(Path(log_path).resolve()),
        "size_and_time": log.size_and_time,
        "message_definitions": definitions_key(message_definitions),
        "tcpipe_version": __version__,
    }


def _index(out: Path) -> dict[str, Any]:
    """Return what ``out`` holds; an entry that is not as this version writes it counts for nothing."""
    found = read_json(out / INDEX) if (out / INDEX).is_file() else {}
    entries = found.get("topics")
    known = entries if isinstance(entries, dict) else {}
    return {"topics": {name: of for name, of in known.items() if isinstance(of, dict) and of.keys() == _ENTRY}}


def _refuse_what_is_ours(out: Path) -> None:
    """Refuse to write between the files of what is counted and sealed."""
    signs = {
        "dataset": "dataset.json", "run": "run.json", "run's recipe": "manifest.json", "map": "zarr.json",
        "model": "model.json", "cost map": "cost-map.json",
    }  # fmt: skip
    kind = "store" if is_store(out) else next((kind for kind, sign in signs.items() if (out / sign).is_file()), None)
    if kind:
        raise UsageError(f"{out}: is a {kind}; give another directory for the topics")


def _refuse_others_files(index: Mapping[str, Any], made_from: Mapping[str, Any], paths: Mapping[str, Path]) -> None:
    others = {
        entry["file"]: entry["made_from"]["log"]
        for entry in index["topics"].values()
        if entry["made_from"]["log"] != made_from["log"]
    }
    taken = sorted({others[path.name] for path in paths.values() if path.name in others})
    if taken:
        out = next(iter(paths.values())).parent
        raise UsageError(f"{out}: holds the same topics of {', '.join(taken)}; give another directory")
    known = {entry["file"] for entry in index["topics"].values()}
    strange = [path for path in paths.values() if path.exists() and path.name not in known and not _is_a_topics(path)]
    if strange:
        raise UsageError(
            *(f"{path}: is there, and no topic that was exported; give another directory" for path in strange)
        )


def _is_a_topics(path: Path) -> bool:
    """Return whether a file is one of `export`, which may have been interrupted before it wrote its index."""
    with suppress(StoreError):
        return "topic" in metadata_of(read_schema(path).empty_table())
    return False


def _is_there(entry: Mapping[str, Any] | None, made_from: Mapping[str, Any], out: Path) -> bool:
    if entry is None or entry["made_from"] != made_from:
        return False
    path = None if entry["file"] is None else out / entry["file"]
    return path is None or (path.is_file() and path.stat().st_size == entry["bytes"])


def _exported(
    status: Literal["done", "unchanged"], entries: Mapping[str, Any], wanted: Sequence[str], log: str, out: Path
) -> Exported:
    files = tuple(
        ExportedTopic(name, entries[name]["type"], out / entries[name]["file"], entries[name]["rows"])
        for name in wanted
        if entries[name]["file"] is not None
    )
    damage = dict.fromkeys(line for name in wanted for line in entries[name]["damage"])
    remarks = dict.fromkeys(line for name in wanted for line in entries[name]["remarks"])
    return Exported(log, out, status, files, tuple(damage), tuple(remarks), 3 if damage else 0)


def _write(log: Log, paths: Mapping[str, Path], threads: int) -> dict[str, dict[str, Any]]:
    """Write the topics in one pass; return what stands in the index of each."""
    rows = dict.fromkeys(paths, 0)
    writers: dict[str, Callable[[pa.Table], None]] = {}
    with ExitStack() as files:
        for tables in log.batches(list(paths), threads=threads):
            for name, table in tables.items():
                if name not in writers:
                    writers[name] = files.enter_context(parquet_rows(paths[name], _schema(log, name, table)))
                writers[name](storable(table))
                rows[name] += table.num_rows
    none: dict[str, Any] = {"file": None, "bytes": 0}
    return {
        name: {
            **({"file": path.name, "bytes": path.stat().st_size} if name in writers else none),
            "type": log.topics[name].type_name,
            "rows": rows[name],
        }
        for name, path in paths.items()
    }


def _schema(log: Log, name: str, table: pa.Table) -> pa.Schema:
    """Return the schema of a topic's file: the table's, with the topic, its type and definition."""
    topic, (definition, source) = log.topics[name], log.definition(name)
    schema = storable(table[:0]).schema
    unit = bare_unit(topic.type_name, name)
    if unit is not None:
        at = schema.get_field_index("data")
        schema = schema.set(at, schema.field(at).with_metadata({"unit": unit}))
    described = {"topic": name, "type": topic.type_name, "definition": definition, "definition_from": source}
    return with_metadata(schema.empty_table(), described).schema


def _paths(out: Path, topics: Sequence[str]) -> dict[str, Path]:
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
