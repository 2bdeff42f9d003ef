"""The documents of a store, and the state that they describe together.

::

    runs/0123456789abcdef.2.fedcba9876543210.json    kind / key . number . digest; written once and never changed
    blobs/5f0c6a7be1d29c04/segments.parquet          payload in a folder with a random name; a document names the folder
    index.parquet                                    cache of the documents' content, by name; it may be deleted

Rules (ADR-36):

1. Bytes whose sha256 does not begin with the digest in their name are no document: they are damaged, or copied in part.
2. For each kind and key the document with the highest number counts; of several with this number, the one with the
smallest digest.
   A writer uses 1 + the highest number that it saw.
3. The payload is written first, into a folder with a fresh random name; then the document that names the folder.
4. A call writes number 1 of its document before it scans, and number 2 when it ends.
5. The state is a function of the documents: `scan` computes it, and nothing else is stored.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar, cast, get_args

import pyarrow as pa

from tcpipe import __version__
from tcpipe.errors import StoreError
from tcpipe.formats.integrity import compute_short_digest
from tcpipe.formats.json_files import parse_typed_json, to_compact_json, to_json
from tcpipe.formats.parquet import read_parquet_bytes, write_parquet_bytes
from tcpipe.formats.place import Place
from tcpipe.formats.runs import Call, LogFailure, LogSnapshot, Output, Problem, RunFacts, StoredMap, Tags, find_lineage
from tcpipe.progress import logger
from tcpipe.tables.findings import Subject, make_finding

Kind: TypeAlias = Literal["calls", "runs", "failed", "tags", "seen", "acknowledged", "maps", "outputs"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""In the order in which they are listed: calls first, so that a call that ends later is seen as open."""
BLOBS = "blobs"
INDEX = "index.parquet"
Record: TypeAlias = Call | RunFacts | LogFailure | Tags | LogSnapshot | Problem | StoredMap | Output
RECORDS: Mapping[Kind, type[Record]] = {
    "calls": Call, "runs": RunFacts, "failed": LogFailure, "tags": Tags, "seen": LogSnapshot, "acknowledged": Problem, "maps": StoredMap,
    "outputs": Output,
}  # fmt: skip
_NAME = re.compile(r"([0-9a-f]{16})\.([0-9]{1,9})\.([0-9a-f]{16})\.json")
_UNREAD = 16
_UNREAD_SHARE = 50  # the index is rewritten if it lacks more than 16 documents, plus one for each 50 in it

_SEAL = b"sha256"  # key of the metadata of the index

T = TypeVar("T")


class Name(NamedTuple):
    """The name of a document."""

    kind: Kind
    key: str
    number: int
    digest: str

    def __str__(self) -> str:
        """Return the name in the store."""
        return f"{self.kind}/{self.key}.{self.number}.{self.digest}.json"


def parse_name(kind: Kind, file: str) -> Name | None:
    """Return the parts of a name in the folder of a kind; None for a file that is no document."""
    found = _NAME.fullmatch(file)
    return Name(kind, found[1], int(found[2]), found[3]) if found else None


def make_key(*parts: str | None) -> str:
    """Return the key of a document about something."""
    return compute_short_digest(to_compact_json(parts))


def make_run_key(sha256: str, recipe_id: str) -> str:
    """Return the key of the run of a content under a recipe."""
    return make_key(sha256, recipe_id)


@dataclass(slots=True)
class State:
    """The current record of each kind and key in a store, and the names of the documents that are not current."""

    facts: dict[Kind, dict[str, Any]] = field(default_factory=lambda: {kind: {} for kind in KINDS})
    names: dict[tuple[Kind, str], str] = field(default_factory=dict)
    """Names of the documents that count."""
    highest: dict[tuple[Kind, str], int] = field(default_factory=dict)
    """The highest number of each kind and key, also of damaged documents."""
    replaced: list[str] = field(default_factory=list)
    """Names of the documents that do not count."""
    damaged: list[str] = field(default_factory=list)
    """Names of documents that are not as they were written."""
    blobs: frozenset[str] = frozenset()
    """Folders of payload that are there."""
    is_new: bool = True
    """Whether there is no document at all."""
    read: int = 0
    """Documents that are not in the index."""
    _joined: dict[str, RunFacts] | None = None

    @property
    def runs(self) -> dict[str, RunFacts]:
        """Runs by key, with tags and supersession; those that are superseded or pruned too."""
        if self._joined is None:
            self._joined = self._join_runs()
        return self._joined

    @property
    def failed(self) -> dict[str, LogFailure]:
        """Failures by key."""
        return self.facts["failed"]

    @property
    def acknowledged(self) -> set[str]:
        """Keys of the problems that a person has acknowledged."""
        return {problem.key for problem in self.facts["acknowledged"].values()}

    @property
    def maps(self) -> dict[str, StoredMap]:
        """Maps by name, sorted."""
        found = {each.name: each for each in self.facts["maps"].values()}
        return {name: found[name] for name in sorted(found)}

    @property
    def outputs(self) -> dict[str, Output]:
        """Outputs by path or URL, sorted."""
        found = {each.where: each for each in self.facts["outputs"].values()}
        return {where: found[where] for where in sorted(found)}

    @property
    def calls(self) -> list[tuple[str, Call]]:
        """Calls with their keys, the latest first."""
        return sorted(self.facts["calls"].items(), reverse=True)

    @property
    def problems(self) -> list[Problem]:
        """Documents that are damaged."""
        return [
            Problem(make_finding("document-damaged", Subject("file", name)), name, (name,))
            for name in sorted(self.damaged)
        ]

    def _join_runs(self) -> dict[str, RunFacts]:
        """Return the runs with the tags of their logs, and with the run that supersedes them.

        Of runs of one robot and recipe that begin with the same measurements the longest recording counts whose payload
        is there.
        """
        longest, joined = dict[Beginning, RunFacts](), dict[str, RunFacts]()
        rows: Mapping[str, RunFacts] = self.facts["runs"]
        tags: Mapping[str, Tags] = self.facts["tags"]
        tags_by_log = {each.log: each.tags for each in tags.values()}
        for row in rows.values():
            if (beginning := _find_beginning(row)) is not None and self.has_payload(row):
                other = longest.get(beginning)
                longest[beginning] = row if other is None or _rank_recording(row) > _rank_recording(other) else other
        for key, row in rows.items():
            beginning = _find_beginning(row)
            winner = row if beginning is None else longest.get(beginning, row)
            is_superseded = winner.log.sha256 != row.log.sha256 and _rank_recording(winner) > _rank_recording(row)
            by = winner.run_id if is_superseded else None
            its_tags = tags_by_log.get(row.log.sha256, {})
            is_settled = row.superseded_by == by and row.tags == its_tags
            joined[key] = row if is_settled else replace(row, superseded_by=by, tags=its_tags)
        return joined

    def list_rows(self, run_id: str | None = None) -> list[RunFacts]:
        """Return the runs by run and recipe, or those of one run: one for each recipe."""
        rows = (row for row in self.runs.values() if run_id in (None, row.run_id))
        return sorted(rows, key=lambda row: (row.run_id, row.recipe_id))

    def has_payload(self, row: RunFacts) -> bool:
        """Return whether the folders of a run exist; `tcpipe verify` reads their content."""
        return row.blob in self.blobs and (not row.streams or row.streams_blob in self.blobs)

    def find_seen(self, log: tuple[str, ...]) -> LogSnapshot | None:
        """Return the last recorded state of the log; None for a new log."""
        found: LogSnapshot | None = self.facts["seen"].get(make_key(find_lineage(log)))
        return found

    def find_tags(self, sha256: str) -> Mapping[str, str]:
        """Return the tags of a log."""
        found: Tags | None = self.facts["tags"].get(make_key(sha256))
        return {} if found is None else found.tags

    def add_run(self, row: RunFacts) -> None:
        """Add a run that a worker has written after the scan."""
        self.facts["runs"][make_run_key(row.log.sha256, row.recipe_id)] = row
        self.blobs |= {row.blob, row.streams_blob} - {""}
        self._joined = None

    def add(self, name: Name, record: Record) -> None:
        """Add a document that was written after the scan."""
        key = name.kind, name.key
        self.replaced += [self.names[key]] if key in self.names else []
        self.highest[key] = max(name.number, self.highest.get(key, 0))
        self.facts[name.kind][name.key], self.names[key] = record, str(name)
        self.is_new = False
        if name.kind == "runs":
            row = cast("RunFacts", record)
            self.blobs |= {row.blob, row.streams_blob} - {""}
        if name.kind in ("runs", "tags"):
            self._joined = None


Beginning: TypeAlias = tuple[str, str, int, str]
"""Robot, recipe, first stamp and hash of the first measurements of a recording."""


def _find_beginning(row: RunFacts) -> Beginning | None:
    """Return the identity of the beginning of a run's log; None if the run was pruned or has no measurements."""
    if row.recording is None or not row.blob:  # a pruned run replaces no other run
        return None
    return row.robot, row.ingest_key, row.recording.first_ns, row.recording.beginning


def _rank_recording(row: RunFacts) -> tuple[int, int, bool, str]:
    recording = row.recording
    assert recording is not None  # noqa: S101  the callers have seen its beginning
    return recording.last_ns, recording.rows, not row.damage, row.log.sha256


# Records that this process has read, of the place that it read last, by the names of their documents.
_DECODED: dict[str, dict[str, Record]] = {}


def scan(place: Place) -> State:
    """Return the current state of a store from its documents."""
    where = place.where()
    if where not in _DECODED:
        _DECODED.clear()
        _DECODED[where] = {}
    return _scan(place, _DECODED[where])


def _scan(place: Place, decoded: dict[str, Record]) -> State:
    """Return the state of a place from its documents; documents that it reads are added to ``decoded``."""
    state, candidates = State(), dict[tuple[Kind, str], list[Name]]()
    for kind in KINDS:
        for file in place.list(kind):
            if (name := parse_name(kind, file)) is not None:
                candidates.setdefault((kind, name.key), []).append(name)
    state.blobs, state.is_new = frozenset(place.list(BLOBS)), not candidates
    for key, names in candidates.items():
        names.sort(key=lambda name: (-name.number, name.digest))
        state.highest[key] = names[0].number
    unread = sum(str(names[0]) not in decoded for names in candidates.values())
    indexed = _read_index(place) if unread > _UNREAD else dict[str, bytes]()
    fresh = dict[str, bytes]()
    while candidates:  # repeated with older documents if the newest one is damaged
        fresh |= _decode(place, [names[0] for names in candidates.values()], indexed, decoded)
        damaged = dict[tuple[Kind, str], list[Name]]()
        for key, (name, *others) in candidates.items():
            if str(name) in decoded:
                state.facts[name.kind][name.key], state.names[key] = decoded[str(name)], str(name)
                state.replaced += map(str, others)
            else:
                is_there = place.size(str(name)) is not None  # else removed by a prune after it was listed
                state.damaged += [str(name)] if is_there else []
                damaged |= {key: others} if others else {}
        candidates = damaged
    state.read = len(fresh)
    if len(fresh) > _UNREAD + len(indexed) // _UNREAD_SHARE:
        names_that_count = state.names.values()
        facts = {
            name: indexed.get(name) or fresh.get(name) or to_compact_json(decoded[name]) for name in names_that_count
        }
        columns = [pa.array([*facts], pa.string()), pa.array([*facts.values()], pa.binary())]
        table = pa.Table.from_arrays(columns, ["name", "facts"]).replace_schema_metadata({_SEAL: _seal(facts)})
        with suppress(StoreError):  # a reader may not write here
            place.put(INDEX, write_parquet_bytes(table))
    return state


def _decode(
    place: Place, names: Iterable[Name], indexed: Mapping[str, bytes], decoded: dict[str, Record]
) -> dict[str, bytes]:
    """Add records of documents to ``decoded``, and return those that are not in the index as the index has them."""
    unread, fresh = list[Name](), dict[str, bytes]()
    for name in names:
        if (text := str(name)) in decoded:
            continue
        if text in indexed:
            decoded[text] = parse_typed_json(indexed[text], RECORDS[name.kind], text)
        else:
            unread.append(name)
    found: list[bytes | None] = place.map(lambda name: _read_document(place, name), unread)
    for name, data in zip(unread, found, strict=True):
        if data is not None:
            record: Record = parse_typed_json(data, RECORDS[name.kind], place.where(str(name)))
            decoded[str(name)], fresh[str(name)] = record, to_compact_json(record)
    return fresh


def _read_document(place: Place, name: Name) -> bytes | None:
    """Return the bytes of a document; None if they have changed."""
    try:
        data = place.read(str(name))
    except StoreError as error:
        logger.debug("%s", error)
        return None
    return data if data is not None and compute_short_digest(data) == name.digest else None


def _read_index(place: Place) -> dict[str, bytes]:
    """Return the documents in the index, by name."""
    with suppress(StoreError, KeyError):
        table = read_parquet_bytes(place.read(INDEX) or b"", INDEX)
        rows = dict(zip(table["name"].to_pylist(), table["facts"].to_pylist(), strict=True))
        if (table.schema.metadata or {}).get(_SEAL) == _seal(rows):
            return rows
    return {}


def _seal(rows: Mapping[str, bytes]) -> bytes:
    """Return a hash of the rows of an index, and of the version that wrote them: another one may have other fields."""
    found = hashlib.sha256(__version__.encode())
    for name, facts in rows.items():
        found.update(name.encode() + facts)
    return found.hexdigest().encode()


def put_document(place: Place, state: State, kind: Kind, key: str, record: Record) -> str:
    """Write the record that counts from now on for a kind and key, and return the name of its document.

    The state, and later scans of this process, have it as it is read from the document.
    """
    data = to_json(record).encode()
    name = Name(kind, key, state.highest.get((kind, key), 0) + 1, compute_short_digest(data))
    place.put(str(name), data)
    facts: Record = parse_typed_json(data, RECORDS[kind], place.where(str(name)))
    state.add(name, facts)
    if (decoded := _DECODED.get(place.where())) is not None:
        decoded[str(name)] = facts
    return str(name)


def read_record(place: Place, name: str, cls: type[T]) -> T:
    """Return the whole record in a document; `StoreError` if it is missing or has changed."""
    kind, _, file = name.partition("/")
    parsed = parse_name(cast("Kind", kind), file)
    data = None if parsed is None else _read_document(place, parsed)
    if data is None:
        raise StoreError(
            f"{place.where(name)}: is missing or has changed since it was written; 'tcpipe verify' lists all"
        )
    return parse_typed_json(data, cls, place.where(name))


def find_strange_files(place: Place) -> Iterable[str]:
    """Yield the names in the folders of documents that are no documents."""
    for kind in KINDS:
        yield from (f"{kind}/{file}" for file in place.list(kind) if parse_name(kind, file) is None)
