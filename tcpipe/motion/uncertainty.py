"""Error of two estimated positions *relative to each other*, on which the error of a cost per metre depends.

The absolute error of an RTK or dead-reckoned position is nearly the same at both ends of a metre and cancels. The exact
remainder is known to a smoother, which states it for some durations (`interpolate_durations_m`). Elsewhere, as at the
end of a track and in a forward filter, it follows from each row's standard deviations.
Over a short time the error of the displacement is that of the velocity, sigma_v T; over a long time it is that of two
independent positions, hypot(sigma_1, sigma_2). A position error that is correlated in time like 1 / (1 + t² / (2
tau²)), with tau = sigma_position / sigma_velocity as both variances demand, gives in between::

    1 / variance = 1 / (sigma_v T)² + 1 / (sigma_1² + sigma_2²)

It grows at most linearly from the smoother's value for a shorter duration, and is no less than the change of the
position error, |sigma_2 - sigma_1| (both by the triangle inequality); and in a forward filter a fix that reduces the
error moves the estimate, by sqrt(sigma_1² - sigma_2²).
"""

from collections.abc import Sequence

import numpy as np

from tcpipe.arrays import Floats, Ints
from tcpipe.motion.row_sections import MotionRows, find_piece_bounds
from tcpipe.tables.facts import FuseFacts


def compute_displacement_std_m(
    *,
    velocity_std_mps: Floats,
    duration_s: Floats,
    start_std_m: Floats,
    end_std_m: Floats,
    smoothed: bool,
    lags_s: Sequence[float],
    lag_std_m: Floats,
) -> Floats:
    """Return the standard deviation of the displacement between two estimated positions [m], shape (M,).

    It is the smoother's (`interpolate_durations_m`), elsewhere derived from ``velocity_std_mps``, ``start_std_m`` and
    ``end_std_m`` along the displacement; ``smoothed`` positions come from a fixed-interval smoother rather than a
    forward filter.
    """
    change = np.abs(end_std_m - start_std_m)
    if not smoothed:
        change = np.maximum(change, np.sqrt(np.maximum(start_std_m**2 - end_std_m**2, 0.0)))
    short, long = velocity_std_mps * duration_s, np.hypot(start_std_m, end_std_m)
    drift = np.divide(short * long, np.hypot(short, long), out=np.zeros_like(short), where=long > 0.0)
    known_s = np.array(lags_s)
    linear = np.where(known_s <= duration_s[:, None], lag_std_m * duration_s[:, None] / known_s, np.nan)
    displacement_std_m = interpolate_durations_m(duration_s, lags_s=lags_s, lag_std_m=lag_std_m)
    modelled = np.maximum(np.fmin(drift, np.fmin.reduce(linear, axis=1)), change)
    return np.where(np.isnan(displacement_std_m), modelled, displacement_std_m)


def interpolate_durations_m(duration_s: Floats, *, lags_s: Sequence[float], lag_std_m: Floats) -> Floats:
    """Return the displacement error over each duration [s] from that over lags, [m], shape (M,); NaN if unknown.

    Between two lags it is a power of time, below the shortest that of a constant velocity error. ``lags_s`` [s]: L
    lags, increasing; ``lag_std_m`` [m], shape (M, L), is above 0 or NaN.
    """
    known = np.array(lags_s)
    after = np.clip(np.searchsorted(known, duration_s), 1, len(known) - 1)
    row = np.arange(len(duration_s))
    low, high = lag_std_m[row, after - 1], lag_std_m[row, after]
    share = np.log(duration_s / known[after - 1]) / np.log(known[after] / known[after - 1])
    std_m: Floats = np.where(
        duration_s < known[0], lag_std_m[:, 0] * duration_s / known[0], low ** (1.0 - share) * high**share
    )
    return np.where(duration_s <= known[-1], std_m, np.nan)


def compute_along_std_m(east_std_m: Floats, north_std_m: Floats, course_rad: Floats) -> Floats:
    """Return the position standard deviation along a course from those along east and north, [m], shape (M,).

    The correlation of east and north is not in a track; it is taken as zero.
    """
    return np.hypot(east_std_m * np.cos(course_rad), north_std_m * np.sin(course_rad))


def compute_chord_ahead_std_m(
    rows: MotionRows,
    *,
    velocity_std_mps: Floats,
    position_std_m: Floats,
    chord_m: float,
    slowest_mps: float,
    smoothed: bool,
    lags_s: Sequence[float],
    lag_std_m: Floats,
) -> Floats:
    """Return for each row the displacement error over the next chord at the row's speed [m], shape (N,).

    See `compute_displacement_std_m`; the σ are of the forward velocity and of the position along the direction of
    travel.
    Rows slower than ``slowest_mps`` [m/s] are taken as this fast.
    """
    _, high = find_piece_bounds(rows.piece)
    duration_s = chord_m / np.maximum(np.abs(rows.velocity_mps), slowest_mps)
    row = np.arange(len(duration_s))
    end = np.minimum(row + np.ceil(duration_s / rows.period_s).astype(np.int64), high)
    return compute_displacement_std_m(
        velocity_std_mps=velocity_std_mps,
        duration_s=duration_s,
        start_std_m=position_std_m,
        end_std_m=position_std_m[end],
        smoothed=smoothed,
        lags_s=lags_s,
        lag_std_m=lag_std_m,
    )


def find_common_scale_std(facts: FuseFacts | None, stamp_ns: Ints, clock_epoch: Ints) -> Floats:
    """Return σ of the unobservable scale of distances at each time, shape (N,): one common error of its section."""
    std = np.zeros(len(stamp_ns))
    for section in facts.sections if facts else ():
        inside = (clock_epoch == section.clock_epoch) & (stamp_ns >= section.start_ns) & (stamp_ns <= section.end_ns)
        std[inside] = section.common_scale_std or 0.0
    return std
