"""Measurements that are to be fused: what contradicts physics or the other sensors is left out, and the recipe line that mends it named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.checks.doppler import doubt_of_velocity
from tcpipe.fusion.checks.odometry_scale import rescaled_odometries
from tcpipe.fusion.checks.sensors import CommandedSpeed, Refusal, check_sensors
from tcpipe.fusion.measurements import DOPPLER, GNSS, IMU, VISUAL, WHEELS, Measurements
from tcpipe.geometry.rotation import matrix_from_quat, rpy_from_matrix
from tcpipe.recipe.suggestions import suggested
from tcpipe.stages.fuse_inputs import FusionInputs
from tcpipe.stages.read_pose import recipe_role
from tcpipe.tables.arrays import rows_where
from tcpipe.tables.columns import floats, integers
from tcpipe.tables.facts import SensorChecks
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import Streams

_STATED = ("recipe", "tf_static", "same frame")


def sane_inputs(inputs: FusionInputs, streams: Streams) -> tuple[FusionInputs, StageReport[SensorChecks]]:
    """Return the inputs without the sensors that are refused, and why, judged over the longest clock epoch."""
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
    if doubt is None:
        return sane, found
    sane, found = left_out(sane, found, [Refusal(DOPPLER, doubt.why)], streams)
    if doubt.late_s is None:
        return sane, found
    given_s = streams.report.facts.time_offset_s.get(DOPPLER, 0.0)
    mend = suggested("to correct its clock", {"read.time_offset_s": {DOPPLER: round(given_s - doubt.late_s, 2)}})
    return sane, replace(found, warnings=(*found.warnings[:-1], found.warnings[-1] + mend))


def left_out(
    inputs: FusionInputs, before: StageReport[SensorChecks], refusals: Sequence[Refusal], streams: Streams
) -> tuple[FusionInputs, StageReport[SensorChecks]]:
    """Return the inputs without refused sensors, with why and the warnings that name the mending line."""
    refused = inputs.refused | {refusal.role for refusal in refusals}
    kept = {number: _without(refused, measurements) for number, measurements in inputs.measurements.items()}
    reasons = {**before.facts.refused, **{refusal.role: refusal.why for refusal in refusals}}
    warnings = (*before.warnings, *(_warning(refusal, streams) for refusal in refusals))
    datum = None if GNSS in refused else inputs.datum_deg_m
    inputs = replace(inputs, datum_deg_m=datum, measurements=kept, refused=refused)
    return inputs, StageReport(warnings, replace(before.facts, refused=reasons))


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


def _warning(refusal: Refusal, streams: Streams) -> str:
    sensor, name = streams.sensors[refusal.role], recipe_role(refusal.role, streams)
    what = f"{name}: {sensor.topic} is not fused: {refusal.why}"
    if refusal.units is not None:
        return what + suggested("if that is so", {"read": {"imu_units": refusal.units}})
    if refusal.instead is not None:
        return what + without_role(recipe_role(refusal.instead, streams), f"to leave {refusal.instead} out instead")
    if refusal.turned_by is None:
        return what + without_role(name, "to leave it out by name")
    turned = refusal.turned_by @ matrix_from_quat(sensor.quat_xyzw)
    return f"{what} (its mounting: {sensor.placed_by})" + stated_placement(name, sensor.xyz_m, turned, "what would fit")


def without_role(name: str, purpose: str) -> str:
    """Return what leaves a role out, whichever topic plays it and whoever chose that."""
    return suggested(purpose, {"read.topics": {name: []}})


def stated_placement(name: str, xyz_m: Sequence[float], turn: NDArray[np.float64], purpose: str) -> str:
    """Return what states a sensor's place [m] and its rotation to base_link, shape (3, 3)."""
    place, rpy_rad = (np.round(values, digits) + 0.0 for values, digits in ((xyz_m, 3), (rpy_from_matrix(turn), 4)))
    return suggested(purpose, {"read.placement": {name: {"xyz_m": place.tolist(), "rpy_rad": rpy_rad.tolist()}}})
