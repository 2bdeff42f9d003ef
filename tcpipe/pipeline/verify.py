"""Re-read everything a path holds and compare it with what was written down about it: seals, checksums, counts, contracts, joins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tcpipe.errors import TcpipeError, UsageError, clean_lines
from tcpipe.formats.atomic import find_leftovers
from tcpipe.formats.bucket_directories import CARDS, FoundCard, find_newest, find_unlisted_files
from tcpipe.formats.commit_log import LOG
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import CARD, REPORT, SAMPLES, parse_card
from tcpipe.formats.integrity import Checksums, find_broken_seal
from tcpipe.formats.json_files import parse_json, parse_typed
from tcpipe.formats.object_storage import is_bucket, is_url
from tcpipe.formats.parquet import read_row_count, read_table
from tcpipe.formats.place import find_wrong_files, open_place
from tcpipe.pipeline.dataset.redaction import find_leaks
from tcpipe.pipeline.verify_store import CheckResult, verify_log, verify_map, verify_run, verify_store
from tcpipe.store import Store, find_store_above, is_store
from tcpipe.tables.facts import LEFT_OUT
from tcpipe.tables.levels import DATA_MODEL_VERSION, READ_VERSIONS
from tcpipe.tables.levels import SAMPLES as SAMPLES_SCHEMA

_KNOWN = "dataset, run, store, map (.zarr), model or cost map"

_KINDS = dict(zip(CARDS, ("dataset", "model", "cost map"), strict=True))
"""What a directory is, by the document that proves all files beside it."""

_BESIDE = ".aux.xml"
"""Ending of the statistics that GDAL and QGIS put beside a raster that they look at."""


@dataclass(frozen=True, slots=True)
class Verified:
    """What was read again, and each thing that is not as it was written; ``str`` of it is what the command prints."""

    path: str
    kind: str
    """``dataset``, ``run``, ``store``, ``map``, ``model`` or ``cost map``."""
    read: Mapping[str, int]
    problems: tuple[str, ...]
    notes: tuple[str, ...] = field(default=(), metadata=LEFT_OUT)
    """What a redacted dataset does not tell."""

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
    problems: list[str] = []
    try:
        for finding in findings:
            if isinstance(finding, str):
                problems.append(finding)
            else:
                read[finding[0]] = read.get(finding[0], 0) + finding[1]
    except TcpipeError as error:
        problems += error.problems
    if kind not in ("store", "run") and not is_url(path):
        again = "the next command that writes it removes it"
        problems += [f"{left}: was left by a killed command; {again}" for left in find_leftovers(Path(path))]
    return Verified(str(path), kind, read, tuple(dict.fromkeys(problems)), notes)


def _find_kind(path: Path | str) -> tuple[str, Iterator[CheckResult], tuple[str, ...]]:
    """Return what a path is, its findings, which are made as they are asked for, and notes."""
    if inside := find_store_above(path):
        return "run", verify_run(*inside), ()
    if is_store(path):
        return "store", verify_store(Store(path)), ()
    place = open_place(path)
    if place.path and place.path.resolve().suffix == ".zarr" and not (place.path.resolve().parent / CARD).is_file():
        return "map", verify_map(place.path), ()
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
    yield find_broken_seal(found.data, where) or ("files", 1)
    if kind == "dataset":
        yield find_broken_seal(place.read(REPORT), place.where(REPORT)) or ("files", 1)
        card = parse_card(found.data, where, proved=False)
        if card.data_model_version not in READ_VERSIONS:
            yield (
                f"{where}: of data model {card.data_model_version}, this version knows {DATA_MODEL_VERSION}; "
                "run 'tcpipe migrate' on it, verify it with the version that wrote it, or build it again"
            )
            return
    checksums = parse_typed(parse_json(found.data, where), Checksums, where).checksums
    wrong = list(find_wrong_files(place, checksums))
    yield from wrong
    yield "files", len(checksums)
    yield from (
        f"{name}: is no file of this {kind}" for name in find_unlisted_files(path) if not name.endswith(_BESIDE)
    )
    if is_bucket(path):
        yield from (line for line in verify_log(open_place(path).below(LOG)) if isinstance(line, str))
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
        table = SAMPLES_SCHEMA.add_missing_columns(read_table(samples))
        yield from (f"{where}: {problem}" for problem in find_leaks(card, table))
