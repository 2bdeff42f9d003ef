"""Read: a log becomes one table a role, in SI units, on one clock, with every sensor's place (L0 to L1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import RoleError
from tcpipe.logs.clocks import Timeline, TopicTimes, settle_clocks
from tcpipe.logs.role_findings import find_missing_roles
from tcpipe.logs.roles import MOTION_ROLES
from tcpipe.logs.simulated_clock import CLOCK
from tcpipe.power.readings import PowerReadings
from tcpipe.power.sources import list_power_lists
from tcpipe.recipe import ReadConfig
from tcpipe.robots.profiles import Profiles
from tcpipe.stages.message_arrays import gather_messages
from tcpipe.stages.protocols import LogReader
from tcpipe.stages.read_findings import read_findings
from tcpipe.stages.read_pose import place_pose
from tcpipe.stages.read_power import add_averaging, find_repeats, read_rail_power, remove_repeats
from tcpipe.stages.read_roles import decide_roles, find_power_candidates
from tcpipe.stages.read_sensors import place_sensors
from tcpipe.stages.read_sources import TopicReadings, read_sources
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import STREAMS, Streams


def read_run(log: LogReader, config: ReadConfig, *, robot: str | None, known: Profiles) -> Streams:
    """Return the streams of a log.

    Parameters
    ----------
    log : the opened log.
    config : topics, placements, clocks and power, where the log does not say.
    robot : profile name; None finds it by message types and topic names.
    known : robots, and what message types tell of power.

    Raises
    ------
    RoleError : a role cannot be decided, or nothing in the log tells motion.
    RecipeError : no profile has the robot's name.
    """
    # 1. Which topic plays which role, from the topic list alone.
    assignment = decide_roles(config, log.topics.values(), robot, known=known)
    if assignment.problems:
        raise RoleError(*assignment.problems, findings=assignment.findings)
    # 2. Messages to SI columns; what cannot be used is counted.
    played = dict.fromkeys(topic for role in assignment.roles.values() for topic in role.topics)
    lists = {topic: list_power_lists(log.topics[topic].type_name, known.power_sources) for topic in played}
    messages, tables = gather_messages(log.batches([*played, *assignment.static_transforms]), lists)
    every, power, unread = read_sources(messages, log.topics, assignment, config, known=known)
    # 3. Every stamp on one clock, every epoch common to all.
    clocks = settle_clocks(
        {source.key: _read_times(source, config) for source in every if len(source.readings.row)},
        clock_published=any(topic.type_name == CLOCK and topic.message_count for topic in log.topics.values()),
    )
    timelines = clocks.timelines
    # 4. One checked table a role, and where its sensor sits.
    sources = [source for source in every if source.key in timelines]
    streams: dict[str, pa.Table] = {
        role: make_role_table(role, sources, timelines, power)
        for role in dict.fromkeys(source.role for source in sources)
    }
    streams, repeats = remove_repeats(streams)
    streams, crs, of_pose = place_pose(streams, assignment, config)
    sensors, unplaced = place_sensors(log, tables, assignment, sources, timelines, config=config)
    power, assumed = add_averaging(power, streams, config)
    offset_s = {str(role): offset for role, offset in config.time_offset_s.items()}
    report = read_findings(assignment, every, clocks, power=power, sensors=sensors, offset_s=offset_s)
    scale = {str(role): factor for role, factor in config.odometry_scale.items()} or None
    findings = (
        *report.findings,
        *find_missing_roles({*streams, "power"} if power.is_rejected else streams.keys()),
        *find_power_candidates(log, assignment, config),
        *unread,
        *unplaced,
        *find_repeats(repeats),
        *assumed,
        *of_pose,
    )
    report = StageReport(tuple(dict.fromkeys(findings)), replace(report.facts, odometry_scale=scale))
    if not any(role in streams for role in MOTION_ROLES):
        what = "nothing in the log tells motion: wheel_odometry, visual_odometry, gnss and pose have no usable row"
        raise RoleError(what, findings=report.findings)
    return Streams(streams, sensors, assignment.robot, crs, power.averaged, report)


def _read_times(source: TopicReadings, config: ReadConfig) -> TopicTimes:
    readings = source.readings
    prefer = config.time_source.get(source.role, "auto")
    stamps = readings.header_ns if readings.own_time_ns is None or prefer == "header" else readings.own_time_ns
    return TopicTimes(
        readings.log_time_ns,
        stamps,
        tuple(readings.columns.values()),
        prefer,
        round(config.time_offset_s.get(source.role, 0.0) * 1e9),
    )


def make_role_table(
    role: str, sources: Sequence[TopicReadings], timelines: Mapping[str, Timeline], power: PowerReadings
) -> pa.Table:
    """Return a role's table, sorted by epoch and stamp; the columns of its sources' readings are taken out."""
    parts = []
    for source in sources:
        if source.role == role:
            parts += list(_read_parts(source, timelines[source.key], power))
    if len(parts) == 1:  # in order already
        return STREAMS[role].table(**parts[0])
    columns = {name: np.concatenate([part.pop(name) for part in parts]) for name in list(parts[0])}
    order = np.lexsort((columns["stamp_ns"], columns["clock_epoch"]))
    return STREAMS[role].table(**{name: columns.pop(name)[order] for name in list(columns)})


def _read_parts(source: TopicReadings, timeline: Timeline, power: PowerReadings) -> list[dict[str, NDArray[Any]]]:
    """Return a topic's columns; one part a rail where it plays power."""
    readings = source.readings.columns
    columns = {name: readings.pop(name)[timeline.row] for name in list(readings)}
    times: dict[str, NDArray[Any]] = {
        "stamp_ns": timeline.stamp_ns,
        "log_time_ns": source.readings.log_time_ns[timeline.row],
        "clock_epoch": timeline.clock_epoch,
    }
    if source.role != "power":
        return [times | columns]
    parts = []
    for rail in power.rails[source.topic]:
        voltage, current = read_rail_power(rail, times, columns)
        known = np.isfinite(voltage) | np.isfinite(current)
        values = {**times, "rail": np.full(len(known), rail.name), "voltage_volt": voltage, "current_amp": current}
        parts.append({name: value[known] for name, value in values.items()})
    return parts
