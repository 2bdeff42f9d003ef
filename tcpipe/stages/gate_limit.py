"""At which speed a run was at its limit: the recipe's, the robot's, or the run's own top command where most of it was driven at that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tcpipe.motion import masks
from tcpipe.motion.pieces import Mask, MotionRows
from tcpipe.recipe import GateConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.tables.bits import DropReason
from tcpipe.tables.catalogue import threshold
from tcpipe.tables.findings import Finding, Remedy, Subject, make_finding

_MOST = 0.5
"""More than this share of the moving track at one top command makes that the limit of the run."""


_COMMAND = Subject("role", "command")
_KEEP = suggest("keep", {"gate": {"require_full_speed": False}})


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """The limit [m/s], None where nobody knows one; the run's top command [m/s] and the share of it held there; what was found."""

    limit_mps: float | None
    top_mps: float
    held: float
    findings: tuple[Finding, ...] = ()


def speed_limit(rows: MotionRows, config: GateConfig, *, max_velocity_mps: float | None) -> SpeedLimit:
    """Return the limit of a run, of a robot whose profile says ``max_velocity_mps`` [m/s]; the recipe's goes first."""
    top, held = masks.top_command(
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


def find_limits(rows: MotionRows, dropped_by: Mask, limit: SpeedLimit, config: GateConfig) -> tuple[Finding, ...]:
    """Return the findings on commands: that there are none, that no limit is known, that most was driven below it."""
    commanded, moving = np.isfinite(rows.commanded_mps), np.abs(rows.velocity_mps) > config.turning_velocity_mps
    if not commanded.any():
        return (make_finding("no-command", _COMMAND),)
    if limit.limit_mps is None and config.require_full_speed:
        remedies = (*_state_limit(np.nanmax(rows.commanded_mps)), *_KEEP)
        return (make_finding("max-velocity-unknown", _COMMAND, remedies=remedies),)
    slow = (dropped_by & DropReason.BELOW_LIMIT) != 0
    if limit.limit_mps and slow[moving].sum() > threshold("driven-below-limit", "min_slow_fraction") * moving.sum():
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
    return suggest("state", {"gate": {"max_velocity_mps": round(float(speed_mps), 2)}})
