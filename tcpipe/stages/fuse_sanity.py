"""Measurements that are to be fused: what contradicts physics or the other sensors is left out, and the recipe line that mends it named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow.compute as pc

from tcpipe.fusion.measurements import GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.fusion.sensor_checks import Command, Refusal, check_sensors
from tcpipe.geometry.rotation import matrix_from_quat, rpy_from_matrix
from tcpipe.stages.fuse_inputs import Inputs
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.levels import Findings, Sensor, Streams

_STATED = ("recipe", "tf_static", "same frame")


def sane_inputs(inputs: Inputs, streams: Streams) -> tuple[Inputs, Findings]:
    """Return the inputs without the sensors that are refused, and why, judged over the longest clock epoch."""
    if not inputs.measurements:
        return inputs, Findings()
    epoch = longest_epoch(inputs)
    stated = {role: sensor.placed_by in _STATED for role, sensor in streams.sensors.items()}
    checks = check_sensors(
        inputs.measurements[epoch], command=_command(streams, epoch), stated=stated, felt=_felt(streams)
    )
    refused = frozenset(refusal.role for refusal in checks.refusals)
    kept = {number: _without(refused, measurements) for number, measurements in inputs.measurements.items()}
    facts = {**checks.facts, "refused": {refusal.role: refusal.why for refusal in checks.refusals}}
    warnings = tuple(_warning(refusal, streams.sensors[refusal.role]) for refusal in checks.refusals)
    datum = None if GNSS in refused else inputs.datum_deg_m
    return replace(inputs, datum_deg_m=datum, measurements=kept, refused=refused), Findings(warnings, facts)


def _without(refused: frozenset[str], m: Measurements) -> Measurements:
    return replace(
        m,
        gnss=None if GNSS in refused else m.gnss,
        imu=None if IMU in refused else m.imu,
        wheels=None if WHEELS in refused else m.wheels,
        visual=None if VISUAL in refused else m.visual,
    )


def longest_epoch(inputs: Inputs) -> int:
    """Return the clock epoch with most measurements."""
    return max(inputs.measurements, key=lambda epoch: _rows(inputs.measurements[epoch]))


def _rows(measurements: Measurements) -> int:
    sources = (measurements.gnss, measurements.imu, measurements.wheels, measurements.visual)
    return sum(source.stamp_ns.size for source in sources if source is not None)


def _command(streams: Streams, epoch: int) -> Command | None:
    if "command" not in streams.tables:
        return None
    table = streams.tables["command"]
    table = table.filter(pc.equal(table["epoch"], epoch))
    order = np.argsort(integers(table, "stamp_ns"), kind="stable")
    return Command(integers(table, "stamp_ns")[order], floats(table, "forward_velocity_mps")[order])


def _felt(streams: Streams) -> float:
    """Return the median size of the specific force."""
    if IMU not in streams.tables:
        return float("nan")
    force = np.stack([floats(streams.tables[IMU], f"linear_acceleration_{axis}_mps2") for axis in "xyz"], -1)
    return float(np.median(np.linalg.norm(force, axis=1)))


def _warning(refusal: Refusal, sensor: Sensor) -> str:
    what = f"{refusal.role}: {sensor.topic} is not fused: {refusal.why}"
    if refusal.units is not None:
        return f'{what}; if that is so, declare it in the recipe under [read]: imu_units = "{refusal.units}"'
    if refusal.turned_by is None:
        return f'{what}; to leave it out by name, write in the recipe under [read]: ignore_topics = ["{sensor.topic}"]'
    rpy_rad = rpy_from_matrix(refusal.turned_by @ matrix_from_quat(sensor.quat_xyzw))
    place = ", ".join(f"{value:g}" for value in sensor.xyz_m)
    turn = ", ".join(f"{value:.4f}" for value in np.where(np.abs(rpy_rad) < 5e-5, 0.0, rpy_rad))
    entry = f"{refusal.role} = {{ xyz_m = [{place}], rpy_rad = [{turn}] }}"
    return f"{what} (its mounting: {sensor.placed_by}); what would fit, under [read.placement]: {entry}"
