"""Which topic plays which role, by what the recipe says of that."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from typing import cast, get_args

from tcpipe.logs.mapped import topic_of
from tcpipe.logs.names_of_fields import propose_roles
from tcpipe.logs.roles import RoleAssignment, assign_roles
from tcpipe.logs.topics import Topic
from tcpipe.recipe import ReadConfig, Recipe, Role
from tcpipe.robots.profiles import Profiles
from tcpipe.tables.findings import Finding, Subject, make_finding


def find_read_config(recipe: Recipe, topics: Collection[str]) -> ReadConfig:
    """Return what rules the reading of a log of these topics: of one that holds the mapped tables, they play their roles."""
    roles: dict[Role, list[str]] = {}
    for name, table in recipe.tables.items():
        role = cast("Role", table.role or name)
        if role in get_args(Role) and (topic := topic_of(name, role, table.columns)[0]) in topics:
            roles.setdefault(role, []).append(topic)
    return replace(recipe.read, topics={**roles, **recipe.read.topics}) if roles else recipe.read


def roles_by(config: ReadConfig, topics: Iterable[Topic], robot: str | None, *, known: Profiles) -> RoleAssignment:
    """Return which topic plays which role, and why; `RecipeError` where no profile has the robot's name."""
    topics = list(topics)
    assignment = assign_roles(
        topics,
        config.topics,
        config.ignore_topics,
        robot,
        known=known,
        namespace=config.namespace,
        mapped=config.fields,
        pose_from=config.pose_from,
    )
    free = [topic for topic in topics if topic.name not in config.ignore_topics]
    findings = (*assignment.findings, *propose_roles(free, {*assignment.roles, *config.topics}))
    if assignment.problems:
        return replace(assignment, findings=findings)
    # An offset is of one clock that was off: where it corrects nothing, the log is another's. The other keys are of the robot, and hold
    # for logs without that sensor as well.
    there = ", ".join(assignment.roles)
    problems = tuple(
        f"recipe read.time_offset_s.{role}: no topic of this log plays {role}, so it does nothing; roles that are there: {there}"
        for role in config.time_offset_s
        if role not in assignment.roles
    )
    return replace(assignment, problems=problems, findings=(*findings, *_find_unused_keys(config, assignment)))


def _find_unused_keys(config: ReadConfig, assignment: RoleAssignment) -> Iterator[Finding]:
    """Yield a finding for each key of the recipe that is for a role without a topic."""
    for key, given in (
        ("placement", config.placement),
        ("odometry_scale", config.odometry_scale),
        ("time", config.time),
    ):
        for role in given:
            if role not in assignment.roles:
                yield make_finding("recipe-key-unused", Subject("role", role), names={"key": f"read.{key}.{role}"})
