"""The store of runs and maps, in a directory or a bucket: documents, and the payload that they name (ADR-36).

::

    <root>/
      runs/ failed/ tags/ seen/ acknowledged/ maps/ outputs/ calls/     documents, see `tcpipe.formats.documents`
      blobs/<random>/          payload: the tables of a run (track, segments, rejections, streams/<role>), or a map
      report.html              page of all runs; the page of a run is in the folder of its tables
      index.parquet            cache of the documents' content
"""

import re
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tcpipe.errors import MapError, StoreError, UsageError
from tcpipe.formats.atomic import Location, check_input, check_local_output, make_unique_name
from tcpipe.formats.documents import BLOBS, KINDS, Kind, Record, State, make_key, make_run_key, put_document, scan
from tcpipe.formats.documents import parse_name as parse_document_name
from tcpipe.formats.integrity import CHECKSUMS, compute_checksums
from tcpipe.formats.object_storage import is_bucket, is_url
from tcpipe.formats.place import Place, find_changed_files, open_place
from tcpipe.formats.published_outputs import FetchedShards, fetch_files
from tcpipe.formats.runs import Run, RunFacts, StoredMap, strip_repeated
from tcpipe.formats.stored_runs import StoredRun, convert_run_errors
from tcpipe.tables.levels import DATA_MODEL_VERSION

_NAME_HEX = 8  # digits of the log's sha256 in the name of a run, more if two logs of one name share them
_MAP_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_MARK_OF_1_X = "store.json"


@dataclass(frozen=True, slots=True)
class Store:
    """A store in a directory, or below a URL."""

    root: Location

    @property
    def place(self) -> Place:
        """Location of its files."""
        return open_place(self.root)

    def scan(self) -> State:
        """Return the current state by its documents."""
        return scan(self.place)

    def put(self, state: State, kind: Kind, key: str, record: Record) -> None:
        """Write a document, which counts from now on for its kind and key, and add it to the state."""
        put_document(self.place, state, kind, key, record)

    def put_run(self, state: State, run: Run) -> None:
        """Write the manifest of a run."""
        self.put(state, "runs", make_run_key(run.log.sha256, run.recipe_id), strip_repeated(run))

    def put_blob(self, directory: Path) -> str:
        """Put a directory's files in this store's workshop into a new payload folder, and return its name."""
        name = make_unique_name()
        self.place.put_files(f"{BLOBS}/{name}", directory)
        return name

    def runs(self, state: State | None = None) -> list[StoredRun]:
        """Return the runs that count, by run and recipe: of this data model, with payload, and not superseded."""
        state = self.scan() if state is None else state
        return self._list_runs(state, {key: row for key, row in state.runs.items() if counts(row, state)})

    def find_runs(self, name: str, state: State | None = None) -> list[StoredRun]:
        """Return a run under each recipe, or, for ``RUN/RECIPE``, under one; none without such a run with its tables.

        Raises `StoreError`: there is such a run, but its tables are missing.
        """
        state = self.scan() if state is None else state
        run_id, _, recipe_id = name.partition("/")
        rows = {
            key: row
            for key, row in state.runs.items()
            if row.run_id == run_id and recipe_id in ("", row.recipe_id) and row.blob
        }
        found = self._list_runs(state, {key: row for key, row in rows.items() if state.has_payload(row)})
        if rows and not found:
            raise StoreError(f"run {name}: its tables are not in {self.place.where()}; ingest its log again")
        return found

    def _list_runs(self, state: State, rows: Mapping[str, RunFacts]) -> list[StoredRun]:
        place = self.place
        found = [StoredRun(place, row, state.names["runs", key]) for key, row in rows.items()]
        return sorted(found, key=lambda run: (run.run_id, run.recipe_id))

    def map_at(self, record: StoredMap) -> tuple[Path, FetchedShards | None]:
        """Return the local path of a map, and its tiles if the store is in a bucket, as for `open_map`."""
        place, described = self.place.below(f"{BLOBS}/{record.blob}"), ("/zarr.json", f"/{CHECKSUMS}")
        root, fetched = fetch_files(place, record.files, by_range=lambda name: not name.endswith(described))
        return root / f"{record.name}.zarr", fetched

    @contextmanager
    def new_map(self, name: str) -> Iterator[tuple[Path, Callable[[State], None]]]:
        """Yield the path for a new map (its picture ``.png`` beside it), and a function that stores both."""
        with self.place.workshop() as directory, convert_run_errors(self.place.where(BLOBS), directory):

            def put(state: State) -> None:
                files = compute_checksums(directory)
                record = StoredMap(name, DATA_MODEL_VERSION, self.put_blob(directory), files)
                self.put(state, "maps", make_key(name), record)

            yield directory / f"{name}.zarr", put

    def prove(self, runs: Sequence[StoredRun]) -> dict[str, str]:
        """Compare segments and tracks on disk with the manifests; return the problems by run.

        From a bucket each file is verified when it is fetched.
        """
        if self.place.path is None:
            return {}
        checksums = [
            {f"{run.facts.blob}/{name}": run.facts.tables[name] for name in ("segments.parquet", "track.parquet")}
            for run in runs
        ]
        every, blobs = dict(ChainMap(*checksums)), self.place.below(BLOBS)
        if not find_changed_files(blobs, every, every):
            return {}
        wrong = [find_changed_files(blobs, files, files) for files in checksums]
        return {run.run_id: lines[0] for run, lines in zip(runs, wrong, strict=True) if lines}


def counts(row: RunFacts, state: State) -> bool:
    """Return whether a run belongs into datasets and reports: of this data model, with payload, and not superseded."""
    is_there = row.data_model_version == DATA_MODEL_VERSION and state.has_payload(row)
    return is_there and not row.superseded_by


def name_run(state: State, stem: str, sha256: str) -> str:
    """Return the name of the run of a content: its existing one, or a new one that no run of the store has."""
    if known := min((row.run_id for row in state.runs.values() if row.log.sha256 == sha256), default=None):
        return known
    taken = {row.run_id for row in state.runs.values()}
    names = (f"{stem}-{sha256[:length]}" for length in range(_NAME_HEX, len(sha256), 4))
    return next((name for name in names if name not in taken), f"{stem}-{sha256}")


def choose_maps(store: Store, state: State, names: Sequence[str], *, hint: str = "") -> tuple[StoredMap, ...]:
    """Return the named maps of a store in their order, or its only one; ``hint`` follows the advice to name one.

    `MapError`: there is no such map; `UsageError`: there are several, and none is named.
    """
    maps, wanted = state.maps, [f" {name!r}" for name in names if name not in state.maps]
    if not maps:
        advice = "add one: tcpipe add-map NAME --height FILE"
        raise MapError(f"{store.root}: no map{''.join(wanted[:1])} in the store; {advice}")
    if wanted:
        raise MapError(f"{store.root}: no map{wanted[0]} in the store; there are {', '.join(maps)}")
    if not names and len(maps) > 1:
        raise UsageError(f"{store.root}: {len(maps)} maps in the store ({', '.join(maps)}); name one with --map{hint}")
    return tuple(maps[name] for name in dict.fromkeys(names)) or tuple(maps.values())


def check_map_name(name: str) -> str:
    """Return the name of a map; `StoreError` if it cannot be one."""
    if not _MAP_NAME.fullmatch(name):
        raise StoreError(
            f"map name {name!r}: expected letters, digits, '_', '-', '.', beginning with a letter or digit"
        )
    return name


def is_store(path: Location) -> bool:
    """Return whether a place is a store: whether it has documents. `UsageError` if it is one of tcpipe 1.x."""
    if is_url(path) and not is_bucket(path):
        return False
    place = open_place(path)
    names = place.list()
    if _MARK_OF_1_X in names and "calls" not in names:
        raise UsageError(f"{place.where()}: made by tcpipe 1.x: ingest the logs again, into a new store")
    found = (parse_document_name(kind, file) for kind in KINDS if kind in names for file in place.list(kind))
    return any(found)


def open_store(root: Location, *, create: bool = False) -> Store:
    """Return the store at a path or URL; unless with ``create`` it has to be there.

    `UsageError`: it is missing, a file, or made by tcpipe 1.x; `StoreError`: it cannot be reached.
    """
    if is_url(root) and not is_bucket(root):
        raise UsageError(f"{root}: no place for a store; expected a directory, s3://bucket/name, gs:// or az://")
    root = str(root).rstrip("/") if is_url(root) else check_local_output(root)
    store = Store(root)
    if store.place.path is None:
        store.place.check()
    elif store.place.path.is_file():
        raise UsageError(f"{root}: is a file, expected a directory for the store")
    if not is_store(root) and not create:
        raise UsageError(f"{root}: there is no store here; run 'tcpipe ingest' first, or name another with --store")
    if create:
        store.place.clear()
    return store


def is_path(name: Location) -> bool:
    """Return whether a name is a URL, or that of a file or directory; any other is looked up as a run."""
    if is_url(name):
        return True
    with suppress(UsageError):
        check_input(name)
        return True
    return False


def find_named_runs(name: Location, store: Location) -> list[StoredRun]:
    """Return the runs called RUN, under each recipe, or RUN/RECIPE; `UsageError` if the store has none."""
    if str(name) != str(store) and not is_store(store):
        raise UsageError(
            f"{name}: there is no such file or directory; if it is a run, name its store with --store: "
            f"there is none at {store}"
        )
    found = open_store(store).find_runs(str(name))
    if not found:
        raise UsageError(
            f"{name}: there is no such file or directory, and no such run in {store}; "
            f"expected a path, a run or RUN/RECIPE; 'tcpipe inspect {store}' lists the runs"
        )
    return found


def find_named_run(name: Location, store: Location) -> StoredRun:
    """Return the run called RUN or RUN/RECIPE; `UsageError` if the store has none, or several of that name."""
    return take_one_run(name, find_named_runs(name, store))


def take_one_run(name: Location, found: Sequence[StoredRun]) -> StoredRun:
    """Return the only run of those called ``name``; `UsageError` for runs under several recipes."""
    if len(found) > 1:
        names = ", ".join(run.name for run in found)
        raise UsageError(f"{name}: was ingested under several recipes; expected one of {names}")
    return found[0]
