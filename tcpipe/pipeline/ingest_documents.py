"""The documents that ingesting writes beside its tables: run.json of a log, manifest.json of what became of it."""

from __future__ import annotations

from tcpipe import __version__
from tcpipe.formats.logs.joined import AnyLog
from tcpipe.formats.recipe_toml import ingest_key, recipe_id
from tcpipe.formats.run_documents import Counts, LogOrigin, Manifest, RunJson, TopicCount
from tcpipe.pipeline.ingest_task import IngestTask
from tcpipe.pipeline.log_findings import find_damage
from tcpipe.tables.catalogue import threshold
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import DATA_MODEL_VERSION, LabelledSegments, Streams, Track, add_findings
from tcpipe.tables.verdicts import judge


def run_json_of(task: IngestTask, log: AnyLog, streams: Streams, sha256: str) -> RunJson:
    """Return what is known of a log that was read; its damage, remarks and tags are to be added."""
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


def manifest_of(
    task: IngestTask, known: RunJson, streams: Streams, track: Track, labelled: LabelledSegments
) -> Manifest:
    """Return what became of a run; ``known`` gives tags and damage."""
    info, count = labelled.info, labelled.table.num_rows
    subject = Subject("run", info.run_id)
    found = (*find_damage(known.damage, subject), *_find_few_segments(count, subject))
    info = add_findings(info, found, info.report.facts)
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
        counts=Counts(count, track.table.num_rows, track.rejections.num_rows, **rows),
        ledger_m=labelled.ledger_m,
        verdict=judge(info.report.findings),
        damage=known.damage,
        info=info,
        robot_requested=task.robot,
        message_definitions=task.definitions,
    )


def _find_few_segments(count: int, subject: Subject) -> tuple[Finding, ...]:
    few = 0 < count < threshold("few-segments", "min_segments_count")
    return (make_finding("few-segments", subject, segments_count=count),) if few else ()
