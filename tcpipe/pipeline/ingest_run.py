"""One log becomes a run of the store: read, fused, masked, cut and labelled, each file whole or not at all."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial

from tcpipe import __version__
from tcpipe.errors import LogError
from tcpipe.formats.commit_log import read_state_here
from tcpipe.formats.commits import State
from tcpipe.formats.index_files import KnownLog, RunFacts
from tcpipe.formats.logs.log_joining import AnyLog, open_logs
from tcpipe.formats.parquet import return_freed_memory
from tcpipe.formats.recipe_toml import ingest_key, load_profiles, make_recipe_id, read_key
from tcpipe.formats.run_documents import Counts, LogOrigin, Manifest, RunJson, TopicCount
from tcpipe.formats.stored_runs import lend_streams
from tcpipe.logs.topics import split_notes
from tcpipe.pipeline.calls import is_committed
from tcpipe.pipeline.log_sources import LogSource, find_damaged_log, find_total_loss
from tcpipe.pipeline.plan import IngestResult, IngestTask, check_age, make_result, mark_reported
from tcpipe.progress import set_task, step
from tcpipe.recipe import IngestSections
from tcpipe.store import Store
from tcpipe.tables.findings import Subject, judge, make_finding, read_threshold
from tcpipe.tables.levels import DATA_MODEL_VERSION, LabelledSegments, MaskedTrack, Streams, Track, add_findings


@dataclass(frozen=True, slots=True)
class Ingested:
    """Result of ingesting a log: the log at that time, and the facts of its run for the commit."""

    source: LogSource
    result: IngestResult
    rows: tuple[RunFacts, ...] = ()


def ingest_one(task: IngestTask) -> Ingested:
    """Ingest one run from its log as that is now; every error becomes its result, so that one log never costs the others."""
    return_freed_memory()
    task = replace(task, source=task.source.now())
    hashed, rows = list[str](), list[RunFacts]()
    young = check_age(task)
    if young is not None:
        return Ingested(task.source, young)
    with set_task(task.source.name):
        result = mark_reported(task, partial(_ingest, hashed=hashed, rows=rows))
    if task.source.has_changed():
        note = "changed during the check; will be ingested when its recording has ended"
        return Ingested(task.source, IngestResult(task.source.name, "waiting", notes=(note,)))
    return Ingested(task.source, replace(result, sha256=hashed[0]) if hashed else result, tuple(rows))


def _ingest(task: IngestTask, *, hashed: list[str], rows: list[RunFacts]) -> IngestResult:
    """Ingest one run; what its log hashes to is left in ``hashed``, also on failure, and what is to be committed in ``rows``."""
    store, source = Store(task.store), task.source
    state = read_state_here(store.place)
    with ExitStack() as stack:
        opened = None if source.sha256 else _open_log(task, stack)
        sha256 = _find_hash(state, opened) if opened else str(source.sha256)
        hashed.append(sha256)
        run_id = state.find_run(sha256) or store.name_run(source.stem, sha256)
        before = store.known_run(run_id)
        same_as = find_twin(before, source)
        if before and not task.force and (made := _find_made_before(store, run_id, task)):
            rows += () if is_committed(made, state) else _read_rows(store, state, run_id, made.recipe_id)
            return make_result(source, "done" if rows else "unchanged", made, sha256, same_as=same_as)
        log = opened or _open_log(task, stack)
        step("reading")
        streams, known = _read(store, run_id, before, log, task, sha256=sha256)
        tags = before.tags if before else next((row.tags for row in state.find_rows(run_id)), {})
        known = replace(known, tags={**tags, **task.tags})
        if not known.streams:
            known = replace(known, streams=store.write_streams(run_id, streams, key=known.streams_key))
        store.write_run_json(run_id, known)
        streams = lend_streams(store.runs_place.below(run_id), streams, known.streams)
        return_freed_memory()
        manifest = _fuse_and_label(store, run_id, streams, known, task)
    rows += _read_rows(store, state, run_id, manifest.recipe_id)
    (made,) = (row for row in rows if row.recipe_id == manifest.recipe_id)
    return make_result(source, "done", made, sha256, same_as=same_as)


def _find_made_before(store: Store, run_id: str, task: IngestTask) -> RunFacts | None:
    """Return an ingestion that is there as it would be made now, after setting its tags; also one that a killed call did not commit."""
    made = next((row for row in store.read_rows(run_id).values() if task.is_made_by(row)), None)
    if made is not None and store.tag_run(run_id, task.tags):
        return store.read_rows(run_id)[made.recipe_id]
    return made


def _read_rows(store: Store, state: State, run_id: str, recipe_id: str) -> list[RunFacts]:
    """Return what is to be committed of a run: the ingestion under a recipe, and those that were committed before, with the tags of now."""
    return [row for key, row in store.read_rows(run_id).items() if key == recipe_id or (run_id, key) in state.runs]


def _find_hash(state: State, log: AnyLog) -> str:
    """Return the hash by which the store knows a log, or is to know it (ADR-30).

    That is the log's own unless the same recording was ingested from elsewhere, where more or less of it was at hand. A run with damage
    is not taken for it: what was broken there may be whole here.
    """
    outline, sha256 = log.outline, log.sha256()
    for row in state.runs.values() if outline else ():
        other = row.log and row.log.source.sha256
        only_index = outline in (sha256, other)  # where both are hashed as a whole, their hashes distinguish them
        if other and row.log and row.log.outline == outline and only_index and not row.damage:
            return other
    return sha256


def _open_log(task: IngestTask, stack: ExitStack) -> AnyLog:
    """Return the log, open until ``stack`` ends."""
    log = open_logs(task.source.locations(), message_definitions=task.message_definitions, tables=task.recipe.tables)
    stack.enter_context(log)
    return log


def _fuse_and_label(store: Store, run_id: str, streams: Streams, known: RunJson, task: IngestTask) -> Manifest:
    track, masked, labelled = run_stages(streams, task.recipe.ingest, run_id=run_id)
    manifest = make_manifest(task, known, streams, track, labelled)
    settled = (lambda _: False) if task.force else task.is_made_by
    return store.write_run(manifest, track=track, masked=masked, labelled=labelled, settled=settled)


def find_twin(known: RunJson | KnownLog | None, source: LogSource) -> str | None:
    """Return where else the same recording was ingested from, if it was."""
    return None if known is None or known.source.paths == source.origins else " + ".join(known.source.paths)


def _read(
    store: Store, run_id: str, before: RunJson | None, log: AnyLog, task: IngestTask, *, sha256: str
) -> tuple[Streams, RunJson]:
    """Return L1 and what is known of its log; from the store what was made with the same read settings."""
    from tcpipe.stages.read import find_read_config, read_run  # noqa: PLC0415  kernels load only when there is work

    key = f"{read_key(task.recipe, task.robot, definitions=task.definitions)}-{__version__}"
    if before and before.message_definitions == task.definitions and not task.force:
        cached = store.read_streams(run_id, key=key)
        if cached is not None:
            known = make_run_json(task, log, cached, sha256)
            return cached, replace(
                known, damage=before.damage, notes=before.notes, streams=before.streams, streams_key=key
            )
    damage, _ = split_notes(log.findings)
    if lost := find_total_loss(log.topics.values(), damage):
        raise LogError(*lost, findings=damage)
    streams = read_run(
        log, find_read_config(task.recipe, log.topics), robot=task.robot, known=load_profiles(task.recipe)
    )
    if task.source.has_changed():
        raise LogError(f"{task.source.name}: changed while it was read")
    damage, notes = split_notes(log.findings)
    known = make_run_json(task, log, streams, sha256)
    return streams, replace(known, damage=damage, notes=notes, streams_key=key)


def make_run_json(task: IngestTask, log: AnyLog, streams: Streams, sha256: str) -> RunJson:
    """Return what is known of a log that was read; its damage, notes and tags are to be added."""
    by_index = sha256 == log.outline or (log.is_known_by_outline and sha256 == log.sha256())
    return RunJson(
        source=LogOrigin(task.source.origins, sha256, log.size_bytes, "index" if by_index else "log"),
        robot=streams.robot,
        topics=tuple(TopicCount(topic.name, topic.type_name, topic.message_count) for topic in log.topics.values()),
        sensors=streams.sensors,
        message_definitions=task.definitions,
        report=streams.report,
        outline=log.outline or "",
    )


def make_manifest(
    task: IngestTask, known: RunJson, streams: Streams, track: Track, labelled: LabelledSegments
) -> Manifest:
    """Return what became of a run; ``known`` gives tags and damage."""
    info, count = labelled.info, labelled.table.num_rows
    subject = Subject("run", info.run_id)
    found = find_damaged_log(known.damage, subject)
    if 0 < count < read_threshold("few-segments", "min_segments_count"):
        found = (*found, make_finding("few-segments", subject, segments_count=count))
    info = add_findings(info, found, info.report.facts)
    messages = {role: table.num_rows for role, table in streams.tables.items()}
    return Manifest(
        run_id=info.run_id,
        recipe_id=make_recipe_id(task.recipe, streams.robot),
        data_model_version=DATA_MODEL_VERSION,
        tcpipe_version=__version__,
        ingest_key=ingest_key(task.recipe),
        recipe=task.recipe.ingest,
        robot=streams.robot,
        tags=known.tags,
        counts=Counts(count, track.table.num_rows, track.rejections.num_rows, messages),
        distance_by_reason_m=labelled.distance_by_reason_m,
        verdict=judge(info.report.findings),
        damage=known.damage,
        info=info,
        robot_requested=task.robot,
        message_definitions=task.definitions,
    )


def run_stages(
    streams: Streams, sections: IngestSections, *, run_id: str
) -> tuple[Track, MaskedTrack, LabelledSegments]:
    """Run fuse, gate, segment and label over the streams of one run.

    A stage gets its own section, and of the others nothing but the chord; no section that `recipe_id` is not the hash of is in reach.
    """
    from tcpipe.stages.fuse import fuse_run  # noqa: PLC0415  kernels load only when there is work
    from tcpipe.stages.label import label_segments  # noqa: PLC0415
    from tcpipe.stages.mask import mask_track  # noqa: PLC0415
    from tcpipe.stages.segment import segment_track  # noqa: PLC0415

    profile = load_profiles(sections).robots[streams.robot]
    step("fusing")
    track = fuse_run(streams, sections.fuse, run_id=run_id)
    step("cutting and labelling")
    masked = mask_track(
        track,
        sections.mask,
        max_velocity_mps=profile.max_velocity_mps,
        max_plausible_mps=profile.max_plausible_mps,
        chord_m=sections.segment.chord_m,
    )
    segments = segment_track(masked, sections.segment)
    labelled = label_segments(segments, masked, streams, sections.label, robot=profile)
    return track, masked, labelled
