"""The topics that are used as a role: their messages as arrays, usable readings, and the extrinsics of their sensors.

A sensor's extrinsics come from the recipe or from static transforms, or are assumed, with a finding. Another program's
pose (SLAM, post-processing) gets longitude and latitude if the recipe states its CRS; it is used as GNSS.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast, get_args

import numpy as np
import pyarrow as pa

from tcpipe.arrays import Columns
from tcpipe.errors import MapError, RecipeError, RoleError
from tcpipe.geometry.rotation import quat_from_rpy
from tcpipe.logs.clocks import TopicTimeline
from tcpipe.logs.expressions import UNITS
from tcpipe.logs.extrinsics import IDENTITY, Pose, Tree, build_static_tree, find_base_link_from, is_base
from tcpipe.logs.field_mapping import MAPPED_TYPES, make_mapped_message
from tcpipe.logs.messages import (
    LOG_TIME,
    Arrays,
    Readings,
    count_frames,
    find_utc_offset,
    read_messages,
    select_ground_velocity,
)
from tcpipe.logs.roles import RoleAssignment
from tcpipe.logs.topics import Topic, make_topic_not_decoded
from tcpipe.power.readings import PowerReadings
from tcpipe.recipe import ReadConfig, Role
from tcpipe.recipe.suggestions import make_place_to_measure, suggest
from tcpipe.robots import Profiles
from tcpipe.stages.message_arrays import LogReader, read_transforms
from tcpipe.stages.read_power import list_second_meters, read_power_of_topics, select_power_rows
from tcpipe.tables.columns import Tables, to_floats
from tcpipe.tables.findings import Finding, Findings, Subject, make_finding
from tcpipe.tables.levels import STREAMS, Sensor


@dataclass(frozen=True, slots=True)
class TopicReadings:
    """A topic that is used as a role: its number of messages, the frames that they name, and usable readings."""

    topic: str
    role: Role
    type_name: str
    messages: int
    frames: Mapping[str, int]
    readings: Readings

    @property
    def key(self) -> str:
        """Identity of the source: one topic may contain positions and velocities."""
        return f"{self.topic} ({self.role})" if self.role == "gnss_velocity" else self.topic


def read_sources(
    messages: dict[str, Arrays],
    topics: Mapping[str, Topic],
    assignment: RoleAssignment,
    config: ReadConfig,
    *,
    known: Profiles,
) -> tuple[list[TopicReadings], PowerReadings, list[Finding]]:
    """Return one `TopicReadings` a topic by role order, the power rails, and findings on topics not decoded.

    Messages are removed from ``messages`` once read, so that no log is in memory twice.

    Raises `RoleError`: ``read.fields`` names fields that the messages lack.
    """
    played = [(cast("Role", role.name), topic) for role in assignment.roles.values() for topic in role.topics]
    findings: list[Finding] = []
    arrays: dict[tuple[Role, str], Columns] = {}
    for role, topic in played:
        if topic not in messages:
            findings.append(make_topic_not_decoded(topics[topic]))
            continue
        arrays[role, topic] = _read_fields(messages[topic], role, config)
    types = {topic: topics[topic].type_name for _, topic in arrays}
    of_power = {topic: (types[topic], columns) for (role, topic), columns in arrays.items() if role == "power"}
    second = [topic for topic in list_second_meters(assignment, topics, config, known) if topic in messages]
    meters = {topic: (topics[topic].type_name, messages[topic]) for topic in second}
    power = read_power_of_topics(of_power, assignment, config, known=known, meters=meters)
    sources = []
    messages.clear()
    for role, topic in list(arrays):
        columns = arrays.pop((role, topic))
        if role != "power":
            std_m = cast("dict[str, float]", config.fix_std_m)
            try:
                readings = read_messages(
                    columns,
                    role,
                    (MAPPED_TYPES[role] if role in config.fields else (topics[topic]).type_name),
                    fix_std_m=std_m,
                )
            except KeyError as error:
                names = {"role": role, "fields": str(error.args[0])}
                findings.append(make_finding("fields-missing", Subject("topic", topic), names=names))
                continue
        elif topic in power.rails:
            readings = select_power_rows(columns, power.rails[topic])
        else:
            continue
        seen_frames = count_frames(columns, types[topic])
        source = TopicReadings(topic, role, types[topic], len(columns[LOG_TIME]), seen_frames, readings)
        sources.append(replace(source, readings=_apply_recipe(source, config)))
    return _join_topics(sources, config, findings), power, findings


def _join_topics(sources: Sequence[TopicReadings], config: ReadConfig, findings: list[Finding]) -> list[TopicReadings]:
    """Return the first topic of each role, with data of others in its frame while earlier topics have no messages.

    A role has one frame and one set of extrinsics. Findings are added on topics that are unused, or used in part.
    """
    joined: dict[Role, list[TopicReadings]] = {}
    for source in sources:
        before, role, subject = joined.setdefault(source.role, []), source.role, Subject("topic", source.topic)
        if role == "power" or not before:
            before.append(source)
        elif role not in (*_WITHOUT_PLACE, *config.extrinsics) and [*source.frames][:1] != [*before[0].frames][:1]:
            names = {"role": role, "reason": "another-frame"}
            findings.append(make_finding("topic-left-out", subject, names=names))
        else:
            at_ns = source.readings.log_time_ns
            overlaps = np.zeros(len(at_ns), bool)
            for used_ns in [other.readings.log_time_ns for other in before if len(other.readings.row)]:
                overlaps |= (used_ns[0] <= at_ns) & (at_ns <= used_ns[-1])
            if count := int(overlaps.sum()):
                names = {"role": role, "used": before[0].topic}
                remedies = suggest("use", {"read.topics": {role: [source.topic]}})
                found = make_finding("topic-overlaps", subject, names=names, remedies=remedies, overlapping_count=count)
                findings.append(found)
            before.append(replace(source, readings=source.readings.select(~overlaps)))
    return [source for topics in joined.values() for source in topics]


def _apply_recipe(source: TopicReadings, config: ReadConfig) -> Readings:
    """Return a topic's readings in the units and scale that the recipe states."""
    readings, role = source.readings, source.role
    if role == "gnss" and config.time_source.get(role) != "header":
        return replace(readings, findings=(*readings.findings, *find_utc_offset(readings)))
    if role == "imu":
        return convert_imu_to_si(readings, config.imu_units)
    if role == "gnss_velocity" and role not in config.topics:
        return select_ground_velocity(readings, next(iter(source.frames), ""), source.topic)
    return scale_odometry(readings, config.odometry_scale[role]) if role in config.odometry_scale else readings


_DEG, _G = UNITS["rad/s"]["deg/s"], UNITS["m/s2"]["g"]
_FACTORS = {"si": (1.0, 1.0), "deg": (_DEG, 1.0), "g": (1.0, _G), "deg_g": (_DEG, _G)}


def convert_imu_to_si(readings: Readings, units: str) -> Readings:
    """Return an IMU's readings in rad/s and m/s², variances included.

    ``units`` is the recipe's ``imu_units``: si, deg (deg/s and m/s²), g (rad/s and g) or deg_g (deg/s and g).
    """
    rate, force = _FACTORS[units]
    columns = dict(readings.columns)
    for prefix, factor in (("angular_velocity_", rate), ("linear_acceleration_", force)):
        for name in [name for name in columns if name.startswith(prefix)]:
            columns[name] = columns[name] * (factor**2 if name.endswith("_var") else factor)
    return replace(readings, columns=columns)


_LENGTHS = {"velocity_": 1, "velocity_var_": 2, "x_m": 1, "y_m": 1, "z_m": 1}
"""Columns of an odometry (or their prefixes) that contain lengths, with the exponent of the length."""


def scale_odometry(readings: Readings, factor: float) -> Readings:
    """Return an odometry's readings with all lengths times ``factor``, variances included; turns stay."""
    columns = dict(readings.columns)
    for name, values in readings.columns.items():
        powers = [power for prefix, power in _LENGTHS.items() if name.startswith(prefix)]
        if powers:
            columns[name] = values * factor ** max(powers)
    return replace(readings, columns=columns)


def _read_fields(columns: Arrays, role: Role, config: ReadConfig) -> Arrays:
    """Return the fields of a topic's messages, those of a message type of the user's own as the recipe maps them."""
    if role not in config.fields:
        return columns
    mapped = make_mapped_message(role, columns, config.fields[role])
    if isinstance(mapped, list):
        raise RoleError(*mapped)
    return mapped


_WITHOUT_PLACE = ("power", "command", "gnss_velocity")
"""Roles without extrinsics of their own; a receiver's velocity has those of its fixes."""


def place_sensors(
    log: LogReader,
    tables: Tables,
    assignment: RoleAssignment,
    sources: Sequence[TopicReadings],
    timelines: Mapping[str, TopicTimeline],
    *,
    config: ReadConfig,
) -> tuple[dict[str, Sensor], list[Finding]]:
    """Return each role's sensor, and findings: frames without extrinsics, topics with several frames."""
    of_role = {role: [source for source in sources if source.role == role] for role in get_args(Role)}
    frame_of = {role: next(iter(found[0].frames), "") for role, found in of_role.items() if found}
    sensors: dict[str, Sensor] = {}
    findings: list[Finding] = []
    for role, (pose, placed_by) in place_frames(log, tables, assignment, frame_of, config).items():
        frame = frame_of[role]
        subject, several = Subject("role", role), of_role[role][0].frames
        if role not in _WITHOUT_PLACE and len(several) > 1:
            names = {"frame": frame, "frames": ", ".join(several)}
            findings.append(make_finding("several-frames", subject, names=names, frames_count=len(several)))
        if placed_by == "assumed":
            names = {"frame": frame or "the sensor", "topic": of_role[role][0].topic}
            remedies = suggest("place", {"read.extrinsics": {role: make_place_to_measure(role)}})
            findings.append(make_finding("sensor-not-placed", subject, names=names, remedies=remedies))
        sensors[role] = Sensor(
            topic=" + ".join(source.topic for source in of_role[role]),
            type_name=of_role[role][0].type_name,
            frame_id=frame,
            why=assignment.roles[role].why,
            xyz_m=(float(pose.xyz_m[0]), float(pose.xyz_m[1]), float(pose.xyz_m[2])),
            quat_xyzw=tuple(float(component) for component in pose.quat_xyzw),  # type: ignore[arg-type]
            placed_by=placed_by,
            time_source=timelines[of_role[role][0].key].source,
        )
    return sensors, findings


def place_frames(
    log: LogReader,
    tables: Tables,
    assignment: RoleAssignment,
    frame_of: Mapping[Role, str],
    config: ReadConfig,
) -> dict[Role, tuple[Pose, str]]:
    """Return by role its frame's pose in base_link, and the source.

    /tf is read only if /tf_static lacks a frame: it is large, and constant only in logs without /tf_static.
    """
    open_frames = {
        frame
        for role, frame in frame_of.items()
        if role not in config.extrinsics and role not in _WITHOUT_PLACE and not is_base(frame)
    }
    tree = _build_tree(log, tables, assignment, open_frames)
    return {role: _place(role, frame, tree, config) for role, frame in frame_of.items()}


def _build_tree(log: LogReader, tables: Tables, assignment: RoleAssignment, open_frames: set[str]) -> Tree:
    static = [read_transforms(tables[topic]) for topic in assignment.transforms if topic in tables]
    tree = build_static_tree(static)
    moving = [topic for topic in assignment.transforms if topic not in tables]
    if moving and any(find_base_link_from(frame, tree) is None for frame in open_frames):
        tree = build_static_tree([*static, *(read_transforms(table) for table in log.tables(moving).values())])
    return tree


def _place(role: Role, frame: str, tree: Tree, config: ReadConfig) -> tuple[Pose, str]:
    if role in config.extrinsics:
        given = config.extrinsics[role]
        return Pose(IDENTITY.xyz_m + given.xyz_m, quat_from_rpy(*given.rpy_rad)), "recipe"
    if role in _WITHOUT_PLACE:
        return IDENTITY, "not needed"
    found = find_base_link_from(frame, tree)
    if frame.rsplit("/", 1)[-1] == "base_link":
        return IDENTITY, "same frame"
    if found is not None and frame in tree:
        return found, "tf_static"
    return IDENTITY, "same frame" if is_base(frame) else "assumed"


_POSE = "pose"
_POSE_ROLE = Subject("role", _POSE)


def place_pose(
    streams: Tables, assignment: RoleAssignment, config: ReadConfig
) -> tuple[dict[str, pa.Table], str, Findings]:
    """Return the streams with the pose in longitude and latitude, the CRS of these, and findings.

    The CRS is that of ``read.pose_crs``, or ``read.gnss_crs`` if the former states its own datum shift.

    Raises `RecipeError`: `read.pose_crs` is no projected CRS.
    """
    if _POSE not in streams:
        return dict(streams), config.gnss_crs, ()
    found = make_finding("pose-used-as-gnss", _POSE_ROLE, names={"topic": assignment.roles[_POSE].topics[0]})
    if config.pose_crs is None:
        return dict(streams), config.gnss_crs, (found, make_finding("pose-not-georeferenced", _POSE_ROLE))
    from pyproj import CRS, Transformer  # noqa: PLC0415  only where a pose is placed

    from tcpipe.terrain.projection import format_crs, parse_crs  # noqa: PLC0415

    try:
        crs = parse_crs(config.pose_crs, where="recipe read.pose_crs")
        geographic = parse_crs(config.gnss_crs, where="recipe read.gnss_crs")
    except MapError as error:
        raise RecipeError(*error.problems) from None
    if not crs.is_projected or crs.geodetic_crs is None:
        raise RecipeError(f"recipe read.pose_crs: {crs.name} is not projected (metres); use degrees as gnss")
    if not crs.is_bound:
        geographic = CRS(crs.geodetic_crs).to_2d()
    pose = streams[_POSE]
    lon, lat = Transformer.from_crs(crs, geographic, always_xy=True).transform(
        to_floats(pose, "x_m"), to_floats(pose, "y_m")
    )
    columns = {name: pose[name] for name in pose.column_names} | {"lon_deg": lon, "lat_deg": lat, "alt_m": pose["z_m"]}
    return {**streams, _POSE: STREAMS[_POSE].table(**columns)}, format_crs(geographic), (found,)
