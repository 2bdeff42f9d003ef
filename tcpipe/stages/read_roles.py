"""Topics by role, as the recipe and the log have it, and topics that could be used for power."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from typing import cast, get_args

from tcpipe.logs.field_mapping import find_topic
from tcpipe.logs.roles import RoleAssignment, assign_roles
from tcpipe.logs.topics import Topic
from tcpipe.recipe import ReadConfig, Recipe, Role
from tcpipe.robots import Profiles
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
    # An offset is of one clock that was off: where it corrects nothing, the log is another's. The other keys are of the robot, and hold
    # for logs without that sensor as well.
    there = ", ".join(assignment.roles)
    problems = tuple(
        f"recipe read.time_offset_s.{role}: no topic of this log is used as {role}, so it has no effect; roles in the log: {there}"
        for role in config.time_offset_s
        if role not in assignment.roles
    )
    return replace(
        assignment, problems=problems, findings=(*assignment.findings, *_find_unused_keys(config, assignment))
    )


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
