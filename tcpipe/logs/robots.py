"""Which robot a log is of: told by the user, by message types that only one robot publishes, or by its name in a topic; or several."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from tcpipe.errors import RecipeError
from tcpipe.logs.topics import Topic
from tcpipe.recipe.suggestions import RecipeFragment
from tcpipe.robots.profiles import GENERIC, Robot

_POWER_OF_ANY_CLEARPATH = "clearpath_platform_msgs/msg/Power"
_FIRST_TO_PUBLISH_IT = "A200"
_SERIAL_NUMBER = re.compile(r"(?<![a-z0-9])([a-z]{1,2}\d{3})[_-]\d{4}(?!\d)")
"""How Clearpath names a robot in its topics: by platform and number."""


def find_robot(topics: Iterable[Topic], name: str | None, robots: Mapping[str, Robot]) -> tuple[str, str]:
    """Return the profile of a log, ``name`` where the user gave one, and why; `RecipeError` where no profile has that name."""
    if name is not None:
        if name not in robots:
            raise RecipeError(f"robot: no profile {name!r}; known: {', '.join(sorted(robots))}")
        return name, "given"
    listed = sorted(topics, key=lambda topic: topic.name)
    if by_type := _find_only_topic(
        (n, t) for t in listed for n, of in robots.items() if t.type_name in of.status_types
    ):
        return by_type[0], f"topic {by_type[1].name} is {by_type[1].type_name}"
    if by_name := _find_only_topic((n, t) for t in listed for n, of in robots.items() if _is_called(of, t)):
        return by_name[0], f"topic {by_name[1].name} has its name"
    for topic in listed:
        if topic.type_name == _POWER_OF_ANY_CLEARPATH:
            if other := next((found for of in listed if (found := _SERIAL_NUMBER.search(of.name.lower()))), None):
                return GENERIC, f"topics are named after the platform {other[1].upper()}, which has no profile"
            first = next((n for n, of in robots.items() if of.platform == _FIRST_TO_PUBLISH_IT), GENERIC)
            return first, f"topic {topic.name} is {topic.type_name}, and nothing names another platform"
    return GENERIC, "no topic identifies the robot"


def _is_called(robot: Robot, topic: Topic) -> bool:
    words = "|".join(map(re.escape, robot.topic_words))
    return bool(words) and re.search(rf"(?<![a-z])({words})(?![a-z])", topic.name.lower()) is not None


def _find_only_topic(found: Iterable[tuple[str, Topic]]) -> tuple[str, Topic] | None:
    """Return the first pair if all of them agree on the robot."""
    pairs = list(found)
    return pairs[0] if pairs and len({name for name, _ in pairs}) == 1 else None


_ENOUGH = 3
_PLACES = frozenset({"gnss", "wheel_odometry"})


def find_robot_namespaces(candidates: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Return the roles that could be played in each robot's namespace, or nothing where one robot explains the topics.

    Two namespaces are two robots when three roles or more, GNSS or wheels among them, could be played in either. A camera that brings an
    IMU and an odometry of its own, or a controller that takes commands and gives odometry, is no robot.
    """
    roles_of: dict[str, set[str]] = {}
    for role, topics in candidates.items():
        for topic in topics:
            first, _, rest = topic.strip("/").partition("/")
            if rest:
                roles_of.setdefault(f"/{first}", set()).add(role)
    kinds = Counter(map(frozenset, roles_of.values()))  # few, however many namespaces there are
    robots = {
        name
        for name, roles in roles_of.items()
        for others, count in kinds.items()
        if count > (others == roles) and len(roles & others) >= _ENOUGH and roles & others & _PLACES
    }
    return {name: tuple(role for role in candidates if role in roles_of[name]) for name in sorted(robots)}


def ask_which_robot(robots: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the one question that a log of several robots asks, and the recipe line that answers it."""
    each = "; ".join(f"{name} ({', '.join(roles)})" for name, roles in robots.items())
    first, *others = robots
    other = "".join(f' or "{name}"' for name in others)
    return [
        f"the log contains {len(robots)} robots, but a run has one: {each}",
        "decide in the recipe (tcpipe.toml), for example:",
        *f"{RecipeFragment({'read': {'namespace': first}}).toml()}  #{other}".splitlines(),
    ]
