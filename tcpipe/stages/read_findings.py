"""What reading noticed: a warning where a person should look, and the facts of every role for the manifest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from tcpipe.logs.clocks import ON_SIMULATED_CLOCK, Settled, Timeline
from tcpipe.logs.roles import RoleAssignment
from tcpipe.power.readings import PowerReadings
from tcpipe.stages.read_sources import TopicReadings
from tcpipe.tables.facts import PowerSign, RobotChoice, RoleFacts, RunFacts, TopicClock, TopicFacts
from tcpipe.tables.findings import StageReport
from tcpipe.tables.levels import Sensor

_MANY_DROPPED = 0.01


def read_findings(
    assignment: RoleAssignment,
    sources: Sequence[TopicReadings],
    clocks: Settled,
    *,
    power: PowerReadings,
    sensors: Mapping[str, Sensor],
    offset_s: Mapping[str, float],
) -> StageReport[RunFacts]:
    """Return the warnings and facts of a read log; ``offset_s`` [s] is what the recipe adds to a role's stamps."""
    timelines, steps = clocks.timelines, clocks.steps
    simulated = clocks.simulated.remark() if clocks.simulated else None
    warnings = [*assignment.warnings, *([simulated] if simulated else []), *power.warnings]
    for source in sources:
        warnings += _warnings(source, timelines.get(source.key))
    warnings += [
        f"clock: header minus log time steps by {step.step_s:+.3f} s at log time {step.log_time_ns} ns on {', '.join(step.topics)}: "
        "a new epoch begins there, and nothing is integrated across it"
        for step in steps
    ]
    facts = RunFacts(
        robot=RobotChoice(assignment.robot, assignment.robot_why),
        roles={role: _role_facts(role, assignment, sources, timelines, sensors[role]) for role in sensors},
        left_out=assignment.left_out,
        epochs=len(steps) + 1,
        clock_steps=tuple(steps),
        time_offset_s=offset_s,
        power=None if power.current_sign is None else PowerSign(power.current_sign, power.averaged, power.includes),
    )
    return StageReport(tuple(dict.fromkeys(warnings)), facts)


def _warnings(source: TopicReadings, timeline: Timeline | None) -> Iterable[str]:
    name = f"{source.role}: {source.topic}"
    rows = source.messages
    yield from (f"{name}: {text}" for text in source.readings.warnings)
    dropped = source.readings.dropped | (timeline.dropped if timeline is not None else {})
    unexpected = {reason: count for reason, count in dropped.items() if reason not in {"not_gga", "no_velocity"}}
    if sum(unexpected.values()) > _MANY_DROPPED * rows:
        counts = ", ".join(f"{reason} {count}" for reason, count in unexpected.items())
        lost = f"{name}: {sum(unexpected.values())} of {rows} messages are not used ({counts})"
        nowhere = source.role == "gnss" and not len(source.readings.row)
        yield lost + (": the track lies in a local frame and cannot be placed on a map" if nowhere else "")
    if timeline is None:
        return
    simulated = timeline.why.endswith(ON_SIMULATED_CLOCK) and any(timeline.moved_s)
    if timeline.source == "log" and (simulated or source.readings.header_ns is not None):
        yield f"{name}: log time rules, since {timeline.why}"
    if timeline.notes.get("stamps_replaced"):
        count = timeline.notes["stamps_replaced"]
        yield f"{name}: {count} header stamps are unset or wrong and were taken from the log time"
    for epoch, moved_s in enumerate(timeline.moved_s):
        if moved_s and not simulated:
            yield (
                f"{name}: its clock is not the other topics': its stamps were moved by {moved_s:+.3f} s in epoch {epoch}"
            )


def _role_facts(
    role: str,
    assignment: RoleAssignment,
    sources: Sequence[TopicReadings],
    timelines: Mapping[str, Timeline],
    sensor: Sensor,
) -> RoleFacts:
    played = [source for source in sources if source.role == role and source.key in timelines]
    topics = {source.topic: _topic_facts(source, timelines[source.key]) for source in played}
    return RoleFacts(assignment.roles[role].why, sensor.frame_id, sensor.placed_by, topics)


def _topic_facts(source: TopicReadings, timeline: Timeline) -> TopicFacts:
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
    period_ns = np.diff(timeline.stamp_ns)[np.diff(timeline.epoch) == 0]
    return 1e9 / float(np.median(period_ns)) if len(period_ns) else None
