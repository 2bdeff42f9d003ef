"""One log becomes a run of the store: read, fused, gated, cut and labelled, each file whole or not at all."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

from tcpipe import __version__
from tcpipe.errors import LogError
from tcpipe.formats.index_files import KnownLog, RunFacts
from tcpipe.formats.logs.joined import AnyLog, open_logs
from tcpipe.formats.object_storage import is_url
from tcpipe.formats.recipe_toml import read_key
from tcpipe.formats.robot_files import profiles_of
from tcpipe.formats.run_documents import RunJson
from tcpipe.pipeline.ingest_documents import manifest_of, run_json_of
from tcpipe.pipeline.ingest_task import IngestResult, IngestTask, Status, result_of, told, too_young
from tcpipe.pipeline.log_sources import LogSource
from tcpipe.pipeline.outlines import known_as, remember_outline
from tcpipe.pipeline.run_stages import run_stages
from tcpipe.store import RunDirectory, Store
from tcpipe.tables.levels import Streams

logger = logging.getLogger("tcpipe")


def ingest_one(task: IngestTask) -> tuple[LogSource, IngestResult]:
    """Ingest one run from its log as that is now; every error becomes its result, so that one log never costs the others."""
    task = replace(task, source=task.source.now())
    hashed: list[str] = []
    young = too_young(task)
    if young is not None:
        return task.source, young
    result = told(task, partial(_ingest, hashed=hashed))
    if task.source.has_changed():
        note = "it changed while it was looked at; it is ingested when its recording has ended"
        return task.source, IngestResult(task.source.name, "waiting", notes=(note,))
    return task.source, replace(result, sha256=hashed[0]) if hashed else result


def _ingest(task: IngestTask, *, hashed: list[str]) -> IngestResult:
    """Ingest one run; what its log hashes to is left in ``hashed``, also on failure."""
    store, source = Store(task.store), task.source
    with ExitStack() as stack:
        opened = None if source.sha256 else _opened(task, stack)
        sha256 = known_as(store, opened) if opened else str(source.sha256)
        hashed.append(sha256)
        run_id = stack.enter_context(store.claimed_run(source.stem, sha256))
        same_as = _twin(store.known_run(run_id), source)
        before = None if task.force or store.known_run(run_id) is None else made_before(store, run_id, task, sha256)
        if before is not None:
            return before
        log = opened or _opened(task, stack)
        logger.info("%s: reading", source.name)
        streams, damage, remarks = _streams(store, run_id, log, task)
        known = run_json_of(task, log, streams, sha256)
        known = replace(known, damage=damage, remarks=remarks, tags=_tags(store, run_id, task))
        store.write_run_json(run_id, known)
        run = _fuse_and_label(store, run_id, streams, known, task)
        remember_outline(store, run_id, sha256, log)
    return result_of(source, "done", run.facts, sha256, same_as=same_as)


def made_before(store: Store, run_id: str, task: IngestTask, sha256: str) -> IngestResult | None:
    """Return the result of a run that is there as it would be made now, after setting its tags; None where there is none."""
    finished = next((run.facts for run in store.recipes_of(run_id) if task.is_made_by(run.facts)), None)
    if finished is None:
        return None
    return result_of(
        task.source, _retagged(store, run_id, task), finished, sha256, same_as=_twin(finished.log, task.source)
    )


def as_indexed(task: IngestTask, made: Sequence[RunFacts], sha256: str) -> IngestResult | None:
    """Return the result of a run that the index has as it would be made now, tags too; None where there is something to look at."""
    for facts in made:
        if facts.log is not None and task.is_made_by(facts) and task.tags.items() <= facts.log.tags.items():
            return result_of(task.source, "unchanged", facts, sha256, same_as=_twin(facts.log, task.source))
    return None


def _opened(task: IngestTask, stack: ExitStack) -> AnyLog:
    """Return the log, open until ``stack`` ends."""
    files = [entry if is_url(entry) else Path(entry) for entry in task.source.origins]
    log = open_logs(files, message_definitions=task.message_definitions, tables=task.recipe.tables)
    stack.enter_context(log)
    return log


def _fuse_and_label(store: Store, run_id: str, streams: Streams, known: RunJson, task: IngestTask) -> RunDirectory:
    track, gated, labelled = run_stages(streams, task.recipe.ingest, run_id=run_id, name=task.source.name)
    manifest = manifest_of(task, known, streams, track, labelled)
    path = store.write_run(manifest, track=track, gated=gated, labelled=labelled)
    return next(run for run in store.recipes_of(run_id) if run.path == path)


def _tags(store: Store, run_id: str, task: IngestTask) -> dict[str, str]:
    """Return the run's tags: those it has, and those given."""
    known = store.known_run(run_id)
    before = known.tags if known else next((run.facts.tags for run in store.recipes_of(run_id)), {})
    return {**before, **task.tags}


def _retagged(store: Store, run_id: str, task: IngestTask) -> Status:
    """Set the tags of a run that is there already; "done" where that changed something."""
    known, tags = store.known_run(run_id), _tags(store, run_id, task)
    if tags == (known.tags if known else {}):
        return "unchanged"
    store.tag_run(run_id, tags)
    return "done"


def _twin(known: RunJson | KnownLog | None, source: LogSource) -> str | None:
    """Return where else the same recording was ingested from, if it was."""
    return None if known is None or known.source.paths == source.origins else " + ".join(known.source.paths)


def _streams(
    store: Store, run_id: str, log: AnyLog, task: IngestTask
) -> tuple[Streams, tuple[str, ...], tuple[str, ...]]:
    """Return L1, from the store when it was made with the same read settings, the log's damage, and remarks on it."""
    from tcpipe.stages.read import read_run  # noqa: PLC0415

    key = f"{read_key(task.recipe, task.robot, definitions=task.definitions)}-{__version__}"
    known = store.known_run(run_id)
    same = known is not None and known.message_definitions == task.definitions
    cached = store.read_streams(run_id, key=key) if same and not task.force else None
    if cached is not None and known is not None:
        return cached, known.damage, known.remarks
    streams = read_run(log, task.recipe.read_of(log.topics), robot=task.robot, known=profiles_of(task.recipe))
    if task.source.has_changed():
        raise LogError(f"{task.source.name}: changed while it was read")
    store.write_streams(run_id, streams, key=key)
    return streams, tuple(str(damage) for damage in log.damage if damage.is_loss), tuple(log.remarks)
