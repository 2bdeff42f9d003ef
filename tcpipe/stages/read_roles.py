"""Topics by role, as the recipe and the log have it, and topics that could be used for power."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast, get_args

import numpy as np

from tcpipe.logs.field_mapping import find_topic, propose_roles
from tcpipe.logs.roles import OVERLAY, RoleAssignment, assign_roles
from tcpipe.logs.topics import Topic
from tcpipe.power.sources import FLOAT_TYPES, LARGEST_AMP, LARGEST_VOLT, find_quantity, is_of_drives, make_rail_name
from tcpipe.recipe import ReadConfig, Recipe, Role
from tcpipe.recipe.suggestions import TomlValue, suggest
from tcpipe.robots import Profiles
from tcpipe.stages.message_arrays import LogReader, make_message_arrays
from tcpipe.tables.findings import Finding, Subject, make_finding


def find_read_config(recipe: Recipe, topics: Collection[str]) -> ReadConfig:
    """Return the configuration for a log of these topics: mapped tables that it holds are used as their roles."""
    roles: dict[Role, list[str]] = {}
    for name, table in recipe.tables.items():
        role = cast("Role", table.role or name)
        of, power = table.columns, table.make_power_source(name)
        if role in get_args(Role) and (topic := find_topic(name, role, of, power.type if power else None)[0]) in topics:
            roles.setdefault(role, []).append(topic)
    return replace(recipe.read, topics={**roles, **recipe.read.topics}) if roles else recipe.read


def decide_roles(config: ReadConfig, topics: Iterable[Topic], robot: str | None, *, known: Profiles) -> RoleAssignment:
    """Return which topic is used as which role, and why; `RecipeError` where no profile has the robot's name."""
    topics = list(topics)
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
    free = [topic for topic in topics if topic.name not in config.ignore_topics]
    findings = (*assignment.findings, *propose_roles(free, {*assignment.roles, *config.topics}))
    if assignment.problems:
        return replace(assignment, findings=findings)
    # An offset is of one clock that was off: where it corrects nothing, the log is another's. The other keys are of the robot, and hold
    # for logs without that sensor as well.
    there = ", ".join(assignment.roles)
    problems = tuple(
        f"recipe read.time_offset_s.{role}: no topic of this log is used as {role}, so it has no effect; roles in the log: {there}"
        for role in config.time_offset_s
        if role not in assignment.roles
    )
    return replace(assignment, problems=problems, findings=(*findings, *_find_unused_keys(config, assignment)))


def _find_unused_keys(config: ReadConfig, assignment: RoleAssignment) -> Iterator[Finding]:
    """Yield a finding for each key of the recipe that is for a role without a topic."""
    for key, given in (
        ("extrinsics", config.extrinsics),
        ("odometry_scale", config.odometry_scale),
        ("time_source", config.time_source),
    ):
        for role in given:
            if role not in assignment.roles:
                yield make_finding("recipe-key-unused", Subject("role", role), names={"key": f"read.{key}.{role}"})


@dataclass(frozen=True, slots=True)
class _Candidate:
    topic: Topic
    what: str
    scale: float
    """What its numbers are multiplied by, to be V or A."""
    range: tuple[float, float]
    """Lowest and highest [V] or [A]."""

    def source(self, rail: str) -> Mapping[str, TomlValue]:
        """Return the table that reads it as a part of a rail."""
        keys = {"type": self.topic.type_name, "topic": self.topic.name, self.what: "data", "rail": rail, "sign": "auto"}
        return keys | ({f"{self.what}_scale": self.scale} if self.scale != 1.0 else {})


def find_power_candidates(log: LogReader, assignment: RoleAssignment, config: ReadConfig) -> tuple[Finding, ...]:
    """Return what could be power in a log without a power topic; nothing where the recipe names its topics or there are no such numbers."""
    if "power" in assignment.roles or "power" in config.topics:
        return ()
    wanted = [topic for topic in log.topics.values() if _is_wanted(topic, config)]
    tables = log.tables([topic.name for topic in wanted]) if wanted else {}
    found = []
    for topic in wanted:
        values = make_message_arrays(tables[topic.name], ()).get("data") if topic.name in tables else None
        known = np.asarray([] if values is None else values, np.float64)
        known = known[np.isfinite(known)]
        what = str(find_quantity(topic.name))
        if known.size and np.any(known):
            most = LARGEST_VOLT if what == "voltage" else LARGEST_AMP
            scale = 0.001 if np.median(np.abs(known)) > most else 1.0
            found.append(_Candidate(topic, what, scale, (scale * float(known.min()), scale * float(known.max()))))
    if not found:
        return ()
    used = _pair_rails(found)
    topics: list[TomlValue] = list(dict.fromkeys(each.topic.name for _, each in used))
    sources = [of.source(rail) for rail, of in used]
    ranges: dict[str, Any] = {
        f"{end}_{unit}": choose(number for of in found if of.what == what for number in of.range)
        for what, unit in (("voltage", "volt"), ("current", "amp"))
        if any(of.what == what for of in found)
        for end, choose in (("low", min), ("high", max))
    }
    return (
        make_finding(
            "power-candidates",
            Subject("role", "power"),
            names={"topics": ", ".join(of.topic.name for of in found)},
            remedies=suggest("use", {"read.topics": {"power": topics}, "power_sources": sources}) if used else (),
            topics_count=len(found),
            **ranges,
        ),
    )


def _is_wanted(topic: Topic, config: ReadConfig) -> bool:
    told = topic.type_name in FLOAT_TYPES and find_quantity(topic.name) is not None
    readable = topic.problem is None and topic.message_count != 0
    return told and readable and topic.name not in config.ignore_topics and not topic.name.startswith(OVERLAY)


def _pair_rails(found: Sequence[_Candidate]) -> list[tuple[str, _Candidate]]:
    """Return each rail's voltage and current: called alike, or all currents at the only voltage; of drives alone where some are."""
    voltages = {make_rail_name(of.topic.name): of for of in found if of.what == "voltage"}
    currents = [of for of in found if of.what == "current"]
    currents = [of for of in currents if is_of_drives(of.topic.name)] or currents
    used = []
    for of in currents:
        rail = make_rail_name(of.topic.name)
        voltage = voltages.get(rail) or (next(iter(voltages.values())) if len(voltages) == 1 else None)
        if voltage is None:
            return []
        used += [(rail, voltage), (rail, of)]
    return used
