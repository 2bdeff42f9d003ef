"""Inspection of a log, a map, a dataset, a run or a store, which changes nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from tcpipe.errors import StoreError, TcpipeError, UsageError
from tcpipe.formats.atomic import Location, make_scratch_directory
from tcpipe.formats.json_files import convert_record
from tcpipe.formats.logs.log_file import list_logs_below
from tcpipe.formats.logs.log_joining import open_single_log
from tcpipe.formats.logs.table_folders import find_table_logs, is_log_file, is_table, list_table_files
from tcpipe.formats.object_storage import format_path, is_presigned, is_url
from tcpipe.formats.published_outputs import CARDS, fetch_directory_by_range, find_newest
from tcpipe.formats.recipe_toml import resolve_recipe
from tcpipe.formats.runs import Counts, LogOrigin, RunFacts
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.pipeline.log_inspection import InspectedLog, inspect_log
from tcpipe.pipeline.log_sources import find_remote_logs
from tcpipe.pipeline.proposals import propose_tables
from tcpipe.recipe import Recipe
from tcpipe.store import Store, find_named_runs, is_path, is_store
from tcpipe.tables.findings import AFFECTED, Findings, Grade, Verdict
from tcpipe.tables.levels import DATA_MODEL_VERSION

if TYPE_CHECKING:
    from tcpipe.formats.dataset_card import InspectedDataset
    from tcpipe.formats.maps.map_facts import InspectedMap


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedLogs:
    """Inspection of every log of a folder."""

    kind: Literal["logs"] = "logs"
    path: str
    logs: tuple[InspectedLog, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedRecipe(RunFacts):
    """A run under one recipe: its facts, and the verdict by the catalogue of this version."""

    counts: Counts
    verdict: Verdict = field()  # else the property of `RunFacts` would be its default


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedRun:
    """A run, under every recipe."""

    kind: Literal["run"] = "run"
    path: str
    """Its store."""
    run_id: str
    log: LogOrigin
    tags: Mapping[str, str]
    notes: Findings
    recipes: tuple[InspectedRecipe, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class GradedRun:
    """A run under one recipe: its grades, and its number of findings."""

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
    """Inspection of a store."""

    kind: Literal["store"] = "store"
    path: str
    maps: tuple[str, ...]
    runs: tuple[GradedRun, ...]
    outdated: Mapping[str, str]
    """Data model of each run of another one, by RUN/RECIPE."""
    incomplete: tuple[str, ...]
    """RUN/RECIPE of each run whose tables are missing."""
    damaged: tuple[str, ...]
    """Documents that are not as they were written."""
    superseded: Mapping[str, str]
    """The run that supersedes each superseded run."""


Inspected: TypeAlias = (
    "InspectedLog | InspectedLogs | InspectedTables | InspectedMap | InspectedDataset | InspectedRun | InspectedStore"
)


def inspect(
    path: Location,
    *,
    recipe: Recipe | Location | None = None,
    robot: str | None = None,
    full: bool = False,
    message_definitions: Path | None = None,
    store: Location = "tcpipe-store",
) -> Inspected:
    """Return the content of a path or a stored run; with ``full`` read every message, for damage, gaps and clocks.

    ``message_definitions`` is a directory of .msg or .idl files for types that a log does not define. `UsageError`,
    `LogError`, `MapError`, `DatasetError`, `StoreError`: the path is something else, or cannot be read.
    """
    ruling = resolve_recipe(recipe)

    def ask(at: Location) -> InspectedLog:
        with open_single_log(at, message_definitions=message_definitions, tables=ruling.tables) as log:
            return replace(inspect_log(log, ruling, robot or ruling.robot, full=full), path=format_path(at))

    if is_url(path):
        return _inspect_url(str(path).rstrip("/"), ask)
    if not is_path(path):
        runs = find_named_runs(path, store)
        run, manifests = runs[0], [run.manifest for run in runs]
        return InspectedRun(
            path=run.place.where(),
            run_id=run.run_id,
            log=run.facts.log,
            tags=run.facts.tags,
            notes=manifests[0].notes,
            recipes=tuple(convert_record(each, InspectedRecipe, verdict=each.verdict) for each in manifests),
        )
    path = Path(path)
    if (path / "dataset.json").is_file():
        return _inspect_dataset(path, str(path))
    if is_store(path):
        return _inspect_store(Store(path))
    if path.suffix == ".zarr":
        from tcpipe.formats.maps.map_facts import InspectedMap  # noqa: PLC0415
        from tcpipe.formats.maps.map_files import open_map  # noqa: PLC0415  it takes longer to load than a log to inspect

        return convert_record(open_map(path).summary(), InspectedMap, path=str(path))
    return _inspect_logs_or_tables(path, ruling, ask)


def _inspect_url(url: str, ask: Callable[[Location], InspectedLog]) -> Inspected:
    """Inspect a log, store or dataset at a URL, or all logs below it."""
    if is_presigned(url):
        return ask(url)
    if not is_log_file(url):  # the rest of a log need not be readable
        with suppress(StoreError):  # the search for logs reports problems of the bucket
            if is_store(url):
                return _inspect_store(Store(url))
        if find_newest(url, CARDS):
            from tcpipe.formats.dataset_files import is_shard  # noqa: PLC0415  as above

            return _inspect_dataset(fetch_directory_by_range(url, by_range=is_shard)[0], url)
    with make_scratch_directory() as directory:
        urls = list(find_remote_logs(url, directory / "logs").values())
    return _inspect_logs_at(urls, url, ask)


def _inspect_dataset(directory: Path, name: str) -> InspectedDataset:
    from tcpipe.formats.dataset_card import InspectedDataset  # noqa: PLC0415
    from tcpipe.formats.dataset_files import read_intact_card  # noqa: PLC0415  as above

    return convert_record(read_intact_card(directory), InspectedDataset, kind="dataset", path=name)


def _inspect_logs_or_tables(
    path: Path, recipe: Recipe, ask: Callable[[Location], InspectedLog]
) -> InspectedLog | InspectedLogs | InspectedTables:
    of_tables = [files[0] for files in find_table_logs(path, recipe.tables)]
    if path.is_dir():
        logs = [*list_logs_below(path), *of_tables]
        if logs or not list_table_files(path):
            return _inspect_logs_at(logs, path, ask)
    elif of_tables or not is_table(path.name):
        return ask(path)
    return InspectedTables(path=str(path), recipe=propose_tables(path).toml())


def _inspect_logs_at(
    logs: Sequence[Location], path: Location, ask: Callable[[Location], InspectedLog]
) -> InspectedLog | InspectedLogs:
    if not logs:
        raise UsageError(f"{path}: is no map, dataset, run or store, and contains no log")
    if len(logs) == 1:
        return ask(logs[0])
    inspected = list[InspectedLog]()
    for entry in logs:
        try:
            inspected.append(ask(entry))
        except TcpipeError as error:
            inspected.append(InspectedLog(path=format_path(entry), problems=error.problems))
    return InspectedLogs(path=str(path), logs=tuple(inspected))


def _inspect_store(store: Store) -> InspectedStore:
    state = store.scan()
    rows = {f"{row.run_id}/{row.recipe_id}": row for row in state.list_rows() if row.blob}
    return InspectedStore(
        path=str(store.root),
        maps=tuple(state.maps),
        runs=tuple(_grade_run(run) for run in store.runs(state)),
        outdated={
            name: row.data_model_version for name, row in rows.items() if row.data_model_version != DATA_MODEL_VERSION
        },
        incomplete=tuple(name for name, row in rows.items() if not state.has_payload(row)),
        damaged=tuple(map(store.place.where, sorted(state.damaged))),
        superseded={row.run_id: row.superseded_by for row in rows.values() if row.superseded_by},
    )


def _grade_run(run: StoredRun) -> GradedRun:
    facts, verdict = run.facts, run.facts.verdict
    grades = {name: getattr(verdict, name) for name in AFFECTED}
    return convert_record(facts, GradedRun, **grades, findings=len(facts.findings), damage=len(facts.damage))


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedTables:
    """Tables without a mapping in the recipe: their columns, and the recipe that is proposed."""

    kind: Literal["tables"] = "tables"
    path: str
    recipe: str
    """Recipe of ``tcpipe init --from`` [TOML]."""
