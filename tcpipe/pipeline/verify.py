"""Re-read everything a path holds and compare it with what was written down about it: seals, checksums, counts."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from tcpipe.errors import StoreError, TcpipeError, UsageError, clean_lines
from tcpipe.formats.atomic import TEMPORARY_PREFIX, find_leftovers, is_abandoned
from tcpipe.formats.bucket_directories import CARDS, FoundCard, find_newest, find_unlisted_files
from tcpipe.formats.commit_log import COMMIT, LOG, SNAPSHOT, make_snapshot_name, read_snapshot, refresh
from tcpipe.formats.commits import State
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import CARD, REPORT, SAMPLES, find_foreign_files, is_desktop_file, parse_card
from tcpipe.formats.integrity import CHECKSUMS, Checksum, Checksums, find_broken_seal, read_checksums
from tcpipe.formats.json_files import parse_json, parse_typed
from tcpipe.formats.object_storage import is_bucket, is_url
from tcpipe.formats.parquet import read_row_count, read_table
from tcpipe.formats.place import Place, find_wrong_files, open_place
from tcpipe.formats.recipe_toml import ingest_key, make_recipe_id
from tcpipe.formats.run_documents import (
    COPY_MARK,
    MARK,
    Manifest,
    MapDocument,
    RunJson,
    find_highest_numbers,
    name_document,
    read_as_at,
    read_sealed_at,
    split_number,
)
from tcpipe.pipeline.dataset.redaction import find_leaks
from tcpipe.store import Store, find_store_above, is_store
from tcpipe.tables.facts import LEFT_OUT
from tcpipe.tables.levels import DATA_MODEL_VERSION


@dataclass(frozen=True, slots=True)
class Repair:
    """How to repair the problems before it."""

    text: str


CheckResult = tuple[str, int] | str | Repair

_COUNTS = {"track": "track_rows", "segments": "segments", "rejections": "rejections"}
_STREAMS = "streams"
_DIGEST = re.compile(r"[0-9a-f]{16}")
_INDEX = "index"
_KNOWN = "dataset, run, store, map (.zarr), model or cost map"

_KINDS = dict(zip(CARDS, ("dataset", "model", "cost map"), strict=True))
"""Kind of a directory, by the document with the checksums of its files."""

_HOW_MADE = {"dataset": "build", "model": "train", "cost map": "make"}

_KILLED = "was left by a killed command; 'tcpipe prune' removes it"
_DESKTOP = "a file manager or a GIS program left it; tcpipe ignores it"


@dataclass(frozen=True, slots=True)
class Verified:
    """Number of files that were read again, and changed ones; the command prints its ``str``."""

    path: str
    kind: str
    """``dataset``, ``run``, ``store``, ``map``, ``model`` or ``cost map``."""
    read: Mapping[str, int]
    problems: tuple[str, ...]
    notes: tuple[str, ...] = field(default=(), metadata=LEFT_OUT)
    """How to repair the problems; limits of a redacted dataset."""

    def __str__(self) -> str:
        """Return a line of what was read, and one for each problem."""
        read = ", ".join(f"{count} {what}" for what, count in self.read.items()) or "nothing"
        count = len(self.problems)
        verdict = f"{count} problem{'s' if count > 1 else ''}" if count else "no changes found"
        return clean_lines((f"{self.path}: {self.kind}; {read} read again: {verdict}", *self.problems, *self.notes))


def verify(path: Path | str) -> Verified:
    """Re-read a dataset, a run, a store, a map, a model or a cost map; all but a map also at a URL.

    Raises `UsageError`: the path is none of these.
    """
    if not is_url(path) and not Path(path).exists():
        raise UsageError(f"{path}: there is no such directory; give a {_KNOWN}")
    kind, findings, notes = _find_kind(path)
    read: dict[str, int] = {}
    problems, repairs = list[str](), list[str]()
    try:
        for finding in findings:
            if isinstance(finding, str):
                problems.append(finding)
            elif isinstance(finding, Repair):
                repairs.append(finding.text)
            else:
                read[finding[0]] = read.get(finding[0], 0) + finding[1]
    except TcpipeError as error:
        problems += error.problems
    if kind not in ("store", "run") and not is_url(path):
        again = "the next command that writes it removes it"
        problems += [f"{left}: was left by a killed command; {again}" for left in find_leftovers(Path(path))]
    return Verified(str(path), kind, read, tuple(dict.fromkeys(problems)), (*dict.fromkeys(repairs), *notes))


def _find_kind(path: Path | str) -> tuple[str, Iterator[CheckResult], tuple[str, ...]]:
    """Return what a path is, its findings, which are made as they are asked for, and notes."""
    if inside := find_store_above(path):
        return "run", _verify_run(*inside), ()
    above, _, last = str(path).rstrip("/").rpartition("/")
    for root in (path, *([above] if above and last in (LOG, "maps") else [])):  # which lie in a store
        if is_store(root):
            return "store", _verify_store(Store(root if is_url(root) else Path(root))), ()
    place = open_place(path)
    if place.path and place.path.resolve().suffix == ".zarr" and not (place.path.resolve().parent / CARD).is_file():
        return "map", _verify_map(place.path), ()
    found = find_newest(str(path), CARDS)
    if found is None:
        raise UsageError(f"{path}: is no {_KNOWN}; give one of these directories")
    card: DatasetCard | None = None
    with suppress(TcpipeError):  # a problem that is found again
        card = parse_card(found.data, found.place.where(CARD), proved=False) if found.name == CARD else None
    redaction = None if card is None else card.redaction
    notes = () if redaction is None else ("It is redacted.", *redaction.lines())
    return _KINDS[found.name], _verify_directory(found, str(path)), notes


def _verify_directory(found: FoundCard, path: str) -> Iterator[CheckResult]:
    """Yield what was read of the files that a card lists, and a line for everything that is not as it says."""
    place, where, kind = found.place, found.place.where(found.name), _KINDS[found.name]
    repair = f"{path}: copy it again, or {_HOW_MADE[kind]} it again"
    if broken := find_broken_seal(found.data, where):
        yield from (broken, Repair(f"{repair} elsewhere"))  # its checksums say nothing of the other files
        return
    yield "files", 1
    if kind == "dataset":
        yield find_broken_seal(place.read(REPORT), place.where(REPORT)) or ("files", 1)
        card = parse_card(found.data, where, proved=False)
    checksums = parse_typed(parse_json(found.data, where), Checksums, where).checksums
    wrong = list(find_wrong_files(place, checksums))
    yield from _repair_by(Repair(f"{repair} with --force"), wrong)
    yield "files", len(checksums)
    is_local = kind == "dataset" and place.path is not None
    for name in find_foreign_files(Path(path), checksums) if is_local else find_unlisted_files(path):
        full = place.where(name) if is_local else name
        yield Repair(f"{full}: {_DESKTOP}") if is_desktop_file(name) else f"{full}: is no file of this {kind}"
    if is_bucket(path):
        yield from (line for line in _verify_log(open_place(path)) if isinstance(line, str))
    if kind == "dataset" and not wrong:  # what nobody knows is not unfolded
        yield from _verify_counts(place.proved(SAMPLES, checksums[SAMPLES]), card, where)


def _verify_counts(samples: Path, card: DatasetCard, where: str) -> Iterator[CheckResult]:
    """Compare how many samples there are; of a redacted dataset also that it reveals nothing."""
    rows = read_row_count(samples)
    yield "samples", rows
    counts = {"splits": sum(card.splits.values()), "runs": sum(run.samples for run in card.runs)}
    for name, count in {"samples": card.samples, **counts}.items():
        if count != rows:
            yield f"{where}: {name} has {count} samples, but {SAMPLES} has {rows}"
    if card.redaction is not None:
        table = read_table(samples)
        yield from (f"{where}: it is marked as redacted, but {leak}" for leak in find_leaks(card, table))


def _verify_store(store: Store) -> Iterator[CheckResult]:
    """Yield what was read of all maps and runs, and a line for everything that is not as it was written."""
    place = store.place
    yield from _verify_seals(place, [MARK], Repair(f"{place.where(MARK)}: {COPY_MARK}"))
    for name in place.files():
        if name == REPORT:
            yield from _verify_seals(place, [name], Repair(f"{place.where(name)}: 'tcpipe report' writes it again"))
        elif name != MARK:
            yield _describe_stranger(place, name)
    for name in place.folders():
        if name not in (LOG, "maps", "runs", _INDEX) and place.entries(name):
            yield _describe_stranger(place, name)
    yield from _verify_log(place)
    yield from _verify_maps(store)
    yield from _verify_runs(store)
    yield from _find_left_behind(place.path) if place.path else ()


def _verify_log(place: Place) -> Iterator[CheckResult]:
    """Yield how many commits a place has, and what is wrong with them and with snapshots."""
    log, state = place.below(LOG), refresh(place, State())
    yield "commits", state.number - len(state.problems)
    wrong = {"commit-missing": "is missing", "commit-damaged": "has changed, or does not follow the commit before"}
    yield from (f"{problem.log[0]}: {wrong[problem.finding.code]}" for problem in state.problems)
    lost, snapshots = len(state.problems), [name for name in log.files() if name.startswith(SNAPSHOT)]
    for name in snapshots:
        if name > make_snapshot_name(state.number):  # the last commits are missing
            yield f"{log.where(name.removeprefix(SNAPSHOT).removesuffix('.zst'))}: is missing"
            lost += 1
    if lost:
        yield Repair(
            f"{log.where()}: copy the store again, or ingest all logs again and acknowledge the commits; what a later snapshot has is kept"
        )
    for name in log.files():
        if name in snapshots:
            repair = Repair(f"{log.where(name)}: remove it; the commits say the same")
            yield from _isolate_errors(_verify_snapshot(log, name), repair)
        elif not COMMIT.fullmatch(name):
            yield _describe_stranger(log, name)


def _repair_by(repair: Repair, findings: Iterable[CheckResult]) -> Iterator[CheckResult]:
    """Yield findings, and after each problem how to repair it."""
    for finding in findings:
        yield from (finding, repair) if isinstance(finding, str) else (finding,)


def _verify_snapshot(log: Place, name: str) -> Iterator[CheckResult]:
    read_snapshot(log, name)
    yield "files", 1


def _verify_runs(store: Store) -> Iterator[CheckResult]:
    """Yield the same of all runs, of those that the log names and of which files are gone, and of ingestions that no commit names."""
    wrong, found = set[str](), store.ingestions()
    pruned = found.superseded.keys() - {run_id for run_id, _ in found.rows}
    for run_id in store.run_ids():
        if run_id in pruned:
            yield f"{store.runs_place.where(run_id)}: {_KILLED}"
            continue
        for finding in _verify_run(store, run_id):
            wrong |= {run_id} if isinstance(finding, str) else set()
            yield finding
        for under in store.read_rows(run_id):
            if (run_id, under) not in found.rows:
                how = _KILLED if (run_id, under) in found.state.pruned else "no commit names it; ingest its log again"
                yield f"{store.runs_place.below(run_id).where(under)}: {how}"
    yield from (line for (run_id, _), line in found.damaged.items() if run_id not in wrong)


def _verify_run(store: Store, run_id: str, recipe: str | None = None) -> Iterator[CheckResult]:
    """Yield the same of one run: its log's description, its streams, and what became of it under every recipe, or one."""
    place = store.runs_place.below(run_id)
    names = [entry.name for entry in place.entries()]
    there, last, folders = _list_documents(place), find_highest_numbers(names), place.folders()
    repair = _describe_ingesting(place)
    yield from _verify_seals(place, sorted(there), repair)
    if "run" not in last:
        yield from (f"{place.where(name_document('run', 1))}: is missing", repair)
    known = None
    for number in range(1, last.get("run", 0) + 1):
        with suppress(StoreError):
            known = read_as_at(place, name_document("run", number), RunJson)
            there |= set(known.streams)
    yield from _verify_files(place, known.streams if known else {}, repair)
    recipes = [name for name in folders if name != _STREAMS and find_highest_numbers(place.files(name)).get("manifest")]
    for name in recipes if recipe is None else [recipe]:
        yield from _isolate_errors(_verify_ingestion(store.runs_place, run_id, name), repair)
    if not recipes:
        yield f"{place.where()}: contains no finished run; ingest its log again"
    for name in names:
        if name not in there and name.partition("/")[0] not in recipes:
            yield _describe_stranger(place, name)


def _describe_ingesting(place: Place) -> Repair:
    return Repair(f"{place.where()}: remove .json files that have changed, then ingest its log again with --force")


def _list_documents(place: Place) -> set[str]:
    return {name for name in place.files() if split_number(name) or name == REPORT}


def _verify_seals(place: Place, names: Iterable[str], repair: Repair) -> Iterator[CheckResult]:
    lines = (find_broken_seal(place.read(name), place.where(name)) or ("files", 1) for name in names)
    yield from _repair_by(repair, lines)


def _verify_maps(store: Store) -> Iterator[CheckResult]:
    place = store.place.below("maps")
    known = _list_documents(place)
    repair = Repair(f"{place.where()}: remove .json files that have changed, then add the map again with --force")
    yield from _verify_seals(place, sorted(known), repair)
    for name, last in find_highest_numbers(known).items():
        yield "maps", 1
        for number in range(1, last + 1):
            with suppress(StoreError):
                checksums = read_as_at(place, name_document(name, number), MapDocument).checksums
                known |= set(checksums)
                yield from _verify_files(place, checksums, repair) if number == last else ()
    yield from _find_strangers(place, known)


def _verify_files(place: Place, checksums: Mapping[str, Checksum], repair: Repair) -> Iterator[CheckResult]:
    """Read files again and compare them with what a sealed document has of them."""
    yield from _repair_by(repair, find_wrong_files(place, checksums))
    yield "files", len(checksums)


def _find_strangers(place: Place, known: Collection[str]) -> Iterator[str]:
    yield from (_describe_stranger(place, entry.name) for entry in place.entries() if entry.name not in known)


def _describe_stranger(place: Place, name: str) -> str:
    """Return a line about what no document knows."""
    if any(_DIGEST.fullmatch(part) for part in name.split("/")):
        return f"{place.where(name)}: {_KILLED}"
    return f"{place.where(name)}: is no file of this store"


def _find_left_behind(root: Path) -> Iterator[str]:
    for path in sorted(root.glob(f"{TEMPORARY_PREFIX}*")):
        if is_abandoned(path):
            yield f"{path}: was left by a killed command; the next tcpipe ingest or add-map removes it"


def _verify_map(path: Path) -> Iterator[CheckResult]:
    """Yield the same of one map."""
    yield "maps", 1
    place, checksums = Place(path), read_checksums(path)
    yield from _verify_files(place, checksums, Repair(f"{path}: copy it again, or add the map again with --force"))
    yield from _find_strangers(place, {*checksums, CHECKSUMS})


def _isolate_errors(findings: Iterator[CheckResult], repair: Repair) -> Iterator[CheckResult]:
    """Turn an error into problems, so that one damaged run or map does not hide the others."""
    try:
        yield from findings
    except TcpipeError as error:
        yield from _repair_by(repair, error.problems)


def _verify_ingestion(runs: Place, run_id: str, recipe_name: str) -> Iterator[CheckResult]:
    """Compare what a run became under one recipe with its manifest."""
    yield "runs", 1
    place = runs.below(f"{run_id}/{recipe_name}")
    last = name_document("manifest", find_highest_numbers(place.files())["manifest"])
    document, where = read_sealed_at(place, last), place.where(last)
    if document["data_model_version"] != DATA_MODEL_VERSION:
        yield (
            f"{where}: of data model {document['data_model_version']}, this version knows {DATA_MODEL_VERSION}; "
            "ingest the log again, then remove this directory"
        )
        return
    manifest, recipe = parse_typed(document, Manifest, where), document["recipe"]
    keys = (ingest_key(recipe), make_recipe_id(recipe, manifest.robot)) if isinstance(recipe, Mapping) else None
    if keys != (manifest.ingest_key, recipe_name):
        yield f"{where}: its recipe is not the one that the directory is named after"
    documents, repair = _list_documents(place), _describe_ingesting(runs.below(run_id))
    yield from _verify_seals(place, sorted(documents), repair)
    known = {*documents, *manifest.checksums}
    for name in documents - {REPORT}:
        with suppress(StoreError):
            known |= set(read_as_at(place, name, Manifest).checksums)
    yield from _find_strangers(place, known)
    wrong = list(find_wrong_files(place, manifest.checksums))
    yield from _repair_by(repair, wrong)
    yield "files", len(manifest.checksums)
    for name, checksum in manifest.checksums.items() if not wrong else ():
        table, rows = PurePosixPath(name).stem, read_row_count(place.local(name, checksum))
        yield "rows", rows
        if (count := getattr(manifest.counts, _COUNTS[table])) not in (None, rows):
            yield f"{where}: {_COUNTS[table]} is {count}, but {table}.parquet has {rows} rows"
