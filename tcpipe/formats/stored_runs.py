"""Finished ingestions in a store: their documents and tables, each verified when it is read."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TypeAlias

import pyarrow as pa

from tcpipe.errors import StoreError
from tcpipe.formats.commits import State
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.integrity import Checksum, compute_checksums
from tcpipe.formats.parquet import read_range, read_table, write_table
from tcpipe.formats.place import Place
from tcpipe.formats.recipe_toml import read_key
from tcpipe.formats.run_documents import Manifest, name_folder, read_as_at
from tcpipe.tables.findings import judge_again
from tcpipe.tables.levels import MaskedTrack, Streams

FilesState: TypeAlias = tuple[tuple[int, int], ...]
"""Size [byte] and modification time [ns] of each file of an ingestion."""


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """One finished ingestion: a run under one recipe."""

    run_id: str
    recipe_id: str
    runs: Place
    """``runs/`` of the store."""
    facts: RunFacts
    """Facts in the log of commits, enough to select the run."""
    files_state: FilesState = ()
    """Distinguishes its files from what is written under their names later."""

    @property
    def place(self) -> Place:
        """``runs/<run_id>/<recipe_id>``."""
        return self.runs.below(f"{self.run_id}/{self.recipe_id}")

    @property
    def manifest(self) -> Manifest:
        """The whole manifest, with the run's tags as they are now; `StoreError` if it is not as it was written."""
        manifest = _read_manifest(self.place, self.facts.manifest, self.files_state)
        if (manifest.run_id, manifest.recipe_id) != (self.run_id, self.recipe_id):
            what = f"is of {manifest.run_id}/{manifest.recipe_id}, but is stored in {self.run_id}/{self.recipe_id}"
            raise StoreError(f"{self.place.where(self.facts.manifest)}: {what}")
        return replace(manifest, tags=self.facts.tags)

    @property
    def streams_key(self) -> str:
        """Names the read settings of the streams that it was made from, as ``run.json`` has it while these are there."""
        manifest = self.manifest
        key = read_key(manifest.recipe, manifest.robot_requested, definitions=manifest.message_definitions)
        return f"{key}-{manifest.tcpipe_version}"

    @property
    def where(self) -> str:
        """Path or URL of its place."""
        return self.place.where()

    def checksum(self, name: str) -> Checksum:
        """Return what the manifest has of ``track.parquet`` and such."""
        return self.manifest.checksums[self._name(name)]

    def file(self, name: str) -> Path:
        """Return ``track.parquet`` and such on this machine, proved; `StoreError` if it is not as it was written."""
        return self.place.proved(self._name(name), self.checksum(name))

    def table(self, name: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Read ``track``, ``segments`` or ``rejections``, or some of its columns; `StoreError` if it is not as it was written."""
        columns = None if columns is None else list(columns)
        return read_table(self.file(f"{name}.parquet"), columns).replace_schema_metadata(None)

    def segments(self) -> pa.Table:
        """Read the labelled segments (schema LABELLED_SEGMENTS)."""
        return self.table("segments")

    def track(self) -> MaskedTrack:
        """Read the masked track as a checked level."""
        return MaskedTrack(self.table("track"), self.manifest.info)

    def rejections(self) -> pa.Table:
        """Read the measurements that the filter refused (schema REJECTIONS)."""
        return self.table("rejections")

    def _name(self, name: str) -> str:
        found = next((file for file in self.manifest.checksums if PurePosixPath(file).name == name), None)
        if found is None:
            raise StoreError(f"{self.where}: its manifest lists no {name}; ingest the log again")
        return found


@dataclass(frozen=True, slots=True)
class Lost:
    """A file of an ingestion that is gone, or has another size."""

    where: str
    expected_bytes: int
    size_bytes: int | None = None

    def __str__(self) -> str:
        """Return it as one line."""
        how = (
            "is missing" if self.size_bytes is None else f"has {self.size_bytes} bytes, expected {self.expected_bytes}"
        )
        return f"{self.where}: {how}; ingest the log again"


@dataclass(frozen=True, slots=True)
class Ingestions:
    """Finished ingestions of a store, or of one of its runs, by run and recipe."""

    state: State
    finished: tuple[RunDirectory, ...]
    """Those whose files are there and that count."""
    lost: Mapping[tuple[str, str], Lost]
    """Those of which a file is gone or has another size."""
    outdated: Mapping[str, RunFacts]
    """By run, of those that are finished in other data-model versions only: the last."""
    rows: Mapping[tuple[str, str], RunFacts]
    """All that are there, those of superseded runs too."""

    @property
    def damaged(self) -> dict[tuple[str, str], str]:
        """Lost files, as lines."""
        return {key: str(lost) for key, lost in self.lost.items()}

    @property
    def superseded(self) -> dict[str, str]:
        """Runs whose log was completed or repaired, and the run that took their place."""
        return self.state.superseded


def look_at_files(place: Place, rows: Iterable[RunFacts]) -> Iterator[tuple[RunFacts, Lost | None, FilesState]]:
    """Yield each row with the first of its files that is gone or has another size, and with the state of its files.

    ``place`` is ``runs/``. On disk each file is looked at; in a bucket there is one request for every thousand objects below it.
    """
    rows = list(rows)
    find = make_file_finder(place, rows)
    for row in rows:
        states, lost = list[tuple[int, int]](), None
        for name, size_bytes in row.files.items():
            seen = find(f"{row.run_id}/{name}")
            if seen is None or seen[0] != size_bytes:
                lost = Lost(place.where(f"{row.run_id}/{name}"), size_bytes, seen and seen[0])
                break
            states.append(seen)
        yield row, lost, tuple(states)


def make_file_finder(place: Place, rows: Collection[RunFacts]) -> Callable[[str], tuple[int, int] | None]:
    """Return a function that finds the size [byte] and modification time [ns] of a file of the runs of rows; None without a file."""
    return _find_on_disk(place.path) if place.path else _find_listed(place, rows)


def _find_on_disk(root: Path) -> Callable[[str], tuple[int, int] | None]:
    def find(name: str) -> tuple[int, int] | None:
        try:
            seen = os.stat(f"{root}/{name}")  # noqa: PTH116  of ten thousands
        except OSError:
            return None
        return seen.st_size, seen.st_mtime_ns

    return find


def _find_listed(place: Place, rows: Collection[RunFacts]) -> Callable[[str], tuple[int, int] | None]:
    """Return it from a listing of the run, or of all."""
    run_ids = {row.run_id for row in rows}
    found = place.entries(run_ids.pop() if len(run_ids) == 1 else "") if rows else []
    return {entry.name: (entry.size_bytes, entry.modified_ns) for entry in found}.get


@lru_cache(maxsize=64)
def _read_manifest(place: Place, name: str, state: FilesState) -> Manifest:
    """Return a manifest while the files of its ingestion are in this state; judged by this version's catalogue."""
    del state
    manifest = read_as_at(place, name, Manifest)
    return replace(manifest, verdict=judge_again(manifest.verdict, manifest.info.report.findings))


def add_span(row: RunFacts, place: Place, manifest: Manifest) -> RunFacts:
    """Return a row with when its segments begin and end, from the statistics of their file; without where it has none."""
    name = row.segments_file.removeprefix(f"runs/{row.run_id}/{row.recipe_id}/")
    with suppress(StoreError):
        if row.segments:
            path = place.local(name, manifest.checksums[name])
            return replace(row, start_ns=read_range(path, "start_ns")[0], end_ns=read_range(path, "end_ns")[1])
    return row


@contextmanager
def convert_run_errors(where: str, directory: Path) -> Iterator[None]:
    """Tell what goes wrong in a working directory of the place for which it is."""
    try:
        yield
    except StoreError as error:
        raise StoreError(*(problem.replace(str(directory), where) for problem in error.problems)) from error.__cause__


def put_tables(place: Place, tables: Mapping[str, pa.Table], *, folder: str = "") -> dict[str, Checksum]:
    """Put tables as Parquet into a directory named after their content; return the files."""
    with place.workshop() as directory:
        with convert_run_errors(place.where(folder), directory):
            for name, table in tables.items():
                write_table(table, directory / f"{name}.parquet")
        checksums = compute_checksums(directory)
        prefix = f"{folder}{name_folder(checksums)}"
        place.put_files(prefix, directory)
    return subdirectory(prefix, checksums)


def subdirectory(prefix: str, checksums: Mapping[str, Checksum]) -> dict[str, Checksum]:
    """Return checksums by the names that their files have where ``prefix`` lies."""
    return {f"{prefix}/{name}": checksum for name, checksum in checksums.items()}


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
        """Tell whether there is such a role; nothing is read for that."""
        return role in self._held or role in self._files

    def __iter__(self) -> Iterator[str]:
        """Yield the roles."""
        return iter([*self._held, *self._files])

    def __len__(self) -> int:
        """Return how many roles there are."""
        return len(self._held) + len(self._files)


def lend_streams(place: Place, streams: Streams, stored: Mapping[str, Checksum]) -> Streams:
    """Return L1 with large tables that are read at each access, and not kept in memory between accesses.

    In a bucket they are held: each time they would be fetched.

    ``stored`` has the files of L1 in the ``place`` of the run.
    """
    if place.path is None:
        return streams
    files = {PurePosixPath(name).stem: place.local(name, checksum) for name, checksum in stored.items()}
    held = {role: table for role, table in streams.tables.items() if role not in _LENT}
    return replace(streams, tables=_LentTables(held, {role: path for role, path in files.items() if role in _LENT}))
