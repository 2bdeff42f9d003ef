"""Masks of the rows of a track that are not steady driving, one pure function for each reason.

Rulings: docs/explanation/rulings.md, Acceleration, At the limit, In-place rotation. Every function returns a mask of
rows, shape (N,). A slowdown by terrain is the signal: with known commands, no function here marks it.
"""

import numpy as np

from tcpipe.arrays import Floats, Ints, Mask, count_before
from tcpipe.motion.row_sections import (
    MotionRows,
    compute_window_mean,
    dilate_mask,
    drop_short_runs,
    find_piece_bounds,
    find_runs,
    fit_slope,
    make_mask,
)


def find_stuck(rows: MotionRows, *, stationary_velocity_mps: float, wheel_velocity_above_mps: float) -> Mask:
    """Return rows where the wheels turn at a stationary ground speed; none if the wheel speed is unknown."""
    turning_wheels = np.abs(np.nan_to_num(rows.wheel_velocity_mps)) > wheel_velocity_above_mps
    return turning_wheels & (np.abs(rows.velocity_mps) < stationary_velocity_mps)


def find_stationary(rows: MotionRows, *, below_velocity_mps: float, below_yaw_rate_radps: float) -> Mask:
    """Return rows that move less than both limits, and the slower row of a change of direction that skips them.

    At 20 Hz a quick change between forward and backward may skip the band around zero; the robot is stationary for an
    instant all the same.
    """
    v, piece = rows.velocity_mps, rows.piece
    still = (np.abs(v) < below_velocity_mps) & (np.abs(rows.yaw_rate_radps) < below_yaw_rate_radps)
    jumps = (v[:-1] * v[1:] < 0.0) & (np.minimum(np.abs(v[:-1]), np.abs(v[1:])) >= below_velocity_mps)
    flips = np.flatnonzero(jumps & (piece[:-1] == piece[1:]))
    still[np.where(np.abs(v[flips]) <= np.abs(v[flips + 1]), flips, flips + 1)] = True
    return still


def find_turning_in_place(
    rows: MotionRows, *, below_velocity_mps: float, above_yaw_rate_radps: float, min_radius_m: float, min_s: float
) -> Mask:
    """Return rows that turn in place for at least ``min_s`` [s], or turn tighter than ``min_radius_m`` at any speed."""
    speed, turn = np.abs(rows.velocity_mps), np.abs(rows.yaw_rate_radps)
    spot = (speed < below_velocity_mps) & (turn > above_yaw_rate_radps)
    return drop_short_runs(spot, rows.piece, min_rows=rows.count(min_s)) | (speed < min_radius_m * turn)


def find_reversing(rows: MotionRows, *, stationary_velocity_mps: float) -> Mask:
    """Return rows driven backwards, faster than a stationary robot."""
    return rows.velocity_mps < -stationary_velocity_mps


def estimate_forward_acceleration_mps2(rows: MotionRows, *, window_s: float) -> Floats:
    """Return the slope of the forward velocity over a centred window of ``window_s`` [s]: [m/s²], shape (N,)."""
    half = max(1, round((window_s / rows.period_s - 1) / 2))
    return fit_slope(rows.velocity_mps, rows.piece, half_window=half, period_s=rows.period_s)


def find_accelerating(
    rows: MotionRows, acceleration_mps2: Floats, *, above_mps2: float, min_s: float, dilate_s: float
) -> Mask:
    """Return rows of lasting acceleration or braking, widened on both sides: for logs without a command topic."""
    lasts = drop_short_runs(np.abs(acceleration_mps2) > above_mps2, rows.piece, min_rows=rows.count(min_s))
    return dilate_mask(lasts, rows.piece, before=rows.count(dilate_s), after=rows.count(dilate_s))


def find_ramps(rows: MotionRows, acceleration_mps2: Floats, halted: Mask, *, above_mps2: float, min_s: float) -> Mask:
    """Return the rows next to stops in which the speed still grows after, or already falls before, the stop.

    A ramp ends when the speed changes by less than ``above_mps2`` for ``min_s`` [s]. It is marked with and without
    commands: a robot whose commands end (dead man's switch, emergency stop) coasts to a stop while its last command
    persists. ``halted`` rows are stationary or turn in place.
    """
    speeding_up = np.sign(rows.velocity_mps) * acceleration_mps2
    halts = count_before(halted)
    found = np.zeros(len(halted), dtype=bool)
    for changes in (speeding_up > above_mps2, speeding_up < -above_mps2):
        going_on = ~drop_short_runs(~(changes | halted), rows.piece, min_rows=rows.count(min_s))
        spans = find_runs(going_on, rows.piece)
        found |= make_mask(spans[halts[spans[:, 1] + 1] > halts[spans[:, 0]]], len(halted))
    return found & ~halted


def find_command_changes(rows: MotionRows, *, step_mps: float, window_s: float, settle_s: float) -> Mask:
    """Return rows from the start to the end of each commanded change of speed, and for ``settle_s`` [s] after it.

    The mean command over the window before a row is compared with that over the window from it on: a step or a ramp of
    more than ``step_mps`` within one window shows at full size. The jitter of a joystick averages out; the limit is
    raised by twice its remainder in the difference of both means.
    """
    part, command = _select_known_command(rows)
    window = max(1, rows.count(window_s))
    before = compute_window_mean(command, part, before=window, after=-1)
    after = compute_window_mean(command, part, before=0, after=window - 1)
    allowed = step_mps + 2.0 * _estimate_jitter(command, part, window)
    # NaN, where a part begins, is no change.
    changing = np.isfinite(rows.commanded_mps) & (np.abs(after - before) > allowed)
    _, high = find_piece_bounds(rows.piece)
    spans = [
        (first + begin, min(first + end + rows.count(settle_s), high[first]))
        for first, last in find_runs(changing, part)
        for begin, end in [_find_moment(command[first : last + 1], before[first], after[last], step_mps=step_mps)]
    ]
    return make_mask(np.array(spans, dtype=np.int64).reshape(-1, 2), len(command))


def _estimate_jitter(command: Floats, part: Ints, window: int) -> Floats:
    """Return the row-to-row scatter in the difference of the means after and before each row, [m/s], shape (N,)."""
    square = np.concatenate((np.zeros(min(len(command), 1)), 0.5 * np.diff(command) ** 2))
    scatter = np.fmax(
        np.nan_to_num(compute_window_mean(square, part, before=window - 1, after=-1)),
        np.nan_to_num(compute_window_mean(square, part, before=-1, after=window - 1)),
    )
    low, high = find_piece_bounds(part)
    row = np.arange(len(part))
    count_before, count_after = np.clip(row - low, 1, window), np.minimum(high - row + 1, window)
    return np.asarray(np.sqrt(scatter * (1.0 / count_before + 1.0 / count_after)))


def _find_moment(command: Floats, before_mps: float, after_mps: float, *, step_mps: float) -> tuple[int, int]:
    """Return the first row that leaves the old value, and the first that stays at the new one, in a change."""
    changed = np.flatnonzero(np.abs(command - before_mps) > step_mps)
    unreached = np.flatnonzero(np.abs(command - after_mps) > step_mps)
    begin = int(changed[0]) if len(changed) else 0
    return begin, max(begin, int(unreached[-1]) + 1 if len(unreached) else 0)


def find_below_full_speed(rows: MotionRows, *, limit_mps: float, window_s: float) -> Mask:
    """Mark rows whose command, and its mean over the window around them, is below the limit (joysticks jitter)."""
    part, command = _select_known_command(rows)
    speed = np.abs(command)
    half = rows.count(window_s / 2)
    mean_command = compute_window_mean(speed, part, before=half, after=half)
    return np.isfinite(rows.commanded_mps) & (speed < limit_mps) & (mean_command < limit_mps)


def find_top_command(
    rows: MotionRows, *, moving_above_mps: float, share_of_top: float, window_s: float
) -> tuple[float, float]:
    """Return a moving run's highest commanded speed [m/s] (99 % quantile), and the share of the run at it.

    A row counts as at the top if the mean command around it (joystick jitter) is at least ``share_of_top`` of it. 0, 0
    without commands.
    """
    part, command = _select_known_command(rows)
    half = rows.count(window_s / 2)
    mean_command = compute_window_mean(np.abs(command), part, before=half, after=half)
    moving = np.isfinite(rows.commanded_mps) & (np.abs(rows.velocity_mps) > moving_above_mps)
    if not moving.any():
        return 0.0, 0.0
    top = float(np.quantile(mean_command[moving], 0.99))
    return top, float(np.mean(mean_command[moving] >= share_of_top * top))


def _select_known_command(rows: MotionRows) -> tuple[Ints, Floats]:
    """Return pieces that end also where the command becomes known or unknown, and the command with 0 for unknown."""
    known = np.isfinite(rows.commanded_mps)
    broken = (np.diff(rows.piece) != 0) | (np.diff(known.astype(np.int8)) != 0)
    part = np.concatenate((np.zeros(min(len(known), 1), dtype=np.int64), np.cumsum(broken)))
    return part, np.where(known, rows.commanded_mps, 0.0)
