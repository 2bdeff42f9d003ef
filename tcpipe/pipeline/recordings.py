"""Recordings that are in the store twice: the same file under two names, or two recordings of one drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.parquet import read_table
from tcpipe.store import RunDirectory
from tcpipe.tables.columns import floats, integers

_SAME_TIME_NS = 1_000_000_000
_SAME_PLACE_M = 2.0
_SAME_DRIVE = 0.5
"""A run of which this share of segments begins at the time and place of another's is the same drive."""

_METRES_PER_DEG = 111_320.0


@dataclass(frozen=True, slots=True)
class _Starts:
    """When and where the segments of a run begin, by time: [ns], (N,), and lon, lat [deg], (N, 2)."""

    stamp_ns: NDArray[np.int64]
    lonlat_deg: NDArray[np.float64]


def each_drive_once(
    runs: Sequence[RunDirectory], sha256_by_run: dict[str, str]
) -> tuple[list[RunDirectory], list[str]]:
    """Return the runs without second recordings, and a warning for each of those; of two, the first by id stays.

    Parameters
    ----------
    runs
        Runs to choose from.
    sha256_by_run
        Hash of each run's log.

    """
    kept: list[RunDirectory] = []
    starts: list[_Starts] = []
    warnings: list[str] = []
    for run in sorted(runs, key=lambda run: (run.run_id, run.recipe_id)):
        mine = _starts(run)
        twin = _same_file(run, kept, sha256_by_run)
        if twin is not None:
            warnings.append(f"run {run.run_id}: the same recording as run {twin.run_id}; used once")
            continue
        shares = [
            _shared(mine, other) if run.robot == first.robot else 0.0 for first, other in zip(kept, starts, strict=True)
        ]
        most = int(np.argmax(shares)) if shares else 0
        if shares and shares[most] >= _SAME_DRIVE:
            warnings.append(
                f"run {run.run_id}: {shares[most]:.0%} of its segments begin when and where those of run {kept[most].run_id} do: "
                "the same drive; used once"
            )
            continue
        kept.append(run)
        starts.append(mine)
    return kept, warnings


def _same_file(run: RunDirectory, kept: Sequence[RunDirectory], sha256_by_run: dict[str, str]) -> RunDirectory | None:
    sha256 = sha256_by_run[run.run_id]
    return next((other for other in kept if sha256_by_run[other.run_id] == sha256), None)


def _starts(run: RunDirectory) -> _Starts:
    columns = ["start_ns", "start_lon_deg", "start_lat_deg"]
    table = read_table(run.path / "segments.parquet", columns)
    stamps = integers(table, columns[0])
    order = np.argsort(stamps, kind="stable")
    return _Starts(stamps[order], np.column_stack([floats(table, name) for name in columns[1:]])[order])


def _shared(mine: _Starts, other: _Starts) -> float:
    """Return the share of ``mine`` that begins within 1 s and 2 m of a segment of ``other``."""
    if len(mine.stamp_ns) == 0 or len(other.stamp_ns) == 0:
        return 0.0
    later, earlier = max(mine.stamp_ns[0], other.stamp_ns[0]), min(mine.stamp_ns[-1], other.stamp_ns[-1])
    if later - earlier > _SAME_TIME_NS:
        return 0.0
    after = np.clip(np.searchsorted(other.stamp_ns, mine.stamp_ns), 1, max(len(other.stamp_ns) - 1, 1))
    found = np.zeros(len(mine.stamp_ns), np.bool_)
    for at in (after - 1, np.minimum(after, len(other.stamp_ns) - 1)):
        together = np.abs(other.stamp_ns[at] - mine.stamp_ns) <= _SAME_TIME_NS
        step_deg = other.lonlat_deg[at] - mine.lonlat_deg
        east_m = step_deg[:, 0] * _METRES_PER_DEG * np.cos(np.radians(mine.lonlat_deg[:, 1]))
        found |= together & (np.hypot(east_m, step_deg[:, 1] * _METRES_PER_DEG) <= _SAME_PLACE_M)
    return float(found.mean())
