"""Which field of a role a column is, or a field of somebody's own message type, by what it is called."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import islice

from tcpipe.logs.field_mapping import MAPPED
from tcpipe.logs.roles import OVERLAY, ROLE_TYPES
from tcpipe.logs.topics import Topic
from tcpipe.logs.wire_types import BASE_TYPES, FieldTypes, MsgTextError, parse_msg
from tcpipe.recipe.suggestions import suggest
from tcpipe.tables.findings import Finding, Subject, make_finding

_ANY_UNIT = re.compile(r"(?<!\s)\s*+[\[(].*|_?(deg|rad|m|mps2?|radps|volt|amp)$")


def _match_axes(before: str, name: str) -> dict[str, str]:
    return {f"{name}_{axis}": rf"(.*[_.])?({before})[_.]?{axis}" for axis in "xyz"}


_VELOCITY = {"linear_x": r"(.*[_.])?(t?l(in(ear)?)?|v(el(ocity)?)?)[_.]?x|speed|velocity|forward_velocity|v"}
_TURN = {"angular_z": r"(.*[_.])?(t?a(ng(ular)?)?|w|omega)[_.]?z|yaw_?rate|omega"}
CALLED: Mapping[str, Mapping[str, str]] = {
    "gnss": {
        "latitude": r"(.*[_.])?lat(itude)?",
        "longitude": r"(.*[_.])?(lon(gitude)?|lng|long)",
        "altitude": r"(.*[_.])?(alt(itude)?|height|h)",
        "east_std": r"sde",
        "north_std": r"sdn",
        "up_std": r"sdu",
    },
    "imu": {
        **_match_axes("w|gyro?|ang(ular)?_?vel(ocity)?|angular_velocity|omega", "angular_velocity"),
        **_match_axes("a|acc(el)?|lin(ear)?_?acc(el(eration)?)?", "linear_acceleration"),
    },
    "command": {**_VELOCITY, **_TURN},
    "wheel_odometry": {**_VELOCITY, **_TURN},
    "power": {"voltage": r"(.*[_.])?volt(age)?", "current": r"(.*[_.])?(curr(ent)?|amps?)"},
    "pose": {
        "x": r"[tp]?x|pos(ition)?[_.]?x|east(ing)?",
        "y": r"[tp]?y|pos(ition)?[_.]?y|north(ing)?",
        "z": r"[tp]?z|pos(ition)?[_.]?z|up|height",
    },
}
"""What is called how, as patterns of names in lower case without a unit; the likelier role first."""

_PROPOSED = ("gnss", "imu")
"""Roles whose fields are called so that nothing else is taken for them."""
_DEEPEST = 4
_LONGEST_BYTES, _MOST_NAMES = 1 << 16, 1000
"""No receiver's message is longer or has more numbers; one that is made to hurt does not cost minutes."""


def match_field_names(role: str, names: Sequence[str]) -> dict[str, str]:
    """Return the name of each field of a role; {} where one is missing that the role needs."""
    found: dict[str, str] = {}
    for field, pattern in CALLED[role].items():
        match = next((name for name in names if re.fullmatch(pattern, _ANY_UNIT.sub("", name.lower()))), None)
        if match is not None and match not in found.values():
            found[field] = match
    return found if all(field in found for field, of in MAPPED[role].items() if of.needed) else {}


def propose_roles(topics: Iterable[Topic], settled: Collection[str]) -> Iterator[Finding]:
    """Yield a finding for each message type that no role knows and whose fields are called as those of a role that nothing can play.

    ``settled`` are roles that are played, or that the recipe speaks of; what a definition in the log does not tell cannot be proposed.
    """
    held = [of for of in topics if of.message_count != 0 and of.problem is None and not of.name.startswith(OVERLAY)]
    types = {topic.type_name for topic in held}
    for role in _PROPOSED:
        if role in settled or types & set(ROLE_TYPES[role]):
            continue
        for topic in held:
            if found := match_field_names(role, _list_number_fields(topic)):
                remedies = suggest("map", {"read.topics": {role: [topic.name]}, "read.fields": {role: found}})
                names = {"role": role, "type": topic.type_name}
                yield make_finding("role-proposed", Subject("topic", topic.name), names=names, remedies=remedies)


def _list_number_fields(topic: Topic) -> list[str]:
    """Return the dotted names of a message's first numbers; none where its definition cannot be read or is far too long."""
    if len(topic.definition) > _LONGEST_BYTES:
        return []
    try:
        return list(islice(_iterate_below(parse_msg(topic.definition, topic.type_name), topic.type_name), _MOST_NAMES))
    except MsgTextError:
        return []


def _iterate_below(messages: Mapping[str, FieldTypes], type_name: str, prefix: str = "") -> Iterator[str]:
    for name, of in messages.get(type_name, ()):
        dotted = f"{prefix}{name}"
        if of.length is None and of.name in BASE_TYPES - {"string", "wstring"}:
            yield dotted
        elif of.length is None and dotted.count(".") < _DEEPEST:
            yield from _iterate_below(messages, of.name, f"{dotted}.")
