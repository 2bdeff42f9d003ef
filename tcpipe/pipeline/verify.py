"""Re-read everything a path holds and compare it with what was written down about it: seals, checksums, counts, contracts, joins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from tcpipe.errors import TcpipeError, UsageError, clean_lines
from tcpipe.formats.atomic import find_leftovers
from tcpipe.formats.bucket_directories import REPORT_PATCHES, fetch_unproved, find_unlisted_files
from tcpipe.formats.commit_log import LOG
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import (
    CARD,
    REPORT,
    SAMPLES,
    read_card,
    read_samples,
    sample_count,
)
from tcpipe.formats.integrity import Checksum, Checksums, find_broken_seal, read_sealed_as
from tcpipe.formats.object_storage import is_bucket, is_url
from tcpipe.formats.place import Place, find_wrong_files, open_place
from tcpipe.pipeline.dataset.redaction import find_leaks
from tcpipe.pipeline.verify_store import CheckResult, verify_log, verify_map, verify_run, verify_store
from tcpipe.store import Store, find_store_above, is_store
from tcpipe.tables.facts import LEFT_OUT
from tcpipe.tables.levels import DATA_MODEL_VERSION, READ_VERSIONS

_KNOWN = "dataset, run, store, map (.zarr), model or cost map"

_SEALED_CARDS = {"model.json": "model", "cost-map.json": "cost map"}
"""Documents that prove all files beside them, and what the directory is."""

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
    stored = _verify_stored(str(path)) if is_url(path) else None
    if is_url(path) and stored is None:
        with fetch_unproved(str(path).rstrip("/")) as copy:
            found = verify(copy)
        return replace(found, path=str(path), problems=(*found.problems, *_verify_generations(str(path), found.kind)))
    if stored is None and not Path(path).exists():
        raise UsageError(f"{path}: there is no such directory; give a {_KNOWN}")
    kind, findings = stored or _find_kind(Path(path))
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
    if kind not in ("store", "run"):
        again = "the next command that writes it removes it"
        problems += [f"{left}: was left by a killed command; {again}" for left in find_leftovers(Path(path))]
    return Verified(
        str(path), kind, read, tuple(dict.fromkeys(problems)), _read_notes(Path(path)) if kind == "dataset" else ()
    )


def _verify_generations(url: str, kind: str) -> Iterator[str]:
    """Yield what is wrong with the log of a URL, and files of no generation."""
    if is_bucket(url):
        yield from (line for line in verify_log(open_place(url).below(LOG)) if isinstance(line, str))
    yield from (f"{name}: is no file of this {kind}" for name in find_unlisted_files(url))


def _read_notes(dataset: Path) -> tuple[str, ...]:
    """Return what a dataset says that it does not tell; nothing where its card cannot be read, which is a problem already."""
    with suppress(TcpipeError):
        redaction = read_card(dataset, proved=False).redaction
        return () if redaction is None else ("It is redacted.", *redaction.lines())
    return ()


def _verify_stored(path: Path | str) -> tuple[str, Iterator[CheckResult]] | None:
    if inside := find_store_above(path):
        return "run", verify_run(*inside)
    if is_store(path):
        return "store", verify_store(Store(path))
    return None


def _find_kind(path: Path) -> tuple[str, Iterator[CheckResult]]:
    """Return what a path is, and its findings, which are made as they are asked for."""
    if (path / CARD).is_file():
        return "dataset", verify_dataset(path)
    place = path.resolve()
    if place.suffix == ".zarr" and not (place.parent / CARD).is_file():
        return "map", verify_map(path)
    if stored := _verify_stored(path):
        return stored
    for card, kind in _SEALED_CARDS.items():
        if (path / card).is_file():
            return kind, _verify_sealed_directory(path, card)
    raise UsageError(f"{path}: is no {_KNOWN}; give one of these directories")


def _verify_sealed_directory(directory: Path, card: str) -> Iterator[CheckResult]:
    checksums = read_sealed_as(directory / card, Checksums).checksums
    yield from _verify_files(directory, checksums, [card], kind=_SEALED_CARDS[card])
    yield "files", len(checksums) + 1


def verify_dataset(directory: Path) -> Iterator[CheckResult]:
    """Yield what was read, and a line for everything that is not as the card says."""
    card = read_card(directory, proved=False)
    for path in (directory / CARD, directory / REPORT):
        problem = find_broken_seal(path)
        yield problem or ("files", 1)
    if card.data_model_version not in READ_VERSIONS:
        yield (
            f"{directory / CARD}: of data model {card.data_model_version}, this version knows {DATA_MODEL_VERSION}; "
            "run 'tcpipe migrate' on it, verify it with the version that wrote it, or build it again"
        )
        return
    wrong = list(_verify_files(directory, card.checksums, [CARD, REPORT], kind="dataset"))
    yield from wrong
    yield "files", len(card.checksums)
    if not wrong:  # what nobody knows is not unfolded
        yield from _verify_counts(directory, card)


def _verify_files(
    directory: Path, checksums: Mapping[str, Checksum], unlisted: Sequence[str], *, kind: str
) -> Iterator[str]:
    """Compare every file with the checksum that the card has of it; name those that it does not know."""
    yield from find_wrong_files(Place(directory), checksums)
    there = {path.relative_to(directory).as_posix() for path in directory.rglob("*") if not path.is_dir()}
    for name in sorted(there - {*checksums, *unlisted}):
        if not (name.startswith(f"{REPORT_PATCHES}/") if kind == "dataset" else name.endswith(_BESIDE)):
            yield f"{directory / name}: is no file of this {kind}"


def _verify_counts(directory: Path, card: DatasetCard) -> Iterator[CheckResult]:
    """Compare how many samples there are; of a redacted dataset also that it reveals nothing."""
    rows = sample_count(directory)
    yield "samples", rows
    counts = {"splits": sum(card.splits.values()), "runs": sum(run.samples for run in card.runs)}
    for name, count in {"samples": card.samples, **counts}.items():
        if count != rows:
            yield f"{directory / CARD}: {name} has {count} samples, but {SAMPLES} has {rows}"
    if card.redaction is not None:
        yield from (f"{directory / CARD}: {problem}" for problem in find_leaks(card, read_samples(directory)))
