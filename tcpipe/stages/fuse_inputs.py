"""Measurements by clock epoch, without sensors that contradict physics or the other sensors; findings name the remedy.

A pose that another program estimated is fused as fixes with an attitude; findings and facts call it by its role.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from tcpipe.fusion import preparation
from tcpipe.fusion.attitude import align_mounting
from tcpipe.fusion.checks.sanity import (
    CommandedSpeed,
    SensorExclusion,
    check_ground_velocity,
    check_sensors,
    rescale_odometries,
)
from tcpipe.fusion.measurements import (
    DOPPLER,
    GNSS,
    IMU,
    NO_LEVER_ARM,
    POSE,
    STATED_ARM_STD_M,
    UNSTATED_ARM_STD_M,
    VISUAL,
    WHEELS,
    Measurements,
)
from tcpipe.fusion.preparation import Prepared
from tcpipe.geometry.datum import geodetic_from_enu
from tcpipe.geometry.rotation import matrix_from_quat, rpy_from_matrix
from tcpipe.recipe import FuseConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.tables.arrays import select_rows
from tcpipe.tables.columns import read_float_columns, to_floats, to_integers
from tcpipe.tables.findings import Finding, Remedy, Subject, make_finding
from tcpipe.tables.levels import STREAMS, Sensor, Streams


@dataclass(slots=True)
class FusionInputs:
    """Measurements by epoch; datum (longitude, latitude, height) or None; by role, unusable stamps and counts; findings."""

    datum_deg_m: tuple[float, float, float] | None
    measurements: dict[int, Measurements] = field(default_factory=dict)
    invalid_ns: dict[str, list[NDArray[np.int64]]] = field(default_factory=dict)
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    excluded: Mapping[str, Finding] = field(default_factory=dict)
    """By role, why a sensor is not fused."""
    scales: Mapping[str, float] = field(default_factory=dict)
    """By odometry, the scale that was taken out: far from 1."""
    cuts_ns: tuple[int, ...] = ()
    """First stamps after the clock of all sensors was set forward."""

    def note(self, role: str, prepared: Prepared) -> None:
        """Remember what was set aside."""
        self.invalid_ns.setdefault(role, []).append(prepared.invalid_ns)
        count = self.counts.setdefault(role, {"invalid": 0, "repeated": 0, "variances_replaced": 0})
        count["invalid"] += prepared.invalid_ns.size
        count["repeated"] += prepared.repeated
        count["variances_replaced"] += prepared.variances_replaced
        self.findings += [finding for finding in prepared.findings if finding not in self.findings]


def prepare_inputs(streams: Streams, config: FuseConfig) -> FusionInputs:
    """Turn the motion streams into measurements, one set a clock epoch."""
    tables = {role: streams.tables[role] for role in (GNSS, DOPPLER, IMU, WHEELS, VISUAL) if role in streams.tables}
    tables |= {GNSS: streams.tables[POSE]} if POSE in streams.tables else {}
    datum = None
    if GNSS in tables:
        datum = preparation.find_datum(*(to_floats(tables[GNSS], name) for name in ("lon_deg", "lat_deg", "alt_m")))
    inputs = FusionInputs(datum)
    for epoch in sorted({int(e) for table in tables.values() for e in pc.unique(table["clock_epoch"]).to_pylist()}):
        parts = {role: select_rows(table, "clock_epoch", epoch) for role, table in tables.items()}
        found = {role: _prepare(role, part, streams.sensors[role], config, inputs) for role, part in parts.items()}
        gnss, odometry = found.get(GNSS), found.get(WHEELS) or found.get(VISUAL)
        if gnss is not None:
            gnss = align_mounting(gnss, odometry, is_stated=streams.sensors[GNSS].placed_by != "assumed")
            count = gnss.stamp_ns.size
            gnss, repeats = preparation.drop_repeated_fixes(gnss, odometry)
            inputs.counts[GNSS]["repeated"] += count - gnss.stamp_ns.size
            inputs.findings += [_find_frozen(each, streams) for each in repeats]
        if gnss is not None and odometry is not None:
            gnss, jitter_s = preparation.inflate_jittery_fixes(gnss, odometry)
            inputs.findings += _find_jitter(jitter_s)
        inputs.measurements[epoch] = Measurements(
            gnss=gnss,
            doppler=found.get(DOPPLER),
            imu=found.get(IMU),
            wheels=found.get(WHEELS),
            visual=found.get(VISUAL),
            nonholonomic_std_mps=config.nonholonomic_std_mps,
        )
    return inputs


def _find_frozen(repeats: preparation.Repeats, streams: Streams) -> Finding:
    first_ns = _find_first_ns(streams)
    span_s = (repeats.start_ns - first_ns) / 1e9, (repeats.end_ns - first_ns) / 1e9
    subject, names = Subject("role", GNSS), {"quantity": "position"}
    return make_finding("frozen", subject, span_s=span_s, names=names, message_count=repeats.messages)


def _find_jitter(jitter_s: NDArray[np.float64]) -> Iterator[Finding]:
    jumpy = jitter_s > 0
    if jumpy.any():
        share, median_s = float(jumpy.mean()), float(np.median(jitter_s[jumpy]))
        yield make_finding("stamp-jitter", Subject("role", GNSS), jitter_fraction=share, jitter_s=median_s)


def _find_first_ns(streams: Streams) -> int:
    """Return the first stamp of any sensor [ns]."""
    return min(
        int(to_integers(table.slice(0, 1), "stamp_ns")[0]) for table in streams.tables.values() if table.num_rows
    )


def _find_used_s(role: str, streams: Streams) -> tuple[float, float] | None:
    """Return when a sensor's first and last messages are [s]."""
    table = streams.tables.get(name_pose(role, streams))
    if table is None:
        return None
    stamp_ns = to_integers(table, "stamp_ns")
    return (int(stamp_ns[0]) - _find_first_ns(streams)) / 1e9, (int(stamp_ns[-1]) - _find_first_ns(streams)) / 1e9


def _prepare(role: str, table: pa.Table, sensor: Sensor, config: FuseConfig, inputs: FusionInputs) -> Any:
    stamp_ns, columns = to_integers(table, "stamp_ns"), read_float_columns(table)
    place: Mapping[str, Any] = {"xyz_m": sensor.xyz_m, "quat_xyzw": sensor.quat_xyzw}
    made: Any
    if role == GNSS:
        if inputs.datum_deg_m is None:
            inputs.note(role, Prepared(stamp_ns))
            return None
        made, prepared = preparation.prepare_positions(
            stamp_ns,
            columns,
            datum_deg_m=inputs.datum_deg_m,
            lever_arm_m=sensor.xyz_m,
            lever_arm_std_m=UNSTATED_ARM_STD_M
            if sensor.placed_by == "assumed"
            else config.lever_arm_std_m or STATED_ARM_STD_M,
            default_std_m=config.gnss_default_std_m,
            floor_std_m=config.gnss_std_floor_m,
            mounting_xyzw=sensor.quat_xyzw,
        )
    elif role == DOPPLER:
        made, prepared = preparation.prepare_ground_velocities(
            stamp_ns, columns, default_std_mps=config.gnss_velocity_std_mps
        )
    elif role == IMU:
        made, prepared = preparation.prepare_imu(
            stamp_ns,
            columns,
            **place,
            gyro_std_radps=config.gyro_noise_radps,
            accelerometer_std_mps2=config.accelerometer_noise_mps2,
        )
    else:
        std = config.wheel_std_mps if role == WHEELS else config.visual_std_mps
        made, prepared = preparation.prepare_body_velocities(
            stamp_ns, columns, **place, default_std_mps=std, only_forward=role == WHEELS
        )
    inputs.note(role, prepared)
    return made if made.stamp_ns.size else None


_STATED = ("recipe", "tf_static", "same frame")


def drop_implausible_sensors(inputs: FusionInputs, streams: Streams) -> FusionInputs:
    """Return the inputs without the sensors that cannot be right, judged over the longest clock epoch."""
    if not inputs.measurements:
        return inputs
    epoch = find_longest_epoch(inputs)
    stated = {role: sensor.placed_by in _STATED for role, sensor in streams.sensors.items()}
    exclusions, scales = check_sensors(
        inputs.measurements[epoch],
        command=read_command(streams, epoch),
        stated=stated,
        felt=_compute_median_specific_force(streams),
    )
    if scales:
        measured = {number: rescale_odometries(m, scales) for number, m in inputs.measurements.items()}
        inputs = replace(inputs, measurements=measured, scales=scales)
    inputs = exclude_sensors(inputs, exclusions.values(), streams)
    doubt = check_ground_velocity(inputs.measurements[epoch])
    return inputs if doubt is None else exclude_sensors(inputs, [doubt], streams)


def exclude_sensors(inputs: FusionInputs, exclusions: Iterable[SensorExclusion], streams: Streams) -> FusionInputs:
    """Return the inputs without some sensors."""
    excluded = {**inputs.excluded, **{each.role: _find_exclusion(each, streams) for each in exclusions}}
    # The receiver's velocity is of the antenna of the fixes.
    gone = dict.fromkeys((*excluded, DOPPLER) if GNSS in excluded else excluded)
    kept = {number: measurements.replace_sensors(gone) for number, measurements in inputs.measurements.items()}
    datum = None if GNSS in excluded else inputs.datum_deg_m
    return _define_base_by_antenna(replace(inputs, datum_deg_m=datum, measurements=kept, excluded=excluded), streams)


def _define_base_by_antenna(inputs: FusionInputs, streams: Streams) -> FusionInputs:
    """Return the inputs with an antenna that nothing places exactly at base_link, if no other sensor of motion is fused."""
    fixes = {number: m.gnss for number, m in inputs.measurements.items() if m.gnss and m.is_antenna_alone}
    others = any(m.sensors() for number, m in inputs.measurements.items() if number not in fixes)
    if others or not fixes or streams.sensors[GNSS].placed_by != "assumed":
        return inputs
    measurements = dict(inputs.measurements)
    for number, gnss in fixes.items():
        measurements[number] = replace(measurements[number], gnss=replace(gnss, lever_arm_std_m=NO_LEVER_ARM))
    findings = dict.fromkeys((*inputs.findings, make_finding("track-of-antenna", Subject("role", GNSS))))
    return replace(inputs, measurements=measurements, findings=[*findings])


def find_longest_epoch(inputs: FusionInputs) -> int:
    """Return the clock epoch with most measurements."""
    counts = {
        epoch: sum(sensor.stamp_ns.size for sensor in m.sensors().values()) for epoch, m in inputs.measurements.items()
    }
    return max(counts, key=lambda epoch: counts[epoch])


def read_command(streams: Streams, epoch: int) -> CommandedSpeed | None:
    """Return the commanded speed of a clock epoch; None without."""
    if "command" not in streams.tables:
        return None
    table = select_rows(streams.tables["command"], "clock_epoch", epoch)
    return CommandedSpeed(to_integers(table, "stamp_ns"), to_floats(table, "forward_velocity_mps"))


def _compute_median_specific_force(streams: Streams) -> float:
    """Return the median size of the specific force."""
    if IMU not in streams.tables:
        return float("nan")
    force = np.stack([to_floats(streams.tables[IMU], f"linear_acceleration_{axis}_mps2") for axis in "xyz"], -1)
    return float(np.median(np.linalg.norm(force, axis=1)))


def _find_exclusion(exclusion: SensorExclusion, streams: Streams) -> Finding:
    """Return the finding of a sensor that is not fused; a receiver's velocity helps fixes that are fused, and no label needs it."""
    sensor, name = streams.sensors[exclusion.role], exclusion.role
    if exclusion.units is not None:
        remedies = suggest("state_units", {"read": {"imu_units": exclusion.units}})
    elif exclusion.turned_by is not None:
        remedies = state_extrinsics(name, sensor.xyz_m, exclusion.turned_by @ matrix_from_quat(sensor.quat_xyzw))
    elif exclusion.is_suspect_excludable:
        remedies = exclude_role(exclusion.names["suspect"], "exclude_suspect")
    else:
        remedies = exclude_role(name)
    numbers: Mapping[str, Any] = exclusion.numbers
    return make_finding(
        exclusion.code,
        Subject("role", name),
        span_s=_find_used_s(exclusion.role, streams),
        action="excluded",
        severity="note" if exclusion.role == DOPPLER else None,
        names={"topic": sensor.topic, "placed_by": sensor.placed_by, **exclusion.names},
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
        "state_extrinsics", {"read.extrinsics": {name: {"xyz_m": place.tolist(), "rpy_rad": rpy_rad.tolist()}}}
    )


_ANYWHERE_DEG_M = (0.0, 45.0, 0.0)
"""Where a frame that is nowhere on the earth is taken to lie while its positions are fused: east, north and up stay what they are."""


def prepare_pose(streams: Streams) -> tuple[Streams, bool]:
    """Return the streams with the pose as fixes of a GNSS could be, and whether it lies in a frame that is nowhere on the earth."""
    pose = streams.tables.get(POSE)
    if pose is None:
        return streams, False
    local = bool(np.isnan(to_floats(pose, "lon_deg")).any())
    if local:
        place = np.column_stack([to_floats(pose, f"{axis}_m") for axis in "xyz"])
        names = ("lon_deg", "lat_deg", "alt_m")
        geodetic = dict(zip(names, geodetic_from_enu(place, datum_deg_m=_ANYWHERE_DEG_M), strict=True))
        pose = STREAMS[POSE].table(**{name: pose[name] for name in pose.column_names} | geodetic)
    sensors = {**streams.sensors, GNSS: streams.sensors[POSE]}
    return replace(streams, tables={**streams.tables, POSE: pose}, sensors=sensors), local


_Named = TypeVar("_Named")


def name_pose(value: _Named, streams: Streams) -> _Named:
    """Return a role, findings or facts in which the role of a pose stands for that of the fixes as which it is fused."""
    if POSE not in streams.tables:
        return value
    named = cast("object", value)
    if isinstance(value, str):
        named = POSE if value == GNSS else value
    elif isinstance(value, Mapping):
        named = {name_pose(key, streams): name_pose(item, streams) for key, item in value.items()}
    elif isinstance(value, tuple | list):
        named = type(value)(name_pose(item, streams) for item in value)
    elif is_dataclass(value) and not isinstance(value, type):
        named = replace(
            value, **{entry.name: name_pose(getattr(value, entry.name), streams) for entry in fields(value)}
        )
    return cast("_Named", named)
