"""Re-read all content of a path, and compare it with its recorded seals, checksums and counts."""

import itertools
from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from tcpipe.errors import StoreError, TcpipeError, UsageError, clean_lines
from tcpipe.formats.atomic import TEMPORARY_PREFIX, Location, find_leftovers, is_abandoned
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import CARD, SAMPLES, find_foreign_files, parse_card
from tcpipe.formats.documents import (
    BLOBS,
    INDEX,
    KINDS,
    RECORDS,
    Kind,
    State,
    find_strange_files,
    parse_name,
    read_record,
)
from tcpipe.formats.integrity import CHECKSUMS, Checksums, FileChecksums, find_broken_seal, read_checksums
from tcpipe.formats.json_files import parse_json, parse_typed
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.parquet import read_row_count, read_schema
from tcpipe.formats.place import REPORT, Place, find_wrong_files, is_desktop_file, open_place
from tcpipe.formats.published_outputs import CARDS, FoundCard, find_newest, find_unlisted_files
from tcpipe.formats.runs import Run, RunFacts
from tcpipe.formats.stored_runs import BLOB, find_unnamed, list_named_files, list_payload, read_records
from tcpipe.pipeline.calls import list_open_calls
from tcpipe.pipeline.problems import find_incomplete_runs
from tcpipe.store import Store, find_named_runs, is_store
from tcpipe.tables.findings import omit
from tcpipe.tables.levels import COORDINATES, DATA_MODEL_VERSION


@dataclass(frozen=True, slots=True)
class Repair:
    """How to repair the problems before it."""

    text: str


CheckResult = tuple[str, int] | str | Repair

_COUNTS = {"track": "track_rows", "segments": "segments", "rejections": "rejections"}
_KNOWN = "dataset, run, store, map (.zarr), model or cost map"
# Kind of a directory, by the document with the checksums of its files.
_KINDS = dict(zip(CARDS, ("dataset", "model", "cost map"), strict=True))
_HOW_MADE = {"dataset": "build", "model": "train", "cost map": "make"}
_KILLED = "was left by a killed command; 'tcpipe prune' removes it"
_INGEST = "run {}: copy the store again, or ingest the log again with --force"
_REPAIRS: Mapping[Kind, str] = {
    "calls": "remove it", "runs": "remove it and ingest its log again", "failed": "remove it and ingest its log again",
    "tags": "remove it and ingest its log again with --tag", "seen": "remove it",
    "acknowledged": "remove it and acknowledge the problem again", "maps": "remove it and add the map again",
    "outputs": "remove it and build the dataset again",
}  # fmt: skip
"""By kind of document: how to repair one that is damaged."""
_DESKTOP = "a file manager or a GIS program left it; tcpipe ignores it"


@dataclass(frozen=True, slots=True)
class Verified:
    """Number of files that were read again, and changed ones; the command prints its ``str``."""

    path: str
    kind: str
    """``dataset``, ``run``, ``store``, ``map``, ``model`` or ``cost map``."""
    read: Mapping[str, int]
    problems: tuple[str, ...]
    notes: tuple[str, ...] = omit(())
    """How to repair the problems."""

    @property
    def exit_code(self) -> int:
        """1 if anything is wrong."""
        return 1 if self.problems else 0

    def __str__(self) -> str:
        """Return a line with the amount read, and one for each problem."""
        read = ", ".join(f"{count} {what}" for what, count in self.read.items()) or "nothing"
        count = len(self.problems)
        verdict = f"{count} problem{'s' if count > 1 else ''}" if count else "no changes found"
        return clean_lines((f"{self.path}: {self.kind}; {read} read again: {verdict}", *self.problems, *self.notes))


def verify(path: Location, *, store: Location = "tcpipe-store") -> Verified:
    """Re-read a dataset, store, map, model or cost map (all but maps also at a URL), or a run of a ``store`` by name.

    Raises `UsageError`: the path is something else.
    """
    kind, findings = _find_kind(path, store)
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
    return Verified(str(path), kind, read, tuple(dict.fromkeys(problems)), tuple(dict.fromkeys(repairs)))


def _find_kind(path: Location, store: Location) -> tuple[str, Iterator[CheckResult]]:
    """Return the kind of a path, and an iterator of its findings."""
    if not is_url(path) and not Path(path).exists():
        place = Store(store).place
        return "run", _verify_runs(place, [(run.facts, run.document) for run in find_named_runs(path, store)])
    if is_store(path):
        return "store", _verify_store(Store(path))
    place = open_place(path)
    if place.path and place.path.resolve().suffix == ".zarr" and not (place.path.resolve().parent / CARD).is_file():
        return "map", _verify_map(place.path)
    found = find_newest(str(path), CARDS)
    if found is None:
        raise UsageError(f"{path}: is no {_KNOWN}; give one of these directories")
    return _KINDS[found.name], _verify_directory(found, str(path))


def _verify_directory(found: FoundCard, path: str) -> Iterator[CheckResult]:
    """Yield the amount read of the files in a card, and a line for each difference from the card."""
    place, where, kind = found.place, found.place.where(found.name), _KINDS[found.name]
    repair = f"{path}: copy it again, or {_HOW_MADE[kind]} it again"
    if broken := find_broken_seal(found.data, where):
        yield from (broken, Repair(f"{repair} elsewhere"))  # its checksums do not cover the other files
        return
    yield "files", 1
    if kind == "dataset":
        yield find_broken_seal(place.read(REPORT), place.where(REPORT)) or ("files", 1)
        card = parse_card(found.data, where, proved=False)
    checksums = parse_typed(parse_json(found.data, where), Checksums, where).checksums
    is_whole = yield from _verify_files(place, checksums, f"{repair} with --force")
    is_local = kind == "dataset" and place.path is not None
    for name in find_foreign_files(Path(path), checksums) if is_local else find_unlisted_files(path):
        full = place.where(name) if is_local else name
        yield Repair(f"{full}: {_DESKTOP}") if is_desktop_file(name) else f"{full}: is no file of this {kind}"
    if kind == "dataset" and is_whole:  # unlisted files are not decompressed
        yield from _verify_counts(place.fetch(SAMPLES, checksums[SAMPLES]), card, where)


def _verify_counts(samples: Path, card: DatasetCard, where: str) -> Iterator[CheckResult]:
    """Compare how many samples there are, and with a card without coordinates the columns."""
    rows = read_row_count(samples)
    yield "samples", rows
    counts = {"splits": sum(card.splits.values()), "runs": sum(run.samples for run in card.runs)}
    for name, count in {"samples": card.samples, **counts}.items():
        if count != rows:
            yield f"{where}: {name} has {count} samples, but {SAMPLES} has {rows}"
    coordinates = [name for name in read_schema(samples).names if name in COORDINATES]
    if card.without_coordinates and coordinates:
        columns = ", ".join(coordinates)
        yield f"{where}: states that it has no coordinates, but {SAMPLES} has the columns {columns}; build it again"


def _verify_files(place: Place, checksums: FileChecksums, repair: str) -> Generator[CheckResult, None, bool]:
    """Read files again, compare them with their document, and return whether all are unchanged."""
    wrong = list(find_wrong_files(place, checksums))
    yield from wrong
    if wrong:
        yield Repair(repair)
    yield "files", len(checksums)
    return not wrong


def _verify_map(path: Path) -> Iterator[CheckResult]:
    """Yield the same of one map."""
    yield "maps", 1
    place, checksums = Place(path), read_checksums(path)
    yield from _verify_files(place, checksums, f"{path}: copy it again, or add the map again with --force")
    foreign = [entry.name for entry in place.entries() if entry.name not in {*checksums, CHECKSUMS}]
    yield from (f"{place.where(name)}: is no file of this map" for name in foreign if not is_desktop_file(name))


def _verify_store(store: Store) -> Iterator[CheckResult]:
    """Yield the amount read of all documents and payload, and a line for each change since they were written."""
    place, state = store.place, store.scan()
    yield from _verify_documents(place)
    yield from _verify_page(place)
    rows = [(row, state.names["runs", key]) for key, row in state.runs.items() if row.blob and state.has_payload(row)]
    yield from _verify_runs(place, sorted(rows, key=lambda row: (row[0].run_id, row[0].recipe_id)))
    for problem in find_incomplete_runs(state):
        missing = place.where(problem.finding.names["file"])
        yield from (f"{missing}: is missing (run {problem.run_id})", Repair(_INGEST.format(problem.run_id)))
    for each in state.maps.values():
        yield "maps", 1
        repair = f"map {each.name}: copy the store again, or add the map again with --force"
        yield from _verify_files(place.below(f"{BLOBS}/{each.blob}"), each.files, repair)
    yield from _verify_names(place, state)


def _verify_documents(place: Place) -> Iterator[CheckResult]:
    """Read every document and compare it with its name."""
    for kind in KINDS:
        names = [str(name) for file in place.list(kind) if (name := parse_name(kind, file)) is not None]
        yield "documents", len(names)
        damaged = place.map(lambda name, kind=kind: _is_damaged(place, kind, name), names)  # type: ignore[misc]
        for where in map(place.where, itertools.compress(names, damaged)):
            yield f"{where}: is missing or has changed since it was written"
            yield Repair(f"{where}: copy it again, or {_REPAIRS[kind]}")


def _is_damaged(place: Place, kind: Kind, name: str) -> bool:
    try:
        read_record(place, name, RECORDS[kind])
    except StoreError:
        return True
    return False


def _verify_page(place: Place) -> Iterator[CheckResult]:
    page, where = place.read(REPORT), place.where(REPORT)
    if page is not None:
        broken = find_broken_seal(page, where)
        yield from (broken, Repair(f"{where}: 'tcpipe report' writes it again")) if broken else (("files", 1),)


def _verify_runs(place: Place, runs: Iterable[tuple[RunFacts, str]]) -> Iterator[CheckResult]:
    """Compare the payload of runs, and the page of each, with their manifests; streams of several runs once."""
    known = set[str]()
    for row, document in runs:
        yield "runs", 1
        repair, folder = _INGEST.format(f"{row.run_id}/{row.recipe_id}"), place.below(f"{BLOBS}/{row.blob}")
        if row.streams_blob not in known:
            known.add(row.streams_blob)
            yield from _verify_files(place.below(f"{BLOBS}/{row.streams_blob}"), row.streams, repair)
        is_whole = yield from _verify_files(folder, row.tables, repair)
        yield from _verify_page(folder)
        if row.data_model_version != DATA_MODEL_VERSION:
            yield (
                f"run {row.run_id}/{row.recipe_id}: is of data model {row.data_model_version}, this version reads "
                f"{DATA_MODEL_VERSION}; ingest its log again"
            )
        elif is_whole:
            try:
                yield from _verify_rows(place, row, document)
            except TcpipeError as error:  # one damaged run does not hide the others
                yield from error.problems
                yield Repair(repair)


def _verify_rows(place: Place, row: RunFacts, document: str) -> Iterator[CheckResult]:
    """Compare the number of rows of each table with the manifest."""
    counts = read_record(place, document, Run).counts
    for name, checksum in row.tables.items():
        table = PurePosixPath(name).stem
        rows = read_row_count(place.below(f"{BLOBS}/{row.blob}").fetch(name, checksum, proved=False))
        yield "rows", rows
        if (count := getattr(counts, _COUNTS[table])) not in (None, rows):
            yield f"{place.where(document)}: {_COUNTS[table]} is {count}, but {table}.parquet has {rows} rows"


def _verify_names(place: Place, state: State) -> Iterator[CheckResult]:
    """Yield unreferenced payload, unless a call is running, and files that tcpipe did not write."""
    foreign = [name for name in place.list() if name not in (*KINDS, BLOBS, INDEX, REPORT)]
    foreign += find_strange_files(place)
    foreign += [f"{BLOBS}/{name}" for name in place.list(BLOBS) if not BLOB.fullmatch(name)]
    is_no_call_running = all(call.state == "killed" for call in list_open_calls(state))
    leftovers = [
        str(path) for path in (place.path.glob(f"{TEMPORARY_PREFIX}*") if place.path else ()) if is_abandoned(path)
    ]
    for each in find_unnamed(list_payload(place), list_named_files(read_records(place, state)[0])):
        if each.foreign and each.name.endswith(each.foreign):
            foreign.append(each.name)
        elif is_no_call_running:
            leftovers.append(place.where(each.name))
    yield from (f"{name}: {_KILLED}" for name in sorted(leftovers))
    for name in foreign:
        line = f"{place.where(name)}: is no file of this store"
        yield Repair(line) if is_desktop_file(name) else line
