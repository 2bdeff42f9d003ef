"""What a log holds: topics and roles from its index; with everything read, also gaps, clocks and damage, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tcpipe.formats.logs.log_file import Log
from tcpipe.formats.robot_files import profiles_of
from tcpipe.logs.clocks import settle_clocks
from tcpipe.logs.roles import assign_roles
from tcpipe.logs.simulated_clock import CLOCK, SIMULATED_NS
from tcpipe.logs.topics import Topic
from tcpipe.pipeline.log_stamps import TopicStamps
from tcpipe.recipe import Recipe


def inspect_log(log: Log, recipe: Recipe, robot: str | None, *, full: bool) -> dict[str, Any]:
    """Return what a log holds as JSON values.

    Parameters
    ----------
    full
        Read every message: counts, gaps, stamps, clock steps and damage, not the index alone.
    """
    config = recipe.read
    cast = assign_roles(
        log.topics.values(),
        config.topics,
        config.ignore_topics,
        robot,
        known=profiles_of(recipe),
        namespace=config.namespace,
    )
    playing = {topic: (name, role.why) for name, role in cast.roles.items() for topic in role.topics}
    playing |= dict.fromkeys(cast.transforms, ("transforms", "places the sensors"))
    read, clocks = _read(log) if full else ({}, {})
    starts = [topic.start_ns for topic in log.topics.values() if topic.start_ns is not None]
    ends = [topic.end_ns for topic in log.topics.values() if topic.end_ns is not None]
    return {
        "kind": "log",
        "path": str(log.path),
        "container": log.container,
        "size_bytes": log.size_bytes,
        "start_ns": min(starts, default=None),
        "duration_s": (max(ends) - min(starts)) / 1e9 if starts and ends else None,
        "robot": cast.robot,
        "robot_why": cast.robot_why,
        "topics": [
            {
                "name": topic.name,
                "type": topic.type_name,
                "messages": topic.message_count,
                "rate_hz": _rate_hz(topic),
                "role": playing.get(topic.name, (None, None))[0],
                "why": playing.get(topic.name, (None, cast.left_out.get(topic.name) or topic.problem))[1],
                **read.get(topic.name, {}),
            }
            for topic in sorted(log.topics.values(), key=lambda topic: topic.name)
        ],
        **clocks,
        "problems": list(cast.problems),
        "warnings": [*cast.warnings, *_simulated(log.topics.values())],
        "damage": [str(damage) for damage in log.damage if damage.is_loss],
        "remarks": log.remarks,
    }


def _read(log: Log) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Read every message; return facts by topic, and what the clocks did."""
    found: dict[str, TopicStamps] = {}
    for tables in log.batches(sorted(log.topics)):
        for name, table in tables.items():
            found.setdefault(name, TopicStamps()).add(table)
    facts = {name: stamps.facts() for name, stamps in found.items()}
    times = {name: stamps.topic_times() for name, stamps in found.items()}
    clocks = {name: of for name, of in times.items() if of.header_ns is not None and len(of.log_time_ns)}
    published = any(topic.type_name == CLOCK and topic.message_count for topic in log.topics.values())
    settled = settle_clocks(clocks, clock_published=published)
    clock = settled.simulated
    counting = clock.topics if clock is not None and clock.remark() is not None else frozenset()
    for name, timeline in settled.timelines.items():
        wrong = timeline.notes.get("stamps_replaced", 0) * found[name].every - facts[name]["zero_stamps"]
        facts[name] |= {
            "time": timeline.source,
            "time_why": timeline.why,
            "header_minus_log_s": timeline.offset_s,
            "moved_s": [moved for moved in timeline.moved_s if moved],
            "wrong_stamps": max(wrong, 0),
            "simulated_time": name in counting,
        }
    return facts, {
        "clock_epochs": len(settled.steps) + 1,
        "clock_steps": [
            {"log_time_ns": step.log_time_ns, "step_s": step.step_s, "topics": list(step.topics)}
            for step in settled.steps
        ],
    }


def _simulated(topics: Iterable[Topic]) -> list[str]:
    """Return what the index tells of simulated time."""
    listed = list(topics)
    starts_ns = [topic.start_ns for topic in listed if topic.start_ns is not None]
    said = []
    if starts_ns and max(starts_ns) < SIMULATED_NS:
        said.append(f"the log's own times are simulated: they begin {min(starts_ns) / 1e9:.3f} s after 0")
    said += [
        f"{topic.name} publishes simulated time ({topic.type_name})" for topic in listed if topic.type_name == CLOCK
    ]
    return said


def _rate_hz(topic: Topic) -> float | None:
    if topic.message_count is None or topic.start_ns is None or topic.end_ns is None or topic.end_ns <= topic.start_ns:
        return None
    return round((topic.message_count - 1) / ((topic.end_ns - topic.start_ns) / 1e9), 2)
