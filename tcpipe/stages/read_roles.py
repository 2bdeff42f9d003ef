"""Which topic plays which role, by what the recipe says of that."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import cast, get_args

from tcpipe.logs.mapped import topic_of
from tcpipe.logs.names_of_fields import proposed_roles
from tcpipe.logs.roles import RoleAssignment, assign_roles
from tcpipe.logs.topics import Topic
from tcpipe.recipe import ReadConfig, Recipe, Role
from tcpipe.robots.profiles import Profiles


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
    proposed = tuple(proposed_roles(free, {*assignment.roles, *config.topics}))
    if assignment.problems:
        return replace(assignment, problems=(*assignment.problems, *proposed))
    problems, warnings = _absent_roles(config, assignment)
    return replace(assignment, problems=problems, warnings=(*assignment.warnings, *proposed, *warnings))


def _absent_roles(config: ReadConfig, assignment: RoleAssignment) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what is wrong, and what is to be said, of keys for roles that no topic of the log plays.

    An offset is of one clock that was seen to be off: where it corrects nothing, another is, or the log is another's. Where a sensor sits
    and which of its stamps rules is of the robot, and holds for logs without that sensor as well.
    """
    there = ", ".join(assignment.roles)
    lines = {
        key: tuple(
            f"recipe read.{key}.{role}: no topic of this log plays {role}, so it does nothing; roles that are there: {there}"
            for role in given
            if role not in assignment.roles
        )
        for key, given in (
            ("time_offset_s", config.time_offset_s),
            ("placement", config.placement),
            ("odometry_scale", config.odometry_scale),
            ("time", config.time),
        )
    }
    return lines.pop("time_offset_s"), tuple(line for every in lines.values() for line in every)
