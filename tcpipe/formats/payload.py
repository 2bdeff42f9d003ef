"""Payload of a store: which files the documents on runs and maps name, and which files no document names."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from tcpipe.errors import StoreError
from tcpipe.formats.dataset_files import REPORT, is_desktop_file
from tcpipe.formats.documents import BLOBS, State, read_record
from tcpipe.formats.place import Entry, Place
from tcpipe.formats.runs import RunFacts, StoredMap
from tcpipe.formats.stored_runs import STREAMS

BLOB = re.compile(r"[0-9a-f]{16}")
"""Name of a folder of payload."""
_TABLES = ("track.parquet", "segments.parquet", "rejections.parquet", REPORT)


class Unnamed(NamedTuple):
    """A folder of payload that no document names, or such a file in a folder of which other files are named."""

    name: str
    size_bytes: int
    foreign: str | None
    """The first file that tcpipe did not write."""


def list_payload(place: Place) -> dict[str, list[Entry]]:
    """Return the files of each folder of payload, by their names in it."""
    found: dict[str, list[Entry]] = {name: [] for name in place.list(BLOBS) if BLOB.fullmatch(name)}
    for entry in place.entries(BLOBS):
        blob, _, name = entry.name.removeprefix(f"{BLOBS}/").partition("/")
        if BLOB.fullmatch(blob) and name:
            found.setdefault(blob, []).append(entry._replace(name=name))
    return found


def list_named_files(records: Iterable[RunFacts | StoredMap]) -> set[str]:
    """Return the files of payload that belong to runs and maps, and the page of each run."""
    named = set[str]()
    for record in records:
        if isinstance(record, RunFacts):
            named |= {f"{record.streams_blob}/{name}" for name in record.streams}
            named |= {f"{record.blob}/{name}" for name in (*record.tables, REPORT)}
        else:
            named |= {f"{record.blob}/{name}" for name in record.files}
    return named


def find_unnamed(payload: Mapping[str, Sequence[Entry]], named: Collection[str]) -> Iterator[Unnamed]:
    """Yield what is not named: whole folders, and single files of folders in use."""
    used = {name.partition("/")[0] for name in named}
    for blob, entries in payload.items():
        if blob not in used:
            foreign = (entry.name for entry in entries if not (_is_payload(entry.name) or is_desktop_file(entry.name)))
            yield Unnamed(f"{BLOBS}/{blob}", sum(entry.size_bytes for entry in entries), next(foreign, None))
            continue
        for entry in entries:
            if f"{blob}/{entry.name}" not in named:
                foreign_name = None if entry.name in _TABLES else entry.name
                yield Unnamed(f"{BLOBS}/{blob}/{entry.name}", entry.size_bytes, foreign_name)


def _is_payload(name: str) -> bool:
    folder, _, file = name.partition("/")
    return name in _TABLES or folder.endswith((".zarr", ".png")) or (folder == STREAMS and file.endswith(".parquet"))


def read_records(place: Place, state: State, but: Collection[str] = ()) -> tuple[list[RunFacts | StoredMap], list[str]]:
    """Return the runs and maps in all documents, also those that do not count, without some, and the names of damaged documents."""
    counting = [(name, state.facts[kind][key]) for (kind, key), name in state.names.items() if kind in ("runs", "maps")]
    records: list[RunFacts | StoredMap] = [record for name, record in counting if name not in but]
    damaged = [name for name in state.damaged if name.startswith(("runs/", "maps/"))]
    for name in state.beaten:
        if name not in but and name.startswith(("runs/", "maps/")):
            cls: type[RunFacts | StoredMap] = RunFacts if name.startswith("runs/") else StoredMap
            try:
                records.append(read_record(place, name, cls))
            except StoreError:
                damaged.append(name)
    return records, damaged
