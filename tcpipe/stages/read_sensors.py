"""Where each stream's sensor sits: from the recipe, from static transforms, or assumed, with a finding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import get_args

import pyarrow as pa

from tcpipe.geometry.rotation import quat_from_rpy
from tcpipe.logs.clocks import Timeline
from tcpipe.logs.extrinsics import IDENTITY, Pose, Tree, build_static_tree, find_base_link_from, is_base
from tcpipe.logs.roles import RoleAssignment
from tcpipe.recipe import Extrinsics, ReadConfig, Role
from tcpipe.recipe.suggestions import suggest
from tcpipe.stages.message_arrays import read_transforms
from tcpipe.stages.protocols import LogReader
from tcpipe.stages.read_sources import TopicReadings
from tcpipe.tables.findings import Finding, Subject, make_finding
from tcpipe.tables.levels import Sensor

_WITHOUT_PLACE = ("power", "command", "gnss_velocity")
"""A receiver's velocity is that of its antenna, which the fixes place."""


def place_sensors(
    log: LogReader,
    tables: Mapping[str, pa.Table],
    assignment: RoleAssignment,
    sources: Sequence[TopicReadings],
    timelines: Mapping[str, Timeline],
    *,
    config: ReadConfig,
) -> tuple[dict[str, Sensor], list[Finding]]:
    """Return each role's sensor, and findings: frames that nothing places, topics with several frames.

    /tf is read only where /tf_static leaves a frame unplaced: it is large, and constant only in logs that lack the other.
    """
    of_role = {role: [source for source in sources if source.role == role] for role in get_args(Role)}
    frame_of = {role: _find_frame(found) for role, found in of_role.items() if found}
    open_frames = {
        frame
        for role, frame in frame_of.items()
        if role not in config.extrinsics and role not in _WITHOUT_PLACE and not is_base(frame)
    }
    tree = _build_tree(log, tables, assignment, open_frames)
    sensors: dict[str, Sensor] = {}
    findings: list[Finding] = []
    for role, frame in frame_of.items():
        pose, placed_by = _place(role, frame, tree, config)
        subject, several = Subject("role", role), of_role[role][0].frames
        if role not in _WITHOUT_PLACE and len(several) > 1:
            names = {"frame": frame, "frames": ", ".join(several)}
            findings.append(make_finding("several-frames", subject, names=names, frames_count=len(several)))
        if placed_by == "assumed":
            names = {"frame": frame or "an unnamed frame", "topic": of_role[role][0].topic}
            remedies = suggest("place", {"read.extrinsics": {role: asdict(Extrinsics())}})
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


def _find_frame(sources: Sequence[TopicReadings]) -> str:
    return next(iter(sources[0].frames), "")


def _build_tree(
    log: LogReader, tables: Mapping[str, pa.Table], assignment: RoleAssignment, open_frames: set[str]
) -> Tree:
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
