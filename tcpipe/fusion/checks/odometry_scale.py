"""Odometries in other units: a scale that is far from 1 is taken out before fusion, which estimates the rest.

Where no sensor makes the scale observable, a command does: no robot drives faster than commanded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import VISUAL, WHEELS, BodyVelocities, Measurements
from tcpipe.fusion.signals import compute_median_period_ns, hold_last

Floats = NDArray[np.float64]

_SHORTEST_NS = 40_000_000_000  # shorter may be one place of slip
_HELD_NS = 3_000_000_000  # a command this long is reached
_STEP_MPS = 0.1  # smaller steps are jitter (`mask.command_step_mps`)
_DRIVES_MPS = 0.3  # motors round slower commands
_FASTER = 1.03  # of a command: no controller overshoots more


@dataclass(frozen=True, slots=True)
class Scale:
    """How many times as far as the others an odometry goes, and its standard deviation.

    ``driven_m`` [m] is how far it goes by its own speed, where the fixes alone told a scale that is far off.
    """

    factor: float
    std: float
    driven_m: float | None = None


def rescale_odometry(source: BodyVelocities, factor: float) -> BodyVelocities:
    """Return an odometry that goes ``factor`` times too far with its velocities as they should be; its claim does not become better."""
    variance = source.variance_m2ps2 * max(1.0, factor**-2.0)
    return replace(source, velocity_mps=source.velocity_mps / factor, variance_m2ps2=variance)


def rescale_odometries(m: Measurements, scales: Mapping[str, Scale]) -> Measurements:
    """Return measurements with the odometries of which a scale is known `rescale_odometry`."""

    def in_metres(role: str, source: BodyVelocities | None) -> BodyVelocities | None:
        return source if source is None or role not in scales else rescale_odometry(source, scales[role].factor)

    return replace(m, wheels=in_metres(WHEELS, m.wheels), visual=in_metres(VISUAL, m.visual))


def compute_command_ratio(wheels: BodyVelocities, command_ns: NDArray[np.int64], commanded_mps: Floats) -> float | None:
    """Return the ratio of the wheels' speed to the commanded speed, where that is surely too fast; else None.

    Only times count in which a command has been constant for three seconds: a robot that brakes is faster than its command.
    """
    if command_ns.size == 0:
        return None
    told = hold_last(command_ns, commanded_mps, wheels.stamp_ns)
    changed = np.flatnonzero(np.abs(np.diff(told)) > _STEP_MPS) + 1
    last = np.searchsorted(changed, np.arange(told.size), "right") - 1
    since_ns = wheels.stamp_ns - wheels.stamp_ns[changed[np.maximum(last, 0)] if changed.size else np.zeros_like(last)]
    since_ns = np.where(last >= 0, since_ns, wheels.stamp_ns - wheels.stamp_ns[0])
    rows = (since_ns > _HELD_NS) & (np.abs(told) > _DRIVES_MPS) & np.isfinite(told)
    if rows.sum() * compute_median_period_ns(wheels.stamp_ns) < _SHORTEST_NS:
        return None
    ratio = wheels.velocity_mps[rows, 0] / told[rows]
    return float(np.median(ratio)) if np.quantile(ratio, 0.25) > _FASTER else None
