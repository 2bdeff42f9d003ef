"""Robot profiles: what is known of a robot before its log is opened, and which robot a log is of.

Speeds and nominal voltages are the makers' data sheets'; the Husky's are also the paper's (section IV-A: 24 V lead-acid, 1.0 m/s).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from tcpipe.errors import RecipeError
from tcpipe.logs.topics import Topic


@dataclass(frozen=True, slots=True)
class Robot:
    """What is known of a robot.

    ``platform`` is the maker's code by which clearpath_platform_msgs/Power names its indices; ``status_types`` are message types that
    only this robot publishes; ``name_pattern`` is a regular expression for its name in a topic.
    """

    name: str
    max_velocity_mps: float | None = None
    voltage_range_volt: tuple[float, float] | None = None
    platform: str | None = None
    status_types: tuple[str, ...] = ()
    name_pattern: str | None = None


GENERIC = Robot("generic")
"""A robot of which nothing is known."""

ROBOTS: dict[str, Robot] = {
    robot.name: robot
    for robot in (
        Robot("husky", 1.0, (20.0, 30.0), "A200", ("husky_msgs/msg/HuskyStatus",), r"husky|a200"),
        Robot("warthog", 5.0, (40.0, 60.0), "W200", ("warthog_msgs/msg/Status",), r"warthog|w200"),
        Robot("jackal", 2.0, (20.0, 30.0), "J100", ("jackal_msgs/msg/Status", "jackal_msgs/msg/Power"), r"jackal|j100"),
        Robot("dingo", 1.3, None, "D100", (), r"dingo|d[do]?1[05]0"),
        Robot("ridgeback", 1.1, None, "R100", (), r"ridgeback|r100"),
        GENERIC,
    )
}
"""Profiles by name; the recipe key ``robot`` and ``--robot`` choose one."""

_POWER_OF_ANY_CLEARPATH = "clearpath_platform_msgs/msg/Power"
_SERIAL_NUMBER = re.compile(r"(?<![a-z0-9])([a-z]{1,2}\d{3})[_-]\d{4}(?!\d)")
"""How Clearpath names a robot in its topics: by platform and number."""


def find_robot(topics: Iterable[Topic], name: str | None) -> tuple[Robot, str]:
    """Return the robot's profile and why it was taken.

    Parameters
    ----------
    topics : the log's topics.
    name : the profile's name where the user gave one.

    Raises
    ------
    RecipeError : no profile has that name.
    """
    if name is not None:
        if name not in ROBOTS:
            raise RecipeError(f"robot: no profile is called {name!r}; there are {', '.join(sorted(ROBOTS))}")
        return ROBOTS[name], "given"
    listed = sorted(topics, key=lambda topic: topic.name)
    by_type = _only_one((robot, t) for t in listed for robot in ROBOTS.values() if t.type_name in robot.status_types)
    if by_type is not None:
        return by_type[0], f"topic {by_type[1].name} is {by_type[1].type_name}"
    by_name = _only_one(
        (robot, t)
        for t in listed
        for robot in ROBOTS.values()
        if robot.name_pattern is not None and re.search(rf"(?<![a-z])({robot.name_pattern})(?![a-z])", t.name.lower())
    )
    if by_name is not None:
        return by_name[0], f"topic {by_name[1].name} is called so"
    for topic in listed:
        if topic.type_name == _POWER_OF_ANY_CLEARPATH:
            if other := next((found for of in listed if (found := _SERIAL_NUMBER.search(of.name.lower()))), None):
                return GENERIC, f"topics are named after the platform {other[1].upper()}, which no profile knows"
            return ROBOTS["husky"], f"topic {topic.name} is {topic.type_name}, and nothing names another platform"
    return GENERIC, "no topic tells the robot"


def _only_one(found: Iterable[tuple[Robot, Topic]]) -> tuple[Robot, Topic] | None:
    """Return the first pair if all of them agree on the robot."""
    pairs = list(found)
    return pairs[0] if pairs and len({robot.name for robot, _ in pairs}) == 1 else None
