"""Measurements that are to be fused: what contradicts physics or the other sensors is left out, with the remedy in a finding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.doppler import doubt_of_velocity
from tcpipe.fusion.checks.odometry_scale import rescaled_odometries
from tcpipe.fusion.checks.refusals import Refusal
from tcpipe.fusion.checks.sensors import CommandedSpeed, check_sensors
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.geometry.rotation import matrix_from_quat, rpy_from_matrix
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.read_pose import recipe_role
from tcpipe.tables.arrays import rows_where
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.facts import SensorChecks
from tcpipe.tables.findings import Finding, Remedy, StageReport, Subject, make_finding
from tcpipe.tables.levels import Streams

_STATED = ("recipe", "tf_static", "same frame")


def sane_inputs(inputs: FusionInputs, streams: Streams) -> tuple[FusionInputs, StageReport[SensorChecks]]:
    """Return the inputs without the sensors that are refused, and the findings, judged over the longest clock epoch."""
    if not inputs.measurements:
        return inputs, StageReport((), SensorChecks())
    epoch = longest_epoch(inputs)
    stated = {role: sensor.placed_by in _STATED for role, sensor in streams.sensors.items()}
    checks = check_sensors(
        inputs.measurements[epoch], command=command_of(streams, epoch), stated=stated, felt=_felt(streams)
    )
    if checks.scales:
        measured = {number: rescaled_odometries(m, checks.scales) for number, m in inputs.measurements.items()}
        inputs = replace(inputs, measurements=measured, scales=checks.scales)
    sane, found = left_out(inputs, StageReport((), checks.facts), checks.refusals, streams)
    doubt = doubt_of_velocity(sane.measurements[epoch])
    return (sane, found) if doubt is None else left_out(sane, found, [doubt], streams)


def left_out(
    inputs: FusionInputs, before: StageReport[SensorChecks], refusals: Sequence[Refusal], streams: Streams
) -> tuple[FusionInputs, StageReport[SensorChecks]]:
    """Return the inputs without refused sensors, the findings, and the codes of these by role."""
    refused = inputs.refused | {refusal.role for refusal in refusals}
    kept = {number: _without(refused, measurements) for number, measurements in inputs.measurements.items()}
    codes = {**before.facts.refused, **{refusal.role: refusal.code for refusal in refusals}}
    findings = (*before.findings, *(_find_exclusion(refusal, streams) for refusal in refusals))
    datum = None if GNSS in refused else inputs.datum_deg_m
    inputs = replace(inputs, datum_deg_m=datum, measurements=kept, refused=refused)
    return inputs, StageReport(findings, replace(before.facts, refused=codes))


def _without(refused: frozenset[str], m: Measurements) -> Measurements:
    return replace(
        m,
        gnss=None if GNSS in refused else m.gnss,
        doppler=None if refused & {GNSS, DOPPLER} else m.doppler,
        imu=None if IMU in refused else m.imu,
        wheels=None if WHEELS in refused else m.wheels,
        visual=None if VISUAL in refused else m.visual,
    )


def longest_epoch(inputs: FusionInputs) -> int:
    """Return the clock epoch with most measurements."""
    return max(inputs.measurements, key=lambda epoch: _rows(inputs.measurements[epoch]))


def _rows(measurements: Measurements) -> int:
    return sum(sensor.stamp_ns.size for sensor in measurements.sensors().values())


def command_of(streams: Streams, epoch: int) -> CommandedSpeed | None:
    """Return the commanded speed of a clock epoch; None without."""
    if "command" not in streams.tables:
        return None
    table = rows_where(streams.tables["command"], "epoch", epoch)
    return CommandedSpeed(integers(table, "stamp_ns"), floats(table, "forward_velocity_mps"))


def _felt(streams: Streams) -> float:
    """Return the median size of the specific force."""
    if IMU not in streams.tables:
        return float("nan")
    force = np.stack([floats(streams.tables[IMU], f"linear_acceleration_{axis}_mps2") for axis in "xyz"], -1)
    return float(np.median(np.linalg.norm(force, axis=1)))


def _find_exclusion(refusal: Refusal, streams: Streams) -> Finding:
    """Return the finding of a sensor that is not fused; a receiver's velocity helps fixes that are fused, and no label needs it."""
    sensor, name = streams.sensors[refusal.role], recipe_role(refusal.role, streams)
    if refusal.units is not None:
        remedies = suggest("state_units", {"read": {"imu_units": refusal.units}})
    elif refusal.late_s is not None:
        given_s = streams.report.facts.time_offset_s.get(name, 0.0)
        remedies = suggest("correct", {"read.time_offset_s": {name: round(given_s - refusal.late_s, 2)}})
    elif refusal.turned_by is not None:
        remedies = state_extrinsics(name, sensor.xyz_m, refusal.turned_by @ matrix_from_quat(sensor.quat_xyzw))
    elif refusal.is_suspect_excludable:
        remedies = exclude_role(recipe_role(refusal.names["suspect"], streams), "exclude_suspect")
    else:
        remedies = exclude_role(name)
    numbers: Mapping[str, Any] = refusal.numbers
    return make_finding(
        refusal.code,
        Subject("role", name),
        action="excluded",
        severity="note" if refusal.role == DOPPLER else None,
        names={"topic": sensor.topic, "placed_by": sensor.placed_by, **refusal.names},
        remedies=remedies,
        **numbers,
    )


def exclude_role(name: str, remedy: str = "exclude") -> tuple[Remedy, ...]:
    """Return what excludes a role, whichever topic is used as it and whoever chose that."""
    return suggest(remedy, {"read.topics": {name: []}})


def state_extrinsics(name: str, xyz_m: Sequence[float], turn: NDArray[np.float64]) -> tuple[Remedy, ...]:
    """Return what states a sensor's lever arm [m] and its rotation to base_link, shape (3, 3)."""
    place, rpy_rad = (np.round(values, digits) + 0.0 for values, digits in ((xyz_m, 3), (rpy_from_matrix(turn), 4)))
    return suggest(
        "state_extrinsics", {"read.placement": {name: {"xyz_m": place.tolist(), "rpy_rad": rpy_rad.tolist()}}}
    )
