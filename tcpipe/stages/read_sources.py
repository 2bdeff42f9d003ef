"""The topics that play a role, each with its messages as arrays and its usable readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import pyarrow as pa
from numpy.typing import NDArray

from tcpipe.errors import RoleError
from tcpipe.logs.imu_units import imu_in_si
from tcpipe.logs.mapped import MAPPED_TYPES, mapped_message
from tcpipe.logs.messages import Readings, frames, needed_fields, read_messages
from tcpipe.logs.odometry_scale import scaled
from tcpipe.logs.roles import RoleAssignment
from tcpipe.logs.topics import Topic
from tcpipe.logs.velocity_frame import over_ground
from tcpipe.power.readings import PowerReadings
from tcpipe.power.sources import power_lists
from tcpipe.recipe import ReadConfig, Role
from tcpipe.robots.profiles import Profiles
from tcpipe.stages.message_arrays import message_arrays
from tcpipe.stages.read_power import power_of_topics, power_rows


@dataclass(frozen=True, slots=True)
class TopicReadings:
    """A topic that plays a role: its messages' fields by dotted name, and what of them is usable."""

    topic: str
    role: Role
    type_name: str
    columns: Mapping[str, NDArray[Any]]
    readings: Readings

    @property
    def key(self) -> str:
        """What tells it from others: a topic may tell places and velocities at once."""
        return f"{self.topic} ({self.role})" if self.role == "gnss_velocity" else self.topic


def read_sources(
    tables: Mapping[str, pa.Table],
    topics: Mapping[str, Topic],
    assignment: RoleAssignment,
    config: ReadConfig,
    *,
    known: Profiles,
) -> tuple[list[TopicReadings], PowerReadings, list[str]]:
    """Read the tables of every topic that plays a role.

    Raises
    ------
    RoleError : ``read.fields`` names what the messages do not hold.

    Returns
    -------
    sources : one a topic, in the order of the roles.
    power : the rails, empty where there is no power or it was refused.
    warnings : topics that play a role but cannot be decoded.
    """
    played = [(cast("Role", role.name), topic) for role in assignment.roles.values() for topic in role.topics]
    warnings: list[str] = []
    arrays: dict[tuple[Role, str], Mapping[str, NDArray[Any]]] = {}
    for role, topic in played:
        if topic not in tables:
            warnings.append(f"{role}: {topic} cannot be decoded and plays no part (see the log's damage)")
            continue
        found = _fields(tables[topic], topics[topic].type_name, role, config, known)
        needed = () if role == "power" else needed_fields(_type_of(topics[topic], role, config))
        if missing := [name for name in needed if name not in found]:
            warnings.append(f"{role}: {topic} plays no part, its messages have no field {', '.join(missing)}")
        else:
            arrays[role, topic] = found
    types = {topic: topics[topic].type_name for _, topic in arrays}
    power = power_of_topics(
        {topic: (types[topic], columns) for (role, topic), columns in arrays.items() if role == "power"},
        assignment,
        config,
        known=known,
    )
    sources = []
    for (role, topic), columns in arrays.items():
        if role != "power":
            readings = read_messages(columns, role, _type_of(topics[topic], role, config))
            if role == "imu":
                readings = imu_in_si(readings, config.imu_units)
            elif role == "gnss_velocity" and role not in config.topics:
                readings = over_ground(readings, next(iter(frames(columns, types[topic])), ""))
            elif role in config.odometry_scale:
                readings = scaled(readings, config.odometry_scale[role])
            sources.append(TopicReadings(topic, role, types[topic], columns, readings))
        elif topic in power.rails:
            sources.append(TopicReadings(topic, role, types[topic], columns, power_rows(columns, power.rails[topic])))
    return sources, power, warnings


def _type_of(topic: Topic, role: Role, config: ReadConfig) -> str:
    """Return the message type as which a topic is read: its own, or that to which the recipe maps it."""
    return MAPPED_TYPES[role] if role in config.fields else topic.type_name


def _fields(
    table: pa.Table, type_name: str, role: Role, config: ReadConfig, known: Profiles
) -> dict[str, NDArray[Any]]:
    """Return the fields of a topic's messages, those of a message type of the user's own as the recipe maps them."""
    found = message_arrays(table, power_lists(type_name, known.power_sources) if role == "power" else ())
    if role not in config.fields:
        return found
    mapped = mapped_message(role, found, config.fields[role])
    if isinstance(mapped, list):
        raise RoleError(*mapped)
    return mapped
