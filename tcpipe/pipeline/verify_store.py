"""A store, its maps and its runs, held against the checksums, counts and contracts that were written with them."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath

from tcpipe.errors import StoreError, TcpipeError
from tcpipe.formats.atomic import TEMPORARY_PREFIX, is_abandoned
from tcpipe.formats.commit_log import LOG, commit_name, make_snapshot_name, read_commit, read_snapshot
from tcpipe.formats.commits import Commit, State, fold
from tcpipe.formats.integrity import CHECKSUMS, Checksum, find_broken_seal, read_checksums
from tcpipe.formats.json_files import parse_typed
from tcpipe.formats.parquet import read_row_count
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
from tcpipe.store import Store
from tcpipe.tables.levels import DATA_MODEL_VERSION, READ_VERSIONS, STREAMS

CheckResult = tuple[str, int] | str

_COUNTS = {"track": "track_rows", "segments": "segments", "rejections": "rejections"}
_REPORT, _STREAMS = "report.html", "streams"
_DIGEST = re.compile(r"[0-9a-f]{16}")
_INDEX = "index"


def verify_store(store: Store) -> Iterator[CheckResult]:
    """Yield what was read of all maps and runs, and a line for everything that is not as it was written."""
    place = store.place
    yield find_broken_seal(place.read(MARK), place.where(MARK)) or ("files", 1)
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
    yield from verify_files(place, known.streams if known else {})
    recipes = [name for name in folders if name != _STREAMS and find_highest_numbers(place.files(name)).get("manifest")]
    for name in recipes if recipe is None else [recipe]:
        yield from _isolate_errors(_verify_ingestion(store.runs_place, run_id, name))
    if not recipes:
        yield f"{place.where()}: contains no finished run; ingest its log again"
    for name in names:
        if name not in there and name.partition("/")[0] not in recipes:
            yield _describe_stranger(place, name)


def _list_documents(place: Place) -> set[str]:
    return {name for name in place.files() if split_number(name) or name == _REPORT}


def _verify_seals(place: Place, names: Iterable[str]) -> Iterator[CheckResult]:
    for name in names:
        yield find_broken_seal(place.read(name), place.where(name)) or ("files", 1)


def _verify_maps(store: Store) -> Iterator[CheckResult]:
    place = store.place.below("maps")
    known = _list_documents(place)
    yield from _verify_seals(place, sorted(known))
    for name, last in find_highest_numbers(known).items():
        yield "maps", 1
        for number in range(1, last + 1):
            with suppress(StoreError):
                checksums = read_as_at(place, name_document(name, number), MapDocument).checksums
                known |= set(checksums)
                yield from verify_files(place, checksums) if number == last else ()
    yield from _find_strangers(place, known)


def verify_files(place: Place, checksums: Mapping[str, Checksum]) -> Iterator[CheckResult]:
    """Read files again and compare them with what a sealed document has of them."""
    yield from find_wrong_files(place, checksums)
    yield "files", len(checksums)


def _find_strangers(place: Place, known: Collection[str]) -> Iterator[str]:
    yield from (_describe_stranger(place, entry.name) for entry in place.entries() if entry.name not in known)


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
    known = {f"{role}.parquet" for role in STREAMS} | {f"{name}.parquet" for name in _COUNTS} | {_REPORT}
    names = ((entry.name, entry.name.rpartition("/")[2]) for entry in place.entries())
    yield from (place.where(name) for name, last in names if last not in known and not split_number(last))


def verify_map(path: Path) -> Iterator[CheckResult]:
    """Yield the same of one map."""
    yield "maps", 1
    place, checksums = Place(path), read_checksums(path)
    yield from verify_files(place, checksums)
    yield from _find_strangers(place, {*checksums, CHECKSUMS})


def _isolate_errors(findings: Iterator[CheckResult]) -> Iterator[CheckResult]:
    """Turn an error into problems, so that one damaged run or map does not hide the others."""
    try:
        yield from findings
    except TcpipeError as error:
        yield from error.problems


def _verify_ingestion(runs: Place, run_id: str, recipe_name: str) -> Iterator[CheckResult]:
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
    documents = _list_documents(place)
    yield from _verify_seals(place, sorted(documents))
    known = {*documents, *manifest.checksums}
    for name in documents - {_REPORT}:
        with suppress(StoreError):
            known |= set(read_as_at(place, name, Manifest).checksums)
    yield from _find_strangers(place, known)
    wrong = list(find_wrong_files(place, manifest.checksums))
    yield from wrong
    yield "files", len(manifest.checksums)
    for name, checksum in manifest.checksums.items() if not wrong else ():
        table, rows = PurePosixPath(name).stem, read_row_count(place.local(name, checksum))
        yield "rows", rows
        if (count := getattr(manifest.counts, _COUNTS[table])) not in (None, rows):
            yield f"{where}: {_COUNTS[table]} is {count}, but {table}.parquet has {rows} rows"
