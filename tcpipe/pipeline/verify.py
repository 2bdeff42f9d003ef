"""Re-read everything a path holds and compare it with what was written down about it: seals, checksums, counts, contracts, joins."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.cost.labels import pool_budgets
from tcpipe.errors import DatasetError, TcpipeError, UsageError, clean_lines
from tcpipe.formats.atomic import find_leftovers
from tcpipe.formats.bucket_directories import REPORT_PATCHES, fetch_unproved, find_unlisted_files
from tcpipe.formats.commit_log import LOG
from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.dataset_files import (
    CARD,
    PATCHES,
    REPORT,
    SAMPLES,
    PatchFiles,
    find_places_in_files,
    has_sample_ids,
    open_patches,
    read_card,
    read_samples,
    sample_columns,
    sample_count,
)
from tcpipe.formats.integrity import Checksum, Checksums, find_broken_seal, read_sealed_as
from tcpipe.formats.json_files import to_plain
from tcpipe.formats.object_storage import is_bucket, is_url
from tcpipe.formats.parquet import read_table
from tcpipe.formats.place import Place, find_wrong_files, open_place
from tcpipe.formats.recipe_toml import make_recipe_id
from tcpipe.motion.distance_breakdown import KEPT
from tcpipe.pipeline.dataset.card import CARD_COLUMNS, measure_samples
from tcpipe.pipeline.dataset.redaction import find_leaks
from tcpipe.pipeline.verify_store import CheckResult, verify_log, verify_map, verify_run, verify_store
from tcpipe.store import Store, find_store_above, is_named_after, is_store
from tcpipe.tables.columns import to_floats
from tcpipe.tables.facts import LEFT_OUT
from tcpipe.tables.levels import DATA_MODEL_VERSION, READ_VERSIONS
from tcpipe.tables.levels import SAMPLES as SAMPLES_SCHEMA
from tcpipe.terrain.layers import Layer

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
    if any(line.startswith(f"{directory / SAMPLES}: ") for line in wrong):
        return  # what nobody knows is not unfolded
    if (rows := sample_count(directory)) != card.samples:
        yield f"{directory / CARD}: samples is {card.samples}, but the samples give {rows}"
        return
    yield from _verify_samples(directory, card)


def _verify_files(
    directory: Path, checksums: Mapping[str, Checksum], unlisted: Sequence[str], *, kind: str
) -> Iterator[str]:
    """Compare every file with the checksum that the card has of it; name those that it does not know."""
    yield from find_wrong_files(Place(directory), checksums)
    there = {path.relative_to(directory).as_posix() for path in directory.rglob("*") if not path.is_dir()}
    for name in sorted(there - {*checksums, *unlisted}):
        if not (name.startswith(f"{REPORT_PATCHES}/") if kind == "dataset" else name.endswith(_BESIDE)):
            yield f"{directory / name}: is no file of this {kind}"


def _verify_samples(directory: Path, card: DatasetCard) -> Iterator[CheckResult]:
    samples, where = read_samples(directory), directory / SAMPLES
    yield "samples", samples.num_rows
    try:
        SAMPLES_SCHEMA.check(
            samples.drop_columns([name for name in card.added_columns if name in samples.column_names])
        )
    except TcpipeError as error:
        yield from (f"{where}: {problem}" for problem in error.problems)
        return
    yield from (f"{where}: has no column {name}" for name in card.added_columns if name not in samples.column_names)
    yield from (f"{where}: {problem}" for problem in _find_wrong_joins(samples, card))
    for key, value in measure_samples(samples.select(CARD_COLUMNS), has_terrain="terrain" in card.layers).items():
        told = getattr(card, key)
        if told != value:
            yield f"{directory / CARD}: {key} is {to_plain(told)}, but the samples give {to_plain(value)}"
    yield from (f"{directory / CARD}: {problem}" for problem in _find_wrong_runs(samples, card))
    used_m = math.fsum(to_floats(samples, "arc_length_m")[samples.column("split").to_numpy() != "buffer"])
    if not math.isclose(used_m, card.distance_by_reason_m[KEPT], rel_tol=1e-9, abs_tol=1e-6):
        yield f"{directory / CARD}: the distance breakdown keeps {card.distance_by_reason_m[KEPT]:.3f} m, the samples cover {used_m:.3f} m"
    if card.redaction is not None:
        yield from (f"{directory / CARD}: {problem}" for problem in find_leaks(card, samples))
    yield from _verify_patches(directory, card, samples)


def _find_wrong_joins(samples: pa.Table, card: DatasetCard) -> Iterator[str]:
    """Yield a line for each kind of row that belongs to nothing, or to something else than its columns say."""
    ids = samples.column("sample_id")
    repeated = len(ids) - pc.count_distinct(ids).as_py()
    if repeated:
        yield f"{repeated} sample ids occur more than once"
    yield from _verify_rows(pc.not_equal(ids, samples.column("segment_id")), "have another id than their segment")
    for column, known in (("run_id", [run.run_id for run in card.runs]), ("map", [entry.name for entry in card.maps])):
        strange = pc.invert(pc.is_in(samples.column(column), value_set=pa.array(known, pa.string())))
        yield from _verify_rows(strange, f"have a {column} that the card does not list")
    names = {entry.id: entry.name for entry in card.classes}
    pairs = samples.select(["terrain_class", "terrain_name"]).group_by(["terrain_class", "terrain_name"]).aggregate([])
    for pair in pairs.to_pylist():
        if names.get(pair["terrain_class"]) != pair["terrain_name"]:
            yield f"class {pair['terrain_class']} is called {pair['terrain_name']!r}, {names.get(pair['terrain_class'])!r} in the card"


def _find_wrong_runs(samples: pa.Table, card: DatasetCard) -> Iterator[str]:
    """Yield a line for what the card copied from its runs and the samples, the recipe or the rest of the card say otherwise."""
    robots: dict[str, dict[str, int]] = {}
    for row in samples.group_by(["run_id", "robot"]).aggregate([([], "count_all")]).to_pylist():
        robots.setdefault(row["run_id"], {})[row["robot"]] = row["count_all"]
    for run in card.runs:
        name, robot = run.run_id, run.robot
        of = robots.get(name, {})
        if of.keys() - {robot}:
            yield f"run {name} is of robot {robot}, its samples of {', '.join(sorted(of))}"
        if sum(of.values()) != run.samples:
            yield f"run {name} has {run.samples} samples, {sum(of.values())} are there"
        if card.redaction is None and run.recipe_id != (wanted := make_recipe_id(card.recipe, robot)):
            yield f"run {name} is of recipe {run.recipe_id}, the card's for robot {robot} is {wanted}"
        if not is_named_after(name, run.sha256):
            yield f"run {name} is of a log whose sha256 begins with {run.sha256[:8]}"
    driven_m, distance_by_reason_m = [run.driven_m for run in card.runs], math.fsum(card.distance_by_reason_m.values())
    known_m = [metres for metres in driven_m if metres is not None]
    if len(known_m) == len(driven_m) and not math.isclose(
        math.fsum(known_m), distance_by_reason_m, rel_tol=1e-9, abs_tol=1e-6
    ):
        yield f"the distance breakdown sums to {distance_by_reason_m:.3f} m, its runs drove {math.fsum(known_m):.3f} m"
    if pool_budgets(run.energy_budget for run in card.runs) != card.energy_budget:
        yield "its energy budget is not that of its runs"


def _verify_rows(wrong: pa.ChunkedArray, what: str) -> Iterator[str]:
    count = int(pc.sum(wrong).as_py() or 0)
    if count:
        yield f"{count} rows {what}, the first is row {pc.index(wrong, value=True).as_py()}"


def _verify_patches(directory: Path, card: DatasetCard, samples: pa.Table) -> Iterator[CheckResult]:
    """Decode every patch; compare order, ids and values with the samples and the class table."""
    files = open_patches(directory, card, proved=False)
    for piece in range(len(files.starts) - 1):
        try:
            yield from _verify_piece(files, piece)
        except DatasetError as error:
            yield from error.problems
    place = find_places_in_files(card, samples.column("split").to_numpy())
    in_files = samples.take(pa.array(np.argsort(place, kind="stable")))
    yield from _verify_patch_columns(directory, card, in_files)


def _verify_piece(files: PatchFiles, piece: int) -> Iterator[CheckResult]:
    pixels = files.read(piece, files.layers)
    first, rows = int(files.starts[piece]), len(next(iter(pixels.values())))
    where = f"{files.directory}: patches {first} to {first + rows - 1}"
    for name, layer in files.layers.items():
        if layer.kind == "categorical" and pixels[name].max(initial=0) > layer.high:
            of = "" if name == "terrain" else f" of {name}"
            yield f"{where} hold classes{of} above {layer.high:g}, the last of the table"
        if layer.stack in {"floats", "bands"} and not _is_within_range(pixels[name], layer):
            yield f"{where} hold {name} beyond {layer.low!r} to {layer.high!r} {layer.unit}"
    floor = pixels["height"].reshape(rows, -1).min(axis=1)
    if floor.any():
        yield f"{where}: {int((floor > 0).sum())} do not begin at height 0"
    yield "patches", rows


def _is_within_range(pixels: NDArray[np.generic], layer: Layer) -> bool:
    """Return whether all pixels with data lie in the layer's range, but for rounding."""
    there = pixels[np.isfinite(pixels)]
    slack = (1e-3 if layer.stored == np.float16 else 1e-5) * max(abs(layer.low), abs(layer.high))
    return bool(((there >= layer.low - slack) & (there <= layer.high + slack)).all())


def _verify_patch_columns(directory: Path, card: DatasetCard, samples: pa.Table) -> Iterator[str]:
    """Compare what stands beside the patches with the samples, given in the order of the files."""
    if card.format == "zarr":
        if not has_sample_ids(directory, samples.column("sample_id").to_pylist()):
            yield f"{directory / PATCHES}: its sample ids are not those of {SAMPLES}, in their order"
        return
    first, names = 0, sample_columns(directory)
    for shard in card.shards:
        found = read_table(directory / shard.path, names)
        wanted = samples.slice(first, shard.rows)
        other = [name for name in names if not found.column(name).equals(wanted.column(name))]
        if other:
            yield f"{directory / shard.path}: {', '.join(other)} are not those of {SAMPLES}, in their order"
        first += shard.rows
