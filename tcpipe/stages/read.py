"""Read a log into one table per role, in SI units, on one clock, with the extrinsics of every sensor (L0 to L1)."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast, get_args

import numpy as np
import pyarrow as pa

from tcpipe.errors import RoleError
from tcpipe.logs.clocks import CLOCK, LOG_CLOCK, RECIPE, AlignedClocks, TopicTimeline, TopicTimes, settle_clocks
from tcpipe.logs.field_mapping import find_topic
from tcpipe.logs.messages import Arrays
from tcpipe.logs.roles import MOTION_ROLES, RoleAssignment, assign_roles
from tcpipe.logs.topics import Topic, find_missing_roles
from tcpipe.power.readings import PowerReadings
from tcpipe.power.sources import list_power_lists
from tcpipe.recipe import ReadConfig, Recipe, Role
from tcpipe.robots import Profiles
from tcpipe.stages.message_arrays import LogReader, gather_messages
from tcpipe.stages.proposals import find_proposals
from tcpipe.stages.read_power import (
    add_averaging,
    add_side_share,
    find_repeats,
    list_second_meters,
    read_rail_power,
    remove_repeats,
)
from tcpipe.stages.read_sources import TopicReadings, place_pose, place_sensors, read_sources
from tcpipe.tables.facts import StageFacts, TopicClock, TopicFacts
from tcpipe.tables.findings import Finding, Severity, StageReport, Subject, make_finding, read_threshold
from tcpipe.tables.levels import STREAMS, Sensor, Streams


def find_read_config(recipe: Recipe, topics: Collection[str]) -> ReadConfig:
    """Return the configuration for a log of these topics: its mapped tables are used as their roles."""
    roles: dict[Role, list[str]] = {}
    for name, table in recipe.tables.items():
        role = cast("Role", table.role or name)
        columns, power = table.columns, table.make_power_source(name)
        if (
            role in get_args(Role)
            and (topic := find_topic(name, role, columns, power.type if power else None)[0]) in topics
        ):
            roles.setdefault(role, []).append(topic)
    return replace(recipe.read, topics={**roles, **recipe.read.topics}) if roles else recipe.read


def decide_roles(config: ReadConfig, topics: Iterable[Topic], robot: str | None, *, known: Profiles) -> RoleAssignment:
    """Return which topic is used as which role, and why; `RecipeError` if no profile has the robot's name."""
    assignment = assign_roles(
        topics,
        config.topics,
        config.ignore_topics,
        robot,
        known=known,
        namespace=config.namespace,
        mapped=config.fields,
        pose_sources=config.pose_sources,
    )
    if assignment.problems:
        return assignment
    # An offset belongs to one wrong clock: without effect, the recipe is for another log. Other keys describe the
    # robot, and are valid for logs without that sensor, too.
    there = ", ".join(assignment.roles)
    problems = tuple(
        f"recipe read.time_offset_s.{role}: no topic of this log is used as {role}, so it has no effect; "
        f"roles in the log: {there}"
        for role in config.time_offset_s
        if role not in assignment.roles
    )
    unused = (
        make_finding("recipe-key-unused", Subject("role", role), names={"key": f"read.{key}.{role}"})
        for key in ("extrinsics", "odometry_scale", "time_source")
        for role in getattr(config, key)
        if role not in assignment.roles
    )
    return replace(assignment, problems=problems, findings=(*assignment.findings, *unused))


def read_run(log: LogReader, config: ReadConfig, *, robot: str | None, known: Profiles) -> Streams:
    """Return the streams of a log; without a ``robot`` its profile is found by message types and topic names.

    `RoleError`: a role cannot be decided, or no topic measures motion; `RecipeError`: no profile has the robot's name.
    """
    # 1. Decide which topic is used as which role, from the topic list alone.
    assignment = decide_roles(config, log.topics.values(), robot, known=known)
    if assignment.problems:
        proposals = find_proposals(log, assignment, config, known)
        raise RoleError(*assignment.problems, findings=(*assignment.findings, *proposals))
    # 2. Convert messages to SI columns, and count unusable ones.
    played = dict.fromkeys(topic for role in assignment.roles.values() for topic in role.topics)
    played |= dict.fromkeys(list_second_meters(assignment, log.topics, config, known))
    lists = {topic: list_power_lists(log.topics[topic].type_name, known.power_sources) for topic in played}
    messages, tables = gather_messages(log.batches([*played, *assignment.static_transforms]), lists)
    every, power, unread = read_sources(messages, log.topics, assignment, config, known=known)
    # 3. Bring all stamps to one clock with common epochs.
    clocks = settle_clocks(
        {source.key: _read_times(source, config) for source in every if len(source.readings.row)},
        clock_published=any(topic.type_name == CLOCK and topic.message_count for topic in log.topics.values()),
    )
    timelines = clocks.timelines
    # 4. Make one checked table per role, with the extrinsics of its sensor.
    sources = [source for source in every if source.key in timelines]
    streams: dict[str, pa.Table] = {
        role: make_role_table(role, sources, timelines, power)
        for role in dict.fromkeys(source.role for source in sources)
    }
    streams, repeats = remove_repeats(streams)
    streams, crs, of_pose = place_pose(streams, assignment, config)
    sensors, unplaced = place_sensors(log, tables, assignment, sources, timelines, config=config)
    power, assumed = add_averaging(add_side_share(power, streams), streams, config)
    offset_s = {str(role): offset for role, offset in config.time_offset_s.items()}
    report = make_read_report(assignment, every, clocks, power=power, sensors=sensors, offset_s=offset_s)
    scale = {str(role): factor for role, factor in config.odometry_scale.items()} or None
    findings = (
        *report.findings,
        *find_missing_roles({*streams, "power"} if power.is_rejected else streams.keys()),
        *find_proposals(log, assignment, config, known),
        *unread,
        *unplaced,
        *find_repeats(repeats),
        *assumed,
        *of_pose,
    )
    report = StageReport(tuple(dict.fromkeys(findings)), replace(report.facts, odometry_scale=scale))
    if not any(role in streams for role in MOTION_ROLES):
        what = "no motion in the log: wheel_odometry, visual_odometry, gnss and pose have no usable rows"
        raise RoleError(what, findings=report.findings)
    return Streams(streams, sensors, assignment.robot, crs, power.facts is not None and power.facts.averaged, report)


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
    role: str, sources: Sequence[TopicReadings], timelines: Mapping[str, TopicTimeline], power: PowerReadings
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


def _read_parts(source: TopicReadings, timeline: TopicTimeline, power: PowerReadings) -> list[Arrays]:
    """Return a topic's columns; one part a rail where it is used as power."""
    readings = source.readings.columns
    columns = {name: readings.pop(name)[timeline.row] for name in list(readings)}
    times: Arrays = {
        "stamp_ns": timeline.stamp_ns,
        "log_time_ns": source.readings.log_time_ns[timeline.row],
        "clock_epoch": timeline.clock_epoch,
    }
    if source.role != "power":
        return [times | columns]
    parts = []
    for rail in power.rails[source.topic]:
        voltage, current = read_rail_power(rail, times, columns)
        known, current = (
            np.isfinite(voltage) | np.isfinite(current),
            current - (power.facts.zero_amp if power.facts else 0.0),
        )
        values = {**times, "rail": np.full(len(known), rail.name), "voltage_volt": voltage, "current_amp": current}
        parts.append({name: value[known] for name, value in values.items()})
    return parts


_EXPECTED = frozenset({"not_gga", "no_velocity", "clock_set_back"})
"""Reasons why messages of a topic are of no use to a role: sentences of other kinds."""


def make_read_report(
    assignment: RoleAssignment,
    sources: Sequence[TopicReadings],
    clocks: AlignedClocks,
    *,
    power: PowerReadings,
    sensors: Mapping[str, Sensor],
    offset_s: Mapping[str, float],
) -> StageReport[StageFacts]:
    """Return the findings and facts of a read log; ``offset_s`` [s] is what the recipe adds to a role's stamps."""
    timelines, steps = clocks.timelines, clocks.steps
    findings = [*assignment.findings, *power.findings]
    findings += clocks.simulated.find_simulated_time() if clocks.simulated else ()
    for source in sources:
        findings += source.readings.findings
        findings += _find_unused(source, timelines.get(source.key))
        if source.key in timelines:
            findings += _find_clock(source, timelines[source.key], is_simulated=clocks.simulated is not None)
    start_ns = min((int(source.readings.log_time_ns[0]) for source in sources if len(source.readings.row)), default=0)
    for step in steps:
        at_s, names = (step.log_time_ns - start_ns) / 1e9, {"topics": ", ".join(step.topics) or "all topics"}
        span_s, step_s = (at_s, at_s), step.step_s
        findings.append(make_finding("clock-step", LOG_CLOCK, span_s=span_s, names=names, step_s=step_s, at_s=at_s))
    facts = StageFacts(
        roles={
            role: {
                source.topic: _make_topic_facts(source, timelines[source.key])
                for source in sources
                if source.role == role and source.key in timelines
            }
            for role in sensors
        },
        left_out=assignment.left_out,
        epochs=len(steps) + 1,
        clock_steps=tuple(steps),
        time_offset_s=offset_s,
        power=power.facts,
    )
    return StageReport(tuple(dict.fromkeys(findings)), facts)


def _find_unused(source: TopicReadings, timeline: TopicTimeline | None) -> Iterator[Finding]:
    """Yield the finding that many messages are not used; the numbers count them by reason."""
    dropped = source.readings.dropped | (timeline.dropped if timeline is not None else {})
    counts = {f"{reason}_count": count for reason, count in dropped.items() if reason not in _EXPECTED}
    unused, messages = sum(counts.values()), source.messages
    if unused > read_threshold("messages-unused", "min_unused_fraction") * messages:
        numbers: dict[str, Any] = {"unused_fraction": unused / messages, "messages_count": messages, **counts}
        names = {"topic": source.topic, "reasons": ", ".join(name.removesuffix("_count") for name in counts)}
        yield make_finding("messages-unused", Subject("role", source.role), names=names, **numbers)


def _find_clock(source: TopicReadings, timeline: TopicTimeline, *, is_simulated: bool) -> Iterator[Finding]:
    """Yield the findings on a topic's stamps: that log time is used, that some were replaced, that all were moved."""
    role, names = Subject("role", source.role), {"topic": source.topic}
    by_simulation = is_simulated and timeline.source == "log" and any(timeline.moved_s)
    if timeline.source == "log" and (by_simulation or source.readings.header_ns is not None):
        severity: Severity | None = "note" if timeline.why == RECIPE else None
        yield make_finding("log-time-used", role, severity=severity, names=names | {"reason": timeline.why})
    if count := timeline.notes.get("stamps_replaced"):
        yield make_finding("stamps-replaced", role, names=names, stamps_count=count)
    for epoch, moved_s in enumerate(timeline.moved_s):
        if moved_s and not by_simulation:
            yield make_finding("topic-clock-offset", role, names=names, moved_s=moved_s, clock_epoch=epoch)


def _make_topic_facts(source: TopicReadings, timeline: TopicTimeline) -> TopicFacts:
    period_ns = np.diff(timeline.stamp_ns)[np.diff(timeline.clock_epoch) == 0]
    return TopicFacts(
        type=source.type_name,
        messages=source.messages,
        rows=len(timeline.row),
        rate_hz=1e9 / float(np.median(period_ns)) if len(period_ns) else None,
        dropped=source.readings.dropped | timeline.dropped,
        notes={name: count for name, count in source.readings.notes.items() if count} | timeline.notes,
        time=TopicClock(timeline.source, timeline.why, timeline.offset_s, timeline.moved_s),
    )
