"""At which speed a run was at its limit: the recipe's, the robot's, or the run's own top command where most of it was driven at that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tcpipe.motion import masks
from tcpipe.motion.pieces import Mask, MotionRows
from tcpipe.recipe import GateConfig
from tcpipe.recipe.suggestions import suggested
from tcpipe.tables.bits import DropReason

_MOST = 0.5
"""More than this share of the moving track at one top command makes that the limit of the run."""


_WITHOUT = suggested("to keep rows whatever was commanded", {"gate": {"require_full_speed": False}})


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """The limit [m/s], None where nobody knows one; the run's top command [m/s] and the share of it held there; what is to be said."""

    limit_mps: float | None
    top_mps: float
    held: float
    warnings: tuple[str, ...] = ()


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
    text = f"{held:.0%} of the moving track was commanded at {top:.2f} m/s, not at the robot's {max_velocity_mps} m/s"
    said = f"{text}: that is taken for the limit of this run{_suggest_limit('to settle it', top)}"
    return SpeedLimit(top, top, held, (said,))


def limit_warnings(rows: MotionRows, dropped_by: Mask, limit: SpeedLimit, config: GateConfig) -> tuple[str, ...]:
    """Return what is to be said of commands: that there are none, that no limit is known, that most was driven below it."""
    commanded, moving = np.isfinite(rows.commanded_mps), np.abs(rows.velocity_mps) > config.turning_velocity_mps
    if not commanded.any():
        return ("no command topic: it cannot be known whether the robot was driven at its maximum speed",)
    if limit.limit_mps is None and config.require_full_speed:
        text = "the robot's maximum speed is not known, so no row is dropped as commanded below it"
        return (
            f"{text}{_suggest_limit('if its largest command was the limit', np.nanmax(rows.commanded_mps))}{_WITHOUT}",
        )
    slow = (dropped_by & DropReason.BELOW_LIMIT) != 0
    if slow[moving].sum() > 0.5 * moving.sum():
        text = f"{slow[moving].mean():.0%} of the moving track was commanded below {config.full_speed_fraction} of {limit.limit_mps} m/s"
        own = f"if this robot is slower (its top command, {limit.top_mps:.2f} m/s, was held for {limit.held:.0%} of it)"
        return (f"{text}{_suggest_limit(own, limit.top_mps)}{_WITHOUT}",)
    return limit.warnings


def _suggest_limit(purpose: str, speed_mps: float) -> str:
    return suggested(purpose, {"gate": {"max_velocity_mps": round(float(speed_mps), 2)}})
