"""Measurements that are to be fused: what contradicts physics or the other sensors is left out, and the recipe line that mends it named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tcpipe.fusion.checks.doppler import doubt_of_velocity
from tcpipe.fusion.checks.sensors import CommandedSpeed, Refusal, check_sensors
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.geometry.rotation import matrix_from_quat, rpy_from_matrix
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.tables.arrays import rows_where
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.findings import Findings, SensorChecks
from tcpipe.tables.levels import Sensor, Streams

_STATED = ("recipe", "tf_static", "same frame")


def sane_inputs(inputs: FusionInputs, streams: Streams) -> tuple[FusionInputs, Findings[SensorChecks]]:
    """Return the inputs without the sensors that are refused, and why, judged over the longest clock epoch."""
    if not inputs.measurements:
        return inputs, Findings((), SensorChecks())
    epoch = longest_epoch(inputs)
    stated = {role: sensor.placed_by in _STATED for role, sensor in streams.sensors.items()}
    checks = check_sensors(
        inputs.measurements[epoch], command=command_of(streams, epoch), stated=stated, felt=_felt(streams)
    )
    sane, found = left_out(inputs, Findings((), checks.facts), checks.refusals, streams)
    doubt = doubt_of_velocity(sane.measurements[epoch])
    if doubt is None:
        return sane, found
    sane, found = left_out(sane, found, [Refusal(DOPPLER, doubt.why)], streams)
    given_s = streams.findings.facts.time_offset_s.get(DOPPLER, 0.0)
    mend = f"; its clock is set by the recipe, under [read.time_offset_s]: {DOPPLER} = {given_s - (doubt.late_s or 0.0):.2f}"
    return sane, found if doubt.late_s is None else replace(
        found, warnings=(*found.warnings[:-1], found.warnings[-1] + mend)
    )


def left_out(
    inputs: FusionInputs, before: Findings[SensorChecks], refusals: Sequence[Refusal], streams: Streams
) -> tuple[FusionInputs, Findings[SensorChecks]]:
    """Return the inputs without refused sensors, with why and the warnings that name the mending line."""
    refused = inputs.refused | {refusal.role for refusal in refusals}
    kept = {number: _without(refused, measurements) for number, measurements in inputs.measurements.items()}
    reasons = {**before.facts.refused, **{refusal.role: refusal.why for refusal in refusals}}
    warnings = (*before.warnings, *(_warning(refusal, streams.sensors) for refusal in refusals))
    datum = None if GNSS in refused else inputs.datum_deg_m
    inputs = replace(inputs, datum_deg_m=datum, measurements=kept, refused=refused)
    return inputs, Findings(warnings, replace(before.facts, refused=reasons))


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


def _warning(refusal: Refusal, sensors: Mapping[str, Sensor]) -> str:
    sensor = sensors[refusal.role]
    what = f"{refusal.role}: {sensor.topic} is not fused: {refusal.why}"
    if refusal.units is not None:
        return f'{what}; if that is so, declare it in the recipe under [read]: imu_units = "{refusal.units}"'
    if refusal.instead is not None:
        topic = sensors[refusal.instead].topic
        return f'{what}; to leave {refusal.instead} out instead, write in the recipe under [read]: ignore_topics = ["{topic}"]'
    if refusal.turned_by is None:
        return f'{what}; to leave it out by name, write in the recipe under [read]: ignore_topics = ["{sensor.topic}"]'
    rpy_rad = rpy_from_matrix(refusal.turned_by @ matrix_from_quat(sensor.quat_xyzw))
    place = ", ".join(f"{value:g}" for value in sensor.xyz_m)
    turn = ", ".join(f"{value:.4f}" for value in np.where(np.abs(rpy_rad) < 5e-5, 0.0, rpy_rad))
    entry = f"{refusal.role} = {{ xyz_m = [{place}], rpy_rad = [{turn}] }}"
    return f"{what} (its mounting: {sensor.placed_by}); what would fit, under [read.placement]: {entry}"
