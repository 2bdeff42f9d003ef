"""Whether a log holds several robots: namespaces that each hold a whole set of sensors, by topic names alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from tcpipe.recipe.suggestions import RecipeFragment

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


def which_robot(robots: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the one question that a log of several robots asks, and the recipe line that answers it."""
    each = "; ".join(f"{name} ({', '.join(roles)})" for name, roles in robots.items())
    first, *others = robots
    other = "".join(f' or "{name}"' for name in others)
    return [
        f"the log holds {len(robots)} robots, and a run is of one: {each}",
        "settle it in the recipe (tcpipe.toml), for example:",
        *f"{RecipeFragment({'read': {'namespace': first}}).toml()}  #{other}".splitlines(),
    ]
