"""The store: where runs and maps live, by content, each file whole or absent.

::

    <root>/
      sources.json                             sha256 of every log seen, by path, size and modification time
      maps/<name>.zarr
      runs/<run_id>/run.json                   source, robot, tags, topics, damage
      runs/<run_id>/streams/<role>.parquet     L1, and checksums.json
      runs/<run_id>/<recipe_id>/               manifest.json, track.parquet, segments.parquet, rejections.parquet

A recipe directory appears by one rename, manifest inside: if it is there, it is complete.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from tcpipe.errors import StoreError, TableError
from tcpipe.formats.atomic import TEMPORARY_PREFIX, atomic_directory, exclusive
from tcpipe.formats.json_files import read_json
from tcpipe.formats.parquet import read_table, write_table
from tcpipe.formats.seals import checksums_to_json, write_checksums, write_sealed
from tcpipe.tables.levels import (
    DATA_MODEL_VERSION,
    Findings,
    GatedTrack,
    LabelledSegments,
    Sensor,
    Streams,
    Track,
    info_from_json,
    info_to_json,
    metadata_of,
    with_metadata,
)

_RUN_FILES = ("track.parquet", "segments.parquet", "rejections.parquet")
_MAP_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """One finished ingestion: a run under one recipe."""

    run_id: str
    recipe_id: str
    path: Path
    manifest: Mapping[str, Any]

    @property
    def robot(self) -> str:
        """The robot profile the run was ingested as."""
        return str(self.manifest["robot"])

    def segments(self) -> pa.Table:
        """Read the labelled segments (schema LABELLED_SEGMENTS)."""
        return read_table(self.path / "segments.parquet").replace_schema_metadata(None)

    def labelled_segments(self) -> LabelledSegments:
        """Read the labelled segments as a checked level, with the run's info and ledger."""
        return LabelledSegments(self.segments(), info_from_json(self.manifest["info"]), self.manifest["ledger_m"])

    def track(self) -> GatedTrack:
        """Read the gated track as a checked level."""
        table = read_table(self.path / "track.parquet").replace_schema_metadata(None)
        return GatedTrack(table, info_from_json(self.manifest["info"]))

    def rejections(self) -> pa.Table:
        """Read the measurements that the filter refused (schema REJECTIONS)."""
        return read_table(self.path / "rejections.parquet").replace_schema_metadata(None)


@dataclass(frozen=True, slots=True)
class Store:
    """A store on the local file system."""

    root: Path

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

    def runs(self, *, robot: str | None = None) -> list[RunDirectory]:
        """Return every finished ingestion of this data-model version, by run and recipe."""
        found = list(self._finished(self.runs_path.glob("*/*/manifest.json")))
        return [run for run in found if robot is None or run.robot == robot]

    def outdated(self) -> dict[str, str]:
        """Return the runs that are finished in other data-model versions only, and in which."""
        versions: dict[str, set[str]] = {}
        for run in self._whole(self.runs_path.glob("*/*/manifest.json")):
            versions.setdefault(run.run_id, set()).add(str(run.manifest.get("data_model_version")))
        return {
            run_id: ", ".join(sorted(found)) for run_id, found in versions.items() if DATA_MODEL_VERSION not in found
        }

    def recipes_of(self, run_id: str) -> list[RunDirectory]:
        """Return the finished ingestions of one run."""
        return list(self._finished((self.runs_path / run_id).glob("*/manifest.json")))

    def run_ids(self) -> list[str]:
        """Return the names of all runs, finished or not."""
        return sorted(path.name for path in self.runs_path.glob("*") if path.is_dir())

    def _finished(self, manifests: Iterator[Path]) -> Iterator[RunDirectory]:
        return (run for run in self._whole(manifests) if run.manifest.get("data_model_version") == DATA_MODEL_VERSION)

    def _whole(self, manifests: Iterator[Path]) -> Iterator[RunDirectory]:
        for path in sorted(manifests):
            whole = all((path.parent / name).is_file() for name in _RUN_FILES)
            if whole and not path.parent.name.startswith(TEMPORARY_PREFIX):
                yield RunDirectory(path.parent.parent.name, path.parent.name, path.parent, read_json(path))

    @contextmanager
    def claimed_run(self, stem: str, sha256: str) -> Iterator[str]:
        """Yield the run that a recording is, by its content: the one that is here, whatever it was called, or a new one.

        A new one of which nothing is written is forgotten on failure.
        """
        self.runs_path.mkdir(parents=True, exist_ok=True)
        with exclusive(self.runs_path):
            run_id = next(self._runs_of(sha256), f"{stem}-{sha256[:8]}")
            (self.runs_path / run_id).mkdir(exist_ok=True)
        try:
            yield run_id
        except BaseException:
            with suppress(OSError):
                (self.runs_path / run_id).rmdir()
            raise

    def _runs_of(self, sha256: str) -> Iterator[str]:
        for path in sorted(self.runs_path.glob(f"*-{sha256[:8]}")):
            known = self.run_json(path.name)
            if known is None or known["source"]["sha256"] == sha256:
                yield path.name

    def tag_run(self, run_id: str, tags: Mapping[str, str]) -> None:
        """Set the tags of a run, under every recipe."""
        for path in (
            self.runs_path / run_id / "run.json",
            *(run.path / "manifest.json" for run in self.recipes_of(run_id)),
        ):
            if path.exists():
                write_sealed(path, {**read_json(path), "tags": dict(tags)})

    def run_json(self, run_id: str) -> dict[str, Any] | None:
        """Return what is known of a run's log, or None."""
        path = self.runs_path / run_id / "run.json"
        return read_json(path) if path.exists() else None

    def write_run_json(self, run_id: str, values: Mapping[str, Any]) -> None:
        """Write what is known of a run's log."""
        write_sealed(self.runs_path / run_id / "run.json", values)

    def sources(self) -> dict[str, Any]:
        """Return the logs seen so far: path → size, modification time, sha256."""
        path = self.root / "sources.json"
        return read_json(path) if path.exists() else {}

    def remember_source(self, key: str, source: Mapping[str, Any]) -> None:
        """Remember a log, beside those that other processes remember meanwhile."""
        with exclusive(self.root):
            known = self.sources()
            if known.get(key) != source:
                write_sealed(self.root / "sources.json", {**known, key: source})

    def write_streams(self, run_id: str, streams: Streams, *, key: str) -> None:
        """Write L1 whole or not at all; ``key`` names the read settings they were made with."""
        shared = {
            "key": key,
            "robot": streams.robot,
            "gnss_crs": streams.gnss_crs,
            "power_averaged": streams.power_averaged,
            "findings": asdict(streams.findings),
        }
        with atomic_directory(self.runs_path / run_id / "streams") as directory:
            for role, table in streams.tables.items():
                sensor = asdict(streams.sensors[role])
                write_table(with_metadata(table, {**shared, "sensor": sensor}), directory / f"{role}.parquet")
            write_checksums(directory)

    def read_streams(self, run_id: str, *, key: str) -> Streams | None:
        """Return L1 if it is there, whole, of this data model and made with these read settings; else None."""
        tables: dict[str, pa.Table] = {}
        sensors: dict[str, Sensor] = {}
        shared: dict[str, Any] = {}
        for path in sorted((self.runs_path / run_id / "streams").glob("*.parquet")):
            try:
                table = read_table(path)
            except StoreError:
                return None
            shared = metadata_of(table)
            if shared.get("key") != key or shared.get("data_model_version") != DATA_MODEL_VERSION:
                return None
            sensor = shared["sensor"]
            sensors[path.stem] = Sensor(
                **{**sensor, "xyz_m": tuple(sensor["xyz_m"]), "quat_xyzw": tuple(sensor["quat_xyzw"])}
            )
            tables[path.stem] = table.replace_schema_metadata(None)
        if not tables:
            return None
        findings = Findings(tuple(shared["findings"]["warnings"]), shared["findings"]["facts"])
        try:
            return Streams(tables, sensors, shared["robot"], shared["gnss_crs"], shared["power_averaged"], findings)
        except TableError:
            return None

    def write_run(
        self,
        run_id: str,
        recipe_id: str,
        *,
        track: Track,
        gated: GatedTrack,
        labelled: LabelledSegments,
        manifest: Mapping[str, Any],
    ) -> Path:
        """Write one ingestion; the directory appears by one rename."""
        path = self.runs_path / run_id / recipe_id
        info = info_to_json(labelled.info)
        with atomic_directory(path) as directory:
            for name, table in (
                ("track", gated.table),
                ("segments", labelled.table),
                ("rejections", track.rejections),
            ):
                datum = {"run_id": run_id, "recipe_id": recipe_id, "datum": info["datum"], "robot": info["robot"]}
                write_table(with_metadata(table, datum), directory / f"{name}.parquet")
            written = {"info": info, "ledger_m": dict(labelled.ledger_m), "checksums": checksums_to_json(directory)}
            write_sealed(directory / "manifest.json", {**manifest, **written})
        return path


def is_store(path: Path) -> bool:
    """Tell whether a directory is a store: it holds runs or maps."""
    return any(path.glob("runs/*/run.json")) or any(path.glob("maps/*.zarr")) or (path / "sources.json").is_file()


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
            runs = [run for run in store.recipes_of(run_path.name) if real in (run_path, run.path)]
            if not runs:
                raise StoreError(
                    f"{path}: holds no finished ingestion of data model {DATA_MODEL_VERSION}; ingest its log again"
                )
            return store, runs
    return None


def open_store(root: str | Path, *, create: bool = False) -> Store:
    """Return the store at ``root``; `StoreError` if it is no directory, is missing (unless ``create``) or cannot be written."""
    if "://" in str(root):
        raise StoreError(f"{root}: this version keeps stores on local disk only; give a directory")
    path = Path(root)
    if path.exists() and not path.is_dir():
        raise StoreError(f"{path}: is a file, wanted a directory for the store")
    if not path.exists() and not create:
        raise StoreError(f"{path}: there is no store here; run 'tcpipe ingest' first, or name another with --store")
    if create:
        try:
            path.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path, prefix=TEMPORARY_PREFIX):
                pass
        except OSError as error:
            raise StoreError(
                f"{path}: the store cannot be written ({error.strerror}); name another with --store"
            ) from None
    return Store(path)
