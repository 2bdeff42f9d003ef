"""What a dataset is made from: which runs and which map of a store, and one hash over all of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe import __version__
from tcpipe.errors import DatasetError, MapError, StoreError
from tcpipe.formats.dataset_files import (
    FileFormat,
    read_card,
    read_samples,
    sample_columns,
)
from tcpipe.formats.json_files import digest, plain, read_json
from tcpipe.formats.recipe_toml import ingest_key
from tcpipe.formats.seals import CHECKSUMS, broken_seal, file_checksum, file_checksums
from tcpipe.pipeline.recordings import each_drive_once
from tcpipe.recipe import Recipe
from tcpipe.store import RunDirectory, Store
from tcpipe.tables.levels import DATA_MODEL_VERSION

_SECTIONS = ("segment", "label", "sample", "split", "dataset")


@dataclass(frozen=True, slots=True)
class Inputs:
    """Runs by id and what the card says of each, the maps, the hash over all inputs, and what was noticed on the way."""

    runs: tuple[RunDirectory, ...]
    sources: tuple[dict[str, Any], ...]
    map_names: tuple[str, ...]
    """In order of priority where maps overlap."""
    map_paths: tuple[Path, ...]
    map_sha256: tuple[str, ...]
    """Over the checksums of each map's files."""
    again: Mapping[str, NDArray[np.bool_]]
    """By run: which of its segments another run has too."""
    digest: str
    warnings: tuple[str, ...]


def choose_inputs(
    store: Store,
    recipe: Recipe,
    *,
    map_names: Sequence[str],
    robot: str | None,
    region: bytes | None,
    file_format: FileFormat,
    tags: Mapping[str, str] | None = None,
    earlier: pa.Table | None = None,
) -> Inputs:
    """Return the runs of one robot ingested with this recipe and the maps, or raise `DatasetError` that lists the candidates."""
    names = choose_maps(store, map_names)
    chosen, warnings = choose_runs(store, recipe, robot=robot, tags=tags or {})
    once = each_drive_once(chosen, {run.run_id: _source(store, run)["sha256"] for run in chosen})
    runs = once.runs
    paths = tuple(store.map_path(name) for name in names)
    map_sha256 = tuple(_map_digest(name, path) for name, path in zip(names, paths, strict=True))
    values = plain(asdict(recipe))
    fingerprint = digest(
        {
            "versions": [__version__, DATA_MODEL_VERSION],
            "recipe": {section: values[section] for section in _SECTIONS},
            "runs": [_run_fingerprint(run) for run in runs],
            "maps": list(zip(names, map_sha256, strict=True)),
            "region": None if region is None else region.decode("utf-8", "replace"),
            "format": file_format,
            **({} if earlier is None else {"kept_split": _table_digest(earlier)}),
        }
    )
    sources = tuple(run_source(store, run) for run in runs)
    return Inputs(runs, sources, names, paths, map_sha256, once.again, fingerprint, (*warnings, *once.warnings))


def _map_digest(name: str, path: Path) -> str:
    """Return one hash over a map's files; `MapError` if they are not as they were written: a lost one would read as no data."""
    found = file_checksums(path)
    problem = broken_seal(path / CHECKSUMS)
    recorded = {} if problem else read_json(path / CHECKSUMS)["checksums"]
    wrong = sorted(
        file
        for file in {*found, *recorded} - {CHECKSUMS}
        if found.get(file) != tuple(recorded.get(file, {}).get(key) for key in ("size_bytes", "sha256"))
    )
    if problem or wrong:
        what = problem or f"{path / wrong[0]}{f' and {len(wrong) - 1} more' if len(wrong) > 1 else ''}"
        raise MapError(
            f"map {name}: not as it was written: {what} ('tcpipe verify {path}' lists everything); add the map again with --force"
        )
    return digest(found)


def earlier_splits(directory: Path) -> pa.Table:
    """Return ``sample_id``, ``split`` and, where there is one, ``fold`` of a dataset of any data model; `DatasetError` if it is none."""
    read_card(directory)
    there = sample_columns(directory)
    missing = [name for name in ("sample_id", "split") if name not in there]
    if missing:
        raise DatasetError(f"{directory}: its samples have no column {missing[0]}; its split cannot be kept")
    return read_samples(directory, [name for name in ("sample_id", "split", "fold") if name in there])


def choose_maps(store: Store, names: Sequence[str]) -> tuple[str, ...]:
    """Return the maps to sample: those named, in their order, or the only one."""
    maps = store.maps()
    if not maps:
        raise DatasetError(f"{store.root}: no map in the store; add one: tcpipe add-map NAME --height FILE")
    unknown = [name for name in names if name not in maps]
    if unknown:
        raise DatasetError(f"{store.root}: no map {unknown[0]!r} in the store; there are {', '.join(maps)}")
    if not names and len(maps) > 1:
        raise DatasetError(
            f"{store.root}: {len(maps)} maps in the store ({', '.join(maps)}); name one with --map, or several, the first to rule "
            "where they overlap"
        )
    return tuple(dict.fromkeys(names)) or (maps[0],)


def choose_runs(
    store: Store, recipe: Recipe, *, robot: str | None, tags: Mapping[str, str]
) -> tuple[list[RunDirectory], list[str]]:
    """Return the runs to pool, those that carry all of the tags, and warnings; two robots are never pooled unasked."""
    every, outdated = store.runs(), store.outdated()
    if not every and outdated:
        versions = ", ".join(sorted(set(outdated.values())))
        raise DatasetError(
            f"{store.root}: {len(outdated)} runs in the store, all of data model {versions}, wanted {DATA_MODEL_VERSION}; "
            "ingest their logs again"
        )
    if not every:
        raise DatasetError(f"{store.root}: no runs in the store; ingest one: tcpipe ingest LOG")
    key = ingest_key(recipe)
    mine = [run for run in every if run.manifest["ingest_key"] == key]
    if not mine:
        raise DatasetError(
            f"{store.root}: {len({run.run_id for run in every})} runs in the store, none ingested with this recipe; "
            "ingest them with it (tcpipe ingest LOG), or give the recipe they were ingested with (--recipe FILE)"
        )
    mine = _tagged(store, mine, tags)
    robots = sorted({run.robot for run in mine})
    chosen = [run for run in mine if robot is None or run.robot == robot]
    if not chosen:
        raise DatasetError(f"{store.root}: no run of robot {robot!r}; there are runs of {', '.join(robots)}")
    if robot is None and len(robots) > 1:
        raise DatasetError(f"{store.root}: runs of {len(robots)} robots ({', '.join(robots)}); name one with --robot")
    left_out = sorted(
        {run.run_id for run in every} - {run.run_id for run in every if run.manifest["ingest_key"] == key}
    )
    warnings = [f"run {run_id}: ingested with another recipe only; left out" for run_id in left_out]
    warnings += [
        f"run {run_id}: of data model {version}, not {DATA_MODEL_VERSION}; left out until its log is ingested again"
        for run_id, version in outdated.items()
    ]
    return chosen, warnings


def _tagged(store: Store, runs: list[RunDirectory], tags: Mapping[str, str]) -> list[RunDirectory]:
    """Return the runs that carry all of the tags; `DatasetError` with the tags there are where none does."""
    chosen = [run for run in runs if tags.items() <= run.manifest.get("tags", {}).items()]
    if not chosen:
        wanted = " ".join(f"{key}={value}" for key, value in tags.items())
        there = sorted({f"{key}={value}" for run in runs for key, value in run.manifest.get("tags", {}).items()})
        raise DatasetError(f"{store.root}: no run is tagged {wanted}; tags there are: {', '.join(there) or 'none'}")
    return chosen


def run_source(store: Store, run: RunDirectory) -> dict[str, Any]:
    """Return what the card says of a run: its log, by name and sha256, its recipe, robot, tags, warnings and error budget."""
    source = _source(store, run)
    return {
        "run_id": run.run_id,
        "recipe_id": run.recipe_id,
        "robot": run.robot,
        "tags": dict(run.manifest.get("tags", {})),
        "logs": [Path(path).name for path in source["paths"]],
        "sha256": source["sha256"],
        "segments_sha256": file_checksum(run.path / "segments.parquet")[1],
        "warnings": list(run.manifest["warnings"]),
        "energy_budget": run.manifest["info"]["findings"]["facts"].get("label", {}).get("energy_budget"),
    }


def _source(store: Store, run: RunDirectory) -> dict[str, Any]:
    known = store.run_json(run.run_id)
    if known is None:
        raise DatasetError(f"{run.path.parent}: run.json is missing; ingest the log again with --force")
    source: dict[str, Any] = known["source"]
    return source


def _run_fingerprint(run: RunDirectory) -> list[Any]:
    found = size_bytes, sha256 = file_checksum(run.path / "segments.parquet")
    if run.manifest["checksums"].get("segments.parquet") != {"size_bytes": size_bytes, "sha256": sha256}:
        raise StoreError(
            f"{run.path / 'segments.parquet'}: is not as it was written; ingest the log again with --force"
        )
    return [run.run_id, run.recipe_id, found, run.manifest["tags"]]


def _table_digest(table: pa.Table) -> str:
    """Return the sha256 (hex) of a table's values, hashed piece by piece."""
    found = hashlib.sha256()
    for batch in table.to_batches(max_chunksize=65_536):
        found.update(json.dumps(batch.to_pydict(), sort_keys=True).encode())
    return found.hexdigest()
