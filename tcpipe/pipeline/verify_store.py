"""A store, its maps and its runs, held against the checksums, counts and contracts that were written with them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tcpipe.errors import StoreError, TcpipeError
from tcpipe.formats.atomic import TEMPORARY_PREFIX, is_abandoned
from tcpipe.formats.json_files import typed
from tcpipe.formats.maps.map_files import MapFile, open_map
from tcpipe.formats.parquet import read_table
from tcpipe.formats.recipe_toml import ingest_key, recipe_id
from tcpipe.formats.run_documents import Manifest
from tcpipe.formats.seals import CHECKSUMS, broken_checksums, broken_seal, read_checksums, read_sealed
from tcpipe.pipeline.dataset.segments import KEPT
from tcpipe.report.overview import shows_map
from tcpipe.store import Store
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.levels import DATA_MODEL_VERSION, GATED_TRACK, LABELLED_SEGMENTS, READ_VERSIONS, REJECTIONS, STREAMS

Finding = tuple[str, int] | str

_TABLES = {"track": GATED_TRACK, "segments": LABELLED_SEGMENTS, "rejections": REJECTIONS}
_COUNTS = {"track": "track_rows", "segments": "segments", "rejections": "rejections"}
_RUN, _MANIFEST, _REPORT, _STREAMS = "run.json", "manifest.json", "report.html", "streams"


def verify_store(store: Store) -> Iterator[Finding]:
    """Yield what was read of all maps and runs, and a line for everything that is not as it was written."""
    for path in sorted(store.records_path.rglob("*")):
        if path.suffix == ".json" and TEMPORARY_PREFIX not in str(path.relative_to(store.root)):
            yield broken_seal(path) or ("records", 1)
        elif not path.is_dir() or path.name.startswith(TEMPORARY_PREFIX):
            yield from _stranger(path)
    for path in _entries(store.root / "maps"):
        if path.suffix == ".zarr":
            yield from _isolated(verify_map(path))
        elif path.suffix == ".png" and path.with_suffix(".zarr").is_dir():
            yield from _isolated(_quick_look(path))
        else:
            yield from _stranger(path)
    for path in _entries(store.runs_path):
        if path.is_dir() and not path.name.startswith(TEMPORARY_PREFIX):
            yield from verify_run(store, path.name)
        else:
            yield from _stranger(path)


def verify_run(store: Store, run_id: str, recipe: str | None = None) -> Iterator[Finding]:
    """Yield the same of one run: its log's description, its streams, and what became of it under every recipe, or one."""
    directory = store.runs_path / run_id
    yield broken_seal(directory / _RUN) or ("files", 1)
    recipes = 0
    for path in _entries(directory):
        if path.is_dir() and path.name == _STREAMS:
            yield from _isolated(_streams(path))
        elif path.is_dir() and not path.name.startswith(TEMPORARY_PREFIX):
            recipes += 1
            if recipe in (None, path.name):
                yield from _isolated(_ingestion(path))
        elif path.name != _RUN:
            yield from _stranger(path)
    if not recipes:
        yield f"{directory}: holds no finished ingestion; ingest its log again"


def strangers_in(directory: Path) -> Iterator[Path]:
    """Yield what no call of tcpipe has written into the directory of a run, or of one of its ingestions."""
    known = {f"{role}.parquet" for role in STREAMS} | {f"{name}.parquet" for name in _TABLES}
    known |= {_RUN, _MANIFEST, _REPORT, CHECKSUMS}
    yield from (path for path in sorted(directory.rglob("*")) if not path.is_dir() and path.name not in known)


def verify_map(path: Path) -> Iterator[Finding]:
    """Yield the same of one map: every file, and every tile of every layer and level decoded."""
    yield "maps", 1
    checksums = yield from _listed(path)
    if checksums is None:
        return
    source = open_map(path, proved=False)
    for factor in source.factors:
        level = source if factor == 1 else source.at(factor)
        for layer in source.layers:
            yield from _layer(path, level, layer, None if factor > 1 else source.facts.covered[layer])


def _quick_look(path: Path) -> Iterator[Finding]:
    yield broken_seal(path) or ("files", 1)
    map_path = path.with_suffix(".zarr")
    if broken_seal(map_path / CHECKSUMS) is None and not shows_map(path, map_path):
        yield f"{path}: does not show {path.stem}.zarr as it is; the add-map that made the map draws it anew"


def _entries(directory: Path) -> list[Path]:
    return sorted(directory.iterdir()) if directory.is_dir() else []


def _stranger(path: Path) -> Iterator[str]:
    """Yield a line about what does not belong here; what another process is writing now does."""
    if not path.name.startswith(TEMPORARY_PREFIX):
        yield f"{path}: is no file of this store"
    elif is_abandoned(path):
        yield f"{path}: was left behind by a command that was killed; the next tcpipe ingest or add-map removes it"


def _isolated(findings: Iterator[Finding]) -> Iterator[Finding]:
    """Turn an error into problems, so that one damaged run or map does not hide the others."""
    try:
        yield from findings
    except TcpipeError as error:
        yield from error.problems


def _listed(directory: Path) -> Any:
    """Compare every file below a directory with its ``checksums.json``; return what that lists, or None if it cannot be trusted."""
    try:
        checksums = read_checksums(directory)
    except StoreError as error:
        yield from error.problems
        return None
    yield from broken_checksums(directory, checksums)
    yield "files", len(checksums) + 1
    yield from _unlisted(directory, {*checksums, CHECKSUMS})
    return checksums


def _unlisted(directory: Path, known: set[str]) -> Iterator[str]:
    there = {path.relative_to(directory).as_posix() for path in directory.rglob("*") if not path.is_dir()}
    for name in sorted(there - known):
        yield from _stranger(directory / name)


def _streams(directory: Path) -> Iterator[Finding]:
    checksums = yield from _listed(directory)
    for name in checksums or ():
        table = read_table(directory / name).replace_schema_metadata(None)
        try:
            STREAMS[Path(name).stem].check(table)
        except TcpipeError as error:
            yield from (f"{directory / name}: {problem}" for problem in error.problems)
        yield "rows", table.num_rows


def _ingestion(directory: Path) -> Iterator[Finding]:
    """Compare what a run became under one recipe with its manifest."""
    yield "runs", 1
    where = directory / _MANIFEST
    document = read_sealed(where)
    if document["data_model_version"] not in READ_VERSIONS:
        yield (
            f"{where}: of data model {document['data_model_version']}, this version knows {DATA_MODEL_VERSION}; "
            "ingest the log again, then remove this directory"
        )
        return
    manifest, recipe = typed(document, Manifest, where), document["recipe"]
    of = (ingest_key(recipe), recipe_id(recipe, manifest.robot)) if isinstance(recipe, Mapping) else None
    if of != (manifest.ingest_key, directory.name):
        yield f"{where}: its recipe is not the one that the directory is named after"
    yield from broken_checksums(directory, manifest.checksums)
    yield "files", len(manifest.checksums) + 1
    yield from _unlisted(directory, {*manifest.checksums, _MANIFEST, _REPORT})
    if (directory / _REPORT).exists():
        yield broken_seal(directory / _REPORT) or ("files", 1)
    tables = {}
    for name, schema in _TABLES.items():
        tables[name] = schema.completed(read_table(directory / f"{name}.parquet").replace_schema_metadata(None))
        try:
            schema.check(tables[name])
        except TcpipeError as error:
            yield from (f"{directory / name}.parquet: {problem}" for problem in error.problems)
            return
        yield "rows", tables[name].num_rows
    yield from (f"{where}: {problem}" for problem in _disagreements(directory, manifest, tables))
    yield from (f"{directory / 'segments.parquet'}: {problem}" for problem in _wrong_joins(directory, manifest, tables))


def _disagreements(directory: Path, manifest: Manifest, tables: Mapping[str, pa.Table]) -> Iterator[str]:
    """Yield what the manifest says otherwise than its directory and its tables."""
    for name, count in _COUNTS.items():
        said = getattr(manifest.counts, count)
        if said not in (None, tables[name].num_rows):
            yield f"{count} is {said}, but {name}.parquet has {tables[name].num_rows} rows"
    covered_m, kept_m = math.fsum(floats(tables["segments"], "arc_length_m")), manifest.ledger_m.get(KEPT, 0.0)
    if not math.isclose(covered_m, kept_m, rel_tol=1e-9, abs_tol=1e-6):
        yield f"the ledger keeps {kept_m:.3f} m, the segments cover {covered_m:.3f} m"
    if manifest.run_id != directory.parent.name:
        yield f"is of run {manifest.run_id}, but lies in {directory.parent.name}"


def _wrong_joins(directory: Path, manifest: Manifest, tables: Mapping[str, pa.Table]) -> Iterator[str]:
    """Yield what is wrong between segments and their run and track."""
    segments, run_id = tables["segments"], directory.parent.name
    start_ns, end_ns = (integers(segments, f"{end}_ns") for end in ("start", "end"))
    if segments.column("segment_id").to_pylist() != [f"{run_id}-{stamp}" for stamp in start_ns.tolist()]:
        yield "its segment ids are not the run's id and their start stamps"
    for column, wanted in (("run_id", run_id), ("robot", manifest.robot)):
        others = set(segments.column(column).unique().to_pylist()) - {wanted}
        if others:
            yield f"holds segments of {column} {', '.join(sorted(others))}; wanted {wanted}"
    if len(start_ns) and (np.any(end_ns <= start_ns) or np.any(start_ns[1:] < end_ns[:-1])):
        yield "its segments do not follow one another in time"
    stamps = integers(tables["track"], "stamp_ns")
    if len(start_ns) and len(stamps) and (start_ns.min() < stamps.min() or end_ns.max() > stamps.max()):
        yield "its segments begin before the track or end after it"


def _layer(path: Path, level: MapFile, layer: str, covered: float | None) -> Iterator[Finding]:
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
        yield f"{path}: {layer} holds class {highest}, the table ends at {kind.high:g}"
