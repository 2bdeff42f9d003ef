"""A store, its maps and its runs, held against the checksums, counts and contracts that were written with them."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
import pyarrow as pa

from tcpipe.errors import StoreError, TcpipeError
from tcpipe.formats.atomic import TEMPORARY_PREFIX, is_abandoned
from tcpipe.formats.bucket_directories import FetchedShards
from tcpipe.formats.commit_log import LOG, commit_name, make_snapshot_name, read_commit, read_snapshot
from tcpipe.formats.commits import Commit, State, fold
from tcpipe.formats.index_files import make_run_facts
from tcpipe.formats.integrity import CHECKSUMS, find_broken_seal_in, read_checksums
from tcpipe.formats.json_files import parse_typed
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.formats.parquet import read_table
from tcpipe.formats.place import Place, find_wrong_files
from tcpipe.formats.recipe_toml import ingest_key, make_recipe_id
from tcpipe.formats.run_documents import (
    MARK,
    SPOOL,
    Manifest,
    MapDocument,
    RunJson,
    find_highest_numbers,
    name_document,
    read_as_at,
    read_sealed_at,
    split_number,
)
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.report.pictures import is_picture_of_map
from tcpipe.store import Store
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.levels import DATA_MODEL_VERSION, LABELLED_SEGMENTS, MASKED_TRACK, READ_VERSIONS, REJECTIONS, STREAMS

CheckResult = tuple[str, int] | str

_TABLES = {"track": MASKED_TRACK, "segments": LABELLED_SEGMENTS, "rejections": REJECTIONS}
_COUNTS = {"track": "track_rows", "segments": "segments", "rejections": "rejections"}
_REPORT, _STREAMS = "report.html", "streams"
_DIGEST = re.compile(r"[0-9a-f]{16}")
_INDEX = "index"


def verify_store(store: Store) -> Iterator[CheckResult]:
    """Yield what was read of all maps and runs, and a line for everything that is not as it was written."""
    place = store.place
    yield find_broken_seal_in(place.read(MARK), place.where(MARK)) or ("files", 1)
    for name in place.files():
        if name == _REPORT:
            yield from _verify_seals(place, [name])
        elif name != MARK:
            yield _describe_stranger(place, name)
    for name in place.folders():
        if name == SPOOL:
            yield f"{place.where(name)}: belongs to a call that is running or was killed; 'tcpipe prune' removes old ones"
        elif name not in (LOG, "maps", "runs", _INDEX) and place.entries(name):
            yield _describe_stranger(place, name)
    yield from verify_log(place.below(LOG))
    yield from _verify_maps(store)
    yield from _verify_runs(store)
    yield from _find_left_behind(place.path) if place.path else ()


def verify_log(log: Place) -> Iterator[CheckResult]:
    """Yield counts and problems of every commit, and of every snapshot, which has to say what the commits to its number say."""
    state, last, whole = State(), 0, True
    for name in log.files():
        number = int(name[:10]) if name[:10].isdigit() and name[10:] == ".json" else None
        if number is None and not name.startswith("snapshot-"):
            yield _describe_stranger(log, name)
        if number is None:
            continue
        yield from (f"{log.where(commit_name(absent))}: is missing" for absent in range(last + 1, number))
        try:
            commit, digest, _ = read_commit(log, number)
        except StoreError as error:
            yield from error.problems
            last, whole = number, False
            continue
        if commit.parent != state.digest and whole and number == last + 1:
            yield f"{log.where(name)}: does not follow the commit before"
        whole = whole and number == last + 1
        state, last = replace(fold([commit], state), digest=digest), number
        yield "commits", 1
        yield from _verify_snapshot(log, state) if whole else ()


def _verify_snapshot(log: Place, state: State) -> Iterator[CheckResult]:
    name = make_snapshot_name(state.number)
    if log.size(name) is None:
        return
    try:
        found: Commit = read_snapshot(log, name)
    except StoreError as error:
        yield from error.problems
        return
    same = fold([found]) == replace(state, digest="")
    yield ("files", 1) if same else f"{log.where(name)}: contradicts the commits; remove it"


def _verify_runs(store: Store) -> Iterator[CheckResult]:
    """Yield the same of all runs, of those that the log names and of which files are gone, and of ingestions that no commit names."""
    wrong, found = set[str](), store.ingestions()
    for run_id in store.run_ids():
        for finding in verify_run(store, run_id):
            wrong |= {run_id} if isinstance(finding, str) else set()
            yield finding
        for under in store.read_rows(run_id):
            if (run_id, under) not in found.rows:
                yield f"{store.runs_place.below(run_id).where(under)}: no commit names it; ingest its log again"
    yield from (line for (run_id, _), line in found.damaged.items() if run_id not in wrong)


def verify_run(store: Store, run_id: str, recipe: str | None = None) -> Iterator[CheckResult]:
    """Yield the same of one run: its log's description, its streams, and what became of it under every recipe, or one."""
    place = store.runs_place.below(run_id)
    names = [entry.name for entry in place.entries()]
    there, last, folders = _list_documents(place), find_highest_numbers(names), place.folders()
    yield from _verify_seals(place, sorted(there))
    if "run" not in last:
        yield f"{place.where(name_document('run', 1))}: is missing"
    known = None
    for number in range(1, last.get("run", 0) + 1):
        with suppress(StoreError):
            known = read_as_at(place, name_document("run", number), RunJson)
            there |= set(known.streams)
    yield from _isolate_errors(_verify_streams(place, known))
    recipes = [name for name in folders if name != _STREAMS and find_highest_numbers(place.files(name)).get("manifest")]
    for name in recipes if recipe is None else [recipe]:
        yield from _isolate_errors(_make_ingestion(store.runs_place, run_id, name))
    if not recipes:
        yield f"{place.where()}: contains no finished run; ingest its log again"
    for name in names:
        if name not in there and name.partition("/")[0] not in recipes:
            yield _describe_stranger(place, name)


def _list_documents(place: Place) -> set[str]:
    return {name for name in place.files() if split_number(name) or name == _REPORT}


def _verify_seals(place: Place, names: Iterable[str]) -> Iterator[CheckResult]:
    for name in names:
        yield find_broken_seal_in(place.read(name), place.where(name)) or ("files", 1)


def _verify_maps(store: Store) -> Iterator[CheckResult]:
    place = store.place.below("maps")
    known = _list_documents(place)
    yield from _verify_seals(place, sorted(known))
    for name, last in find_highest_numbers(known).items():
        for number in range(1, last + 1):
            with suppress(StoreError):
                known |= set(read_as_at(place, name_document(name, number), MapDocument).checksums)
        yield from _isolate_errors(_verify_stored_map(store, name))
    for entry in place.entries():
        if entry.name not in known:
            yield _describe_stranger(place, entry.name)


def _verify_stored_map(store: Store, name: str) -> Iterator[CheckResult]:
    yield "maps", 1
    place, document = store.place.below("maps"), store.map_document(name)
    wrong = list(find_wrong_files(place, document.checksums))
    yield from wrong
    yield "files", len(document.checksums)
    if not wrong:
        path, fetched = store.map_files(name)
        yield from _verify_tiles(path, fetched)
        if document.picture in document.checksums and not is_picture_of_map(store.map_picture(name), path):
            yield f"{place.where(document.picture)}: does not show the map as it is; add the map again with --force"


def _describe_stranger(place: Place, name: str) -> str:
    """Return a line about what no document knows."""
    if any(_DIGEST.fullmatch(part) for part in name.split("/")):
        return f"{place.where(name)}: was left by a killed command; 'tcpipe prune' removes it"
    return f"{place.where(name)}: is no file of this store"


def _find_left_behind(root: Path) -> Iterator[str]:
    for path in sorted(root.glob(f"{TEMPORARY_PREFIX}*")):
        if is_abandoned(path):
            yield f"{path}: was left by a killed command; the next tcpipe ingest or add-map removes it"


def find_strangers(place: Place) -> Iterator[str]:
    """Yield what no call of tcpipe has written into the directory of a run, or of one of its ingestions."""
    known = {f"{role}.parquet" for role in STREAMS} | {f"{name}.parquet" for name in _TABLES} | {_REPORT}
    names = ((entry.name, entry.name.rpartition("/")[2]) for entry in place.entries())
    yield from (place.where(name) for name, last in names if last not in known and not split_number(last))


def verify_map(path: Path) -> Iterator[CheckResult]:
    """Yield the same of one map: every file, and every tile of every layer and level decoded."""
    yield "maps", 1
    place, checksums = Place(path), read_checksums(path)
    yield from find_wrong_files(place, checksums)
    yield "files", len(checksums) + 1
    for entry in place.entries():
        if entry.name not in {*checksums, CHECKSUMS}:
            yield _describe_stranger(place, entry.name)
    yield from _verify_tiles(path)


def _verify_tiles(path: Path, fetched: FetchedShards | None = None) -> Iterator[CheckResult]:
    source = open_map(path, fetched, proved=False)
    for factor in source.factors:
        level = source if factor == 1 else source.at(factor)
        for layer in source.layers:
            yield from _verify_layer(path, level, layer, None if factor > 1 else source.facts.covered[layer])
    for bands in source.banded.values():
        for row in range(0, bands.grid.rows, bands.tile_px):
            for col in range(0, bands.grid.cols, bands.tile_px):
                try:
                    bands.read(row, row + bands.tile_px, col, col + bands.tile_px)
                    yield "tiles", len(bands.layer.bands)
                except TcpipeError as error:
                    yield from error.problems


def _isolate_errors(findings: Iterator[CheckResult]) -> Iterator[CheckResult]:
    """Turn an error into problems, so that one damaged run or map does not hide the others."""
    try:
        yield from findings
    except TcpipeError as error:
        yield from error.problems


def _verify_streams(place: Place, known: RunJson | None) -> Iterator[CheckResult]:
    checksums = known.streams if known else {}
    wrong = list(find_wrong_files(place, checksums))
    yield from wrong
    yield "files", len(checksums)
    for name, of in checksums.items() if not wrong else ():
        table = read_table(place.local(name, of)).replace_schema_metadata(None)
        try:
            STREAMS[PurePosixPath(name).stem].check(table)
        except TcpipeError as error:
            yield from (f"{place.where(name)}: {problem}" for problem in error.problems)
        yield "rows", table.num_rows


def _make_ingestion(runs: Place, run_id: str, recipe_name: str) -> Iterator[CheckResult]:
    """Compare what a run became under one recipe with its manifest."""
    yield "runs", 1
    place = runs.below(f"{run_id}/{recipe_name}")
    last = name_document("manifest", find_highest_numbers(place.files())["manifest"])
    document, where = read_sealed_at(place, last), place.where(last)
    if document["data_model_version"] not in READ_VERSIONS:
        yield (
            f"{where}: of data model {document['data_model_version']}, this version knows {DATA_MODEL_VERSION}; "
            "ingest the log again, then remove this directory"
        )
        return
    manifest, recipe = parse_typed(document, Manifest, where), document["recipe"]
    of = (ingest_key(recipe), make_recipe_id(recipe, manifest.robot)) if isinstance(recipe, Mapping) else None
    if of != (manifest.ingest_key, recipe_name):
        yield f"{where}: its recipe is not the one that the directory is named after"
    wrong = list(find_wrong_files(place, manifest.checksums))
    yield from wrong
    yield "files", len(manifest.checksums)
    yield from _verify_others(place, manifest)
    run = RunDirectory(run_id, recipe_name, runs, make_run_facts(manifest, last, {}), ((0, time.time_ns()),))
    yield from _verify_tables(run, where) if not wrong else ()


def _verify_others(place: Place, manifest: Manifest) -> Iterator[CheckResult]:
    """Yield what is wrong with the documents beside a manifest, and what no manifest knows."""
    documents = _list_documents(place)
    yield from _verify_seals(place, sorted(documents))
    known = {*documents, *manifest.checksums}
    for name in documents:
        with suppress(StoreError):
            known |= set(read_as_at(place, name, Manifest).checksums) if name != _REPORT else set()
    for entry in place.entries():
        if entry.name not in known:
            yield _describe_stranger(place, entry.name)


def _verify_tables(run: RunDirectory, where: str) -> Iterator[CheckResult]:
    tables = {}
    for name, schema in _TABLES.items():
        tables[name] = schema.add_missing_columns(run.table(name))
        try:
            schema.check(tables[name])
        except TcpipeError as error:
            yield from (f"{run.where}/{name}.parquet: {problem}" for problem in error.problems)
            return
        yield "rows", tables[name].num_rows
    yield from (f"{where}: {problem}" for problem in _find_disagreements(run, tables))
    yield from (f"{run.where}/segments.parquet: {problem}" for problem in _find_wrong_joins(run, tables))


def _find_disagreements(run: RunDirectory, tables: Mapping[str, pa.Table]) -> Iterator[str]:
    """Yield what the manifest says otherwise than its directory and its tables."""
    manifest = run.manifest
    for name, count in _COUNTS.items():
        said = getattr(manifest.counts, count)
        if said not in (None, tables[name].num_rows):
            yield f"{count} is {said}, but {name}.parquet has {tables[name].num_rows} rows"
    covered_m, kept_m = (
        math.fsum(to_floats(tables["segments"], "arc_length_m")),
        manifest.distance_by_reason_m.get(KEPT, 0.0),
    )
    if not math.isclose(covered_m, kept_m, rel_tol=1e-9, abs_tol=1e-6):
        yield f"the distance breakdown keeps {kept_m:.3f} m, the segments cover {covered_m:.3f} m"
    if manifest.run_id != run.run_id:
        yield f"is of run {manifest.run_id}, but is stored in {run.run_id}"


def _find_wrong_joins(run: RunDirectory, tables: Mapping[str, pa.Table]) -> Iterator[str]:
    """Yield what is wrong between segments and their run and track."""
    segments, run_id = tables["segments"], run.run_id
    start_ns, end_ns = (to_integers(segments, f"{end}_ns") for end in ("start", "end"))
    if segments.column("segment_id").to_pylist() != [f"{run_id}-{stamp}" for stamp in start_ns.tolist()]:
        yield "its segment ids are not the run's id and their start stamps"
    for column, wanted in (("run_id", run_id), ("robot", run.manifest.robot)):
        others = set(segments.column(column).unique().to_pylist()) - {wanted}
        if others:
            yield f"contains segments of {column} {', '.join(sorted(others))}; expected {wanted}"
    if len(start_ns) and (np.any(end_ns <= start_ns) or np.any(start_ns[1:] < end_ns[:-1])):
        yield "its segments do not follow one another in time"
    stamps = to_integers(tables["track"], "stamp_ns")
    if len(start_ns) and len(stamps) and (start_ns.min() < stamps.min() or end_ns.max() > stamps.max()):
        yield "its segments begin before the track or end after it"


def _verify_layer(path: Path, level: MapFile, layer: str, covered: float | None) -> Iterator[CheckResult]:
    """Decode every tile of a layer; compare its coverage with what was recorded, and its classes with the table."""
    grid, side, kind, with_data, highest = level.grid, level.tile_px, level.layers[layer], 0, 0
    for row in range(0, grid.rows, side):
        for col in range(0, grid.cols, side):
            try:
                tile = level.read(layer, row, min(row + side, grid.rows), col, min(col + side, grid.cols))
            except TcpipeError as error:
                yield from error.problems
                continue
            with_data += int(kind.has_data(tile).sum())
            highest = max(highest, int(tile.max(initial=0)) if kind.kind == "categorical" else 0)
            yield "tiles", 1
    share = with_data / (grid.rows * grid.cols)
    if covered is not None and not math.isclose(share, covered, rel_tol=1e-9):
        yield f"{path}: {layer} covers {share:.6%} of the map, {covered:.6%} when it was added; add the map again"
    if highest > kind.high:
        yield f"{path}: {layer} contains class {highest}, the table ends at {kind.high:g}"
