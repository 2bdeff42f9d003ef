"""Runs whose log was completed, repaired or recorded on: the older run is superseded, and counts again when its log is back (ADR-18)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa

from tcpipe.errors import StoreError
from tcpipe.formats.commits import State, Superseded
from tcpipe.formats.parquet import read_table
from tcpipe.pipeline.log_sources import LogSource, is_there
from tcpipe.store import Store

_CONTAINED = 0.9
"""Where so large a share of an older run's measurements is in the newer one, it is the same recording, and loses nothing."""


def find_superseded(
    store: Store, state: State, source: LogSource, run_id: str, sha256: str
) -> tuple[list[Superseded], list[str]]:
    """Return which runs the content of a log supersedes, and a line about every run that was made from the same path before.

    A run counts again when its recording is seen again, wherever that is. A log that is as it was is looked at only where its run
    has a part in that.
    """
    found, notes, gone, parties = list[Superseded](), list[str](), state.superseded, state.parties
    if run_id in gone:
        found.append(Superseded(run_id, None))
        notes.append(f"run {run_id} counts again: its recording is back")
    seen = {sighting.sha256 for sighting in state.seen.get(source.lineage, ())}
    new = sha256 not in seen
    earlier = seen - {sha256} if new or run_id in parties else ()
    for older in sorted(filter(None, map(state.find_run, earlier))):
        if older != run_id and older not in gone and (new or older in parties):
            share = _compute_shared_fraction(store, older, run_id)
            elsewhere = _describe_elsewhere(state, older, source) if share >= _CONTAINED else ""
            if share >= _CONTAINED and not elsewhere:
                found.append(Superseded(older, run_id))
                notes.append(f"run {older}, made from this path before, is superseded: this log holds what it held")
            elif new:
                held = f"this log holds {share:.0%} of it" if share else "that was another recording"
                why = f"its recording lies at {elsewhere}" if elsewhere else held
                notes.append(f"run {older}, made from this path before, stays: {why}")
    return found, notes


def _describe_elsewhere(state: State, run_id: str, source: LogSource) -> str:
    """Return where else a run's recording lies, "" where it is gone."""
    contents = {row.log.source.sha256 for row in state.find_rows(run_id) if row.log}
    for lineage, sightings in state.seen.items():
        for sighting in sightings if lineage != source.lineage else ():
            if sighting.sha256 in contents and sighting.size_and_time and is_there(sighting):
                return " + ".join(sighting.log)
    return ""


def _compute_shared_fraction(store: Store, older: str, newer: str) -> float:
    """Return the share of a run's measurements that another has too."""
    shared = every = 0
    mine_of, theirs_of = _find_stream_files(store, older), _find_stream_files(store, newer)
    for role, path in mine_of.items():
        try:
            mine, theirs = read_table(path), read_table(theirs_of[role]) if role in theirs_of else None
        except StoreError:
            continue
        every += mine.num_rows
        shared += 0 if theirs is None else _count_shared_rows(mine, theirs)
    return shared / every if every else 0.0


def _find_stream_files(store: Store, run_id: str) -> Mapping[str, Path]:
    with suppress(StoreError):
        known = store.run_json(run_id)
        return store.stream_files(run_id, known) if known else {}
    return {}


def _count_shared_rows(mine: pa.Table, theirs: pa.Table) -> int:
    """Count the rows of one table that are in the other: recorded at one instant with the same values."""
    floating = [field.name for field in mine.schema if pa.types.is_floating(field.type)]
    names = ["log_time_ns", *(name for name in floating if name in theirs.column_names)]
    others = set(_read_rows(theirs, names))
    return sum(row in others for row in _read_rows(mine, names))


def _read_rows(table: pa.Table, names: Sequence[str]) -> list[bytes]:
    columns = [np.asarray(table.column(name)).view(np.int64) for name in names]
    return [row.tobytes() for row in np.column_stack(columns)]
