"""What a store holds of all logs at once: their ingestions and where they were seen, from its index."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.record_files import Sighting, Superseded
from tcpipe.formats.stored_runs import Ingestions
from tcpipe.pipeline.log_sources import LogSource
from tcpipe.store import Store


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
    runs, made = store.ingestions(), dict[str, list[RunFacts]]()
    for facts in runs.rows.values():
        if facts.log is not None:
            made.setdefault(facts.log.source.sha256, []).append(facts)
    parties = {
        party for record in store.records("superseded", Superseded) for party in (record.run_id, record.by) if party
    }
    failed = frozenset(f"failed/{name.removesuffix('.json')}" for name in store.place.files("records/failed"))
    broken = {run_id for run_id, _ in runs.damaged} | {key[0] for key, row in runs.rows.items() if row.log is None}
    seen = {} if force else store.seen_logs()
    return KnownRuns(runs, made, seen, frozenset(parties), frozenset(broken), failed)
