"""A store or a dataset of an earlier data model, brought to this one, in place or to another place; and any store copied.

Tables, maps and pixels stay as and where they are. Warnings of manifests and cards, which were sentences, become findings; the records of
a store become commits. The mark of the data model is written after them. So a migration that was killed goes on when it is called again,
and one that is done does nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

from tcpipe.errors import StoreError, TcpipeError, UsageError, clean_lines
from tcpipe.formats.bucket_directories import find_newest
from tcpipe.formats.commit_log import LOG
from tcpipe.formats.commits import CallRecord, Dataset, Entries, Failure, LogSnapshot, Problem, State, Superseded
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import CARD
from tcpipe.formats.integrity import Checksum, find_wrong_checksum, seal_document, verify_document
from tcpipe.formats.json_files import Json, parse_typed, to_json, to_plain
from tcpipe.formats.maps.map_files import open_map
from tcpipe.formats.object_storage import is_url, run_side_by_side
from tcpipe.formats.place import Place, find_changed_files, open_place
from tcpipe.formats.recipe_toml import rename_earlier_keys
from tcpipe.formats.run_documents import (
    MARK,
    SPOOL,
    Manifest,
    RunJson,
    StoreDocument,
    read_layout,
    read_sealed_at,
    split_number,
)
from tcpipe.pipeline.calls import is_committed, open_log
from tcpipe.recipe import SplitConfig
from tcpipe.store import Store
from tcpipe.tables.findings import Finding, Subject, SubjectKind, judge, make_finding
from tcpipe.tables.levels import DATA_MODEL_VERSION, EARLIER_VERSIONS
from tcpipe.tables.options import EARLIER_DOCUMENT_KEYS, rename_keys

T = TypeVar("T")

Document = Mapping[str, Any]

_KNOWN_VERSIONS = (*EARLIER_VERSIONS, DATA_MODEL_VERSION)
_RECORDS, _INDEX = "records/", "index/"
_APART = (_RECORDS, _INDEX, f"{SPOOL}/", MARK)
"""What is not copied: it is converted, or made again."""
_IN_FOLDER = re.compile(r"(?:runs/[^/]+|maps)/[^/]+/[0-9a-f]{16}(?=/)")
"""A folder that is named after its content, at the beginning of a name."""
_WHOLLY_RENAMED = ("distance_by_reason_m", "flagged_samples", "removal", "physics")
"""Parts of cards and manifests that no names of users are keys of."""
_TOGETHER = 500
"""So many runs are one commit."""


@dataclass(frozen=True, slots=True)
class Migrated:
    """What became of each document; ``str`` of it is what the command prints."""

    path: str
    migrated: tuple[str, ...]
    current: int
    """Documents that were of this data model, and maps outside of stores, which are read as they are."""
    problems: tuple[str, ...]
    """Documents that are left as they are, and why."""
    copied: int = 0
    """Files that were put to another place."""

    @property
    def exit_code(self) -> int:
        """Return 0, 3 if some documents could not be migrated, 1 if none could."""
        return (3 if self.migrated or self.current else 1) if self.problems else 0

    def __str__(self) -> str:
        """Return what was done, one line a document, and what was not."""
        count = f"{len(self.migrated)} documents brought to data model {DATA_MODEL_VERSION}, {self.current} left as they are"
        if not self.migrated and not self.problems and not self.copied:
            count = f"nothing to do: {self.current} documents are current"
        head = f"{count}; {self.copied} files copied" if self.copied else count
        done = (f"migrated: {path}" for path in self.migrated)
        return clean_lines((f"{self.path}: {head}", *done, *(f"problem: {problem}" for problem in self.problems)))


def migrate(path: Path | str, to: Path | str | None = None) -> Migrated:
    """Bring the documents of a store, or the card of a dataset, to this data model; maps are read as they are.

    Raises `UsageError`: the path is none of these, or no store and to be brought elsewhere, or of a data model that this version does not
    know.

    ``to``: where a store is brought to; what is there of it already is not copied again. None: where it is.
    """
    source = open_place(path)
    if (version := read_layout(source)) is not None:
        if version not in _KNOWN_VERSIONS:
            raise UsageError(f"{path}: is of data model {version}, this version knows {', '.join(_KNOWN_VERSIONS)}")
        return _bring_store(source, source if to is None else open_place(to))
    if to is not None:
        raise UsageError(f"{path}: is no store; only stores are brought elsewhere")
    try:
        brought = _bring_one(path)
    except UsageError:
        raise
    except TcpipeError as error:
        return Migrated(str(path), (), 0, error.problems)
    return Migrated(str(path), brought, 0 if brought else 1, ())


def _bring_one(path: Path | str) -> tuple[str, ...]:
    """Bring a dataset to this data model; return where its card is, nothing where it was current or is a map."""
    if (dataset := find_newest(str(path), [CARD])) is not None:
        return _bring_card(dataset.place)
    if is_url(path) or Path(path).resolve().suffix != ".zarr":
        raise UsageError(f"{path}: is no store, map (.zarr) or dataset; give one of these directories")
    open_map(Path(path))
    return ()


def _bring_card(place: Place) -> tuple[str, ...]:
    found, where = read_sealed_at(place, CARD), place.where(CARD)
    document = _bring_document(found, where)
    if document is found:
        return ()
    parse_typed(document, DatasetCard, where)
    place.put(CARD, to_json(seal_document(document)).encode())
    return (where,)


def _bring_store(source: Place, target: Place) -> Migrated:
    """Bring a store to this data model; ``target`` is ``source``, or where it is copied to."""
    target.clear()
    is_current, names = read_layout(source) == DATA_MODEL_VERSION, [entry.name for entry in source.entries()]
    there = {entry.name: entry.size_bytes for entry in target.entries()}
    units, log = dict[str, list[str]](), list[str]()
    for name in names:
        if name.startswith("runs/") or (target != source and not name.startswith((*_APART, f"{LOG}/"))):
            units.setdefault("/".join(name.split("/")[: 2 if name.startswith("runs/") else 1]), []).append(name)
        elif target != source and name.startswith(f"{LOG}/"):
            log.append(name)
    done = run_side_by_side(lambda unit: _bring_unit(source, target, unit, there), [*units.values()])
    copied = sum(unit.copied for unit in done) + sum(_put(target, name, source.read(name), there) for name in log)
    changed = [] if is_current else [target.where(name) for unit in done for name in unit.changed]
    problems = [line for unit in done for line in unit.problems]
    records = [name for name in names if name.startswith(_RECORDS)]
    if records or read_layout(target) != DATA_MODEL_VERSION:
        problems += _write_log(Store(target.where()), source, records)
    for name in (name for name in names if target == source and name.startswith((_RECORDS, f"{_INDEX}logs."))):
        source.delete(name)
    _put(target, MARK, to_json(seal_document(StoreDocument(DATA_MODEL_VERSION))).encode(), there)
    count = sum(map(_is_converted, names))
    return Migrated(target.where(), tuple(changed), count - len(changed), tuple(problems), copied)


@dataclass(frozen=True, slots=True)
class _Unit:
    """What became of the files of a run, or of all maps."""

    changed: tuple[str, ...] = ()
    copied: int = 0
    problems: tuple[str, ...] = ()


def _bring_unit(source: Place, target: Place, names: Sequence[str], there: Mapping[str, int]) -> _Unit:
    """Copy the files of a run or map, where the target is another place, then put its documents, which name these files."""
    documents, listed, problems = dict[str, bytes](), dict[str, Checksum](), list[str]()
    for name in (name for name in names if split_number(name.rpartition("/")[2])):
        if (data := source.read(name)) is None:
            continue
        documents[name], where = data, source.where(name)
        try:
            found = verify_document(data, where)
            listed |= _read_checksums(found, name.rpartition("/")[0])
            documents[name] = _bring(found, data, name, where)
        except TcpipeError as error:
            problems += error.problems
    folders, copied = dict[str, list[str]](), 0
    for name in (name for name in names if target != source and name not in documents):
        folders.setdefault(match[0] if (match := _IN_FOLDER.match(name)) else "", []).append(name)
    try:
        for name in folders.pop("", ()):
            copied += _put(target, name, source.read(name), there)
        for prefix, folder in folders.items():
            copied += _copy_folder(source, target, prefix, {name: listed.get(name) for name in folder}, there)
    except StoreError as error:
        return _Unit((), copied, (*problems, *error.problems))
    put = [name for name, data in documents.items() if _put(target, name, data, there)]
    changed = tuple(filter(_is_converted, put))
    return _Unit(changed, copied + (len(put) - len(changed) if target != source else 0), tuple(problems))


def _put(target: Place, name: str, data: bytes | None, there: Mapping[str, int]) -> bool:
    """Write a file unless the target has it; return whether it was written."""
    if data is None or (there.get(name) == len(data) and target.read(name) == data):
        return False
    target.put(name, data)
    return True


def _copy_folder(
    source: Place, target: Place, prefix: str, wanted: Mapping[str, Checksum | None], there: Mapping[str, int]
) -> int:
    """Copy a folder that is named after its content, unless the target has it, byte for byte; return the number of files.

    `StoreError` where a file is not what the documents have of it.
    """
    digests = {name: checksum or source.checksum(name) or Checksum(0, "") for name, checksum in wanted.items()}
    if all(there.get(name) == digest.size_bytes for name, digest in digests.items()) and not find_changed_files(
        target, digests, digests
    ):
        return 0
    with target.workshop() as directory:

        def fetch(name: str) -> None:
            path = directory / name.removeprefix(f"{prefix}/")
            path.parent.mkdir(parents=True, exist_ok=True)
            if wrong := find_wrong_checksum(source.where(name), source.copy(name, path), digests[name]):
                raise StoreError(f"{wrong}; not copied")

        source.map(fetch, [*digests])
        target.put_files(prefix, directory)
    return len(digests)


def _is_converted(name: str) -> bool:
    """Return whether a file is a document of a run."""
    document = split_number(name.rpartition("/")[2]) if name.startswith("runs/") else None
    return document is not None and document[0] in ("run", "manifest", "tags")


def _read_checksums(document: Document, above: str) -> dict[str, Checksum]:
    """Return what a document has of files, by their name in the store."""
    found = {**document.get("checksums", {}), **document.get("streams", {})}
    return {f"{above}/{name}": parse_typed(checksum, Checksum, above) for name, checksum in found.items()}


def _bring(found: Document, data: bytes, name: str, where: str) -> bytes:
    """Return a document of a run as this data model has it; `StoreError` where it is of no data model that is known."""
    kind = name.rpartition("/")[2].partition("-")[0] if name.startswith("runs/") else ""
    document = _bring_document(found, where) if kind == "manifest" else _bring_run(found) if kind == "run" else found
    if document is found:
        return data
    parse_typed(document, Manifest if kind == "manifest" else RunJson, where)
    return to_json(seal_document(document)).encode()


def _bring_run(found: Document) -> Document:
    """Return what is known of a log, with ``findings`` as ``report``."""
    if "findings" not in found:
        return found
    report = _convert_findings(rename_keys(found["findings"]), "run", "")
    texts = {key: _read_earlier(found.get(key, ()), "log", "") for key in ("damage", "remarks")}
    return {**_rename_top_keys({**_remove_keys(found, "findings"), **texts}), "report": report}


def _bring_document(found: Document, where: str) -> Document:
    """Return a manifest or card of this data model; `StoreError` where it is of none that is known."""
    version = found.get("data_model_version", "")
    if version == DATA_MODEL_VERSION:
        return found
    if version not in EARLIER_VERSIONS:
        known = ", ".join(_KNOWN_VERSIONS)
        raise StoreError(f"{where}: of data model {version}, this version knows {known}; left as it is")
    document = {**_remove_keys(found, "warnings", "problems", "findings"), "data_model_version": DATA_MODEL_VERSION}
    document = _rename_top_keys(document) | {"recipe": rename_earlier_keys(found["recipe"])}
    document |= rename_keys({name: document[name] for name in _WHOLLY_RENAMED if name in document})
    if "info" in found:
        earlier = rename_keys(found["info"]["findings"])
        report = _convert_findings({**earlier, "warnings": found["warnings"]}, "run", found["run_id"])
        findings = report["findings"]
        document |= {"info": {**_remove_keys(found["info"], "findings"), "report": report}}
        document |= {"counts": _bring_counts(found["counts"])}
        document |= {"damage": _read_earlier(found["damage"], "run", found["run_id"])}
    else:
        own = chain(found.get("problems", ()), found.get("warnings", ()))
        findings = _read_earlier(own, "dataset", str(found.get("name", "")))
        document |= {
            "findings": findings,
            "runs": [_convert_findings(run, "run", run["run_id"]) for run in found["runs"]],
        }
        document |= {
            "maps": [_convert_findings(_rename_top_keys(entry), "map", entry["name"]) for entry in found["maps"]]
        }
        rules = {entry.name for entry in fields(SplitConfig)} - {"buffer_m"}  # the recipe has them
        document |= {"split": _remove_keys(found["split"], *rules)}
        if found.get("redaction"):  # their descriptions name tags and files
            document |= {"added_columns": dict.fromkeys(found.get("added_columns", ()), "")}
    return {**document, "verdict": to_plain(judge(parse_typed(findings, tuple[Finding, ...], where)))}


def _bring_counts(counts: Mapping[str, int]) -> dict[str, Any]:
    """Return the counts of a manifest with those of messages by role."""
    ending = "_messages"
    messages = {name.removesuffix(ending): count for name, count in counts.items() if name.endswith(ending)}
    return {**_remove_keys(counts, *(f"{role}{ending}" for role in messages)), "messages": messages}


def _rename_top_keys(document: Document) -> dict[str, Any]:
    return {EARLIER_DOCUMENT_KEYS.get(name, name): value for name, value in document.items()}


def _remove_keys(document: Document, *names: str) -> dict[str, Any]:
    return {name: value for name, value in document.items() if name not in names}


def _convert_findings(found: Document, kind: SubjectKind, name: str) -> dict[str, Any]:
    """Return a part of a document with its warnings as findings."""
    return {**_remove_keys(found, "warnings"), "findings": _read_earlier(found.get("warnings", ()), kind, name)}


def _read_earlier(lines: Iterable[str], kind: SubjectKind, name: str) -> list[Json]:
    return [
        to_plain(make_finding("earlier-warning", Subject(kind, name), names={"text": line}))
        for line in dict.fromkeys(lines)
    ]


def _write_log(store: Store, source: Place, record_names: Sequence[str]) -> list[str]:
    """Commit the runs of a store and what its records say, and return a line for each record that cannot be read."""
    log, records, problems = open_log(store), dict[str, list[Document]](), list[str]()
    for name in record_names:
        try:
            found = read_sealed_at(source, name)
            records.setdefault(name.split("/")[1], []).append({**found, "key": Path(name).stem})
        except StoreError as error:
            problems += error.problems
    outlines = {record["run_id"]: record["outline"] for record in records.get("outlines", ())}
    names = store.run_ids()
    for start in range(0, len(names), _TOGETHER):
        run_ids = names[start : start + _TOGETHER]
        read = source.map(store.read_rows, run_ids)
        rows = [row for rows_by_recipe in read for row in rows_by_recipe.values() if not is_committed(row, log.state)]
        known = (replace(row, log=row.log and replace(row.log, outline=outlines.get(row.run_id, ""))) for row in rows)
        log.commit("ingested", Entries(runs=tuple(known)))
    log.commit("seen", lambda state: _convert_records(records, state))
    store.write_index(log.state)
    return problems


def _convert_records(records: Mapping[str, Sequence[Document]], state: State) -> Entries:
    """Return what records say and a state does not."""

    def read(kind: str, cls: type[T]) -> list[T]:
        return [parse_typed(record, cls, kind) for record in records.get(kind, ())]

    replaced = {(dataset.out, dataset.inputs) for dataset in read("replaced", Dataset)}
    superseded = sorted(records.get("superseded", ()), key=lambda record: (record["number"], record["by"] is None))
    failed = (
        {**record, "problems": record["lines"], "version": record.get("version") or ""}
        for record in records.get("failed", ())
    )
    accepted = chain(*map(_iterate_acknowledged, records.get("accepted", ())))
    calls = sorted(read("calls", CallRecord), key=lambda call: call.begin)
    return Entries(
        seen=tuple(snapshot for snapshot in read("logs", LogSnapshot) if not state.has_seen(snapshot)),
        failed=tuple(
            failure for failure in parse_typed([*failed], list[Failure], "failed") if failure.key not in state.failed
        ),
        acknowledged=tuple(problem for problem in accepted if problem.key not in state.acknowledged),
        superseded=()
        if state.supersessions
        else tuple(Superseded(record["run_id"], record["by"]) for record in superseded),
        datasets=tuple(
            dataset
            for dataset in read("datasets", Dataset)
            if (dataset.out, dataset.inputs) not in {*replaced, *state.datasets}
        ),
        calls=() if state.calls else tuple(calls),
    )


def _iterate_acknowledged(document: Document) -> Iterator[Problem]:
    """Yield the problems of which somebody said so; that a call was killed is not carried over."""
    name = document.get("run_id") or " + ".join(document["log"])
    kind: SubjectKind = "run" if document.get("run_id") else "log"
    for code in {"damaged": ("log-damaged", "no-segments"), "empty": ("no-segments",), "failed": ("log-failed",)}.get(
        document["kind"], ()
    ):
        finding = Finding(code, "error", Subject(kind, name), "rejected")
        yield Problem(finding, document["content"], tuple(document["log"]), document.get("run_id"))
