"""Runs whose log was completed, repaired or recorded on: the older run is superseded, and counts again when its log is back (ADR 51)."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe.errors import StoreError
from tcpipe.formats.parquet import read_table
from tcpipe.formats.record_files import RunName, Superseded, in_force
from tcpipe.pipeline.log_sources import LogSource, is_there
from tcpipe.store import Store

logger = logging.getLogger("tcpipe")

_CONTAINED = 0.9
"""Where so large a share of an older run's measurements is in the newer one, it is the same recording, and loses nothing."""


def superseded_by(
    store: Store, source: LogSource, run_id: str, sha256: str, runs: Mapping[str, Sequence[str]]
) -> Iterator[str]:
    """Mark the runs that a log's content supersedes; yield a line about every run that was made from the same path before.

    A run counts again when its recording is seen again, wherever that is. A log that is as it was is looked at only where its run
    has a part in that.
    """
    records = store.records("superseded", Superseded)
    gone = in_force(records)
    if run_id in gone:
        store.supersede(run_id, None)
        yield f"run {run_id} counts again: its recording is back"
    seen = {sighting.sha256 for sighting in store.sightings(source.lineage)}
    new = sha256 not in seen
    parties = {party for record in records for party in (record.run_id, record.by)}
    earlier = seen - {sha256} if new or run_id in parties else ()
    for older in sorted(filter(None, (store.run_of(of, runs) for of in earlier))):
        if older != run_id and older not in gone and (new or older in parties):
            share = _share_of(store, older, run_id)
            elsewhere = _elsewhere(store, older, source) if share >= _CONTAINED else ""
            if share >= _CONTAINED and not elsewhere:
                store.supersede(older, run_id)
                yield f"run {older}, made from this path before, is superseded: this log holds what it held"
            elif new:
                held = f"this log holds {share:.0%} of it" if share else "that was another recording"
                why = f"its recording lies at {elsewhere}" if elsewhere else held
                yield f"run {older}, made from this path before, stays: {why}"


def remember_earlier(store: Store) -> None:
    """Write down which run a recording is, and where it lay, in a store that was made before that was remembered, or lost its records."""
    if "runs" not in store.place.folders("records"):
        for run_id in store.run_ids():
            with suppress(StoreError):  # told where it matters
                if (known := store.run_json(run_id)) is not None:
                    origin = known.source
                    log = LogSource(tuple(map(Path, origin.paths)), (), urls=origin.paths)
                    store.note(log.lineage, log.sighting(origin.sha256))
                    store.remember(f"runs/{origin.sha256}", RunName(origin.sha256, run_id))


def _elsewhere(store: Store, run_id: str, source: LogSource) -> str:
    """Return where else a run's recording lies, "" where it is gone."""
    known = store.run_json(run_id)
    for folder in store.place.folders("records/logs"):
        lineage = f"logs/{folder}"
        for sighting in store.sightings(lineage) if lineage != source.lineage else ():
            if known and sighting.sha256 == known.source.sha256 and sighting.size_and_time and is_there(sighting):
                return " + ".join(sighting.log)
    return ""


def _share_of(store: Store, older: str, newer: str) -> float:
    """Return the share of a run's measurements that another has too."""
    shared = every = 0
    mine_of, theirs_of = _stream_files(store, older), _stream_files(store, newer)
    for role, path in mine_of.items():
        try:
            mine, theirs = read_table(path), read_table(theirs_of[role]) if role in theirs_of else None
        except StoreError:
            continue
        every += mine.num_rows
        shared += 0 if theirs is None else _in_both(mine, theirs)
    return shared / every if every else 0.0


def _stream_files(store: Store, run_id: str) -> Mapping[str, Path]:
    with suppress(StoreError):
        known = store.run_json(run_id)
        return store.stream_files(run_id, known) if known else {}
    return {}


def _in_both(mine: pa.Table, theirs: pa.Table) -> int:
    """Count the rows of one table that are in the other: recorded at one instant with the same values."""
    floating = [field.name for field in mine.schema if pa.types.is_floating(field.type)]
    names = ["log_time_ns", *(name for name in floating if name in theirs.column_names)]
    others = set(_rows(theirs, names))
    return sum(row in others for row in _rows(mine, names))


def _rows(table: pa.Table, names: Sequence[str]) -> list[bytes]:
    columns = [np.asarray(table.column(name)).view(np.int64) for name in names]
    return [row.tobytes() for row in np.column_stack(columns)]
