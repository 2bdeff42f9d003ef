"""Track to MaskedTrack: mark what is not steady driving, and why; nothing is deleted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tcpipe.motion import masks
from tcpipe.motion.row_sections import Mask, MotionRows, number_pieces
from tcpipe.recipe import MaskConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.robots.profiles import MAX_PLAUSIBLE_MPS
from tcpipe.stages.gate_gaps import find_gaps
from tcpipe.tables.bits import DropReason, flag_name
from tcpipe.tables.catalogue import read_threshold
from tcpipe.tables.columns import to_floats, to_integers
from tcpipe.tables.facts import MaskFacts
from tcpipe.tables.findings import Finding, Remedy, Subject, make_finding
from tcpipe.tables.levels import MASKED_TRACK, MaskedTrack, Track, add_findings


def mask_track(
    track: Track,
    config: MaskConfig,
    *,
    max_velocity_mps: float | None,
    chord_m: float,
    max_plausible_mps: float = MAX_PLAUSIBLE_MPS,
) -> MaskedTrack:
    """Return the track with ``dropped_by``: every reason why a row is not steady driving at the terrain's limit.

    Parameters
    ----------
    max_velocity_mps : [m/s], the robot profile's maximum; the recipe's goes first. With neither, no row is dropped as below the limit.
    chord_m : [m], length of a segment, over which the relative position error counts.
    max_plausible_mps : [m/s], the robot profile's; the recipe's goes first.

    Raises
    ------
    FusionError : for most of a minute of driving the track is faster than plausible.
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
    gaps = find_gaps(
        track, rows, chord_m=chord_m, config=config, max_plausible_mps=config.max_plausible_mps or max_plausible_mps
    )
    found = {DropReason.GAP: gaps.rows, **_find_motion_reasons(rows, config)}
    limit = find_speed_limit(rows, config, max_velocity_mps=max_velocity_mps)
    limit_mps = limit.limit_mps
    slowest = limit_mps and config.full_speed_fraction * limit_mps
    if slowest is not None and config.require_full_speed:
        found[DropReason.BELOW_FULL_SPEED] = masks.find_below_full_speed(
            rows, limit_mps=slowest, window_s=config.command_window_s
        )
    dropped_by = np.bitwise_or.reduce([np.uint32(reason) * mask for reason, mask in found.items()])
    facts = MaskFacts(
        rows=table.num_rows,
        rows_kept=int((dropped_by == 0).sum()),
        gap_rows=gaps.counts(),
        rows_dropped={flag_name(reason): int((dropped_by & reason != 0).sum()) for reason in DropReason},
        max_velocity_mps=limit_mps,
        full_speed_mps=slowest,
    )
    masked = MASKED_TRACK.table(**{name: table[name] for name in table.column_names}, dropped_by=dropped_by)
    findings = (*gaps.findings, *find_limits(rows, dropped_by, limit, config))
    return MaskedTrack(masked, add_findings(track.info, findings, replace(track.info.report.facts, mask=facts)))


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
    """Mark commanded changes where there are commands, lasting accelerations where there are none, and ramps beside halts."""
    slope = masks.estimate_forward_acceleration_mps2(rows, window_s=config.acceleration_window_s)
    lasting = masks.find_accelerating(
        rows, slope, above_mps2=config.max_acceleration_mps2, min_s=config.min_event_s, dilate_s=config.dilate_s
    )
    changed = masks.find_command_changes(
        rows, step_mps=config.command_step_mps, window_s=config.command_window_s, settle_s=config.command_settle_s
    )
    beside = masks.find_ramps(rows, slope, halted, above_mps2=config.ramp_acceleration_mps2, min_s=config.min_event_s)
    return changed | (lasting & np.isnan(rows.commanded_mps)) | beside


_MOST = 0.5
"""More than this share of the moving track at one top command makes that the limit of the run."""


_COMMAND = Subject("role", "command")
_KEEP = suggest("keep", {"mask": {"require_full_speed": False}})


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """The limit [m/s], None where nobody knows one; the run's top command [m/s] and the share of it held there; what was found."""

    limit_mps: float | None
    top_mps: float
    held: float
    findings: tuple[Finding, ...] = ()


def find_speed_limit(rows: MotionRows, config: MaskConfig, *, max_velocity_mps: float | None) -> SpeedLimit:
    """Return the limit of a run, of a robot whose profile says ``max_velocity_mps`` [m/s]; the recipe's goes first."""
    top, held = masks.find_top_command(
        rows,
        moving_above_mps=config.turning_velocity_mps,
        share_of_top=config.full_speed_fraction,
        window_s=config.command_window_s,
    )
    if config.max_velocity_mps is not None or max_velocity_mps is None or not config.require_full_speed:
        return SpeedLimit(config.max_velocity_mps or max_velocity_mps, top, held)
    if held <= _MOST or top >= config.full_speed_fraction * max_velocity_mps:
        return SpeedLimit(max_velocity_mps, top, held)
    found = make_finding(
        "limit-from-commands",
        _COMMAND,
        held_fraction=held,
        top_mps=top,
        limit_mps=max_velocity_mps,
        remedies=_state_limit(top),
    )
    return SpeedLimit(top, top, held, (found,))


def find_limits(rows: MotionRows, dropped_by: Mask, limit: SpeedLimit, config: MaskConfig) -> tuple[Finding, ...]:
    """Return the findings on commands: that there are none, that no limit is known, that most was driven below it."""
    commanded, moving = np.isfinite(rows.commanded_mps), np.abs(rows.velocity_mps) > config.turning_velocity_mps
    if not commanded.any():
        return (make_finding("no-command", _COMMAND),)
    if limit.limit_mps is None and config.require_full_speed:
        remedies = (*_state_limit(np.nanmax(rows.commanded_mps)), *_KEEP)
        return (make_finding("max-velocity-unknown", _COMMAND, remedies=remedies),)
    slow = (dropped_by & DropReason.BELOW_FULL_SPEED) != 0
    if (
        limit.limit_mps
        and slow[moving].sum() > read_threshold("driven-below-limit", "min_slow_fraction") * moving.sum()
    ):
        remedies = (*_state_limit(limit.top_mps), *_KEEP)
        finding = make_finding(
            "driven-below-limit",
            _COMMAND,
            slow_fraction=float(slow[moving].mean()),
            limit_mps=config.full_speed_fraction * limit.limit_mps,
            top_mps=limit.top_mps,
            remedies=remedies,
        )
        return (finding,)
    return limit.findings


def _state_limit(speed_mps: float) -> tuple[Remedy, ...]:
    return suggest("state", {"mask": {"max_velocity_mps": round(float(speed_mps), 2)}})
