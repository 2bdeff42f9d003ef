"""What was mended of mountings and scales, said with the recipe lines that would state it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.mounting import Arm, Tilt
from tcpipe.fusion.checks.odometry_scale import Scale
from tcpipe.fusion.measurements import GNSS, IMU
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rpy
from tcpipe.recipe.suggestions import suggested
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_mounting import moved_m
from tcpipe.stages.fuse_sanity import stated_placement
from tcpipe.stages.read_pose import recipe_role
from tcpipe.tables.facts import MountingFacts, vector
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import Sensor, Streams


def mounting_findings(inputs: FusionInputs, streams: Streams) -> StageReport[MountingFacts | None]:
    """Return what was mended, with the recipe lines that would state it."""
    arm, tilt = inputs.arm, inputs.imu_tilt
    warnings = [] if arm is None else [_arm_warning(arm, streams.sensors[GNSS], recipe_role(GNSS, streams))]
    warnings += [] if tilt is None else [_tilt_warning(tilt, streams.sensors[IMU])]
    given = streams.report.facts.odometry_scale or {}
    warnings += [_scale_warning(role, scale, given.get(role, 1.0)) for role, scale in inputs.scales.items()]
    if not warnings:
        return StageReport((), None)
    std_m = None if arm is None else vector(np.sqrt(np.diag(arm.covariance)[:3]))
    moved = None if arm is None else vector(moved_m(inputs, streams))
    roll_pitch = None if tilt is None else (float(tilt.rad[0]), float(tilt.rad[1]))
    scales = {role: scale.factor for role, scale in inputs.scales.items()} or None
    return StageReport(tuple(warnings), MountingFacts(moved, std_m, roll_pitch, scales))


def _scale_warning(role: str, scale: Scale, given: float) -> str:
    by_speed = scale.driven_m
    ways = "" if by_speed is None else f" ({by_speed:.0f} m by its speed, {by_speed / scale.factor:.0f} m by the fixes)"
    return (
        f"{role}: it goes {scale.factor:.3f} (± {scale.std:.3f}) times as far as the track, in all of the run{ways}: that is its scale, "
        f"not slip, and is taken out"
    ) + suggested("to state it", {"read.odometry_scale": {role: round(given / scale.factor, 4)}})


def _arm_warning(arm: Arm, sensor: Sensor, name: str) -> str:
    place = np.asarray(sensor.xyz_m) + arm.error[:3]
    std_m = np.sqrt(np.diag(arm.covariance)[:3])
    found = f"({_list(place)}) m ± ({_list(std_m)}) m"
    turn = matrix_from_quat(sensor.quat_xyzw)
    if sensor.placed_by == "assumed":
        return (
            f"{name}: nobody states where its antenna sits; by the turns it is at {found}, which is used, and what they do not show is "
            "in the positions' deviations"
        ) + stated_placement(name, np.round(place, 2).tolist(), turn, "to state it")
    return (
        f"{name}: the turns contradict that its antenna sits at ({_list(np.asarray(sensor.xyz_m))}) m ({sensor.placed_by}): it is taken to "
        f"sit at {found}"
    ) + stated_placement(name, np.round(place, 2).tolist(), turn, "if that is so")


def _tilt_warning(tilt: Tilt, sensor: Sensor) -> str:
    roll_rad, pitch_rad = tilt.rad.tolist()
    turned = matrix_from_quat(quat_from_rpy(roll_rad, pitch_rad, 0.0))
    return (
        f"imu: it sits rolled by {np.degrees(roll_rad):.1f}° and pitched by {np.degrees(pitch_rad):.1f}° against its mounting "
        f"({sensor.placed_by}), by the slope of the track and by its own turns; that is taken out"
    ) + stated_placement(IMU, sensor.xyz_m, turned @ matrix_from_quat(sensor.quat_xyzw), "to state it")


def _list(values: NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
