"""What a path holds: a log, a map, a dataset, a run or a store, told without changing anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tcpipe.errors import TcpipeError, UsageError
from tcpipe.formats.json_files import plain
from tcpipe.formats.logs.log_file import belongs_to_a_log, logs_below, open_log
from tcpipe.formats.object_storage import copied, is_url
from tcpipe.pipeline.log_inspection import inspect_log
from tcpipe.recipe import Recipe
from tcpipe.store import RunDirectory, Store, is_store, run_at


def inspect(
    path: Path | str,
    *,
    recipe: Recipe,
    robot: str | None = None,
    full: bool = False,
    message_definitions: Path | None = None,
) -> dict[str, Any]:
    """Return what the path holds as JSON values; ``kind`` is log, logs, map, dataset, run or store.

    Parameters
    ----------
    full
        Read every message of a log: damage, gaps, stamps and clocks, instead of its index alone.
    message_definitions
        A directory of .msg or .idl files for types that a log does not define.

    Raises
    ------
    LogError, MapError, DatasetError, StoreError
        When it is none of these, or cannot be read.

    """
    how = {"robot": robot or recipe.robot, "full": full, "message_definitions": message_definitions}
    if is_url(path):
        with copied(str(path), wanted=belongs_to_a_log) as copy:
            return _named(_logs_at(copy, recipe, **how), str(copy), str(path).rstrip("/"))
    path = Path(path)
    if not path.exists():
        raise UsageError(f"{path}: there is no such file or directory")
    if (path / "dataset.json").is_file():
        from tcpipe.formats.dataset_files import read_current_card  # noqa: PLC0415  as below

        return {**plain(read_current_card(path)), "kind": "dataset", "path": str(path)}
    if is_store(path):
        return _store(Store(path))
    found = run_at(path)
    if found:
        return _run(path, *found)
    if path.suffix == ".zarr":
        from tcpipe.formats.maps.map_files import open_map  # noqa: PLC0415  it takes longer to load than a log to inspect

        return {"kind": "map", "path": str(path), **plain(open_map(path).summary())}
    return _logs_at(path, recipe, **how)


def _logs_at(path: Path, recipe: Recipe, **how: Any) -> dict[str, Any]:
    logs = logs_below(path) if path.is_dir() else [path]
    if not logs:
        raise UsageError(f"{path}: is no map, dataset, run or store, and holds no log")
    if len(logs) == 1:
        return _one(logs[0], recipe, **how)
    return {"kind": "logs", "path": str(path), "logs": [_one_of(entry, recipe, **how) for entry in logs]}


def _named(found: dict[str, Any], copy: str, url: str) -> dict[str, Any]:
    """Return what was found in a copy with the URL in the place of the copy's path."""
    texts: dict[str, Any] = {key: value.replace(copy, url) for key, value in found.items() if isinstance(value, str)}
    if "problems" in found:
        texts["problems"] = [line.replace(copy, url) for line in found["problems"]]
    if "logs" in found:
        texts["logs"] = [_named(log, copy, url) for log in found["logs"]]
    return {**found, **texts}


def _one(
    path: Path, recipe: Recipe, *, robot: str | None, full: bool, message_definitions: Path | None
) -> dict[str, Any]:
    with open_log(path, message_definitions=message_definitions) as log:
        return inspect_log(log, recipe, robot, full=full)


def _one_of(path: Path, recipe: Recipe, **how: Any) -> dict[str, Any]:
    try:
        return _one(path, recipe, **how)
    except TcpipeError as error:
        return {"kind": "log", "path": str(path), "problems": list(error.problems)}


def _run(path: Path, store: Store, runs: list[RunDirectory]) -> dict[str, Any]:
    run_id = runs[0].run_id
    known = store.run_json(run_id)
    return {
        "kind": "run",
        "path": str(path),
        "run_id": run_id,
        "source": plain(known.source) if known else {},
        "tags": dict(known.tags) if known else {},
        "remarks": list(known.remarks) if known else [],
        "recipes": [
            {
                **_line(run),
                "counts": plain(run.manifest.counts),
                "ledger_m": dict(run.manifest.ledger_m),
                "warnings": list(run.manifest.warnings),
                "damage": list(run.manifest.damage),
            }
            for run in runs
        ],
    }


def _store(store: Store) -> dict[str, Any]:
    found = store.ingestions()
    runs, outdated = found.finished, {run_id: str(head.data_model_version) for run_id, head in found.outdated.items()}
    damaged = {str(path): line for path, line in found.damaged.items()}
    seen = {*outdated, *found.superseded, *(run.run_id for run in runs), *(path.parent.name for path in found.damaged)}
    return {
        "kind": "store",
        "path": str(store.root),
        "maps": store.maps(),
        "runs": [
            {**_line(run), "warnings": len(run.manifest.warnings), "damage": len(run.manifest.damage)} for run in runs
        ],
        "outdated": outdated,
        "damaged_runs": damaged,
        "superseded": dict(found.superseded),
        "unfinished": sorted(set(store.run_ids()) - seen),
    }


def _line(run: RunDirectory) -> dict[str, Any]:
    return {
        "run_id": run.run_id,
        "recipe_id": run.recipe_id,
        "robot": run.manifest.robot,
        "segments": run.manifest.counts.segments,
        "distance_m": sum(run.manifest.ledger_m.values()),
    }
