"""Recordings that are in the store twice: one file under two names, or two recordings of one drive, whole or in part (ADR-18)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.findings import Finding, Subject, make_finding

_SAME_TIME_NS = 1_000_000_000
_SAME_PLACE_M = 2.0
_SAME_DRIVE = 0.5
"""Where so large a share of two runs is together, to the second and in place, their clocks may differ by a constant."""

_METRES_PER_DEG = 111_320.0

_NEVER_NS = 2**61
"""Beyond any time [ns since 1970], and twice of it is an integer still."""

_WAYS = 64
"""So many ways are held at once."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class UniqueRuns:
    """Runs of which each drive is there once: ``again`` marks, by run, the segments that an earlier one in ``runs`` has too."""

    runs: tuple[RunDirectory, ...]
    again: Mapping[str, Mask]
    findings: tuple[Finding, ...]


@dataclass(frozen=True, slots=True)
class _Spans:
    """From when to when the runs' segments are [ns] and whose they are, (N,); a run of which that is not known is there at any time."""

    start_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    robot: NDArray[np.str_]

    def find_overlapping(self, index: int) -> list[int]:
        """Return which earlier runs of the same robot have segments at the time of one."""
        early = slice(0, index)
        apart_ns = np.maximum(self.start_ns[early], self.start_ns[index]) - np.minimum(
            self.end_ns[early], self.end_ns[index]
        )
        found: list[int] = np.flatnonzero(
            (apart_ns <= _SAME_TIME_NS) & (self.robot[early] == self.robot[index])
        ).tolist()
        return found


@dataclass(frozen=True, slots=True)
class _SegmentPositions:
    """When and where a run's segments lie, in the order of its file, which is that of time: [ns], (N,), and lon, lat [deg], (N, 2)."""

    start_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    lonlat_deg: NDArray[np.float64]


def remove_duplicates(runs: Sequence[RunDirectory], sha256_by_run: Mapping[str, str]) -> UniqueRuns:
    """Return the runs, by id, without second recordings, and a finding for each of those; of two, the first by id stays.

    Parameters
    ----------
    runs : runs to choose from, all of one recipe.
    sha256_by_run : hash of each run's log.
    """
    runs = sorted(runs, key=lambda run: (run.run_id, run.recipe_id))
    spans, kept = _read_spans(runs), dict[int, RunDirectory]()

    @lru_cache(maxsize=_WAYS)
    def way(index: int) -> _SegmentPositions:
        return _read_positions(runs[index])

    again: dict[str, Mask] = {}
    findings: list[Finding] = []
    by_sha256: dict[str, str] = {}
    for index, run in enumerate(runs):
        twin = by_sha256.setdefault(sha256_by_run[run.run_id], run.run_id)
        if twin != run.run_id:
            findings.append(_find_twice(run, run.facts.segments, [twin]))
            continue
        twice, others = np.zeros(run.facts.segments, np.bool_), []
        for earlier in spans.find_overlapping(index):
            if earlier in kept:
                shared = _find_shared(way(index), way(earlier))
                twice |= shared
                others += [kept[earlier].run_id] if shared.any() else []
        if twice.any():
            findings.append(_find_twice(run, int(twice.sum()), others))
        if twice.all() and len(twice):
            continue
        again[run.run_id] = twice
        kept[index] = run
    return UniqueRuns(tuple(kept.values()), again, tuple(findings))


def _find_twice(run: RunDirectory, duplicates: int, others: Sequence[str]) -> Finding:
    return make_finding(
        "drive-recorded-twice",
        Subject("run", run.run_id),
        names={"others": ", ".join(others)},
        duplicate_count=duplicates,
        segment_count=run.facts.segments,
    )


def _read_spans(runs: Sequence[RunDirectory]) -> _Spans:
    """Return when the runs have segments; one without segments is nowhere."""
    start_ns, end_ns = np.empty(len(runs), np.int64), np.empty(len(runs), np.int64)
    for index, run in enumerate(runs):
        facts = run.facts
        if not facts.segments:
            start_ns[index], end_ns[index] = _NEVER_NS, -_NEVER_NS
        elif facts.start_ns is None or facts.end_ns is None:
            start_ns[index], end_ns[index] = -_NEVER_NS, _NEVER_NS
        else:
            start_ns[index], end_ns[index] = facts.start_ns, facts.end_ns
    return _Spans(start_ns, end_ns, np.array([run.facts.robot for run in runs], np.str_))


def _read_positions(run: RunDirectory) -> _SegmentPositions:
    names = [f"{end}_{what}" for end in ("start", "end") for what in ("ns", "lon_deg", "lat_deg")]
    table = run.table("segments", names)
    middle = [
        (to_floats(table, f"start_{axis}_deg") + to_floats(table, f"end_{axis}_deg")) / 2 for axis in ("lon", "lat")
    ]
    return _SegmentPositions(to_integers(table, "start_ns"), to_integers(table, "end_ns"), np.column_stack(middle))


def _find_shared(mine: _SegmentPositions, other: _SegmentPositions) -> Mask:
    """Mark the segments of ``mine`` that are ``other``'s: at one time a robot is at one place."""
    skew_ns = 0
    together_ns = min(mine.end_ns[-1], other.end_ns[-1]) - max(mine.start_ns[0], other.start_ns[0])
    if together_ns >= _SAME_DRIVE * min(way.end_ns[-1] - way.start_ns[0] for way in (mine, other)):
        loosely, apart_ns = _find_overlapping(mine, other, slack_ns=_SAME_TIME_NS)
        if loosely.sum() >= _SAME_DRIVE * min(len(mine.start_ns), len(other.start_ns)):
            skew_ns = int(np.median(apart_ns[loosely]))
    return _find_overlapping(mine, other, skew_ns=skew_ns)[0]


def _find_overlapping(
    mine: _SegmentPositions, other: _SegmentPositions, *, slack_ns: int = 0, skew_ns: int = 0
) -> tuple[Mask, NDArray[np.int64]]:
    """Mark the segments whose middle half overlaps one of the other's in time, but for the slack, and that lie within 2 m of it.

    The second array says how much later than that one they are [ns], once ``skew_ns`` is taken off.
    """
    start_ns, quarter_ns = mine.start_ns - skew_ns, (mine.end_ns - mine.start_ns) // 4
    first = np.searchsorted(other.end_ns, start_ns + quarter_ns - slack_ns, side="right")
    last = np.searchsorted(other.start_ns, start_ns + 3 * quarter_ns + slack_ns, side="left") - 1
    nearest_m, apart_ns = np.full(len(start_ns), np.inf), np.zeros(len(start_ns), np.int64)
    for at in (first, (first + last) // 2, last):
        there = np.clip(at, 0, len(other.start_ns) - 1)
        step_deg = other.lonlat_deg[there] - mine.lonlat_deg
        east_m = step_deg[:, 0] * _METRES_PER_DEG * np.cos(np.radians(mine.lonlat_deg[:, 1]))
        away_m = np.hypot(east_m, step_deg[:, 1] * _METRES_PER_DEG)
        nearer = (first <= last) & (away_m < nearest_m)
        nearest_m[nearer], apart_ns[nearer] = away_m[nearer], (start_ns - other.start_ns[there])[nearer]
    return nearest_m <= _SAME_PLACE_M, apart_ns
