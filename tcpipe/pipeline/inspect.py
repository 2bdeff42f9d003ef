"""What a path holds: a log, a map, a dataset, a run or a store, told without changing anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from tcpipe.errors import StoreError, TcpipeError, UsageError
from tcpipe.formats.atomic import make_scratch_directory
from tcpipe.formats.bucket_directories import fetch_directory_by_range
from tcpipe.formats.json_files import convert_record
from tcpipe.formats.logs.log_file import is_log_file, list_logs_below
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.logs.table_folders import find_table_logs, is_table, list_table_files
from tcpipe.formats.object_storage import format_path, is_presigned, is_url
from tcpipe.formats.published_outputs import CARDS, find_newest
from tcpipe.formats.run_documents import Counts, Ingestion, LogOrigin
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.pipeline.log_inspection import InspectedLog, inspect_log
from tcpipe.pipeline.log_sources import find_remote_logs
from tcpipe.recipe import Recipe
from tcpipe.store import Store, is_store, run_at
from tcpipe.tables.findings import AFFECTED, Finding, Grade, Verdict

if TYPE_CHECKING:
    from tcpipe.pipeline.inspected import InspectedDataset, InspectedMap


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedLogs:
    """What every log of a folder holds."""

    kind: Literal["logs"] = "logs"
    path: str
    logs: tuple[InspectedLog, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedIngestion(Ingestion):
    """A run under one recipe: what became of it."""

    counts: Counts
    findings: tuple[Finding, ...]
    verdict: Verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedRun:
    """What a run is, under every recipe."""

    kind: Literal["run"] = "run"
    path: str
    run_id: str
    source: LogOrigin | None
    """None where run.json is gone."""
    tags: Mapping[str, str]
    notes: tuple[Finding, ...]
    recipes: tuple[InspectedIngestion, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredIngestion:
    """A run under one recipe: its grades, and how much there is to say of it."""

    run_id: str
    recipe_id: str
    robot: str
    segments: int
    driven_m: float
    position: Grade
    time: Grade
    energy: Grade
    findings: int
    damage: int


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedStore:
    """What a store holds."""

    kind: Literal["store"] = "store"
    path: str
    maps: tuple[str, ...]
    runs: tuple[StoredIngestion, ...]
    outdated: Mapping[str, str]
    """Runs of another data model, and which."""
    damaged_runs: Mapping[str, str]
    """By path, what is wrong."""
    superseded: Mapping[str, str]
    """Runs, and which run supersedes each."""


Inspected: TypeAlias = (
    "InspectedLog | InspectedLogs | InspectedTables | InspectedMap | InspectedDataset | InspectedRun | InspectedStore"
)


def inspect(
    path: Path | str,
    *,
    recipe: Recipe,
    robot: str | None = None,
    full: bool = False,
    message_definitions: Path | None = None,
) -> Inspected:
    """Return what the path holds; with ``full`` from every message of a log, for damage, gaps, stamps and clocks.

    ``message_definitions`` is a directory of .msg or .idl files for types that a log does not define. `LogError`, `MapError`,
    `DatasetError`, `StoreError`: it is none of these, or cannot be read.
    """
    ask = partial(
        _inspect_one, recipe=recipe, robot=robot or recipe.robot, full=full, message_definitions=message_definitions
    )
    if is_url(path):
        return _inspect_url(str(path).rstrip("/"), ask)
    path = Path(path)
    if not path.exists():
        raise UsageError(f"{path}: there is no such file or directory")
    if (path / "dataset.json").is_file():
        return _inspect_dataset(path, str(path))
    if stored := _inspect_in_store(path):
        return stored
    if path.suffix == ".zarr":
        from tcpipe.formats.maps.map_files import open_map  # noqa: PLC0415  it takes longer to load than a log to inspect
        from tcpipe.pipeline.inspected import InspectedMap  # noqa: PLC0415

        return convert_record(open_map(path).summary(), InspectedMap, path=str(path))
    return _inspect_logs_or_tables(path, recipe, ask)


def _inspect_url(url: str, ask: Callable[[Path | str], InspectedLog]) -> Inspected:
    if is_presigned(url):
        return ask(url)
    if not is_log_file(url):  # of a log nothing else need be readable
        with suppress(StoreError):  # what is wrong with the bucket is told where logs are looked for
            if stored := _inspect_in_store(url):
                return stored
        if find_newest(url, CARDS):
            from tcpipe.formats.dataset_files import is_shard  # noqa: PLC0415  as above

            return _inspect_dataset(fetch_directory_by_range(url, by_range=is_shard)[0], url)
    with make_scratch_directory() as directory:
        urls = list(find_remote_logs(url, directory / "logs").values())
    return _inspect_logs_at(urls, url, ask)


def _inspect_dataset(directory: Path, name: str) -> InspectedDataset:
    from tcpipe.formats.dataset_files import read_intact_card  # noqa: PLC0415  as above
    from tcpipe.pipeline.inspected import InspectedDataset  # noqa: PLC0415

    return convert_record(read_intact_card(directory), InspectedDataset, kind="dataset", path=name)


def _inspect_in_store(path: Path | str) -> InspectedStore | InspectedRun | None:
    if is_store(path):
        return _store(Store(path))
    found = run_at(path)
    return _run(path, *found) if found else None


def _inspect_logs_or_tables(
    path: Path, recipe: Recipe, ask: Callable[[Path | str], InspectedLog]
) -> InspectedLog | InspectedLogs | InspectedTables:
    of_tables = [files[0] for files in find_table_logs(path, recipe.tables)]
    if path.is_dir():
        logs = [*list_logs_below(path), *of_tables]
        if logs or not list_table_files(path):
            return _inspect_logs_at(logs, path, ask)
    elif of_tables or not is_table(path.name):
        return ask(path)
    from tcpipe.pipeline.table_proposals import propose_tables  # noqa: PLC0415  polars only where a table is read

    return InspectedTables(path=str(path), recipe=propose_tables(path).toml())


def _inspect_logs_at(
    logs: Sequence[Path | str], path: Path | str, ask: Callable[[Path | str], InspectedLog]
) -> InspectedLog | InspectedLogs:
    if not logs:
        raise UsageError(f"{path}: is no map, dataset, run or store, and contains no log")
    if len(logs) == 1:
        return ask(logs[0])
    return InspectedLogs(path=str(path), logs=tuple(_try_inspect(entry, ask) for entry in logs))


def _inspect_one(
    path: Path | str, *, recipe: Recipe, robot: str | None, full: bool, message_definitions: Path | None
) -> InspectedLog:
    with open_single_log(path, message_definitions=message_definitions, tables=recipe.tables) as log:
        return replace(inspect_log(log, recipe, robot, full=full), path=format_path(path))


def _try_inspect(path: Path | str, ask: Callable[[Path | str], InspectedLog]) -> InspectedLog:
    try:
        return ask(path)
    except TcpipeError as error:
        return InspectedLog(path=format_path(path), problems=error.problems)


def _run(path: Path | str, store: Store, runs: list[RunDirectory]) -> InspectedRun:
    run_id = runs[0].run_id
    known = store.run_json(run_id)
    return InspectedRun(
        path=str(path),
        run_id=run_id,
        source=known.source if known else None,
        tags=known.tags if known else {},
        notes=known.notes if known else (),
        recipes=tuple(
            convert_record(run.manifest, InspectedIngestion, findings=run.manifest.info.report.findings) for run in runs
        ),
    )


def _store(store: Store) -> InspectedStore:
    found = store.ingestions()
    runs, outdated = found.finished, {run_id: row.data_model_version for run_id, row in found.outdated.items()}
    return InspectedStore(
        path=str(store.root),
        maps=tuple(store.maps()),
        runs=tuple(_make_stored(run) for run in runs),
        outdated=outdated,
        damaged_runs={store.runs_place.where("/".join(filter(None, run))): line for run, line in found.damaged.items()},
        superseded=dict(found.superseded),
    )


def _make_stored(run: RunDirectory) -> StoredIngestion:
    facts, verdict = run.facts, run.facts.verdict
    grades = {name: getattr(verdict, name) for name in AFFECTED}
    return convert_record(facts, StoredIngestion, **grades, findings=len(facts.findings), damage=len(facts.damage))


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedTables:
    """Tables without a mapping in the recipe: their columns, and the recipe that is proposed."""

    kind: Literal["tables"] = "tables"
    path: str
    recipe: str
    """What ``tcpipe init --from`` would write [TOML]."""
