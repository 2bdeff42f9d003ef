"""The store: where runs and maps live, by content, each file whole or absent.

::

    <root>/
      records/logs/<path>/<fact>.json          logs seen: sizes, times, sha256
      records/<kind>/<fact>.json               what else is remembered: failed, damaged, accepted, superseded
      maps/<name>.zarr
      runs/<run_id>/run.json                   source, robot, tags, topics, damage
      runs/<run_id>/streams/<role>.parquet     L1, and checksums.json
      runs/<run_id>/<recipe_id>/               manifest.json, track.parquet, segments.parquet, rejections.parquet
      index/                                   runs.parquet, logs.parquet: what the documents say, made again at will

A recipe directory appears by one rename, manifest inside: if it is there, it is complete.
"""

from __future__ import annotations

import logging
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import pyarrow as pa

from tcpipe.errors import StoreError, TableError, UsageError
from tcpipe.formats.atomic import TEMPORARY_PREFIX, atomic_directory, clear, exclusive
from tcpipe.formats.index_files import (
    RunFacts,
    SeenLog,
    as_stored,
    facts_of,
    file_state,
    known_log,
    read_logs,
    read_runs,
    write_logs,
    write_runs,
)
from tcpipe.formats.json_files import digest, plain, typed
from tcpipe.formats.parquet import highest, lowest, read_table, write_table
from tcpipe.formats.places import local_output
from tcpipe.formats.record_files import Sighting, Superseded, put_record, read_record, read_records, record_name
from tcpipe.formats.run_documents import Manifest, ManifestHead, RunJson, StreamInfo
from tcpipe.formats.seals import (
    file_checksums,
    prove_files,
    read_checksums,
    read_sealed,
    read_sealed_as,
    write_checksums,
    write_sealed,
)
from tcpipe.tables.levels import (
    DATA_MODEL_VERSION,
    LABELLED_SEGMENTS,
    READ_VERSIONS,
    GatedTrack,
    LabelledSegments,
    Streams,
    Track,
    metadata_of,
    with_metadata,
)

T = TypeVar("T")

logger = logging.getLogger("tcpipe")

RUN_FILES = ("track.parquet", "segments.parquet", "rejections.parquet")
RUN, MANIFEST = "run.json", "manifest.json"

_HASH_IN_NAME = re.compile(r"-([0-9a-f]{8,64})$")
_SIGNS = ("runs/*/run.json", "maps/*.zarr", "records/logs/*/*.json", "records/failed/*.json")
"""Of these a store has at least one."""

_NAME_HEX = 8
"""So many digits of its log's sha256 stand in a run's name, more where two recordings of one name share them."""

_MAP_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """One finished ingestion: a run under one recipe."""

    run_id: str
    recipe_id: str
    path: Path
    facts: RunFacts
    """What the index has of it: enough to choose by."""

    @property
    def manifest(self) -> Manifest:
        """The whole manifest; `StoreError` if it is not as it was written."""
        return _manifest(self.path / MANIFEST, self.facts.state)

    def table(self, name: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Read ``track``, ``segments`` or ``rejections``, or some of its columns; `StoreError` if it is not as it was written."""
        self.prove(f"{name}.parquet")
        columns = None if columns is None else list(columns)
        return read_table(self.path / f"{name}.parquet", columns).replace_schema_metadata(None)

    def prove(self, *names: str) -> None:
        """Compare files with what the manifest has of them; `StoreError` names the first that is not as it was written."""
        prove_files(self.path, self.manifest.checksums, names)

    def segments(self) -> pa.Table:
        """Read the labelled segments (schema LABELLED_SEGMENTS; columns that an earlier data model lacks are null)."""
        return LABELLED_SEGMENTS.completed(self.table("segments"))

    def track(self) -> GatedTrack:
        """Read the gated track as a checked level."""
        return GatedTrack(self.table("track"), self.manifest.info)

    def rejections(self) -> pa.Table:
        """Read the measurements that the filter refused (schema REJECTIONS)."""
        return self.table("rejections")


@dataclass(frozen=True, slots=True)
class Ingestions:
    """What a store, or one of its runs, holds of finished ingestions."""

    finished: tuple[RunDirectory, ...]
    """Those of this data-model version, by run and recipe."""
    outdated: Mapping[str, ManifestHead]
    """By run, of those that are finished in other data-model versions only: the last."""
    damaged: Mapping[Path, str]
    """By directory of an ingestion: what is not as it was written."""
    superseded: Mapping[str, str] = field(default_factory=dict)
    """Runs whose log was completed or repaired, which are in none of the others, and the run that took their place."""
    rows: Mapping[tuple[str, str], RunFacts] = field(default_factory=dict)
    """Of the index, by run and recipe: of all that are finished, those of superseded runs too."""
    stale: bool = False
    """Whether the index has to be written again."""


@dataclass(frozen=True, slots=True)
class Store:
    """A store on the local file system."""

    root: Path

    def clear(self) -> None:
        """Put in order what killed commands left anywhere in the store."""
        for directory in (self.root, self.root / "maps", self.runs_path, self.records_path):
            clear(directory)
        for run_id in self.run_ids():
            clear(self.runs_path / run_id)

    @property
    def runs_path(self) -> Path:
        """Directory of the runs."""
        return self.root / "runs"

    def map_path(self, name: str) -> Path:
        """Return where a map lives; `StoreError` if the name cannot be one."""
        if not _MAP_NAME.fullmatch(name):
            raise StoreError(
                f"map name {name!r}: wanted letters, digits, '_', '-', '.', beginning with a letter or digit"
            )
        return self.root / "maps" / f"{name}.zarr"

    def maps(self) -> list[str]:
        """Return the names of the maps, sorted."""
        return sorted(path.stem for path in self.root.glob("maps/*.zarr") if not path.name.startswith(TEMPORARY_PREFIX))

    def runs(self) -> list[RunDirectory]:
        """Return every finished ingestion of this data-model version, by run and recipe, that is not superseded."""
        return list(self.ingestions().finished)

    def recipes_of(self, run_id: str) -> list[RunDirectory]:
        """Return the finished ingestions of one run."""
        return list(self.ingestions(run_id).finished)

    def ingestions(self, run_id: str | None = None) -> Ingestions:
        """Return what there is of all runs, or of one.

        A manifest is read and proved, unless the index has what it says and its file is as it was then.
        """
        superseded = self.superseded() if run_id is None else {}
        known = read_runs(self.index_path) if run_id is None else {}
        finished, others, damaged = list[RunDirectory](), dict[str, ManifestHead](), dict[Path, str]()
        rows = dict[tuple[str, str], RunFacts]()
        for name in [run_id] if run_id is not None else self.run_ids():
            for path in self._recipes(name):
                try:
                    found = _ingestion(path, known.get((name, path.name)))
                except StoreError as error:
                    damaged.update({} if name in superseded else {path: error.problems[0]})
                    continue
                if isinstance(found, ManifestHead):
                    others.update({} if name in superseded else {name: found})
                    continue
                rows[name, path.name] = replace(found.facts, superseded_by=superseded.get(name))
                if name not in superseded:
                    finished.append(found)
        current = {run.run_id for run in finished}
        outdated = {name: head for name, head in others.items() if name not in current}
        return Ingestions(tuple(finished), outdated, damaged, superseded, rows, stale=_differ(rows, known))

    def _recipes(self, run_id: str) -> list[Path]:
        """Return the directories of a run's ingestions, by recipe."""
        directory = self.runs_path / run_id
        with suppress(OSError), os.scandir(directory) as entries:
            here = [entry.name for entry in entries if entry.is_dir()]
            names = (name for name in here if name != "streams" and not name.startswith(TEMPORARY_PREFIX))
            return [directory / name for name in sorted(names)]
        return []

    @property
    def index_path(self) -> Path:
        """Directory of the index."""
        return self.root / "index"

    def keep_index(self, found: Ingestions) -> None:
        """Write down what was found of all runs, where that is not what the index had."""
        if found.stale:
            write_runs(self.index_path, found.rows.values())

    def prove(self, runs: Sequence[RunDirectory]) -> dict[str, str]:
        """Compare segments and tracks with what the manifests have of them; return by run what is wrong.

        Files that are as they were when they were compared before are not read again.
        """
        damaged, proved = dict[str, str](), dict[tuple[str, str], RunFacts]()
        for run in runs:
            names = ("segments.parquet", "track.parquet")
            try:
                now = " ".join(file_state((run.path / name).stat()) for name in names)
                if now != run.facts.proved:
                    run.prove(*names)
                    proved[run.run_id, run.recipe_id] = replace(run.facts, proved=now)
            except (OSError, StoreError) as error:
                damaged[run.run_id] = error.problems[0] if isinstance(error, StoreError) else f"{run.path}: {error}"
        if proved:
            write_runs(self.index_path, {**read_runs(self.index_path), **proved}.values())
        return damaged

    def seen_logs(self) -> dict[str, list[Sighting]]:
        """Return what is remembered of all logs, by lineage; a record that the index has is not read, while its file is as it was."""
        known, rows = read_logs(self.index_path), dict[tuple[str, str], SeenLog]()
        for lineage, name, state in _record_files(self.records_path, "logs"):
            row = known.get((lineage, name))
            if row is None or row.state != state:
                sighting = self.recall(f"{lineage}/{name}", Sighting)
                if sighting is None:
                    continue
                row = SeenLog(lineage, name, state, sighting)
            rows[lineage, name] = row
        if _differ(rows, known):
            write_logs(self.index_path, rows.values())
        seen: dict[str, list[Sighting]] = {}
        for row in rows.values():
            seen.setdefault(row.lineage, []).append(row.sighting)
        return seen

    def superseded(self) -> dict[str, str]:
        """Return the runs whose log was completed or repaired, and by which run."""
        records = sorted(self.records("superseded", Superseded), key=lambda record: (record.number, record.by is None))
        latest = {record.run_id: record.by for record in records}
        return {run_id: by for run_id, by in latest.items() if by is not None}

    def supersede(self, run_id: str, by: str | None) -> None:
        """Remember that another run takes this one's place, or, without ``by``, that it counts again."""
        number = sum(record.run_id == run_id for record in self.records("superseded", Superseded))
        fact = Superseded(run_id, by, number)
        self.remember(f"superseded/{record_name(digest(fact))}", fact)

    def run_ids(self) -> list[str]:
        """Return the names of all runs, finished or not."""
        with suppress(OSError), os.scandir(self.runs_path) as entries:
            return sorted(
                entry.name for entry in entries if entry.is_dir() and not entry.name.startswith(TEMPORARY_PREFIX)
            )
        return []

    @contextmanager
    def claimed_run(self, stem: str, sha256: str) -> Iterator[str]:
        """Yield the run that a recording is, by its content: the one that is here, whatever it was called, or a new one.

        A new one of which nothing is written is forgotten on failure.
        """
        self.runs_path.mkdir(parents=True, exist_ok=True)
        with exclusive(self.runs_path):
            run_id = next(self._runs_of(sha256), None) or self._free_name(stem, sha256)
            (self.runs_path / run_id).mkdir(exist_ok=True)
        try:
            yield run_id
        except BaseException:
            with suppress(OSError):
                (self.runs_path / run_id).rmdir()
            raise

    def _runs_of(self, sha256: str) -> Iterator[str]:
        for path in sorted(self.runs_path.glob(f"*-{sha256[:_NAME_HEX]}*")):
            known, end = self.known_run(path.name), f"-{sha256[:_NAME_HEX]}"
            if path.name.endswith(end) if known is None else known.source.sha256 == sha256:
                yield path.name

    def _free_name(self, stem: str, sha256: str) -> str:
        """Return a new run's name: as much of its hash as tells it from another recording of the same name."""
        names = [f"{stem}-{sha256[:length]}" for length in range(_NAME_HEX, len(sha256), 4)]
        return next((name for name in names if not (self.runs_path / name).exists()), f"{stem}-{sha256}")

    def run_ids_by_hash(self) -> dict[str, list[str]]:
        """Return the names of all runs by what of their log's sha256 stands in them."""
        found: dict[str, list[str]] = {}
        for run_id in self.run_ids():
            add_by_hash(found, run_id)
        return found

    def run_of(self, sha256: str, among: Mapping[str, Sequence[str]]) -> str | None:
        """Return the run of a recording, among `run_ids_by_hash`; None where there is none."""
        for run_id in among.get(sha256[:_NAME_HEX], ()):
            known = self.known_run(run_id)
            if known is not None and known.source.sha256 == sha256:
                return run_id
        return None

    def tag_run(self, run_id: str, tags: Mapping[str, str]) -> None:
        """Set the tags of a run, under every recipe."""
        for path in (
            *(run.path / "manifest.json" for run in self.recipes_of(run_id)),
            self.runs_path / run_id / "run.json",  # the last: who finds the tags here finds them everywhere
        ):
            if path.exists():
                write_sealed(path, {**read_sealed(path), "tags": dict(tags)})

    def run_json(self, run_id: str) -> RunJson | None:
        """Return what is known of a run's log, or None; `StoreError` if it is not as it was written, or another run's."""
        path = self.runs_path / run_id / "run.json"
        if not path.exists():
            return None
        found = read_sealed_as(path, RunJson)
        if not is_named_after(run_id, found.source.sha256):
            raise StoreError(f"{path}: is of another run: its log's sha256 begins with {found.source.sha256[:8]}")
        return found

    def known_run(self, run_id: str) -> RunJson | None:
        """Return `run_json`; None also where it is not as it was written, which is said: the run is to be made again."""
        try:
            return self.run_json(run_id)
        except StoreError as error:
            logger.warning("%s; the run is made again when its log is ingested", error.problems[0])
            return None

    def write_run_json(self, run_id: str, values: RunJson) -> None:
        """Write what is known of a run's log."""
        write_sealed(self.runs_path / run_id / "run.json", values)

    @property
    def records_path(self) -> Path:
        """Directory of what is remembered."""
        return self.root / "records"

    def remember(self, name: str, fact: object) -> bool:
        """Remember a fact under ``<kind>/<name>`` for good; return whether it was new."""
        return put_record(self.records_path, name, fact)

    def recall(self, name: str, cls: type[T]) -> T | None:
        """Return what is remembered under ``<kind>/<name>``, None where nothing is."""
        return read_record(self.records_path, name, cls)

    def records(self, kind: str, cls: type[T]) -> list[T]:
        """Return everything of a kind that is remembered, by name."""
        return list(read_records(self.records_path, kind, cls))

    def sightings(self, lineage: str) -> list[Sighting]:
        """Return what is remembered of a log."""
        return self.records(lineage, Sighting)

    def write_streams(self, run_id: str, streams: Streams, *, key: str) -> None:
        """Write L1 whole or not at all; ``key`` names the read settings they were made with."""
        with atomic_directory(self.runs_path / run_id / "streams") as directory:
            for role, table in streams.tables.items():
                read_with = key, streams.robot, streams.gnss_crs, streams.power_averaged
                told = StreamInfo(*read_with, findings=streams.findings, sensor=streams.sensors[role])
                write_table(with_metadata(table, plain(told)), directory / f"{role}.parquet")
            write_checksums(directory)

    def read_streams(self, run_id: str, *, key: str) -> Streams | None:
        """Return L1 if it is there, whole, of this data model and made with these read settings; else None."""
        directory = self.runs_path / run_id / "streams"
        try:
            listed = read_checksums(directory)
            prove_files(directory, listed, {*listed, *(path.name for path in directory.glob("*.parquet"))})
        except StoreError:
            return None
        tables, of = dict[str, pa.Table](), dict[str, StreamInfo]()
        try:
            for path in sorted(directory.glob("*.parquet")):
                table = read_table(path)
                of[path.stem] = told = typed(metadata_of(table), StreamInfo, path)
                if told.key != key or told.data_model_version not in READ_VERSIONS:
                    return None
                tables[path.stem] = table.replace_schema_metadata(None)
            if not tables:
                return None
            sensors = {role: each.sensor for role, each in of.items()}
            return Streams(tables, sensors, told.robot, told.gnss_crs, told.power_averaged, told.findings)
        except (TableError, StoreError):
            return None

    def write_run(self, manifest: Manifest, *, track: Track, gated: GatedTrack, labelled: LabelledSegments) -> Path:
        """Write one ingestion, its checksums added to the manifest; the directory appears by one rename."""
        path = self.runs_path / manifest.run_id / manifest.recipe_id
        told = {
            "run_id": manifest.run_id, "recipe_id": manifest.recipe_id, "datum": plain(manifest.info.datum), "robot": manifest.robot,
        }  # fmt: skip
        tables = {"track": gated.table, "segments": labelled.table, "rejections": track.rejections}
        with atomic_directory(path) as directory:
            for name, table in tables.items():
                write_table(with_metadata(table, told), directory / f"{name}.parquet")
            write_sealed(directory / "manifest.json", replace(manifest, checksums=file_checksums(directory)))
        return path


def _ingestion(path: Path, row: RunFacts | None = None) -> RunDirectory | ManifestHead:
    """Return an ingestion, or the head of one of another data model; `StoreError` if it is not as it was written, or a file is gone.

    ``row`` is what the index has of it.
    """
    name = path / MANIFEST
    with os.scandir(path) as entries:
        here = {entry.name: entry.stat() for entry in entries if entry.name in (MANIFEST, *RUN_FILES)}
    state = file_state(here[MANIFEST]) if MANIFEST in here else ""
    if row is None or row.state != state:
        document = read_sealed(name, ours=lambda found: found.get("data_model_version") in READ_VERSIONS)
        if document.get("data_model_version") not in READ_VERSIONS:
            return typed(document, ManifestHead, name)
        manifest = typed(document, Manifest, name)
        if (manifest.run_id, manifest.recipe_id) != (path.parent.name, path.name):
            raise StoreError(
                f"{name}: is of {manifest.run_id}/{manifest.recipe_id}, but lies in {path.parent.name}/{path.name}"
            )
        row = _with_span(facts_of(manifest, state), path / "segments.parquet")
    gone = [file for file in RUN_FILES if file not in here]
    if gone:
        raise StoreError(f"{path / gone[0]}: is gone; ingest the log again")
    return RunDirectory(path.parent.name, path.name, path, _with_log(row, path.parent / RUN))


@lru_cache(maxsize=64)
def _manifest(path: Path, state: str) -> Manifest:  # noqa: ARG001  a file of another state is read again
    return read_sealed_as(path, Manifest)


def _with_span(row: RunFacts, segments: Path) -> RunFacts:
    """Return a row with when its segments begin and end, from the statistics of their file; without where it has none."""
    with suppress(StoreError):
        if row.segments:
            return replace(row, start_ns=lowest(segments, "start_ns"), end_ns=highest(segments, "end_ns"))
    return row


def _with_log(row: RunFacts, path: Path) -> RunFacts:
    """Return what the index has of an ingestion with what its run.json says now; None of one that cannot be believed."""
    try:
        state = file_state(path.stat())
        if row.log is not None and row.log.state == state:
            return row
        known = known_log(read_sealed_as(path, RunJson), state)
    except (OSError, StoreError):
        known = None
    return replace(row, log=known if known and is_named_after(row.run_id, known.source.sha256) else None)


def _differ(rows: Mapping[tuple[str, str], object], known: Mapping[tuple[str, str], object]) -> bool:
    """Tell whether the index has something else."""
    return rows != known and {key: as_stored(row) for key, row in rows.items()} != known


def _record_files(root: Path, kind: str) -> Iterator[tuple[str, str, str]]:
    """Yield the directory, name and state of every record that lies in a directory of a kind."""
    with suppress(OSError), os.scandir(root / kind) as directories:
        for directory in sorted((entry for entry in directories if entry.is_dir()), key=lambda entry: entry.name):
            with os.scandir(directory.path) as entries:
                for entry in sorted(entries, key=lambda entry: entry.name):
                    if entry.name.endswith(".json") and not entry.name.startswith(TEMPORARY_PREFIX):
                        yield f"{kind}/{directory.name}", entry.name.removesuffix(".json"), file_state(entry.stat())


def add_by_hash(runs: dict[str, list[str]], run_id: str) -> None:
    """Add a new run to `Store.run_ids_by_hash`."""
    runs.setdefault(run_id.rpartition("-")[2][:_NAME_HEX], []).append(run_id)


def is_named_after(run_id: str, sha256: str) -> bool:
    """Return whether a run can be that of a log: the digits at the end of its name, if any, are the first of the log's sha256."""
    name = _HASH_IN_NAME.search(run_id)
    return name is None or sha256.startswith(name[1])


def is_store(path: Path) -> bool:
    """Tell whether a directory is a store: it holds runs, maps or records."""
    return any(next(path.glob(pattern), None) for pattern in _SIGNS)


def run_at(path: Path) -> tuple[Store, list[RunDirectory]] | None:
    """Return the store and the finished ingestions of a run's directory, or the one of a recipe's; None for any other path.

    Raises
    ------
    StoreError
        It is a run's, but holds no finished ingestion of this data-model version.
    """
    real = path.resolve()
    for run_path in (real, real.parent):
        if run_path.parent.name == "runs" and (run_path / "run.json").is_file():
            store = Store(run_path.parent.parent)
            found = store.ingestions(run_path.name)
            runs = [run for run in found.finished if real in (run_path, run.path)]
            if damaged := [line for path, line in found.damaged.items() if real in (run_path, path)]:
                raise StoreError(*damaged)
            if not runs:
                raise StoreError(
                    f"{path}: holds no finished ingestion of data model {DATA_MODEL_VERSION}; ingest its log again"
                )
            return store, runs
    return None


def open_store(root: str | Path, *, create: bool = False) -> Store:
    """Return the store at ``root``; `StoreError` if it is no directory, is missing (unless ``create``) or cannot be written."""
    path = local_output(root)
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: is a file, wanted a directory for the store")
    if not path.exists() and not create:
        raise UsageError(f"{path}: there is no store here; run 'tcpipe ingest' first, or name another with --store")
    if create:
        try:
            path.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path, prefix=TEMPORARY_PREFIX):
                pass
        except OSError as error:
            raise StoreError(
                f"{path}: the store cannot be written ({error.strerror}); name another with --store"
            ) from None
    store = Store(path)
    if create:
        store.clear()
    return store
