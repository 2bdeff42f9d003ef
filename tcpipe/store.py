"""The store: where runs and maps live, by content, in a directory or a bucket with one layout and one protocol (ADR-28).

::

    <root>/
      store.json, report.html                       that this is a store, and of which layout; the page of all runs
      log/<n>.json, snapshot-<n>.json.zst           commits: what every call did, and from time to time what they add up to
      maps/<name>-<n>.json                          a map: its files and their checksums
      maps/<name>/<digest>/                         <name>.zarr, and a picture of it
      runs/<run_id>/run-<n>.json                    source, robot, topics, damage; files and checksums of the streams
      runs/<run_id>/tags-<n>.json                   tags that were changed since
      runs/<run_id>/streams/<digest>/<role>.parquet
      runs/<run_id>/<recipe_id>/manifest-<n>.json   what became of it; files and checksums of the tables
      runs/<run_id>/<recipe_id>/<digest>/           track.parquet, segments.parquet, rejections.parquet
      index/                                        runs.parquet: all runs as a table for other tools, made again at will

Of numbered documents the highest holds. A ``<digest>`` names the content of what lies in it.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath

import pyarrow as pa

from tcpipe.errors import StoreError, TableError, UsageError
from tcpipe.formats.atomic import check_local_output
from tcpipe.formats.bucket_directories import FetchedShards, fetch_files
from tcpipe.formats.commit_log import Stamp, put_commit, read_state
from tcpipe.formats.commits import Entries, Kind, State
from tcpipe.formats.index_files import RunFacts, make_run_facts, read_known_log, write_index
from tcpipe.formats.integrity import CHECKSUMS, Checksum, compute_checksums, seal_document
from tcpipe.formats.json_files import parse_typed, parse_typed_json, to_compact_json, to_json, to_plain
from tcpipe.formats.object_storage import is_bucket, is_url
from tcpipe.formats.parquet import add_segments_metadata, read_table
from tcpipe.formats.place import Place, open_place
from tcpipe.formats.run_documents import (
    MARK,
    Manifest,
    MapDocument,
    RunJson,
    StreamInfo,
    Tags,
    find_highest_numbers,
    is_unmarked_store,
    mark_store,
    name_document,
    name_folder,
    put_next,
    read_as_at,
    read_layout,
    tell_the_same,
)
from tcpipe.formats.stored_runs import (
    FilesState,
    Ingestions,
    Lost,
    RunDirectory,
    add_span,
    convert_run_errors,
    look_at_files,
    put_tables,
    subdirectory,
)
from tcpipe.tables.levels import (
    DATA_MODEL_VERSION,
    TABLES_VERSION,
    LabelledSegments,
    MaskedTrack,
    Streams,
    Track,
    add_metadata,
    describe_other_data_model,
    read_metadata,
)

logger = logging.getLogger("tcpipe")

_HASH_IN_NAME = re.compile(r"-([0-9a-f]{8,64})$")
_STREAMS = "streams"
_PROVED = "proved.json"
"""Record of files that were compared with their manifest, and their state then; may be removed at any time."""
_NAME_HEX = 8
"""Digits of the log's sha256 in a run's name, more if two logs of one name share them."""
_MAP_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True, slots=True)
class Store:
    """A store in a directory, or below a URL."""

    root: Path | str

    @property
    def place(self) -> Place:
        """Where its files lie."""
        return open_place(self.root)

    @property
    def runs_place(self) -> Place:
        """Where its runs lie."""
        return self.place.below("runs")

    def maps(self) -> list[str]:
        """Return the names of the maps, sorted."""
        return sorted(find_highest_numbers(self.place.files("maps")))

    def map_number(self, name: str) -> int:
        """Return the number of a map's last document, 0 without one; `StoreError` if the name cannot be a map's."""
        if not _MAP_NAME.fullmatch(name):
            raise StoreError(
                f"map name {name!r}: expected letters, digits, '_', '-', '.', beginning with a letter or digit"
            )
        return find_highest_numbers(self.place.files("maps")).get(name, 0)

    def map_document(self, name: str) -> MapDocument:
        """Return the place of a map, and its files; `StoreError` if it is missing, or its document has changed."""
        return read_as_at(self.place.below("maps"), name_document(name, self.map_number(name)), MapDocument)

    def map_files(self, name: str) -> tuple[Path, FetchedShards | None]:
        """Return the place of a map on this machine, and of its tiles if the store is in a bucket, as `open_map` takes them."""
        return self.map_at(self.map_document(name))

    def map_at(self, document: MapDocument) -> tuple[Path, FetchedShards | None]:
        """Return the same of the map of a document, whatever has taken its place since."""
        place, described = self.place.below("maps"), ("/zarr.json", f"/{CHECKSUMS}")
        root, fetched = fetch_files(place, document.checksums, by_range=lambda name: not name.endswith(described))
        return root / document.zarr, fetched

    @contextmanager
    def new_map(self, name: str, *, after: int = 0) -> Iterator[Path]:
        """Yield where a map is to be written, and beside it a picture ``.png``; in the end it is this store's, under ``after`` + 1.

        `StoreError`: another process has added a map of that name meanwhile, which stays.
        """
        maps = self.place.below("maps")
        with maps.workshop() as directory:
            with convert_run_errors(maps.where(name), directory):
                yield directory / f"{name}.zarr"
            checksums = compute_checksums(directory)
            prefix = f"{name}/{name_folder(checksums)}"
            if free := self.map_number(name) == after:
                maps.put_files(prefix, directory)
        zarr, picture, files = f"{prefix}/{name}.zarr", f"{prefix}/{name}.png", subdirectory(prefix, checksums)
        document = MapDocument(DATA_MODEL_VERSION, zarr, picture, files)
        data, new = to_json(seal_document(document)).encode(), name_document(name, after + 1)
        same = free and after > 0 and maps.read(name_document(name, after)) == data
        put = same or (free and maps.put_new(new, data))
        if not put and not (after and maps.read(new) == data):  # the answer to one's own may be lost
            raise StoreError(f"map {name}: another process has written it meanwhile, and it stays; look at it first")

    def check_writable(self) -> None:
        """Raise `StoreError` where the store cannot be written: before work whose result would have no place."""
        mark_store(self.place, found=True)

    def state(self) -> State:
        """Return what the log says."""
        return read_state(self.place)

    def commit(self, state: State, stamp: Stamp, kind: Kind, make: Callable[[State], Entries]) -> State:
        """Write a commit after those of a state; see `put_commit`."""
        return put_commit(self.place, state, stamp, kind, make)

    def runs(self) -> list[RunDirectory]:
        """Return every finished ingestion of this data-model version, by run and recipe, that is not superseded."""
        return list(self.ingestions().finished)

    def recipes_of(self, run_id: str) -> list[RunDirectory]:
        """Return the finished ingestions of one run."""
        return list(self.ingestions(run_id).finished)

    def ingestions(self, run_id: str | None = None, *, state: State | None = None) -> Ingestions:
        """Return what there is of all runs, or of one: what the log says, and whether the files are there in their sizes."""
        state = self.state() if state is None else state
        rows = {key: state.runs[key] for key in sorted(state.runs) if run_id in (None, key[0])}
        finished, lost, outdated = list[RunDirectory](), dict[tuple[str, str], Lost](), dict[str, RunFacts]()
        for row, gone, files_state in look_at_files(runs := self.runs_place, rows.values()):
            if run_id is None and row.superseded_by:
                continue
            if gone is not None:
                lost[row.run_id, row.recipe_id] = gone
            elif row.data_model_version != DATA_MODEL_VERSION:
                outdated[row.run_id] = row
            else:
                finished.append(RunDirectory(row.run_id, row.recipe_id, runs, row, files_state))
        current = {run.run_id for run in finished}
        outdated = {name: row for name, row in outdated.items() if name not in current}
        return Ingestions(state, tuple(finished), lost, outdated, rows)

    def read_rows(self, run_id: str) -> dict[str, RunFacts]:
        """Return what lies in the directory of a run, by recipe, as a commit would have it; what is not whole is left out.

        The highest number of each document counts, whether a commit names it or not.
        """
        place = self.runs_place.below(run_id)
        sizes = {
            entry.name.removeprefix(f"{run_id}/"): entry.size_bytes
            for entry in self.runs_place.entries(run_id, but=_STREAMS)
        }
        last = find_highest_numbers(sizes)
        known = self.known_run(run_id, last)
        about = {
            name: sizes[name] for stem in ("run", "tags") if stem in last for name in [name_document(stem, last[stem])]
        }
        found = dict[str, RunFacts]()
        for stem, number in sorted(last.items()):
            recipe_id, _, kind = stem.partition("/")
            with suppress(StoreError):
                if kind == "manifest" and known is not None:
                    document, name = name_document(stem, number), name_document(kind, number)
                    manifest = read_as_at(place, document, Manifest)
                    if (manifest.run_id, manifest.recipe_id) != (run_id, recipe_id):
                        continue
                    tables = {
                        f"{recipe_id}/{file}": checksum.size_bytes for file, checksum in manifest.checksums.items()
                    }
                    if tables.items() <= sizes.items():
                        row = make_run_facts(manifest, name, {document: sizes[document], **about, **tables})
                        row = add_span(row, place.below(recipe_id), manifest)
                        tags = known.tags if "tags" in last else manifest.tags
                        found[recipe_id] = replace(row, log=read_known_log(known), tags=tags)
        return found

    @property
    def index_place(self) -> Place:
        """Where tables for other tools lie."""
        return self.place.below("index")

    def write_index(self, state: State) -> None:
        """Write the table of all runs for other tools."""
        write_index(self.index_place, state.runs)

    def prove(self, runs: Sequence[RunDirectory]) -> dict[str, str]:
        """Compare segments and tracks with what the manifests have of them; return by run what is wrong.

        Files that are as they were when they were compared before are not read again.
        """
        damaged, proved, new = dict[str, str](), dict[str, FilesState](), dict[str, FilesState]()
        with suppress(StoreError):
            proved = parse_typed_json(self.index_place.read(_PROVED) or b"{}", dict[str, FilesState], _PROVED)
        for run in runs:
            try:
                if run.files_state != proved.get(f"{run.run_id}/{run.recipe_id}"):
                    for name in ("segments.parquet", "track.parquet"):
                        run.file(name)
                    new[f"{run.run_id}/{run.recipe_id}"] = run.files_state
            except StoreError as error:
                damaged[run.run_id] = error.problems[0]
        if new:
            with suppress(StoreError):
                self.index_place.put(_PROVED, to_compact_json({**proved, **new}))
        return damaged

    def run_ids(self) -> list[str]:
        """Return the names of all runs, finished or not."""
        return self.runs_place.folders()

    def name_run(self, stem: str, sha256: str) -> str:
        """Return a new run's name, with enough of its hash to differ from another log of the same name."""
        names = [f"{stem}-{sha256[:length]}" for length in range(_NAME_HEX, len(sha256), 4)]
        for name in names:
            known = self.known_run(name) if self.runs_place.files(name) else None
            if known is None or known.source.sha256 == sha256:
                return name
        return f"{stem}-{sha256}"

    def tag_run(self, run_id: str, given: Mapping[str, str]) -> bool:
        """Add tags to those of a run, under every recipe; return whether that changed any."""
        while True:
            number = self._last(run_id, "tags")
            known = self.known_run(run_id)
            before = known.tags if known is not None else self._tags(run_id, number) or {}
            tags = Tags({**before, **given})
            if tags.tags == before:
                return False
            data = to_json(seal_document(tags)).encode()
            if self.runs_place.put_new(f"{run_id}/{name_document('tags', number + 1)}", data):
                return True

    def _last(self, run_id: str, stem: str) -> int:
        return find_highest_numbers(self.runs_place.files(run_id)).get(stem, 0)

    def _tags(self, run_id: str, number: int) -> Mapping[str, str] | None:
        """Return the tags in a document; None for number 0."""
        return read_as_at(self.runs_place, f"{run_id}/{name_document('tags', number)}", Tags).tags if number else None

    def run_json(self, run_id: str, last: Mapping[str, int] | None = None) -> RunJson | None:
        """Return what is known of a run's log, or None; `StoreError` if it is not as it was written, or another run's.

        ``last`` are the highest numbers of its documents, where they are known.
        """
        last = find_highest_numbers(self.runs_place.files(run_id)) if last is None else last
        if not last.get("run"):
            return None
        name = f"{run_id}/{name_document('run', last['run'])}"
        found = read_as_at(self.runs_place, name, RunJson)
        if not is_named_after(run_id, found.source.sha256):
            where = self.runs_place.where(name)
            raise StoreError(f"{where}: is of another run: its log's sha256 begins with {found.source.sha256[:8]}")
        tags = self._tags(run_id, last.get("tags", 0))
        return found if tags is None else replace(found, tags=tags)

    def known_run(self, run_id: str, last: Mapping[str, int] | None = None) -> RunJson | None:
        """Return `run_json`; None also where it is not as it was written, which is said: the run is to be made again."""
        try:
            return self.run_json(run_id, last)
        except StoreError as error:
            logger.warning("%s; the run is made again when its log is ingested", error.problems[0])
            return None

    def write_run_json(self, run_id: str, values: RunJson) -> None:
        """Write what is known of a run's log; where that is known already nothing is written."""
        place, last = self.runs_place.below(run_id), find_highest_numbers(self.runs_place.files(run_id))
        known = self.known_run(run_id) if last.get("run") else None
        if known is None or not tell_the_same(known, values) or values.streams != known.streams:
            known = put_next(place, "run", values, after=last.get("run", 0), settled=partial(tell_the_same, values))
        if last.get("tags") or not values.tags.items() <= known.tags.items():
            self.tag_run(run_id, values.tags)

    def write_streams(self, run_id: str, streams: Streams, *, key: str) -> Mapping[str, Checksum]:
        """Put L1 into the store, and return the files; ``key`` names the read settings they were made with."""
        tables: dict[str, pa.Table] = {}
        for role, table in streams.tables.items():
            read_with = key, streams.robot, streams.gnss_crs, streams.power_averaged
            info = StreamInfo(*read_with, report=streams.report, sensor=streams.sensors[role])
            tables[role] = add_metadata(table, to_plain(info))
        return put_tables(self.runs_place.below(run_id), tables, folder=f"{_STREAMS}/")

    def read_streams(self, run_id: str, *, key: str) -> Streams | None:
        """Return L1 if it is there, whole, of this data model and made with these read settings; else None."""
        known = self.known_run(run_id)
        if known is None or known.streams_key != key:
            return None
        tables, infos = dict[str, pa.Table](), dict[str, StreamInfo]()
        try:
            for role, path in self.stream_files(run_id, known).items():
                table = read_table(path)
                infos[role] = info = parse_typed(read_metadata(table), StreamInfo, path)
                if info.key != key or info.data_model_version != TABLES_VERSION:
                    return None
                tables[role] = table.replace_schema_metadata(None)
            if not tables:
                return None
            sensors = {role: each.sensor for role, each in infos.items()}
            return Streams(tables, sensors, info.robot, info.gnss_crs, info.power_averaged, info.report)
        except (TableError, StoreError):
            return None

    def find_stream_files(self, run_id: str) -> dict[str, Path]:
        """Return the files of L1 by role as `stream_files`; none if they are not there or not as they were written."""
        with suppress(StoreError):
            known = self.run_json(run_id)
            return self.stream_files(run_id, known) if known else {}
        return {}

    def stream_files(self, run_id: str, known: RunJson) -> dict[str, Path]:
        """Return the files of L1 on this machine by role, proved; `StoreError` if one is not as it was written."""
        place = self.runs_place.below(run_id)
        return {
            PurePosixPath(name).stem: place.proved(name, checksum) for name, checksum in sorted(known.streams.items())
        }

    def write_run(
        self,
        manifest: Manifest,
        *,
        track: Track,
        masked: MaskedTrack,
        labelled: LabelledSegments,
        settled: Callable[[Manifest], bool] = lambda _: False,
    ) -> Manifest:
        """Write one ingestion, its checksums added to the manifest; return that, or the one of others that is ``settled``."""
        place = self.runs_place.below(f"{manifest.run_id}/{manifest.recipe_id}")
        metadata = {
            "run_id": manifest.run_id, "recipe_id": manifest.recipe_id, "datum": to_plain(manifest.info.datum), "robot": manifest.robot,
        }  # fmt: skip
        tables = {
            "track": masked.table,
            "segments": add_segments_metadata(labelled.table, manifest.info.datum),
            "rejections": track.rejections,
        }
        whole = self.read_rows(manifest.run_id).get(manifest.recipe_id)
        if whole is not None and settled(known := read_as_at(place, whole.manifest, Manifest)):
            return known
        checksums = put_tables(place, {name: add_metadata(table, metadata) for name, table in tables.items()})
        after = find_highest_numbers(place.files()).get("manifest", 0)
        return put_next(place, "manifest", replace(manifest, checksums=checksums), after=after, settled=settled)


def is_named_after(run_id: str, sha256: str) -> bool:
    """Return whether a run can be that of a log: the digits at the end of its name, if any, are the first of the log's sha256."""
    name = _HASH_IN_NAME.search(run_id)
    return name is None or sha256.startswith(name[1])


def is_store(path: Path | str) -> bool:
    """Return whether a place is a store; `UsageError` if it is one of another data model, or incomplete."""
    if is_url(path) and not is_bucket(path):
        return False
    place = open_place(path)
    if place.read(MARK) is None:  # not its size: only what is asked for with a body is refused with a reason
        if is_unmarked_store(place):
            raise UsageError(f"{place.where()}: an incomplete copy of a store (no {MARK}); copy it again")
        return False
    with suppress(StoreError):
        _read_layout(place)
    return True


def _read_layout(place: Place) -> str | None:
    """Return the data model of a store, None without a store; `UsageError` for another data model."""
    version = read_layout(place)
    if version not in (None, DATA_MODEL_VERSION):
        raise UsageError(describe_other_data_model(place.where(), version))
    return version


def run_at(path: Path | str) -> tuple[Store, list[RunDirectory]] | None:
    """Return the store and the finished ingestions of a run's directory, or the one of a recipe's; None for any other path.

    `StoreError`: it holds no finished run of this data-model version.
    """
    inside = find_store_above(path)
    if inside is None:
        return None
    store, run_id, recipe_id = inside
    found = store.ingestions(run_id)
    runs = [run for run in found.finished if recipe_id in (None, run.recipe_id)]
    if damaged := [line for (_, recipe), line in found.damaged.items() if recipe_id in (None, recipe)]:
        raise StoreError(*damaged)
    if not runs:
        raise StoreError(f"{path}: contains no finished run of data model {DATA_MODEL_VERSION}; ingest its log again")
    return store, runs


def find_store_above(path: Path | str) -> tuple[Store, str, str | None] | None:
    """Return of ``STORE/runs/<run_id>[/<recipe_id>]`` the store, the run and the recipe; None for any other path."""
    text = str(path).rstrip("/") if is_url(path) else str(Path(path).resolve())
    found = re.fullmatch(r"(.+)/runs/([^/]+)(?:/([^/]+))?", text)
    if found is None or not is_store(found[1]):
        return None
    store = Store(found[1] if is_url(path) else Path(found[1]))
    return (store, found[2], found[3]) if store.runs_place.files(found[2]) else None


def open_store(root: str | Path, *, create: bool = False) -> Store:
    """Return the store at a path or URL; unless with ``create`` it has to be there.

    `UsageError`: it is missing, a file, or of another data model; `StoreError`: it cannot be reached or made.
    """
    if is_url(root) and not is_bucket(root):
        raise UsageError(f"{root}: no place for a store; expected a directory, s3://bucket/name, gs:// or az://")
    root = str(root).rstrip("/") if is_url(root) else check_local_output(root)
    store = Store(root)
    if store.place.path is None:
        store.place.check()
    elif store.place.path.is_file():
        raise UsageError(f"{root}: is a file, expected a directory for the store")
    found = _read_layout(store.place) is not None or is_store(root)
    if not found and not create and not (store.place.path and store.place.path.exists()):
        raise UsageError(f"{root}: there is no store here; run 'tcpipe ingest' first, or name another with --store")
    if create:
        if not found:
            mark_store(store.place)
        store.place.clear()
    return store
