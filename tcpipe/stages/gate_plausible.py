"""A track faster than any ground robot: no segments there; where it is so for long, whatever the estimator, the run is refused."""

from __future__ import annotations

import numpy as np

from tcpipe.errors import FusionError
from tcpipe.motion.pieces import Mask, MotionRows
from tcpipe.recipe.suggestions import recipe_key
from tcpipe.tables.columns import floats
from tcpipe.tables.levels import Track

_WINDOW_S = 60.0
_DRIVES_MPS = 0.1


def find_implausible(track: Track, rows: MotionRows, jumps: Mask, limit_mps: float) -> tuple[Mask, tuple[str, ...]]:
    """Return the rows faster than a limit, by velocity or by the step between two rows, and the warning of them.

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
    if 2 * int((faster[window:] - faster[:-window]).max()) > window:
        raise FusionError(
            f"fusion: in most of a minute the track drives faster than {limit_mps:g} m/s (median {np.median(driving_mps):.0f} m/s over the "
            "run): the estimate does not follow the robot, and nothing of the run is used; look at the sensors with tcpipe inspect "
            f"--full, and leave out the one that errs ({recipe_key('read.topics')}: an empty list for its role); {_remedy()}",
            *track.info.report.findings,
        )
    fast_s = implausible.sum() * rows.period_s
    return implausible, (
        f"for {fast_s:.1f} s the track is faster than {limit_mps:g} m/s: no segments there; {_remedy()}",
    )


def _remedy() -> str:
    return f"if the robot is that fast, set {recipe_key('gate.max_plausible_mps')}"
