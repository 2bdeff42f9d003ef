"""The store: where runs and maps live, by content, in a directory or a bucket with one layout and one protocol (ADR 84).

::

    <root>/
      store.json, report.html                       that this is a store, and of which layout; the page of all runs
      records/<kind>/<fact>.json                    what is remembered: logs seen, known problems, superseded runs, names, calls
      maps/<name>-<n>.json                          a map: its files and their checksums
      maps/<name>/<digest>/                         <name>.zarr, and a picture of it
      runs/<run_id>/run-<n>.json                    source, robot, topics, damage; files and checksums of the streams
      runs/<run_id>/tags-<n>.json                   tags that were changed since
      runs/<run_id>/streams/<digest>/<role>.parquet
      runs/<run_id>/<recipe_id>/manifest-<n>.json   what became of it; files and checksums of the tables
      runs/<run_id>/<recipe_id>/<digest>/           track.parquet, segments.parquet, rejections.parquet
      spool/                                        pixels on their way into a dataset, while a cluster builds it
      index/                                        runs.parquet, logs.parquet: what the documents say, made again at will

Of numbered documents the highest holds. A ``<digest>`` names the content of what lies in it.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import TypeVar

import pyarrow as pa

from tcpipe.errors import StoreError, TableError, UsageError
from tcpipe.formats.atomic import clear_scratch
from tcpipe.formats.bucket import open_place, side_by_side
from tcpipe.formats.geoparquet import located_segments
from tcpipe.formats.index_files import (
    RunFacts,
    SeenLog,
    as_stored,
    facts_of,
    known_log,
    read_logs,
    read_runs,
    state_of,
    uncollected,
    write_logs,
    write_runs,
)
from tcpipe.formats.json_files import digest, plain, to_json, typed
from tcpipe.formats.numbered import digest_of, name_of, numbers, put_next, read_as_at, read_sealed_at
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.parquet import read_table
from tcpipe.formats.place import DirectoryPlace, Entry, Place
from tcpipe.formats.places import local_output
from tcpipe.formats.published import FetchedShards, files_here
from tcpipe.formats.record_files import (
    RunName,
    Sighting,
    Superseded,
    in_force,
    put_record,
    read_record,
    read_records,
    record_name,
)
from tcpipe.formats.run_documents import Manifest, ManifestHead, MapDocument, RunJson, StreamInfo, Tags, tell_the_same
from tcpipe.formats.seals import CHECKSUMS, Checksum, file_checksums, sealed
from tcpipe.formats.store_mark import MARK, is_outdated, layout_of, mark_store
from tcpipe.formats.stored_runs import (
    Ingestions,
    Listed,
    RunDirectory,
    below,
    local_file,
    put_tables,
    refuse_lost,
    told_of,
    with_lost,
    with_span,
)
from tcpipe.tables.levels import (
    DATA_MODEL_VERSION,
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

_HASH_IN_NAME = re.compile(r"-([0-9a-f]{8,64})$")
_STREAMS = "streams"
_BUCKETS = ("s3://", "gs://", "az://")
_NAME_HEX = 8
"""So many digits of its log's sha256 stand in a run's name, more where two recordings of one name share them."""
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
        return sorted(numbers(self.place.files("maps")))

    def map_number(self, name: str) -> int:
        """Return the number of a map's last document, 0 where there is none; `StoreError` if the name cannot be one."""
        if not _MAP_NAME.fullmatch(name):
            raise StoreError(
                f"map name {name!r}: wanted letters, digits, '_', '-', '.', beginning with a letter or digit"
            )
        return numbers(self.place.files("maps")).get(name, 0)

    def map_document(self, name: str) -> MapDocument:
        """Return where a map lies, and its files; `StoreError` where there is none, or its document is not as it was written."""
        return read_as_at(self.place.below("maps"), name_of(name, self.map_number(name)), MapDocument)

    def map_path(self, name: str) -> Path:
        """Return where a map lies on this machine; of one in a bucket only its descriptions do."""
        return self.map_files(name)[0]

    def map_files(self, name: str) -> tuple[Path, FetchedShards | None]:
        """Return where a map lies on this machine, and where its tiles are read if they lie in a bucket: what `open_map` takes."""
        return self.map_at(self.map_document(name))

    def map_at(self, document: MapDocument) -> tuple[Path, FetchedShards | None]:
        """Return the same of the map of a document, whatever has taken its place since."""
        place, described = self.place.below("maps"), ("/zarr.json", f"/{CHECKSUMS}")
        root, fetched = files_here(place, document.checksums, by_range=lambda name: not name.endswith(described))
        return root / document.zarr, fetched

    def map_picture(self, name: str) -> Path:
        """Return where the quick look of a map lies on this machine."""
        document = self.map_document(name)
        return self.place.below("maps").local(document.picture, document.checksums[document.picture])

    @contextmanager
    def new_map(self, name: str, *, after: int = 0) -> Iterator[Path]:
        """Yield where a map is to be written, and beside it a picture ``.png``; in the end it is this store's, under ``after`` + 1.

        Raises
        ------
        StoreError : it cannot be written, or another process has added a map of that name meanwhile, which stays.
        """
        maps = self.place.below("maps")
        with maps.workshop() as directory:
            with told_of(maps.where(name), directory):
                yield directory / f"{name}.zarr"
            checksums = file_checksums(directory)
            prefix = f"{name}/{digest_of(checksums)}"
            if free := self.map_number(name) == after:
                maps.put_files(prefix, directory)
        told = DATA_MODEL_VERSION, f"{prefix}/{name}.zarr", f"{prefix}/{name}.png", below(prefix, checksums)
        data, new = to_json(sealed(MapDocument(*told))).encode(), name_of(name, after + 1)
        same = free and after > 0 and maps.read(name_of(name, after)) == data
        put = same or (free and maps.put_new(new, data))
        if not put and not (after and maps.read(new) == data):  # the answer to one's own may be lost
            raise StoreError(f"map {name}: another process has written it meanwhile, and it stays; look at it first")

    def runs(self) -> list[RunDirectory]:
        """Return every finished ingestion of this data-model version, by run and recipe, that is not superseded."""
        return list(self.ingestions().finished)

    def recipes_of(self, run_id: str) -> list[RunDirectory]:
        """Return the finished ingestions of one run."""
        return list(self.ingestions(run_id).finished)

    @uncollected()
    def ingestions(self, run_id: str | None = None) -> Ingestions:
        """Return what there is of all runs, or of one, by one listing.

        A manifest is read and proved, unless the index has what it says and its file is as it was then; of all, see `with_lost`.
        """
        superseded = self.superseded() if run_id is None else {}
        known = read_runs(self.index_place) if run_id is None else {}
        finished, others, damaged = list[RunDirectory](), dict[str, ManifestHead](), dict[tuple[str, str], str]()
        rows = dict[tuple[str, str], RunFacts]()

        def seen(of: tuple[Listed, str, int]) -> RunDirectory | ManifestHead | StoreError:
            try:
                return self._ingestion(*of, known.get((of[0].run_id, of[1])))
            except StoreError as error:
                return error

        every = [(listed, *of) for listed in self._listed(run_id) for of in listed.manifests()]
        for (listed, recipe, _), found in zip(every, side_by_side(self.root, seen, every), strict=True):
            name, by = listed.run_id, superseded.get(listed.run_id)
            if isinstance(found, StoreError):
                damaged.update({} if by else {(name, recipe): found.problems[0]})
            elif isinstance(found, ManifestHead):
                others.update({} if by else {name: found})
            else:
                row = found.facts
                rows[name, recipe] = row if row.superseded_by == by else replace(row, superseded_by=by)
                finished += [found] if by is None else []
        current = {run.run_id for run in finished}
        outdated = {name: head for name, head in others.items() if name not in current}
        here = Ingestions(tuple(finished), outdated, damaged, superseded, rows)
        if run_id is None:
            here = with_lost(here, known, self.run_ids(), runs=self.runs_place, index=self.index_place)
        return replace(here, stale=_differ({**rows, **here.lost}, known))

    def _listed(self, run_id: str | None) -> Iterator[Listed]:
        """Yield the files of each run, perhaps without its streams: one listing."""
        runs, found = self.runs_place, dict[str, dict[str, Entry]]()
        for entry in runs.entries(run_id or "", but=_STREAMS):
            name, _, rest = entry.name.partition("/")
            found.setdefault(name, {})[rest] = entry
        return (Listed(runs, name, files, numbers(files)) for name, files in found.items())

    def _ingestion(self, of: Listed, recipe_id: str, number: int, row: RunFacts | None) -> RunDirectory | ManifestHead:
        """Return an ingestion, or the head of one of another data model; `StoreError` if it is not as it was written, or a file is gone.

        ``row`` is what the index has of it.
        """
        place, name = of.runs.below(f"{of.run_id}/{recipe_id}"), name_of("manifest", number)
        state = state_of(of.files[f"{recipe_id}/{name}"])
        refuse_lost(of, recipe_id, row)
        if row is None or row.state != state:
            where = place.where(name)
            document = read_sealed_at(place, name, ours=lambda found: found.get("data_model_version") in READ_VERSIONS)
            if document.get("data_model_version") not in READ_VERSIONS:
                return typed(document, ManifestHead, where)
            manifest = typed(document, Manifest, where)
            if (manifest.run_id, manifest.recipe_id) != (of.run_id, recipe_id):
                raise StoreError(
                    f"{where}: is of {manifest.run_id}/{manifest.recipe_id}, but lies in {of.run_id}/{recipe_id}"
                )
            row = with_span(facts_of(manifest, state), place, manifest)
        for file, wanted in row.sizes.items():
            found = of.files.get(f"{recipe_id}/{file}")
            if found is None or found.size_bytes != wanted:
                how = "is gone" if found is None else f"has {found.size_bytes} bytes, wanted {wanted}"
                raise StoreError(f"{place.where(file)}: {how}; ingest the log again")
        above = len(f"runs/{of.run_id}/")
        files_state = " ".join(state_of(of.files[name[above:]]) for name in (row.segments_file, row.track_file))
        return RunDirectory(of.run_id, recipe_id, place, self._with_log(row, of), files_state)

    def _with_log(self, row: RunFacts, of: Listed) -> RunFacts:
        """Return what the index has of an ingestion with what is known of its log and tags now; None of a log that cannot be believed."""
        last = [name_of(stem, of.numbers[stem]) for stem in ("run", "tags") if stem in of.numbers]
        state = " ".join(state_of(of.files[name]) for name in last)
        if row.log is not None and row.log.state == state:
            return row
        try:
            known = self.run_json(row.run_id, of.numbers)
        except StoreError:
            known = None
        tags = known.tags if known and len(last) > 1 else row.tags
        return replace(row, log=known_log(known, state) if known else None, tags=tags)

    @property
    def index_place(self) -> Place:
        """Where the index lies."""
        return self.place.below("index")

    def keep_index(self, found: Ingestions) -> None:
        """Write down what was found of all runs, and what was lost, where that is not what the index had."""
        if found.stale:
            write_runs(self.index_place, {**found.rows, **found.lost}.values())

    def prove(self, runs: Sequence[RunDirectory]) -> dict[str, str]:
        """Compare segments and tracks with what the manifests have of them; return by run what is wrong.

        Files that are as they were when they were compared before are not read again.
        """
        damaged, proved = dict[str, str](), dict[tuple[str, str], RunFacts]()
        for run in runs:
            try:
                if run.files_state != run.facts.proved:
                    run.prove("segments.parquet", "track.parquet")
                    proved[run.run_id, run.recipe_id] = replace(run.facts, proved=run.files_state)
            except StoreError as error:
                damaged[run.run_id] = error.problems[0]
        if proved:
            write_runs(self.index_place, {**read_runs(self.index_place), **proved}.values())
        return damaged

    @uncollected()
    def seen_logs(self) -> dict[str, list[Sighting]]:
        """Return what is remembered of all logs, by lineage; a record that the index has is not read, while its file is as it was."""
        known = read_logs(self.index_place)

        def row_of(entry: Entry) -> SeenLog | None:
            lineage, _, name = entry.name.removesuffix(".json").rpartition("/")
            row, state = known.get((lineage, name)), state_of(entry)
            if row is None or row.state != state:
                sighting = self.recall(f"{lineage}/{name}", Sighting)
                row = None if sighting is None else SeenLog(lineage, name, state, sighting)
            return row

        found = side_by_side(self.root, row_of, self.place.below("records").entries("logs"))
        rows = {(row.lineage, row.name): row for row in found if row is not None}
        if _differ(rows, known):
            write_logs(self.index_place, rows.values())
        seen: dict[str, list[Sighting]] = {}
        for row in rows.values():
            seen.setdefault(row.lineage, []).append(row.sighting)
        return seen

    def superseded(self) -> dict[str, str]:
        """Return the runs whose log was completed or repaired, and by which run."""
        return in_force(self.records("superseded", Superseded))

    def supersede(self, run_id: str, by: str | None) -> None:
        """Remember that another run takes this one's place, or, without ``by``, that it counts again."""
        number = sum(record.run_id == run_id for record in self.records("superseded", Superseded))
        self.note("superseded", Superseded(run_id, by, number))

    def run_ids(self) -> list[str]:
        """Return the names of all runs, finished or not."""
        return self.runs_place.folders()

    def claim_run(self, stem: str, sha256: str) -> str:
        """Return the run that a recording is, by its content: the one that was named for it first, or a new one."""
        run_id = self._free_name(stem, sha256)
        new = self.remember(f"runs/{sha256}", RunName(sha256, run_id))
        return run_id if new else self.run_of_content(sha256) or run_id

    def run_of_content(self, sha256: str) -> str | None:
        """Return the run that was named for a recording; None where there was none."""
        found = self.recall(f"runs/{sha256}", RunName)
        return None if found is None else found.run_id

    def _free_name(self, stem: str, sha256: str) -> str:
        """Return a new run's name: as much of its hash as tells it from another recording of the same name."""
        names = [f"{stem}-{sha256[:length]}" for length in range(_NAME_HEX, len(sha256), 4)]
        for name in names:
            known = self.known_run(name) if self.runs_place.files(name) else None
            if known is None or known.source.sha256 == sha256:
                return name
        return f"{stem}-{sha256}"

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

    def tag_run(self, run_id: str, given: Mapping[str, str]) -> bool:
        """Add tags to those of a run, under every recipe; return whether that changed any."""
        while True:
            number = self._last(run_id, "tags")
            known = self.known_run(run_id)
            before = known.tags if known is not None else self._tags(run_id, number) or {}
            tags = Tags({**before, **given})
            if tags.tags == before:
                return False
            data = to_json(sealed(tags)).encode()
            if self.runs_place.put_new(f"{run_id}/{name_of('tags', number + 1)}", data):
                return True

    def _last(self, run_id: str, stem: str) -> int:
        return numbers(self.runs_place.files(run_id)).get(stem, 0)

    def _tags(self, run_id: str, number: int) -> Mapping[str, str] | None:
        """Return the tags in a document; None for number 0."""
        return read_as_at(self.runs_place, f"{run_id}/{name_of('tags', number)}", Tags).tags if number else None

    def run_json(self, run_id: str, last: Mapping[str, int] | None = None) -> RunJson | None:
        """Return what is known of a run's log, or None; `StoreError` if it is not as it was written, or another run's.

        ``last`` are the highest numbers of its documents, where they are known.
        """
        last = numbers(self.runs_place.files(run_id)) if last is None else last
        if not last.get("run"):
            return None
        name = f"{run_id}/{name_of('run', last['run'])}"
        found = read_as_at(self.runs_place, name, RunJson)
        if not is_named_after(run_id, found.source.sha256):
            where = self.runs_place.where(name)
            raise StoreError(f"{where}: is of another run: its log's sha256 begins with {found.source.sha256[:8]}")
        tags = self._tags(run_id, last.get("tags", 0))
        return found if tags is None else replace(found, tags=tags)

    def known_run(self, run_id: str) -> RunJson | None:
        """Return `run_json`; None also where it is not as it was written, which is said: the run is to be made again."""
        try:
            return self.run_json(run_id)
        except StoreError as error:
            logger.warning("%s; the run is made again when its log is ingested", error.problems[0])
            return None

    def write_run_json(self, run_id: str, values: RunJson) -> None:
        """Write what is known of a run's log; where that is known already nothing is written."""
        place, last = self.runs_place.below(run_id), numbers(self.runs_place.files(run_id))
        known = self.known_run(run_id) if last.get("run") else None
        if known is None or not tell_the_same(known, values) or values.streams != known.streams:
            known = put_next(place, "run", values, after=last.get("run", 0), settled=partial(tell_the_same, values))
        if last.get("tags") or not values.tags.items() <= known.tags.items():
            self.tag_run(run_id, values.tags)

    def remember(self, name: str, fact: object) -> bool:
        """Remember a fact under ``<kind>/<name>`` for good; return whether it was new."""
        return put_record(self.place.below("records"), name, fact)

    def note(self, kind: str, fact: object) -> bool:
        """Remember a fact under a name that follows from it; return whether it was new."""
        return self.remember(f"{kind}/{record_name(digest(fact))}", fact)

    def recall(self, name: str, cls: type[T]) -> T | None:
        """Return what is remembered under ``<kind>/<name>``, None where nothing is."""
        return read_record(self.place.below("records"), name, cls)

    def records(self, kind: str, cls: type[T]) -> list[T]:
        """Return everything of a kind that is remembered, by name."""
        return list(read_records(self.place.below("records"), kind, cls))

    def sightings(self, lineage: str) -> list[Sighting]:
        """Return what is remembered of a log."""
        return self.records(lineage, Sighting)

    def write_streams(self, run_id: str, streams: Streams, *, key: str) -> Mapping[str, Checksum]:
        """Put L1 into the store, and return the files; ``key`` names the read settings they were made with."""
        told: dict[str, pa.Table] = {}
        for role, table in streams.tables.items():
            read_with = key, streams.robot, streams.gnss_crs, streams.power_averaged
            info = StreamInfo(*read_with, report=streams.report, sensor=streams.sensors[role])
            told[role] = with_metadata(table, plain(info))
        return put_tables(self.runs_place.below(run_id), told, folder=f"{_STREAMS}/")

    def read_streams(self, run_id: str, *, key: str) -> Streams | None:
        """Return L1 if it is there, whole, of this data model and made with these read settings; else None."""
        known = self.known_run(run_id)
        if known is None or known.streams_key != key:
            return None
        tables, of = dict[str, pa.Table](), dict[str, StreamInfo]()
        try:
            for role, path in self.stream_files(run_id, known).items():
                table = read_table(path)
                of[role] = told = typed(metadata_of(table), StreamInfo, path)
                if told.key != key or told.data_model_version not in READ_VERSIONS:
                    return None
                tables[role] = table.replace_schema_metadata(None)
            if not tables:
                return None
            sensors = {role: each.sensor for role, each in of.items()}
            return Streams(tables, sensors, told.robot, told.gnss_crs, told.power_averaged, told.report)
        except (TableError, StoreError):
            return None

    def stream_files(self, run_id: str, known: RunJson) -> dict[str, Path]:
        """Return the files of L1 on this machine by role, proved; `StoreError` if one is not as it was written."""
        place = self.runs_place.below(run_id)
        return {PurePosixPath(name).stem: local_file(place, name, of) for name, of in sorted(known.streams.items())}

    def write_run(
        self,
        manifest: Manifest,
        *,
        track: Track,
        gated: GatedTrack,
        labelled: LabelledSegments,
        settled: Callable[[Manifest], bool] = lambda _: False,
    ) -> Manifest:
        """Write one ingestion, its checksums added to the manifest; return that, or the one of others that is ``settled``."""
        place = self.runs_place.below(f"{manifest.run_id}/{manifest.recipe_id}")
        told = {
            "run_id": manifest.run_id, "recipe_id": manifest.recipe_id, "datum": plain(manifest.info.datum), "robot": manifest.robot,
        }  # fmt: skip
        tables = {
            "track": gated.table,
            "segments": located_segments(labelled.table, manifest.info.datum),
            "rejections": track.rejections,
        }
        whole = next((run for run in self.recipes_of(manifest.run_id) if run.recipe_id == manifest.recipe_id), None)
        if whole is not None and settled(whole.manifest):
            return whole.manifest
        checksums = put_tables(place, {name: with_metadata(table, told) for name, table in tables.items()})
        after = numbers(place.files()).get("manifest", 0)
        return put_next(place, "manifest", replace(manifest, checksums=checksums), after=after, settled=settled)


def _differ(rows: Mapping[tuple[str, str], object], known: Mapping[tuple[str, str], object]) -> bool:
    """Tell whether the index has something else."""
    return rows != known and {key: as_stored(row) for key, row in rows.items()} != known


def add_by_hash(runs: dict[str, list[str]], run_id: str) -> None:
    """Add a new run to `Store.run_ids_by_hash`."""
    runs.setdefault(run_id.rpartition("-")[2][:_NAME_HEX], []).append(run_id)


def is_named_after(run_id: str, sha256: str) -> bool:
    """Return whether a run can be that of a log: the digits at the end of its name, if any, are the first of the log's sha256."""
    name = _HASH_IN_NAME.search(run_id)
    return name is None or sha256.startswith(name[1])


def is_store(path: Path | str) -> bool:
    """Tell whether a place is a store; `UsageError` if it is one of an earlier layout."""
    if is_url(path) and not str(path).startswith(_BUCKETS):
        return False
    place = open_place(path)
    if place.read(MARK) is not None:  # not its size: only what is asked for with a body is refused with a reason
        return True
    if is_outdated(place):
        raise UsageError(
            f"{place.where()}: is a store of an earlier data model, or of which not all was copied (it has no {MARK}); "
            f"'tcpipe migrate {place.where()}' brings it to data model {DATA_MODEL_VERSION}"
        )
    return False


def run_at(path: Path | str) -> tuple[Store, list[RunDirectory]] | None:
    """Return the store and the finished ingestions of a run's directory, or the one of a recipe's; None for any other path.

    Raises
    ------
    StoreError : it is a run's, but holds no finished run of this data-model version.
    """
    inside = inside_store(path)
    if inside is None:
        return None
    store, run_id, recipe_id = inside
    found = store.ingestions(run_id)
    runs = [run for run in found.finished if recipe_id in (None, run.recipe_id)]
    if damaged := [line for (_, recipe), line in found.damaged.items() if recipe_id in (None, recipe)]:
        raise StoreError(*damaged)
    if not runs:
        raise StoreError(f"{path}: holds no finished run of data model {DATA_MODEL_VERSION}; ingest its log again")
    return store, runs


def inside_store(path: Path | str) -> tuple[Store, str, str | None] | None:
    """Return of ``STORE/runs/<run_id>[/<recipe_id>]`` the store, the run and the recipe; None for any other path."""
    text = str(path).rstrip("/") if is_url(path) else str(Path(path).resolve())
    found = re.fullmatch(r"(.+)/runs/([^/]+)(?:/([^/]+))?", text)
    if found is None or not is_store(found[1]):
        return None
    store = Store(found[1] if is_url(path) else Path(found[1]))
    return (store, found[2], found[3]) if store.runs_place.files(found[2]) else None


def open_store(root: str | Path, *, create: bool = False) -> Store:
    """Return the store at a path or URL.

    Raises
    ------
    UsageError : it is missing (unless ``create``), a file, or of an earlier layout.
    StoreError : it cannot be reached or written, or is of a data model that this version does not know.
    """
    if is_url(root) and not str(root).rstrip("/").startswith(_BUCKETS):
        raise UsageError(f"{root}: no store can lie there; wanted a directory, s3://bucket/name, gs:// or az://")
    root = str(root).rstrip("/") if is_url(root) else local_output(root)
    store = Store(root)
    if isinstance(root, Path):
        _refuse_file(root, create=create)
    else:
        store.place.check()
    version = layout_of(store.place)
    found = version is not None or is_store(root)
    if not found and not create and not isinstance(root, Path):
        raise UsageError(f"{root}: there is no store here; run 'tcpipe ingest' first, or name another with --store")
    if version not in (None, *READ_VERSIONS):
        raise StoreError(f"{root}: is of data model {version}, this version knows {', '.join(READ_VERSIONS)}")
    if create:
        mark_store(store.place, found=found)
        if isinstance(place := store.place, DirectoryPlace):  # what killed commands left
            place.clear()
        else:
            clear_scratch()
    return store


def _refuse_file(path: Path, *, create: bool) -> None:
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: is a file, wanted a directory for the store")
    if not path.exists() and not create:
        raise UsageError(f"{path}: there is no store here; run 'tcpipe ingest' first, or name another with --store")
