"""What a store holds of all logs at once: their ingestions and where they were seen, from its index."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from tcpipe.errors import StoreError
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.record_files import Sighting, Superseded
from tcpipe.formats.stored_runs import Ingestions
from tcpipe.pipeline.begun_calls import begun_calls
from tcpipe.pipeline.known_trouble import Trouble
from tcpipe.pipeline.log_sources import LogSource
from tcpipe.store import Store, is_named_after


@dataclass(frozen=True, slots=True)
class KnownRuns:
    """What a store holds when a call begins."""

    runs: Ingestions
    made: Mapping[str, list[RunFacts]]
    """Finished ingestions, by the sha256 of the log."""
    seen: Mapping[str, list[Sighting]]
    """Logs that were seen, by lineage; none where they are to be read again."""
    parties: frozenset[str]
    """Runs that another has taken the place of, or did once, and those others."""
    broken: frozenset[str]
    """Runs with a document or file that is gone, or not as it was written."""
    failed: frozenset[str]
    """Names of the records of failures."""

    def has_seen(self, source: LogSource, sha256: str) -> bool:
        """Tell whether this is remembered of the log."""
        return source.sighting(sha256) in self.seen.get(source.lineage, ())


def known_runs(store: Store, *, force: bool = False) -> KnownRuns:
    """Return what a store holds; with ``force`` no log was seen before."""
    runs, made = list_runs(store), dict[str, list[RunFacts]]()
    for facts in runs.rows.values():
        if facts.log is not None:
            made.setdefault(facts.log.source.sha256, []).append(facts)
    parties = {
        party for record in store.records("superseded", Superseded) for party in (record.run_id, record.by) if party
    }
    failed = frozenset(f"failed/{name.removesuffix('.json')}" for name in store.place.files("records/failed"))
    broken = {run_id for run_id, _ in runs.damaged}
    seen = {} if force else store.seen_logs()
    return KnownRuns(runs, made, seen, frozenset(parties), frozenset(broken), failed)


def list_runs(store: Store) -> Ingestions:
    """Return what there is of all runs; every run that is not complete is among the damaged, whatever of it is gone.

    Without a manifest a run is complete in two cases: a call that may still run makes it, or its log failed, which is told of the log.
    """
    found = store.ingestions()
    damaged = dict(found.damaged)
    for run in found.finished:
        if run.facts.log is None:
            damaged[run.run_id, run.recipe_id] = _wrong_with_log(store, run.run_id)
    finished = tuple(run for run in found.finished if run.facts.log is not None)
    unfinished = tuple(name for name in found.unfinished if name not in {run_id for run_id, _ in damaged})
    if unfinished and not any(call.state != "killed" for call in begun_calls(store)):
        failed = [trouble.content for trouble in store.records("failed", Trouble)]
        for name in unfinished:
            # A call may have finished it, and ended, since it was listed.
            if not any(is_named_after(name, content) for content in failed) and not store.recipes_of(name):
                damaged[name, ""] = f"{store.runs_place.where(name)}: has no manifest-<n>.json; ingest the log again"
        unfinished = tuple(name for name in unfinished if (name, "") not in damaged)
    return replace(found, finished=finished, damaged=damaged, unfinished=unfinished)


def _wrong_with_log(store: Store, run_id: str) -> str:
    """Return why what is known of a run's log cannot be believed."""
    try:
        store.run_json(run_id)
    except StoreError as error:
        return error.problems[0]
    return f"{store.runs_place.where(run_id)}/run-1.json: is gone; ingest the log again"
