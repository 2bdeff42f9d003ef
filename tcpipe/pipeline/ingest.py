"""From logs to labelled segments in the store: one task a log, side by side, each whole or not at all."""

from __future__ import annotations

import logging
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from tcpipe import __version__
from tcpipe.errors import LogError, TcpipeError, UsageError, plain_line
from tcpipe.execution import run_all
from tcpipe.formats.joined_log import open_logs
from tcpipe.formats.json_files import plain
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.recipe_toml import find_recipe, ingest_key, load_recipe, read_key, recipe_id
from tcpipe.logs.profiles import ROBOTS, Robot
from tcpipe.pipeline.log_sources import LogSource, definitions_key, find_sources, in_turns, on_this_machine, with_hashes
from tcpipe.recipe import IngestSections, Recipe
from tcpipe.store import RunDirectory, Store, open_store
from tcpipe.tables.levels import DATA_MODEL_VERSION, GatedTrack, LabelledSegments, Streams, Track

logger = logging.getLogger("tcpipe")

Status = Literal["done", "unchanged", "damaged", "failed"]


@dataclass(frozen=True, slots=True)
class IngestTask:
    """One run to make: the log and how."""

    source: LogSource
    store: Path
    recipe: Recipe
    robot: str | None
    tags: Mapping[str, str]
    force: bool
    message_definitions: Path | None = None
    """A directory of .msg files for types that the log does not define."""


@dataclass(frozen=True, slots=True)
class IngestResult:
    """What became of one log."""

    log: str
    status: Status
    run_id: str | None = None
    recipe_id: str | None = None
    robot: str | None = None
    segments: int = 0
    distance_m: float = 0.0
    kept_m: float = 0.0
    energy_budget: Mapping[str, Any] | None = None
    """The noise floor of the labels' energy and its causes, as shares of their mean (`tcpipe.cost.budget`)."""
    warnings: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()
    same_as: str | None = None
    """The log from which the same recording was ingested before, under another path; it is one run."""
    sha256: str | None = None
    traceback: str | None = None
    """Where an internal error comes from."""


@dataclass(frozen=True, slots=True)
class IngestSummary:
    """What became of every log, in the order given; ``exit_code`` is the contract's."""

    store: Path
    results: tuple[IngestResult, ...] = field(default_factory=tuple)

    @property
    def exit_code(self) -> int:
        """0 all whole, 1 all failed, 3 some failed or are damaged; the same for a second call that finds everything done."""
        if not any(result.status == "failed" or result.damage for result in self.results):
            return 0
        return 1 if all(result.status == "failed" for result in self.results) else 3


def ingest(
    logs: Iterable[str | Path],
    *,
    store: str | Path = "tcpipe-store",
    recipe: Recipe | str | Path | None = None,
    robot: str | None = None,
    tags: Mapping[str, str] | None = None,
    jobs: int = 1,
    force: bool = False,
    as_one: bool = False,
    message_definitions: Path | None = None,
    on_found: Callable[[int], None] | None = None,
    on_result: Callable[[IngestResult], None] | None = None,
) -> IngestSummary:
    """Ingest logs (files, ROS 2 bag directories, folders of them) into the store; what is there already is left alone.

    Parameters
    ----------
    logs
        ``.mcap``, ``.bag``, ``.db3``, ROS 2 bag directories, or folders searched downward; or URLs of such (``s3://…``), which are
        copied to this machine, one by one, while they are read.
    recipe
        A `Recipe`, a path to one, or None for the one that rules here (``TCPIPE_RECIPE``, nearest tcpipe.toml, defaults).
    robot
        Profile; None takes the recipe's, or finds it by message types.
    as_one
        All logs are parts of one drive.
    message_definitions
        A directory of .msg or .idl files for types that the logs do not define.
    on_found
        Called once with the number of logs.
    on_result
        Called as each log ends, in the order of ending.

    Raises
    ------
    LogError, StoreError, RecipeError, UsageError
        When nothing can be begun; what goes wrong with one log stands in its result.

    """
    ruling = recipe if isinstance(recipe, Recipe) else load_recipe(find_recipe(_as_path(recipe), Path.cwd()))
    robot = robot or ruling.robot
    if robot is not None and robot not in ROBOTS:
        raise UsageError(f"robot {robot!r} is not known; known: {', '.join(sorted(ROBOTS))}")
    with _place_for_stand_ins(logs := list(logs)) as staging, _gone_if_empty(Path(store)):
        found = find_sources(logs, as_one=as_one, staging=Path(staging))
        house = open_store(store, create=True)
        if on_found:
            on_found(len(found))
        sources = with_hashes(found, house.sources())
        results: dict[int, IngestResult] = {}
        for turn in in_turns(sources):
            tasks = [
                IngestTask(sources[index], house.root, ruling, robot, dict(tags or {}), force, message_definitions)
                for index in turn
            ]
            with closing(run_all(ingest_one, tasks, jobs=jobs)) as outcomes:
                for outcome in outcomes:
                    task = tasks[outcome.index]
                    result = results[turn[outcome.index]] = outcome.result or _died(task.source)
                    if result.sha256:
                        files = [list(file) for file in task.source.files]
                        house.remember_source(task.source.key, {"size_and_time": files, "sha256": result.sha256})
                    if on_result:
                        on_result(result)
        return IngestSummary(house.root, tuple(results[index] for index in range(len(sources))))


def _place_for_stand_ins(logs: Iterable[str | Path]) -> AbstractContextManager[str]:
    """Return a temporary directory, where a log is named by its URL."""
    remote = any(is_url(log) for log in logs)
    return tempfile.TemporaryDirectory(prefix="tcpipe-") if remote else nullcontext("")


@contextmanager
def _gone_if_empty(store: Path) -> Iterator[None]:
    """Remove directories that were made for the store when nothing came into it."""
    made = [path for path in (store, *store.absolute().parents) if not path.exists()]
    try:
        yield
    finally:
        for path in (store / "runs", *made) if made else ():
            with suppress(OSError):
                path.rmdir()


def ingest_one(task: IngestTask) -> IngestResult:
    """Ingest one run; every error becomes its result, so that one log never costs the others."""
    name = task.source.name
    try:
        return _ingest(task)
    except TcpipeError as error:
        return IngestResult(name, "failed", problems=_naming(task.source, error.problems))
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        return IngestResult(name, "failed", problems=(f"{name}: {error.strerror or error}{where}",))
    except MemoryError:
        return IngestResult(name, "failed", problems=(f"{name}: not enough memory; fewer --jobs need less",))
    except Exception as error:  # noqa: BLE001  a bug that one log meets
        problem = (
            f"{name}: internal error, {type(error).__name__}: {error}; please report it (tcpipe --debug shows where)"
        )
        return IngestResult(name, "failed", problems=(plain_line(problem),), traceback=traceback.format_exc())


def _naming(source: LogSource, problems: tuple[str, ...]) -> tuple[str, ...]:
    """Return the problems with the log's name in the first, unless a file of it is named there."""
    if any(plain_line(origin) in problems[0] for origin in source.origins):
        return problems
    return (f"{source.name}: {problems[0]}", *problems[1:])


def _ingest(task: IngestTask) -> IngestResult:
    store, source = Store(task.store), task.source
    with ExitStack() as stack:
        opened = None if source.sha256 else _opened(task, stack)
        sha256 = str(opened[1].sha256() if opened else source.sha256)
        run_id = stack.enter_context(store.claimed_run(source.stem, sha256))
        same_as = _twin(store, run_id, source)
        finished = None if task.force else _finished(store, run_id, task)
        if finished is not None:
            return _result(source, _retagged(store, run_id, task), finished, sha256, same_as=same_as)
        task, log = opened or _opened(task, stack)
        logger.info("%s: reading", source.name)
        streams, damage, remarks = _streams(store, run_id, log, task)
        known = {"sha256": sha256, "damage": damage, "remarks": remarks, "tags": _tags(store, run_id, task)}
        known["message_definitions"] = definitions_key(task.message_definitions)
        store.write_run_json(run_id, _run_json(log, streams, source, known))
        run = _fuse_and_label(store, run_id, streams, known, task)
    return _result(source, "done", run, sha256, same_as=same_as)


def _opened(task: IngestTask, stack: ExitStack) -> tuple[IngestTask, Any]:
    """Return the task with the log's files on this machine, and the log, both until ``stack`` ends."""
    source = stack.enter_context(on_this_machine(task.source))
    log = stack.enter_context(open_logs(source.paths, message_definitions=task.message_definitions))
    return replace(task, source=source), log


def _fuse_and_label(
    store: Store, run_id: str, streams: Streams, known: Mapping[str, Any], task: IngestTask
) -> RunDirectory:
    track, gated, labelled = run_stages(streams, task.recipe.ingest, run_id=run_id, name=task.source.name)
    identity = recipe_id(task.recipe, streams.robot)
    names = {"run_id": run_id, "recipe_id": identity, "tags": known["tags"], "damage": known["damage"]}
    manifest = {**_manifest(task, streams, track, labelled), **names}
    path = store.write_run(run_id, identity, track=track, gated=gated, labelled=labelled, manifest=manifest)
    return next(run for run in store.recipes_of(run_id) if run.path == path)


def _tags(store: Store, run_id: str, task: IngestTask) -> dict[str, str]:
    """Return the run's tags: those it has, and those given."""
    return {**(store.run_json(run_id) or {}).get("tags", {}), **task.tags}


def _retagged(store: Store, run_id: str, task: IngestTask) -> Status:
    """Set the tags of a run that is there already; "done" where that changed something."""
    before = (store.run_json(run_id) or {}).get("tags", {})
    tags = _tags(store, run_id, task)
    if tags == before:
        return "unchanged"
    store.tag_run(run_id, tags)
    return "done"


def _twin(store: Store, run_id: str, source: LogSource) -> str | None:
    """Return where else the same recording was ingested from, if it was."""
    before = (store.run_json(run_id) or {}).get("source", {}).get("paths")
    return None if before is None or before == list(source.origins) else " + ".join(before)


def run_stages(
    streams: Streams, sections: IngestSections, *, run_id: str, name: str
) -> tuple[Track, GatedTrack, LabelledSegments]:
    """Run fuse, gate, segment and label over the streams of one run (``name`` is for progress only).

    A stage gets its own section, and of the others nothing but the chord; no section that `recipe_id` is not the hash of is in reach.
    """
    from tcpipe.stages.fuse import fuse_run  # noqa: PLC0415  kernels load only when there is work
    from tcpipe.stages.gate import gate_track  # noqa: PLC0415
    from tcpipe.stages.label import label_segments  # noqa: PLC0415
    from tcpipe.stages.segment import segment_track  # noqa: PLC0415

    profile: Robot = ROBOTS[streams.robot]
    logger.info("%s: fusing", name)
    track = fuse_run(streams, sections.fuse, run_id=run_id)
    logger.info("%s: cutting and labelling", name)
    gated = gate_track(
        track, sections.gate, max_velocity_mps=profile.max_velocity_mps, chord_m=sections.segment.chord_m
    )
    segments = segment_track(gated, sections.segment)
    labelled = label_segments(segments, gated, streams, sections.label, voltage_range_volt=profile.voltage_range_volt)
    return track, gated, labelled


def _streams(store: Store, run_id: str, log: Any, task: IngestTask) -> tuple[Streams, list[str], list[str]]:
    """Return L1, from the store when it was made with the same read settings, the log's damage, and remarks on it."""
    from tcpipe.stages.read import read_run  # noqa: PLC0415

    definitions = definitions_key(task.message_definitions)
    key = f"{read_key(task.recipe, task.robot, definitions=definitions)}-{__version__}"
    known = store.run_json(run_id)
    same = known is not None and known.get("message_definitions", "") == definitions
    cached = store.read_streams(run_id, key=key) if same and not task.force else None
    if cached is not None and known is not None:
        return cached, list(known["damage"]), list(known.get("remarks", ()))
    streams = read_run(log, task.recipe.read, robot=task.robot)
    if task.source.has_changed():
        raise LogError(f"{task.source.name}: changed while it was read; ingest it when its recording has ended")
    store.write_streams(run_id, streams, key=key)
    return streams, [str(damage) for damage in log.damage if damage.is_loss], log.remarks


def _finished(store: Store, run_id: str, task: IngestTask) -> RunDirectory | None:
    key = ingest_key(task.recipe)
    for run in store.recipes_of(run_id):
        manifest = run.manifest
        same_robot = manifest["robot_requested"] == task.robot or (task.robot and manifest["robot"] == task.robot)
        same_definitions = manifest.get("message_definitions", "") == definitions_key(task.message_definitions)
        same_version = manifest["tcpipe_version"] == __version__
        if manifest["ingest_key"] == key and same_version and same_robot and same_definitions:
            return run
    return None


def _run_json(log: Any, streams: Streams, source: LogSource, known: Mapping[str, Any]) -> dict[str, Any]:
    paths = list(source.origins)
    return {
        "source": {"paths": paths, "size_bytes": log.size_bytes, "sha256": known["sha256"]},
        "robot": streams.robot,
        "tags": known["tags"],
        "topics": [
            {"name": topic.name, "type": topic.type_name, "messages": topic.message_count}
            for topic in log.topics.values()
        ],
        "sensors": {role: asdict(sensor) for role, sensor in streams.sensors.items()},
        "damage": known["damage"],
        "remarks": known["remarks"],
        "message_definitions": known["message_definitions"],
        "findings": plain(streams.findings),
    }


def _manifest(task: IngestTask, streams: Streams, track: Track, labelled: LabelledSegments) -> dict[str, Any]:
    warnings = (*streams.findings.warnings, *labelled.info.findings.warnings)
    return {
        "data_model_version": DATA_MODEL_VERSION,
        "tcpipe_version": __version__,
        "ingest_key": ingest_key(task.recipe),
        "recipe": plain(task.recipe.ingest),
        "robot": streams.robot,
        "robot_requested": task.robot,
        "message_definitions": definitions_key(task.message_definitions),
        "counts": {
            **{f"{role}_messages": table.num_rows for role, table in streams.tables.items()},
            "track_rows": track.table.num_rows,
            "rejections": track.rejections.num_rows,
            "segments": labelled.table.num_rows,
        },
        "warnings": list(dict.fromkeys(warnings)),
    }


def _result(source: LogSource, status: Status, run: RunDirectory, sha256: str, *, same_as: str | None) -> IngestResult:
    manifest = run.manifest
    ledger = manifest["ledger_m"]
    damage = tuple(manifest["damage"])
    return IngestResult(
        log=source.name,
        status="damaged" if damage and status == "done" else status,
        run_id=run.run_id,
        recipe_id=run.recipe_id,
        robot=run.robot,
        segments=manifest["counts"]["segments"],
        distance_m=sum(ledger.values()),
        kept_m=ledger.get("kept", 0.0),
        energy_budget=manifest["info"]["findings"]["facts"].get("label", {}).get("energy_budget"),
        warnings=tuple(manifest["warnings"]),
        damage=damage,
        same_as=same_as,
        sha256=sha256,
    )


def _died(source: LogSource) -> IngestResult:
    problem = f"{source.name}: its worker process died (killed, or out of memory); run it again"
    return IngestResult(source.name, "failed", problems=(problem,))


def _as_path(value: str | Path | None) -> Path | None:
    return None if value is None else Path(value)
