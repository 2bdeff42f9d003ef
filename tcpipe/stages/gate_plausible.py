"""A track faster than any ground robot: no segments there; where it is so for long, whatever the estimator, the run is refused."""

from __future__ import annotations

import numpy as np

from tcpipe.errors import FusionError
from tcpipe.motion.pieces import Mask, MotionRows
from tcpipe.tables.columns import floats
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import Track

_WINDOW_S = 60.0
_DRIVES_MPS = 0.1


def find_implausible(track: Track, rows: MotionRows, jumps: Mask, limit_mps: float) -> tuple[Mask, tuple[Finding, ...]]:
    """Return the rows faster than a limit, by velocity or by the step between two rows, and the finding of them.

    Parameters
    ----------
    jumps : rows beside a jump of the position, shape (N,): a jump is no speed.
    limit_mps : [m/s].

    Raises
    ------
    FusionError : the moving median of the speed, over a minute of driving, exceeds the limit.
    """
    table = track.table
    speed_mps = np.hypot(floats(table, "east_velocity_mps"), floats(table, "north_velocity_mps"))
    step_mps = np.hypot(*(np.diff(floats(table, f"{axis}_m")) for axis in "xy")) / rows.period_s
    step_mps = np.where((np.diff(rows.piece) == 0) & ~(jumps[1:] & jumps[:-1]), step_mps, 0.0)
    speed_mps = np.maximum(speed_mps, np.maximum(np.append(step_mps, 0.0), np.append(0.0, step_mps)))
    implausible: Mask = speed_mps > limit_mps
    if not implausible.any():
        return implausible, ()
    driving_mps = speed_mps[speed_mps > _DRIVES_MPS]
    window = min(driving_mps.size, rows.count(_WINDOW_S))
    faster = np.concatenate(([0], np.cumsum(driving_mps > limit_mps)))
    run, median_mps = Subject("run", track.info.run_id), float(np.median(driving_mps))
    numbers = {"fast_s": implausible.sum() * rows.period_s, "limit_mps": limit_mps, "median_mps": median_mps}
    if 2 * int((faster[window:] - faster[:-window]).max()) > window:
        finding = make_finding("track-too-fast", run, severity="error", action="rejected", **numbers)
        raise FusionError("the track is faster than plausible", findings=(finding, *track.info.report.findings))
    return implausible, (make_finding("track-too-fast", run, **numbers),)
