"""One log becomes a run of the store: read, fused, gated, cut and labelled, each file whole or not at all."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial

import pyarrow as pa

from tcpipe import __version__
from tcpipe.errors import LogError
from tcpipe.formats.index_files import KnownLog, RunFacts, facts_of
from tcpipe.formats.lent_tables import lend_streams
from tcpipe.formats.logs.joined import AnyLog, open_logs
from tcpipe.formats.recipe_toml import read_key
from tcpipe.formats.robot_files import profiles_of
from tcpipe.formats.run_documents import Manifest, RunJson
from tcpipe.pipeline.ingest_documents import manifest_of, run_json_of
from tcpipe.pipeline.ingest_task import IngestResult, IngestTask, Status, result_of, told, too_young
from tcpipe.pipeline.log_sources import LogSource
from tcpipe.pipeline.outlines import known_as, remember_outline
from tcpipe.pipeline.run_stages import run_stages
from tcpipe.progress import step, working_on
from tcpipe.store import Store
from tcpipe.tables.levels import Streams

_M_MMAP_THRESHOLD = -3


def ingest_one(task: IngestTask) -> tuple[LogSource, IngestResult]:
    """Ingest one run from its log as that is now; every error becomes its result, so that one log never costs the others."""
    _return_freed_memory()
    task = replace(task, source=task.source.now())
    hashed: list[str] = []
    young = too_young(task)
    if young is not None:
        return task.source, young
    with working_on(task.source.name):
        result = told(task, partial(_ingest, hashed=hashed))
    if task.source.has_changed():
        note = "it changed while it was looked at; it is ingested when its recording has ended"
        return task.source, IngestResult(task.source.name, "waiting", notes=(note,))
    return task.source, replace(result, sha256=hashed[0]) if hashed else result


def _return_freed_memory() -> None:
    """Have columns go back to the system when nobody needs them: heaps would keep the room of all that a long log ever took."""
    pa.set_memory_pool(pa.system_memory_pool())
    with suppress(OSError, AttributeError, TypeError):  # only glibc has it
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, 1 << 20)
        library.malloc_trim(0)


def _ingest(task: IngestTask, *, hashed: list[str]) -> IngestResult:
    """Ingest one run; what its log hashes to is left in ``hashed``, also on failure."""
    store, source = Store(task.store), task.source
    with ExitStack() as stack:
        opened = None if source.sha256 else _opened(task, stack)
        sha256 = known_as(store, opened) if opened else str(source.sha256)
        hashed.append(sha256)
        named = store.run_of_content(sha256)
        before = store.known_run(named) if named else None
        if named and before and not task.force and (made := made_before(store, named, task, sha256)):
            return made
        log = opened or _opened(task, stack)
        step("reading")
        same_as = _twin(before, source)
        streams, known = _read(store, named, before, log, task, sha256=sha256)
        known = replace(known, tags={**_tags(store, named, before), **task.tags})
        run_id = named or store.claim_run(source.stem, sha256)
        if not known.streams:
            known = replace(known, streams=store.write_streams(run_id, streams, key=known.streams_key))
        store.write_run_json(run_id, known)
        remember_outline(store, run_id, sha256, log)  # before it is done: then nobody looks again
        streams = lend_streams(store.runs_place.below(run_id), streams, known.streams)
        _return_freed_memory()
        manifest = _fuse_and_label(store, run_id, streams, known, task)
    return result_of(source, "done", facts_of(manifest, state=""), sha256, same_as=same_as)


def made_before(store: Store, run_id: str, task: IngestTask, sha256: str) -> IngestResult | None:
    """Return the result of a run that is there as it would be made now, after setting its tags; None where there is none."""
    finished = next((run.facts for run in store.recipes_of(run_id) if task.is_made_by(run.facts)), None)
    if finished is None:
        return None
    status: Status = "done" if store.tag_run(run_id, task.tags) else "unchanged"
    return result_of(task.source, status, finished, sha256, same_as=_twin(finished.log, task.source))


def as_indexed(task: IngestTask, made: Sequence[RunFacts], sha256: str) -> IngestResult | None:
    """Return the result of a run that the index has as it would be made now, tags too; None where there is something to look at."""
    for facts in made:
        if facts.log is not None and task.is_made_by(facts) and task.tags.items() <= facts.log.tags.items():
            return result_of(task.source, "unchanged", facts, sha256, same_as=_twin(facts.log, task.source))
    return None


def _opened(task: IngestTask, stack: ExitStack) -> AnyLog:
    """Return the log, open until ``stack`` ends."""
    log = open_logs(task.source.locations(), message_definitions=task.message_definitions, tables=task.recipe.tables)
    stack.enter_context(log)
    return log


def _fuse_and_label(store: Store, run_id: str, streams: Streams, known: RunJson, task: IngestTask) -> Manifest:
    track, gated, labelled = run_stages(streams, task.recipe.ingest, run_id=run_id)
    manifest = manifest_of(task, known, streams, track, labelled)
    settled = (lambda _: False) if task.force else task.is_made_by
    return store.write_run(manifest, track=track, gated=gated, labelled=labelled, settled=settled)


def _twin(known: RunJson | KnownLog | None, source: LogSource) -> str | None:
    """Return where else the same recording was ingested from, if it was."""
    return None if known is None or known.source.paths == source.origins else " + ".join(known.source.paths)


def _tags(store: Store, run_id: str | None, known: RunJson | None) -> Mapping[str, str]:
    """Return the tags that a run has."""
    if known is not None or run_id is None:
        return known.tags if known else {}
    return next((run.facts.tags for run in store.recipes_of(run_id)), {})


def _read(
    store: Store, run_id: str | None, before: RunJson | None, log: AnyLog, task: IngestTask, *, sha256: str
) -> tuple[Streams, RunJson]:
    """Return L1 and what is known of its log; from the store what was made with the same read settings."""
    from tcpipe.stages.read import read_run  # noqa: PLC0415
    from tcpipe.stages.read_roles import find_read_config  # noqa: PLC0415

    key = f"{read_key(task.recipe, task.robot, definitions=task.definitions)}-{__version__}"
    if run_id and before and before.message_definitions == task.definitions and not task.force:
        cached = store.read_streams(run_id, key=key)
        if cached is not None:
            known = run_json_of(task, log, cached, sha256)
            return cached, replace(
                known, damage=before.damage, remarks=before.remarks, streams=before.streams, streams_key=key
            )
    streams = read_run(log, find_read_config(task.recipe, log.topics), robot=task.robot, known=profiles_of(task.recipe))
    if task.source.has_changed():
        raise LogError(f"{task.source.name}: changed while it was read")
    damage = tuple(str(damage) for damage in log.damage if damage.is_loss)
    known = run_json_of(task, log, streams, sha256)
    return streams, replace(known, damage=damage, remarks=tuple(log.remarks), streams_key=key)
