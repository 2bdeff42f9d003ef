"""Runs in a store: their manifests and tables, each verified when it is read."""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import pyarrow as pa

from tcpipe.errors import StoreError, TableError
from tcpipe.formats.documents import BLOBS, State, read_record
from tcpipe.formats.json_files import parse_typed, to_plain
from tcpipe.formats.parquet import read_table, write_table
from tcpipe.formats.place import REPORT, FileEntry, Place, is_desktop_file
from tcpipe.formats.runs import Run, RunFacts, StoredMap, StreamInfo, restore_repeated
from tcpipe.tables.levels import TABLES_VERSION, MaskedTrack, Streams, add_metadata, read_metadata

STREAMS = "streams"
"""Folder of the streams in a folder of payload."""


@dataclass(frozen=True, slots=True)
class StoredRun:
    """A run under one recipe whose tables are in a store."""

    place: Place
    """The store."""
    facts: RunFacts
    document: str
    """Name of its manifest in the store."""

    @property
    def run_id(self) -> str:
        """Name of the run."""
        return self.facts.run_id

    @property
    def recipe_id(self) -> str:
        """Name of the recipe."""
        return self.facts.recipe_id

    @property
    def name(self) -> str:
        """Name of the run under this recipe, as messages and commands have it."""
        return f"{self.run_id}/{self.recipe_id}"

    @property
    def manifest(self) -> Run:
        """The whole record; `StoreError` if it is not as it was written."""
        return restore_repeated(_read_manifest(self.place, self.document), self.facts)

    @property
    def folder(self) -> Place:
        """The place of its tables."""
        return self.place.below(f"{BLOBS}/{self.facts.blob}")

    def file(self, name: str) -> Path:
        """Return a local path of a table, as ``track.parquet``, after a check of its checksum; `StoreError` if it differs."""
        checksum = self.facts.tables.get(name)
        if checksum is None:
            raise StoreError(f"run {self.name}: its manifest lists no {name}; ingest the log again with --force")
        return self.folder.fetch(name, checksum)

    def table(self, name: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Read ``track``, ``segments`` or ``rejections``, or columns of it; `StoreError` if it was changed."""
        columns = None if columns is None else list(columns)
        return read_table(self.file(f"{name}.parquet"), columns).replace_schema_metadata(None)

    def segments(self) -> pa.Table:
        """Read the labelled segments (schema LABELLED_SEGMENTS)."""
        return self.table("segments")

    def track(self) -> MaskedTrack:
        """Read the masked track as a checked level."""
        return MaskedTrack(self.table("track"), self.manifest.info)

    def rejections(self) -> pa.Table:
        """Read the measurements that the filter rejected (schema REJECTIONS)."""
        return self.table("rejections")

    def stream_files(self) -> dict[str, Path]:
        """Return the files of L1 on this machine by role, verified; `StoreError` if one is not as it was written."""
        return find_stream_files(self.place, self.facts)

    def streams(self) -> Streams:
        """Read L1; `StoreError` if it is missing or has changed."""
        found = read_streams(self.place, self.facts)
        if found is None:
            raise StoreError(f"run {self.name}: its streams cannot be read; ingest the log again with --force")
        return found


@lru_cache(maxsize=64)
def _read_manifest(place: Place, document: str) -> Run:
    return read_record(place, document, Run)


def find_stream_files(place: Place, row: RunFacts) -> dict[str, Path]:
    """Return the files of L1 of a run on this machine by role, verified."""
    folder = place.below(f"{BLOBS}/{row.streams_blob}")
    return {PurePosixPath(name).stem: folder.fetch(name, checksum) for name, checksum in sorted(row.streams.items())}


def write_streams(directory: Path, streams: Streams, *, key: str) -> None:
    """Write L1 into a directory; ``key`` identifies the settings of reading."""
    (directory / STREAMS).mkdir()
    for role, table in streams.tables.items():
        read_with = key, streams.robot, streams.gnss_crs, streams.power_averaged
        info = StreamInfo(*read_with, report=streams.report, sensor=streams.sensors[role])
        write_table(add_metadata(table, to_plain(info)), directory / STREAMS / f"{role}.parquet")


def read_streams(place: Place, row: RunFacts) -> Streams | None:
    """Return the streams of a run; None if they are missing, changed, or of another version."""
    tables, infos = dict[str, pa.Table](), dict[str, StreamInfo]()
    try:
        for role, path in find_stream_files(place, row).items():
            table = read_table(path)
            infos[role] = info = parse_typed(read_metadata(table), StreamInfo, path)
            if info.key != row.read_key or info.data_model_version != TABLES_VERSION:
                return None
            tables[role] = table.replace_schema_metadata(None)
        if not tables:
            return None
        sensors = {role: each.sensor for role, each in infos.items()}
        return Streams(tables, sensors, info.robot, info.gnss_crs, info.power_averaged, info.report)
    except (TableError, StoreError):
        return None


@contextmanager
def convert_run_errors(where: str, directory: Path) -> Iterator[None]:
    """Give errors in a working directory the path of the final place."""
    try:
        yield
    except StoreError as error:
        raise StoreError(*(problem.replace(str(directory), where) for problem in error.problems)) from error.__cause__


_LENT = ("imu", "wheel_odometry", "visual_odometry")


class _LentTables(Mapping[str, pa.Table]):
    """Tables by role: some held, the others read from their files each time they are asked for."""

    def __init__(self, held: Mapping[str, pa.Table], files: Mapping[str, Path]) -> None:
        self._held, self._files = held, files

    def __getitem__(self, role: str) -> pa.Table:
        """Return a role's table."""
        if role in self._held:
            return self._held[role]
        return read_table(self._files[role]).replace_schema_metadata(None)

    def __contains__(self, role: object) -> bool:
        """Return whether there is such a role, without reading a table."""
        return role in self._held or role in self._files

    def __iter__(self) -> Iterator[str]:
        """Yield the roles."""
        return iter([*self._held, *self._files])

    def __len__(self) -> int:
        """Return the number of roles."""
        return len(self._held) + len(self._files)


def lend_streams(streams: Streams, files: Mapping[str, Path]) -> Streams:
    """Return L1; large tables are read from ``files`` at each access and are not kept in memory in between."""
    held = {role: table for role, table in streams.tables.items() if role not in _LENT}
    return replace(streams, tables=_LentTables(held, {role: path for role, path in files.items() if role in _LENT}))


BLOB = re.compile(r"[0-9a-f]{16}")
"""Name of a folder of payload."""
_TABLES = ("track.parquet", "segments.parquet", "rejections.parquet", REPORT)


class Unnamed(NamedTuple):
    """A folder of payload that no document names, or a file that none names in a folder with named files."""

    name: str
    size_bytes: int
    foreign: str | None
    """The first file that tcpipe did not write."""


def list_payload(place: Place) -> dict[str, list[FileEntry]]:
    """Return the files of each folder of payload, by their names in it."""
    found: dict[str, list[FileEntry]] = {name: [] for name in place.list(BLOBS) if BLOB.fullmatch(name)}
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


def find_unnamed(payload: Mapping[str, Sequence[FileEntry]], named: Collection[str]) -> Iterator[Unnamed]:
    """Yield unreferenced payload: whole folders, and single files of used folders."""
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
    """Return runs and maps in all documents (superseded ones too) without some, and the names of damaged documents."""
    counting = [(name, state.facts[kind][key]) for (kind, key), name in state.names.items() if kind in ("runs", "maps")]
    records: list[RunFacts | StoredMap] = [record for name, record in counting if name not in but]
    damaged = [name for name in state.damaged if name.startswith(("runs/", "maps/"))]
    for name in state.replaced:
        if name not in but and name.startswith(("runs/", "maps/")):
            cls: type[RunFacts | StoredMap] = RunFacts if name.startswith("runs/") else StoredMap
            try:
                records.append(read_record(place, name, cls))
            except StoreError:
                damaged.append(name)
    return records, damaged
