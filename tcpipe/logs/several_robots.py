"""Whether a log holds several robots: namespaces that each hold a whole set of sensors, by topic names alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

_ENOUGH = 3
_PLACES = frozenset({"gnss", "wheel_odometry"})


def namespaces_of_robots(candidates: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Return the roles that could be played in each robot's namespace, or nothing where one robot explains the topics.

    Two namespaces are two robots when three roles or more, GNSS or wheels among them, could be played in either. A camera that brings an
    IMU and an odometry of its own, or a controller that takes commands and gives odometry, is no robot.

    Parameters
    ----------
    candidates : topics that could play each role, by role.
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
