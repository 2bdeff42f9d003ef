"""One recording, one run, wherever its log lies: what is hashed of a log in object storage is its index alone (ADR 86)."""

from __future__ import annotations

from tcpipe.formats.logs.joined import AnyLog
from tcpipe.formats.record_files import Recording, record_name
from tcpipe.store import Store


def known_as(store: Store, log: AnyLog) -> str:
    """Return the hash by which the store knows a log, or is to know it.

    That is the log's own unless the same recording was ingested from elsewhere, where more or less of it was at hand. A run with damage
    is not taken for it: what was broken there may be whole here.
    """
    outline, sha256 = log.outline, log.sha256()
    for other in store.records(_kind(outline), Recording) if outline else ():
        only_index = outline in (sha256, other.sha256)  # where both are hashed as a whole, their hashes tell them apart
        run = store.known_run(other.run_id) if other.outline == outline and only_index else None
        if run is not None and run.source.sha256 == other.sha256 and not run.damage:
            return other.sha256
    return sha256


def remember_outline(store: Store, run_id: str, sha256: str, log: AnyLog) -> None:
    """Remember the outline of a run's log."""
    if log.outline:
        store.note(_kind(log.outline), Recording(log.outline, run_id, sha256))


def _kind(outline: str) -> str:
    return f"outlines/{record_name(outline)}"
