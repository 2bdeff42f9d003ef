"""From logs to labelled segments in the store: one task a log, side by side, each whole or not at all."""

from __future__ import annotations

import logging
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Literal, TypeVar

from tcpipe import __version__
from tcpipe.errors import LogError, StoreError, TcpipeError, UsageError, plain_line
from tcpipe.execution import run_all
from tcpipe.formats.json_files import digest
from tcpipe.formats.logs.joined import JoinedLog, open_logs
from tcpipe.formats.logs.log_file import Log
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.recipe_toml import find_recipe, ingest_key, load_recipe, read_key, recipe_id
from tcpipe.formats.record_files import record_name
from tcpipe.formats.robot_files import profiles_of
from tcpipe.formats.run_documents import Counts, LogOrigin, Manifest, RunJson, TopicCount
from tcpipe.pipeline.known_trouble import Trouble, failure_name
from tcpipe.pipeline.log_sources import (
    FoundLogs,
    LogSource,
    definitions_key,
    find_sources,
    in_shard,
    in_turns,
    on_this_machine,
    with_hashes,
)
from tcpipe.pipeline.supersession import remember_earlier, superseded_by
from tcpipe.pipeline.transience import is_transient
from tcpipe.recipe import IngestSections, Recipe
from tcpipe.store import RunDirectory, Store, add_by_hash, open_store
from tcpipe.tables.findings import EnergyBudget
from tcpipe.tables.levels import DATA_MODEL_VERSION, GatedTrack, LabelledSegments, Streams, Track

R = TypeVar("R")

logger = logging.getLogger("tcpipe")

_NO_LOGS = "no logs given; wanted .mcap, .bag or .db3 files, ROS 2 bag directories, or folders of them"

Status = Literal["done", "unchanged", "damaged", "failed", "waiting"]


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
    definitions: str = ""
    """Their `definitions_key`."""
    retry_failed: bool = False
    min_age_s: float = 0.0

    @property
    def failure(self) -> str:
        """The name of the record that this fails, should it fail for what the log's content is."""
        key, content = ingest_key(self.recipe), self.source.sha256 or self.source.files_digest
        return failure_name(content, ingest_key=key, robot=self.robot, definitions=self.definitions)


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
    energy_budget: EnergyBudget | None = None
    """The noise floor of the labels' energy and its causes, as shares of their mean (`tcpipe.cost.budget`)."""
    warnings: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()
    same_as: str | None = None
    """The log from which the same recording was ingested before, under another path; it is one run."""
    sha256: str | None = None
    notes: tuple[str, ...] = ()
    """What else is to be said: why it waits, which runs it supersedes."""
    transient: bool = False
    """Whether it failed for what may pass: a full disk, a killed worker."""
    known: bool = False
    """Whether it failed before and was not tried again, or its damage was told before."""
    accepted: bool = False
    """Whether a person has accepted what is wrong with it (`tcpipe accept`)."""
    traceback: str | None = None
    """Where an internal error comes from."""

    @property
    def is_news(self) -> bool:
        """Whether something is wrong that nobody was told before, or accepted."""
        return (self.status == "failed" or bool(self.damage)) and not self.known and not self.accepted


@dataclass(frozen=True, slots=True)
class IngestSummary:
    """What became of every log, in the order given; ``exit_code`` is the contract's."""

    store: Path
    results: tuple[IngestResult, ...] = field(default_factory=tuple)

    @property
    def exit_code(self) -> int:
        """0 nothing is wrong, or nothing that is news; 1 all failed; 3 some failed or are damaged."""
        if not any(result.is_news for result in self.results):
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
    retry_failed: bool = False,
    as_one: bool = False,
    shard: tuple[int, int] | None = None,
    min_age_s: float = 0.0,
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
    force
        Do again what is there already, and what is known to fail.
    retry_failed
        Try again what is known to fail.
    as_one
        All logs are parts of one drive.
    shard
        ``(i, n)``: only the i-th of n shares of the logs, i from 1.
    min_age_s
        A log that was written since so many seconds waits for another call.
    message_definitions
        A directory of .msg or .idl files for types that the logs do not define.
    on_found
        Called once with the number of logs.
    on_result
        Called as each log ends, in the order of ending.

    Raises
    ------
    LogError, StoreError, RecipeError, UsageError
        When nothing can be begun; what goes wrong with one log or path stands in its result.

    """
    ruling = recipe if isinstance(recipe, Recipe) else load_recipe(find_recipe(_as_path(recipe), Path.cwd()))
    robot = robot or ruling.robot
    if robot is not None and robot not in (robots := profiles_of(ruling).robots):
        raise UsageError(f"robot {robot!r} is not known; known: {', '.join(sorted(robots))}")
    with _place_for_stand_ins(logs := list(logs)) as staging, _gone_if_empty(Path(store)):
        found = find_sources(logs, as_one=as_one, staging=Path(staging))
        if not found.sources:
            raise (LogError if found.transient else UsageError)(*chain(*found.problems.values()) or [_NO_LOGS])
        opened = open_store(store, create=True)
        remember_earlier(opened)
        mine = found.sources if shard is None else in_shard(found.sources, shard)
        common = (opened.root, ruling, robot, dict(tags or {}), force, message_definitions)
        how = (definitions_key(message_definitions), retry_failed, min_age_s)
        sources = with_hashes(mine, (lambda _: []) if force else opened.sightings)
        tasks = [IngestTask(source, *common, *how) for source in sources]
        if on_found:
            on_found(len(tasks) + len(found.problems))
        results = {}
        for index, source, result in _results(opened, tasks, found, jobs):
            results[index] = result
            if on_result:
                on_result(result)
            if source is not None:
                _remember(opened, tasks[index], source, result)
        return IngestSummary(opened.root, tuple(results[index] for index in sorted(results)))


def _results(
    store: Store, tasks: Sequence[IngestTask], found: FoundLogs, jobs: int
) -> Iterator[tuple[int, LogSource | None, IngestResult]]:
    """Yield what became of each path that holds no log, and of each log as it ends, by its place; what needs no work is told first."""
    for index, (path, lines) in enumerate(found.problems.items(), start=-len(found.problems)):
        yield index, None, IngestResult(plain_line(path), "failed", problems=lines, transient=True)
    runs = store.run_ids_by_hash()
    for turn in in_turns([task.source for task in tasks]):
        todo = []
        for index in turn:
            result = _told(tasks[index], partial(_without_work, runs=runs))
            if result is None:
                todo.append(index)
            else:
                yield index, tasks[index].source, _judged(store, tasks[index].source, result, runs)
        with closing(run_all(ingest_one, [tasks[index] for index in todo], jobs=jobs)) as outcomes:
            for outcome in outcomes:
                task = tasks[todo[outcome.index]]
                source, result = outcome.result or (task.source, _died(task.source))
                yield todo[outcome.index], source, _judged(store, source, result, runs)


def _without_work(task: IngestTask, *, runs: Mapping[str, Sequence[str]]) -> IngestResult | None:
    """Return the result of a log that is in the store, is known to fail, or has to wait; None where there is something to do."""
    store, source = Store(task.store), task.source
    run_id = store.run_of(source.sha256, runs) if source.sha256 and not task.force else None
    finished = _finished(store, run_id, task) if run_id else None
    if run_id and finished:
        same_as = _twin(store, run_id, source)
        return _result(source, _retagged(store, run_id, task), finished, str(source.sha256), same_as=same_as)
    failed = None if task.force or task.retry_failed else store.recall(task.failure, Trouble)
    if failed is not None:
        return IngestResult(source.name, "failed", problems=failed.lines, sha256=source.sha256, known=True)
    return _too_young(task)


def _too_young(task: IngestTask) -> IngestResult | None:
    age_s = (time.time_ns() - task.source.youngest_ns) / 1e9
    if not task.source.files or age_s >= task.min_age_s or not task.min_age_s:
        return None
    note = f"it was written {max(age_s, 0.0):.0f} s ago; it is ingested when it is {task.min_age_s:g} s old"
    return IngestResult(task.source.name, "waiting", notes=(note,))


def _judged(store: Store, source: LogSource, result: IngestResult, runs: dict[str, list[str]]) -> IngestResult:
    """Return a result with what the store says of it: whether its trouble is news, and which runs it supersedes."""
    notes = result.notes
    if result.run_id and result.sha256:
        if store.run_of(result.sha256, runs) is None:
            add_by_hash(runs, result.run_id)
        try:
            notes += tuple(superseded_by(store, source, result.run_id, result.sha256, runs))
        except StoreError as error:
            notes += error.problems
    trouble = _trouble(source, result)
    if trouble is None:
        return replace(result, notes=notes)
    known = result.known or (trouble.kind == "damaged" and trouble.is_told(store))
    return replace(result, notes=notes, known=known, accepted=trouble.is_accepted(store))


def _trouble(source: LogSource, result: IngestResult) -> Trouble | None:
    content = result.sha256 or source.files_digest
    if result.status == "failed":
        return Trouble(content, result.problems, source.origins, kind="failed")
    return Trouble(content, result.damage, source.origins, result.run_id, "damaged") if result.damage else None


def _remember(store: Store, task: IngestTask, source: LogSource, result: IngestResult) -> None:
    """Remember what a log holds, and what is wrong with that; where it cannot be written it is told again the next time."""
    trouble = _trouble(source, result)
    try:
        if result.sha256 and source.files:
            sighting = source.sighting(result.sha256)
            store.remember(f"{source.lineage}/{record_name(digest(sighting))}", sighting)
        if trouble is not None and trouble.kind == "damaged":
            trouble.told(store)
        elif trouble is not None and not result.transient and not result.known:
            task = replace(task, source=replace(source, sha256=result.sha256))
            store.remember(task.failure, replace(trouble, version=__version__))
    except StoreError as error:
        logger.error("%s", error)  # noqa: TRY400  one line


def _place_for_stand_ins(logs: Iterable[str | Path]) -> AbstractContextManager[str]:
    """Return a temporary directory, where a log is named by its URL."""
    remote = any(is_url(log) for log in logs)
    return tempfile.TemporaryDirectory(prefix="tcpipe-") if remote else nullcontext("")


@contextmanager
def _gone_if_empty(store: Path) -> Iterator[None]:
    """Remove what was made for the store when no run came into it, what is remembered of failures too."""
    made = [path for path in (store, *store.absolute().parents) if not path.exists()]
    try:
        yield
    finally:
        if made and not any(store.glob("runs/*")):
            shutil.rmtree(store / "records", ignore_errors=True)
            for path in (store / "runs", *made):
                with suppress(OSError):
                    path.rmdir()


def ingest_one(task: IngestTask) -> tuple[LogSource, IngestResult]:
    """Ingest one run from its log as that is now; every error becomes its result, so that one log never costs the others."""
    task = replace(task, source=task.source.now())
    hashed: list[str] = []
    young = _too_young(task)
    if young is not None:
        return task.source, young
    result = _told(task, partial(_ingest, hashed=hashed))
    if task.source.has_changed():
        note = "it changed while it was looked at; it is ingested when its recording has ended"
        return task.source, IngestResult(task.source.name, "waiting", notes=(note,))
    return task.source, replace(result, sha256=hashed[0]) if hashed else result


def _told(task: IngestTask, act: Callable[[IngestTask], R]) -> R | IngestResult:
    """Do something with a log; an error becomes its result."""
    try:
        return act(task)
    except Exception as error:  # noqa: BLE001  at last a bug that one log meets
        problems, trace = _in_words(error, task.source)
        transient = is_transient(error) or not task.source.files
        return IngestResult(task.source.name, "failed", problems=problems, transient=transient, traceback=trace)


def _in_words(error: Exception, source: LogSource) -> tuple[tuple[str, ...], str | None]:
    """Return lines about what went wrong with a log, and where an internal error comes from."""
    if isinstance(error, TcpipeError):
        return _naming(source, error.problems), None
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return _naming(source, (plain_line(f"{where}{error.strerror or error}"),)), None
    if isinstance(error, MemoryError):
        return (f"{source.name}: not enough memory; fewer --jobs need less",), None
    what = f"internal error, {type(error).__name__}: {error}; please report it (tcpipe --debug shows where)"
    return (plain_line(f"{source.name}: {what}"),), "".join(traceback.format_exception(error))


def _naming(source: LogSource, problems: tuple[str, ...]) -> tuple[str, ...]:
    """Return the problems with the log's name in the first, unless a file of it is named there."""
    if any(plain_line(origin) in problems[0] for origin in source.origins):
        return problems
    return (f"{source.name}: {problems[0]}", *problems[1:])


def _ingest(task: IngestTask, *, hashed: list[str]) -> IngestResult:
    """Ingest one run; what its log hashes to is left in ``hashed``, also on failure."""
    store, source = Store(task.store), task.source
    with ExitStack() as stack:
        opened = None if source.sha256 else _opened(task, stack)
        sha256 = str(opened[1].sha256() if opened else source.sha256)
        hashed.append(sha256)
        run_id = stack.enter_context(store.claimed_run(source.stem, sha256))
        same_as = _twin(store, run_id, source)
        finished = None if task.force or store.known_run(run_id) is None else _finished(store, run_id, task)
        if finished is not None:
            return _result(source, _retagged(store, run_id, task), finished, sha256, same_as=same_as)
        task, log = opened or _opened(task, stack)
        logger.info("%s: reading", source.name)
        streams, damage, remarks = _streams(store, run_id, log, task)
        known = _run_json(task, log, streams, sha256)
        known = replace(known, damage=damage, remarks=remarks, tags=_tags(store, run_id, task))
        store.write_run_json(run_id, known)
        run = _fuse_and_label(store, run_id, streams, known, task)
    return _result(source, "done", run, sha256, same_as=same_as)


def _opened(task: IngestTask, stack: ExitStack) -> tuple[IngestTask, Log | JoinedLog]:
    """Return the task with the log's files on this machine, and the log, both until ``stack`` ends."""
    source = stack.enter_context(on_this_machine(task.source))
    log = open_logs(source.paths, message_definitions=task.message_definitions)
    stack.enter_context(log)
    return replace(task, source=source), log


def _fuse_and_label(store: Store, run_id: str, streams: Streams, known: RunJson, task: IngestTask) -> RunDirectory:
    track, gated, labelled = run_stages(streams, task.recipe.ingest, run_id=run_id, name=task.source.name)
    manifest = _manifest(task, known, streams, track, labelled)
    path = store.write_run(manifest, track=track, gated=gated, labelled=labelled)
    return next(run for run in store.recipes_of(run_id) if run.path == path)


def _tags(store: Store, run_id: str, task: IngestTask) -> dict[str, str]:
    """Return the run's tags: those it has, and those given."""
    known = store.known_run(run_id)
    before = known.tags if known else next((run.manifest.tags for run in store.recipes_of(run_id)), {})
    return {**before, **task.tags}


def _retagged(store: Store, run_id: str, task: IngestTask) -> Status:
    """Set the tags of a run that is there already; "done" where that changed something."""
    known, tags = store.known_run(run_id), _tags(store, run_id, task)
    if tags == (known.tags if known else {}):
        return "unchanged"
    store.tag_run(run_id, tags)
    return "done"


def _twin(store: Store, run_id: str, source: LogSource) -> str | None:
    """Return where else the same recording was ingested from, if it was."""
    known = store.known_run(run_id)
    return None if known is None or known.source.paths == source.origins else " + ".join(known.source.paths)


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

    profile = profiles_of(sections).robots[streams.robot]
    logger.info("%s: fusing", name)
    track = fuse_run(streams, sections.fuse, run_id=run_id)
    logger.info("%s: cutting and labelling", name)
    gated = gate_track(
        track, sections.gate, max_velocity_mps=profile.max_velocity_mps, chord_m=sections.segment.chord_m
    )
    segments = segment_track(gated, sections.segment)
    labelled = label_segments(segments, gated, streams, sections.label, voltage_range_volt=profile.voltage_range_volt)
    return track, gated, labelled


def _streams(
    store: Store, run_id: str, log: Log | JoinedLog, task: IngestTask
) -> tuple[Streams, tuple[str, ...], tuple[str, ...]]:
    """Return L1, from the store when it was made with the same read settings, the log's damage, and remarks on it."""
    from tcpipe.stages.read import read_run  # noqa: PLC0415

    key = f"{read_key(task.recipe, task.robot, definitions=task.definitions)}-{__version__}"
    known = store.known_run(run_id)
    same = known is not None and known.message_definitions == task.definitions
    cached = store.read_streams(run_id, key=key) if same and not task.force else None
    if cached is not None and known is not None:
        return cached, known.damage, known.remarks
    streams = read_run(log, task.recipe.read, robot=task.robot, known=profiles_of(task.recipe))
    if task.source.has_changed():
        raise LogError(f"{task.source.name}: changed while it was read")
    store.write_streams(run_id, streams, key=key)
    return streams, tuple(str(damage) for damage in log.damage if damage.is_loss), tuple(log.remarks)


def _finished(store: Store, run_id: str, task: IngestTask) -> RunDirectory | None:
    key = ingest_key(task.recipe)
    for run in store.recipes_of(run_id):
        made = run.manifest
        same_robot = made.robot_requested == task.robot or (task.robot and made.robot == task.robot)
        same_version = made.tcpipe_version == __version__
        if made.ingest_key == key and same_version and same_robot and made.message_definitions == task.definitions:
            return run
    return None


def _run_json(task: IngestTask, log: Log | JoinedLog, streams: Streams, sha256: str) -> RunJson:
    return RunJson(
        source=LogOrigin(task.source.origins, sha256, log.size_bytes),
        robot=streams.robot,
        topics=tuple(TopicCount(topic.name, topic.type_name, topic.message_count) for topic in log.topics.values()),
        sensors=streams.sensors,
        message_definitions=task.definitions,
        findings=streams.findings,
    )


def _manifest(task: IngestTask, known: RunJson, streams: Streams, track: Track, labelled: LabelledSegments) -> Manifest:
    info = labelled.info
    rows = {f"{role}_messages": table.num_rows for role, table in streams.tables.items()}
    return Manifest(
        run_id=info.run_id,
        recipe_id=recipe_id(task.recipe, streams.robot),
        data_model_version=DATA_MODEL_VERSION,
        tcpipe_version=__version__,
        ingest_key=ingest_key(task.recipe),
        recipe=task.recipe.ingest,
        robot=streams.robot,
        tags=known.tags,
        counts=Counts(labelled.table.num_rows, track.table.num_rows, track.rejections.num_rows, **rows),
        ledger_m=labelled.ledger_m,
        warnings=tuple(dict.fromkeys(info.findings.warnings)),
        damage=known.damage,
        info=info,
        robot_requested=task.robot,
        message_definitions=task.definitions,
    )


def _result(source: LogSource, status: Status, run: RunDirectory, sha256: str, *, same_as: str | None) -> IngestResult:
    made = run.manifest
    return IngestResult(
        log=source.name,
        status="damaged" if made.damage and status == "done" else status,
        run_id=run.run_id,
        recipe_id=run.recipe_id,
        robot=made.robot,
        segments=made.counts.segments,
        distance_m=sum(made.ledger_m.values()),
        kept_m=made.ledger_m.get("kept", 0.0),
        energy_budget=run.energy_budget,
        warnings=made.warnings,
        damage=made.damage,
        same_as=same_as,
        sha256=sha256,
    )


def _died(source: LogSource) -> IngestResult:
    problem = f"{source.name}: its worker process died (killed, or out of memory); run it again"
    return IngestResult(source.name, "failed", problems=(problem,), transient=True)


def _as_path(value: str | Path | None) -> Path | None:
    return None if value is None else Path(value)
