"""Mountings that nobody stated, and mountings and scales that the motion contradicts: mended by a first track."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.mounting import (
    ARM_STD_M,
    Arm,
    Tilt,
    level_imu,
    make_unknown_arm,
    move_antenna,
    solve_arm,
    solve_tilt,
)
from tcpipe.fusion.checks.odometry_scale import Scale, rescale_odometries, solve_scales
from tcpipe.fusion.measurements import GNSS, Measurements
from tcpipe.recipe import FuseConfig
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_stretches import Fused, fuse_stretches
from tcpipe.tables.levels import Streams

_ROUNDS = 3
_SURE = 4.0  # standard deviations
_SURE_OF_ARM = 4.0
_LEAST_TILT_RAD = np.radians(1.0)
_MOST_TILT_RAD = np.radians(30.0)  # an IMU that is turned further is told by gravity, before anything is fused
_LEAST_ARM_M = 0.1
_SETTLED_M = 0.02
_SETTLED_RAD = np.radians(0.2)
_STATED_HEIGHT_STD_M = 0.05
_ANTENNA = slice(0, 2)  # what the turns show: forward and left


def fuse_mounted(inputs: FusionInputs, streams: Streams, config: FuseConfig) -> tuple[FusionInputs, Fused]:
    """Fuse each stretch, and again as long as that shows an antenna or an IMU to be mounted, or an odometry to be scaled, otherwise."""
    fused = fuse_stretches(inputs, streams, config)
    for _ in range(_ROUNDS):
        mended = _correct_mounting(inputs, fused, streams)
        if mended is None:
            break
        inputs, fused = mended, fuse_stretches(mended, streams, config)
    return inputs, fused


def _correct_mounting(inputs: FusionInputs, fused: Fused, streams: Streams) -> FusionInputs | None:
    """Return the inputs with what a track shows to be mounted otherwise mended; None where all is settled."""
    tilt = _find_tilt(inputs, fused)
    turn = np.zeros(2) if tilt is None else tilt.rad
    arm, move_m = _find_lever_arm(inputs, fused, streams, trusted=tilt is None)
    scales = solve_scales(fused.ratios)
    if tilt is None and arm is None and not scales:
        return None
    mended = {epoch: _apply_mounting(m, turn, move_m, scales) for epoch, m in inputs.measurements.items()}
    if tilt is not None and inputs.imu_tilt is not None:
        tilt = replace(tilt, rad=tilt.rad + inputs.imu_tilt.rad)
    arm, tilt = arm or inputs.arm, tilt or inputs.imu_tilt
    scales = {role: scale.after(inputs.scales.get(role)) for role, scale in scales.items()}
    return replace(inputs, measurements=mended, arm=arm, imu_tilt=tilt, scales={**inputs.scales, **scales})


def _find_tilt(inputs: FusionInputs, fused: Fused) -> Tilt | None:
    """Return by how much the IMU is still to be turned; None where it stays."""
    tilt = solve_tilt(fused.tilts)
    if tilt is None:
        return None
    known = np.zeros(2) if inputs.imu_tilt is None else inputs.imu_tilt.rad
    least = np.where(known != 0.0, _SETTLED_RAD, np.maximum(_LEAST_TILT_RAD, _SURE * tilt.std_rad))
    told = (np.abs(tilt.rad) > least) & (np.abs(tilt.rad + known) < _MOST_TILT_RAD)
    turned = np.where(told, tilt.rad, 0.0)
    return replace(tilt, rad=turned) if turned.any() else None


def _find_lever_arm(
    inputs: FusionInputs, fused: Fused, streams: Streams, *, trusted: bool
) -> tuple[Arm | None, NDArray[np.float64]]:
    """Return the antenna's arm and by how much to move it; None and nothing where it stays.

    Parameters
    ----------
    trusted : whether the track's attitude is; otherwise a stated arm is not judged by it.
    """
    nothing = np.zeros(3)
    if inputs.datum_deg_m is None or GNSS not in streams.sensors:
        return None, nothing
    unknown = streams.sensors[GNSS].placed_by == "assumed"
    moved = compute_moved_m(inputs, streams)
    height_std_m = ARM_STD_M if unknown else _STATED_HEIGHT_STD_M
    arm = solve_arm(fused.arms, moved, height_std_m=height_std_m) or (make_unknown_arm() if unknown else None)
    if arm is None:
        return None, nothing
    if inputs.arm is None and not unknown and not (trusted and _is_contradicted(arm)):
        return None, nothing
    move_m = arm.error[:3] - moved
    if inputs.arm is not None and float(np.linalg.norm(move_m[_ANTENNA])) < _SETTLED_M:
        return None, nothing
    return arm, move_m


def _is_contradicted(arm: Arm) -> bool:
    """Return whether the turns show an antenna elsewhere than it is stated to be."""
    aside = arm.error[_ANTENNA]
    squared = float(aside @ np.linalg.solve(arm.covariance[_ANTENNA, _ANTENNA], aside))
    return squared > _SURE_OF_ARM**2 and float(np.linalg.norm(aside)) > _LEAST_ARM_M


def compute_moved_m(inputs: FusionInputs, streams: Streams) -> NDArray[np.float64]:
    """Return by how much the arm in use differs from the one that was read [m], shape (3,)."""
    arms = [m.gnss.lever_arm_m for m in inputs.measurements.values() if m.gnss is not None]
    return np.asarray(arms[0]) - np.asarray(streams.sensors[GNSS].xyz_m) if arms else np.zeros(3)


def _apply_mounting(
    m: Measurements, turn_rad: NDArray[np.float64], move_m: NDArray[np.float64], scales: Mapping[str, Scale]
) -> Measurements:
    return replace(
        rescale_odometries(m, scales),
        imu=None if m.imu is None else level_imu(m.imu, turn_rad) if turn_rad.any() else m.imu,
        gnss=None if m.gnss is None else move_antenna(m.gnss, move_m),
    )
