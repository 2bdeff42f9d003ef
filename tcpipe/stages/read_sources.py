"""The topics that play a role, each with its messages as arrays and its usable readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

from numpy.typing import NDArray

from tcpipe.errors import RoleError
from tcpipe.logs.conversions import convert_imu_to_si, scale_odometry, select_ground_velocity
from tcpipe.logs.field_mapping import MAPPED_TYPES, make_mapped_message
from tcpipe.logs.messages import LOG_TIME, Readings, count_frames, find_utc_offset, list_needed_fields, read_messages
from tcpipe.logs.role_findings import make_topic_not_decoded
from tcpipe.logs.roles import RoleAssignment
from tcpipe.logs.topics import Topic
from tcpipe.power.readings import PowerReadings
from tcpipe.recipe import ReadConfig, Role
from tcpipe.robots.profiles import Profiles
from tcpipe.stages.read_power import read_power_of_topics, select_power_rows
from tcpipe.tables.findings import Finding, Subject, make_finding


@dataclass(frozen=True, slots=True)
class TopicReadings:
    """A topic that plays a role: how many messages it has and what frames they name, and what of them is usable."""

    topic: str
    role: Role
    type_name: str
    messages: int
    frames: Mapping[str, int]
    readings: Readings

    @property
    def key(self) -> str:
        """What tells it from others: a topic may tell places and velocities at once."""
        return f"{self.topic} ({self.role})" if self.role == "gnss_velocity" else self.topic


def read_sources(
    messages: dict[str, dict[str, NDArray[Any]]],
    topics: Mapping[str, Topic],
    assignment: RoleAssignment,
    config: ReadConfig,
    *,
    known: Profiles,
) -> tuple[list[TopicReadings], PowerReadings, list[Finding]]:
    """Read the messages of every topic that plays a role; they are taken out of ``messages``, so that no log is held twice.

    Returns
    -------
    sources : one a topic, in the order of the roles.
    power : the rails, empty where there is no power or it was refused.
    findings : topics that play a role but cannot be decoded.

    Raises
    ------
    RoleError : ``read.fields`` names what the messages do not hold.
    """
    played = [(cast("Role", role.name), topic) for role in assignment.roles.values() for topic in role.topics]
    findings: list[Finding] = []
    arrays: dict[tuple[Role, str], Mapping[str, NDArray[Any]]] = {}
    for role, topic in played:
        if topic not in messages:
            findings.append(make_topic_not_decoded(topics[topic]))
            continue
        found = _read_fields(messages[topic], role, config)
        needed = () if role == "power" else list_needed_fields(_find_type(topics[topic], role, config))
        if missing := [name for name in needed if name not in found]:
            names = {"role": role, "fields": ", ".join(missing)}
            findings.append(make_finding("fields-missing", Subject("topic", topic), names=names))
        else:
            arrays[role, topic] = found
    types = {topic: topics[topic].type_name for _, topic in arrays}
    of_power = {topic: (types[topic], columns) for (role, topic), columns in arrays.items() if role == "power"}
    power = read_power_of_topics(of_power, assignment, config, known=known)
    sources = []
    messages.clear()
    for role, topic in list(arrays):
        columns = arrays.pop((role, topic))
        if role != "power":
            readings = read_messages(columns, role, _find_type(topics[topic], role, config))
        elif topic in power.rails:
            readings = select_power_rows(columns, power.rails[topic])
        else:
            continue
        seen_frames = count_frames(columns, types[topic])
        source = TopicReadings(topic, role, types[topic], len(columns[LOG_TIME]), seen_frames, readings)
        sources.append(replace(source, readings=_as_the_recipe_says(source, config)))
    return sources, power, findings


def _as_the_recipe_says(source: TopicReadings, config: ReadConfig) -> Readings:
    """Return a topic's readings in the units and scale that the recipe states."""
    readings, role = source.readings, source.role
    if role == "gnss" and config.time_source.get(role) != "header":
        return replace(readings, findings=(*readings.findings, *find_utc_offset(readings)))
    if role == "imu":
        return convert_imu_to_si(readings, config.imu_units)
    if role == "gnss_velocity" and role not in config.topics:
        return select_ground_velocity(readings, next(iter(source.frames), ""), source.topic)
    return scale_odometry(readings, config.odometry_scale[role]) if role in config.odometry_scale else readings


def _find_type(topic: Topic, role: Role, config: ReadConfig) -> str:
    return MAPPED_TYPES[role] if role in config.fields else topic.type_name


def _read_fields(columns: dict[str, NDArray[Any]], role: Role, config: ReadConfig) -> dict[str, NDArray[Any]]:
    """Return the fields of a topic's messages, those of a message type of the user's own as the recipe maps them."""
    if role not in config.fields:
        return columns
    mapped = make_mapped_message(role, columns, config.fields[role])
    if isinstance(mapped, list):
        raise RoleError(*mapped)
    return mapped
