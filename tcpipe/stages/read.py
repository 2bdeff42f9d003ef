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
from tcpipe.logs.roles import MOTION_ROLES, assign_roles
from tcpipe.logs.simulated_clock import CLOCK
from tcpipe.power.readings import PowerReadings
from tcpipe.recipe import ReadConfig
from tcpipe.robots.profiles import Profiles
from tcpipe.stages.protocols import LogReader
from tcpipe.stages.read_averaging import with_averaging
from tcpipe.stages.read_findings import read_findings
from tcpipe.stages.read_power import currents_of
from tcpipe.stages.read_sensors import place_sensors
from tcpipe.stages.read_sources import TopicReadings, read_sources
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
    topics, namespace = log.topics.values(), config.namespace
    assignment = assign_roles(topics, config.topics, config.ignore_topics, robot, known=known, namespace=namespace)
    if assignment.problems:
        raise RoleError(*assignment.problems)
    # 2. Messages to SI columns; what cannot be used is counted.
    played = [topic for role in assignment.roles.values() for topic in role.topics]
    tables = log.tables([*played, *assignment.static_transforms])
    every, power, unread = read_sources(tables, log.topics, assignment, config, known=known)
    # 3. Every stamp on one clock, every epoch common to all.
    clocks = settle_clocks(
        {source.topic: _times(source, config) for source in every if len(source.readings.row)},
        clock_published=any(topic.type_name == CLOCK and topic.message_count for topic in topics),
    )
    timelines = clocks.timelines
    # 4. One checked table a role, and where its sensor sits.
    sources = [source for source in every if source.topic in timelines]
    streams: dict[str, pa.Table] = {
        role: _table(role, sources, timelines, power) for role in dict.fromkeys(source.role for source in sources)
    }
    sensors, unplaced = place_sensors(log, tables, assignment, sources, timelines, config=config)
    offset_s = {str(role): offset for role, offset in config.time_offset_s.items()}
    power, asked = with_averaging(power, streams, config)
    findings = read_findings(assignment, every, clocks, power=power, sensors=sensors, offset_s=offset_s)
    scale = {str(role): factor for role, factor in config.odometry_scale.items()} or None
    facts = replace(findings.facts, odometry_scale=scale)
    findings = replace(findings, warnings=(*findings.warnings, *unread, *unplaced, *asked), facts=facts)
    if not any(role in streams for role in MOTION_ROLES):
        what = "nothing in the log tells motion: wheel_odometry, visual_odometry and gnss have no usable row"
        raise RoleError(what, *findings.warnings)
    return Streams(streams, sensors, assignment.robot, config.gnss_crs, power.averaged, findings)


def _times(source: TopicReadings, config: ReadConfig) -> TopicTimes:
    readings = source.readings
    prefer = config.time.get(source.role, "auto")
    stamps = readings.header_ns if readings.own_time_ns is None or prefer == "header" else readings.own_time_ns
    return TopicTimes(
        readings.log_time_ns,
        stamps,
        np.stack([values.astype(np.float64) for values in readings.columns.values()], -1),
        prefer,
        round(config.time_offset_s.get(source.role, 0.0) * 1e9),
    )


def _table(
    role: str, sources: Sequence[TopicReadings], timelines: Mapping[str, Timeline], power: PowerReadings
) -> pa.Table:
    """Return a role's table, sorted by epoch and stamp."""
    parts = []
    for source in sources:
        if source.role == role:
            parts += list(_parts(source, timelines[source.topic], power))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.lexsort((columns["stamp_ns"], columns["epoch"]))
    return STREAMS[role].table(**{name: values[order] for name, values in columns.items()})


def _parts(source: TopicReadings, timeline: Timeline, power: PowerReadings) -> list[dict[str, NDArray[Any]]]:
    """Return a topic's columns; one part a rail where it plays power."""
    columns = {name: values[timeline.row] for name, values in source.readings.columns.items()}
    times: dict[str, NDArray[Any]] = {
        "stamp_ns": timeline.stamp_ns,
        "log_time_ns": source.readings.log_time_ns[timeline.row],
        "epoch": timeline.epoch,
    }
    if source.role != "power":
        return [times | columns]
    parts = []
    for rail in power.rails[source.topic]:
        voltage, current = currents_of(rail, times, columns)
        known = np.isfinite(voltage) | np.isfinite(current)
        values = {**times, "rail": np.full(len(known), rail.name), "voltage_volt": voltage, "current_amp": current}
        parts.append({name: value[known] for name, value in values.items()})
    return parts
