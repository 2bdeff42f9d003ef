"""Track to MaskedTrack: mark rows that are not steady driving or not usable, with the reason; nothing is deleted."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tcpipe.arrays import Floats, Mask, count_before
from tcpipe.errors import FusionError
from tcpipe.fusion.measurements import DISPLACEMENT_LAGS_S
from tcpipe.motion import masks
from tcpipe.motion.distance_breakdown import JUMP_M, compute_unexplained_m
from tcpipe.motion.row_sections import MotionRows, dilate_mask, number_pieces
from tcpipe.motion.uncertainty import compute_along_std_m, compute_chord_ahead_std_m, find_common_scale_std
from tcpipe.recipe import MaskConfig, TimeWindow
from tcpipe.recipe.suggestions import suggest
from tcpipe.robots import MAX_PLAUSIBLE_MPS
from tcpipe.tables.bits import DropReason, flag_name
from tcpipe.tables.columns import stack_floats, to_floats, to_integers
from tcpipe.tables.facts import MaskFacts
from tcpipe.tables.findings import Finding, Findings, Remedy, Subject, make_finding, read_threshold
from tcpipe.tables.levels import MASKED_TRACK, TRACK, MaskedTrack, Track, add_findings


def mask_track(
    track: Track,
    config: MaskConfig,
    *,
    max_velocity_mps: float | None,
    chord_m: float,
    max_plausible_mps: float = MAX_PLAUSIBLE_MPS,
) -> MaskedTrack:
    """Return the track with ``dropped_by``: every reason why a row is not steady driving at the terrain's limit.

    Raises `FusionError`: for most of a minute of driving the track is faster than plausible.

    Parameters
    ----------
    max_velocity_mps, max_plausible_mps : [m/s], of the robot's profile; the recipe has priority. Without a maximum, no
        row is masked as below the limit.
    chord_m : [m], length of a segment, over which the relative position error counts.
    """
    table, period_s = track.table, 1.0 / track.info.rate_hz
    rows = MotionRows(
        velocity_mps=to_floats(table, "forward_velocity_mps"),
        yaw_rate_radps=to_floats(table, "yaw_rate_radps"),
        wheel_velocity_mps=to_floats(table, "wheel_velocity_mps"),
        commanded_mps=to_floats(table, "commanded_velocity_mps"),
        piece=number_pieces(
            to_integers(table, "stamp_ns"), to_integers(table, "clock_epoch"), period_ns=1e9 * period_s
        ),
        period_s=period_s,
    )
    gaps, gap_findings = find_gaps(
        track, rows, chord_m=chord_m, config=config, max_plausible_mps=config.max_plausible_mps or max_plausible_mps
    )
    found = {DropReason.GAP: np.logical_or.reduce([*gaps.values()]), **_find_motion_reasons(rows, config)}
    limit = find_speed_limit(rows, config, max_velocity_mps=max_velocity_mps)
    limit_mps = limit.limit_mps
    slowest = limit_mps and config.full_speed_fraction * limit_mps
    if slowest is not None and config.require_full_speed:
        found[DropReason.BELOW_FULL_SPEED] = masks.find_below_full_speed(
            rows, limit_mps=slowest, window_s=config.command_window_s
        )
    if config.max_position_std_m is not None:
        std_m = np.hypot(to_floats(table, "x_std_m"), to_floats(table, "y_std_m"))
        found[DropReason.POSITION_UNCERTAIN] = ~(std_m <= config.max_position_std_m)
    dropped_by = np.bitwise_or.reduce([np.uint32(reason) * mask for reason, mask in found.items()])
    outside, window_findings = find_outside_windows(track, config.windows)
    dropped_by = np.where(outside, np.uint32(DropReason.TIME_WINDOW), dropped_by)
    facts = MaskFacts(
        rows=table.num_rows,
        rows_kept=int((dropped_by == 0).sum()),
        gap_rows={cause: int(mask.sum()) for cause, mask in gaps.items()},
        rows_dropped={flag_name(reason): int((dropped_by & reason != 0).sum()) for reason in DropReason},
        max_velocity_mps=limit_mps,
        full_speed_mps=slowest,
    )
    masked = MASKED_TRACK.table(**{name: table[name] for name in table.column_names}, dropped_by=dropped_by)
    findings = (*gap_findings, *window_findings, *find_limits(rows, dropped_by, limit, config))
    return MaskedTrack(masked, add_findings(track.info, findings, replace(track.info.report.facts, mask=facts)))


def find_outside_windows(track: Track, windows: Sequence[TimeWindow]) -> tuple[Mask, Findings]:
    """Return the rows that the windows of this run drop, and a finding if a window has no row.

    Rows are dropped inside a window that drops and, if any window keeps, outside all windows that keep.
    """
    stamp_ns, run_id = to_integers(track.table, "stamp_ns"), track.info.run_id
    dropped, kept, empty = np.zeros(len(stamp_ns), bool), np.zeros(len(stamp_ns), bool), 0
    own_windows = [window for window in windows if len(stamp_ns) and window.is_for(run_id)]
    for window in own_windows:
        start_ns, end_ns = window.find_bounds_ns(int(stamp_ns[0]))
        inside = (stamp_ns >= start_ns) & (stamp_ns < end_ns)
        empty += not inside.any()
        (dropped if window.action == "drop" else kept)[inside] = True
    if any(window.action == "keep" for window in own_windows):
        dropped |= ~kept
    subject = Subject("run", run_id)
    return dropped, (make_finding("time-window-empty", subject, windows_count=empty),) if empty else ()


def _find_motion_reasons(rows: MotionRows, config: MaskConfig) -> dict[DropReason, Mask]:
    stuck = masks.find_stuck(
        rows,
        stationary_velocity_mps=config.stationary_velocity_mps,
        wheel_velocity_above_mps=config.stuck_wheel_velocity_mps,
    )
    standing = masks.find_stationary(
        rows, below_velocity_mps=config.stationary_velocity_mps, below_yaw_rate_radps=config.stationary_yaw_rate_radps
    )
    turning = masks.find_turning_in_place(
        rows,
        below_velocity_mps=config.turning_velocity_mps,
        above_yaw_rate_radps=config.turning_yaw_rate_radps,
        min_radius_m=config.min_turn_radius_m,
        min_s=config.min_event_s,
    )
    back = masks.find_reversing(rows, stationary_velocity_mps=config.stationary_velocity_mps)
    return {
        DropReason.STATIONARY: standing & ~stuck,
        DropReason.STUCK: stuck,
        DropReason.TURNING_IN_PLACE: turning & ~standing & ~stuck,
        DropReason.REVERSING: back & (not config.keep_reversing),
        DropReason.ACCELERATING: _find_accelerating(rows, standing | turning, config),
    }


def _find_accelerating(rows: MotionRows, halted: Mask, config: MaskConfig) -> Mask:
    """Mark commanded changes, ramps next to stops, and lasting accelerations without a command or just before it ends.

    Before the commands end, a change may be missing: the last command is extended.
    """
    slope = masks.estimate_forward_acceleration_mps2(rows, window_s=config.acceleration_window_s)
    lasting = masks.find_accelerating(
        rows, slope, above_mps2=config.max_acceleration_mps2, min_s=config.min_event_s, dilate_s=config.dilate_s
    )
    changed = masks.find_command_changes(
        rows, step_mps=config.command_step_mps, window_s=config.command_window_s, settle_s=config.command_settle_s
    )
    beside = masks.find_ramps(rows, slope, halted, above_mps2=config.ramp_acceleration_mps2, min_s=config.min_event_s)
    unknown = np.isnan(rows.commanded_mps)
    unknown = dilate_mask(unknown, rows.piece, before=rows.count(config.command_settle_s), after=0)
    return changed | (lasting & unknown) | beside


_MOST = 0.5  # more than this share of the moving track at one top command makes that the limit of the run


_COMMAND = Subject("role", "command")
_KEEP = suggest("keep", {"mask": {"require_full_speed": False}})


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """The limit [m/s], None if unknown; the run's top command [m/s]; findings."""

    limit_mps: float | None
    top_mps: float
    findings: Findings = ()


def find_speed_limit(rows: MotionRows, config: MaskConfig, *, max_velocity_mps: float | None) -> SpeedLimit:
    """Return a run's speed limit; ``max_velocity_mps`` [m/s] is the profile's, and the recipe has priority."""
    top, held = masks.find_top_command(
        rows,
        moving_above_mps=config.turning_velocity_mps,
        share_of_top=config.full_speed_fraction,
        window_s=config.command_window_s,
    )
    if config.max_velocity_mps is not None or max_velocity_mps is None or not config.require_full_speed:
        return SpeedLimit(config.max_velocity_mps or max_velocity_mps, top)
    if held <= _MOST or top >= config.full_speed_fraction * max_velocity_mps:
        return SpeedLimit(max_velocity_mps, top)
    found = make_finding(
        "limit-from-commands",
        _COMMAND,
        held_fraction=held,
        top_mps=top,
        limit_mps=max_velocity_mps,
        remedies=_state_limit(top),
    )
    return SpeedLimit(top, top, (found,))


def find_limits(rows: MotionRows, dropped_by: Mask, limit: SpeedLimit, config: MaskConfig) -> Iterator[Finding]:
    """Yield the findings on commands: none or silent, unknown limit, most of the drive below the limit."""
    commanded, moving = np.isfinite(rows.commanded_mps), np.abs(rows.velocity_mps) > config.turning_velocity_mps
    if not commanded.any():
        yield make_finding("no-command", _COMMAND)
        return
    silent_s, moving_s = (float(mask.sum()) * rows.period_s for mask in (moving & ~commanded, moving))
    if silent_s > read_threshold("command-silent", "min_silent_fraction") * moving_s:
        yield make_finding("command-silent", _COMMAND, silent_s=silent_s, moving_s=moving_s)
    slow = (dropped_by & DropReason.BELOW_FULL_SPEED) != 0
    if limit.limit_mps is None and config.require_full_speed:
        remedies = (*_state_limit(np.nanmax(rows.commanded_mps)), *_KEEP)
        yield make_finding("max-velocity-unknown", _COMMAND, remedies=remedies)
    elif (
        limit.limit_mps
        and slow[moving].sum() > read_threshold("driven-below-limit", "min_slow_fraction") * moving.sum()
    ):
        remedies = (*_state_limit(limit.top_mps), *_KEEP)
        yield make_finding(
            "driven-below-limit",
            _COMMAND,
            slow_fraction=float(slow[moving].mean()),
            limit_mps=config.full_speed_fraction * limit.limit_mps,
            top_mps=limit.top_mps,
            remedies=remedies,
        )
    else:
        yield from limit.findings


def _state_limit(speed_mps: float) -> tuple[Remedy, ...]:
    return suggest("state", {"mask": {"max_velocity_mps": round(float(speed_mps), 2)}})


_DISPLACEMENTS = [c.name for c in TRACK.columns if c.name.startswith("displacement_std_")]


def find_gaps(
    track: Track, rows: MotionRows, *, chord_m: float, config: MaskConfig, max_plausible_mps: float
) -> tuple[dict[str, Mask], Findings]:
    """Return the rows that are in a gap by cause, and the findings; a row may have several causes.

    An error of scale that is common to the whole run makes no segment worse than the next: it is no part of a chord's
    own uncertainty.
    """
    power = to_floats(track.table, "power_watt")
    without_power = np.isnan(power) & bool(np.isfinite(power).any())
    moving = np.abs(rows.velocity_mps) >= config.turning_velocity_mps
    uncertain = moving & (_compute_chord_std_m(track, rows, chord_m, config) > config.max_relative_position_std_m)
    table, stamp_ns = track.table, to_integers(track.table, "stamp_ns")
    position_m = stack_floats(table, "x_m", "y_m", "z_m")
    velocity_mps = stack_floats(table, "east_velocity_mps", "north_velocity_mps", "up_velocity_mps")
    off_m = np.append(compute_unexplained_m(stamp_ns, position_m, velocity_mps, rows.piece), 0.0)
    jumps = np.zeros(len(moving), dtype=bool)
    steps = np.flatnonzero(off_m > config.max_relative_position_std_m)
    jumps[steps] = jumps[steps + 1] = True
    run, findings = Subject("run", track.info.run_id), []
    lost, live = without_power & moving, ~without_power
    for outside in (~np.logical_or.accumulate(live), ~np.logical_or.accumulate(live[::-1])[::-1]):
        if outside.sum() <= read_threshold("power-gaps", "max_edge_s") * track.info.rate_hz:
            lost &= ~outside
    share = float(lost.sum() / moving.sum()) if moving.any() else 0.0
    if share > read_threshold("power-gaps", "min_lost_fraction"):
        findings.append(make_finding("power-gaps", Subject("role", "power"), lost_fraction=share))
    share = float(uncertain[moving].mean()) if moving.any() else 0.0
    if share > read_threshold("distance-uncertain", "min_lost_fraction"):
        limit_m = config.max_relative_position_std_m
        findings.append(
            make_finding("distance-uncertain", run, lost_fraction=share, chord_m=chord_m, max_std_m=limit_m)
        )
    if far := int((off_m > JUMP_M).sum()):
        furthest = int(np.argmax(off_m))
        at_s = (int(stamp_ns[furthest]) - int(stamp_ns[0])) / 1e9
        jump_m = float(off_m.max())
        findings.append(make_finding("position-jumps", run, span_s=(at_s, at_s), jump_m=jump_m, jump_count=far))
    implausible, too_fast = find_implausible(track, rows, jumps, max_plausible_mps)
    gaps = {"without_power": without_power, "uncertain": uncertain, "jumps": jumps}
    return {**gaps, "implausible": implausible}, (*findings, *too_fast)


def _compute_chord_std_m(track: Track, rows: MotionRows, chord_m: float, config: MaskConfig) -> Floats:
    table = track.table
    course = np.arctan2(to_floats(table, "north_velocity_mps"), to_floats(table, "east_velocity_mps"))
    common_mps = _compute_common_std_mps(track)
    lag_std_m = stack_floats(table, *_DISPLACEMENTS)
    return compute_chord_ahead_std_m(
        rows,
        velocity_std_mps=_subtract_variance(to_floats(table, "forward_velocity_std_mps"), common_mps),
        position_std_m=compute_along_std_m(to_floats(table, "x_std_m"), to_floats(table, "y_std_m"), course),
        chord_m=chord_m,
        slowest_mps=config.turning_velocity_mps,
        smoothed=track.info.estimator == "smoother",
        lags_s=DISPLACEMENT_LAGS_S,
        lag_std_m=_subtract_variance(lag_std_m, common_mps[:, None] * DISPLACEMENT_LAGS_S),
    )


def _compute_common_std_mps(track: Track) -> Floats:
    """Return the part of each row's velocity σ that is common in its section: of an unobservable scale."""
    table = track.table
    speed_mps = np.linalg.norm([to_floats(table, f"{name}_velocity_mps") for name in ("east", "north", "up")], axis=0)
    scale_std = find_common_scale_std(
        track.info.report.facts.fuse, to_integers(table, "stamp_ns"), to_integers(table, "clock_epoch")
    )
    return np.asarray(scale_std * speed_mps)


def _subtract_variance(std: Floats, part: Floats) -> Floats:
    """Return a σ without the variance of a part of it; NaN if it is unknown."""
    return np.sqrt(np.maximum(std**2 - part**2, 0.0))


_WINDOW_S = 60.0
_DRIVES_MPS = 0.1


def find_implausible(track: Track, rows: MotionRows, jumps: Mask, limit_mps: float) -> tuple[Mask, Findings]:
    """Return the rows above a limit [m/s] by velocity or by the step between two rows (jumps excepted), and findings.

    Raises `FusionError`: the moving median of the speed, over a minute of driving, exceeds the limit.
    """
    table = track.table
    speed_mps = np.hypot(to_floats(table, "east_velocity_mps"), to_floats(table, "north_velocity_mps"))
    step_mps = np.hypot(*(np.diff(to_floats(table, f"{axis}_m")) for axis in "xy")) / rows.period_s
    step_mps = np.where((np.diff(rows.piece) == 0) & ~(jumps[1:] & jumps[:-1]), step_mps, 0.0)
    speed_mps = np.maximum(speed_mps, np.maximum(np.append(step_mps, 0.0), np.append(0.0, step_mps)))
    implausible: Mask = speed_mps > limit_mps
    if not implausible.any():
        return implausible, ()
    driving_mps = speed_mps[speed_mps > _DRIVES_MPS]
    window = min(driving_mps.size, rows.count(_WINDOW_S))
    faster = count_before(driving_mps > limit_mps)
    run, median_mps = Subject("run", track.info.run_id), float(np.median(driving_mps))
    numbers = {"fast_s": implausible.sum() * rows.period_s, "limit_mps": limit_mps, "median_mps": median_mps}
    if 2 * int((faster[window:] - faster[:-window]).max()) > window:
        finding = make_finding("track-too-fast", run, severity="error", action="rejected", **numbers)
        raise FusionError("the track is faster than plausible", findings=(finding, *track.info.report.findings))
    return implausible, (make_finding("track-too-fast", run, **numbers),)
