"""What reading observed: findings on roles, clocks and messages, and the facts of every role for the manifest."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tcpipe.logs.clocks import RECIPE, AlignedClocks, Timeline
from tcpipe.logs.roles import RoleAssignment
from tcpipe.logs.simulated_clock import LOG_CLOCK
from tcpipe.power.readings import PowerReadings
from tcpipe.stages.read_sources import TopicReadings
from tcpipe.tables.catalogue import Severity, read_threshold
from tcpipe.tables.facts import ClockStep, PowerSign, RobotChoice, RoleFacts, StageFacts, TopicClock, TopicFacts
from tcpipe.tables.findings import Finding, StageReport, Subject, make_finding
from tcpipe.tables.levels import Sensor

_EXPECTED = frozenset({"not_gga", "no_velocity"})
"""Reasons why messages of a topic are of no use to a role: sentences of other kinds."""


def read_findings(
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
    start_ns = min((int(of.readings.log_time_ns[0]) for of in sources if len(of.readings.row)), default=0)
    findings += [_find_step(step, start_ns) for step in steps]
    facts = StageFacts(
        robot=RobotChoice(assignment.robot, assignment.robot_why),
        roles={role: _make_role_facts(role, assignment, sources, timelines, sensors[role]) for role in sensors},
        left_out=assignment.left_out,
        epochs=len(steps) + 1,
        clock_steps=tuple(steps),
        time_offset_s=offset_s,
        power=None if power.current_sign is None else PowerSign(power.current_sign, power.averaged, power.other_loads),
    )
    return StageReport(tuple(dict.fromkeys(findings)), facts)


def _find_unused(source: TopicReadings, timeline: Timeline | None) -> Iterator[Finding]:
    """Yield the finding that many messages are not used; the numbers count them by reason."""
    dropped = source.readings.dropped | (timeline.dropped if timeline is not None else {})
    counts = {f"{reason}_count": count for reason, count in dropped.items() if reason not in _EXPECTED}
    unused, messages = sum(counts.values()), source.messages
    if unused > read_threshold("messages-unused", "min_unused_fraction") * messages:
        numbers: dict[str, Any] = {"unused_fraction": unused / messages, "messages_count": messages, **counts}
        names = {"topic": source.topic, "reasons": ", ".join(name.removesuffix("_count") for name in counts)}
        yield make_finding("messages-unused", Subject("role", source.role), names=names, **numbers)


def _find_clock(source: TopicReadings, timeline: Timeline, *, is_simulated: bool) -> Iterator[Finding]:
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


def _find_step(step: ClockStep, start_ns: int) -> Finding:
    at_s = (step.log_time_ns - start_ns) / 1e9
    names = {"topics": ", ".join(step.topics)}
    return make_finding("clock-step", LOG_CLOCK, span_s=(at_s, at_s), names=names, step_s=step.step_s, at_s=at_s)


def _make_role_facts(
    role: str,
    assignment: RoleAssignment,
    sources: Sequence[TopicReadings],
    timelines: Mapping[str, Timeline],
    sensor: Sensor,
) -> RoleFacts:
    played = [source for source in sources if source.role == role and source.key in timelines]
    topics = {source.topic: _make_topic_facts(source, timelines[source.key]) for source in played}
    return RoleFacts(assignment.roles[role].why, sensor.frame_id, sensor.placed_by, topics)


def _make_topic_facts(source: TopicReadings, timeline: Timeline) -> TopicFacts:
    return TopicFacts(
        type=source.type_name,
        messages=source.messages,
        rows=len(timeline.row),
        rate_hz=_rate_hz(timeline),
        dropped=source.readings.dropped | timeline.dropped,
        notes={name: count for name, count in source.readings.notes.items() if count} | timeline.notes,
        time=TopicClock(timeline.source, timeline.why, timeline.offset_s, timeline.moved_s),
    )


def _rate_hz(timeline: Timeline) -> float | None:
    """Return one over the median period inside epochs [Hz]."""
    period_ns = np.diff(timeline.stamp_ns)[np.diff(timeline.clock_epoch) == 0]
    return 1e9 / float(np.median(period_ns)) if len(period_ns) else None
