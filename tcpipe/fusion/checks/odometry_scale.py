"""Estimate the scale of an odometry against the track: one that is off throughout is calibration, one that comes and goes is slip.

Windows of five seconds count in which the robot drives and the scale is observable: by the fixes, or for wheels by a camera. The scale is
surely wrong where its median is further from 1 than twice the prior's standard deviation, and most windows agree. Where no sensor makes it
observable, a command does: no robot drives faster than commanded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import VISUAL, WHEELS, BodyVelocities, Measurements
from tcpipe.fusion.process import VISUAL_SCALE_STD, WHEEL_SCALE_STD
from tcpipe.fusion.signals import (
    compute_interval_means,
    compute_median_period_ns,
    compute_seconds,
    hold_last,
    is_in_gap,
)
from tcpipe.fusion.trajectory import Trajectory
from tcpipe.geometry.rotation import matrix_from_quat

Floats = NDArray[np.float64]

_WINDOW_NS = 5_000_000_000  # as in the audit
_MAX_GAP_NS = 500_000_000
_MOVES_M = 1.5  # shorter distances give no scale
_FEWEST_WINDOWS = 8  # fewer may be one place of slip
_MIN_SIGNIFICANCE_SIGMA = 2.0  # times the prior of a scale
_ALIKE = 0.25  # scatter over offset of the median: more is slip
_HELD_NS = 3_000_000_000  # a command this long is reached
_STEP_MPS = 0.1  # smaller steps are jitter (`gate.command_step_mps`)
_DRIVES_MPS = 0.3  # motors round slower commands
_FASTER = 1.03  # of a command: no controller overshoots more
_SCALE_STD = {WHEELS: WHEEL_SCALE_STD, VISUAL: VISUAL_SCALE_STD}


@dataclass(frozen=True, slots=True)
class Scale:
    """How many times as far as the track an odometry goes, and its standard deviation by how windows scatter.

    ``driven_m`` [m] is how far it goes by its own speed, where the fixes alone told a scale that is far off.
    """

    factor: float
    std: float
    driven_m: float | None = None

    def after(self, before: Scale | None) -> Scale:
        """Return this scale together with one that was taken out before it was found."""
        return self if before is None else Scale(before.factor * self.factor, before.factor * self.std, before.driven_m)


def compute_distance_ratios(found: Trajectory, m: Measurements) -> Mapping[str, Floats]:
    """Return by odometry how many times as far as the track it goes in each window that tells, where something else tells the scale."""
    measures = (m.gnss is not None) + (m.visual is not None)
    told = {WHEELS: measures > 0, VISUAL: m.gnss is not None}
    return {role: _compute_ratios(found, source) for role, source in m.odometries().items() if told[role]}


def _compute_ratios(found: Trajectory, source: BodyVelocities) -> Floats:
    begin_ns = np.arange(found.stamp_ns[0], found.stamp_ns[-1] - _WINDOW_NS, _WINDOW_NS, dtype=np.int64)
    end_ns = begin_ns + _WINDOW_NS
    longest_ns = max(_MAX_GAP_NS, 3 * compute_median_period_ns(source.stamp_ns))
    whole = ~is_in_gap(source.stamp_ns, begin_ns, end_ns, longest_ns=longest_ns)
    whole &= ~is_in_gap(found.stamp_ns, begin_ns, end_ns, longest_ns=_MAX_GAP_NS)
    begin_ns, end_ns = begin_ns[whole], end_ns[whole]
    point = found.velocity_enu_mps + np.einsum(
        "kij,kj->ki",
        rotation := matrix_from_quat(found.quat_xyzw),
        np.cross(found.angular_velocity_radps, source.lever_arm_m),
    )
    forward = np.einsum("ki,ki->k", rotation[:, :, 0], point)
    zero = int(found.stamp_ns[0])

    def ways_m(stamp_ns: NDArray[np.int64], speed_mps: Floats) -> Floats:
        means = compute_interval_means(
            compute_seconds(stamp_ns, zero),
            speed_mps[:, None],
            compute_seconds(begin_ns, zero),
            compute_seconds(end_ns, zero),
        )
        return np.asarray(means[:, 0] * _WINDOW_NS * 1e-9)

    said, track = ways_m(source.stamp_ns, source.velocity_mps[:, 0]), ways_m(found.stamp_ns, forward)
    far = np.abs(track) > _MOVES_M
    return said[far] / track[far]


def solve_scales(told: Sequence[Mapping[str, Floats]]) -> Mapping[str, Scale]:
    """Return by odometry the scale that it surely has in all of a run, told by each section; those that are as usual are left out."""
    found = {}
    for role in dict.fromkeys(role for each in told for role in each):
        ratios = np.concatenate([each[role] for each in told if role in each])
        if ratios.size < _FEWEST_WINDOWS:
            continue
        factor = float(np.median(ratios))
        spread = 1.4826 * float(np.median(np.abs(ratios - factor)))
        off = abs(factor - 1.0)
        if factor > 0.0 and off > _MIN_SIGNIFICANCE_SIGMA * _SCALE_STD[role] and spread < _ALIKE * off:
            found[role] = Scale(factor, spread / float(np.sqrt(ratios.size)))
    return found


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
    if rows.sum() * compute_median_period_ns(wheels.stamp_ns) < _FEWEST_WINDOWS * _WINDOW_NS:
        return None
    ratio = wheels.velocity_mps[rows, 0] / told[rows]
    return float(np.median(ratio)) if np.quantile(ratio, 0.25) > _FASTER else None
