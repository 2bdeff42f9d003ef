"""Sections of a run: measurements by clock epoch, without sensors that contradict physics or other sensors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tcpipe.arrays import Floats
from tcpipe.fusion import preparation
from tcpipe.fusion.attitude import align_mounting
from tcpipe.fusion.checks.motions import compute_driven_m, find_span_ns
from tcpipe.fusion.checks.sanity import CONSTANT_FAULTS, Command, SensorExclusion, check_ground_velocity, check_sensors
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
from tcpipe.geometry.rotation import matrix_from_quat, rpy_from_matrix
from tcpipe.recipe import FuseConfig
from tcpipe.recipe.suggestions import suggest
from tcpipe.tables.columns import read_float_columns, select_rows, to_floats, to_integers
from tcpipe.tables.facts import ClockFacts, ClockOffset
from tcpipe.tables.findings import Finding, Remedy, Subject, make_finding
from tcpipe.tables.levels import Sensor, Streams


@dataclass(frozen=True, slots=True)
class Section:
    """A clock epoch of a run, or a part of it without a pause of an hour, and all decisions on its sensors.

    Units and mounting are constants of the robot, so a section also takes those found in sections with a longer drive.
    All other decisions are made for each section separately.

    Attributes
    ----------
    command : commands of its clock epoch; None without commands.
    datum_deg_m : longitude, latitude, height of the local frame's origin; None without fixes.
    prepared : by role, messages that are excluded or changed.
    excluded : by role, reason for the exclusion of a sensor.
    clocks : time offsets of the sensors; ``measurements`` contain them until
    `tcpipe.stages.fuse_clocks.correct_clocks`.
    cuts : findings of forward steps of the clock of all sensors, by the first stamp after the step [ns].
    """

    clock_epoch: int
    measurements: Measurements = field(default_factory=Measurements)
    command: Command | None = None
    datum_deg_m: tuple[float, float, float] | None = None
    prepared: Mapping[str, Prepared] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    excluded: Mapping[str, Finding] = field(default_factory=dict)
    clocks: ClockFacts = field(default_factory=lambda: ClockFacts(0, "", (), {}))
    cuts: Mapping[int, Finding] = field(default_factory=dict)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp of a measurement [ns]."""
        return find_span_ns(self.measurements) or (0, 0)

    @property
    def offsets(self) -> dict[str, ClockOffset]:
        """Time offsets that are corrected, by role."""
        sensors = self.measurements.sensors()
        return {
            role: offset for role, offset in self.clocks.offsets.items() if offset.is_significant and role in sensors
        }

    @property
    def driven_m(self) -> float:
        """Distance by the first motion sensor [m]: a longer drive determines more about the sensors."""
        return float(np.diff(compute_driven_m(self.measurements, np.array(self.span_ns)))[0])


def rank_sections(sections: Sequence[Section]) -> list[int]:
    """Return the indices of sections from the longest drive to the shortest."""
    return sorted(range(len(sections)), key=lambda place: -sections[place].driven_m)


def prepare_sections(streams: Streams, config: FuseConfig) -> list[Section]:
    """Return the measurements of each clock epoch with at least one usable value, in order of epoch and time."""
    tables = {role: streams.tables[role] for role in (GNSS, DOPPLER, IMU, WHEELS, VISUAL) if role in streams.tables}
    tables |= {GNSS: streams.tables[POSE]} if POSE in streams.tables else {}
    datum = None
    if GNSS in tables:
        datum = preparation.find_datum(*(to_floats(tables[GNSS], name) for name in ("lon_deg", "lat_deg", "alt_m")))
    sections = []
    for epoch in sorted({int(e) for table in tables.values() for e in pc.unique(table["clock_epoch"]).to_pylist()}):
        parts = {role: select_rows(table, "clock_epoch", epoch) for role, table in tables.items()}
        command = None
        if "command" in streams.tables:
            table = select_rows(streams.tables["command"], "clock_epoch", epoch)
            values = (to_floats(table, name) for name in ("forward_velocity_mps", "yaw_rate_radps"))
            command = Command(to_integers(table, "stamp_ns"), *values)
        for part in _split_at_pauses(parts):
            section = _prepare_section(part, streams, config, datum)
            sections.append(replace(section, clock_epoch=epoch, command=command))
    return sections


def _split_at_pauses(parts: Mapping[str, pa.Table]) -> Iterator[dict[str, pa.Table]]:
    """Yield the parts of tables between pauses of an hour; some logs begin in 1970, and grids must stay small."""
    stamps = {role: to_integers(part, "stamp_ns") for role, part in parts.items()}
    every = np.unique(np.concatenate([*stamps.values()]))
    first = np.concatenate((every[:1], every[1:][np.diff(every) > 3_600_000_000_000], every[-1:] + 1))
    for start, end in pairwise(first.tolist()):
        bounds = {role: np.searchsorted(stamp, (start, end)).tolist() for role, stamp in stamps.items()}
        yield {role: parts[role].slice(first, last - first) for role, (first, last) in bounds.items() if last > first}


def _prepare_section(
    tables: Mapping[str, pa.Table], streams: Streams, config: FuseConfig, datum: tuple[float, float, float] | None
) -> Section:
    """Return the measurements and findings of a clock epoch, or of a part of it."""
    prepared_by_role = {
        role: _prepare(role, part, streams.sensors[role], config, datum) for role, part in tables.items()
    }
    prepared: dict[str, Prepared] = {role: each for role, (_, each) in prepared_by_role.items()}
    found = {
        role: sensor for role, (sensor, _) in prepared_by_role.items() if sensor is not None and sensor.stamp_ns.size
    }
    findings = [finding for each in prepared.values() for finding in each.findings]
    gnss, odometry, fixes = found.get(GNSS), found.get(WHEELS) or found.get(VISUAL), Subject("role", GNSS)
    if gnss is not None:
        gnss = align_mounting(gnss, odometry, is_stated=streams.sensors[GNSS].placed_by != "assumed")
        repeated = prepared[GNSS].repeated + gnss.stamp_ns.size
        gnss, repeats = preparation.drop_repeated_fixes(gnss, odometry)
        prepared[GNSS] = replace(prepared[GNSS], repeated=repeated - gnss.stamp_ns.size)
        for start_ns, end_ns, count in repeats:
            span_s, frozen = find_span_s(start_ns, end_ns, streams), {"quantity": "position"}
            findings.append(make_finding("frozen", fixes, span_s=span_s, names=frozen, message_count=count))
    if gnss is not None and odometry is not None:
        gnss, jitter_s = preparation.inflate_jittery_fixes(gnss, odometry)
        if (has_jitter := jitter_s > 0).any():
            share, median_s = float(has_jitter.mean()), float(np.median(jitter_s[has_jitter]))
            finding = make_finding("stamp-jitter", fixes, jitter_fraction=share, jitter_s=median_s)
            # If most stamps jitter, most positions are uncertain.
            findings.append(replace(finding, severity="warning") if share > 0.5 else finding)
    return Section(
        0,
        Measurements(nonholonomic_std_mps=config.nonholonomic_std_mps).replace_sensors(found | {GNSS: gnss}),
        datum_deg_m=datum,
        prepared=prepared,
        findings=tuple(dict.fromkeys(findings)),
    )


def find_span_s(start_ns: int, end_ns: int, streams: Streams) -> tuple[float, float]:
    """Return two stamps [ns] as times since the first stamp of any sensor [s]."""
    stamps = [to_integers(table.slice(0, 1), "stamp_ns") for table in streams.tables.values()]
    first_ns = min((int(each[0]) for each in stamps if each.size), default=start_ns)
    return (start_ns - first_ns) / 1e9, (end_ns - first_ns) / 1e9


def _prepare(
    role: str, table: pa.Table, sensor: Sensor, config: FuseConfig, datum_deg_m: tuple[float, float, float] | None
) -> tuple[Any, Prepared]:
    """Return a sensor's measurements (None without any), and the counts and findings of their preparation."""
    stamp_ns, columns = to_integers(table, "stamp_ns"), read_float_columns(table)
    place: Mapping[str, Any] = {"xyz_m": sensor.xyz_m, "quat_xyzw": sensor.quat_xyzw}
    if role == GNSS:
        if datum_deg_m is None:
            return None, Prepared(stamp_ns)
        return preparation.prepare_positions(
            stamp_ns,
            columns,
            datum_deg_m=datum_deg_m,
            lever_arm_m=sensor.xyz_m,
            lever_arm_std_m=UNSTATED_ARM_STD_M
            if sensor.placed_by == "assumed"
            else config.lever_arm_std_m or STATED_ARM_STD_M,
            default_std_m=config.gnss_default_std_m,
            floor_std_m=config.gnss_std_floor_m,
            mounting_xyzw=sensor.quat_xyzw,
        )
    if role == DOPPLER:
        return preparation.prepare_ground_velocities(stamp_ns, columns, default_std_mps=config.gnss_velocity_std_mps)
    if role == IMU:
        return preparation.prepare_imu(
            stamp_ns,
            columns,
            **place,
            gyro_std_radps=config.gyro_noise_radps,
            accelerometer_std_mps2=config.accelerometer_noise_mps2,
        )
    std = config.wheel_std_mps if role == WHEELS else config.visual_std_mps
    return preparation.prepare_body_velocities(
        stamp_ns, columns, **place, default_std_mps=std, only_forward=role == WHEELS
    )


def drop_implausible_sensors(sections: Sequence[Section], streams: Streams) -> list[Section]:
    """Return the sections without implausible sensors.

    Sections are checked from the longest drive to the shortest. Each section checks its own sensors, but takes units
    and mounting from the sections before: a few metres do not determine the sign of a yaw rate.
    """
    stated = ("recipe", "tf_static", "same frame")
    is_imu_stated = IMU in streams.sensors and streams.sensors[IMU].placed_by in stated
    force_norm_mps2 = float("nan")
    if IMU in streams.tables:
        force = np.stack([to_floats(streams.tables[IMU], f"linear_acceleration_{axis}_mps2") for axis in "xyz"], -1)
        force_norm_mps2 = float(np.median(np.linalg.norm(force, axis=1)))
    judged = list(sections)
    constants: dict[str, SensorExclusion] = {}
    for place in rank_sections(sections):
        roles = sections[place].measurements.sensors()
        section = exclude_sensors(sections[place], [constants[role] for role in constants if role in roles], streams)
        found = check_sensors(
            section.measurements, section.command, is_imu_stated=is_imu_stated, force_mps2=force_norm_mps2
        )
        section = exclude_sensors(section, found.values(), streams)
        doubt = check_ground_velocity(section.measurements)
        judged[place] = exclude_sensors(section, [] if doubt is None else [doubt], streams)
        constants = {role: each for role, each in found.items() if each.code in CONSTANT_FAULTS} | constants
    if not any(section.measurements.gnss for section in judged):
        judged = [replace(section, datum_deg_m=None) for section in judged]
    return [_define_base_by_antenna(section, streams) for section in judged]


def exclude_sensors(section: Section, exclusions: Iterable[SensorExclusion], streams: Streams) -> Section:
    """Return a section without the given sensors, with their findings."""
    excluded = {**section.excluded, **{each.role: _find_exclusion(each, section, streams) for each in exclusions}}
    # The receiver's velocity needs the antenna position of the fixes.
    removed = dict.fromkeys((*excluded, DOPPLER) if GNSS in excluded else excluded)
    return replace(
        section,
        datum_deg_m=None if GNSS in excluded else section.datum_deg_m,
        measurements=section.measurements.replace_sensors(removed),
        excluded=excluded,
    )


def _define_base_by_antenna(section: Section, streams: Streams) -> Section:
    """Return a section with base_link near the antenna, if its lever arm is unknown and it is fused alone."""
    m = section.measurements
    if m.gnss is None or not m.is_antenna_alone or streams.sensors[GNSS].placed_by != "assumed":
        return section
    found = make_finding("track-of-antenna", Subject("role", GNSS))
    gnss = replace(m.gnss, lever_arm_std_m=NO_LEVER_ARM)
    return replace(section, measurements=m.replace_sensors({GNSS: gnss}), findings=(*section.findings, found))


def _find_exclusion(exclusion: SensorExclusion, section: Section, streams: Streams) -> Finding:
    """Return the finding of a sensor that is not fused; without a receiver's velocity all labels remain usable."""
    sensor, name = streams.sensors[exclusion.role], exclusion.role
    if exclusion.units is not None:
        remedies = suggest("state_units", {"read": {"imu_units": exclusion.units}})
    elif exclusion.turned_by is not None:
        remedies = state_extrinsics(name, sensor.xyz_m, exclusion.turned_by @ matrix_from_quat(sensor.quat_xyzw))
    elif exclusion.scale is not None:
        stated = (streams.report.facts.odometry_scale or {}).get(name, 1.0)
        remedies = suggest("state_scale", {"read.odometry_scale": {name: round(stated / exclusion.scale, 4)}})
    else:
        remedies = exclude_role(name)
    stamp_ns = section.measurements.sensors()[name].stamp_ns
    return make_finding(
        exclusion.code,
        Subject("role", name),
        span_s=find_span_s(int(stamp_ns[0]), int(stamp_ns[-1]), streams),
        action="excluded",
        severity="note" if exclusion.role == DOPPLER else None,
        names={"topic": sensor.topic, "placed_by": sensor.placed_by, **exclusion.names},
        remedies=remedies,
        **exclusion.numbers,
    )


def exclude_role(name: str) -> tuple[Remedy, ...]:
    """Return the remedy that excludes a role, for any topic and any source of the choice."""
    return suggest("exclude", {"read.topics": {name: []}})


def state_extrinsics(name: str, xyz_m: Sequence[float], turn: Floats) -> tuple[Remedy, ...]:
    """Return the remedy that states a sensor's lever arm [m] and its rotation to base_link, shape (3, 3)."""
    place, rpy_rad = (np.round(values, digits) + 0.0 for values, digits in ((xyz_m, 3), (rpy_from_matrix(turn), 4)))
    return suggest(
        "state_extrinsics", {"read.extrinsics": {name: {"xyz_m": place.tolist(), "rpy_rad": rpy_rad.tolist()}}}
    )
