"""Re-read everything a path holds and compare it with what was written down about it: counts, checksums, contracts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.errors import DatasetError, TcpipeError, UsageError
from tcpipe.formats.dataset_files import (
    CARD,
    PATCHES,
    REPORT,
    PatchFiles,
    file_checksum,
    open_patches,
    read_card,
    read_samples,
    rows_in_files,
    zarr_sample_ids,
)
from tcpipe.formats.json_files import plain
from tcpipe.formats.map_files import MapFile, open_map
from tcpipe.formats.parquet import read_table
from tcpipe.formats.recipe_toml import ingest_key, parse_recipe, recipe_id
from tcpipe.pipeline.dataset_card import CARD_COLUMNS, measured
from tcpipe.pipeline.dataset_segments import KEPT
from tcpipe.store import RunDirectory, Store, is_store, run_at
from tcpipe.tables.columns import floats
from tcpipe.tables.levels import GATED_TRACK, LABELLED_SEGMENTS, REJECTIONS, SAMPLES, STREAMS

_TABLES = {"track": GATED_TRACK, "segments": LABELLED_SEGMENTS, "rejections": REJECTIONS}


@dataclass(frozen=True, slots=True)
class Verified:
    """What was read again, and each thing that is not as it was written; ``str`` of it is what the command prints."""

    path: Path
    kind: str
    """``dataset``, ``run``, ``store`` or ``map``."""
    read: Mapping[str, int]
    problems: tuple[str, ...]

    def __str__(self) -> str:
        """Return a line of what was read, and one for each problem."""
        read = ", ".join(f"{count} {what}" for what, count in self.read.items())
        verdict = f"{len(self.problems)} problems" if self.problems else "all as it was written"
        return "\n".join((f"{self.path}: {self.kind}; {read} read again: {verdict}", *self.problems))


def verify(path: Path) -> Verified:
    """Re-read a dataset, a run, a store or a map.

    Raises
    ------
    UsageError
        When the path is none of these.

    """
    if not path.exists():
        raise UsageError(f"{path}: there is no such directory; give a dataset, a run, a store or a map")
    if (path / CARD).is_file():
        return _verified(path, "dataset", _dataset(path))
    if path.suffix == ".zarr":
        return _verified(path, "map", _map(path))
    if is_store(path):
        return _verified(path, "store", _store(Store(path)))
    found = run_at(path)
    if found is None:
        raise UsageError(f"{path}: is no dataset, run, store or map (.zarr); give one of these directories")
    store, runs = found
    return _verified(path, "run", (entry for run in runs for entry in _run(store, run)))


Finding = tuple[str, int] | str
"""What was read and how much of it, or a problem."""


def _verified(path: Path, kind: str, findings: Iterator[Finding]) -> Verified:
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
    return Verified(path, kind, read, tuple(dict.fromkeys(problems)))


def _dataset(directory: Path) -> Iterator[Finding]:
    card = read_card(directory)
    yield from _files(directory, card)
    samples = read_samples(directory)
    yield "samples", samples.num_rows
    try:
        SAMPLES.check(samples)
    except TcpipeError as error:
        yield from (f"{directory / 'samples.parquet'}: {problem}" for problem in error.problems)
        return
    ids = samples.column("sample_id").to_pylist()
    if len(set(ids)) != len(ids):
        yield f"{directory / 'samples.parquet'}: {len(ids) - len(set(ids))} sample ids occur more than once"
    for key, value in plain(measured(samples.select(CARD_COLUMNS), has_terrain="terrain" in card["layers"])).items():
        if card.get(key) != value:
            yield f"{directory / CARD}: {key} is {card.get(key)}, but the samples give {value}"
    used_m = math.fsum(floats(samples, "arc_length_m")[samples.column("split").to_numpy() != "buffer"])
    if not math.isclose(used_m, card["ledger_m"][KEPT], rel_tol=1e-9, abs_tol=1e-6):
        yield f"{directory / CARD}: the ledger keeps {card['ledger_m'][KEPT]:.3f} m, the samples cover {used_m:.3f} m"
    yield from _patches(directory, card, samples)


def _files(directory: Path, card: Mapping[str, Any]) -> Iterator[Finding]:
    """Compare every file with the checksum that the card has of it; name those that it does not know."""
    yield from _checksums(directory, card["checksums"])
    there = {path.relative_to(directory).as_posix() for path in directory.rglob("*") if path.is_file()}
    for name in sorted(there - {*card["checksums"], CARD, REPORT}):
        yield f"{directory / name}: is no file of this dataset"


def _checksums(directory: Path, checksums: Mapping[str, Any]) -> Iterator[Finding]:
    for name, entry in checksums.items():
        path = directory / name
        if not path.is_file():
            yield f"{path}: is gone"
            continue
        size_bytes, sha256 = file_checksum(path)
        if (size_bytes, sha256) != (entry["size_bytes"], entry["sha256"]):
            size = "" if size_bytes == entry["size_bytes"] else f" ({size_bytes} bytes, wanted {entry['size_bytes']})"
            yield f"{path}: its sha256 is {sha256[:12]}…, wanted {entry['sha256'][:12]}…{size}"
    yield "files", len(checksums)


def _patches(directory: Path, card: Mapping[str, Any], samples: pa.Table) -> Iterator[Finding]:
    """Decode every patch; compare order, ids and values with the samples and the class table."""
    files = open_patches(directory, card)
    split = samples.column("split").to_numpy()
    place = np.empty(samples.num_rows, np.int64)  # of each row of samples in the files
    for name, rows in rows_in_files(card, split).items():
        place[split == name] = rows
    ids = np.empty(samples.num_rows, object)
    ids[place] = samples.column("sample_id").to_numpy()
    classes = max((entry["id"] for entry in card["classes"]), default=0)
    for piece in range(len(files.starts) - 1):
        try:
            yield from _piece(files, piece, classes)
        except DatasetError as error:
            yield from error.problems
    yield from _ids(directory, card, ids)


def _piece(files: PatchFiles, piece: int, classes: int) -> Iterator[Finding]:
    pixels = files.read(piece, files.layers)
    first, rows = int(files.starts[piece]), len(next(iter(pixels.values())))
    if "terrain" in pixels and pixels["terrain"].max(initial=0) > classes:
        yield f"{files.directory}: patches {first} to {first + rows - 1} hold classes above {classes}, the last of the table"
    floor = pixels["height"].reshape(rows, -1).min(axis=1)
    if floor.any():
        yield f"{files.directory}: patches {first} to {first + rows - 1}: {int((floor > 0).sum())} do not begin at height 0"
    yield "patches", rows


def _ids(directory: Path, card: Mapping[str, Any], ids: np.ndarray[Any, np.dtype[Any]]) -> Iterator[Finding]:
    """Compare the ids beside the patches, in the order of the files, with those of the samples."""
    if card["format"] == "zarr":
        if zarr_sample_ids(directory) != ids.tolist():
            yield f"{directory / PATCHES}: its sample ids are not those of samples.parquet, in their order"
        return
    first = 0
    for shard in card["shards"]:
        found = read_table(directory / shard["path"], ["sample_id"]).column("sample_id").to_pylist()
        if found != ids[first : first + shard["rows"]].tolist():
            yield f"{directory / shard['path']}: its sample ids are not those of samples.parquet, in their order"
        first += shard["rows"]


def _store(store: Store) -> Iterator[Finding]:
    for name in store.maps():
        yield from _isolated(_map(store.map_path(name)))
    runs = store.runs()
    for run in runs:
        yield from _isolated(_run(store, run))
    finished = {run.run_id for run in runs}
    for run_id in store.run_ids():
        if run_id not in finished:
            yield f"{store.runs_path / run_id}: holds no finished ingestion; ingest its log again"


def _isolated(findings: Iterator[Finding]) -> Iterator[Finding]:
    """Turn an error into problems, so that one damaged run or map does not hide the others."""
    try:
        yield from findings
    except TcpipeError as error:
        yield from error.problems


def _run(store: Store, run: RunDirectory) -> Iterator[Finding]:
    yield "runs", 1
    yield from _checksums(run.path, run.manifest.get("checksums", {}))
    tables = {}
    for name, schema in _TABLES.items():
        table = read_table(run.path / f"{name}.parquet").replace_schema_metadata(None)
        try:
            schema.check(table)
        except TcpipeError as error:
            yield from (f"{run.path / name}.parquet: {problem}" for problem in error.problems)
        tables[name] = table
        yield "rows", table.num_rows
    manifest, where = run.manifest, run.path / "manifest.json"
    counts = {"track": "track_rows", "segments": "segments", "rejections": "rejections"}
    for name, count in counts.items():
        wanted = manifest["counts"].get(count, tables[name].num_rows)
        if wanted != tables[name].num_rows:
            yield f"{run.path / name}.parquet: {tables[name].num_rows} rows, its manifest says {wanted}"
    covered_m = math.fsum(floats(tables["segments"], "arc_length_m"))
    if not math.isclose(covered_m, manifest["ledger_m"].get(KEPT, 0.0), rel_tol=1e-9, abs_tol=1e-6):
        yield f"{where}: the ledger keeps {manifest['ledger_m'].get(KEPT, 0.0):.3f} m, the segments cover {covered_m:.3f} m"
    recipe = parse_recipe(manifest["recipe"], where=str(where))
    if manifest["ingest_key"] != ingest_key(recipe) or run.recipe_id != recipe_id(recipe, run.robot):
        yield f"{where}: its recipe is not the one that the directory is named after"
    yield from _streams(store, run)


def _streams(store: Store, run: RunDirectory) -> Iterator[Finding]:
    """Read the streams and, where it still lies there, the log that the run was made from."""
    known = store.run_json(run.run_id)
    if known is None:
        yield f"{run.path.parent}: run.json is missing; ingest the log again with --force"
        return
    for path in sorted((run.path.parent / "streams").glob("*.parquet")):
        table = read_table(path).replace_schema_metadata(None)
        if path.stem not in STREAMS:
            yield f"{path}: is no stream of a run"
            continue
        try:
            STREAMS[path.stem].check(table)
        except TcpipeError as error:
            yield from (f"{path}: {problem}" for problem in error.problems)
        yield "rows", table.num_rows


def _map(path: Path) -> Iterator[Finding]:
    source = open_map(path)
    yield "maps", 1
    for factor in source.factors:
        level = source if factor == 1 else source.at(factor)
        for layer in source.layers:
            yield from _layer(path, level, layer, None if factor > 1 else source.facts["covered"][layer])


def _layer(path: Path, level: MapFile, layer: str, covered: float | None) -> Iterator[Finding]:
    """Decode every tile of a layer; compare its coverage with what was recorded, and its classes with the table."""
    grid, side, with_data, highest = level.grid, level.tile_px, 0, 0
    for row in range(0, grid.rows, side):
        for col in range(0, grid.cols, side):
            try:
                tile = level.read(layer, row, min(row + side, grid.rows), col, min(col + side, grid.cols))
            except TcpipeError as error:
                yield from error.problems
                continue
            with_data += int(np.isfinite(tile).sum() if layer == "height" else (tile > 0).sum())
            highest = max(highest, int(tile.max(initial=0)) if layer == "terrain" else 0)
            yield "tiles", 1
    share = with_data / (grid.rows * grid.cols)
    if covered is not None and not math.isclose(share, covered, rel_tol=1e-9):
        yield f"{path}: {layer} covers {share:.6%} of the map, {covered:.6%} when it was added; add the map again"
    if highest > level.classes.count:
        yield f"{path}: {layer} holds class {highest}, the table ends at {level.classes.count}"
