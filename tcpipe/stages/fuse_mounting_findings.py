"""What was mended of mountings and scales, said with the recipe lines that would state it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.mounting import Arm, Tilt
from tcpipe.fusion.checks.odometry_scale import Scale
from tcpipe.fusion.measurements import GNSS, IMU
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rpy, rpy_from_matrix
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_mounting import moved_m
from tcpipe.tables.findings import Findings, MountingFacts, vector
from tcpipe.tables.levels import Sensor, Streams


def mounting_findings(inputs: FusionInputs, streams: Streams) -> Findings[MountingFacts | None]:
    """Return what was mended, with the recipe lines that would state it."""
    arm, tilt = inputs.arm, inputs.imu_tilt
    warnings = [] if arm is None else [_arm_warning(arm, streams.sensors[GNSS])]
    warnings += [] if tilt is None else [_tilt_warning(tilt, streams.sensors[IMU])]
    given = streams.findings.facts.odometry_scale or {}
    warnings += [_scale_warning(role, scale, given.get(role, 1.0)) for role, scale in inputs.scales.items()]
    if not warnings:
        return Findings((), None)
    std_m = None if arm is None else vector(np.sqrt(np.diag(arm.covariance)[:3]))
    moved = None if arm is None else vector(moved_m(inputs, streams))
    roll_pitch = None if tilt is None else (float(tilt.rad[0]), float(tilt.rad[1]))
    scales = {role: scale.factor for role, scale in inputs.scales.items()} or None
    return Findings(tuple(warnings), MountingFacts(moved, std_m, roll_pitch, scales))


def _scale_warning(role: str, scale: Scale, given: float) -> str:
    return (
        f"{role}: it goes {scale.factor:.3f} (± {scale.std:.3f}) times as far as the track, in all of the run: that is its scale, not "
        f"slip, and is taken out; to state it, under [read]: odometry_scale = {{ {role} = {given / scale.factor:.4f} }}"
    )


def _arm_warning(arm: Arm, sensor: Sensor) -> str:
    place = np.asarray(sensor.xyz_m) + arm.error[:3]
    std_m = np.sqrt(np.diag(arm.covariance)[:3])
    found = f"({_list(place)}) m ± ({_list(std_m)}) m"
    entry = f"under [read.placement]: gnss = {{ xyz_m = [{_list(place)}], rpy_rad = [0, 0, 0] }}"
    if sensor.placed_by == "assumed":
        return (
            f"gnss: nobody states where its antenna sits; by the turns it is at {found}, which is used, and what they do not show is "
            f"in the positions' deviations; to state it, {entry}"
        )
    return (
        f"gnss: the turns contradict that its antenna sits at ({_list(np.asarray(sensor.xyz_m))}) m ({sensor.placed_by}): it is taken to "
        f"sit at {found}; if that is so, {entry}"
    )


def _tilt_warning(tilt: Tilt, sensor: Sensor) -> str:
    roll_rad, pitch_rad = tilt.rad.tolist()
    turned = matrix_from_quat(quat_from_rpy(roll_rad, pitch_rad, 0.0))
    angles = ", ".join(f"{value:.4f}" for value in rpy_from_matrix(turned @ matrix_from_quat(sensor.quat_xyzw)))
    place = ", ".join(f"{value:g}" for value in sensor.xyz_m)
    return (
        f"imu: it sits rolled by {np.degrees(roll_rad):.1f}° and pitched by {np.degrees(pitch_rad):.1f}° against its mounting "
        f"({sensor.placed_by}), by the slope of the track and by its own turns; that is taken out; to state it, under [read.placement]: "
        f"imu = {{ xyz_m = [{place}], rpy_rad = [{angles}] }}"
    )


def _list(values: NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
