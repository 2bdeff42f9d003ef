"""What was corrected of lever arms, extrinsics and scales, with the recipe keys that would state it."""

from __future__ import annotations

from typing import Any

import numpy as np

from tcpipe.fusion.checks.mounting import Arm, Tilt
from tcpipe.fusion.checks.odometry_scale import Scale
from tcpipe.fusion.measurements import GNSS, IMU
from tcpipe.geometry.rotation import matrix_from_quat, quat_from_rpy
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.fuse_mounting import moved_m
from tcpipe.stages.fuse_sanity import state_extrinsics
from tcpipe.stages.read_pose import recipe_role
from tcpipe.tables.facts import MountingFacts, vector
from tcpipe.tables.findings import Finding, StageReport, Subject, make_finding
from tcpipe.tables.levels import Sensor, Streams


def mounting_findings(inputs: FusionInputs, streams: Streams) -> StageReport[MountingFacts | None]:
    """Return what was corrected, with the recipe keys that would state it."""
    arm, tilt = inputs.arm, inputs.imu_tilt
    findings = [] if arm is None else [_find_arm(arm, streams.sensors[GNSS], recipe_role(GNSS, streams))]
    findings += [] if tilt is None else [_find_tilt(tilt, streams.sensors[IMU])]
    given = streams.report.facts.odometry_scale or {}
    findings += [_find_scale(role, scale, given.get(role, 1.0)) for role, scale in inputs.scales.items()]
    if not findings:
        return StageReport((), None)
    std_m = None if arm is None else vector(np.sqrt(np.diag(arm.covariance)[:3]))
    moved = None if arm is None else vector(moved_m(inputs, streams))
    roll_pitch = None if tilt is None else (float(tilt.rad[0]), float(tilt.rad[1]))
    scales = {role: scale.factor for role, scale in inputs.scales.items()} or None
    return StageReport(tuple(findings), MountingFacts(moved, std_m, roll_pitch, scales))


def _find_scale(role: str, scale: Scale, given: float) -> Finding:
    by_speed: dict[str, Any] = {} if scale.driven_m is None else {"driven_m": scale.driven_m}
    remedies = suggest("state", {"read.odometry_scale": {role: round(given / scale.factor, 4)}})
    subject, std = Subject("role", role), scale.std
    return make_finding("odometry-scale", subject, remedies=remedies, scale=scale.factor, scale_std=std, **by_speed)


def _find_arm(arm: Arm, sensor: Sensor, name: str) -> Finding:
    place, std_m = np.asarray(sensor.xyz_m) + arm.error[:3], np.sqrt(np.diag(arm.covariance)[:3])
    axes = ("forward", "left", "up")
    return make_finding(
        "lever-arm-unknown" if sensor.placed_by == "assumed" else "lever-arm-contradicted",
        Subject("role", name),
        names={"placed_by": sensor.placed_by},
        remedies=state_extrinsics(name, np.round(place, 2).tolist(), matrix_from_quat(sensor.quat_xyzw)),
        **{f"{axis}_m": value for axis, value in zip(axes, place.tolist(), strict=True)},
        **{f"{axis}_std_m": value for axis, value in zip(axes, std_m.tolist(), strict=True)},
    )


def _find_tilt(tilt: Tilt, sensor: Sensor) -> Finding:
    roll_rad, pitch_rad = tilt.rad.tolist()
    turn = matrix_from_quat(quat_from_rpy(roll_rad, pitch_rad, 0.0)) @ matrix_from_quat(sensor.quat_xyzw)
    return make_finding(
        "imu-tilted",
        Subject("role", IMU),
        names={"placed_by": sensor.placed_by},
        remedies=state_extrinsics(IMU, sensor.xyz_m, turn),
        roll_rad=roll_rad,
        pitch_rad=pitch_rad,
    )
