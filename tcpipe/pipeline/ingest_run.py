"""Ingestion of one log into a run of the store: read, fuse, mask, cut and label; each file is complete or missing."""

import hashlib
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe import __version__
from tcpipe.errors import LogError
from tcpipe.formats.documents import State, make_key, make_run_key, read_record
from tcpipe.formats.integrity import compute_checksums
from tcpipe.formats.json_files import to_plain
from tcpipe.formats.logs.log_joining import AnyLog, open_logs
from tcpipe.formats.parquet import add_segments_metadata, return_freed_memory, write_table
from tcpipe.formats.recipe_toml import ingest_key, load_profiles, make_recipe_id, read_key
from tcpipe.formats.runs import Counts, LogOrigin, Recording, Run, RunFacts, Tags, TopicCount, list_physics_terms
from tcpipe.formats.stored_runs import (
    STREAMS,
    convert_run_errors,
    find_stream_files,
    lend_streams,
    read_streams,
    write_streams,
)
from tcpipe.logs.topics import split_notes
from tcpipe.pipeline.log_sources import LogSource, find_damaged_log, find_total_loss
from tcpipe.pipeline.plan import IngestResult, IngestTask, check_age, make_result, mark_reported
from tcpipe.progress import set_task, step
from tcpipe.recipe import IngestSections
from tcpipe.store import Store, name_run
from tcpipe.tables.columns import encode_rows, number_column, to_floats, to_integers
from tcpipe.tables.findings import Findings, Subject, make_finding, read_threshold
from tcpipe.tables.levels import (
    DATA_MODEL_VERSION,
    RESULTS_VERSION,
    LabelledSegments,
    MaskedTrack,
    Streams,
    Track,
    add_findings,
    add_metadata,
)


@dataclass(frozen=True, slots=True)
class Ingested:
    """Result of ingesting a log: the log at that time, and the hash of its content in the result."""

    source: LogSource
    result: IngestResult


def ingest_one(task: IngestTask) -> Ingested:
    """Ingest one run from its log as it is now; every error becomes its result, so that other logs are not affected."""
    return_freed_memory()
    task = replace(task, source=task.source.now())
    hashed = list[str]()
    young = check_age(task)
    if young is not None:
        return Ingested(task.source, young)
    with set_task(task.source.name):
        result = mark_reported(task, partial(_ingest, hashed=hashed))
    if task.source.has_changed():
        note = "changed during the check; will be ingested when its recording has ended"
        return Ingested(task.source, IngestResult(task.source.name, "waiting", notes=(note,)))
    return Ingested(task.source, replace(result, sha256=hashed[0]) if hashed else result)


@dataclass(frozen=True, slots=True)
class _Read:
    """The streams of a log, and findings on the log."""

    streams: Streams
    damage: Findings
    notes: Findings
    stored: RunFacts | None = None
    """The run of which these are the stored streams; None of streams that were read now."""


def _ingest(task: IngestTask, *, hashed: list[str]) -> IngestResult:
    """Ingest one run; append the hash of its log to ``hashed``, also on failure."""
    store, source = Store(task.store), task.source
    state = store.scan()
    with ExitStack() as stack:
        opened = None if source.sha256 else _open_log(task, stack)
        sha256 = _find_hash(state, opened) if opened else str(source.sha256)
        hashed.append(sha256)
        runs_of_log = [row for row in state.runs.values() if row.log.sha256 == sha256]
        same_as = next((twin for row in runs_of_log if (twin := find_twin(row, source))), None)
        stored_run = None if task.force else next((row for row in runs_of_log if task.is_made_by(row)), None)
        if stored_run is not None and (not stored_run.blob or state.has_payload(stored_run)):
            tag_log(store, state, sha256, task.tags)
            return make_result(source, "unchanged", stored_run, sha256, same_as=same_as)
        log, run_id = opened or _open_log(task, stack), name_run(state, source.stem, sha256)
        directory = stack.enter_context(store.place.workshop())
        stack.enter_context(convert_run_errors(store.place.where(), directory))
        step("reading")
        key = f"{read_key(task.recipe, task.robot, definitions=task.definitions)}-{RESULTS_VERSION}"
        read = _find_stored_streams(store, state, runs_of_log, task, key) or _read(log, task)
        if read.stored is None:
            write_streams(directory, read.streams, key=key)
            files = {path.stem: path for path in (directory / STREAMS).iterdir()}
        else:
            files = find_stream_files(store.place, read.stored)
        read = replace(read, streams=lend_streams(read.streams, files))
        return_freed_memory()
        track, masked, labelled = run_stages(read.streams, task.recipe.ingest, run_id=run_id)
        run = make_run(task, log, read, track, labelled, sha256=sha256, key=key)
        write_tables(directory, run, track, masked, labelled)
        run = put_run(store, state, run, directory, read.stored)
        tag_log(store, state, sha256, task.tags)
    row = next(row for row in state.runs.values() if row.blob == run.blob)
    return make_result(source, "done", row, sha256, same_as=same_as)


def tag_log(store: Store, state: State, sha256: str, given: Mapping[str, str]) -> None:
    """Add tags to those of a log, unless it has them."""
    before = state.find_tags(sha256)
    if not given.items() <= before.items():
        store.put(state, "tags", make_key(sha256), Tags(sha256, {**before, **given}))


def _find_hash(state: State, log: AnyLog) -> str:
    """Return the hash that identifies a log in the store (ADR-36).

    It is the log's own hash, unless a run without damage has the same outline and one of both logs was identified by it
    alone: then it is the hash of that run. A damaged run does not count: its damaged parts may be intact here.
    """
    outline, sha256 = log.outline, log.sha256()
    for row in state.runs.values() if outline else ():
        # Two logs whose whole contents are hashed differ if their hashes differ.
        only_index = outline in (sha256, row.log.sha256)
        if row.log.outline == outline and only_index and not row.damage:
            return row.log.sha256
    return sha256


def _open_log(task: IngestTask, stack: ExitStack) -> AnyLog:
    """Return the log, open until ``stack`` ends."""
    log = open_logs(task.source.locations(), message_definitions=task.message_definitions, tables=task.recipe.tables)
    stack.enter_context(log)
    return log


def find_twin(known: RunFacts, source: LogSource) -> str | None:
    """Return the other path from which a run was ingested; None if it is the path of the source."""
    return None if known.log.paths == source.origins else " + ".join(known.log.paths)


def _find_stored_streams(
    store: Store, state: State, known: Iterable[RunFacts], task: IngestTask, key: str
) -> _Read | None:
    """Return the stored streams of the same log that were read with the same settings; None without any."""
    for row in known:
        if not task.force and row.read_key == key and row.streams_blob in state.blobs:
            streams = read_streams(store.place, row)
            if streams is not None:
                document = state.names["runs", make_run_key(row.log.sha256, row.recipe_id)]
                return _Read(streams, row.damage, read_record(store.place, document, Run).notes, row)
    return None


def _read(log: AnyLog, task: IngestTask) -> _Read:
    """Read the streams of a log (level L1); `LogError` if damage leaves no message."""
    from tcpipe.stages.read import find_read_config, read_run  # noqa: PLC0415  kernels load only when there is work

    damage, _ = split_notes(log.findings)
    if lost := find_total_loss(log.topics.values(), damage):
        raise LogError(*lost, findings=damage)
    streams = read_run(
        log, find_read_config(task.recipe, log.topics), robot=task.robot, known=load_profiles(task.recipe)
    )
    if task.source.has_changed():
        raise LogError(f"{task.source.name}: changed while it was read")
    return _Read(streams, *split_notes(log.findings))


def make_run(
    task: IngestTask, log: AnyLog, read: _Read, track: Track, labelled: LabelledSegments, *, sha256: str, key: str
) -> Run:
    """Return the record of a run whose tables are not in the store yet."""
    info, table, streams = labelled.info, labelled.table, read.streams
    subject = Subject("run", info.run_id)
    found = find_damaged_log(read.damage, subject)
    if 0 < table.num_rows < read_threshold("few-segments", "min_segments_count"):
        found = (*found, make_finding("few-segments", subject, segments_count=table.num_rows))
    info = add_findings(info, found, info.report.facts)
    label, messages = info.report.facts.label, {role: rows.num_rows for role, rows in streams.tables.items()}
    by_index = sha256 == log.outline or (log.is_known_by_outline and sha256 == log.sha256())
    return Run(
        run_id=info.run_id,
        recipe_id=make_recipe_id(task.recipe, streams.robot),
        data_model_version=DATA_MODEL_VERSION,
        results_version=RESULTS_VERSION,
        tcpipe_version=__version__,
        ingest_key=ingest_key(task.recipe),
        read_key=key,
        robot=streams.robot,
        robot_requested=task.robot,
        message_definitions=task.definitions,
        log=LogOrigin(task.source.origins, sha256, log.size_bytes, "index" if by_index else "log", log.outline or ""),
        recording=describe_recording(streams),
        sensors=streams.sensors,
        segments=table.num_rows,
        start_ns=int(to_integers(table, "start_ns")[0]) if table.num_rows else None,
        end_ns=int(to_integers(table, "end_ns")[-1]) if table.num_rows else None,
        distance_by_reason_m=labelled.distance_by_reason_m,
        findings=info.report.findings,
        damage=read.damage,
        energy_joule=None if label is None else label.energy_joule,
        energy_budget=None if label is None else label.energy_budget,
        idle_watt=None if label is None else label.physics.idle_watt,
        physics=list_physics_terms(label),
        blob="",
        tables={},
        streams_blob="",
        streams={},
        recipe=task.recipe.ingest,
        counts=Counts(table.num_rows, track.table.num_rows, track.rejections.num_rows, messages),
        info=info,
        topics=tuple(TopicCount(topic.name, topic.type_name, topic.message_count) for topic in log.topics.values()),
        notes=read.notes,
    )


_FIRST_ROWS = 20
_IDENTIFYING = ("gnss", "pose", "imu", "wheel_odometry", "visual_odometry")  # sensors whose values seldom repeat


def describe_recording(streams: Streams) -> Recording | None:
    """Return when a log was recorded, and a hash of the first measurements of its sensors of motion."""
    tables = {role: table for role, table in streams.tables.items() if table.num_rows}
    if not tables:
        return None
    stamps = [to_integers(table, "stamp_ns") for table in tables.values()]
    content_hash = hashlib.sha256()
    for role in _IDENTIFYING:
        if role in tables:
            names = [field.name for field in tables[role].schema if field.type in (pa.float64(), pa.int64())]
            content_hash.update(b"".join([role.encode(), *encode_rows(_take_first_changes(tables[role]), names)]))
    first_ns, last_ns = min(int(stamp_ns.min()) for stamp_ns in stamps), max(int(stamp_ns.max()) for stamp_ns in stamps)
    return Recording(first_ns, last_ns, sum(table.num_rows for table in tables.values()), content_hash.hexdigest()[:16])


def _take_first_changes(table: pa.Table) -> pa.Table:
    """Return the first rows that differ from the row before: rows of a stationary robot are alike for every log."""
    is_new = np.zeros(table.num_rows, bool)
    is_new[0] = True
    for field in table.schema:
        if field.type == pa.float64():
            values = to_floats(table, field.name)
            is_new[1:] |= (values[1:] != values[:-1]) & ~(np.isnan(values[1:]) & np.isnan(values[:-1]))
    return table.take(number_column(np.flatnonzero(is_new)[:_FIRST_ROWS]))


def write_tables(directory: Path, run: Run, track: Track, masked: MaskedTrack, labelled: LabelledSegments) -> None:
    """Write track, segments and rejections of a run into a directory."""
    metadata = {
        "run_id": run.run_id, "recipe_id": run.recipe_id, "datum": to_plain(run.info.datum), "robot": run.robot,
    }  # fmt: skip
    tables = {
        "track": masked.table,
        "segments": add_segments_metadata(labelled.table, run.info.datum),
        "rejections": track.rejections,
    }
    for name, table in tables.items():
        write_table(add_metadata(table, metadata), directory / f"{name}.parquet")


def put_run(store: Store, state: State, run: Run, directory: Path, stored: RunFacts | None) -> Run:
    """Put the files of a run into the store, then its manifest; ``stored`` has streams that are there already."""
    files = compute_checksums(directory)
    streams = {name: checksum for name, checksum in files.items() if name.startswith(f"{STREAMS}/")}
    blob = store.put_blob(directory)
    run = replace(
        run,
        blob=blob,
        tables={name: checksum for name, checksum in files.items() if name not in streams},
        streams_blob=blob if stored is None else stored.streams_blob,
        streams=streams if stored is None else stored.streams,
    )
    store.put_run(state, run)
    return run


def run_stages(
    streams: Streams, sections: IngestSections, *, run_id: str
) -> tuple[Track, MaskedTrack, LabelledSegments]:
    """Run fuse, gate, segment and label over the streams of one run.

    Each stage gets only its own section of the recipe, and the chord. All of these sections are part of the hash
    `recipe_id`.
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
    return track, masked, label_segments(segments, masked, streams, sections.label, robot=profile)
