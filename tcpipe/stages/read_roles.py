"""Which topic plays which role, by what the recipe says of that."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from tcpipe.logs.names_of_fields import proposed_roles
from tcpipe.logs.roles import RoleAssignment, assign_roles
from tcpipe.logs.topics import Topic
from tcpipe.recipe import ReadConfig
from tcpipe.robots.profiles import Profiles


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
    return replace(assignment, warnings=(*assignment.warnings, *proposed))
